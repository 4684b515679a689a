"""The rolling window: moved by whole cells, never blurred, unknown where it is new."""

import chex
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings

from drnav_jax.filter import FilterParams, FilterSpec, FilterState, belief
from drnav_jax.types import Evidence, GridSpec

SPEC = FilterSpec(grid=GridSpec(shape=(12, 16), resolution=0.1, stride=2), local_cells=8)
PARAMS = FilterParams()
L0 = np.float32(np.log(np.float32(0.06)) - np.log1p(np.float32(-0.06)))


def random_state(seed, xy):
    rng = np.random.default_rng(seed)
    state = belief.init(SPEC, PARAMS, jnp.asarray(xy, jnp.float32))
    seen = rng.random(SPEC.grid.shape) < 0.5
    return FilterState(
        occupancy=jnp.asarray(np.where(seen, rng.normal(size=seen.shape), 0), jnp.float32),
        seen=jnp.asarray(seen),
        surface=jnp.asarray(rng.random(state.surface.shape), jnp.float32),
        dead_end=jnp.asarray(rng.normal(size=seen.shape), jnp.float32),
        corner=state.corner,
        hole=jnp.asarray(rng.normal(size=seen.shape), jnp.float32),
        barrier=jnp.asarray(rng.normal(size=seen.shape), jnp.float32),
    )


def by_lattice_cell(state):
    """(row, column) on the odom lattice -> what is believed there."""
    corner = np.asarray(state.corner)
    fields = [np.asarray(f) for f in (state.occupancy, state.seen, state.dead_end, state.hole, state.barrier)]
    return {
        (int(corner[0]) + i, int(corner[1]) + j): tuple(f[i, j] for f in fields) for i, j in np.ndindex(SPEC.grid.shape)
    }


@settings(max_examples=30)
@given(
    st.integers(0, 1000),
    st.tuples(st.floats(-3, 3), st.floats(-3, 3)),
    st.tuples(st.floats(-2, 2), st.floats(-2, 2)),
)
def test_the_window_moves_and_never_blurs(seed, at, by):
    state = random_state(seed, at)
    to = jnp.asarray(np.add(at, by), jnp.float32)
    moved = belief.move(SPEC, PARAMS, state, to)
    old, new = by_lattice_cell(state), by_lattice_cell(moved)
    for cell, values in new.items():
        if cell in old:
            assert values == old[cell]
        else:
            assert values[:2] == (0, False) and values[2] == pytest.approx(L0, abs=1e-5) and values[3:] == (0, 0)
    # The robot is within half a stride of the middle.
    origin = np.asarray(belief.local_map(SPEC, moved).origin)
    middle = origin + np.array([16, 12]) * 0.1 / 2
    assert np.abs(np.asarray(to) - middle).max() <= 0.1 + 1e-4
    chex.assert_trees_all_equal(belief.move(SPEC, PARAMS, moved, to), moved)


def test_init_knows_nothing():
    state = belief.init(SPEC, PARAMS, jnp.asarray([3.0, -2.0], jnp.float32))
    assert not bool(state.seen.any()) and not bool(state.occupancy.any())
    np.testing.assert_allclose(np.asarray(state.dead_end), L0, atol=1e-5)
    local = belief.local_map(SPEC, state)
    assert local.occupancy.shape == (12, 16)
    np.testing.assert_allclose(np.asarray(local.origin), [3.0 - 0.8, -2.0 - 0.6], atol=0.11)
    assert state.corner.dtype == jnp.int32 and state.occupancy.dtype == jnp.float32


def ring(radius):
    angle = np.linspace(-np.pi, np.pi, 180, endpoint=False) + np.pi / 180
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(180, 0.5)], -1)
    return jnp.asarray(points, jnp.float32)


def test_observe_moves_and_marks():
    state = belief.init(SPEC, PARAMS, jnp.zeros(2, jnp.float32))
    pose = jnp.asarray([5.0, 4.0, 1.0], jnp.float32)
    state, visible = belief.observe(SPEC, PARAMS, state, pose, ring(0.5), jnp.ones(180, bool))
    np.testing.assert_array_equal(np.asarray(visible), np.asarray(state.seen))
    occupied = np.argwhere(np.asarray(state.occupancy) > 0) + np.asarray(state.corner)
    distance = np.hypot(*((occupied[:, ::-1] + 0.5) * 0.1 - [5.0, 4.0]).T)
    assert len(occupied) > 20 and np.abs(distance - 0.5).max() < 0.1
    evidence = Evidence(p_dead=jnp.full((12, 16), 0.9), confidence=jnp.ones((12, 16)))
    after = belief.assimilate(PARAMS, state, evidence, visible, 0.1)
    raised = np.asarray(after.dead_end > state.dead_end)
    np.testing.assert_array_equal(raised, np.asarray(visible))
    chex.assert_trees_all_equal(after._replace(dead_end=state.dead_end), state)


def test_batch_equals_loop_and_traces_once():
    rng = np.random.default_rng(0)
    poses = jnp.asarray(rng.uniform(-1, 1, (4, 3)), jnp.float32)
    valid = jnp.asarray(rng.random((4, 180)) < 0.9)
    start = random_state(0, (0.0, 0.0))
    once = chex.assert_max_traces(belief.observe.__wrapped__, n=1)
    observe = jax.jit(once, static_argnames="spec")
    loop = [observe(SPEC, PARAMS, start, poses[i], ring(0.4), valid[i]) for i in range(4)]
    batch = jax.vmap(lambda p, v: belief.observe(SPEC, PARAMS, start, p, ring(0.4), v))(poses, valid)
    for i, one in enumerate(loop):
        chex.assert_trees_all_close(jax.tree.map(lambda x, i=i: x[i], batch), one, atol=1e-6)

    move = jax.jit(chex.assert_max_traces(belief.move.__wrapped__, n=1), static_argnames="spec")
    for pose in poses:
        move(SPEC, PARAMS, start, pose[:2])


def test_too_few_bearings_are_refused():
    with pytest.raises(ValueError, match="num_bearings must be >= 8"):
        FilterSpec(num_bearings=4)


def test_what_is_forgotten_is_a_square_and_nothing_else():
    state = random_state(3, (0.3, -0.2))
    xy = jnp.asarray([0.32, -0.25], jnp.float32)
    after = belief.forget(SPEC, state, xy, 0.25)
    corner, res = np.asarray(state.corner), SPEC.grid.resolution
    near = np.zeros(SPEC.grid.shape, bool)
    for i, j in np.ndindex(near.shape):
        x, y = (corner[1] + j + 0.5) * res, (corner[0] + i + 0.5) * res
        near[i, j] = max(abs(x - 0.32), abs(y + 0.25)) <= 0.25
    assert 16 <= near.sum() <= 36
    np.testing.assert_array_equal(after.occupancy, np.where(near, 0, state.occupancy))
    np.testing.assert_array_equal(after.seen, np.asarray(state.seen) & ~near)
    np.testing.assert_array_equal(after.dead_end, state.dead_end)
    top, left = belief.local_corner(SPEC)
    fine = np.kron(near[top : top + 8, left : left + 8], np.ones((2, 2), bool))
    np.testing.assert_array_equal(after.surface, np.where(fine, 0, state.surface))
    chex.assert_trees_all_equal(belief.forget(SPEC, state, xy, -1.0), state)
