"""The predictor that says nothing: no evidence anywhere (`--predictor none`)."""

import jax.numpy as jnp

from drnav_jax.types import Evidence, LocalMap, Observation


def predict(params: None, observation: Observation, local_map: LocalMap) -> Evidence:
    """No evidence: confidence 0 on every cell.

    Args:
        params: None.
        observation: Not used.
        local_map: Its shape is used.
    """
    del params, observation
    nothing = jnp.zeros(local_map.occupancy.shape, jnp.float32)
    return Evidence(p_dead=nothing + 0.5, confidence=nothing)
