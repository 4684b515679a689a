"""Everything that decides where the robot goes, as functions of arrays; no model is known here."""

from drnav_jax.planning import (
    compositions,
    costmap,
    dynamics,
    exposure,
    goal_generator,
    recovery,
    route,
    scoring,
    tracker,
)
from drnav_jax.planning.compositions import PLANNERS, Composition, planner
from drnav_jax.planning.costmap import InflationParams, inflation
from drnav_jax.planning.exposure import exposure_integral, exposure_sum
from drnav_jax.planning.goal_generator import GeneratorSpec
from drnav_jax.planning.recovery import RecoveryParams
from drnav_jax.planning.route import RouteParams, RouteSpec
from drnav_jax.planning.scoring import ScoreParams
from drnav_jax.planning.tracker import TrackerParams, TrackerSpec

__all__ = [
    "PLANNERS",
    "Composition",
    "GeneratorSpec",
    "InflationParams",
    "RecoveryParams",
    "RouteParams",
    "RouteSpec",
    "ScoreParams",
    "TrackerParams",
    "TrackerSpec",
    "compositions",
    "costmap",
    "dynamics",
    "exposure",
    "exposure_integral",
    "exposure_sum",
    "goal_generator",
    "inflation",
    "planner",
    "recovery",
    "route",
    "scoring",
    "tracker",
]
