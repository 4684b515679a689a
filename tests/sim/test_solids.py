"""What stops a robot, as rows: which of them are near, and how many there may be."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drnav_jax import worlds
from drnav_jax.bench.obstacles import random_obstacles
from drnav_jax.sim import solids
from drnav_jax.worlds import Material, make_world, signed_distance, stack_worlds, surfaces


def test_the_nearest_are_those_with_the_least_distance():
    world = jax.tree.map(np.asarray, random_obstacles(3, 60, extent=6.0))
    rows = jax.tree.map(lambda a: jnp.asarray(a[0]), solids.collect([world], 30, 30))
    rng = np.random.default_rng(0)
    find = jax.jit(functools.partial(solids.nearest, num_boxes=8, num_posts=4))
    for xy in rng.uniform(-6, 6, (20, 2)):
        near = find(rows, jnp.asarray(xy, jnp.float32))
        each = [signed_distance(make_world(boxes=[b]), xy)[0] for b in world.boxes]
        chosen = [signed_distance(make_world(boxes=[[*b, 0, 1]]), np.zeros(2))[0] for b in np.asarray(near.boxes)]
        np.testing.assert_allclose(np.sort(chosen), np.sort(each)[:8], atol=1e-4)
        each = [signed_distance(make_world(cylinders=[c]), xy)[0] for c in world.cylinders]
        chosen = [signed_distance(make_world(cylinders=[[*c, 0, 1]]), np.zeros(2))[0] for c in np.asarray(near.posts)]
        np.testing.assert_allclose(np.sort(chosen), np.sort(each)[:4], atol=1e-4)


def test_a_world_that_is_too_large_is_refused():
    occupied = np.indices((20, 20)).sum(0) % 2 == 0
    grid = worlds.from_grid(occupied, (0.0, 0.0), 0.1)
    assert solids.collect([grid], 200, 1).boxes.shape == (1, 224, 5)
    with pytest.raises(ValueError, match=r"has 200 boxes .* takes 199: raise num_boxes \(--mjx-boxes .*kinematic"):
        solids.collect([make_world(), grid], 199, 9)
    posts = make_world(cylinders=[[k, 0, 0.1, 0, 1] for k in range(5)])
    with pytest.raises(ValueError, match="has 5 cylinders, and the MJX model takes 4: raise num_posts, or"):
        solids.collect([posts], 9, 4)


def test_only_what_blocks_is_there_and_all_the_rest_is_far():
    boxes = [[k, 1.0, 0.3, 0.5, 0.25, -2.0 * k, 1.0] for k in range(3)]
    posts = [[k, 2.0, 0.2, 0.0, 1.0] for k in range(3)]
    kinds = [Material.GRASS, Material.DROP, Material.GLASS]
    world = make_world(boxes, posts, box_surfaces=surfaces(3, kinds), cylinder_surfaces=surfaces(3, kinds))
    found = solids.collect([world, make_world()], 2, 2)
    assert found.boxes.shape == (2, 32, 5) and found.posts.shape == (2, 32, 3)
    np.testing.assert_allclose(found.boxes[0, :2], np.array(boxes, np.float32)[1:, :5])
    np.testing.assert_allclose(found.posts[0, :2], np.array(posts, np.float32)[1:, :3])
    assert (found.boxes[0, 2:, :2] == worlds.FAR).all() and (found.posts[1, :, :2] == worlds.FAR).all()
    # Rows that filled up a batch fill up nothing here.
    padded = jax.tree.map(lambda a: a[1], stack_worlds([world, make_world()]))
    assert (solids.collect([padded], 2, 2).boxes[..., 0] == worlds.FAR).all()
