"""The whole robot as two pure functions: `init` and `step`.

    perceive   sensors -> filter: occupancy, and (when replanning) the predictor's dead-end evidence     (eq. 4-6)
    replan     filter -> risk P_dead^foot, cost-to-go, recovery points; every 5th tick
    act        goal generator (eq. 7-9) -> g* -> DWA with a braking certificate -> command;
               or, for the rivals, a path followed by DWB or MPPI (`planning.follower`)

This is the one place that joins models, filter and planning. Nothing branches on values in Python, nothing raises inside:
broken sensor values are masked, a broken pose stops the robot, and every command is finite and within the limits.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from drnav_jax import geometry, grids
from drnav_jax.filter import FilterParams, FilterSpec, FilterState, belief, dead_end
from drnav_jax.filter import recovery as recovery_points
from drnav_jax.filter.recovery import RecoveryParams as RecoveryPointParams
from drnav_jax.filter.recovery import RecoveryPoints, RecoverySpec
from drnav_jax.models import geometric
from drnav_jax.planning import costmap, dynamics, follower, goal_generator, latency, memory, nav2_recovery, route, tracker
from drnav_jax.planning import recovery as behaviour
from drnav_jax.planning.compositions import Composition
from drnav_jax.planning.follower import FollowerParams, FollowerSpec, FollowerState
from drnav_jax.planning.goal_generator import GeneratorSpec, LocalGoal
from drnav_jax.planning.latency import LatencyParams, LatencyState
from drnav_jax.planning.memory import MemorySpec, MemoryState
from drnav_jax.planning.recovery import RecoveryParams, RecoveryState
from drnav_jax.planning.route import RouteParams, RouteSpec
from drnav_jax.planning.scoring import ScoreParams
from drnav_jax.planning.tracker import Track, TrackerParams, TrackerSpec
from drnav_jax.types import Command, Evidence, GridMap, LocalMap, Observation, RobotParams, Scalar, sane

_FAR = 1 << 20  # [cells] so far that nothing of the window stays
_NO_PLAN = -(1 << 16)  # the word of a cell that has only just come into the window: no risk, the worst value

Predictor = Callable[[Any, Observation, LocalMap], Evidence]


@dataclasses.dataclass(frozen=True)
class NavSpec:
    """Everything that fixes shapes and composition.

    Attributes:
        filter: The rolling window and the scan's bins.
        planner: Which parts the planner is composed of.
        predictor: Dead-end evidence from an observation and the local map.
        generator: Candidates of the goal generator.
        tracker: Samples of the DWA.
        route: Resolution of the cost-to-go.
        recovery_points: Capacity of the recovery points' store.
        memory: What the route remembers beyond the window.
        follower: DWB and MPPI.
        dt: Tick [s].
        replan_every: Ticks per replan.
    """

    filter: FilterSpec = FilterSpec()
    planner: Composition = Composition()
    predictor: Predictor = geometric.predict
    generator: GeneratorSpec = GeneratorSpec()
    tracker: TrackerSpec = TrackerSpec()
    route: RouteSpec = RouteSpec()
    recovery_points: RecoverySpec = RecoverySpec()
    memory: MemorySpec = MemorySpec()
    follower: FollowerSpec = FollowerSpec()
    dt: float = 0.1
    replan_every: int = 5

    def __post_init__(self) -> None:
        """Check that the parts fit together."""
        shape = self.filter.grid.shape
        if any(n % self.route.pooling for n in shape):
            raise ValueError(f"the window {shape} must be a multiple of route.pooling = {self.route.pooling} cells.")
        memory.check(self.memory, self.filter.grid, self.route.pooling)
        if self.dt <= 0 or self.replan_every < 1:
            raise ValueError(f"dt must be > 0 s and replan_every >= 1, got {self.dt} and {self.replan_every}.")
        follower.check(self.follower, self.planner, self.dt)
        if abs(self.tracker.dt - self.dt) > 1e-6:
            raise ValueError(f"tracker.dt must be the tick, {self.dt} s, got {self.tracker.dt}.")
        if self.recovery_points.grid != self.filter.grid:
            raise ValueError(f"recovery_points.grid must be the window, {self.filter.grid}.")
        around = 0.5 * (self.filter.local_cells - self.filter.grid.stride) * self.filter.grid.resolution
        if around < 2.0:  # in which the fastest robot stops
            raise ValueError(f"filter.local_cells leave {around:.1f} m around the robot, 2 m are needed to brake.")

    @property
    def candidates(self) -> GeneratorSpec:
        """The generator's sizes as the planner uses them."""
        return self.generator if self.planner.controls else dataclasses.replace(self.generator, num_speeds=0)


class NavParams(NamedTuple):
    """Everything that may be swept."""

    robot: RobotParams = RobotParams()
    filter: FilterParams = FilterParams()
    score: ScoreParams = ScoreParams()
    route: RouteParams = RouteParams()
    tracker: TrackerParams = TrackerParams()
    recovery: RecoveryParams = RecoveryParams()
    recovery_points: RecoveryPointParams = RecoveryPointParams()
    follower: FollowerParams = FollowerParams()
    latency: LatencyParams = LatencyParams()
    predictor: Any = geometric.GeometricParams()
    squeeze_time: Scalar = 5.0  # [] how long narrow ways stay allowed after none was found [s]
    hysteresis: Scalar = 0.3  # [] advantage of the last g* [m]
    goal_tolerance: Scalar = 0.75  # [] nearer than this the robot has arrived and stops [m]
    max_age: Scalar = 0.5  # [] images and scans older than this count as missing [s]
    pose_jump: Scalar = 1.0  # [] the map is dropped when odometry leaps farther than this in one tick [m]


class NavState(NamedTuple):
    """What the robot carries from tick to tick."""

    belief: FilterState
    plan: Array  # [H, W] int32 words of `costmap.pack_plan`
    reachable: Array  # [] bool, a way to the goal is known or may exist
    squeeze_until: Array  # [] until then narrower ways than usual are taken, since there was no other [s]
    risk: Array  # [H, W] P_dead^foot above the prior
    points: RecoveryPoints
    memory: MemoryState
    recovery: RecoveryState
    follower: FollowerState | None  # of planners that follow a path
    latency: LatencyState
    local_goal: Array  # [2] the last g* [m]
    last_pose: Array  # [3] the last finite pose
    time: Array  # [] [s]

    @property
    def last_command(self) -> Array:
        """v, omega `[2]`."""
        return self.latency.sent[0]


class Info(NamedTuple):
    """What one looks at, per tick."""

    local_goal: LocalGoal  # g*, its score, EDE, and the weighted terms of the score, also of the ten best candidates
    track: Track  # the command's certificate, and its cost critic by critic, also of the ten best
    mode: Array  # [] int32, `planning.recovery.MODES`
    arrived: Array  # [] bool
    recoveries: Array  # [] int32, how often recovery began
    p_dead: Array  # [] P_dead under the robot
    clearance: Array  # [] clearance as the map has it [m]
    fault: Array  # [] bool: pose not finite or leapt, or no valid scan


@partial(jax.jit, static_argnames="spec")
def init(spec: NavSpec, params: NavParams, pose: Float[Array, "3"]) -> NavState:
    """A robot that knows nothing yet.

    Args:
        spec: Sizes and composition.
        params: Parameters.
        pose: Where it stands in odom (x, y, yaw).
    """
    shape = spec.filter.grid.shape
    pose = jnp.where(jnp.all(jnp.isfinite(pose)), pose, 0.0)
    return NavState(
        belief=belief.init(spec.filter, params.filter, pose[:2]),
        plan=jnp.zeros(shape, jnp.int32),
        reachable=jnp.asarray(True),
        squeeze_until=jnp.zeros((), jnp.float32),
        risk=jnp.zeros(shape, jnp.float32),
        points=recovery_points.init(spec.recovery_points),
        memory=memory.init(spec.memory),
        recovery=behaviour.init(spec.filter.grid, pose[:2]),
        follower=follower.init(spec.follower, spec.planner, params.follower, pose),
        latency=latency.init(),
        local_goal=pose[:2],
        last_pose=pose, time=jnp.zeros((), jnp.float32),
    )


def _perceive(spec: NavSpec, params: NavParams, state: NavState, seen: Observation, leap: Array) -> NavState:
    """Move the window and fold the scan in; after a leap of odometry whatever has a place is forgotten first."""
    fresh = lambda: belief.init(spec.filter, params.filter, seen.pose[:2])  # noqa: E731
    kept = jax.lax.cond(leap, fresh, lambda: state.belief)
    moved, _ = belief.observe(spec.filter, params.filter, kept, seen.pose, seen.points, seen.point_valid)
    by = jnp.where(leap, _FAR, moved.corner - state.belief.corner)

    def shifted() -> tuple[Array, Array, Array, MemoryState]:
        return (
            geometry.shift(state.plan, by, _NO_PLAN), geometry.shift(state.risk, by, 0.0),
            geometry.shift(state.recovery.visits, by, 0.0), memory.shift(spec.memory, state.memory, by),
        )  # fmt: skip

    unmoved = lambda: (state.plan, state.risk, state.recovery.visits, state.memory)  # noqa: E731
    plan, risk, visits, held = jax.lax.cond(jnp.any(by != 0), shifted, unmoved)
    following = state.follower
    if following is not None:
        following = follower.forget(following, leap)
    return state._replace(
        belief=moved, plan=plan, risk=risk, memory=held, follower=following,
        points=state.points._replace(valid=state.points.valid & ~leap),
        recovery=behaviour.forget(state.recovery, leap)._replace(visits=visits),
        local_goal=jnp.where(leap, seen.pose[:2], state.local_goal), last_pose=seen.pose,
    )  # fmt: skip


def _fine_clearance(spec: NavSpec, params: NavParams, held: FilterState) -> Float[Array, "n n"]:
    """Clearance [m] around the robot on cells of half the map's edge."""
    return costmap.clearance(belief.obstacles(spec.filter, params.filter, held), spec.filter.grid.resolution / 2)


def rollout_field(spec: NavSpec, params: NavParams, state: NavState) -> tuple[GridMap, GridMap]:
    """The square around the robot on cells of half the map's edge: clearance [m], and the words that rollouts read."""
    n, (top, left) = spec.filter.local_cells, belief.local_corner(spec.filter)
    grid, resolution = spec.filter.grid, spec.filter.grid.resolution
    corner = geometry.window_origin(state.belief.corner, grid) + jnp.asarray([left, top], jnp.float32) * resolution
    clear = _fine_clearance(spec, params, state.belief)
    plan = grids.repeat(state.plan[top : top + n, left : left + n], 2)
    words = costmap.pack_clearance(plan, clear)
    return GridMap(clear, corner, resolution / 2), GridMap(words, corner, resolution / 2)


def _replan(spec: NavSpec, params: NavParams, state: NavState, seen: Observation) -> NavState:
    """Evidence -> belief -> risk; recovery points; cost-to-go."""
    grid, planner, robot = spec.filter.grid, spec.planner, params.robot
    local = belief.local_map(spec.filter, state.belief, params.filter)
    nothing = jnp.zeros(grid.shape, jnp.float32)
    held, risk = state.belief, nothing
    if planner.predicts:
        evidence = spec.predictor(params.predictor, seen, local)
        everywhere = jnp.ones(grid.shape, bool)  # where it has nothing to say its confidence is 0
        held = grids.once(belief.assimilate(params.filter, held, evidence, everywhere, spec.dt * spec.replan_every))
        above = dead_end.risk(params.filter.dead_end, held.dead_end)
        risk = dead_end.footprint(above, robot.radius, grid.resolution, half_width=dead_end.half_width(grid.resolution))
    assert local.closed is not None
    clear = costmap.clearance(local.closed, grid.resolution)
    top, left = belief.local_corner(spec.filter)
    near = grids.pool(_fine_clearance(spec, params, state.belief), 2, "max")  # what rollouts will find there
    clear = jax.lax.dynamic_update_slice(clear, near, (top, left))
    goal, points, visits, recover = seen.goal, state.points, state.recovery.visits, state.recovery
    remembered, retreating = state.memory, recover.mode == behaviour.RETREAT
    x, y = geometry.cell_centres(grid.shape, local.origin, grid.resolution)
    here = jnp.hypot(x - seen.pose[0], y - seen.pose[1]) < robot.radius + grid.resolution
    room = grids.flood_fill(local.seen & (local.occupancy < 0) & ((clear > robot.radius) | here), here)
    if planner.predicts:
        shown = geometry.sample_nearest(GridMap(room, local.origin, grid.resolution), goal, fill=False)
        risk = grids.once(dead_end.on_trip(params.filter.dead_end, risk, jnp.hypot(x - goal[0], y - goal[1]), shown))
    if planner.recovery == "drnav":
        points = recovery_points.observe(
            spec.recovery_points, params.recovery_points, points, local, dead_end.probability(held.dead_end), room,
            state.time,
        )  # fmt: skip
        goal = jnp.where(retreating, recover.target, goal)
    found, late = None, jnp.asarray(False)
    if planner.needs_route or planner.recovery == "drnav":
        priced = jnp.where(retreating, 0.0, risk) if planner.risk_in_route else nothing
        squeeze = (state.time < state.squeeze_until) | retreating
        ways = params.route if planner.generates else params.follower.route
        margin = jnp.where(squeeze, ways.squeeze_margin, ways.closed_margin)
        remembered = memory.update(
            spec.memory, remembered, clear >= robot.radius + margin, local.origin, grid.resolution, seen.goal
        )
        # a recovery point is near: leaving the window to get there is out of the question
        beyond = memory.beyond(spec.memory, remembered, grid.shape, spec.route.pooling)
        beyond = jnp.where(retreating, grids.UNREACHABLE, beyond)
        found = route.solve(
            spec.route, ways, clear, priced, jnp.where(retreating, 0.0, visits), local.origin,
            grid.resolution, seen.pose[:2], goal, robot, squeeze, beyond,
        )  # fmt: skip
        value, reachable = found.value, found.reachable
        until = jnp.where(reachable, state.squeeze_until, state.time + params.squeeze_time)
        late = ~reachable & ~squeeze  # narrow ways are looked for at the next replan: the last plan holds until then
    else:
        value, reachable, until = nothing, jnp.asarray(True), state.squeeze_until
    exposed = risk
    if planner.progress == "straight":
        direct = route.straight(grid.shape, local.origin, grid.resolution, seen.goal)
        value, reachable, late = jnp.where(retreating, value, direct), reachable | ~retreating, jnp.asarray(False)
        exposed = jnp.maximum(risk, visits)  # no route that visits could be priced in: they count as exposure
    exposed = exposed if planner.exposure else nothing
    if planner.recovery == "drnav":
        assert found is not None
        recover = jax.lax.cond(
            behaviour.looking(recover, state.time),
            lambda: behaviour.look_back(
                params.recovery, recover, state.time, points.xy, points.rank, points.last_seen, points.valid, found,
                local.seen & (local.occupancy < 0), value, clear, local.origin, grid.resolution, seen.pose,
            ),
            lambda: recover,
        )  # fmt: skip
    following = state.follower
    if following is not None:
        following = follower.replan(
            spec.follower, planner, following, found, local.origin, grid.resolution * spec.route.pooling, seen.pose[:2],
            goal, state.time,
        )  # fmt: skip
        following = jax.tree.map(lambda old, new: jnp.where(late, old, new), state.follower, following)
    return state._replace(
        belief=held, risk=risk, plan=jnp.where(late, state.plan, costmap.pack_plan(exposed, value)),
        reachable=jnp.where(late, state.reachable, reachable), squeeze_until=until, points=points, memory=remembered,
        recovery=recover, follower=following,
    )  # fmt: skip


def _act(
    spec: NavSpec, params: NavParams, state: NavState, seen: Observation, healthy: Array, leap: Array, key: PRNGKeyArray
) -> tuple[NavState, Command, Info]:
    """g* and the command that tracks it; the recovery's rules; the stop at the goal. `seen` is when the command acts."""
    grid, robot, planner = spec.filter.grid, params.robot, spec.planner
    pose, twist, time = seen.pose, seen.twist, state.time
    window = GridMap(state.risk, geometry.window_origin(state.belief.corner, grid), grid.resolution)
    local, field = rollout_field(spec, params, state)

    arrived = jnp.hypot(seen.goal[0] - pose[0], seen.goal[1] - pose[1]) <= params.goal_tolerance
    recover = behaviour.wait(state.recovery, time, arrived | ~healthy)
    heading_for = jnp.where(recover.mode == behaviour.RETREAT, recover.target, seen.goal)
    squeeze = (time < state.squeeze_until) | (recover.mode == behaviour.RETREAT)
    margin = params.score.margin
    score = params.score._replace(margin=jnp.where(squeeze, jnp.minimum(params.route.squeeze_margin, margin), margin))
    choice = goal_generator.given(spec.candidates, seen.goal)
    make = lambda: goal_generator.generate(  # noqa: E731
        spec.candidates, score, robot, field, pose, twist, heading_for, state.local_goal,
        jnp.asarray(params.hysteresis, jnp.float32),
    )  # fmt: skip
    if planner.generates:
        choice = make()
    elif planner.recovery == "drnav":  # back along the route, whoever drives
        choice = jax.lax.cond(recover.mode == behaviour.RETREAT, make, lambda: choice)
    if planner.recovery == "drnav":
        risky = jnp.asarray(False)
        if planner.exposure and not planner.risk_in_route:  # a route that prices risk turns away by itself
            inside = geometry.sample_nearest(window, pose[:2]) > 0.5
            risky = (choice.exposure > params.recovery.risky_exposure) & (params.score.risk_weight > 0) & ~inside
        driven = jnp.abs(state.latency.twist[0]) * spec.dt
        recover = behaviour.update(
            grid, params.recovery, recover, time, spec.dt, state.last_pose[:2], driven, window.origin, choice.valid,
            state.reachable, risky, choice.xy,
        )  # fmt: skip
    following: Any = state.follower
    seek_room = recover.mode == behaviour.CLEAR
    track = tracker.track(spec.tracker, params.tracker, robot, local, pose, twist, choice.xy, seek_room)
    if planner.follows:
        n, (top, left) = spec.filter.local_cells, belief.local_corner(spec.filter)
        risk = grids.repeat(state.risk[top : top + n, left : left + n], 2)
        following, followed = follower.act(
            spec.follower, planner, params.follower, robot, following, local, risk, pose, twist, heading_for, spec.dt, key
        )
        track = tracker.instead(seek_room, track, followed)
    held, mode, entries = state.belief, recover.mode, recover.entries
    if planner.recovery == "nav2":
        waiting = arrived | ~healthy
        following, track, wipe = follower.recover(
            params.follower, robot, following, local, track, state.last_pose, twist, time, waiting, spec.dt
        )
        held = belief.forget(spec.filter, held, pose[:2], jnp.where(wipe, params.follower.recovery.clear_radius, -1.0))
        mode, entries = nav2_recovery.as_drnav(following.recovery.mode), following.recovery.retries
    halt = arrived | ~healthy | (mode == behaviour.STOP)
    stop = dynamics.limit(0.0, 0.0, twist, robot, spec.dt)
    command = jax.tree.map(lambda a, b: jnp.where(halt, a, b), stop, track.command)
    info = Info(
        local_goal=choice, track=track, mode=mode, arrived=arrived, recoveries=entries,
        p_dead=dead_end.probability(geometry.sample_nearest(window._replace(values=held.dead_end), pose[:2])),
        clearance=geometry.sample_bilinear(local, pose[:2]),
        fault=~healthy | leap | ~jnp.any(seen.point_valid),
    )  # fmt: skip
    state = state._replace(
        belief=held, recovery=recover, follower=following, local_goal=choice.xy,
        latency=latency.sent(state.latency, command), time=time + spec.dt,
    )  # fmt: skip
    return state, command, info


@partial(jax.jit, static_argnames=("spec", "replan"))
def step(
    spec: NavSpec, params: NavParams, state: NavState, observation: Observation, key: PRNGKeyArray, *, replan: bool
) -> tuple[NavState, Command, Info]:
    """One tick of the robot.

    Args:
        spec: Sizes and composition (static).
        params: Parameters; sweep them without compiling again.
        state: What the robot carried over.
        observation: What its sensors say now; missing sensors are masked, non-finite values count as missing. Its speeds
            also tell how late commands act (`planning.latency`).
        key: Randomness (only MPPI uses any).
        replan: Also update the dead-end belief, the cost-to-go and the recovery points; every
            `spec.replan_every`-th tick, the first included (static).

    Returns:
        The new state, the command (finite, within speed and acceleration limits) and what one looks at.
    """
    seen, healthy = sane(observation, state.last_pose, state.last_command, params.max_age)
    leap = jnp.hypot(seen.pose[0] - state.last_pose[0], seen.pose[1] - state.last_pose[1]) > params.pose_jump
    state = _perceive(spec, params, state, seen, leap)
    if replan:
        state = _replan(spec, params, state, seen)
    late = latency.update(params.latency, state.latency, seen.twist, params.robot, spec.dt)
    pose, twist = latency.ahead(late, seen.pose, seen.twist, params.robot, spec.dt)  # when this command acts
    return _act(spec, params, state._replace(latency=late), seen._replace(pose=pose, twist=twist), healthy, leap, key)
