"""Everything that decides where the robot goes, as functions of arrays; no model is known here."""

from drnav_jax.planning import (
    api,
    compositions,
    costmap,
    dwb,
    dynamics,
    exposure,
    follower,
    goal_generator,
    mppi,
    mppi_critics,
    nav2_recovery,
    noise,
    recovery,
    route,
    scoring,
    tracker,
)
from drnav_jax.planning.api import Plan, PlanParams, PlanState, drive, plan
from drnav_jax.planning.compositions import PLANNERS, Composition, planner
from drnav_jax.planning.costmap import InflationParams, inflation
from drnav_jax.planning.dwb import DwbSpec
from drnav_jax.planning.dwb_critics import DwbParams
from drnav_jax.planning.exposure import exposure_integral, exposure_sum
from drnav_jax.planning.follower import FollowerParams, FollowerSpec
from drnav_jax.planning.goal_generator import GeneratorSpec
from drnav_jax.planning.mppi import MppiParams, MppiSpec
from drnav_jax.planning.mppi_critic_params import CriticParams, CriticSpec
from drnav_jax.planning.mppi_rollout import Cost
from drnav_jax.planning.noise import NoiseParams, NoiseSpec
from drnav_jax.planning.recovery import RecoveryParams
from drnav_jax.planning.route import RouteParams, RouteSpec
from drnav_jax.planning.scoring import ScoreParams
from drnav_jax.planning.tracker import TrackerParams, TrackerSpec

__all__ = [
    "PLANNERS",
    "Composition",
    "Cost",
    "CriticParams",
    "CriticSpec",
    "DwbParams",
    "DwbSpec",
    "FollowerParams",
    "FollowerSpec",
    "GeneratorSpec",
    "InflationParams",
    "MppiParams",
    "MppiSpec",
    "NoiseParams",
    "NoiseSpec",
    "Plan",
    "PlanParams",
    "PlanState",
    "RecoveryParams",
    "RouteParams",
    "RouteSpec",
    "ScoreParams",
    "TrackerParams",
    "TrackerSpec",
    "api",
    "compositions",
    "costmap",
    "drive",
    "dwb",
    "dynamics",
    "exposure",
    "exposure_integral",
    "exposure_sum",
    "follower",
    "goal_generator",
    "inflation",
    "mppi",
    "mppi_critics",
    "nav2_recovery",
    "noise",
    "plan",
    "planner",
    "recovery",
    "route",
    "scoring",
    "tracker",
]
