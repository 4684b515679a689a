"""Predictors: `(predictor_params, observation, local_map) -> Evidence`."""

from drnav_jax.models import geometric, oracle, silent
from drnav_jax.models.geometric import GeometricParams
from drnav_jax.models.oracle import OracleParams

__all__ = ["GeometricParams", "OracleParams", "geometric", "oracle", "silent"]
