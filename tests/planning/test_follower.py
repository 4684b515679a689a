"""Path, costmap, controller and limits together, for DWB and for MPPI."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reference
from drnav_jax import grids
from drnav_jax.planning import PLANNERS, follower, nav2_recovery, route
from drnav_jax.planning import path as paths
from drnav_jax.planning.dwb import DwbSpec
from drnav_jax.planning.follower import FollowerParams, FollowerSpec
from drnav_jax.planning.mppi import MppiSpec
from drnav_jax.planning.route import RouteSpec
from drnav_jax.types import RobotParams

SPEC = FollowerSpec(
    dwb=DwbSpec(num_speeds=8, num_turns=10, max_steps=40),
    mppi=MppiSpec(num_samples=400, num_steps=24, dt=0.1, immediate=True),
    num_points=80,
)
PARAMS, ROBOT = FollowerParams(), RobotParams()
DT = 0.1
SHAPE, RESOLUTION, ORIGIN = (64, 96), 0.1, np.array([-2.0, -3.2], np.float32)
GOAL = np.array([6.0, 0.5], np.float32)
FOLLOWERS = [name for name in PLANNERS if PLANNERS[name].follows]


def f32(values):
    return jnp.asarray(values, jnp.float32)


@pytest.fixture(scope="module")
def wall(clearance_of):
    """A wall across the straight way, open above y = 1.4."""
    occupied = np.zeros(SHAPE, bool)
    occupied[:46, 40:43] = True
    return occupied, clearance_of(occupied, ORIGIN, RESOLUTION)


@pytest.fixture(scope="module")
def way(wall):
    """The cost-to-go around it."""
    nothing = jnp.zeros(SHAPE)
    beyond = jnp.full((SHAPE[0] // 2, SHAPE[1] // 2), jnp.float32(grids.UNREACHABLE))
    return route.solve(
        RouteSpec(), PARAMS.route, wall[1].values, nothing, nothing, f32(ORIGIN), RESOLUTION, f32([0, 0]), f32(GOAL),
        ROBOT, jnp.asarray(False), beyond,
    )  # fmt: skip


def replan(name, state, found, xy=(0.0, 0.0), time=0.0):
    args = f32(ORIGIN), 2 * RESOLUTION, f32(xy), f32(GOAL), f32(time)
    return follower.replan(SPEC, PLANNERS[name], state, found, *args)


def points(path):
    return np.stack([path.x, path.y], axis=1)[: int(path.count)].astype(float)


def test_the_path_goes_down_the_cost_to_go_around_the_wall(wall, way):
    path = paths.down(
        way, f32(ORIGIN), 0.2, f32([0, 0]), f32(GOAL), num_moves=60, spacing=0.05, num_points=256, smoothing=4
    )
    got = points(path)
    np.testing.assert_allclose(got[0], [0, 0], atol=1e-6)
    np.testing.assert_allclose(got[-1], GOAL, atol=1e-5)
    cells = np.floor((got - ORIGIN) / RESOLUTION).astype(int)
    assert np.asarray(wall[1].values)[cells[:, 1], cells[:, 0]].min() > ROBOT.radius
    # as long as its cost: at most what a 16-connected way is longer than the true one, and less at smoothed corners
    length = np.hypot(*np.diff(got, axis=0).T).sum()
    coarse = np.asarray(way.coarse)
    free = np.where(np.asarray(way.cost) < grids.UNREACHABLE, 1.0, grids.UNREACHABLE)
    x, y = (ORIGIN[a] + (np.arange(n) + 0.5) * 0.2 for a, n in ((0, coarse.shape[1]), (1, coarse.shape[0])))
    away = np.hypot(x[None] - GOAL[0], y[:, None] - GOAL[1])
    initial = np.where(away <= 0.3, away, grids.UNREACHABLE)
    shortest = reference.dijkstra(free, initial, 0.2, np.asarray(way.east), np.asarray(way.north))
    start = shortest[int((0 - ORIGIN[1]) / 0.2), int((0 - ORIGIN[0]) / 0.2)]
    assert 0.9 * start < length < 1.15 * start


def test_paths_are_made_anew_when_it_is_time_and_kept_where_there_is_none(way):
    state = follower.init(SPEC, PLANNERS["nav2-dwb"], PARAMS, f32([0, 0, 0]))
    state = state._replace(dwb=state.dwb._replace(in_window=jnp.asarray(True)))
    first = replan("nav2-dwb", state, way)
    assert int(first.path.count) > 40 and bool(first.has_path) and not bool(first.dwb.in_window)
    latched = first._replace(dwb=first.dwb._replace(in_window=jnp.asarray(True)))
    early = replan("nav2-dwb", latched, way, xy=(0.5, 0.0), time=0.5)
    np.testing.assert_array_equal(early.path.x, first.path.x)
    assert bool(early.dwb.in_window)
    late = replan("nav2-dwb", latched, way, xy=(0.5, 0.0), time=1.0)
    assert float(late.path.x[0]) == 0.5
    lost = replan("nav2-dwb", latched, way._replace(reachable=jnp.asarray(False)), xy=(0.5, 0.0), time=1.0)
    np.testing.assert_array_equal(lost.path.x, first.path.x)
    assert not bool(lost.has_path)
    straight = replan("dwb", follower.init(SPEC, PLANNERS["dwb"], PARAMS, f32([0, 0, 0])), None)
    along = np.cross(np.append(GOAL, 0.0), np.pad(points(straight.path), ((0, 0), (0, 1))))[:, 2]
    np.testing.assert_allclose(along, 0, atol=1e-4)


def test_the_costmap_is_nav2s_inflation_of_the_padded_disc(wall):
    got = np.asarray(follower.costs_of(PARAMS, ROBOT, wall[1]).values)
    clear = np.asarray(wall[1].values)
    inscribed = np.float32(ROBOT.radius + PARAMS.padding)
    for d, cost in zip(clear.ravel()[::37], got.ravel()[::37], strict=True):
        assert cost in {reference.inflation(float(d) + e, inscribed, 3.0, np.float32(0.7)) for e in (-1e-6, 0, 1e-6)}
    assert got.max() == 254 and got.min() == 0


def acting(name, state, clear, pose, twist, key):
    planner = PLANNERS[name]
    step = jax.jit(
        lambda state, pose, twist, key: follower.act(
            SPEC, planner, PARAMS, ROBOT, state, clear, jnp.zeros(clear.values.shape), pose, twist, f32(GOAL), DT, key
        )
    )
    return step(state, pose, twist, key) if pose is not None else step


@pytest.mark.parametrize("name", ["nav2-dwb", "nav2-mppi"])
def test_they_drive_around_the_wall_within_the_limits(wall, way, name):
    clear = wall[1]
    state = replan(name, follower.init(SPEC, PLANNERS[name], PARAMS, f32([0, 0, 0])), way)
    step = acting(name, state, clear, None, None, None)
    pose, twist, places, sums = np.zeros(3), np.zeros(2), [], []
    for k in range(110):
        if k % 10 == 0:
            state = replan(name, state, way, xy=pose[:2], time=k * DT)
        state, track = step(state, f32(pose), f32(twist), jax.random.key(k))
        why = track.critics
        command = np.array([track.command.v, track.command.omega], float)
        tiny = 1e-5
        assert np.isfinite(command).all()
        assert ROBOT.v_min - tiny <= command[0] <= ROBOT.v_max + tiny and abs(command[1]) <= ROBOT.w_max + tiny
        assert abs(command[0] - twist[0]) <= ROBOT.a_max * DT + tiny
        assert abs(command[1] - twist[1]) <= ROBOT.alpha_max * DT + tiny
        assert bool(track.certified)
        twist = command
        pose = pose + DT * np.array([twist[0] * np.cos(pose[2]), twist[0] * np.sin(pose[2]), twist[1]])
        places.append(pose.copy())
        sums.append(float(jnp.sum(why.best[0])))
        if np.hypot(*(pose[:2] - GOAL)) < 0.75:
            break
    else:
        raise AssertionError(f"it never arrived: {pose}")
    places = np.array(places)
    cells = np.floor((places[:, :2] - ORIGIN) / RESOLUTION).astype(int)
    assert np.asarray(clear.values)[cells[:, 1], cells[:, 0]].min() > ROBOT.radius
    assert np.isfinite(sums).all() and len(why.chosen) == len(follower.critics(SPEC, PLANNERS[name])) == why.best.shape[1]


@pytest.mark.parametrize("name", ["dwb", "mppi", "drnav-mppi"])
def test_whatever_they_are_told_the_command_is_sane(wall, name):
    planner = PLANNERS[name]
    rng = np.random.default_rng(0)
    state = follower.init(SPEC, planner, PARAMS, f32([0, 0, 0]))
    step = acting(name, state, wall[1], None, None, None)
    failed = 0
    for k in range(30):
        pose = f32([*rng.uniform(-4, 9, 2), rng.uniform(-3, 3)])
        twist = rng.uniform((-0.2, -1.5), (1.0, 1.5))
        found = replan(name, state, None, xy=rng.uniform(-4, 9, 2), time=2.0 * k) if planner.path == "straight" else state
        state, track = step(found, pose, f32(twist), jax.random.key(k))
        v, w = float(track.command.v), float(track.command.omega)
        assert np.isfinite([v, w]).all() and -0.2 - 1e-6 <= v <= 1.0 + 1e-6 and abs(w) <= 1.5 + 1e-6
        assert abs(v - twist[0]) <= ROBOT.a_max * DT + 1e-5 and abs(w - twist[1]) <= ROBOT.alpha_max * DT + 1e-5
        finite = jax.tree.map(lambda a: bool(jnp.all(jnp.isfinite(a))), state)
        assert all(jax.tree.leaves(finite))
        if not bool(track.certified):
            failed += 1
            assert abs(v) < abs(twist[0]) + 1e-6, "it brakes"
    assert failed > 0, "off the map, or in the wall, there is no command"


def test_recovery_takes_over_and_starts_the_controller_anew(wall, way):
    planner = PLANNERS["nav2-mppi"]
    state = replan("nav2-mppi", follower.init(SPEC, planner, PARAMS, f32([0, 0, 0])), way)
    state = state._replace(mppi=state.mppi._replace(control=jnp.ones_like(state.mppi.control)))
    pose, twist = f32([0, 0, 0]), f32([0, 0])
    step = acting("nav2-mppi", state, wall[1], None, None, None)
    _, track = step(state, pose, twist, jax.random.key(0))
    args = wall[1], track, pose, twist, f32(1.0), jnp.asarray(False), DT
    quiet, same, wipe = follower.recover(PARAMS, ROBOT, state, *args)
    assert float(same.command.v) == float(track.command.v) and not bool(wipe)
    assert float(quiet.mppi.control.max()) == 1.0
    spin = state._replace(recovery=state.recovery._replace(mode=jnp.int32(nav2_recovery.SPIN)))
    after, turned, _ = follower.recover(PARAMS, ROBOT, spin, *args)
    assert float(turned.command.v) == 0.0
    assert float(turned.command.omega) == pytest.approx(ROBOT.alpha_max * DT), "as fast as it may speed up"
    assert float(jnp.abs(after.mppi.control).max()) == 0.0


def test_planners_that_do_not_follow_carry_nothing():
    for name, planner in PLANNERS.items():
        state = follower.init(SPEC, planner, PARAMS, f32([0, 0, 0]))
        assert (state is None) == (name not in FOLLOWERS)
    borrowed = dataclasses.replace(PLANNERS["grid"], recovery="nav2")
    state = follower.init(SPEC, borrowed, PARAMS, f32([0, 0, 0]))
    assert state is not None and state.recovery is not None and state.mppi is None and state.dwb is None


def test_the_spec_is_checked():
    for wrong in ({"num_points": 1}, {"spacing": 0.0}, {"smoothing": -1}):
        with pytest.raises(ValueError, match="must be >= 2, spacing > 0"):
            FollowerSpec(**wrong)
