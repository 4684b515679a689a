"""The robot's bird's-eye grid against plain loops."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drnav_jax.models import bev
from drnav_jax.types import BevSpec, GridMap, LocalMap

SPEC = BevSpec(shape=(6, 9), resolution=0.2, ahead=0.5)
SHAPE, ORIGIN, CELL = (30, 24), (-1.3, 0.4), 0.1
POSES = [(0.013, 1.927, 0.0), (-0.217, 1.531, 0.7), (0.31, 2.42, -2.9), (40.0, 0.0, 1.0)]


def window(seed=0):
    rng = np.random.default_rng(seed)
    occupancy = rng.choice([-2.0, 0.0, 3.0], SHAPE).astype(np.float32)
    return LocalMap(
        occupancy=jnp.asarray(occupancy), seen=jnp.asarray(rng.random(SHAPE) < 0.6),
        origin=jnp.asarray(ORIGIN, jnp.float32), resolution=jnp.asarray(CELL, jnp.float32),
    )  # fmt: skip


def in_odom(pose, x, y):
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return pose[0] + c * x - s * y, pose[1] + s * x + c * y


def cell_at(x, y):
    j, i = int(np.floor((x - ORIGIN[0]) / CELL)), int(np.floor((y - ORIGIN[1]) / CELL))
    return (i, j) if 0 <= i < SHAPE[0] and 0 <= j < SHAPE[1] else None


def places(i, j):
    """base_link x, y of the centre of a cell."""
    x0, y0 = SPEC.origin
    return x0 + (j + 0.5) * SPEC.resolution, y0 + (i + 0.5) * SPEC.resolution


@pytest.mark.parametrize("pose", POSES)
def test_classes_are_those_of_a_loop(pose):
    local = window()
    seen, occupied = np.asarray(local.seen), np.asarray(local.occupancy) > 0
    expected = np.zeros(SPEC.shape, np.uint8)
    for i in range(SPEC.shape[0]):
        for j in range(SPEC.shape[1]):
            x, y = places(i, j)
            for dx in (-0.05, 0.05):
                for dy in (-0.05, 0.05):
                    at = cell_at(*in_odom(pose, x + dx, y + dy))
                    if at is not None and seen[at]:
                        expected[i, j] = max(expected[i, j], bev.OCCUPIED if occupied[at] else bev.FREE)
    got = np.asarray(bev.classes(SPEC, local, jnp.asarray(pose, jnp.float32)))
    assert got.dtype == np.uint8
    assert np.mean(got != expected) <= 0.04  # a place on the line between two cells may fall either way in float32
    if pose[0] < 10:
        assert {0, 1, 2} == set(np.unique(got).tolist())
    else:
        assert not got.any()  # far off the window nothing is known


@pytest.mark.parametrize("pose", POSES)
def test_resample_reads_the_cell_under_each_centre(pose):
    values = np.random.default_rng(1).random(SHAPE).astype(np.float32)
    grid = GridMap(jnp.asarray(values), jnp.asarray(ORIGIN, jnp.float32), jnp.asarray(CELL, jnp.float32))
    got = np.asarray(bev.resample(SPEC, grid, jnp.asarray(pose, jnp.float32), -1.0))
    wrong = 0
    for i in range(SPEC.shape[0]):
        for j in range(SPEC.shape[1]):
            at = cell_at(*in_odom(pose, *places(i, j)))
            wrong += got[i, j] != (-1.0 if at is None else values[at])
    assert wrong <= 2  # as above


def test_one_trace_for_all_poses():
    local = window()

    @jax.jit
    @chex.assert_max_traces(n=1)
    def classes(pose):
        return bev.classes(SPEC, local, pose)

    for pose in POSES:
        classes(jnp.asarray(pose, jnp.float32))
