"""The cameras next to native MuJoCo: the same views, in turn within one run.

MuJoCo's renderer needs OpenGL without a screen (the system package libegl1 or libosmesa6) and takes the choice from the
environment when it is imported; so it runs in a process of its own, and where it cannot, that says why.
"""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from drnav_jax.bench.obstacles import native_scene, random_obstacles
from drnav_jax.bench.timing import interleaved, matmul
from drnav_jax.sim import CameraParams, render
from drnav_jax.types import CameraRig, RigSpec, rig_of
from drnav_jax.worlds.world import World, make_world

GL = ("egl", "osmesa")  # ways to draw without a screen, tried in turn


class NativeViews(NamedTuple):
    """What `mujoco.Renderer` sees from K cameras."""

    depth: np.ndarray  # [K, h, w] along the optical axis [m]
    solid: np.ndarray  # [K, h, w] bool: a box or a cylinder, not the ground or nothing
    seconds: float  # median time of one RGB image
    gl: str  # of `GL`


def _world_cameras(rig: CameraRig, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position `[N, 3]` and rotation `[N, 3, 3]` (optical frame to world) of a rig at a pose."""
    c, s = np.cos(float(pose[2])), np.sin(float(pose[2]))
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    position = np.asarray(rig.position, float) @ turn.T + [float(pose[0]), float(pose[1]), 0]
    return position, turn @ np.asarray(rig.rotation, float)


def native_views(spec: RigSpec, world: World, rig: CameraRig, poses: np.ndarray, repeats: int = 1) -> NativeViews:
    """Views of `mujoco.Renderer`, from the cameras of a rig at each pose in turn.

    Args:
        spec: Size of the images.
        world: Boxes and cylinders, all taken as opaque.
        rig: The cameras; one focal length for all, square pixels, the principal point in the middle.
        poses: x, y, yaw of `base_link` `[P, 3]` [m, rad].
        repeats: How often the RGB images are timed.

    Raises:
        RuntimeError: If OpenGL does not work here; it says what to install.
    """
    cameras = [_world_cameras(rig, pose) for pose in np.asarray(poses, float)]
    position, rotation = (np.concatenate(part) for part in zip(*cameras, strict=True))
    vertical = 2 * np.degrees(np.arctan(spec.shape[0] / 2 / float(rig.focal[0, 1])))
    root = Path(__file__).resolve().parents[2]
    failures = []
    with tempfile.TemporaryDirectory() as folder:
        np.savez(
            f"{folder}/in.npz", boxes=world.boxes, cylinders=world.cylinders, position=position, rotation=rotation,
            vertical=vertical, shape=spec.shape, repeats=repeats,
        )  # fmt: skip
        for gl in GL:
            # mujoco first: where this way to draw is missing it says so before anything else is loaded
            program = "import sys, mujoco; from drnav_jax.bench.camera import draw_natively; draw_natively(sys.argv[1])"
            path = os.pathsep.join([str(root), *filter(None, [os.environ.get("PYTHONPATH")])])
            done = subprocess.run(
                [sys.executable, "-c", program, folder], capture_output=True, text=True, check=False,
                env={**os.environ, "MUJOCO_GL": gl, "PYTHONPATH": path, "JAX_PLATFORMS": "cpu"},
            )  # fmt: skip
            if Path(f"{folder}/out.npz").exists():
                with np.load(f"{folder}/out.npz") as out:
                    return NativeViews(out["depth"], out["solid"], float(out["seconds"]), gl)
            failures.append(f"{gl}: {(done.stderr.strip().splitlines() or ['no message'])[-1]}")
    raise RuntimeError(
        f"mujoco.Renderer needs OpenGL without a screen; install libegl1 or libosmesa6 ({'; '.join(failures)})."
    )


def draw_natively(folder: str) -> None:
    """What the other process of `native_views` does: `in.npz` to `out.npz`."""
    with np.load(f"{folder}/in.npz") as given:
        asked = {name: given[name] for name in given.files}
    mujoco, scene = native_scene(make_world(asked["boxes"], asked["cylinders"]))
    h, w = (int(n) for n in asked["shape"])
    scene.visual.global_.offheight, scene.visual.global_.offwidth = h, w
    scene.visual.quality.offsamples, scene.visual.quality.numslices = 0, 256
    scene.stat.extent, scene.visual.map.znear, scene.visual.map.zfar = 1.0, 0.05, 300.0
    for position, rotation in zip(asked["position"], asked["rotation"], strict=True):
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, (rotation @ np.diag([1.0, -1.0, -1.0])).reshape(-1))  # it looks along -z, y up
        scene.worldbody.add_camera(pos=position, quat=quaternion, fovy=float(asked["vertical"]))
    model = scene.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    depth, solid, spent = [], [], []
    with mujoco.Renderer(model, h, w) as renderer:
        for k in range(model.ncam):
            for _ in range(int(asked["repeats"])):
                begin = time.perf_counter()
                renderer.update_scene(data, k)
                renderer.render()
                spent.append(time.perf_counter() - begin)
            renderer.enable_depth_rendering()
            renderer.update_scene(data, k)
            depth.append(renderer.render().copy())
            renderer.disable_depth_rendering()
            renderer.enable_segmentation_rendering()
            renderer.update_scene(data, k)
            solid.append(renderer.render()[..., 0] > 0)  # 0 is the ground
            renderer.disable_segmentation_rendering()
    np.savez(f"{folder}/partial.npz", depth=depth, solid=solid, seconds=statistics.median(spent))
    os.replace(f"{folder}/partial.npz", f"{folder}/out.npz")


def camera_against_mujoco(
    seed: int = 0, num_obstacles: int = 100, size: int = 96, num_poses: int = 16, repeats: int = 20, workers: int = 2
) -> dict[str, Any]:
    """Our images per second next to those of `mujoco.Renderer`, of the same views; both as they come.

    Args:
        seed: Of the world.
        num_obstacles: Boxes and cylinders.
        size: Edge of an image [pixels].
        num_poses: How many poses of the default rig are drawn.
        repeats: How often each is timed.
        workers: Threads that share the poses; each draws one frame after another.

    Returns:
        `images_per_s` (median), `mujoco_images_per_s` and their `ratio`, or None and the reason in `no_mujoco`;
        `matmul_ms`, a 1024^3 float32 product in turn with our images.
    """
    spec, params = RigSpec(shape=(size, size)), CameraParams()
    world, rig = random_obstacles(seed, num_obstacles), rig_of(spec)
    poses = np.zeros((num_poses, 3), np.float32)
    poses[:, 2] = np.linspace(-np.pi, np.pi, num_poses, endpoint=False)
    keys = jax.random.split(jax.random.key(seed), num_poses)
    shares = [(jnp.asarray(poses[k::workers]), keys[k::workers]) for k in range(workers)]
    frames = jax.jit(lambda poses, keys: jax.lax.map(lambda at: render(spec, params, world, rig, *at), (poses, keys)))
    with ThreadPoolExecutor(workers) as pool:

        def ours() -> list[jax.Array]:
            return list(pool.map(lambda share: jax.block_until_ready(frames(*share)), shares))

        seconds, reference = interleaved([ours, matmul()], repeats)
    rate = num_poses * len(spec.mounts) / seconds
    native, reason = None, None
    try:
        native = 1 / native_views(spec, world, rig, poses[:: max(1, num_poses // 4)]).seconds
    except RuntimeError as error:
        reason = str(error)
    return {
        "images_per_s": rate, "mujoco_images_per_s": native, "ratio": rate / native if native else None,
        "no_mujoco": reason, "matmul_ms": 1e3 * reference,
    }  # fmt: skip
