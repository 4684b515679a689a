"""Times of the parts next to their rivals, measured in turn within one run."""

import importlib
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from drnav_jax.sim import LidarParams, LidarSpec, cast
from drnav_jax.worlds.world import World, no_field


def _interleaved(calls: list[Callable[[], object]], repeats: int) -> list[float]:
    """Median time [s] of each call; the calls take turns, so that a slow moment hits them all."""
    times: list[list[float]] = [[] for _ in calls]
    for k in range(repeats + 1):
        for call, spent in zip(calls, times, strict=True):
            start = time.perf_counter()
            jax.block_until_ready(call())
            if k:  # the first round warms up
                spent.append(time.perf_counter() - start)
    return [statistics.median(spent) for spent in times]


def random_obstacles(
    seed: int, num_obstacles: int, extent: float = 20.0, gap: float = 0.5
) -> World:
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
    return World(
        boxes=jnp.asarray(boxes, jnp.float32),
        cylinders=jnp.asarray(cylinders, jnp.float32),
        field=no_field(),
    )


def native_lidar(
    spec: LidarSpec, params: LidarParams, world: World, pose: np.ndarray
) -> Callable[[], np.ndarray]:
    """The rays of `sim.cast` in native MuJoCo (`mj_multiRay`), ready to be cast again and again.

    Args:
        spec: The beams.
        params: Range and mounting height.
        world: Boxes and cylinders; a field is not looked at.
        pose: x, y, yaw of `base_link` [m, rad].

    Returns:
        A function that casts all rays and returns ranges [m], `[rings, azimuths]`; inf where
        nothing is met. The array is the same at each call.
    """
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
    model = scene.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)

    e, a = np.meshgrid(spec.elevations, spec.bearings + float(pose[2]), indexing="ij")
    rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1).reshape(-1)
    sensor = np.asarray([pose[0], pose[1], params.height], float)
    limit = float(params.max_range)
    met, ranges = np.zeros(spec.num_points, np.int32), np.zeros(spec.num_points)

    def cast_native() -> np.ndarray:
        mujoco.mj_multiRay(
            model, data, sensor, rays, None, 1, -1, met, ranges, None, spec.num_points, limit
        )
        ranges[met < 0] = np.inf
        return ranges.reshape(spec.rings, spec.azimuths)

    return cast_native


def lidar_against_mujoco(
    seed: int = 0,
    num_obstacles: int = 100,
    rings: int = 16,
    azimuths: int = 360,
    repeats: int = 30,
) -> dict[str, float]:
    """Our LiDAR and native `mj_multiRay` on the same rays, world and pose.

    The native one runs on the calling thread, as it comes; ours on what XLA uses.

    Args:
        seed: Of the world.
        num_obstacles: Boxes and cylinders.
        rings: Rays stacked in elevation.
        azimuths: Rays in one turn.
        repeats: How often each is timed.

    Returns:
        `rays_per_s` and `mujoco_rays_per_s` (medians), their `ratio`, the largest difference
        between ranges `max_error_m`, and `mismatches`, rays that met something in one only.
    """
    world = random_obstacles(seed, num_obstacles)
    spec = LidarSpec(rings, azimuths)
    params = LidarParams(max_range=100.0)
    pose = np.asarray([0.1, -0.2, np.random.default_rng(seed).uniform(-np.pi, np.pi)], np.float32)
    native = native_lidar(spec, params, world, pose)
    on_device = jax.tree.map(jnp.asarray, (params, world, pose))

    def ours() -> jax.Array:
        return cast(spec, *on_device)

    seconds, native_seconds = _interleaved([ours, native], repeats)
    ranges, expected = np.asarray(ours(), float), native()
    both = np.isfinite(ranges) & np.isfinite(expected)
    return {
        "rays_per_s": spec.num_points / seconds,
        "mujoco_rays_per_s": spec.num_points / native_seconds,
        "ratio": native_seconds / seconds,
        "max_error_m": float(np.max(np.abs(ranges[both] - expected[both]), initial=0.0)),
        "mismatches": float(np.sum(np.isfinite(ranges) != np.isfinite(expected))),
    }
