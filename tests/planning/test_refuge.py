"""Ranking recovery points: the ways there against Dijkstra, the worth term by term, and what no retreat may lead to."""

import jax.numpy as jnp
import numpy as np
import pytest

from drnav_jax.grids import UNREACHABLE
from drnav_jax.planning import refuge
from drnav_jax.planning.refuge import RefugeParams
from drnav_jax.types import GridMap
from reference import dijkstra

SIZE, ORIGIN = 0.2, np.array([-2.0, -1.0], np.float32)  # window x -2..3.2, y -1..2.6
SHAPE = (18, 26)
PARAMS = RefugeParams()


def f32(values):
    return jnp.asarray(values, jnp.float32)


def cell(x, y):
    return int(np.floor((y - ORIGIN[1]) / SIZE)), int(np.floor((x - ORIGIN[0]) / SIZE))


def centres():
    return np.meshgrid(
        ORIGIN[0] + (np.arange(SHAPE[1]) + 0.5) * SIZE, ORIGIN[1] + (np.arange(SHAPE[0]) + 0.5) * SIZE
    )


def ways(cost, free, pose=(0.1, 0.1, 0.0), params=PARAMS):
    one = jnp.ones(SHAPE, bool)
    return np.asarray(refuge.ways(params, f32(cost), one, one, jnp.asarray(free), f32(ORIGIN), SIZE, f32(pose)))


def test_the_way_leads_over_known_free_cells_at_their_price():
    rng = np.random.default_rng(0)
    cost, free = 1 + rng.random(SHAPE), rng.random(SHAPE) > 0.2
    cost[:, 18] = UNREACHABLE  # a wall: nothing lies beyond it
    got = ways(cost, free, params=PARAMS._replace(turning=0.0))
    x, y = centres()
    away = np.hypot(x - 0.1, y - 0.1)
    open_cells = (free | (away <= 2 * SIZE + 1e-6)) & (cost < UNREACHABLE)
    initial = np.where(open_cells & (away <= 2 * SIZE + 1e-6) & (away > 0.5 * SIZE), away, UNREACHABLE)
    own = away <= 0.75 * SIZE
    want = dijkstra(np.where(open_cells & ~own, cost, UNREACHABLE), initial, SIZE)
    np.testing.assert_allclose(np.minimum(got, UNREACHABLE), np.minimum(want, UNREACHABLE), rtol=1e-4)
    assert (got[:, 19:] == UNREACHABLE).all() and (got[:, :18] < UNREACHABLE).any()


def test_turning_before_driving_off_is_paid_once():
    cost, free = np.ones(SHAPE), np.ones(SHAPE, bool)
    ahead, behind = cell(2.1, 0.1), cell(-1.9, 0.1)
    plain, turned = ways(cost, free, params=PARAMS._replace(turning=0.0)), ways(cost, free)
    assert plain[ahead] == pytest.approx(plain[behind], abs=0.05) == pytest.approx(2.0, abs=0.05)
    assert turned[ahead] == pytest.approx(plain[ahead], abs=0.02)
    # it may drive off at an angle and bend round: dearer than straight, cheaper than the whole turn plus the way
    extra = turned[behind] - plain[behind]
    assert 0.5 * PARAMS.turning * np.pi < extra <= PARAMS.turning * np.pi + 1e-4


POINTS = np.array([[2.0, 0.1], [-1.0, 1.5], [0.5, 0.1], [2.9, 2.3]], np.float32)


def worth(params=PARAMS, rank=(3, 2, 6, 4), age=(0, 10, 0, 5), valid=(1, 1, 1, 1), visits=None, way=None):
    x, y = centres()
    fields = {
        "way": np.hypot(x - 0.1, y - 0.1) if way is None else way, "onward": np.hypot(x - 3, y),
        "clear": 0.2 + 0.3 * (y + 1), "visits": np.zeros(SHAPE) if visits is None else visits,
    }  # fmt: skip
    fields = {k: GridMap(f32(v), f32(ORIGIN), SIZE) for k, v in fields.items()}
    got = refuge.choose(
        params, f32(POINTS), f32(rank), f32(age), jnp.asarray(valid, bool), xy=f32([0.1, 0.1]), **fields
    )
    return got, {k: np.asarray(v.values) for k, v in fields.items()}


def test_the_worth_is_the_sum_of_its_terms():
    visits = np.zeros(SHAPE)
    visits[cell(*POINTS[1])] = 0.7
    got, fields = worth(visits=visits)
    for k, (rank, age) in enumerate(zip((3, 2, 6, 4), (0, 10, 0, 5), strict=True)):
        at = {name: float(values[cell(*POINTS[k])]) for name, values in fields.items()}
        want = (
            rank + min(at["clear"], 1.0) - at["way"] - 0.5 * at["onward"] - 0.02 * age - 10.0 * at["visits"]
        )
        if k == 2:  # 0.4 m away: no retreat
            assert np.isneginf(got.worth[k])
        else:
            assert float(got.worth[k]) == pytest.approx(want, rel=1e-5)
    assert bool(got.found) and int(np.argmax(got.worth)) == 0
    np.testing.assert_array_equal(got.xy, POINTS[0])


@pytest.mark.parametrize(
    "change,choice",
    [
        ({"rank": (1, 6, 1, 1)}, 1),  # more open directions
        ({"age": (300, 0, 0, 300)}, 1),  # seen long ago
        ({"valid": (0, 1, 1, 1)}, 3),
        ({"params": PARAMS._replace(onward=0.0, way=0.0)}, 3),  # wherever it is
    ],
)
def test_each_term_can_decide(change, choice):
    assert int(np.argmax(worth(**change)[0].worth)) == choice


def test_without_a_way_there_is_no_refuge():
    got, _ = worth(way=np.full(SHAPE, UNREACHABLE))
    assert not bool(got.found)
    np.testing.assert_allclose(got.xy, [0.1, 0.1])
    assert np.isneginf(np.asarray(got.worth)).all()
