"""Which critics MPPI asks, and the numbers of each: Nav2's bringup. What they compute is in `mppi_critics`."""

import dataclasses
from typing import NamedTuple

from drnav_jax.types import Scalar

BRINGUP = (
    "Constraint", "Cost", "Goal", "GoalAngle", "PathAlign", "PathFollow", "PathAngle", "PreferForward"
)  # fmt: skip
CRITICS = (*BRINGUP, "Obstacles", "Twirling", "VelocityDeadband", "Exposure")


@dataclasses.dataclass(frozen=True)
class CriticSpec:
    """Which critics, and how they look at trajectories.

    Attributes:
        critics: Names out of `CRITICS`, in the order in which Info lists them.
        circular: The footprint is a disc: 253 is a collision.
        track_unknown: Unknown space is no collision.
        cost_every: Points between two that Cost looks at.
        align_every: Points between two that PathAlign looks at.
    """

    critics: tuple[str, ...] = BRINGUP
    circular: bool = True
    track_unknown: bool = False
    cost_every: int = 2
    align_every: int = 4

    def __post_init__(self) -> None:
        """Check names and strides."""
        unknown = [name for name in self.critics if name not in CRITICS]
        if unknown or not self.critics or len(set(self.critics)) < len(self.critics):
            raise ValueError(f"critics must be different names out of {', '.join(CRITICS)}, got {self.critics}.")
        if min(self.cost_every, self.align_every) < 1:
            raise ValueError(f"strides must be >= 1 point, got {self.cost_every} and {self.align_every}.")


class Weight(NamedTuple):
    """Of a critic without further numbers."""

    weight: Scalar  # []
    power: Scalar = 1  # []


class CostParams(NamedTuple):
    """Cost."""

    weight: Scalar = 3.81  # []
    power: Scalar = 1  # []
    critical: Scalar = 300.0  # [] where the costmap is >= 253 and that is no collision
    collision: Scalar = 1e6  # []
    near_goal: Scalar = 1.0  # [] path left below which only collisions count [m]


class ObstacleParams(NamedTuple):
    """Obstacles."""

    critical: Scalar = 20.0  # [] weight of raw
    repulsion: Scalar = 1.5  # [] weight of rep
    power: Scalar = 1  # []
    margin: Scalar = 0.1  # [] [m]
    collision: Scalar = 1e5  # []
    near_goal: Scalar = 0.5  # [] path left below which rep is off [m]


class GoalParams(NamedTuple):
    """Goal and GoalAngle."""

    weight: Scalar  # []
    within: Scalar  # [] off where more of the path is left [m]
    power: Scalar = 1  # []


class ForwardParams(NamedTuple):
    """PreferForward."""

    weight: Scalar = 5.0  # []
    power: Scalar = 1  # []
    beyond: Scalar = 0.5  # [] off where less of the path is left [m]


class DeadbandParams(NamedTuple):
    """VelocityDeadband."""

    weight: Scalar = 35.0  # []
    power: Scalar = 1  # []
    v: Scalar = 0.05  # [] [m/s]
    w: Scalar = 0.05  # [] [rad/s]


class ExposureParams(NamedTuple):
    """EDE."""

    weight: Scalar = 3.0  # [] lambda of eq. 1 and 7 [1/m]
    power: Scalar = 1  # []
    decay: Scalar = 0.1  # [] lambda of w_k = exp(-lambda s_k) [1/m]


class AlignParams(NamedTuple):
    """PathAlign."""

    weight: Scalar = 14.0  # []
    power: Scalar = 1  # []
    beyond: Scalar = 0.5  # [] off where less of the path is left [m]
    furthest: Scalar = 20  # [] off where F is nearer than this many points
    blocked: Scalar = 0.05  # [] off where a larger share of the points before F is blocked (and more than 2)


class FollowParams(NamedTuple):
    """PathFollow."""

    weight: Scalar = 5.0  # []
    power: Scalar = 1  # []
    beyond: Scalar = 1.4  # [] off where less of the path is left [m]
    offset: Scalar = 5  # [] points beyond F


class AngleParams(NamedTuple):
    """PathAngle."""

    weight: Scalar = 2.0  # []
    power: Scalar = 1  # []
    beyond: Scalar = 0.5  # [] off where less of the path is left [m]
    offset: Scalar = 4  # [] points beyond F
    min_angle: Scalar = 1.0  # [] off where the point lies less aside than this [rad]


class CriticParams(NamedTuple):
    """All numbers of all critics."""

    constraint: Weight = Weight(4.0)
    cost: CostParams = CostParams()
    obstacles: ObstacleParams = ObstacleParams()
    goal: GoalParams = GoalParams(5.0, 1.4)
    goal_angle: GoalParams = GoalParams(3.0, 0.5)
    align: AlignParams = AlignParams()
    follow: FollowParams = FollowParams()
    angle: AngleParams = AngleParams()
    forward: ForwardParams = ForwardParams()
    twirling: Weight = Weight(10.0)
    deadband: DeadbandParams = DeadbandParams()
    exposure: ExposureParams = ExposureParams()
