"""Planners that follow a path: DWB or MPPI behind one face, with the path, the costmap and Nav2's recovery around them.

    path       straight to the goal, or down the cost-to-go (`route`), at most once per `path_period`; the controller sees
               the `reach` metres of it ahead of the robot
    costmap    Nav2's inflation of the map around the robot, for a disc of its radius plus `padding`, since the surface of
               an obstacle may lie in front of the centre of its cell
    controller a command, limited to what the robot can do within a tick
    recovery   Nav2's round robin, if the composition has it

Numbers are Nav2's bringup, but for what has to follow the robot: horizons, sampling and what is measured by them
(`FollowerParams`) are those of one that drives 1 m/s, and strides follow the tick, which must be MPPI's step. The
route's clearance is about as dear as NavFn's 1 + 0.016 cost: 4.5 beside an obstacle, 1 from 0.7 m on.
"""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from drnav_jax import geometry
from drnav_jax.planning import costmap, dwb, dwb_critics, dynamics, mppi, mppi_critics, mppi_rollout, nav2_recovery, tracker
from drnav_jax.planning import path as paths
from drnav_jax.planning.compositions import Composition
from drnav_jax.planning.costmap import InflationParams
from drnav_jax.planning.dwb import DwbSpec, Sampling
from drnav_jax.planning.dwb_critics import DwbParams, DwbState
from drnav_jax.planning.mppi import MppiParams, MppiSpec, MppiState
from drnav_jax.planning.mppi_critic_params import CriticParams, CriticSpec, FollowParams, GoalParams
from drnav_jax.planning.nav2_recovery import Nav2Params, Nav2State
from drnav_jax.planning.noise import NoiseSpec
from drnav_jax.planning.path import Path
from drnav_jax.planning.route import Route, RouteParams
from drnav_jax.planning.tracker import Critics, Track
from drnav_jax.types import GridMap, RobotParams, Scalar

# missions have no yaw at the goal: GoalAngle, and DWB's rotation in the goal window, have nothing to do
_LONG_AGO = -1e6  # [s]
_CRITICS = ("Constraint", "Cost", "Goal", "PathAlign", "PathFollow", "PathAngle", "PreferForward")


@dataclasses.dataclass(frozen=True)
class FollowerSpec:
    """Sizes.

    Attributes:
        dwb: Samples of DWB.
        mppi: Samples of MPPI; its step is the tick.
        critics: Of MPPI; EDE joins them where the composition has it.
        num_points: Of the path, and of the part of it that a controller sees.
        spacing: Of its points [m].
        num_moves: Cells that the path goes down the cost-to-go.
        smoothing: Points on each side over which such a path is averaged.
    """

    dwb: DwbSpec = DwbSpec()
    mppi: MppiSpec = MppiSpec(num_steps=28, dt=0.1, immediate=True, noise=NoiseSpec(bank=8000))
    critics: CriticSpec = CriticSpec(critics=_CRITICS, cost_every=1, align_every=2)
    num_points: int = 96
    spacing: float = 0.05
    num_moves: int = 48
    smoothing: int = 4

    def __post_init__(self) -> None:
        """Check sizes."""
        if min(self.num_points, self.num_moves) < 2 or self.spacing <= 0 or self.smoothing < 0:
            raise ValueError(
                "num_points and num_moves must be >= 2, spacing > 0 m and smoothing >= 0, "
                f"got {self.num_points}, {self.num_moves}, {self.spacing}, {self.smoothing}."
            )


class FollowerParams(NamedTuple):
    """Numbers."""

    dwb: DwbParams = DwbParams()
    sampling: Sampling = Sampling()
    mppi: MppiParams = MppiParams(std_v=0.4)
    critics: CriticParams = CriticParams(goal=GoalParams(5.0, 2.8), follow=FollowParams(beyond=2.8))
    inflation: InflationParams = InflationParams()
    recovery: Nav2Params = Nav2Params()
    route: RouteParams = RouteParams(clearance=3.5, soft_clearance=0.45)  # of planners that only follow a path
    reach_dwb: Scalar = 2.0  # [] of the path ahead [m]
    reach_mppi: Scalar = 3.4  # [] as far beyond the horizon's 2.8 m as Nav2's 1.7 m beyond its 1.4 m [m]
    padding: Scalar = 0.04  # [] of the footprint [m]


class FollowerState(NamedTuple):
    """Carried between ticks; what the composition has no use for is None."""

    path: Path
    path_time: Array  # [] when the path was made [s]
    has_path: Array  # [] bool
    dwb: DwbState | None
    mppi: MppiState | None
    recovery: Nav2State | None


def mppi_critics_of(spec: FollowerSpec, planner: Composition) -> CriticSpec:
    """MPPI's critics: EDE joins them where the composition has it."""
    if not planner.exposure:
        return spec.critics
    return dataclasses.replace(spec.critics, critics=(*spec.critics.critics, "Exposure"))


def check(spec: FollowerSpec, planner: Composition, dt: float) -> None:
    """Raise a ValueError if MPPI would not take its steps in ticks of `dt` [s]."""
    if planner.tracker == "mppi" and abs(spec.mppi.dt - dt) > 1e-6:
        raise ValueError(f"MPPI's step must be the tick, {dt} s: follower.mppi.dt is {spec.mppi.dt}.")


def critics(spec: FollowerSpec, planner: Composition) -> tuple[str, ...]:
    """Names of what `Track.critics` holds, of whatever tracker."""
    own = {"dwa": tracker.TERMS, "dwb": dwb_critics.CRITICS}
    return mppi_critics_of(spec, planner).critics if planner.tracker == "mppi" else own[planner.tracker]


@partial(jax.jit, static_argnames=("spec", "planner"))
def init(
    spec: FollowerSpec, planner: Composition, params: FollowerParams, pose: Float[Array, "3"]
) -> FollowerState | None:
    """Standing still, without a path; None where the composition needs none of it."""
    if not planner.follows and planner.recovery != "nav2":
        return None
    here = Path(jnp.full(spec.num_points, pose[0]), jnp.full(spec.num_points, pose[1]), jnp.asarray(1, jnp.int32))
    # the bank's key is fixed: like Nav2's, it is drawn once, and every command reads another part of it
    held = mppi.init(spec.mppi, params.mppi, jax.random.key(0)) if planner.tracker == "mppi" else None
    return FollowerState(
        path=here, path_time=jnp.asarray(_LONG_AGO, jnp.float32), has_path=jnp.asarray(True),
        dwb=dwb_critics.init() if planner.tracker == "dwb" else None,
        mppi=held, recovery=nav2_recovery.init(pose) if planner.recovery == "nav2" else None,
    )  # fmt: skip


def forget(state: FollowerState, leap: Bool[Array, ""]) -> FollowerState:
    """After a `leap` of odometry the path is somewhere else: a new one is due."""
    return state._replace(path_time=jnp.where(leap, _LONG_AGO, state.path_time))


def replan(
    spec: FollowerSpec,
    planner: Composition,
    state: FollowerState,
    route: Route | None,
    origin: Float[Array, "2"],
    size: float,
    xy: Float[Array, "2"],
    goal: Float[Array, "2"],
    time: Array,
) -> FollowerState:
    """A new path, if it is time for one. DWB's latches begin anew with it, as in Nav2. Arguments as in `path.down`.

    Where there is no way to the goal the old path is kept, and `has_path` is False.
    """
    if not planner.follows:
        return state if route is None else state._replace(has_path=route.reachable)
    due = time >= state.path_time + planner.path_period - 1e-3
    if planner.path == "straight":
        path = paths.straight(xy, goal, spacing=spec.spacing, num_points=spec.num_points)
        found = jnp.asarray(True)
    else:
        assert route is not None
        path, found = paths.down(
            route, origin, size, xy, goal, num_moves=spec.num_moves, spacing=spec.spacing, num_points=spec.num_points,
            smoothing=spec.smoothing,
        ), route.reachable  # fmt: skip
    take = lambda new, old: jax.tree.map(lambda a, b: jnp.where(due & found, a, b), new, old)  # noqa: E731
    return state._replace(
        path=take(path, state.path), path_time=jnp.where(due, time, state.path_time),
        has_path=jnp.where(due, found, state.has_path),
        dwb=None if state.dwb is None else take(dwb_critics.init(), state.dwb),
    )  # fmt: skip


def costs_of(params: FollowerParams, robot: RobotParams, clear: GridMap) -> GridMap:
    """Nav2's costmap from the clearance [m] around the robot."""
    values = costmap.inflation(clear.values, robot.radius + params.padding, params.inflation)
    return clear._replace(values=values)


def act(
    spec: FollowerSpec,
    planner: Composition,
    params: FollowerParams,
    robot: RobotParams,
    state: FollowerState,
    clear: GridMap,
    risk: Float[Array, "H W"],
    pose: Float[Array, "3"],
    twist: Float[Array, "2"],
    goal: Float[Array, "2"],
    dt: float,
    key: PRNGKeyArray,
) -> tuple[FollowerState, Track]:
    """One command along the path.

    Args:
        spec: Sizes.
        planner: The composition, whose tracker is "dwb" or "mppi".
        params: Numbers.
        robot: Radius and limits.
        state: So far.
        clear: Clearance [m] around the robot.
        risk: P_dead^foot above the prior on the same cells.
        pose: Robot.
        twist: Its speeds.
        goal: Where the path leads to [m].
        dt: Tick [s].
        key: Randomness.
    """
    costs = costs_of(params, robot, clear)
    reach = params.reach_mppi if planner.tracker == "mppi" else params.reach_dwb
    ahead = paths.ahead(state.path, pose[:2], reach, num_points=spec.num_points)
    if planner.tracker == "mppi":
        asked = mppi_critics_of(spec, planner)
        scene = mppi_critics.look(
            asked, params.critics, mppi_rollout.limits_of(robot), params.inflation,
            costs._replace(values=mppi_critics.pack(costs.values, risk)), ahead, pose, 0.0, 0.25,
        )  # fmt: skip
        cost = mppi_critics.nav2(asked, spec.mppi.num_steps, spec.mppi.dt)
        held, wanted, info = mppi.plan(
            spec.mppi, params.mppi, mppi_rollout.limits_of(robot), cost, scene, state.mppi, pose, twist, key
        )
        state = state._replace(mppi=held)
    else:
        # as in Nav2's bringup: none of its critics minds driving backwards, and once turned round it would go on like that
        forward = robot._replace(v_min=jnp.maximum(robot.v_min, 0.0))
        held, wanted, info = dwb.plan(
            spec.dwb, params.sampling, params.dwb, forward, costs, ahead, state.dwb, pose, twist,
            jnp.concatenate([goal, pose[2:]]),
        )  # fmt: skip
        state = state._replace(dwb=held)
    command = dynamics.limit(wanted.v, wanted.omega, twist, robot, dt)
    near = geometry.sample_bilinear(clear, pose[:2])
    why = Critics(chosen=info.chosen, best=info.best, best_cost=info.best_cost)
    return state, Track(command=command, certified=~info.failed, cost=info.cost, clearance=near, critics=why)


def recover(
    params: FollowerParams,
    robot: RobotParams,
    state: FollowerState,
    clear: GridMap,
    track: Track,
    pose: Float[Array, "3"],
    twist: Float[Array, "2"],
    time: Array,
    waiting: Bool[Array, ""],
    dt: float,
) -> tuple[FollowerState, Track, Bool[Array, ""]]:
    """Nav2's recovery, whose command takes the tracker's place while it acts.

    Returns:
        The new state, the track, and whether to clear the map around the robot.
    """
    assert state.recovery is not None
    good = track.certified & state.has_path
    held, wanted, wipe = nav2_recovery.update(
        params.recovery, state.recovery, costs_of(params, robot, clear), robot, pose, time, good, waiting
    )
    acts = held.mode != nav2_recovery.FOLLOW
    instead = dynamics.limit(wanted[0], wanted[1], twist, robot, dt)
    command = jax.tree.map(lambda a, b: jnp.where(acts, a, b), instead, track.command)
    # a controller that was interrupted begins anew
    fresh = None if state.mppi is None else state.mppi._replace(
        control=jnp.where(acts, 0.0, state.mppi.control), history=jnp.where(acts, 0.0, state.mppi.history)
    )  # fmt: skip
    return state._replace(recovery=held, mppi=fresh), track._replace(command=command), wipe
