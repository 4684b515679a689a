"""The whole robot: it drives, it survives broken sensors, and a batch is what its robots are."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drnav_jax import navigator
from drnav_jax.filter import FilterSpec, RecoverySpec
from drnav_jax.navigator import NavParams, NavSpec
from drnav_jax.planning import PLANNERS, GeneratorSpec, TrackerSpec, follower
from drnav_jax.planning import recovery as behaviour
from drnav_jax.planning.dwb import DwbSpec
from drnav_jax.planning.follower import FollowerSpec
from drnav_jax.planning.memory import MemorySpec
from drnav_jax.planning.mppi import MppiSpec
from drnav_jax.sim import kinematic, lidar
from drnav_jax.sim.contact import clearance
from drnav_jax.sim.kinematic import FaultParams
from drnav_jax.sim.lidar import LidarParams, LidarSpec
from drnav_jax.types import GridSpec, empty_observation
from drnav_jax.worlds.world import make_world

GRID = GridSpec(shape=(64, 96))
BEAMS = LidarSpec(rings=2, azimuths=60, elevation_min=-0.02, elevation_max=0.02)
SPEC = NavSpec(
    filter=FilterSpec(grid=GRID, num_bearings=60, local_cells=64),
    generator=GeneratorSpec(num_speeds=3, num_turns=7, num_headings=34),
    tracker=TrackerSpec(num_speeds=5, num_turns=7),
    recovery_points=RecoverySpec(grid=GRID, capacity=8, num_directions=12),
    memory=MemorySpec(cells=32),
)
PARAMS = NavParams()
ROBOT = PARAMS.robot
KEY = jax.random.key(0)
GOAL = (6.0, 0.5)
# float32 in two programs: a sum may be ordered otherwise, and what it decides is compared exactly
SAME = 1e-5

# A wall across the way, that ends at y = 1.5, and clutter.
WORLD = make_world(
    boxes=[[2.5, -1.0, 0.0, 0.2, 2.5, 0.0, 2.0], [0.5, 1.6, 0.4, 0.3, 0.2, 0.0, 2.0]],
    cylinders=[[4.0, 0.2, 0.3, 0.0, 2.0]],
)

init = jax.jit(navigator.init.__wrapped__, static_argnames="spec")
step = jax.jit(chex.assert_max_traces(navigator.step.__wrapped__, n=2), static_argnames=("spec", "replan"))


def f32(values):
    return jnp.asarray(values, jnp.float32)


def look(pose, twist, goal=GOAL, seed=0):
    """What the sensors say at a pose in `WORLD`."""
    points, valid = lidar.scan(BEAMS, LidarParams(), WORLD, f32(pose), jax.random.key(seed))
    return empty_observation(BEAMS.num_points)._replace(
        points=points, point_valid=valid, pose=f32(pose), twist=f32(twist), goal=f32(goal)
    )


def drive(ticks, pose=(0.0, 0.0, 0.2), goal=GOAL, params=PARAMS, start=None):
    """Closed loop. Returns a list of (state before, observation, replan, state after, command, info)."""
    pose, twist = f32(pose), f32([0.0, 0.0])
    state = init(SPEC, params, pose) if start is None else start
    record = []
    for k in range(ticks):
        seen = look(pose, twist, goal, k)
        replan = k % SPEC.replan_every == 0
        after, command, info = step(SPEC, params, state, seen, KEY, replan=replan)
        record.append((state, seen, replan, after, command, info))
        pose, twist = kinematic.step(ROBOT, pose, twist, command, SPEC.dt)
        state = after
    return record


@pytest.fixture(scope="module")
def trip():
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        return drive(140)


def poses(record):
    return np.array([np.asarray(r[1].pose) for r in record])


def within_limits(command, twist):
    tiny = 1e-5
    v, w = float(command.v), float(command.omega)
    return (
        np.isfinite([v, w]).all()
        and ROBOT.v_min - tiny <= v <= ROBOT.v_max + tiny
        and abs(w) <= ROBOT.w_max + tiny
        and abs(v - twist[0]) <= ROBOT.a_max * SPEC.dt + tiny
        and abs(w - twist[1]) <= ROBOT.alpha_max * SPEC.dt + tiny
    )


@pytest.mark.parametrize("goal, hidden", [((1.6, -0.4), False), (GOAL, True), ((40.0, 0.0), True)])
def test_a_goal_that_is_seen_to_be_reachable_lies_in_no_dead_end(trip, goal, hidden):
    state = trip[10][0]
    held = state.belief._replace(dead_end=jnp.full_like(state.belief.dead_end, 2.0))
    seen = trip[10][1]._replace(goal=f32(goal))
    after, _, _ = step(SPEC, PARAMS, state._replace(belief=held), seen, KEY, replan=True)
    assert (float(after.risk.max()) > 0.5) == hidden and float(after.risk.min()) >= 0.0
    assert float(after.belief.dead_end.max()) > 1.0, "what is believed stays"


def test_it_drives_around_the_wall_to_the_goal_and_stops(trip):
    path = poses(trip)
    assert np.hypot(*(path[-1, :2] - GOAL)) <= PARAMS.goal_tolerance
    room = [float(clearance(WORLD, f32(p[:2]))) for p in path]
    assert min(room) > ROBOT.radius
    assert path[:, 1].max() > 1.7, "around the end of the wall"
    last = trip[-1]
    assert bool(last[5].arrived) and float(last[4].v) == float(last[4].omega) == 0.0
    assert all(within_limits(r[4], np.asarray(r[1].twist)) for r in trip)
    assert not any(bool(r[5].fault) for r in trip) and int(last[5].recoveries) == 0


def test_what_it_says_fits_together(trip):
    for before, seen, _, after, command, info in trip[5:60:9]:
        chex.assert_trees_all_equal(after.last_command, jnp.stack(command))
        np.testing.assert_array_equal(after.last_pose, seen.pose)
        np.testing.assert_allclose(float(after.time - before.time), SPEC.dt, atol=1e-4)
        goal = info.local_goal
        np.testing.assert_array_equal(after.local_goal, goal.xy)
        assert bool(goal.valid) and bool(info.track.certified)
        score = pytest.approx(float(goal.score), abs=1e-3)
        assert float(sum(goal.terms)[0]) == score
        assert float(goal.geometric + PARAMS.score.risk_weight * goal.exposure) == score
        true = min(float(clearance(WORLD, seen.pose[:2])), 1.0)
        assert abs(float(info.clearance) - true) < 0.15  # as the map has it: cells of 5 cm, noise of 2 cm


def test_the_plan_is_made_at_replans_only(trip):
    for before, _, replan, after, _, _ in trip[10:30]:
        moved = bool(jnp.any(before.belief.corner != after.belief.corner))
        if replan:
            assert bool(jnp.any(before.plan != after.plan))
        elif not moved:
            chex.assert_trees_all_equal(before.plan, after.plan)
            chex.assert_trees_all_equal(before.belief.dead_end, after.belief.dead_end)


def test_it_is_a_function(trip):
    state, seen, replan, *after = trip[20]
    chex.assert_trees_all_equal(step(SPEC, PARAMS, state, seen, KEY, replan=replan), tuple(after))
    chex.assert_trees_all_equal(step(SPEC, PARAMS, state, seen, jax.random.key(7), replan=replan), tuple(after))


def broken(what, seen):
    nan, rng = jnp.nan, np.random.default_rng(0)
    points = np.asarray(seen.points).copy()
    if what == "no scan":
        return seen._replace(point_valid=jnp.zeros_like(seen.point_valid))
    if what == "points NaN":
        return seen._replace(points=seen.points * nan)
    if what == "some points inf":
        points[rng.random(len(points)) < 0.3] = np.inf
        return seen._replace(points=f32(points))
    if what == "points huge":
        return seen._replace(points=seen.points * 1e30)
    if what == "points at the robot":
        return seen._replace(points=seen.points * 0)
    if what == "points all around":
        angle = rng.uniform(-np.pi, np.pi, len(points))
        return seen._replace(points=f32(np.stack([0.3 * np.cos(angle), 0.3 * np.sin(angle), 0 * angle + 0.5], -1)))
    if what == "pose NaN":
        return seen._replace(pose=seen.pose.at[2].set(nan))
    if what == "pose inf":
        return seen._replace(pose=seen.pose.at[0].set(jnp.inf))
    if what == "pose jump":
        return seen._replace(pose=seen.pose + f32([5.0, -3.0, 1.0]))
    if what == "pose huge":
        return seen._replace(pose=f32([1e30, -1e30, 1e9]))
    if what == "twist NaN":
        return seen._replace(twist=f32([nan, nan]))
    if what == "twist inf":
        return seen._replace(twist=f32([jnp.inf, -jnp.inf]))
    if what == "twist huge":
        return seen._replace(twist=f32([1e20, -1e20]))
    if what == "goal NaN":
        return seen._replace(goal=f32([nan, 1.0]))
    if what == "goal inf":
        return seen._replace(goal=f32([jnp.inf, 0.0]))
    if what == "goal huge":
        return seen._replace(goal=f32([1e30, -1e30]))
    assert what == "all"
    return jax.tree.map(lambda a: a * nan if a.dtype == jnp.float32 else a, seen)


FAULTS = (
    "no scan", "points NaN", "some points inf", "points huge", "points at the robot", "points all around", "pose NaN",
    "pose inf", "pose jump", "pose huge", "twist NaN", "twist inf", "twist huge", "goal NaN", "goal inf", "goal huge",
    "all",
)  # fmt: skip


@pytest.mark.parametrize("what", FAULTS)
def test_broken_sensors_give_no_broken_command(trip, what):
    """For a second, replans included; then the sensors are back, and the robot goes on."""
    state, seen, *_ = trip[23]
    twist = np.asarray(seen.twist)
    wrong = broken(what, seen)
    for k in range(7):
        state, command, info = step(SPEC, PARAMS, state, wrong, KEY, replan=k % 5 == 0)
        if "twist" not in what and what != "all":
            wrong = wrong._replace(twist=jnp.stack(command))
        assert bool(jnp.isfinite(command.v)) and bool(jnp.isfinite(command.omega))
        assert -0.2 - 1e-6 <= float(command.v) <= 1.0 + 1e-6 and abs(float(command.omega)) <= 1.5 + 1e-6
        if k == 0 and "twist" not in what:
            assert what == "all" or within_limits(command, twist)
        leapt = k == 0 and what in ("pose jump", "pose huge")
        if what in ("no scan", "points NaN", "pose NaN", "pose inf", "all") or leapt:
            assert bool(info.fault)
    if what in ("pose NaN", "pose inf", "all"):
        assert float(command.v) == float(command.omega) == 0.0, "without a pose it stands still"
    state, command, info = step(SPEC, PARAMS, state, seen, KEY, replan=True)  # back: to the map this may be a leap
    for k in range(12):
        state, command, info = step(SPEC, PARAMS, state, seen, KEY, replan=k % 5 == 0)
    assert not bool(info.fault) and within_limits(command, twist)
    finite = jax.tree.map(lambda a: bool(jnp.all(jnp.isfinite(a))), state._replace(points=state.points.xy))
    assert all(jax.tree.leaves(finite))
    assert what == "points all around" or float(command.v) > 0.3, "and it drives on"


def test_without_a_pose_to_begin_with_it_waits():
    state = init(SPEC, PARAMS, f32([jnp.nan, 0.0, 0.0]))
    assert all(bool(jnp.all(jnp.isfinite(a))) for a in jax.tree.leaves(state) if a.dtype == jnp.float32)
    _, command, info = step(SPEC, PARAMS, state, broken("pose NaN", look([0, 0, 0], [0, 0])), KEY, replan=True)
    assert float(command.v) == float(command.omega) == 0.0 and bool(info.fault)


def test_after_a_leap_the_old_map_is_dropped(trip):
    state, seen, *_ = trip[50]
    leapt, _, info = step(SPEC, PARAMS, state, broken("pose jump", seen), KEY, replan=False)
    assert bool(info.fault)
    fresh = init(SPEC, PARAMS, seen.pose + f32([5.0, -3.0, 1.0]))
    want, _, _ = step(SPEC, PARAMS, fresh, broken("pose jump", seen), KEY, replan=False)
    chex.assert_trees_all_equal(leapt.belief, want.belief)
    for name in ("free", "east", "north"):
        np.testing.assert_array_equal(getattr(leapt.memory, name), getattr(want.memory, name), err_msg=name)
    assert (np.asarray(leapt.plan) == np.asarray(leapt.plan)[0, 0]).all()
    for name in ("risk", "local_goal"):
        np.testing.assert_array_equal(getattr(leapt, name), getattr(want, name), err_msg=name)
    assert bool(state.points.valid.any()) and not bool(leapt.points.valid.any())
    assert bool(state.recovery.visits.any()) and int(leapt.recovery.mode) == behaviour.DRIVE
    assert float(leapt.recovery.visits.max()) < 0.2, "but for what it drove just now"


def test_at_the_goal_it_brakes(trip):
    state, seen, *_ = trip[25]
    there = seen._replace(goal=seen.pose[:2] + 0.3, twist=f32([0.9, -0.4]))
    _, command, info = step(SPEC, PARAMS, state, there, KEY, replan=False)
    assert bool(info.arrived)
    np.testing.assert_allclose([command.v, command.omega], [0.65, -0.08], atol=1e-6)


def test_recovery_never_writes_into_the_belief(trip):
    """Whatever recovery does or remembers, P_dead and the risk made of it are the same."""
    state, seen, *_ = trip[30]
    plain = step(SPEC, PARAMS, state, seen, KEY, replan=True)[0]
    for mode in (behaviour.CLEAR, behaviour.RETREAT, behaviour.STOP):
        stuck = state.recovery._replace(
            mode=jnp.int32(mode), visits=jnp.ones(GRID.shape), attempts=jnp.int32(3), anchor_time=state.time - 100.0,
        )  # fmt: skip
        after, _, _ = step(SPEC, PARAMS, state._replace(recovery=stuck), seen, KEY, replan=True)
        chex.assert_trees_all_equal(after.belief, plain.belief)
        chex.assert_trees_all_equal(after.risk, plain.risk)
    assert float(plain.belief.dead_end.std()) > 0


def test_a_robot_that_cannot_move_tries_to_recover():
    """Walled in by an invisible hand: it is told that it stands still whatever it commands."""
    pose = [0.0, 0.0, 0.2]
    state, modes = init(SPEC, PARAMS, f32(pose)), []
    seen = look(pose, [0.0, 0.0])
    for k in range(160):
        state, command, info = step(SPEC, PARAMS, state, seen, KEY, replan=k % 5 == 0)
        modes.append(int(info.mode))
        assert within_limits(command, (0.0, 0.0))
    assert behaviour.CLEAR in modes and int(info.recoveries) >= 2
    assert modes.index(behaviour.CLEAR) == pytest.approx(PARAMS.recovery.stuck_time / SPEC.dt, abs=3)
    assert float(state.recovery.visits.max()) > 0.9


def test_commands_that_act_late_are_planned_for():
    """Around the wall with commands 0.3 s late, since it finds that out; else it takes 107 ticks, at 0.34 m."""
    pose, twist, late = f32([0.0, 0.0, 0.2]), f32([0.0, 0.0]), FaultParams(delay=0.3)
    pending = jnp.zeros((5, 2), jnp.float32)
    state, near, info = init(SPEC, PARAMS, pose), [], None
    for k in range(200):
        state, command, info = step(SPEC, PARAMS, state, look(pose, twist, seed=k), KEY, replan=k % 5 == 0)
        pending, reached = kinematic.delayed(pending, command, SPEC.dt, late)
        pose, twist = kinematic.step(ROBOT, pose, twist, reached, SPEC.dt)
        near.append(float(clearance(WORLD, pose[:2])))
        if bool(info.arrived):
            break
    assert info is not None and bool(info.arrived) and len(near) < 95
    assert int(state.latency.ticks) == 3 and min(near) > ROBOT.radius + 0.15


def test_one_trace_for_a_sweep(trip):
    """Over risk weight, decay, horizon and key: `step` above allows one trace with and one without replanning."""
    state, seen, *_ = trip[15]
    scores = {True: set(), False: set()}
    for k in range(4):
        score = PARAMS.score._replace(risk_weight=1.0 * k, decay=0.1 * k, horizon=4.0 - k)
        for replan in (True, False):
            _, _, info = step(SPEC, PARAMS._replace(score=score), state, seen, jax.random.key(k), replan=replan)
            scores[replan].add(float(info.local_goal.score))
    assert [len(found) for found in scores.values()] == [4, 4]


def without_ties(stepped):
    """The step's results; where two prefixes of a candidate are equally good, rounding says which is shown."""
    state, command, info = stepped
    best = info.local_goal.best
    best = best._replace(progress=best.progress + best.range_bias, range_bias=best.range_bias * 0)
    return state, command, info._replace(local_goal=info.local_goal._replace(best=best))


def compare_batch(record, replan):
    """One vmapped call over recorded states against single calls."""
    states, seen = (jax.tree.map(lambda *a: jnp.stack(a), *[r[k] for r in record]) for k in (0, 1))
    keys = jax.random.split(KEY, len(record))
    batched = jax.jit(jax.vmap(lambda s, o, k: navigator.step(SPEC, PARAMS, s, o, k, replan=replan)))
    many = batched(states, seen, keys)
    one = [step(SPEC, PARAMS, r[0], r[1], KEY, replan=replan) for r in record]
    one = jax.tree.map(lambda *a: jnp.stack(a), *one)
    chex.assert_trees_all_close(many[1], one[1], atol=SAME)  # commands
    for a, b in zip(jax.tree.leaves(without_ties(many)), jax.tree.leaves(without_ties(one)), strict=True):
        if a.dtype in (jnp.bool_, jnp.int32):
            assert float(jnp.mean((a == b).astype(jnp.float32))) > 0.999
        else:
            np.testing.assert_allclose(a, b, atol=SAME, rtol=SAME)


@pytest.mark.parametrize("replan", [pytest.param(True, marks=pytest.mark.long), False])
def test_a_batch_equals_single_calls(trip, replan):
    compare_batch(trip[::8][:16], replan)


@pytest.mark.slow
@pytest.mark.parametrize("replan", [True, False])
def test_a_batch_of_128_equals_single_calls(trip, replan):
    compare_batch(trip[:128], replan)


FOLLOWER = FollowerSpec(
    dwb=DwbSpec(num_speeds=8, num_turns=10, max_steps=60),
    mppi=MppiSpec(num_samples=300, num_steps=24, dt=0.1, immediate=True),
)


@pytest.mark.long
@pytest.mark.parametrize("planner", ["nav2-mppi", pytest.param("nav2-dwb", marks=pytest.mark.slow)])
def test_followers_of_a_route_drive_around_the_wall(planner):
    spec = dataclasses.replace(SPEC, planner=PLANNERS[planner], follower=FOLLOWER)
    drive = jax.jit(navigator.step.__wrapped__, static_argnames=("spec", "replan"))
    pose, twist = f32([0.0, 0.0, 0.2]), f32([0.0, 0.0])
    state, path = navigator.init(spec, PARAMS, pose), []
    for k in range(160):
        seen = look(pose, twist, seed=k)
        state, command, info = drive(spec, PARAMS, state, seen, jax.random.key(k), replan=k % 5 == 0)
        assert within_limits(command, np.asarray(twist))
        assert float(jnp.sum(info.track.critics.best)) < np.inf
        pose, twist = kinematic.step(ROBOT, pose, twist, command, spec.dt)
        path.append(np.asarray(pose))
        if bool(info.arrived):
            break
    path = np.array(path)
    assert bool(info.arrived) and path[:, 1].max() > 1.7
    assert min(float(clearance(WORLD, f32(p[:2]))) for p in path) > ROBOT.radius


@pytest.mark.long
@pytest.mark.parametrize("planner", ["mppi", "nav2-dwb"])
def test_broken_sensors_give_followers_no_broken_command_either(trip, planner):
    spec = dataclasses.replace(SPEC, planner=PLANNERS[planner], follower=FOLLOWER)
    drive = jax.jit(navigator.step.__wrapped__, static_argnames=("spec", "replan"))
    seen = trip[23][1]
    for what in FAULTS:
        state = navigator.init(spec, PARAMS, seen.pose)
        for k, o in enumerate([seen, seen, *[broken(what, seen)] * 3, seen]):
            state, command, info = drive(spec, PARAMS, state, o, jax.random.key(k), replan=k % 5 == 0)
            assert bool(jnp.isfinite(command.v)) and bool(jnp.isfinite(command.omega)), what
            assert -0.2 - 1e-6 <= float(command.v) <= 1.0 + 1e-6 and abs(float(command.omega)) <= 1.5 + 1e-6
        finite = jax.tree.map(lambda a: bool(jnp.all(jnp.isfinite(a))), state._replace(points=state.points.xy))
        assert all(jax.tree.leaves(finite)), what


@pytest.mark.parametrize("planner", PLANNERS)
def test_every_planner_fits_together(planner):
    spec = dataclasses.replace(SPEC, planner=PLANNERS[planner])
    state = jax.eval_shape(lambda: navigator.init(spec, PARAMS, f32([0, 0, 0])))
    seen = empty_observation(0)  # an empty cloud
    for replan in (True, False):
        after, command, info = jax.eval_shape(
            lambda s, replan=replan: navigator.step(spec, PARAMS, s, seen, KEY, replan=replan), state
        )
        chex.assert_trees_all_equal_shapes_and_dtypes(after, state)
        assert command.v.shape == command.omega.shape == () == info.mode.shape
        names, why = follower.critics(spec.follower, spec.planner), info.track.critics
        assert why.chosen.shape == (len(names),) and why.best.shape == (10, len(names))
        assert info.local_goal.best_score.shape == info.local_goal.best.progress.shape == (10,)
    assert spec.candidates.num_candidates == (34 if not spec.planner.controls else 55)
    assert dataclasses.replace(spec, planner=PLANNERS["drnav"]) == dataclasses.replace(SPEC, planner=PLANNERS["drnav"])


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"dt": 0.0}, "dt must be > 0 s"),
        ({"replan_every": 0}, "replan_every >= 1"),
        ({"dt": 0.05}, "tracker.dt must be the tick, 0.05 s, got 0.1"),
        ({"planner": PLANNERS["mppi"], "dt": 0.05}, "MPPI's step must be the tick, 0.05 s: follower.mppi.dt is 0.1"),
        ({"recovery_points": RecoverySpec()}, "recovery_points.grid must be the window"),
        ({"filter": FilterSpec(grid=GRID, local_cells=40)}, "leave 1.6 m around the robot, 2 m are needed"),
        ({"memory": MemorySpec(cells=256, pooling=1)}, "memory pooling 1 must be a multiple of the route's, 2"),
    ],
)
def test_the_spec_is_checked(wrong, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(SPEC, **wrong)
