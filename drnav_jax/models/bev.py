"""Between the rolling window, aligned with odom, and the bird's-eye grid of the robot (`BevSpec`).

The network and its training frames read the same map through these functions.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, Shaped, UInt8

from drnav_jax import geometry
from drnav_jax.types import BevSpec, GridMap, LocalMap, Scalar

UNKNOWN, FREE, OCCUPIED = 0, 1, 2  # classes of `classes`


def centres(spec: BevSpec, pose: Float[Array, "3"]) -> Float[Array, "h w 2"]:
    """Cell centres in the frame of `pose` [m]."""
    x, y = geometry.cell_centres(spec.shape, jnp.asarray(spec.origin, jnp.float32), spec.resolution)
    return geometry.transform(pose, jnp.stack(jnp.broadcast_arrays(x, y), axis=-1))


def resample(spec: BevSpec, values: GridMap, pose: Float[Array, "3"], fill: Scalar) -> Shaped[Array, "h w"]:
    """What a grid in odom holds under the centre of each cell; `fill` beyond it."""
    return geometry.sample_nearest(values, centres(spec, pose), fill=fill)


def classes(spec: BevSpec, local_map: LocalMap, pose: Float[Array, "3"]) -> UInt8[Array, "h w"]:
    """The known map as `UNKNOWN`, `FREE` or `OCCUPIED`.

    A cell is looked up at four places, half-way between its centre and its corners: it is occupied if any of them is,
    else free if any is, so that thin walls stay closed.

    Args:
        spec: The grid.
        local_map: The map as the filter believes it.
        pose: Robot in odom (x, y, yaw).
    """
    code = jnp.where(local_map.occupancy > 0, OCCUPIED, FREE)
    code = jnp.where(local_map.seen, code, UNKNOWN)
    grid = GridMap(code.astype(jnp.uint8), local_map.origin, local_map.resolution)
    quarter = spec.resolution / 4
    x, y = geometry.cell_centres(spec.shape, jnp.asarray(spec.origin, jnp.float32), spec.resolution)
    found = jnp.full(spec.shape, UNKNOWN, jnp.uint8)
    for dx in (-quarter, quarter):
        for dy in (-quarter, quarter):
            xy = geometry.transform(pose, jnp.stack(jnp.broadcast_arrays(x + dx, y + dy), axis=-1))
            found = jnp.maximum(found, geometry.sample_nearest(grid, xy, fill=UNKNOWN))
    return found
