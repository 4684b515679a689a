"""How far the nearest obstacle is, exactly. All that stop a robot count, but for what it passes under."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from drnav_jax.geometry import sample_bilinear
from drnav_jax.worlds.materials import BLOCKS
from drnav_jax.worlds.world import HEADROOM, World


@jax.jit
def clearance(world: World, xy: Float[Array, "2"]) -> Float[Array, ""]:
    """Signed distance from a point to the nearest surface of any obstacle.

    A disc robot collides where this is less than its radius. Between the cell centres of a grid
    map the distance is interpolated; beyond its edge there are no walls, and it is a lower bound.

    Args:
        world: Boxes, cylinders and field.
        xy: A point in the world's frame [m].

    Returns:
        Distance [m]; negative inside an obstacle, inf in an empty world.
    """
    nearest = jnp.asarray(jnp.inf, jnp.float32)
    if world.boxes.shape[0]:
        x, y, yaw, half_x, half_y, z_min = jnp.asarray(world.boxes, jnp.float32)[:, :6].T
        c, s, rx, ry = jnp.cos(yaw), jnp.sin(yaw), xy[0] - x, xy[1] - y
        beyond_x = jnp.abs(c * rx + s * ry) - half_x
        beyond_y = jnp.abs(c * ry - s * rx) - half_y
        outside = jnp.hypot(jnp.maximum(beyond_x, 0.0), jnp.maximum(beyond_y, 0.0))
        inside = jnp.minimum(jnp.maximum(beyond_x, beyond_y), 0.0)
        blocks = jnp.asarray(BLOCKS)[world.box_surfaces.material] & (z_min < HEADROOM)
        nearest = jnp.minimum(nearest, jnp.min(jnp.where(blocks, outside + inside, jnp.inf)))
    if world.cylinders.shape[0]:
        x, y, radius, z_min = jnp.asarray(world.cylinders, jnp.float32)[:, :4].T
        blocks = jnp.asarray(BLOCKS)[world.cylinder_surfaces.material] & (z_min < HEADROOM)
        nearest = jnp.minimum(nearest, jnp.min(jnp.where(blocks, jnp.hypot(xy[0] - x, xy[1] - y) - radius, jnp.inf)))
    if world.field.values.size:
        field = world.field._replace(values=jnp.asarray(world.field.values, jnp.float32))
        low = jnp.asarray(field.origin, jnp.float32)
        high = low + jnp.asarray(field.values.shape[::-1], jnp.float32) * field.resolution
        edge = jnp.clip(xy, low, high)
        away = jnp.hypot(xy[0] - edge[0], xy[1] - edge[1])
        value = sample_bilinear(field._replace(origin=low), edge)
        beyond = jnp.hypot(away, jnp.maximum(value, 0.0))  # walls lie in the grid, a convex set
        nearest = jnp.minimum(nearest, jnp.where(away > 0, beyond, value))
    return nearest
