"""DWB against plain loops: twists, trajectories, every critic, latches, and the choice."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_nav2 as reference

from drnav_jax.planning import dwb, dwb_critics
from drnav_jax.planning.dwb import DwbSpec, Sampling
from drnav_jax.planning.dwb_critics import CRITICS, DwbParams, Trajectories
from drnav_jax.planning.path import Path
from drnav_jax.types import GridMap, RobotParams

CLOSE = 1e-5  # relative: float32 sums of a hundred steps
STOCK = RobotParams(v_min=0.0, v_max=0.26, w_max=1.0, a_max=2.5, alpha_max=3.2)
SAMPLING, PARAMS = Sampling(), DwbParams()
SHAPE, RESOLUTION, ORIGIN = (44, 60), 0.05, (-1.3, -1.1)
POINTS = 48

# one for each of the specs and shapes here
plan = jax.jit(chex.assert_max_traces(dwb.plan.__wrapped__, n=4), static_argnames="spec")
# as inside `plan`: one program, not one for each operation
twists, rollout = (jax.jit(f, static_argnums=0) for f in (dwb.twists, dwb.rollout))
judge, remember = jax.jit(dwb_critics.judge), jax.jit(dwb_critics.remember)


def f32(values):
    return jnp.asarray(values, jnp.float32)


def axes(robot):
    """Limits of x, y and theta as the oracle takes them."""
    return (
        (robot.v_min, robot.v_max, robot.a_max, -robot.a_max), (0.0, 0.0, 2.5, -2.5),
        (-robot.w_max, robot.w_max, robot.alpha_max, -robot.alpha_max),
    )  # fmt: skip


def sampled(twist, robot=STOCK, nums=(20, 20)):
    v, w, used = twists(DwbSpec(*nums), SAMPLING, robot, f32(twist))
    return np.stack([v, w], axis=1)[np.asarray(used)]


def test_419_twists_from_rest_with_the_stock_settings():
    assert len(sampled([0.0, 0.0])) == 419
    assert len(reference.twists((0, 0, 0), axes(STOCK), 1.7, (20, 5, 20))) == 419


@pytest.mark.parametrize("robot", [STOCK, RobotParams(), RobotParams(a_max=0.1, alpha_max=0.2)])
@pytest.mark.parametrize("twist", [(0.0, 0.0), (0.2, -0.3), (0.26, 1.0), (-0.3, 2.0), (0.02, 0.01)])
@pytest.mark.parametrize("nums", [(20, 20), (5, 7)])
def test_twists_are_those_of_the_loops(robot, twist, nums):
    want = reference.twists((twist[0], 0.0, twist[1]), axes(robot), 1.7, (nums[0], 5, nums[1]))
    got = sampled(twist, robot, nums)
    assert len(got) == len(want)
    np.testing.assert_allclose(got, np.array(want)[:, [0, 2]], atol=1e-6)
    assert (np.abs(got).max(axis=1) > 0).all()
    assert (got[:, 1] == 0).any() == (np.ptp(np.sign(got[:, 1])) == 2), "an exact 0 where omega steps over it"


def make_map(rng, density):
    values = rng.integers(0, 253, SHAPE).astype(float)
    special = rng.random(SHAPE) < density
    values[special] = rng.choice([253, 254, 255], special.sum())
    return values


def make_path(rng, reach):
    """From near the robot; it may leave the map and come back."""
    n = int(rng.integers(2, POINTS))
    heading = rng.uniform(-3, 3) + np.cumsum(rng.normal(0, 0.2, n))
    x, y = (np.float32(np.cumsum(reach * f(heading)) * RESOLUTION) for f in (np.cos, np.sin))
    pad = lambda a: f32(np.concatenate([a, np.full(POINTS - n, a[-1])]))  # noqa: E731
    return Path(pad(x), pad(y), jnp.asarray(n, jnp.int32)), [(float(a), float(b)) for a, b in zip(x, y, strict=True)]


def inner(values):
    """The same numbers, moved off the borders between cells."""
    values = np.array(values, np.float64)
    for axis in (0, 1):
        cells = (values[:, axis] - ORIGIN[axis]) / RESOLUTION
        values[:, axis] += np.where(np.abs(cells - np.round(cells)) < 1e-2, 0.02 * RESOLUTION, 0.0)
    return np.float32(values)


def describe(costmap, paths, v, w):
    """What the critics get, from poses in plain numbers."""
    ends = np.array([poses[-1] for poses in paths])
    return Trajectories(
        v=f32(v), w=f32(w), x=f32(ends[:, 0]), y=f32(ends[:, 1]), c=f32(np.cos(ends[:, 2])), s=f32(np.sin(ends[:, 2])),
        cost=f32([costmap.cost(*e[:2]) for e in ends]),
        on_grid=jnp.asarray([all(costmap.cell(x, y) for x, y, _ in poses) for poses in paths]),
        blocked=jnp.asarray([any(costmap.cost(x, y) >= 253 for x, y, _ in poses) for poses in paths]),
    )  # fmt: skip


def nose_is_safe(pose, ahead):
    """Whether the point ahead, in float32 or not, lies in the same cell."""
    point = np.array([pose[0] + ahead * np.cos(pose[2]), pose[1] + ahead * np.sin(pose[2])])
    cells = (point - ORIGIN) / RESOLUTION
    return (np.abs(cells - np.round(cells)) > 1e-3).all()


@pytest.mark.parametrize("seed", range(10))
def test_every_critic_is_that_of_the_loops(seed):
    rng = np.random.default_rng(seed)
    values = make_map(rng, (0.0, 0.002, 0.02)[seed % 3])
    costmap = reference.Map(values, np.float32(ORIGIN), float(np.float32(RESOLUTION)))
    path, points = make_path(rng, 1.0 + 2.0 * (seed % 2))
    pose, twist = np.float32([0.03, 0.01, 0.4]), np.float32([0.2, 0.1])
    goal = np.float32([*points[-1], rng.uniform(-3, 3)])
    if seed == 3:
        goal[:2] = pose[:2] + 0.04  # the Align critics' special case
    speeds = np.float32(rng.choice([0.0, 0.05, 0.15, -0.1], 40)), np.float32(rng.uniform(-1, 1, 40))
    paths = [inner(np.cumsum(rng.normal(0, 0.12, (6, 3)), axis=0)) for _ in range(40)]
    paths = [p for p in paths if nose_is_safe(p[-1], PARAMS.forward_point)]
    v, w = (a[: len(paths)] for a in speeds)
    flags = rng.random(2) < 0.5, rng.random((2, 2)) < 0.4
    state = dwb_critics.init()._replace(
        in_window=jnp.asarray(flags[0][0]), rotating=jnp.asarray(flags[0].all()),
        positive_only=jnp.asarray(flags[1][:, 0]), negative_only=jnp.asarray(flags[1][:, 1]),
    )  # fmt: skip
    grid = GridMap(f32(values), f32(ORIGIN), f32(RESOLUTION))
    got = judge(PARAMS, state, grid, path, f32(pose), f32(twist), f32(goal), describe(costmap, paths, v, w))
    got = jax.device_get(got)
    for k, poses in enumerate(paths):
        want = reference.dwb_scores(
            PARAMS, (flags[0][0], flags[0].all()), [tuple(f) for f in flags[1]], costmap, points, pose, twist, goal,
            v[k], w[k], [tuple(map(float, p)) for p in poses],
        )  # fmt: skip
        for c, name in enumerate(CRITICS):
            scale, raw = want[name]
            assert float(got.scale[c]) == pytest.approx(scale, rel=CLOSE)
            if scale == 0:
                continue
            assert bool(got.legal[c, k]) == (raw is not None), (name, k)
            if raw is not None:
                assert float(got.raw[c, k]) == pytest.approx(raw, rel=CLOSE, abs=CLOSE), (name, k)


def free_map(rng):
    """A few obstacles away from the robot, smooth costs elsewhere."""
    values = np.floor(rng.uniform(0, 200, SHAPE))
    for _ in range(5):
        i, j = rng.integers(0, SHAPE[0]), rng.integers(0, SHAPE[1])
        values[i : i + 4, j : j + 4] = 254
    values[16:28, 20:32] = 10
    return values


@pytest.mark.parametrize("robot", [STOCK, RobotParams()])
@pytest.mark.parametrize("seed", range(3))
def test_trajectories_and_the_choice_are_those_of_the_loops(robot, seed):
    rng = np.random.default_rng(seed)
    spec = DwbSpec(num_speeds=6, num_turns=6)
    values = free_map(rng)
    costmap = reference.Map(values, np.float32(ORIGIN), float(np.float32(RESOLUTION)))
    grid = GridMap(f32(values), f32(ORIGIN), f32(RESOLUTION))
    path, points = make_path(rng, 0.9)
    pose, twist = np.float32([0.013, 0.017, rng.uniform(-3, 3)]), np.float32([0.1, 0.2])
    goal = np.float32([*points[-1], 1.0])
    v, w, used = twists(spec, SAMPLING, robot, f32(twist))
    rolled = jax.device_get(rollout(spec, SAMPLING, robot, grid, f32(pose), f32(twist), v, w))
    v, w = np.asarray(v), np.asarray(w)
    scores, index, sure = [], [], True
    for k in np.flatnonzero(used):
        a, b = float(v[k]), float(w[k])
        poses, exact = reference.trajectory(pose, twist, a, b, robot, 1.7, 0.05, 0.025)
        assert abs(exact - round(exact)) > 1e-3 or abs(exact - round(exact)) < 1e-5, "which N is meant is unclear"
        end = np.array(poses[-1])
        np.testing.assert_allclose([rolled.x[k], rolled.y[k]], end[:2], rtol=CLOSE, atol=2e-6)
        np.testing.assert_allclose([rolled.c[k], rolled.s[k]], [np.cos(end[2]), np.sin(end[2])], atol=CLOSE)
        at = (np.array([p[:2] for p in poses]) - ORIGIN) / RESOLUTION
        sure &= bool((np.abs(at - np.round(at)) > 1e-4).all())
        scores.append(
            reference.dwb_scores(
                PARAMS, (False, False), ((False, False),) * 2, costmap, points, pose, twist, goal, a, b, poses
            )
        )
        index.append(k)
    best, total = reference.dwb_best(scores)
    state = dwb_critics.init()
    _, command, info = plan(spec, SAMPLING, PARAMS, robot, grid, path, state, f32(pose), f32(twist), f32(goal))
    legal = sum(all(raw is not None for scale, raw in s.values() if scale) for s in scores)
    if sure:
        assert int(info.num_legal) == legal
        assert bool(info.failed) == (best is None)
    if best is not None and sure:
        assert float(info.cost) == pytest.approx(total, rel=CLOSE)
        assert int(info.best_index[0]) == index[best]
        assert [float(command.v), float(command.omega)] == [float(v[index[best]]), float(w[index[best]])]
        parts = [scale * raw for scale, raw in scores[best].values()]
        np.testing.assert_allclose(info.chosen, parts, rtol=CLOSE, atol=CLOSE)
        np.testing.assert_allclose(info.best[0], info.chosen)
        assert float(jnp.sum(info.chosen)) == pytest.approx(total, rel=CLOSE)


def test_the_first_of_equals_wins_and_nothing_legal_fails():
    grid = GridMap(jnp.zeros(SHAPE), f32(ORIGIN), f32(RESOLUTION))
    path = Path(f32([1.0] * 4), f32([0.0] * 4), jnp.asarray(1, jnp.int32))
    pose, twist, goal = f32([0.0, 0.0, 0.0]), f32([0.0, 0.0]), f32([1.0, 0.0, 0.0])
    equal = DwbParams(*[0.0] * 7)  # no critic is asked: all twists are equal
    state = dwb_critics.init()
    _, command, info = plan(DwbSpec(), SAMPLING, equal, STOCK, grid, path, state, pose, twist, goal)
    assert int(info.best_index[0]) == 0 and [float(command.v), float(command.omega)] == [0.0, -1.0]
    walled = grid._replace(values=jnp.full(SHAPE, 254.0))
    _, command, info = plan(DwbSpec(), SAMPLING, PARAMS, STOCK, walled, path, state, pose, twist, goal)
    assert bool(info.failed) and float(command.v) == float(command.omega) == 0.0 and int(info.num_legal) == 0
    assert int(info.illegal[CRITICS.index("BaseObstacle")]) == 419
    nowhere = path._replace(x=path.x + 100.0)
    _, _, info = plan(DwbSpec(), SAMPLING, PARAMS, STOCK, grid, nowhere, state, pose, twist, goal)
    assert bool(info.failed) and int(info.illegal[CRITICS.index("PathDist")]) == 419


def test_trends_are_those_of_the_loops():
    rng = np.random.default_rng(0)
    state, oracle, seen = dwb_critics.init(), reference.Oscillation(PARAMS), set()
    pose = np.zeros(3, np.float32)
    for _ in range(300):
        sent = np.float32(rng.choice([-0.1, 0.0, 0.02, 0.2], 1)[0]), np.float32(rng.choice([-0.5, 0.0, 0.5]))
        pose = np.float32(pose + rng.choice([0.0, 0.01, 0.03]) * rng.choice([-1, 1], 3))
        state = remember(PARAMS, state, f32(pose), f32(sent))
        oracle.debrief(pose, *sent)
        got = tuple(zip(np.asarray(state.positive_only).tolist(), np.asarray(state.negative_only).tolist(), strict=True))
        assert got == oracle.trends()
        seen.add(got)
    assert len(seen) >= 4


def test_the_goal_window_and_the_rotation_latch():
    state = dwb_critics.init()
    goal, far, near = f32([1.0, 0.0, 0.0]), f32([0.7, 0.0, 0.0]), f32([0.8, 0.0, 0.0])
    fast, slow = f32([0.26, 0.0]), f32([0.2, 0.0])
    steps = [(far, slow, (0, 0)), (near, fast, (1, 0)), (far, fast, (1, 0)), (far, slow, (1, 1)), (far, fast, (1, 1))]
    for pose, twist, want in steps:
        state = dwb_critics.enter(PARAMS, state, pose, twist, goal)
        assert (int(state.in_window), int(state.rotating)) == want


def test_it_drives_a_clear_path_and_turns_at_the_goal():
    grid = GridMap(jnp.zeros((80, 120)), f32([-2.0, -2.0]), f32(0.05))
    x = np.linspace(0, 2, 41)
    path = Path(f32(x), f32(np.zeros(41)), jnp.asarray(41, jnp.int32))
    state, pose, twist = dwb_critics.init(), np.array([0.0, 0.1, 0.5]), np.zeros(2)
    spec = DwbSpec(num_speeds=20, num_turns=20)
    for _ in range(140):
        state, command, info = plan(
            spec, SAMPLING, PARAMS, STOCK, grid, path, state, f32(pose), f32(twist), f32([2.0, 0.0, 1.5])
        )
        assert not bool(info.failed)
        twist = np.array([float(command.v), float(command.omega)])
        pose = pose + 0.1 * np.array([twist[0] * np.cos(pose[2]), twist[0] * np.sin(pose[2]), twist[1]])
    assert np.hypot(pose[0] - 2.0, pose[1]) < 0.3 and abs(pose[2] - 1.5) < 0.2 and bool(state.rotating)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"num_speeds": 1}, "must be >= 2"), ({"max_steps": 0}, "max_steps >= 1"), ({"num_explained": 0}, "within 1..")],
)
def test_the_spec_is_checked(wrong, message):
    with pytest.raises(ValueError, match=message):
        DwbSpec(**wrong)
