"""The LiDAR next to native MuJoCo: the same rays, in turn within one run."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from drnav_jax.bench.obstacles import native_scene, random_obstacles
from drnav_jax.bench.timing import interleaved
from drnav_jax.sim import LidarParams, LidarSpec, cast
from drnav_jax.worlds.world import World


def native_lidar(spec: LidarSpec, params: LidarParams, world: World, pose: np.ndarray) -> Callable[[], np.ndarray]:
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
    mujoco, scene = native_scene(world)
    model = scene.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)

    e, a = np.meshgrid(spec.elevations, spec.bearings + float(pose[2]), indexing="ij")
    rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1).reshape(-1)
    sensor = np.asarray([pose[0], pose[1], params.height], float)
    limit = float(params.max_range)
    met, ranges = np.zeros(spec.num_points, np.int32), np.zeros(spec.num_points)

    def cast_native() -> np.ndarray:
        mujoco.mj_multiRay(model, data, sensor, rays, None, 1, -1, met, ranges, None, spec.num_points, limit)
        ranges[met < 0] = np.inf
        return ranges.reshape(spec.rings, spec.azimuths)

    return cast_native


def lidar_against_mujoco(
    seed: int = 0, num_obstacles: int = 100, rings: int = 16, azimuths: int = 360, repeats: int = 30
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

    seconds, native_seconds = interleaved([ours, native], repeats)
    ranges, expected = np.asarray(ours(), float), native()
    both = np.isfinite(ranges) & np.isfinite(expected)
    return {
        "rays_per_s": spec.num_points / seconds,
        "mujoco_rays_per_s": spec.num_points / native_seconds,
        "ratio": native_seconds / seconds,
        "max_error_m": float(np.max(np.abs(ranges[both] - expected[both]), initial=0.0)),
        "mismatches": float(np.sum(np.isfinite(ranges) != np.isfinite(expected))),
    }
