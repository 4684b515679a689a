"""The cost-to-go on the window: as short as can be, around walls, away from risk, and honest when there is no way."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

import reference
from drnav_jax import grids
from drnav_jax.planning import route
from drnav_jax.planning.route import RouteParams, RouteSpec
from drnav_jax.types import RobotParams

SHAPE, RESOLUTION = (64, 96), 0.1
SPEC = RouteSpec(pooling=2)
SIZE = RESOLUTION * SPEC.pooling
ORIGIN = np.array([-4.8, -3.2], np.float32)
ROBOT, PARAMS = RobotParams(), RouteParams()
PLAIN = PARAMS._replace(clearance=0.0, risk_weight=0.0, visit_weight=0.0)  # metres only
METRIC = 1.028  # queen and knight moves against Euclid, in the open
NONE = np.zeros(SHAPE)

solve_ = jax.jit(route.solve.__wrapped__, static_argnames=("spec", "resolution"))


def f32(values):
    return jnp.asarray(values, jnp.float32)


def centres():
    x = ORIGIN[0] + (np.arange(SHAPE[1]) + 0.5) * RESOLUTION
    y = ORIGIN[1] + (np.arange(SHAPE[0]) + 0.5) * RESOLUTION
    return np.meshgrid(x, y)


X, Y = centres()


def solve(
    occupied, goal, xy=(-4.0, 0.0), params=PLAIN, risk=NONE, visits=NONE, squeeze=False, beyond=0.0, solver=solve_
):
    clear = np.full(SHAPE, 1.0)
    if occupied.any():
        clear = np.minimum(ndimage.distance_transform_edt(~occupied) * RESOLUTION, 1.0)
    rim = f32(np.broadcast_to(beyond, [n // SPEC.pooling for n in SHAPE]))
    return solver(
        SPEC, params, f32(clear), f32(risk), f32(visits), f32(ORIGIN), RESOLUTION, f32(xy), f32(goal), ROBOT,
        jnp.asarray(squeeze), rim,
    )  # fmt: skip


def at(values, x, y):
    return float(values[int((y - ORIGIN[1]) / RESOLUTION), int((x - ORIGIN[0]) / RESOLUTION)])


def downhill(value, xy, steps=400):
    """Follow the steepest way down over the map's cells; the points passed."""
    value = np.asarray(value, np.float64)
    cell = [int((xy[1] - ORIGIN[1]) / RESOLUTION), int((xy[0] - ORIGIN[0]) / RESOLUTION)]
    points = []
    for _ in range(steps):
        points.append((X[tuple(cell)], Y[tuple(cell)]))
        near = [
            (cell[0] + i, cell[1] + j)
            for i in (-1, 0, 1)
            for j in (-1, 0, 1)
            if 0 <= cell[0] + i < SHAPE[0] and 0 <= cell[1] + j < SHAPE[1]
        ]
        best = min(near, key=lambda c: value[c])
        if value[best] >= value[tuple(cell)]:
            break
        cell = best
    return np.array(points)


def test_in_the_open_it_is_the_straight_distance():
    got = solve(NONE > 0, [2.05, 1.0])
    straight = np.hypot(X - 2.05, Y - 1.0)
    value = np.asarray(got.value)
    assert bool(got.reachable)
    far = straight > 3 * SIZE
    assert (value <= straight * METRIC + SIZE / 2)[far].all() and (value >= straight - SIZE / 2)[far].all()


def test_it_equals_dijkstra_on_the_pooled_cells():
    """Value of the coarse cells, from the documented cost and the documented graph."""
    rng = np.random.default_rng(0)
    occupied = rng.random(SHAPE) < 0.01
    goal, xy = np.array([3.1, -1.1]), np.array([-2.9, 0.5])
    occupied[np.hypot(X - xy[0], Y - xy[1]) < 0.5] = False
    risk, visits = rng.random(SHAPE), rng.random(SHAPE) < 0.1
    got = np.asarray(solve(occupied, goal, xy, PARAMS, risk, visits).value)
    clear = np.minimum(ndimage.distance_transform_edt(~occupied) * RESOLUTION, 1.0)
    closed = ROBOT.radius + PARAMS.closed_margin
    near_goal = np.hypot(X - goal[0], Y - goal[1]) <= 1.5 * SIZE
    free = (clear >= closed) | (near_goal & (clear > 0.5 * ROBOT.radius))
    h, w = SHAPE[0] // 2, SHAPE[1] // 2
    cost, initial = np.full((h, w), 1e4), np.full((h, w), 1e4)
    east, north = np.zeros((h, w), bool), np.zeros((h, w), bool)
    for i, j in np.ndindex(h, w):
        block = np.s_[2 * i : 2 * i + 2, 2 * j : 2 * j + 2]
        away = np.hypot(*(np.array([X[block].mean(), Y[block].mean()]) - goal))
        lack = ROBOT.radius + PARAMS.soft_clearance - clear[block].mean()
        lack /= PARAMS.soft_clearance - PARAMS.closed_margin
        if free[block].any():
            cost[i, j] = 1 + PARAMS.clearance * max(lack, 0) ** 2 + PARAMS.visit_weight * visits[block].mean()
            cost[i, j] += min(PARAMS.risk_weight * risk[block].mean(), PARAMS.risk_cap)
            if away <= 1.5 * SIZE or i in (0, h - 1) or j in (0, w - 1):
                initial[i, j] = away
        east[i, j] = any(free[a, 2 * j + 1] and free[a, 2 * j + 2] for a in (2 * i, 2 * i + 1)) if j + 1 < w else False
        north[i, j] = any(free[2 * i + 1, b] and free[2 * i + 2, b] for b in (2 * j, 2 * j + 1)) if i + 1 < h else False
    want = reference.dijkstra(cost, initial, SIZE, east, north)
    assert 0.03 < (want == 1e4).mean() < 0.6
    for i, j in np.ndindex(SHAPE):  # between coarse centres bilinear, where all four have a way
        own = want[i // 2, j // 2]
        beside_i, beside_j = (min(max(k // 2 + (1 if k % 2 else -1), 0), n - 1) for k, n in ((i, h), (j, w)))
        others = want[beside_i, j // 2], want[i // 2, beside_j], want[beside_i, beside_j]
        mixed = 0.5625 * own + 0.1875 * (others[0] + others[1]) + 0.0625 * others[2]
        assert got[i, j] == pytest.approx(mixed if max(own, *others) < 1e4 else own, rel=1e-5)


def wall_with_gap(gap_y, width):
    """A wall across the window at x = 0 with a gap."""
    return (np.abs(X) < 0.06) & (np.abs(Y - gap_y) > width / 2)


def test_it_goes_through_the_gap():
    occupied = wall_with_gap(2.0, 1.2)
    got = solve(occupied, [3.0, 0.0], beyond=50.0)
    want = np.hypot(4.0, 2.0) + np.hypot(3.0, 2.0)
    assert at(got.value, -4.0, 0.0) == pytest.approx(want, rel=0.06)  # metric, and cells of 0.2 m
    points = downhill(got.value, (-4.0, 0.0))
    crossing = points[np.abs(points[:, 0]).argmin()]
    assert 1.4 < crossing[1] < 2.6 and np.hypot(*(points[-1] - [3.0, 0.0])) < 2 * SIZE


@pytest.mark.parametrize(("width", "squeeze", "passes"), [(0.3, False, False), (0.3, True, False), (1.0, False, True)])
def test_a_gap_narrower_than_the_robot_is_no_way(width, squeeze, passes):
    got = solve(wall_with_gap(2.0, width), [3.0, 0.0], beyond=50.0, squeeze=squeeze)
    assert (at(got.value, -4.0, 0.0) < 20.0) == passes


def test_squeezing_opens_what_is_just_wide_enough():
    def passes(squeeze):
        params = PLAIN._replace(closed_margin=0.2, squeeze_margin=0.0)
        got = solve(wall_with_gap(2.0, 0.8), [3.0, 0.0], beyond=50.0, squeeze=squeeze, params=params)
        return at(got.value, -4.0, 0.0) < 20.0

    assert passes(True) and not passes(False)


def two_corridors():
    """Two ways from left to right, of nearly the same length, with rock between and around."""
    return (np.abs(X) < 2.5) & ~((np.abs(Y - 1.5) < 0.8) | (np.abs(Y + 1.5) < 0.8))


def way_taken(**kwargs):
    got = solve(two_corridors(), [4.0, 0.3], beyond=50.0, params=PARAMS, **kwargs)
    points = downhill(got.value, (-4.0, 0.0))
    return np.sign(points[np.abs(points[:, 0]).argmin(), 1]), at(got.value, -4.0, 0.0)


def test_risk_and_visits_make_it_take_the_other_way():
    upper, plain = way_taken()
    assert upper == 1
    danger = np.where((Y > 0) & (np.abs(X) < 2.5), 0.9, 0.0)
    lower, value = way_taken(risk=danger)
    assert lower == -1 and plain < value < plain + 1.0
    assert way_taken(visits=danger)[0] == -1
    assert way_taken(risk=danger[::-1].copy())[0] == 1


def test_risk_on_the_only_way_is_capped():
    rock = two_corridors() | ((np.abs(X) < 2.5) & (Y < 0))
    args = {"beyond": 500.0, "xy": (-4.0, 0.0)}
    values = [
        at(solve(rock, [4.0, 0.3], params=PARAMS._replace(risk_weight=w), risk=NONE + 1.0, **args).value, -4.0, 0.0)
        for w in (0.0, 3.0, 1e6)
    ]
    assert values[0] < values[1] < values[2] < values[0] * (1 + PARAMS.risk_cap) + 1.0


def test_a_goal_outside_is_reached_over_the_edge():
    goal = np.array([30.0, 10.0])
    got = solve(NONE > 0, goal)
    straight = np.hypot(X - goal[0], Y - goal[1])
    np.testing.assert_allclose(got.value, straight, rtol=METRIC - 1, atol=SIZE)
    assert bool(got.reachable)
    # what is known of the world beyond counts: the right edge leads nowhere
    rim = np.zeros((SHAPE[0] // 2, SHAPE[1] // 2))
    rim[:, -1] = 500.0
    points = downhill(solve(NONE > 0, [30.0, 0.0], beyond=rim).value, (2.0, 1.0))
    assert points[-1, 1] > 2.9 or points[-1, 1] < -2.9


def test_an_enclosed_goal_is_left_to_what_lies_beyond_the_window():
    ring = np.hypot(X - 2.0, Y)
    closed = (ring > 0.9) & (ring < 1.2)
    over_the_edge = solve(closed, [2.0, 0.0], beyond=80.0)
    assert bool(over_the_edge.reachable) and at(over_the_edge.value, -4.0, 0.0) > 79.0
    assert at(over_the_edge.value, 2.0, 0.0) < 0.3
    nowhere = solve(closed, [2.0, 0.0], beyond=grids.UNREACHABLE)
    assert not bool(nowhere.reachable)
    assert bool(solve(closed, [2.0, 0.0], xy=[2.3, 0.1], beyond=grids.UNREACHABLE).reachable)


def test_a_robot_that_is_walled_in_has_no_way():
    ring = np.hypot(X + 2.0, Y)
    got = solve((ring > 0.9) & (ring < 1.2), [3.0, 0.0], xy=[-2.0, 0.0])
    assert not bool(got.reachable)
    assert at(got.value, -2.0, 0.0) == grids.UNREACHABLE and at(got.value, 0.0, 0.0) < 5.0


def test_a_robot_on_a_closed_cell_may_leave_it():
    wall = X < -3.0
    xy = [-2.85, 0.05]  # 0.2 m from the wall: closer than any route may come
    got = solve(wall, [3.0, 0.0], xy=xy)
    assert bool(got.reachable) and at(got.value, *xy) < 7.0
    assert at(got.value, -2.85, 2.0) == grids.UNREACHABLE, "elsewhere along the wall it stays closed"


def test_straight_is_the_straight_distance():
    got = route.straight(SHAPE, f32(ORIGIN), RESOLUTION, f32([20.0, -3.0]))
    np.testing.assert_allclose(got, np.hypot(X - 20.0, Y + 3.0), rtol=1e-5)


def test_the_spec_is_checked():
    with pytest.raises(ValueError, match="must be >= 1, got 0, 5"):
        RouteSpec(pooling=0, max_iterations=5)


def test_one_trace_and_batches_equal_loops():
    once = jax.jit(chex.assert_max_traces(route.solve.__wrapped__, n=1), static_argnames=("spec", "resolution"))
    rock, goals = two_corridors(), [[4.0, 0.3], [3.0, -2.0], [20.0, 1.0]]
    sweep = [(g, PARAMS._replace(risk_weight=f32(k))) for k, g in enumerate(goals)]
    one = [solve(rock, g, params=p, risk=NONE + 0.3, solver=once) for g, p in sweep]
    params = jax.tree.map(lambda *a: f32(a), *[p for _, p in sweep])
    many = jax.vmap(lambda g, p: solve(rock, g, params=p, risk=NONE + 0.3))(f32(goals), params)
    chex.assert_trees_all_close(jax.tree.map(lambda *a: jnp.stack(a), *one), many, atol=1e-4)
