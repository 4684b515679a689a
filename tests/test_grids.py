"""Grid algorithms against SciPy and against Dijkstra on the graph as it is documented."""

from functools import partial

import chex
import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from scipy import ndimage

import reference
from drnav_jax import grids

RESOLUTION = 0.2
RELATIVE = 2e-6  # a few dozen float32 additions
METRIC = 1.028  # queen and knight moves against Euclid, in the open

masks = hnp.arrays(bool, (7, 37), elements=st.booleans())


def f32(values):
    return jnp.asarray(values, jnp.float32)


def field(rng, shape, walls):
    """Random costs with impassable cells."""
    cost = rng.uniform(1.0, 5.0, shape)
    cost[rng.random(shape) < walls] = grids.UNREACHABLE
    return cost.astype(np.float32)


def at_goal(shape, *cells):
    initial = np.full(shape, grids.UNREACHABLE, np.float32)
    for cell, value in cells:
        initial[cell] = value
    return initial


@pytest.mark.parametrize("by", [1, 2, 3])
def test_pooling_and_repeating(by):
    values = np.random.default_rng(0).random((6, 12)).astype(np.float32)
    for how in ("max", "sum", "mean", "any", "all"):
        boolean = how in ("any", "all")
        layer = values > 0.6 if boolean else values
        got = grids.pool(jnp.asarray(layer), by, how)
        assert got.dtype == layer.dtype
        for i, j in np.ndindex(6 // by, 12 // by):
            block = layer[by * i : by * (i + 1), by * j : by * (j + 1)]
            assert float(got[i, j]) == pytest.approx(float(getattr(block, how)()), rel=1e-6)
    chex.assert_trees_all_equal(grids.pool(grids.repeat(f32(values), by), by, "max"), f32(values))


@pytest.mark.parametrize("share", [0.0, 0.004, 0.1, 1.0])
def test_distance_transform_equals_scipy(share):
    rng = np.random.default_rng(0)
    for n in range(4):
        mask = rng.random((23, 38)) < share
        got = np.asarray(grids.distance_transform(jnp.asarray(mask), 0.1, 0.75))
        far = np.full(mask.shape, np.inf)
        want = ndimage.distance_transform_edt(~mask) * 0.1 if mask.any() else far
        np.testing.assert_allclose(got, np.minimum(want, 0.75), atol=1e-6, err_msg=str(n))


@settings(max_examples=50)
@given(masks, masks)
def test_flood_fill_equals_scipy(passable, seeds):
    got = np.asarray(grids.flood_fill(jnp.asarray(passable), jnp.asarray(seeds)))
    label, _ = ndimage.label(passable)
    want = np.isin(label, np.unique(label[seeds & passable])) & passable
    np.testing.assert_array_equal(got, want)


@pytest.mark.parametrize("width", [1, 31, 32, 33, 64, 70])
def test_flood_fill_finds_its_way_through_a_snake(width):
    passable = np.ones((9, width), bool)
    passable[1::4, :-1] = passable[3::4, 1:] = width == 1
    seeds = np.zeros_like(passable)
    seeds[0, 0] = True
    got = np.asarray(grids.flood_fill(jnp.asarray(passable), jnp.asarray(seeds)))
    np.testing.assert_array_equal(got, passable)
    passable[4, width // 2] = False
    got = np.asarray(grids.flood_fill(jnp.asarray(passable), jnp.asarray(seeds)))
    assert not got[-1, 0] and (got == (got & passable)).all()


def solve(cost, initial, east=None, north=None):
    sides = [None if a is None else jnp.asarray(a) for a in (east, north)]
    value = grids.cost_to_go(f32(cost), f32(initial), resolution=RESOLUTION, east=sides[0], north=sides[1])
    return np.asarray(value)


@pytest.mark.parametrize("walls", [0.0, 0.05, 0.15, 0.35])
@pytest.mark.parametrize("sided", [False, True])
def test_cost_to_go_is_dijkstras(walls, sided):
    shape, rng = (11, 16), np.random.default_rng(1)
    for _ in range(4):
        cost = field(rng, shape, walls)
        initial = at_goal(shape, ((2, 13), 0.0), ((9, 1), 1.5))
        cost[2, 13] = 1.0
        east, north = (rng.random((2, *shape)) > walls / 4) if sided else (None, None)
        initial[cost >= grids.UNREACHABLE] = grids.UNREACHABLE
        want = reference.dijkstra(cost.astype(np.float64), initial, RESOLUTION, east, north)
        np.testing.assert_allclose(solve(cost, initial, east, north), want, rtol=RELATIVE)
        assert walls < 0.3 or (want[cost < grids.UNREACHABLE] == grids.UNREACHABLE).any()


def test_quarter_turns_and_mirrors_change_nothing():
    rng = np.random.default_rng(2)
    cost = field(rng, (14, 14), 0.12)
    cost[3, 8] = 1.0
    initial = at_goal((14, 14), ((3, 8), 0.0))
    want = solve(cost, initial)
    for turn in (np.rot90, np.fliplr, np.flipud, np.transpose):
        got = solve(turn(cost).copy(), turn(initial).copy())
        np.testing.assert_allclose(got, turn(want), rtol=RELATIVE)


def test_in_the_open_the_way_is_nearly_straight():
    shape, goal = (41, 60), (17, 22)
    value = solve(np.ones(shape), at_goal(shape, (goal, 0.0)))
    i, j = np.indices(shape)
    straight = np.hypot(i - goal[0], j - goal[1]) * RESOLUTION
    assert (value >= straight * (1 - 1e-5)).all() and (value <= straight * METRIC + 1e-5).all()
    assert value[goal] == 0


def test_nothing_is_squeezed_through_a_corner_or_jumped_over():
    free = np.ones((9, 11))
    for wall in (np.eye(9, 11, 1, bool), np.indices((9, 11))[0] == 4):
        cost = np.where(wall, grids.UNREACHABLE, free)
        value = solve(cost, at_goal((9, 11), ((0, 10), 0.0)))
        beyond, _ = ndimage.label(~wall)
        reached = value < grids.UNREACHABLE
        np.testing.assert_array_equal(reached, beyond == beyond[0, 10])
        assert 0 < reached.sum() < (~wall).sum()
    # A side may be closed though both its cells are open.
    north = np.ones((9, 11), bool)
    north[4] = False
    value = solve(free, at_goal((9, 11), ((0, 10), 0.0)), north=north)
    assert (value[5:] == grids.UNREACHABLE).all() and (value[:5] < grids.UNREACHABLE).all()


def test_without_a_goal_nothing_is_reached_and_no_more_rounds_are_made_than_allowed():
    assert (solve(np.ones((8, 9)), at_goal((8, 9))) == grids.UNREACHABLE).all()
    cost = np.ones((5, 20))  # up and down between walls: each turn takes a round
    cost[:4, 1::4] = cost[1:, 3::4] = grids.UNREACHABLE
    cut = grids.cost_to_go(f32(cost), f32(at_goal((5, 20), ((0, 0), 0.0))), resolution=0.1, max_iterations=2)
    assert float(cut[0, 2]) < grids.UNREACHABLE == float(cut[0, 18])
    assert solve(cost, at_goal((5, 20), ((0, 0), 0.0)))[0, 18] < grids.UNREACHABLE


@pytest.mark.parametrize("sided", [False, True])
def test_descending_costs_what_the_value_says(sided):
    shape, goal, rng = (12, 17), (4, 11), np.random.default_rng(3)
    reached = 0
    for _ in range(3):
        cost = field(rng, shape, 0.12)
        cost[goal] = 1.0
        east, north = (jnp.asarray(a) for a in rng.random((2, *shape)) > 0.06) if sided else (None, None)
        initial = at_goal(shape, (goal, 0.5))
        value = solve(cost, initial, east, north)
        graph = reference.edges(cost.astype(np.float64), RESOLUTION, east, north)
        for start in [(0, 0), (11, 16), (11, 0), (0, 16), (6, 5)]:
            cells, moved = grids.descend(
                f32(value), jnp.asarray(start, jnp.int32), f32(cost), resolution=RESOLUTION, num_steps=60,
                east=east, north=north,
            )  # fmt: skip
            if value[start] == grids.UNREACHABLE:
                assert not bool(moved.any()) and tuple(map(int, cells[-1])) == start
                continue
            reached += 1
            way, total = [start, *[tuple(map(int, c)) for c in cells]], 0.5
            for here, there, goes in zip(way, way[1:], np.asarray(moved), strict=False):
                total += dict(graph[here])[there] if goes else 0.0
            assert way[-1] == goal
            assert total == pytest.approx(float(value[start]), rel=1e-5)
    assert reached >= 5


def test_batches_equal_loops_and_every_verb_is_traced_once():
    rng = np.random.default_rng(4)
    masks = jnp.asarray(rng.random((3, 9, 40)) < 0.3)
    costs = f32([field(rng, (9, 40), 0.2) for _ in range(3)])
    initial = f32(at_goal((9, 40), ((0, 0), 0.0)))

    def once(verb, *static):
        return jax.jit(chex.assert_max_traces(verb.__wrapped__, n=1), static_argnames=static)

    distance = once(grids.distance_transform, "resolution", "max_distance")
    fill, to_go = once(grids.flood_fill), once(grids.cost_to_go)
    down = once(grids.descend, "num_steps")
    start = jnp.asarray([8, 39], jnp.int32)
    for one, many in [
        (lambda k: distance(masks[k], 0.1, 0.5), jax.vmap(lambda m: grids.distance_transform(m, 0.1, 0.5))(masks)),
        (lambda k: fill(~masks[k], masks[0]), jax.vmap(lambda m: grids.flood_fill(~m, masks[0]))(masks)),
        (
            lambda k: to_go(costs[k], initial, resolution=f32(0.1 + k)),
            jax.vmap(lambda c, r: grids.cost_to_go(c, initial, resolution=r))(costs, f32([0.1, 1.1, 2.1])),
        ),
        (
            lambda k: down(costs[k], start, costs[k], resolution=f32(0.1), num_steps=3)[0],
            jax.vmap(partial(grids.descend, resolution=0.1, num_steps=3), (0, None, 0))(costs, start, costs)[0],
        ),
    ]:
        chex.assert_trees_all_equal(jnp.stack([one(k) for k in range(3)]), many)


def test_the_least_come_first_and_of_equals_the_first():
    values = f32([3.0, 1.0, np.inf, 1.0, -2.0, 1.0])
    found, index = grids.least(values, 4)
    np.testing.assert_array_equal(found, [-2.0, 1.0, 1.0, 1.0])
    np.testing.assert_array_equal(index, [4, 1, 3, 5])


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="What is compiled into what differs: run it on a CPU.")
def test_who_looks_at_one_of_the_least_does_not_sort_them_all():
    def two_ways(values, pick):
        index = pick(values)
        return index, index[0]

    sorts = lambda pick: " sort(" in jax.jit(lambda v: two_ways(v, pick)).lower(jnp.ones(512)).compile().as_text()  # noqa: E731
    assert sorts(lambda v: jax.lax.top_k(-v, 10)[1])  # or the barrier is needed no longer
    assert not sorts(lambda v: grids.least(v, 10)[1])
