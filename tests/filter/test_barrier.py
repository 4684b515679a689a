"""Holes, panes and grass: the equations against loops, and an edge as beams see it."""

import jax.numpy as jnp
import numpy as np
import pytest

from drnav_jax.filter import FilterParams, FilterSpec, barrier, belief
from drnav_jax.filter.barrier import BarrierParams
from drnav_jax.types import Evidence, GridSpec

SHAPE, RES, ORIGIN, Z = (9, 14), 0.25, np.array([-1.0, -0.75]), 0.5
PARAMS = BarrierParams(depth=0.15, brink=0.2)
POSE = np.array([0.4, 0.3, 0.6])


def loop(points, valid):
    """Equation (1), beam by beam."""
    c, s = np.cos(POSE[2]), np.sin(POSE[2])
    fell, landed = np.zeros(SHAPE, bool), np.zeros(SHAPE, bool)

    def mark(field, x, y):
        at = np.array([POSE[0] + c * x - s * y, POSE[1] + s * x + c * y])
        j, i = np.floor((at - ORIGIN) / RES).astype(int)
        if 0 <= i < SHAPE[0] and 0 <= j < SHAPE[1]:
            field[i, j] = True

    for (x, y, z), ok in zip(points.astype(float), valid, strict=True):
        if not ok or not np.isfinite([x, y, z]).all():
            continue
        if z < -PARAMS.depth:  # the beam from (0, 0, Z) to (x, y, z) is at z = 0 here:
            share = Z / (Z - z)
            mark(fell, share * x, share * y)
            back = max(share - PARAMS.brink / np.hypot(x, y), 0.0)
            mark(fell, back * x, back * y)
        elif abs(z) <= PARAMS.depth:
            mark(landed, x, y)
    return fell, landed & ~fell


def test_falls_are_those_of_a_loop():
    rng = np.random.default_rng(0)
    points = rng.uniform([-2, -2, -1], [3, 3, 0.6], (60, 3)).astype(np.float32)
    points[5], points[6] = np.nan, [np.inf, 0, -1]
    valid = rng.random(60) < 0.8
    got = barrier.fallen(
        PARAMS, Z, SHAPE, jnp.asarray(ORIGIN, jnp.float32), RES, jnp.asarray(POSE, jnp.float32), jnp.asarray(points),
        jnp.asarray(valid),
    )  # fmt: skip
    want = loop(points, valid)
    assert want[0].sum() > 10 and want[1].sum() > 2
    for a, b in zip(got, want, strict=True):
        np.testing.assert_array_equal(np.asarray(a), b)


def test_beliefs_add_up_within_their_limit():
    hole = jnp.asarray([[0.0, 3.0, -3.4, 1.0]])
    fell, landed = jnp.asarray([[True, True, False, False]]), jnp.asarray([[False, False, True, False]])
    got = barrier.observe(PARAMS, hole, fell, landed)
    np.testing.assert_allclose(got, [[PARAMS.hole, PARAMS.limit, -PARAMS.limit, 1.0]], rtol=1e-6)
    said = jnp.asarray([[1.0, np.nan, -9.0, np.inf, -9.0, -9.0, 1.0]])
    taken = jnp.asarray([[False, False, True, False, False, False, False]])
    got = barrier.assimilate(PARAMS, jnp.asarray([[0.5, 0.5, 0.5, 0.5, 0.5, -2.0, -2.0]]), said, taken)
    np.testing.assert_allclose(got, [[1.5, 0.5, -PARAMS.limit, 0.5, 0.0, -2.0, -1.0]], rtol=1e-6)


@pytest.mark.parametrize(
    ("occupied", "hole", "sides", "shut"),
    [
        (False, 0.0, 0.0, False), (True, 0.0, 0.0, True),
        (True, 0.0, -3.0, False),  # grass
        (True, 0.0, -2.0, True),  # not sure enough
        (True, 0.1, -3.0, True),  # grass over a hole
        (False, 0.1, 0.0, True), (False, -3.0, 2.0, True),  # a pane
        (False, 0.0, 1.0, False),
    ],
)  # fmt: skip
def test_what_is_closed(occupied, hole, sides, shut):
    got = barrier.closed(BarrierParams(), jnp.asarray([[occupied]]), jnp.asarray([[hole]]), jnp.asarray([[sides]]))
    assert bool(got[0, 0]) is shut


def scan(edge, drop, xy, rings=16, azimuths=180):
    """Where beams from a LiDAR over flat ground end, which lies `drop` deeper at x > `edge`; in base_link, yaw 0."""
    up = np.linspace(-0.26, 0.26, rings)[:, None]
    around = np.linspace(-np.pi, np.pi, azimuths, endpoint=False)[None]
    ray = np.stack(np.broadcast_arrays(np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)), -1)
    ray = ray.reshape(-1, 3)[ray.reshape(-1, 3)[:, 2] < -1e-3]
    ground = ray * (Z / -ray[:, 2:])
    deep = xy[0] + ground[:, 0] > edge
    points = np.where(deep[:, None], ray * ((Z + drop) / -ray[:, 2:]), ground) + [0, 0, Z]
    near = np.linalg.norm(points, axis=1) < 12
    return jnp.asarray(points, jnp.float32), jnp.asarray(near)


@pytest.mark.parametrize("drop", [0.0, 1.0])
def test_the_edge_of_a_dock_is_closed_before_a_robot_falls(drop):
    """Driving at it from 6 m away, every step's map must have the edge closed at braking distance, and no ground."""
    spec = FilterSpec(grid=GridSpec(shape=(80, 128), resolution=0.1, stride=2), local_cells=8)
    params, edge = FilterParams(), 6.0
    params = params._replace(occupancy=params.occupancy._replace(sensor_z=Z))
    state = belief.init(spec, params, jnp.zeros(2))
    for x in np.arange(0.0, 5.2, 0.2):
        points, valid = scan(edge, drop, (x, 0.0))
        state, _ = belief.observe(spec, params, state, jnp.asarray([x, 0.0, 0.0]), points, valid)
        local = belief.local_map(spec, state, params)
        i, j = np.nonzero(np.asarray(local.closed))
        at = np.asarray(local.origin) + 0.1 * np.stack([j + 0.5, i + 0.5], -1)
        assert (at[:, 0] > edge - 0.25).all()  # nothing on the ground, but for `brink`
        ahead = at[(np.abs(at[:, 1]) < 0.3)]
        if drop and edge - x < 3.0:
            assert len(ahead) and ahead[:, 0].min() < edge + 0.35
        if not drop:
            assert not len(at)


def test_a_camera_opens_grass_and_closes_a_pane_and_both_move_with_the_window():
    spec = FilterSpec(grid=GridSpec(shape=(12, 16), resolution=0.1, stride=2), local_cells=8)
    params = FilterParams()
    state = belief.init(spec, params, jnp.zeros(2))
    seen = jnp.ones(spec.grid.shape, bool)
    state = state._replace(occupancy=state.occupancy.at[3, 4].set(2.0), seen=seen)
    says = jnp.zeros(spec.grid.shape).at[3, 4].set(-1.0).at[8, 9].set(1.0)
    nothing = Evidence(jnp.zeros(spec.grid.shape), jnp.zeros(spec.grid.shape), says)
    closed = []
    for _ in range(4):
        closed.append(np.asarray(belief.closed(params, state)))
        state = belief.assimilate(params, state, nothing, seen, 0.5)
    assert closed[0][3, 4] and not closed[0][8, 9]
    last = np.asarray(belief.closed(params, state))
    assert not last[3, 4] and last[8, 9] and last.sum() == 1
    moved = belief.move(spec, params, state, jnp.asarray([0.2, 0.0]))
    assert np.asarray(belief.closed(params, moved))[8, 7]
    forgot = belief.forget(spec, state, jnp.zeros(2), 5.0)
    assert not np.asarray(belief.closed(params, forgot)).any()
    for _ in range(6):  # taken back, and no further: a return there would count at once
        state = belief.assimilate(params, state, nothing._replace(blocked=-says), seen, 0.5)
    assert float(state.barrier[8, 9]) == 0.0 and float(state.barrier[3, 4]) > 0.0
    dumb = belief.assimilate(params, state, nothing._replace(blocked=None), seen, 0.5)
    np.testing.assert_array_equal(dumb.barrier, state.barrier)
