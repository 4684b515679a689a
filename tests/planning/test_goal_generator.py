"""The goal generator: which candidates there are, and that g* is the best of them."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

import reference
from drnav_jax.planning import costmap, goal_generator, scoring
from drnav_jax.planning.goal_generator import GeneratorSpec
from drnav_jax.planning.scoring import BLOCKED, ScoreParams
from drnav_jax.types import GridMap, RobotParams

SHAPE, RESOLUTION, ORIGIN = (80, 100), 0.1, np.array([-3.0, -4.0], np.float32)
SPEC = GeneratorSpec(num_speeds=4, num_turns=9, num_headings=38)
ROBOT, PARAMS = RobotParams(), ScoreParams()
HERE, STILL = [0.0, 0.0, 0.0], [0.0, 0.0]
NEW = (RESOLUTION + PARAMS.range_max / 40)  # [m] a cell and a step of the rollout

generate = jax.jit(goal_generator.generate.__wrapped__, static_argnames="spec")


def f32(values):
    return jnp.asarray(values, jnp.float32)


def centres(shape=SHAPE, resolution=RESOLUTION, origin=ORIGIN):
    x = origin[0] + (np.arange(shape[1]) + 0.5) * resolution
    y = origin[1] + (np.arange(shape[0]) + 0.5) * resolution
    return np.meshgrid(x, y)


def field(occupied=None, risk=0.0, goal=(20.0, 0.0), value=None, resolution=RESOLUTION, origin=ORIGIN):
    occupied = np.zeros(SHAPE, bool) if occupied is None else occupied
    x, y = centres(occupied.shape, resolution, origin)
    clear = np.full(occupied.shape, 1.0)
    if occupied.any():
        clear = np.minimum(ndimage.distance_transform_edt(~occupied) * resolution, 1.0)
    value = np.hypot(x - goal[0], y - goal[1]) if value is None else value
    plan = costmap.pack_plan(f32(risk + 0 * x), f32(value))
    return GridMap(costmap.pack_clearance(plan, f32(clear)), f32(origin), resolution)


def choose(words, goal=(20.0, 0.0), last=(0.0, 0.0), hysteresis=0.3, pose=HERE, twist=STILL, params=PARAMS, spec=SPEC):
    args = (f32(pose), f32(twist), f32(goal), f32(last), f32(hysteresis))
    return generate(spec, params, ROBOT, words, *args)


def everything(words, goal=(20.0, 0.0), last=(0.0, 0.0), hysteresis=0.3, params=PARAMS):
    ways = goal_generator.candidates(SPEC, params, ROBOT, f32(HERE), f32(STILL), f32(goal), f32(last), f32(hysteresis))
    every = goal_generator.at(ways, jnp.arange(SPEC.num_candidates))
    return every, scoring.explain(words, every, params, ROBOT, dt=SPEC.dt, num_steps=SPEC.num_steps)[0]


@pytest.mark.parametrize(("speeds", "turns", "headings"), [(4, 9, 38), (0, 9, 38), (3, 0, 5), (1, 1, 3)])
def test_there_are_as_many_candidates_as_the_spec_says(speeds, turns, headings):
    spec = GeneratorSpec(num_speeds=speeds, num_turns=turns, num_headings=headings)
    goal, last = f32([3.0, 4.0]), f32([0.0, -2.0])
    ways = goal_generator.candidates(spec, PARAMS, ROBOT, f32([1, 1, 0.3]), f32(STILL), goal, last, f32(0.3))
    assert [part.shape for part in ways] == [(speeds, turns), (headings,)]
    assert spec.num_candidates == speeds * turns + headings
    ways = goal_generator.at(ways, jnp.arange(spec.num_candidates))
    assert all(a.shape == (spec.num_candidates,) for a in jax.tree.leaves(ways))
    controls = speeds * turns
    v, w = np.asarray(ways.v)[:controls], np.asarray(ways.w)[:controls]
    assert len({*zip(v.tolist(), w.tolist(), strict=True)}) == controls
    assert controls == 0 or (v.min() > 0 and v.max() == ROBOT.v_max and np.abs(w).max() <= ROBOT.w_max)
    yaw = np.arctan2(ways.motion.s, ways.motion.c)[controls:]
    np.testing.assert_allclose(yaw[-2:], [np.arctan2(-3, -1), np.arctan2(3, 2)], atol=1e-6)
    gaps = np.diff(np.sort(yaw[:-2] % (2 * np.pi)))
    np.testing.assert_allclose(gaps, 2 * np.pi / (headings - 2), atol=1e-5)
    turned = [abs(reference.wrap(a - 0.3)) for a in yaw]
    np.testing.assert_allclose(np.asarray(ways.turned)[controls:], turned, atol=1e-5)
    assert (np.asarray(ways.turned)[:controls] == 0).all()


@pytest.mark.parametrize("wrong", [{"num_headings": 2}, {"num_speeds": -1}, {"dt": 0.0}, {"num_steps": 0}])
def test_a_generator_that_cannot_be_is_refused(wrong):
    with pytest.raises(ValueError, match="must be"):
        GeneratorSpec(**wrong)


def test_the_choice_is_the_least_score():
    rng = np.random.default_rng(0)
    occupied = rng.random(SHAPE) < 0.004
    occupied[30:50, 20:40] = False
    words = field(occupied, risk=ndimage.uniform_filter((rng.random(SHAPE) < 0.2).astype(float), 9))
    ways, scores = everything(words)
    best = int(jnp.argmin(scores.score))
    path = scoring.path_of(scoring.at(ways, jnp.int32(best)), ROBOT, dt=SPEC.dt, num_steps=SPEC.num_steps)
    got = choose(words)
    assert int(got.index) == best and bool(got.valid)
    assert float(got.score) == pytest.approx(float(scores.score.min()), abs=1e-5)  # eq. 9; two programs may fuse apart
    np.testing.assert_allclose(got.xy, path[int(scores.step[best]) - 1], atol=1e-5)
    assert float(got.geometric) + PARAMS.risk_weight * float(got.exposure) == pytest.approx(float(got.score), abs=1e-5)
    assert float(sum(got.terms)[0]) == pytest.approx(float(got.score), abs=1e-4)


def test_the_best_are_the_least_scores_and_their_terms_add_up():
    rng = np.random.default_rng(1)
    words = field(rng.random(SHAPE) < 0.004)
    _, scores = everything(words)
    got, want = choose(words), np.sort(np.asarray(scores.score))[: SPEC.num_explained]
    np.testing.assert_allclose(got.best_score, want, atol=1e-5)
    np.testing.assert_allclose(sum(got.best), want, atol=1e-4)
    chex.assert_trees_all_equal(jax.tree.map(lambda a: a[:1], got.best), got.terms)
    few = dataclasses.replace(SPEC, num_speeds=0, num_headings=6)
    assert choose(words, spec=few).best_score.shape == (6,)


def test_in_the_open_it_heads_for_the_goal():
    got = choose(field())
    assert abs(float(got.xy[1])) < NEW and PARAMS.range_min - NEW <= float(got.xy[0]) <= PARAMS.range_max + NEW
    near = choose(field(goal=(1.5, 0.5)), goal=(1.5, 0.5))  # nearer than range_min
    np.testing.assert_allclose(near.xy, [1.5, 0.5], atol=NEW)


def gap_world():
    """A wall at x = 2 with a gap of 1.4 m around y = -1.5, and the value-to-go through it."""
    x, y = centres()
    wall = (np.abs(x - 2.0) < 0.11) & (np.abs(y + 1.5) > 0.7)
    through = np.hypot(x - 2.3, y + 1.5) + np.hypot(2.3 - 6.0, -1.5)
    return wall, np.where(x > 2.2, np.hypot(x - 6.0, y), through)


def test_it_heads_for_the_gap():
    wall, value = gap_world()
    got = choose(field(wall, value=value), goal=(6.0, 0.0))
    x, y = map(float, got.xy)
    assert x > 1.5 and -2.2 < y / x * 2.0 < -0.8


def test_risk_turns_it_away_and_without_weight_does_not():
    x, y = centres()
    pocket = np.where((x > 1.0) & (np.abs(y) < 1.2), 0.9, 0.0)
    words = field(risk=pocket)
    blind = choose(words, params=PARAMS._replace(risk_weight=0.0))
    chex.assert_trees_all_equal(blind.xy, choose(field(), params=PARAMS._replace(risk_weight=0.0)).xy)
    wary = choose(words)
    assert float(blind.xy[0]) > 2.0 and abs(float(blind.xy[1])) < 1.2
    assert float(wary.xy[0]) < 1.1 or abs(float(wary.xy[1])) > 1.1
    assert float(wary.exposure) < 0.1 * float(blind.exposure)


def test_hysteresis_keeps_a_choice_unless_another_is_better_by_it():
    _, y = centres()

    def two_ways(lead):
        """To the left and to the right it is equally good, but for 2 * lead per metre."""
        return field(value=9.0 - np.abs(y) - lead * y)

    last = np.array([0.0, -3.2], np.float32)
    kept = choose(two_ways(0.05), last=last, hysteresis=1.0)
    assert int(kept.index) == SPEC.num_candidates - 2 and float(kept.xy[1]) < -2.5
    assert float(kept.terms.bias[0]) == -1.0
    assert float(choose(two_ways(0.05), last=last, hysteresis=0.0).xy[1]) > 2.5
    assert float(choose(two_ways(0.5), last=last, hysteresis=1.0).xy[1]) > 2.5
    # at the last g* itself there is nothing to hold on to
    assert float(choose(two_ways(0.05), last=(0.0, -0.01), hysteresis=1.0).xy[1]) > 2.5


def test_when_all_is_blocked_it_says_so_and_stays():
    x, y = centres()
    words = field(np.hypot(x, y) > 0.35)
    got = choose(words)
    assert not bool(got.valid) and float(got.score) == BLOCKED
    np.testing.assert_allclose(got.xy, HERE[:2])
    assert bool(jnp.all(jnp.isfinite(jnp.stack([got.exposure, *got.xy]))))


@pytest.mark.parametrize(("away", "horizon"), [(0.5, 0.5), (1.0, 0.7), (1.0, 4.0)])
def test_no_heading_leaps_over_a_wall(away, horizon):
    """A wall 15 cm thick across the way, which a ray in steps of a metre would not see."""
    x, _ = centres()
    got = choose(field((x > away) & (x < away + 0.15)), params=PARAMS._replace(horizon=f32(horizon)))
    assert float(got.xy[0]) < away


def test_what_nobody_generated_is_the_goal_itself():
    got = goal_generator.given(SPEC, f32([3.0, -1.0]))
    chex.assert_trees_all_equal_shapes_and_dtypes(got, choose(field()))
    np.testing.assert_array_equal(got.xy, [3, -1])
    assert bool(got.valid) and int(got.index) == -1


def test_one_trace_and_batches_equal_loops():
    once = jax.jit(chex.assert_max_traces(goal_generator.generate.__wrapped__, n=1), static_argnames="spec")
    wall, value = gap_world()
    words = field(wall, value=value)
    args = (f32(STILL), f32([6.0, 0.0]), f32([1.0, 1.0]), f32(0.3))
    one = [
        once(SPEC, PARAMS._replace(risk_weight=f32(k), horizon=f32(4 - k)), ROBOT, words, f32([0, 0.3 * k, k]), *args)
        for k in range(3)
    ]

    def batched(k):
        params = PARAMS._replace(risk_weight=k, horizon=4 - k)
        return generate(SPEC, params, ROBOT, words, jnp.stack([0 * k, 0.3 * k, k]), *args)

    many = jax.vmap(batched)(f32(range(3)))
    chex.assert_trees_all_close(jax.tree.map(lambda *a: jnp.stack(a), *one), many, atol=1e-5)


@pytest.mark.parametrize(("before", "aside"), [(0.4, -0.03), (0.4, 0.0), (0.4, 0.04), (1.1, -0.1), (1.1, 0.0), (1.1, 0.1)])
def test_a_door_that_the_tracker_would_pass_is_gone_through(before, aside):
    """Six cells from the middle to either post, 5 cm beyond the radius, which the tracker's margin of 4 cm lets pass."""
    resolution, shape, wall, middle = 0.05, (61, 83), 50, 30
    origin = np.array([-2.525, -1.525], np.float32)  # the door's middle is a cell's, at 0, 0
    occupied = np.zeros(shape, bool)
    occupied[:, wall] = True
    occupied[middle - 5 : middle + 6, wall] = False
    words = field(occupied, goal=(4.0, 0.0), resolution=resolution, origin=origin)
    near, _, _ = costmap.unpack(words.values)
    assert near[middle, wall] == pytest.approx(ROBOT.radius + 0.05)
    pose = [-before, aside, 0.0]
    found = choose(words, goal=(4.0, 0.0), last=pose[:2], pose=pose, spec=GeneratorSpec())
    assert found.valid
    assert found.xy[0] > 0.3
