"""Obstacles at random, and the same in native MuJoCo."""

import importlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from drnav_jax.worlds.world import World, make_world


def random_obstacles(seed: int, num_obstacles: int, extent: float = 20.0, gap: float = 0.5) -> World:
    """A world of boxes at all angles and cylinders, half of each, around a free origin.

    Args:
        seed: Of the world.
        num_obstacles: How many in all.
        extent: Half the edge of the square that they fill [m].
        gap: Free distance around the origin [m].
    """
    rng = np.random.default_rng(seed)
    num_boxes = num_obstacles // 2
    half = rng.uniform(0.1, 1.5, (num_obstacles, 2))
    radius = np.where(np.arange(num_obstacles) < num_boxes, np.hypot(*half.T), half[:, 0])
    centre = rng.uniform(-extent, extent, (num_obstacles, 2))
    near = np.hypot(*centre.T) < radius + gap
    centre[near] *= ((radius + gap + extent / 2) / np.hypot(*centre.T))[near, None]
    low = np.where(rng.random(num_obstacles) < 0.25, rng.uniform(0.0, 1.0, num_obstacles), 0.0)
    z = np.stack([low, low + rng.uniform(0.2, 2.5, num_obstacles)], axis=1)
    yaw = rng.uniform(-np.pi, np.pi, (num_obstacles, 1))
    boxes = np.concatenate([centre, yaw, half, z], axis=1)[:num_boxes]
    cylinders = np.concatenate([centre, half[:, :1], z], axis=1)[num_boxes:]
    return jax.tree.map(jnp.asarray, make_world(boxes, cylinders))


def native_scene(world: World) -> tuple[Any, Any]:
    """The module `mujoco`, and an `MjSpec` with the ground (geom 0), the boxes and the cylinders of a world."""
    # Imported when it is used, and by name: pyright does not see into its C++ module.
    mujoco: Any = importlib.import_module("mujoco")
    scene = mujoco.MjSpec()
    scene.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[200, 200, 1])
    for x, y, yaw, half_x, half_y, low, high in np.asarray(world.boxes, float):
        scene.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[x, y, (low + high) / 2],
            size=[half_x, half_y, (high - low) / 2],
            quat=[np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)],
        )
    for x, y, radius, low, high in np.asarray(world.cylinders, float):
        scene.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            pos=[x, y, (low + high) / 2],
            size=[radius, (high - low) / 2, 0],
        )
    return mujoco, scene
