"""DR. Nav in JAX: robot navigation that does not get trapped in dead ends.

    state = drnav_jax.init(spec, params, pose)
    state, command, info = drnav_jax.step(spec, params, state, observation, key, replan=tick % 5 == 0)

Pure, jittable functions for one robot; the caller vmaps. The parts are in the subpackages.
"""

from drnav_jax import bags, evaluate, filter, geometry, grids, metrics, models, navigator, planning, sim, types, worlds
from drnav_jax.navigator import Info, NavParams, NavSpec, NavState, init, step
from drnav_jax.types import (
    BevSpec,
    CameraRig,
    Command,
    Evidence,
    GridMap,
    GridSpec,
    LocalMap,
    Mount,
    Observation,
    RigSpec,
    RobotParams,
    empty_observation,
    rig_of,
)

__version__ = "0.1.0"

__all__ = [
    "BevSpec",
    "CameraRig",
    "Command",
    "Evidence",
    "GridMap",
    "GridSpec",
    "Info",
    "LocalMap",
    "Mount",
    "NavParams",
    "NavSpec",
    "NavState",
    "Observation",
    "RigSpec",
    "RobotParams",
    "bags",
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
    "rig_of",
    "sim",
    "step",
    "types",
    "worlds",
]
