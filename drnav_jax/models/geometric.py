"""Dead ends without learning: what geometry alone implies.

A known free cell is a dead end if from it no walk over known free cells reaches a frontier (free next to unknown), the
window's edge or the goal without passing the robot: whatever lies behind the robot is cut off by its own body. For
other cells the rule only says that they are not shown to be one, which is weak evidence for being open, and none at all
where little has been seen. It works on cells of twice the map's size, in the configuration space of a disc.

It reads the accumulated map and answers as if each replan were news: the belief adds its small p̂ up (eq. 5), so that what
it calls shut only for a moment passes, and what it calls shut three times running, 1 s, is believed at 0.9. P_dead then
tells how long the rule has held, and is no calibrated probability.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from drnav_jax import geometry, grids
from drnav_jax.types import Evidence, LocalMap, Observation, Scalar

_POOLING = 2  # map cells per cell of the rule


class GeometricParams(NamedTuple):
    """The rule's numbers."""

    radius: Scalar = 0.25  # [] robot radius [m]
    margin: Scalar = 0.05  # [] beyond the radius: closer to an obstacle is not free [m]
    body: Scalar = 0.6  # [] radius of the disc by which the robot cuts the free space [m]
    range: Scalar = 8.0  # [] cells farther from the robot get no verdict [m]
    p_dead: Scalar = 0.25  # [] p̂ of cells behind which nothing is left: mostly they are only not seen well enough
    p_open: Scalar = 0.03  # [] p̂ of the other free cells
    open_confidence: Scalar = 0.2  # [] weight of "not shown to be a dead end"
    seen_share: Scalar = 0.6  # [] share of seen cells around a cell from which on it counts as well seen


def _box_mean(values: Float[Array, "H W"], half: int) -> Float[Array, "H W"]:
    """Mean over (2 half + 1)^2 cells, by a summed-area table; beyond the grid counts as 0."""
    h, w = values.shape
    n = 2 * half + 1
    table = jnp.cumsum(jnp.cumsum(jnp.pad(values, ((n, half), (n, half))), axis=0), axis=1)
    total = table[n:, n:] - table[:-n, n:] - table[n:, :-n] + table[:-n, :-n]
    return total[half : half + h, half : half + w] / (n * n)


@partial(jax.jit, static_argnames=())
def predict(params: GeometricParams, observation: Observation, local_map: LocalMap) -> Evidence:
    """Evidence from the known map alone (module docstring).

    Args:
        params: The rule's numbers.
        observation: Only its pose and goal are used.
        local_map: Occupancy as believed.

    Returns:
        p̂ and confidence on the window; confidence 0 where nothing is known or the rule is silent.
    """
    by = _POOLING
    h, w = local_map.occupancy.shape
    size = local_map.resolution * by
    closed = local_map.seen & (local_map.occupancy > 0) if local_map.closed is None else local_map.closed
    occupied = grids.once(grids.pool(closed, by, "any"))
    seen = grids.once(grids.pool(local_map.seen | closed, by, "all"))
    shape = occupied.shape
    # in cells, so that the resolution may be traced
    reach = 5.0
    distance = (grids.distance_transform(occupied, 1.0, reach) - 0.5) * size
    room = jnp.minimum(params.radius + params.margin, (reach - 0.5) * size - 1e-3)
    free = seen & (distance >= room)
    x, y = geometry.cell_centres(shape, local_map.origin, size)
    xy, goal = observation.pose[:2], observation.goal
    to_robot = jnp.hypot(x - xy[0], y - xy[1])
    row, col = jnp.arange(shape[0])[:, None], jnp.arange(shape[1])[None, :]
    edge = (row == 0) | (row == shape[0] - 1) | (col == 0) | (col == shape[1] - 1)
    unknown = jnp.pad(~seen & ~occupied, 1)
    frontier = unknown[:-2, 1:-1] | unknown[2:, 1:-1] | unknown[1:-1, :-2] | unknown[1:-1, 2:]
    seeds = edge | frontier | (jnp.hypot(x - goal[0], y - goal[1]) <= 2.0 * size)
    passable = free & (to_robot > params.body)
    open_ = grids.flood_fill(passable, seeds)
    # the disc must cut: where the robot stands in the open, a small enclosed remainder is no dead end
    shut = passable & ~open_
    verdict = free & (to_robot <= params.range) & (to_robot > params.body)
    well_seen = jnp.clip(_box_mean(seen.astype(jnp.float32), 3) / params.seen_share, 0.0, 1.0)
    confidence = jnp.where(verdict, jnp.where(shut, 1.0, params.open_confidence) * well_seen, 0.0)
    p_dead = jnp.where(shut, params.p_dead, params.p_open).astype(jnp.float32)
    p_dead, confidence = grids.once((p_dead, confidence))
    return Evidence(p_dead=grids.once(grids.repeat(p_dead, by)), confidence=grids.once(grids.repeat(confidence, by)))
