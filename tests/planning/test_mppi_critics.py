"""Every critic against plain loops, on random maps, paths and trajectories."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_nav2 as reference

from drnav_jax.planning import mppi_critics, mppi_path_critics, mppi_rollout
from drnav_jax.planning.costmap import InflationParams
from drnav_jax.planning.dynamics import Motion
from drnav_jax.planning.mppi_critic_params import CRITICS, AlignParams, CriticParams, CriticSpec
from drnav_jax.planning.mppi_rollout import Limits
from drnav_jax.planning.path import Path
from drnav_jax.types import GridMap

# float32 sums of some fifty terms, against double precision
CLOSE = 1e-5
SHAPE, RESOLUTION, ORIGIN = (40, 56), 0.05, (-1.123, -0.917)
STEPS, SAMPLES, DT = 23, 17, 0.05  # no multiple of the strides
POINTS = 64
LIMITS = Limits(v_min=-0.35, v_max=0.5, w_max=1.9, a_max=3.0, a_min=-2.3, alpha_max=3.5)
INFLATION = InflationParams()
# PathAlign is off where trajectories reach less than 20 points: they are shorter than that here
EAGER = CriticParams(align=AlignParams(furthest=3))


def f32(values):
    return jnp.asarray(values, jnp.float32)


def make_map(rng, density):
    """Costs of all kinds, with holes of collision."""
    values = rng.integers(1, 253, SHAPE).astype(float)
    values[rng.random(SHAPE) < 0.3] = 0
    special = rng.random(SHAPE) < density
    values[special] = rng.choice([253, 254, 255], special.sum())
    return values


def make_path(rng, length):
    """A wandering path of uneven spacing, some of it off the map when it is long."""
    n = int(rng.integers(2, POINTS)) if length is None else length
    step = rng.uniform(0.02, 0.08, n)
    heading = rng.uniform(-3, 3) + np.cumsum(rng.normal(0, 0.15, n))
    x, y = np.cumsum(step * np.cos(heading)), np.cumsum(step * np.sin(heading))
    x, y = (np.float32(a - a[0]) for a in (x, y))
    pad = lambda a: f32(np.concatenate([a, np.full(POINTS - n, a[-1])]))  # noqa: E731
    points = [(float(a), float(b)) for a, b in zip(x, y, strict=True)]
    return Path(pad(x), pad(y), jnp.asarray(n, jnp.int32)), points


def make_runs(rng, reach):
    """Random trajectories, none of whose points lies on the border of two cells."""
    runs = []
    for _ in range(SAMPLES):
        v = rng.uniform(-0.5, 0.8) * reach + rng.normal(0, 0.2, STEPS)
        w = rng.normal(0, 1.5) + rng.normal(0, 0.5, STEPS)
        yaw = np.float32(rng.uniform(-3, 3) + np.cumsum(w) * DT)
        x, y = (np.cumsum(v * f(yaw)) * DT for f in (np.cos, np.sin))
        place = []
        for a, low in ((x, ORIGIN[0]), (y, ORIGIN[1])):
            cells = (a - low) / RESOLUTION
            edge = np.abs(cells - np.round(cells)) < 1e-3
            place.append(np.float32(a + np.where(edge, 3e-3 * RESOLUTION, 0)))
        runs.append((*place, yaw, np.float32(v), np.float32(w)))
    return runs


look = jax.jit(mppi_critics.look, static_argnums=0)


@functools.cache
def pricing(spec):
    """The functions that roll-outs call, each compiled once for all comparisons."""
    cost = mppi_critics.nav2(spec, STEPS, DT)
    names = [name for name in ("begin", "step", "finish", "seldom") if getattr(cost, name) is not None]
    return dataclasses.replace(cost, **{name: jax.jit(getattr(cost, name)) for name in names})


def price(spec, scene, runs):
    """Costs of given trajectories through the functions that roll-outs call."""
    x, y, yaw, v, w = (f32(np.stack(a, axis=1)) for a in zip(*runs, strict=True))
    motion = [Motion(x=x[t], y=y[t], c=jnp.cos(yaw[t]), s=jnp.sin(yaw[t]), v=v[t], w=w[t]) for t in range(STEPS)]
    cost = pricing(spec)
    carry = cost.begin(scene, motion[0])
    for t in range(1, STEPS):
        carry = cost.step(scene, carry, motion[t], jnp.asarray(t))
        if cost.seldom is not None and t % cost.period == 0:
            carry = cost.seldom(scene, carry, motion[t])
    return cost.finish(scene, carry, motion[-1])


def compare(seed, spec=None, params=None, density=0.01, length=None, reach=1.0, tolerance=0.25):
    """Draw everything, price it both ways, compare all critics; returns the oracle's."""
    spec = CriticSpec(critics=CRITICS) if spec is None else spec
    params = EAGER if params is None else params
    rng = np.random.default_rng(seed)
    values, risk = make_map(rng, density), np.round(rng.random(SHAPE) * 65535) / 65535
    path, points = make_path(rng, length)
    runs = make_runs(rng, reach)
    pose = np.float32([0.02, -0.01, rng.uniform(-3, 3)])
    goal_yaw = float(np.float32(rng.uniform(-3, 3)))
    words = GridMap(mppi_critics.pack(f32(values), f32(risk)), f32(ORIGIN), f32(RESOLUTION))
    scene = look(spec, params, LIMITS, INFLATION, words, path, f32(pose), goal_yaw, tolerance)
    # the yaw of GoalAngle is summed up from omega, beginning at the robot's
    turned = [(x, y, pose[2] + np.cumsum(w.astype(float)) * DT, v, w) for x, y, _, v, w in runs]
    got = price(spec, scene, turned)
    costs, risks = (reference.Map(a, np.float32(ORIGIN), float(np.float32(RESOLUTION))) for a in (values, risk))
    want, all_hit = reference.mppi_terms(
        spec, params, LIMITS, INFLATION, costs, risks, points, pose, goal_yaw, tolerance, turned, DT
    )
    for k, name in enumerate(spec.critics):
        scale = CLOSE * max(np.abs(want[name]).max(), 1e-3)
        np.testing.assert_allclose(got.terms[k], want[name], rtol=CLOSE, atol=scale, err_msg=name)
    np.testing.assert_allclose(got.total, sum(want[n] for n in spec.critics), rtol=CLOSE, atol=1e-4)
    if "Obstacles" not in spec.critics:
        assert bool(jnp.all(got.collides)) == all_hit
    return want, got


@pytest.mark.parametrize("seed", range(9))
def test_all_critics_are_those_of_the_loops(seed):
    compare(seed, density=(0.0, 0.003, 0.02)[seed % 3], reach=(0.3, 1.0)[seed % 2])


def test_every_critic_says_something_somewhere():
    """The comparison above must not be one of zeros."""
    seen = {name: 0 for name in CRITICS}
    for seed in range(12):
        want, _ = compare(seed, density=0.003, length=(None, 8, 30, 60)[seed % 4])
        for name, cost in want.items():
            seen[name] += int(np.ptp(cost) > 0)
    assert min(seen.values()) > 0, seen


@pytest.mark.parametrize("length", [1, 2, 3])
def test_short_paths(length):
    compare(5, length=length)


def test_powers_strides_and_rules_of_collision():
    squared = CriticParams(*[p._replace(power=2) for p in EAGER])
    for spec in (
        CriticSpec(critics=CRITICS, cost_every=3, align_every=2),
        CriticSpec(critics=CRITICS, circular=False, track_unknown=True),
        CriticSpec(critics=CRITICS, track_unknown=True, cost_every=1, align_every=5),
    ):
        compare(3, spec=spec, params=squared, density=0.01, reach=0.5)


def test_where_all_collide_it_says_so():
    _, got = compare(2, spec=CriticSpec(), density=1.0)
    assert bool(jnp.all(got.collides))


def test_blocked_points_turn_path_align_off():
    used = [compare(1, density=d, length=60)[0]["PathAlign"].max() > 0 for d in (0.0, 0.5)]
    assert used == [True, False]
    stock = CriticParams()
    assert compare(1, params=stock, density=0.0, length=60)[0]["PathAlign"].max() == 0, "too near"


def test_the_furthest_point_is_that_of_the_loops():
    rng = np.random.default_rng(4)
    path, points = make_path(rng, 40)
    ends = rng.uniform(-0.5, 0.5, (200, 2)).astype(np.float32)
    want = max(int(np.argmin([np.hypot(*(np.array(p) - e)) for p in points])) for e in ends)
    assert int(mppi_path_critics.furthest(path, f32(ends[:, 0]), f32(ends[:, 1]))) == want


def test_packing_keeps_costs_and_risk():
    cost, risk = np.arange(256.0).reshape(16, 16), np.random.default_rng(0).random((16, 16))
    words = GridMap(mppi_critics.pack(f32(cost), f32(risk)), f32([0, 0]), f32(1.0))
    x, y = (f32(a.ravel() + 0.5) for a in np.meshgrid(np.arange(16.0), np.arange(16.0)))
    got_cost, got_risk = mppi_critics.read(words, x, y)
    np.testing.assert_array_equal(got_cost, cost.ravel())
    np.testing.assert_allclose(got_risk, risk.ravel(), atol=0.51 * mppi_critics.RISK_STEP)
    outside = mppi_critics.read(words, f32([-0.1, 16.1, 3.0]), f32([3.0, 3.0, 16.0]))
    np.testing.assert_array_equal(outside, [[255.0] * 3, [0.0] * 3])


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"critics": ()}, "different names"),
        ({"critics": ("Cost", "Cost")}, "different names"),
        ({"critics": ("Costs",)}, "out of Constraint, Cost"),
        ({"cost_every": 0}, "strides must be >= 1"),
    ],
)
def test_the_spec_is_checked(wrong, message):
    with pytest.raises(ValueError, match=message):
        CriticSpec(**wrong)


def test_rollouts_are_those_of_the_loops():
    rng = np.random.default_rng(0)
    control, eps = rng.normal(0, 0.3, (STEPS, 2)), rng.normal(size=(STEPS, 2, SAMPLES))
    pose, twist, sigma = np.float32([0.3, -0.2, 2.0]), np.float32([0.2, -0.4]), (0.4, 0.8)

    def path_of(data, m):
        del data
        return jnp.stack([m.x, m.y, jnp.arctan2(m.s, m.c), m.v, m.w])

    def record(data, seen, m, t):
        return seen.at[t].set(path_of(data, m))

    def begin(data, m):
        return record(data, jnp.zeros((STEPS, 5, m.x.shape[0])), m, 0)

    def seldom(data, seen, m):
        """Counts its calls in the yaw of the first pose."""
        return seen.at[0, 2].add(1.0)

    def finish(data, carry, m):
        del data, m
        seen = carry.reshape(STEPS * 5, -1)
        return mppi_rollout.Priced(seen[0], seen, seen[0] < 0)

    cost = mppi_rollout.Cost(begin=begin, step=record, finish=finish, seldom=seldom, period=4)
    gains = np.array([[1.0, 0.9], [1.0, 1.2]])
    for with_gains in (None, f32(gains)):
        got = mppi_rollout.rollout(
            cost, None, LIMITS, f32(pose), f32(twist), f32(control), f32(eps), f32(sigma), dt=DT, gains=with_gains
        )
        got = np.array(got.terms).reshape(STEPS, 5, -1)
        got[0, 2] -= (STEPS - 1) // 4
        c = np.float32(control)[:, :, None] + np.float32(sigma)[None, :, None] * np.float32(eps)
        for k in range(SAMPLES):
            want = np.stack(reference.mppi_rollout(pose, twist, c[:, :, k], LIMITS, DT))
            want[2] = reference.wrap(want[2])
            np.testing.assert_allclose(got[:, :, k], want.T, rtol=CLOSE, atol=CLOSE)
        if with_gains is not None:  # the second block is driven with other gains: as commanded, but for them
            np.testing.assert_allclose(got[:, 3, SAMPLES:], 0.9 * got[:, 3, :SAMPLES], rtol=CLOSE)
            np.testing.assert_allclose(got[:, 4, SAMPLES:], 1.2 * got[:, 4, :SAMPLES], rtol=CLOSE)


def test_commands_that_act_at_once_drive_the_first_step():
    rng = np.random.default_rng(1)
    control, eps = rng.normal(0, 0.3, (STEPS, 2)), rng.normal(size=(STEPS, 2, SAMPLES))
    twist = np.float32([0.2, -0.4])
    speeds = mppi_rollout.running(lambda weights, m: weights[0] * m.v + weights[1] * m.w)
    got = [
        mppi_rollout.rollout(
            speeds, f32(w), LIMITS, f32([0, 0, 0]), f32(twist), f32(control), f32(eps), f32([1, 1]), dt=DT, immediate=True
        ).total
        for w in ((1, 0), (0, 1))
    ]
    for k in range(SAMPLES):
        c = control + eps[:, :, k]
        # a sequence with one more command in front of it, that asks for no change and is not counted
        longer = np.concatenate([c, c[-1:]])
        *_, v, w = reference.mppi_rollout([0, 0, 0], twist, longer, LIMITS, DT)
        np.testing.assert_allclose([g[k] for g in got], [v[1:].sum(), w[1:].sum()], rtol=CLOSE, atol=1e-4)
