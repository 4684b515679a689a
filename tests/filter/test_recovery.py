"""Recovery points: where they are found, and how the set merges, forgets and overflows."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drnav_jax.filter import RecoveryParams, RecoveryPoints, RecoverySpec, recovery
from drnav_jax.types import GridSpec, LocalMap

GRID = GridSpec(shape=(100, 140), resolution=0.1)
SPEC = RecoverySpec(grid=GRID, capacity=12)
PARAMS = RecoveryParams()
ORIGIN = np.array([-3.0, 2.0], np.float32)
merge = jax.jit(recovery.merge)  # as inside `observe`


def tee():
    """A T of 1.6 m wide corridors; the junction is at (7, 7) m from the window's corner."""
    free = np.zeros(GRID.shape, bool)
    free[62:78, 5:135] = True
    free[5:62, 62:78] = True
    return free


def belief(free, seen=None):
    return LocalMap(
        occupancy=jnp.asarray(np.where(free, -2.0, 2.0), jnp.float32),
        seen=jnp.ones(GRID.shape, bool) if seen is None else jnp.asarray(seen),
        origin=jnp.asarray(ORIGIN),
        resolution=jnp.float32(0.1),
    )


def calm():
    return jnp.full(GRID.shape, 0.06, jnp.float32)


def observe(points, free, time=0.0, p_dead=None, reachable=None, seen=None, params=PARAMS):
    return recovery.observe(
        SPEC,
        params,
        points,
        belief(free, seen),
        calm() if p_dead is None else jnp.asarray(p_dead, jnp.float32),
        jnp.asarray(free if reachable is None else reachable),
        jnp.float32(time),
    )


def as_set(xy, rank, last_seen, spec=SPEC):
    n, m = len(xy), spec.capacity
    fill = (0, m - n)
    return RecoveryPoints(
        xy=jnp.asarray(np.pad(np.asarray(xy, np.float32), (fill, (0, 0)))),
        rank=jnp.asarray(np.pad(np.asarray(rank, np.float32), fill)),
        last_seen=jnp.asarray(np.pad(np.asarray(last_seen, np.float32), fill)),
        valid=jnp.asarray(np.arange(m) < n),
    )


def valid_rows(points):
    keep = np.asarray(points.valid)
    return np.asarray(points.xy)[keep], np.asarray(points.rank)[keep]


def test_openness_equals_plain_loops():
    rng = np.random.default_rng(0)
    passable = rng.random((20, 26)) < 0.93
    for n in (8, 36):
        got = np.asarray(recovery.openness(jnp.asarray(passable), n, 5))
        for i, j in np.ndindex(passable.shape):
            taken = []
            for d in range(n):
                u, v = np.sin(2 * np.pi * d / n), np.cos(2 * np.pi * d / n)
                cells = [(i + round(k * u), j + round(k * v)) for k in range(6)]
                free = all(0 <= a < 20 and 0 <= b < 26 and passable[a, b] for a, b in cells)
                if free and (not taken or d - taken[-1] >= n / 6):
                    taken.append(d)
            if len(taken) > 1 and n - taken[-1] + taken[0] < n / 6:
                taken.pop()
            assert got[i, j] == len(taken)
        assert got.max() == n // np.ceil(n / 6)


def test_a_junction_is_found_and_ranks_first():
    points = observe(recovery.init(SPEC), tee())
    xy, rank = valid_rows(points)
    away = np.linalg.norm(xy - ORIGIN - [7, 7], axis=-1)
    assert away.min() < 0.5 and (np.diff(rank) <= 0).all()
    assert set(rank[away < 2]) == {3} and set(rank[away > 2.5]) == {2}
    free = tee()
    for at in xy - ORIGIN:  # in the middle of the corridors, away from their ends
        i, j = int(at[1] / 0.1), int(at[0] / 0.1)
        assert free[i - 6 : i + 7, j - 6 : j + 7].all()
    gaps = np.linalg.norm(xy[:, None] - xy[None], axis=-1) + 10 * np.eye(len(xy))
    assert gaps.min() >= 1.0


@pytest.mark.parametrize("why", ["unknown", "unreachable", "dead end"])
def test_no_points_where_one_should_not_go(why):
    free, stem = tee(), np.zeros(GRID.shape, bool)
    stem[:60] = True
    data = {
        "unknown": {"seen": ~stem},
        "unreachable": {"reachable": free & ~stem},
        "dead end": {"p_dead": np.where(stem, 0.9, 0.06)},
    }
    xy, _ = valid_rows(observe(recovery.init(SPEC), free, **data[why]))
    assert len(xy) > 3 and (xy[:, 1] - ORIGIN[1] > 6.0).all()
    xy, _ = valid_rows(observe(recovery.init(SPEC), free))
    assert (xy[:, 1] - ORIGIN[1] < 6.0).any()


def test_seen_again_is_the_same_point():
    first = observe(recovery.init(SPEC), tee(), time=1.0)
    again = observe(first, tee(), time=2.0)
    chex.assert_trees_all_equal(again._replace(last_seen=first.last_seen), first)
    assert (np.asarray(again.last_seen)[np.asarray(again.valid)] == 2.0).all()


def test_merging_keeps_the_higher_rank_and_the_latest_sighting():
    points = as_set([[0, 0], [5, 0], [9, 9]], [4, 9, 3], [1, 1, 1])
    merged = merge(
        PARAMS,
        points,
        jnp.asarray([[0.5, 0.0], [5.0, 0.9], [20.0, 0.0], [30.0, 0.0]], jnp.float32),
        jnp.asarray([7, 2, 5, 8], jnp.float32),
        jnp.asarray([True, True, True, False]),
        10.0,
    )
    got = {tuple(map(float, p)): (float(r), float(t)) for p, r, t in zip(*merged[:3], strict=True)}
    valid = np.asarray(merged.valid)
    assert valid.sum() == 4 and valid[:4].all()
    del got[0.0, 0.0]
    assert got == {
        (5.0, 0.0): (9.0, 10.0),  # the remembered one, seen again
        (0.5, 0.0): (7.0, 10.0),  # replaced by a better one
        (20.0, 0.0): (5.0, 10.0),  # new
        (9.0, 9.0): (3.0, 1.0),  # not seen
    }


def test_when_full_the_lowest_rank_goes_and_then_the_oldest():
    xy = [[3 * i, 0] for i in range(SPEC.capacity)]
    points = as_set(xy, [5] * 11 + [4], [float(i) for i in range(12)])
    new = jnp.asarray([[0.0, 50.0], [0.0, 60.0], [0.0, 70.0]], jnp.float32)
    rank = jnp.asarray([6, 5, 2], jnp.float32)
    merged = merge(PARAMS, points, new, rank, jnp.ones(3, bool), 20.0)
    kept = {tuple(map(float, p)) for p in merged.xy}
    assert bool(merged.valid.all())
    assert {(0.0, 50.0), (0.0, 60.0)} <= kept and (0.0, 70.0) not in kept
    assert (33.0, 0.0) not in kept, "rank 4"
    assert (0.0, 0.0) not in kept and (3.0, 0.0) in kept, "the oldest of rank 5"


def test_taking_in_order_equals_a_plain_loop():
    rng = np.random.default_rng(0)
    for n in (1, 7, 40):
        better = np.tril(rng.random((n, n)) < 0.15, -1)
        want = np.ones(n, bool)
        for i in range(n):
            want[i] = not (better[i] & want).any()
        np.testing.assert_array_equal(np.asarray(recovery._greedy(jnp.asarray(better))), want)


def test_points_are_forgotten_in_time_but_outlive_the_window():
    far = as_set([[100, 100]], [5], [0])
    wall = np.zeros(GRID.shape, bool)
    assert int(observe(far, wall, time=299.0).valid.sum()) == 1
    assert int(observe(far, wall, time=301.0).valid.sum()) == 0
    swept = PARAMS._replace(max_age=60.0)
    assert int(observe(far, wall, time=61.0, params=swept).valid.sum()) == 0


def test_a_point_that_proves_bad_is_dropped():
    at = ORIGIN + [7.05, 3.05]
    points, free, none = as_set([at], [5], [0]), tee(), np.zeros(GRID.shape, bool)
    assert int(observe(points, free, reachable=none).valid.sum()) == 1
    assert int(observe(points, none, reachable=none).valid.sum()) == 0  # occupied
    risky = np.full(GRID.shape, 0.8)
    assert int(observe(points, free, p_dead=risky, reachable=none).valid.sum()) == 0
    unseen = observe(points, none, reachable=none, seen=none)  # nothing is known: it stays
    assert int(unseen.valid.sum()) == 1


def test_batch_equals_loop_and_traces_once():
    rng = np.random.default_rng(0)
    frees = [tee() & (rng.random(GRID.shape) < 0.9995) for _ in range(3)]
    loop = [observe(recovery.init(SPEC), f, time=float(i)) for i, f in enumerate(frees)]
    batch = jax.vmap(
        lambda occupancy, reachable, time: recovery.observe(
            SPEC,
            PARAMS,
            recovery.init(SPEC),
            belief(tee())._replace(occupancy=occupancy),
            calm(),
            reachable,
            time,
        )
    )(
        jnp.stack([belief(f).occupancy for f in frees]),
        jnp.asarray(np.stack(frees)),
        jnp.arange(3, dtype=jnp.float32),
    )
    for i, one in enumerate(loop):
        chex.assert_trees_all_close(jax.tree.map(lambda x, i=i: x[i], batch), one, atol=1e-5)

    once = jax.jit(chex.assert_max_traces(recovery.observe.__wrapped__, n=1), static_argnames="spec")
    points = recovery.init(SPEC)
    for i, f in enumerate(frees):
        points = once(SPEC, PARAMS, points, belief(f), calm(), jnp.asarray(f), jnp.float32(i))


@pytest.mark.parametrize(
    ("bad", "says"),
    [
        ({"capacity": 0}, "capacity"),
        ({"num_directions": 4}, "num_directions must be 8..200"),
        ({"open_distance": 0.0}, "open_distance must be > 0 m"),
        ({"block": 5}, "block must be an even number"),
    ],
)
def test_bad_specs_are_refused(bad, says):
    with pytest.raises(ValueError, match=says):
        RecoverySpec(**bad)
