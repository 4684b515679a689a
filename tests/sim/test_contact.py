"""Clearance against distances to densely sampled surfaces."""

import chex
import jax
import jax.numpy as jnp
import numpy as np

from drnav_jax import sim
from drnav_jax.bench.obstacles import random_obstacles
from drnav_jax.worlds.world import HEADROOM, World, from_grid, make_world, rasterise, stack_worlds

SAMPLES = 4000  # points per obstacle: about 1 mm apart
TOLERANCE = 1e-4  # [m] the gap between two samples seen from 0.05 m, and float32


def outlines(world: World) -> np.ndarray:
    """Points on the sides of all boxes and cylinders `[n, 2]`."""
    u = np.linspace(-1, 1, SAMPLES // 4)
    one = np.ones_like(u)
    edges = [(u, one), (u, -one), (one, u), (-one, u)]
    square = np.concatenate([np.stack(side, axis=1) for side in edges])
    a = np.linspace(-np.pi, np.pi, SAMPLES)
    circle = np.stack([np.cos(a), np.sin(a)], axis=1)
    points = []
    for x, y, yaw, half_x, half_y, _, _ in np.asarray(world.boxes, float):
        turn = np.asarray([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        points.append([x, y] + (square * [half_x, half_y]) @ turn)
    for x, y, radius, _, _ in np.asarray(world.cylinders, float):
        points.append([x, y] + radius * circle)
    return np.concatenate(points)


def test_boxes_and_cylinders():
    world = random_obstacles(0, 16, extent=6.0)
    surface = outlines(world)
    points = np.random.default_rng(0).uniform(-6, 6, (300, 2)).astype(np.float32)
    here = jax.tree.map(jnp.asarray, world)
    got = np.asarray(jax.vmap(lambda xy: sim.clearance(here, xy))(jnp.asarray(points)))
    corners = (points - 0.005).tolist()  # of a grid of one cell around each point
    within = np.asarray([rasterise(world, tuple(c), (1, 1), 0.01)[0, 0] for c in corners])
    assert within.any() and not within.all()
    np.testing.assert_array_equal(got < 0, within)
    nearest = np.asarray([np.min(np.hypot(*(surface - p).T)) for p in points.astype(float)])
    clear = ~within & (nearest > 0.05)
    np.testing.assert_allclose(got[clear], nearest[clear], atol=TOLERANCE)


def test_the_depth_inside_a_box_and_a_cylinder():
    box = np.asarray([[1.0, 2.0, np.pi / 2, 3.0, 1.0, 0.0, 1.0]], np.float32)
    post = np.asarray([[8.0, 2.0, 0.5, 0.0, 1.0]], np.float32)
    world = jax.tree.map(jnp.asarray, make_world(box, post))
    for xy, depth in (([1.7, 2.0], -0.3), ([1.0, 4.9], -0.1), ([8.1, 2.0], -0.4)):
        np.testing.assert_allclose(sim.clearance(world, jnp.asarray(xy)), depth, atol=1e-6)


def test_grid_maps_within_and_beyond_the_edge():
    occupied = np.zeros((30, 40), bool)
    occupied[10:12, 20:] = True  # y in 1.0..1.2, from x = 2.0 to the edge at 4.0
    world = jax.tree.map(jnp.asarray, from_grid(occupied, (0.0, 0.0), 0.1))
    for xy, expected in (([3.0, 2.05], 0.85), ([3.0, 1.1], -0.05), ([0.55, 1.05], 1.45)):
        np.testing.assert_allclose(sim.clearance(world, jnp.asarray(xy)), expected, atol=1e-5)
    # Beyond the edge: never more than the true distance, and the distance where it is straight.
    np.testing.assert_allclose(sim.clearance(world, jnp.asarray([5.0, 1.1])), 1.0, atol=1e-5)
    rng = np.random.default_rng(0)
    cells = np.argwhere(occupied)[:, ::-1]
    for xy in rng.uniform((4.0, -3.0), (8.0, 6.0), (50, 2)).astype(np.float32):
        gap = np.maximum(np.abs(xy - (cells + 0.5) * 0.1) - 0.05, 0)
        true = np.min(np.hypot(*gap.T))
        # The field measures from centres: past a corner it may say half a cell's diagonal less 1/2.
        assert 0 < float(sim.clearance(world, jnp.asarray(xy))) <= true + 0.021


def test_nothing_near():
    empty = jax.tree.map(jnp.asarray, make_world())
    assert np.isinf(sim.clearance(empty, jnp.zeros(2)))


def test_padding_does_not_count_and_a_batch_compiles_once():
    worlds = [random_obstacles(seed, n) for seed, n in ((0, 3), (1, 12))]
    batch = jax.tree.map(jnp.asarray, stack_worlds(worlds))

    @jax.jit
    @chex.assert_max_traces(n=1)
    def both(xy):
        return jax.vmap(lambda world: sim.clearance(world, xy))(batch)

    for xy in (jnp.zeros(2), jnp.asarray([3.0, -2.0])):
        single = [sim.clearance(jax.tree.map(jnp.asarray, w), xy) for w in worlds]
        np.testing.assert_allclose(both(xy), np.asarray(single), atol=1e-6)


def test_what_a_robot_passes_under_is_no_contact():
    solids = [[1, 0, 0, 0.5, 0.5, HEADROOM, 2.5]], [[-1, 0, 0.5, HEADROOM, 2.5]]
    assert np.isinf(sim.clearance(jax.tree.map(jnp.asarray, make_world(*solids)), jnp.zeros(2, jnp.float32)))
