"""What is remembered beyond the window: kept when the window moves on, and priced at its edge."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reference
from drnav_jax import grids
from drnav_jax.planning import memory
from drnav_jax.planning.memory import MemorySpec
from drnav_jax.types import GridSpec

GRID = GridSpec(shape=(32, 48), resolution=0.1, stride=8)
SPEC = MemorySpec(cells=24, pooling=4, solve_every=1)
SIZE = 0.4
CORNER = (8, 6)  # of the window in the memory [cells]
ORIGIN = np.array([-2.4, -1.6], np.float32)

update = jax.jit(memory.update.__wrapped__, static_argnames=("spec", "resolution"))


def f32(values):
    return jnp.asarray(values, jnp.float32)


def write(state, free, origin=ORIGIN, goal=(0.2, 0.2), spec=SPEC):
    return update(spec, state, jnp.asarray(free), f32(origin), 0.1, f32(goal))


def test_it_equals_dijkstra_on_what_it_holds():
    rng = np.random.default_rng(0)
    free = np.kron(rng.random((8, 12)) < 0.8, np.ones((4, 4), bool)) & (rng.random(GRID.shape) < 0.6)
    goal = np.array([0.3, -0.5])
    held = write(memory.init(SPEC), free, goal=goal)
    cost, east, north = np.ones((24, 24)), np.ones((24, 24), bool), np.ones((24, 24), bool)
    away = np.zeros((24, 24))
    for i, j in np.ndindex(24, 24):
        centre = ORIGIN + (np.array([j - CORNER[1], i - CORNER[0]]) + 0.5) * SIZE
        away[i, j] = np.hypot(*(centre - goal))
        a, b = i - CORNER[0], j - CORNER[1]
        if not (0 <= a < 8 and 0 <= b < 12):
            continue
        block = free[4 * a : 4 * a + 4, 4 * b : 4 * b + 4]
        cost[i, j] = 1.0 if block.any() or away[i, j] < SIZE else 1e4
        if b < 11:
            east[i, j] = any(free[r, 4 * b + 3] and free[r, 4 * b + 4] for r in range(4 * a, 4 * a + 4))
        if a < 7:
            north[i, j] = any(free[4 * a + 3, c] and free[4 * a + 4, c] for c in range(4 * b, 4 * b + 4))
    initial = np.where((away < SIZE) & (cost < 1e4), away, 1e4)
    want = reference.dijkstra(cost, initial, SIZE, east, north)
    assert 5 < (cost == 1e4).sum() and (want == 1e4).sum() < 50
    np.testing.assert_allclose(held.value, want, rtol=1e-5)
    rim = memory.beyond(SPEC, held, GRID.shape, 2)
    assert rim.shape == (16, 24)
    np.testing.assert_allclose(rim, np.kron(want[8:16, 6:18], np.ones((2, 2))), rtol=1e-5)


def room():
    """The window's lower half is shut off from its upper half by a wall."""
    free = np.ones(GRID.shape, bool)
    free[12:16] = False
    return free


def test_what_rolls_out_of_the_window_is_remembered():
    held = write(memory.init(SPEC), room(), goal=(0.0, -1.4))
    up = jnp.asarray([16, 0], jnp.int32)
    moved = memory.shift(SPEC, held, up)
    here = ORIGIN + np.array([0.0, 1.6])
    later = write(moved, np.ones(GRID.shape, bool), origin=here, goal=(0.0, -1.4))
    rim = np.asarray(memory.beyond(SPEC, later, GRID.shape, 2))
    # Straight down from the window's lower edge the wall, remembered, stands in the way.
    straight = abs(here[1] + 0.2 + 1.4)
    assert rim[0, 12] > straight + 2.0
    blank = write(memory.init(SPEC), np.ones(GRID.shape, bool), origin=here, goal=(0.0, -1.4))
    assert np.asarray(memory.beyond(SPEC, blank, GRID.shape, 2))[0, 12] < 1.03 * straight + SIZE
    # ... until the window is there again and finds it gone
    back = write(memory.shift(SPEC, later, -up), np.ones(GRID.shape, bool), goal=(0.0, -1.4))
    assert bool(back.free.all()) and bool(back.east[:, :-1].all()) and bool(back.north[:-1].all())


def test_moving_there_and_back_loses_only_what_left_the_memory():
    held = write(memory.init(SPEC), np.random.default_rng(1).random(GRID.shape) < 0.1)
    by = jnp.asarray([8, -16], jnp.int32)
    moved = memory.shift(SPEC, held, by)
    back = memory.shift(SPEC, moved, -by)
    for name in ("free", "east", "north"):
        there = np.asarray(getattr(moved, name))
        np.testing.assert_array_equal(there[:-2, 4:], np.asarray(getattr(held, name))[2:, :-4])
        assert not there.all()
        a, b = np.asarray(getattr(held, name)), np.asarray(getattr(back, name))
        np.testing.assert_array_equal(a[2:, :-4], b[2:, :-4])
        assert b[:2].all() and b[:, -4:].all(), "unknown counts as free"


def test_it_is_solved_when_it_is_due():
    spec = MemorySpec(cells=24, pooling=4, solve_every=3)
    held = write(memory.init(spec), room(), spec=spec, goal=(1.8, 1.2))
    assert float(held.value.max()) > 0, "at once the first time"
    values = []
    for _ in range(6):
        held = write(held, np.ones(GRID.shape, bool), spec=spec, goal=(1.8, 1.2))
        values.append(np.asarray(held.value))
    changed = [bool((a != b).any()) for a, b in zip(values, values[1:], strict=False)]
    assert changed.count(True) == 1
    moved = memory.shift(spec, held, jnp.asarray([8, 0], jnp.int32))
    again = write(moved, np.ones(GRID.shape, bool), origin=ORIGIN + np.array([0.0, 0.8]), spec=spec, goal=(1.8, 1.2))
    assert float(jnp.abs(again.value - moved.value).max()) > 0, "and at once after a move"
    other = write(again, np.ones(GRID.shape, bool), origin=ORIGIN + np.array([0.0, 0.8]), spec=spec, goal=(-1.8, 1.2))
    assert float(jnp.abs(other.value - again.value).max()) > 1.0, "and for another goal"


def test_a_goal_beyond_the_memory_is_reached_over_its_rim():
    held = write(memory.init(SPEC), np.ones(GRID.shape, bool), goal=(40.0, 0.0))
    rim = np.asarray(memory.beyond(SPEC, held, GRID.shape, 2))
    np.testing.assert_allclose(rim[8, -1], 40.0 - 2.2, rtol=0.03, atol=SIZE)
    assert float(held.value.max()) < 60 < grids.UNREACHABLE


@pytest.mark.parametrize(
    ("spec", "grid", "message"),
    [
        ({"cells": 7}, GRID, "cells must be even"),
        ({"solve_every": 0}, GRID, "sizes >= 1"),
        ({"cells": 24, "pooling": 16}, GRID, "must divide the window's stride 8"),
        ({"cells": 24, "pooling": 1}, GRID, "must be a multiple of the route's, 2"),
        ({"cells": 8, "pooling": 4}, GRID, "smaller than the window"),
    ],
)
def test_a_memory_that_does_not_fit_is_refused(spec, grid, message):
    with pytest.raises(ValueError, match=message):
        memory.check(MemorySpec(**spec), grid, 2)


def test_one_trace_and_a_batch_equals_single_calls():
    once = jax.jit(chex.assert_max_traces(memory.update.__wrapped__, n=1), static_argnames=("spec", "resolution"))
    rng = np.random.default_rng(2)
    free, goals = jnp.asarray(rng.random((3, *GRID.shape)) < 0.6), f32(rng.uniform(-1, 1, (3, 2)))
    blank = memory.init(SPEC)
    one = [once(SPEC, blank, free[k], f32(ORIGIN), 0.1, goals[k]) for k in range(3)]
    many = jax.vmap(lambda f, g: update(SPEC, blank, f, f32(ORIGIN), 0.1, g))(free, goals)
    chex.assert_trees_all_close(jax.tree.map(lambda *a: jnp.stack(a), *one), many, rtol=1e-6)
