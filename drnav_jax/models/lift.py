"""Camera features on the bird's-eye grid, by the rig's geometry; the rig may be traced, so every frame may have its own.

A column of an image looks along one bearing, so what it sees is spread over depths on that bearing.

    (1)  G[j, e] = Σ_r F[r, j] w_er / (Σ_r w_er + ε),  w_er = (1 - |s(r, j) - s_e| / Δs)₊
         rows r of column j brought to fixed slopes s_e, whatever the pitch, roll and focal length; s(r, j) is the slope,
         rise over run, of the ray through the pixel, in base_link
    (2)  Z[j, t] = MLP([G[j, ·], camera])[t],  t: depths, even in log r
    (3)  bev(c)  = Z[u(c), log r(c)], bilinear, of the camera that sees c least far off its axis; zero where none does
"""

import math
from typing import NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drnav_jax import geometry
from drnav_jax.models.layers import Dense, lecun_normal
from drnav_jax.types import BevSpec, CameraRig

DEPTHS = (0.5, 12.0)  # [m] nearest and farthest depth
SLOPES = 16  # E: fixed, so that parameters do not depend on the size of the images
STEEPEST = 1.0  # slopes lie in ± this
_HEIGHT = 0.5  # share of a camera's height at which cells are looked for


def row_weights(
    rig: CameraRig, pixels: tuple[int, int], cells: tuple[int, int], num_slopes: int = SLOPES
) -> Float[Array, "b n j e r"]:
    """Eq. 1: how rows are brought to slopes, for each column.

    Args:
        rig: Fields `[B, N, ...]`.
        pixels: (rows, columns) of the images that the rig counts in.
        cells: (rows, columns) of the feature map.
        num_slopes: E.
    """
    rows, columns = cells
    v = (jnp.arange(rows, dtype=jnp.float32) + 0.5) * (pixels[0] / rows)
    u = (jnp.arange(columns, dtype=jnp.float32) + 0.5) * (pixels[1] / columns)
    fx, fy = rig.focal[..., 0, None, None], rig.focal[..., 1, None, None]
    across = (u[None, None, :, None] - rig.centre[..., 0, None, None]) / fx  # [B, N, columns, 1]
    down = (v[None, None, None, :] - rig.centre[..., 1, None, None]) / fy  # [B, N, 1, rows]
    x, y, z = (
        rig.rotation[..., k, 0, None, None] * across + rig.rotation[..., k, 1, None, None] * down
        + rig.rotation[..., k, 2, None, None]
        for k in range(3)
    )  # fmt: skip
    slope = z / jnp.sqrt(jnp.square(x) + jnp.square(y) + 1e-6)
    step = 2 * STEEPEST / num_slopes
    wanted = STEEPEST - (jnp.arange(num_slopes, dtype=jnp.float32) + 0.5) * step  # from the top down, as rows go
    near = jnp.maximum(1.0 - jnp.abs(slope[..., None, :] - wanted[None, None, None, :, None]) / step, 0.0)
    return near / (jnp.sum(near, axis=-1, keepdims=True) + 0.1)


class Taps(NamedTuple):
    """Where each cell finds itself in the table `[N columns depths]` of one frame (eq. 3)."""

    index: Int[Array, "b k 4"]
    weight: Float[Array, "b k 4"]
    seen: Bool[Array, "b k"]


def taps(
    bev: BevSpec, cell: int, rig: CameraRig, usable: Bool[Array, "b n"], width: int, columns: int, num_depths: int
) -> Taps:
    """Eq. 3 for cells of `cell` x `cell` cells of the grid.

    Args:
        bev: The grid.
        cell: Grid cells along an edge of the cells asked for.
        rig: Fields `[B, N, ...]`.
        usable: Cameras that have an image.
        width: Of the images that the rig counts in [pixels].
        columns: Of the feature map.
        num_depths: Of the table.
    """
    shape = (bev.shape[0] // cell, bev.shape[1] // cell)
    x, y = geometry.cell_centres(shape, jnp.asarray(bev.origin, jnp.float32), bev.resolution * cell)
    x, y = (jnp.broadcast_to(a, shape).reshape(1, 1, -1) for a in (x, y))
    dx, dy = x - rig.position[..., 0, None], y - rig.position[..., 1, None]
    dz = (_HEIGHT - 1.0) * rig.position[..., 2, None]
    right, _, ahead = (
        rig.rotation[..., 0, k, None] * dx + rig.rotation[..., 1, k, None] * dy + rig.rotation[..., 2, k, None] * dz
        for k in range(3)
    )
    distance = jnp.sqrt(jnp.square(dx) + jnp.square(dy) + 1e-6)
    u = rig.focal[..., 0, None] * right / jnp.maximum(ahead, 1e-3) + rig.centre[..., 0, None]
    seen = (ahead > 0.05 * distance) & (u >= 0) & (u <= width) & usable[..., None]
    facing = jnp.where(seen, ahead / distance, -1.0)
    best = jnp.argmax(facing, axis=1, keepdims=True)  # [B, 1, K]
    pick = lambda a: jnp.take_along_axis(a, best, axis=1)[:, 0]  # noqa: E731
    u, distance, seen = pick(u), pick(distance), pick(seen)
    column = jnp.clip(u * (columns / width) - 0.5, 0.0, columns - 1.0)
    scale = (num_depths - 1) / math.log(DEPTHS[1] / DEPTHS[0])
    depth = jnp.clip(jnp.log(distance / DEPTHS[0]) * scale, 0.0, num_depths - 1.0)
    j, t = (jnp.minimum(a.astype(jnp.int32), n - 2) for a, n in ((column, columns), (depth, num_depths)))
    a, b = column - j.astype(jnp.float32), depth - t.astype(jnp.float32)
    first = (best[:, 0].astype(jnp.int32) * columns + j) * num_depths + t
    index = jnp.stack([first, first + 1, first + num_depths, first + num_depths + 1], axis=-1)
    weight = jnp.stack([(1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b], axis=-1)
    return Taps(index, weight * seen[..., None].astype(jnp.float32), seen)


def read(table: Float[Array, "b q c"], at: Taps) -> Float[Array, "b k c"]:
    """Weighted rows of the table."""
    b, q, c = table.shape
    first = (jnp.arange(b, dtype=jnp.int32) * q)[:, None, None]
    rows = table.reshape(b * q, c).at[at.index + first].get(mode="promise_in_bounds")
    return jnp.sum(rows * at.weight[..., None], axis=2)


class Lift(nn.Module):
    """Eqs. 1 to 3.

    Attributes:
        bev: The grid.
        cell: Grid cells along an edge of the cells that come out.
        num_depths: T.
        hidden: Channels per column.
        features: Channels that come out.
    """

    bev: BevSpec
    cell: int
    num_depths: int
    hidden: int
    features: int

    @nn.compact
    def __call__(
        self, maps: Float[Array, "b n r j c"], camera: Float[Array, "b n d"], rig: CameraRig,
        usable: Bool[Array, "b n"], pixels: tuple[int, int],
    ) -> Float[Array, "b h w c2"]:  # fmt: skip
        """Features `[B, h / cell, w / cell, features + 1]`; the last says where a camera sees.

        Args:
            maps: Feature maps, rows and columns.
            camera: What is to be known of each camera.
            rig: Fields `[B, N, ...]`.
            usable: Cameras that have an image.
            pixels: (rows, columns) of the images that the rig counts in.
        """
        b, n, rows, columns, c = maps.shape
        weights = row_weights(rig, pixels, (rows, columns))
        by_column = maps.transpose(0, 1, 3, 2, 4)
        levelled = jnp.einsum("bnjer,bnjrc->bnjec", weights, by_column)
        flat = levelled.reshape(b, n, columns, SLOPES * c)
        inner = Dense(self.hidden, name="column")(flat) + Dense(self.hidden, bias=False, name="camera")(camera)[:, :, None]
        spread = Dense(self.num_depths * self.features, kernel_init=lecun_normal, name="depths")(nn.relu(inner))
        table = spread.reshape(b, n * columns * self.num_depths, self.features)
        at = taps(self.bev, self.cell, rig, usable, pixels[1], columns, self.num_depths)
        shape = (self.bev.shape[0] // self.cell, self.bev.shape[1] // self.cell)
        found = jnp.concatenate([read(table, at), at.seen[..., None].astype(jnp.float32)], axis=-1)
        return found.reshape(b, *shape, self.features + 1)
