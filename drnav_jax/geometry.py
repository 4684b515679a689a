"""Frames and cells: the only module that knows how the plane maps to a grid.

A grid is `[H, W]`, row = y, column = x, row 0 at the smallest y (like `nav_msgs/OccupancyGrid`); `origin` is the world
position of the outer corner of cell (0, 0), so the centre of cell (i, j) is `origin + (j + 1/2, i + 1/2) * resolution`.
Poses are `[..., 3]` = x, y, yaw (SE(2)); points `[..., 2]` = x, y.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drnav_jax.types import GridMap, GridSpec, Scalar


def wrap_angle(angle: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """Wrap angles [rad] to [-pi, pi)."""
    return jnp.mod(angle + jnp.pi, 2 * jnp.pi) - jnp.pi


def transform(pose: Float[Array, "3"], points: Float[Array, "*s 2"]) -> Float[Array, "*s 2"]:
    """Points given in the frame at `pose`, expressed in the frame `pose` is given in [m]."""
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    x, y = points[..., 0], points[..., 1]
    return jnp.stack([pose[0] + c * x - s * y, pose[1] + s * x + c * y], axis=-1)


def inverse(pose: Float[Array, "3"]) -> Float[Array, "3"]:
    """The pose of the parent frame seen from the frame at `pose`."""
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    x, y = pose[0], pose[1]
    return jnp.stack([-c * x - s * y, s * x - c * y, wrap_angle(-pose[2])])


def compose(first: Float[Array, "3"], second: Float[Array, "3"]) -> Float[Array, "3"]:
    """`second`, given in the frame at `first`, expressed in the frame `first` is given in."""
    xy = transform(first, second[:2])
    return jnp.stack([xy[0], xy[1], wrap_angle(first[2] + second[2])])


def cell_of(xy: Float[Array, "*s 2"], origin: Float[Array, "2"], resolution: Scalar) -> Int[Array, "*s 2"]:
    """(row, column) of the cell that holds each point; may lie outside the grid."""
    col = jnp.floor((xy[..., 0] - origin[0]) / resolution)
    row = jnp.floor((xy[..., 1] - origin[1]) / resolution)
    return jnp.stack([row, col], axis=-1).astype(jnp.int32)


def centre_of(cell: Int[Array, "*s 2"], origin: Float[Array, "2"], resolution: Scalar) -> Float[Array, "*s 2"]:
    """World position [m] of the centre of each (row, column)."""
    x = origin[0] + (cell[..., 1].astype(jnp.float32) + 0.5) * resolution
    y = origin[1] + (cell[..., 0].astype(jnp.float32) + 0.5) * resolution
    return jnp.stack([x, y], axis=-1)


def cell_centres(shape: tuple[int, int], origin: Float[Array, "2"], resolution: Scalar) -> tuple[Array, Array]:
    """X `[1, W]` and y `[H, 1]` of all cell centres [m]; they broadcast to `[H, W]`."""
    x = origin[0] + (jnp.arange(shape[1], dtype=jnp.float32) + 0.5) * resolution
    y = origin[1] + (jnp.arange(shape[0], dtype=jnp.float32) + 0.5) * resolution
    return x[None, :], y[:, None]


def inside(cell: Int[Array, "*s 2"], shape: tuple[int, int]) -> Bool[Array, "*s"]:
    """Whether each (row, column) lies on a grid of this shape."""
    return (cell[..., 0] >= 0) & (cell[..., 0] < shape[0]) & (cell[..., 1] >= 0) & (cell[..., 1] < shape[1])


def sample_nearest(grid: GridMap, xy: Float[Array, "*s 2"], fill: Scalar | None = None) -> Array:
    """Value of the cell that holds each point; outside the grid `fill`, or the nearest edge cell if it is None."""
    h, w = grid.values.shape
    cell = cell_of(xy, grid.origin, grid.resolution)
    row, col = jnp.clip(cell[..., 0], 0, h - 1), jnp.clip(cell[..., 1], 0, w - 1)
    value = grid.values.reshape(-1).at[row * w + col].get(mode="promise_in_bounds")
    if fill is None:
        return value
    return jnp.where(inside(cell, (h, w)), value, jnp.asarray(fill, value.dtype))


def sample_bilinear(grid: GridMap, xy: Float[Array, "*s 2"], fill: Scalar | None = None) -> Float[Array, "*s"]:
    """Bilinear interpolation between cell centres; outside the grid `fill`, or the edge's value if it is None.

    Differentiable in the values and, between cell centres, in `xy`.
    """
    h, w = grid.values.shape
    fx = jnp.clip((xy[..., 0] - grid.origin[0]) / grid.resolution - 0.5, 0.0, w - 1.0)
    fy = jnp.clip((xy[..., 1] - grid.origin[1]) / grid.resolution - 0.5, 0.0, h - 1.0)
    col, row = jnp.minimum(fx.astype(jnp.int32), w - 2), jnp.minimum(fy.astype(jnp.int32), h - 2)
    ax, ay = fx - col.astype(fx.dtype), fy - row.astype(fy.dtype)
    flat, k = grid.values.reshape(-1), row * w + col
    v00, v01, v10, v11 = (flat.at[k + o].get(mode="promise_in_bounds") for o in (0, 1, w, w + 1))
    value = (v00 * (1 - ax) + v01 * ax) * (1 - ay) + (v10 * (1 - ax) + v11 * ax) * ay
    if fill is None:
        return value
    return jnp.where(inside(cell_of(xy, grid.origin, grid.resolution), (h, w)), value, jnp.asarray(fill, value.dtype))


def window_corner(xy: Float[Array, "2"], spec: GridSpec) -> Int[Array, "2"]:
    """(row, column) on the odom lattice of cell (0, 0) of the window that is centred on `xy`, to whole strides."""
    step = spec.resolution * spec.stride
    centre = jnp.round(xy / step).astype(jnp.int32)[::-1] * spec.stride
    return centre - jnp.asarray([spec.shape[0] // 2, spec.shape[1] // 2], jnp.int32)


def window_origin(corner: Int[Array, "2"], spec: GridSpec) -> Float[Array, "2"]:
    """Odom position [m] of the outer corner of the window whose cell (0, 0) is lattice cell `corner`."""
    return corner[::-1].astype(jnp.float32) * spec.resolution


def shift(values: Array, by: Int[Array, "2"], fill: Scalar) -> Array:
    """Move the window by whole cells: `out[i, j] = values[i + by[0], j + by[1]]`, `fill` for what rolls in.

    Nothing is interpolated, so a belief is moved, never blurred.
    """
    h, w = values.shape
    by = jnp.clip(by, -jnp.asarray([h, w], jnp.int32), jnp.asarray([h, w], jnp.int32))
    padded = jnp.pad(values, ((h, h), (w, w)), constant_values=jnp.asarray(fill, values.dtype))
    return jax.lax.dynamic_slice(padded, (h + by[0], w + by[1]), (h, w))
