"""The scoring kernel against a plain loop, and what must not change a score."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

import reference
from drnav_jax.planning import costmap, scoring
from drnav_jax.planning.dynamics import Motion
from drnav_jax.planning.exposure import STANDING_SPEED, exposure_integral
from drnav_jax.planning.scoring import BLOCKED, Candidates, ScoreParams
from drnav_jax.types import GridMap, RobotParams

SHAPE, RESOLUTION, ORIGIN = (60, 84), 0.1, np.array([-4.0, -3.0], np.float32)
DT, STEPS = 0.1, 40
ROBOT, PARAMS = RobotParams(), ScoreParams()
PLACE = 3e-4  # [cells] float32 after 40 steps: nearer to a border, a pose may be read from the cell beyond
TOLERANCE = 1e-4  # [m] 40 float32 additions to scores of up to 20 m
NUM = 150

score = jax.jit(scoring.score.__wrapped__, static_argnames=("dt", "num_steps", "block_size", "reader"))
explain = jax.jit(scoring.explain.__wrapped__, static_argnames=("dt", "num_steps", "reader"))
path_of = jax.jit(lambda candidates, k: scoring.path_of(scoring.at(candidates, k), ROBOT, dt=DT, num_steps=STEPS))


def f32(values):
    return jnp.asarray(values, jnp.float32)


def pack(clear, risk, value):
    word = costmap.pack_clearance(costmap.pack_plan(f32(risk), f32(value)), f32(clear))
    return GridMap(word, f32(ORIGIN), RESOLUTION)


def world(seed, obstacles=0.003):
    """Clutter, blotches of risk and a bumpy value-to-go; with free room where the candidates begin."""
    rng = np.random.default_rng(seed)
    occupied = rng.random(SHAPE) < obstacles
    occupied[25:36, 35:46] = False
    clear = np.minimum(ndimage.distance_transform_edt(~occupied) * RESOLUTION, 1.0)
    risk = ndimage.uniform_filter((rng.random(SHAPE) < 0.3).astype(float), 7)
    x, y = np.meshgrid(np.arange(SHAPE[1]), np.arange(SHAPE[0]))
    value = np.hypot(x - 80, y - 50) * RESOLUTION + ndimage.uniform_filter(rng.random(SHAPE), 5)
    return pack(clear, risk, value)


def population(seed, num=NUM, pose=(0.0, 0.0)):
    """Candidates as a generator makes them, and some it would not make."""
    rng = np.random.default_rng(seed)
    yaw, v0, w0 = rng.uniform(-3.1, 3.1, num), rng.uniform(-0.2, 1.0, num), rng.uniform(-1.5, 1.5, num)
    if num > 3:
        v0[:3], w0[:3] = 0.0, 0.0
    v, w = rng.uniform(-0.2, 1.2, num), rng.uniform(-1.5, 1.5, num)
    v[:1] = 0.0  # turning on the spot
    one = np.ones(num)
    motion = Motion(*map(f32, (pose[0] * one, pose[1] * one, np.cos(yaw), np.sin(yaw), v0, w0)))
    rest = (v, w, rng.uniform(0, 3, num), rng.uniform(0.5, 6, num), rng.uniform(-0.3, 0.3, num))
    return Candidates(motion, *map(f32, rest))


def one_of(candidates, k):
    m = jax.tree.map(lambda a: float(np.asarray(a)[k]), candidates)
    yaw = np.arctan2(m.motion.s, m.motion.c)
    return {
        "pose": (m.motion.x, m.motion.y, yaw), "twist": (m.motion.v, m.motion.w), "v": m.v, "w": m.w,
        "turned": m.turned, "reach": m.reach, "bias": m.bias,
    }  # fmt: skip


def run(field, candidates, params=PARAMS, num_steps=STEPS, **static):
    """Scores looked at (`Best`), after a check that the scores alone are the same."""
    best, _ = explain(field, candidates, params, ROBOT, dt=DT, num_steps=num_steps)
    alone = score(field, candidates, params, ROBOT, dt=DT, num_steps=num_steps, **static)
    chex.assert_trees_all_close(alone, best.score, atol=1e-5)
    return jax.device_get(best._replace(score=alone))


VARIANTS = [
    PARAMS,
    PARAMS._replace(horizon=1.7, risk_weight=0.0),
    PARAMS._replace(range_max=2.2, decay=1.3, risk_weight=9.0, range_least=0.0),
    PARAMS._replace(collision=4.0, clearance=0.3, smoothness=0.7, range_bias=2.0, progress=0.5, margin=0.12),
]


@pytest.mark.parametrize("variant", range(len(VARIANTS)))
def test_scores_equal_a_plain_loop(variant):
    params, field, candidates = VARIANTS[variant], world(variant), population(variant)
    got = run(field, candidates, params)
    layers = [np.asarray(a, np.float64) for a in costmap.unpack(field.values)]
    block = ROBOT.radius + params.margin
    compared = ends = blocked = hits = 0
    for k in range(NUM):
        want, certainty = reference.score(
            layers, ORIGIN, RESOLUTION, one_of(candidates, k), params, ROBOT, DT, STEPS, block, STANDING_SPEED
        )
        if certainty < PLACE:
            continue
        compared += 1
        if want is None:
            blocked += 1
            assert float(got.score[k]) == float(got.geometric[k]) == BLOCKED
            continue
        hits += want["hit"]
        assert float(got.score[k]) == pytest.approx(want["score"], abs=TOLERANCE)
        if want["clear_winner"]:
            ends += 1
            assert float(got.geometric[k]) == pytest.approx(want["geometric"], abs=TOLERANCE)
            assert float(got.exposure[k]) == pytest.approx(want["exposure"], abs=TOLERANCE)
            assert (got.x[k], got.y[k]) == pytest.approx(want["end"], abs=1e-4)
            assert float(got.arc[k]) == pytest.approx(want["arc"], abs=1e-4)
    assert compared > 0.8 * NUM and ends > 0.3 * NUM
    assert hits > 2
    assert blocked > 0 or params.range_least == 0.0


def test_a_robot_within_the_margin_may_leave_but_not_come_closer(clearance_of):
    wall = np.zeros(SHAPE, bool)
    wall[:, 43] = True  # its centre is at x = 0.35
    near = clearance_of(wall, ORIGIN, RESOLUTION).values
    field = pack(near, 0 * near, 0 * near + 1.0)
    assert 0.2 < float(near[30, 41]) < ROBOT.radius + PARAMS.margin
    yaw = np.array([0.0, np.pi, np.pi / 2])  # into the wall, away from it, along it
    place = np.array([0.17, 0.05], np.float32)
    one = np.ones(3)
    motion = Motion(*map(f32, (place[0] * one, place[1] * one, np.cos(yaw), np.sin(yaw), one, 0 * one)))
    got = run(field, Candidates(motion, f32(one), f32(0 * one), f32(0 * one), f32(5 * one), f32(0 * one)))
    assert float(got.score[0]) == BLOCKED
    assert float(got.score[1]) < BLOCKED and float(got.score[2]) < BLOCKED


def test_through_a_wall_is_blocked_and_short_of_it_costs_the_collision():
    occupied = np.zeros(SHAPE, bool)
    occupied[:, 60] = True  # x = 2.05
    clear = np.minimum(ndimage.distance_transform_edt(~occupied) * RESOLUTION, 1.0)
    x = (np.arange(SHAPE[1]) + 0.5) * RESOLUTION + ORIGIN[0]
    value = np.broadcast_to(10.0 - x, SHAPE)  # the goal lies behind the wall
    candidates = Candidates(
        Motion(*map(f32, ([0.0], [0.0], [1.0], [0.0], [1.0], [0.0]))), *map(f32, ([1.0], [0.0], [0.0], [5.0], [0.0]))
    )
    free = run(pack(np.ones(SHAPE), 0 * clear, value), candidates)
    stopped = run(pack(clear, 0 * clear, value), candidates)
    assert float(free.x[0]) > 2.8  # from range_min on nothing is gained or lost
    assert float(stopped.x[0]) < 2.05 - ROBOT.radius - PARAMS.margin + RESOLUTION
    least = run(pack(clear, 0 * clear, value), candidates, PARAMS._replace(range_least=2.0))
    assert float(least.score[0]) == BLOCKED
    dear = run(pack(clear, 0 * clear, value), candidates, PARAMS._replace(collision=1.1))
    assert float(dear.score[0] - stopped.score[0]) == pytest.approx(1.0, abs=TOLERANCE)
    # what lies beyond the horizon is not met
    near = PARAMS._replace(horizon=1.0)
    soon = [run(pack(clear, 0 * clear, value), candidates, near._replace(collision=w)) for w in (0.0, 7.0)]
    chex.assert_trees_all_equal(*soon)
    assert float(soon[0].x[0]) == pytest.approx(1.0, abs=1e-4)


def test_without_risk_weight_the_score_is_geometry_bit_for_bit():
    field, candidates = world(5), population(5)
    off = PARAMS._replace(risk_weight=0.0)
    with_risk = run(field, candidates, off)
    chex.assert_trees_all_equal(with_risk.score, with_risk.geometric)
    near, _, value = costmap.unpack(field.values)
    without = run(pack(near + 0.5 * costmap.CLEARANCE_STEP, 0 * near, value), candidates, off)
    assert float(with_risk.exposure.max()) > 0.1
    chex.assert_trees_all_equal(with_risk._replace(exposure=without.exposure), without)
    heavy = run(field, candidates, PARAMS._replace(risk_weight=5.0))
    free = np.asarray(heavy.score) < BLOCKED
    assert (np.asarray(heavy.score) >= np.asarray(with_risk.score))[free].all()
    assert (np.asarray(heavy.score) > np.asarray(with_risk.score))[free].any()
    np.testing.assert_allclose(  # eq. 8
        np.asarray(heavy.score)[free], np.asarray(heavy.geometric + 5.0 * heavy.exposure)[free], rtol=1e-5
    )


def test_exposure_is_the_integral_along_the_path():
    """The kernel adds up whole steps over whole cells: on a smooth field that is the integral, nearly."""
    smooth = ndimage.gaussian_filter((np.random.default_rng(3).random(SHAPE) < 0.3).astype(float), 6)
    field = pack(np.ones(SHAPE), smooth, np.ones(SHAPE))
    far = PARAMS._replace(range_max=9.0, range_bias=50.0, range_min=9.0)  # the longest prefix wins
    candidates = population(11, num=12)
    candidates = candidates._replace(reach=f32(np.full(12, 9.0)), v=f32(np.linspace(0.4, 1.0, 12)))
    got = run(field, candidates, far)
    risk = GridMap(f32(smooth), f32(ORIGIN), RESOLUTION)
    for k in range(12):
        path = path_of(candidates, jnp.int32(k))
        begin = f32([[candidates.motion.x[k], candidates.motion.y[k]]])
        want = float(exposure_integral(risk, jnp.concatenate([begin, path]), far.decay, dt=DT))
        assert float(got.exposure[k]) == pytest.approx(want, rel=0.03) and want > 0.1


@pytest.mark.parametrize("horizon", [0.5, 2.0, 3.1])
def test_a_masked_horizon_is_a_shorter_rollout(horizon):
    field, candidates = world(6), population(6)
    masked = run(field, candidates, PARAMS._replace(horizon=horizon))
    short = run(field, candidates, num_steps=round(horizon / DT))
    chex.assert_trees_all_close(masked, short, atol=TOLERANCE)
    assert float(masked.arc.max()) <= 1.2 * horizon + TOLERANCE  # speeds up to 1.2 m/s


def test_ends_lie_within_the_ranges():
    got = run(world(7), population(7), PARAMS._replace(range_least=0.8, range_max=2.0))
    free = np.asarray(got.score) < BLOCKED
    arc, step = np.asarray(got.arc)[free], 1.2 * DT
    assert free.any() and (~free).any()
    assert (arc >= 0.8).all() and (arc <= 2.0 + step).all()
    assert (np.asarray(got.x) ** 2 + np.asarray(got.y) ** 2 <= (2.0 + step) ** 2).all()


def test_the_terms_add_up_to_the_score():
    field, candidates = world(8), population(8)
    got = run(field, candidates)
    _, terms = explain(field, candidates, PARAMS, ROBOT, dt=DT, num_steps=STEPS)
    free = np.asarray(got.score) < BLOCKED
    np.testing.assert_allclose(np.asarray(sum(terms))[free], np.asarray(got.score)[free], atol=TOLERANCE)
    assert all(float(jnp.abs(t).max()) > 0 for t in terms)
    best = int(jnp.argmin(got.score))
    _, alone = explain(field, scoring.at(candidates, jnp.int32(best)), PARAMS, ROBOT, dt=DT, num_steps=STEPS)
    assert float(sum(alone)[0]) == pytest.approx(float(got.score[best]), abs=TOLERANCE)


@pytest.mark.parametrize("size", [30, 50, 150, 64])
def test_the_size_of_blocks_changes_nothing(size):
    field, candidates = world(9), population(9)
    chex.assert_trees_all_close(run(field, candidates, block_size=size), run(field, candidates), atol=1e-6)


def product(seed, speeds=7, turns=9):
    """Candidates of one robot, every speed with every turn rate: as arrays that broadcast, and written out."""
    some = population(seed, max(speeds, turns))
    first = jax.tree.map(lambda a: a[:1, None], some)
    few = first._replace(v=some.v[:speeds, None], w=some.w[None, :turns], bias=some.bias[None, :turns])
    return few, jax.tree.map(lambda a: jnp.broadcast_to(a, (speeds, turns)).reshape(-1), few)


@pytest.mark.parametrize("size", [None, 27, 8])  # all at once; three rows, three rows, one; row by row
def test_a_product_is_the_list_of_its_pairs(size):
    field, (few, listed) = world(16), product(16)
    assert few.shape == (7, 9) and listed.shape == (63,)
    got = score(field, few, PARAMS, ROBOT, dt=DT, num_steps=STEPS, block_size=size)
    assert got.shape == (7, 9) and 0 < int((got < BLOCKED).sum())
    chex.assert_trees_all_close(got.reshape(-1), run(field, listed).score, atol=1e-6)
    chosen = jnp.asarray([62, 0, 13])
    chex.assert_trees_all_equal(scoring.at(few, chosen), scoring.at(listed, chosen))


def test_arrays_of_other_axes_are_refused():
    few, _ = product(16, 7, 7)
    with pytest.raises(ValueError, match=r"as many axes, such as \[S, 1\] and \[1, N\]"):
        score(world(16), few._replace(bias=few.bias[0]), PARAMS, ROBOT, dt=DT, num_steps=STEPS)


@pytest.mark.parametrize("workers", [1, 2, 4])
@pytest.mark.parametrize("kind", ["list", "product"])
def test_the_number_of_threads_changes_nothing(workers, kind):
    field, candidates = world(9), population(9) if kind == "list" else product(9)[0]
    how = {"dt": DT, "num_steps": STEPS}
    shared = scoring.score_on_threads(field, candidates, PARAMS, ROBOT, workers=workers, **how)
    chex.assert_trees_all_close(shared, score(field, candidates, PARAMS, ROBOT, **how), atol=1e-6)


def test_the_step_leads_to_the_end():
    field, candidates = world(12), population(12)
    got, free = run(field, candidates), 0
    for k in range(NUM):
        if float(got.score[k]) == BLOCKED:
            assert int(got.step[k]) == 0
            continue
        free += 1
        path = path_of(candidates, jnp.int32(k))
        np.testing.assert_allclose(path[int(got.step[k]) - 1], [got.x[k], got.y[k]], atol=1e-5)
    assert 0.2 * NUM < free < NUM


@pytest.mark.parametrize("decay", [0.0, 40.0, 3e4])
def test_any_discount_is_exact(decay):
    """The discount is a product of factors that are ramps themselves; at 3e4 / m all that matters underflows."""
    params, field, candidates = PARAMS._replace(decay=decay, risk_weight=9.0), world(13), population(13)
    got = run(field, candidates, params)
    layers = [np.asarray(a, np.float64) for a in costmap.unpack(field.values)]
    block, compared = ROBOT.radius + params.margin, 0
    for k in range(NUM):
        want, certainty = reference.score(
            layers, ORIGIN, RESOLUTION, one_of(candidates, k), params, ROBOT, DT, STEPS, block, STANDING_SPEED
        )
        if want is not None and certainty >= PLACE:
            compared += 1
            assert float(got.score[k]) == pytest.approx(want["score"], abs=TOLERANCE)
    assert compared > 0.2 * NUM


def test_another_reader_may_read_other_layers():
    """Float layers in metres, looked up like packed words, give the same scores up to the packing's steps."""
    field, candidates = world(14), population(14)
    layers = costmap.unpack(field.values)

    def locate(layers, x, y):
        col = jnp.clip((x - ORIGIN[0]) / RESOLUTION, 0.0, SHAPE[1] - 1.0).astype(jnp.int32)
        row = jnp.clip((y - ORIGIN[1]) / RESOLUTION, 0.0, SHAPE[0] - 1.0).astype(jnp.int32)
        return row, col

    reader = scoring.Reader(
        lambda layers: (jnp.zeros(2, jnp.float32), 1.0), locate, lambda layers, at: tuple(a[at] for a in layers)
    )
    got = score(layers, candidates, PARAMS, ROBOT, dt=DT, num_steps=STEPS, reader=reader)
    want = score(field, candidates, PARAMS, ROBOT, dt=DT, num_steps=STEPS)
    error = np.abs(np.asarray(got) - np.asarray(want))
    assert np.mean(error > TOLERANCE) < 0.02  # poses on a border between cells


def test_the_path_ends_where_the_score_says():
    field, candidates = pack(np.ones(SHAPE), np.zeros(SHAPE), np.ones(SHAPE)), population(10, num=8)
    far = PARAMS._replace(range_max=9.0, range_bias=50.0, range_min=9.0)  # the longest prefix wins
    got = run(field, candidates._replace(reach=f32(np.full(8, 9.0)), v=f32(np.full(8, 0.8))), far)
    for k in range(8):
        one = scoring.at(candidates._replace(v=f32(np.full(8, 0.8))), jnp.int32(k))
        path = np.asarray(scoring.path_of(one, ROBOT, dt=DT, num_steps=STEPS))
        np.testing.assert_allclose(path[-1], [got.x[k], got.y[k]], atol=1e-5)
        want = reference.rollout(*[one_of(candidates, k)[n] for n in ("pose", "twist")], 0.8,
                                 float(candidates.w[k]), ROBOT, DT, STEPS)  # fmt: skip
        np.testing.assert_allclose(path, [p[:2] for p in want], atol=1e-4)


def test_one_trace_for_a_sweep_over_weights():
    once = jax.jit(chex.assert_max_traces(scoring.score.__wrapped__, n=1), static_argnames=("dt", "num_steps"))
    seen = set()
    for k in range(3):
        params = PARAMS._replace(risk_weight=f32(k), decay=f32(0.1 * k), horizon=f32(4 - k), range_max=f32(5 - k))
        seen.add(float(once(world(k), population(k), params, ROBOT, dt=DT, num_steps=STEPS)[5]))
    assert len(seen) == 3
    score_of = lambda lam: score(  # noqa: E731
        world(1), population(1), PARAMS._replace(risk_weight=lam), ROBOT, dt=DT, num_steps=STEPS
    )
    sweep = jax.vmap(score_of)(f32([0, 1, 4]))
    for lam, row in zip((0.0, 1.0, 4.0), sweep, strict=True):
        chex.assert_trees_all_close(row, score_of(f32(lam)), atol=1e-5)
