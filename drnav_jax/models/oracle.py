"""A perfect predictor: the world's true labels near the robot, also through walls. The planner's ceiling."""

from typing import NamedTuple

import jax.numpy as jnp

from drnav_jax import geometry
from drnav_jax.types import Evidence, GridMap, LocalMap, Observation, Scalar


class OracleParams(NamedTuple):
    """The truth, and how far the oracle sees."""

    label: GridMap  # 1 where a cell is a dead end, else 0, [H, W]
    reach: Scalar = 6.0  # [] [m]
    p_dead: Scalar = 0.97  # [] p̂ of dead-end cells
    p_open: Scalar = 0.03  # [] p̂ of all others


def predict(params: OracleParams, observation: Observation, local_map: LocalMap) -> Evidence:
    """True labels within `reach` of the robot; no evidence beyond.

    Args:
        params: The labels.
        observation: Only its pose is used.
        local_map: Where the window lies.
    """
    h, w = local_map.occupancy.shape
    x, y = geometry.cell_centres((h, w), local_map.origin, local_map.resolution)
    xy = jnp.stack(jnp.broadcast_arrays(x, y), axis=-1)
    label = geometry.sample_nearest(params.label, xy, fill=0.0)
    near = jnp.square(x - observation.pose[0]) + jnp.square(y - observation.pose[1]) <= jnp.square(params.reach)
    return Evidence(
        p_dead=jnp.where(label > 0.5, params.p_dead, params.p_open).astype(jnp.float32),
        confidence=near.astype(jnp.float32),
    )
