"""DR. Nav in JAX: robot navigation that does not get trapped in dead ends.

    state = drnav_jax.init(spec, params, pose)
    state, command, info = drnav_jax.step(spec, params, state, observation, key, replan=tick % 5 == 0)

Pure, jittable functions for one robot; the caller vmaps. The parts are in the subpackages.
"""

from drnav_jax import evaluate, filter, geometry, grids, metrics, models, navigator, planning, sim, types, worlds
from drnav_jax.navigator import Info, NavParams, NavSpec, NavState, init, step
from drnav_jax.types import Command, Evidence, GridMap, GridSpec, LocalMap, Observation, RobotParams, empty_observation

__version__ = "0.1.0"

__all__ = [
    "Command",
    "Evidence",
    "GridMap",
    "GridSpec",
    "Info",
    "LocalMap",
    "NavParams",
    "NavSpec",
    "NavState",
    "Observation",
    "RobotParams",
    "empty_observation",
    "evaluate",
    "filter",
    "geometry",
    "grids",
    "init",
    "metrics",
    "models",
    "navigator",
    "planning",
    "sim",
    "step",
    "types",
    "worlds",
]
