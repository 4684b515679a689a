"""The two physics next to native MuJoCo: steps per second among obstacles, in turn within one run."""

import functools
import os
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from drnav_jax.bench.timing import interleaved, matmul
from drnav_jax.sim import contact, kinematic, mjx
from drnav_jax.sim.kinematic import FaultParams
from drnav_jax.sim.mjx import MjxParams, MjxSpec
from drnav_jax.types import Command, RobotParams
from drnav_jax.worlds.world import World, make_world, signed_distance, stack_worlds

DT = 0.1  # [s] tick
EXTENT = 9.0  # [m] half the edge of the square that the boxes fill
ROOM = 0.1  # [m] between a robot's footprint and the boxes, where it starts


def random_boxes(seed: int, count: int) -> tuple[World, np.ndarray]:
    """A world of boxes at all angles, and a free pose `[3]` in it (host)."""
    rng = np.random.default_rng(seed)
    centre, yaw = rng.uniform(-EXTENT, EXTENT, (count, 2)), rng.uniform(-np.pi, np.pi, (count, 1))
    world = make_world(np.concatenate([centre, yaw, rng.uniform(0.1, 0.7, (count, 2)), np.tile([0.0, 1.0], (count, 1))], 1))
    while True:
        places = rng.uniform(-EXTENT, EXTENT, (200, 2))
        free = places[signed_distance(world, places) > float(RobotParams().radius) + ROOM]
        if len(free):
            return world, np.asarray([*free[0], rng.uniform(-np.pi, np.pi)], np.float32)


def native(spec: MjxSpec, world: World) -> tuple[Any, Any, Any]:
    """The module `mujoco`, a native model of this robot among all boxes of a world at once, and its data."""
    mujoco, _ = mjx.load()
    boxes = np.asarray(world.boxes, float)
    text = mjx.xml(MjxSpec(timestep=spec.timestep, near_boxes=len(boxes), iterations=spec.iterations))
    scene = mujoco.MjSpec.from_string(text)
    for geom, (x, y, yaw, half_x, half_y, _, _) in zip(scene.geoms, boxes, strict=False):
        geom.pos, geom.size = [x, y, 0], [half_x, half_y, mjx.HALF_HEIGHT]
        geom.quat = [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]
    servo = jax.device_get(mjx.servos(spec, MjxParams(), RobotParams(), FaultParams()))
    body = scene.body("robot")
    body.mass, body.inertia = float(servo["mass"]), [float(servo["inertia"])] * 3
    for k, actuator in enumerate(scene.actuators):
        actuator.gainprm[0], actuator.biasprm[2] = servo["setpoint_gain"][k], -servo["speed_gain"][k]
        actuator.forcerange = [-servo["limit"][k], servo["limit"][k]]
    model = scene.compile()
    return mujoco, model, mujoco.MjData(model)


def physics_rates(
    batch: int = 256, num_boxes: int = 100, ticks: int = 20, repeats: int = 10, spec: MjxSpec = MjxSpec()  # noqa: B008
) -> dict[str, Any]:
    """Robots that drive at random among boxes and run into them, with contacts, in one batched call.

    A step of MJX and of native MuJoCo is one time step; a step of kinematic physics, which has no shorter one, is a tick
    with its distance to the obstacles. Native MuJoCo does one world on one thread.

    Args:
        batch: Worlds, and robots.
        num_boxes: Boxes in each.
        ticks: Ticks per call.
        repeats: How often each is timed.
        spec: Sizes of the model.

    Returns:
        `steps_per_s` of MJX, `ticks_per_s` of MJX, `kinematic_steps_per_s` and `native_steps_per_s` (medians), `ratio` (of
        MJX to native MuJoCo), `touched` (share of the robots' ticks in contact, last call), `deepest_m` (inside a box, all
        calls), `timestep_s`, `worlds`, `obstacles`, `matmul_ms` (1024^3 float32, in the same turns) and `load_average` (1
        minute).
    """
    every, starts = zip(*(random_boxes(seed, num_boxes) for seed in range(batch)), strict=True)
    solids = jax.tree.map(jnp.asarray, mjx.solids_of(list(every), spec))
    poses, bodies = jnp.asarray(np.stack(starts)), jax.vmap(lambda _: mjx.init())(jnp.arange(batch))
    rng = np.random.default_rng(0)
    speed, turn = (jnp.asarray(rng.uniform(*ends, batch), jnp.float32) for ends in ((0.3, 1.0), (-1.0, 1.0)))
    commands, steps = Command(speed, turn), ticks * spec.steps_in(DT)

    @jax.jit
    def drive(poses: Any, bodies: Any) -> tuple:
        def tick(carry: tuple, _: None) -> tuple:
            go = functools.partial(mjx.step, spec, MjxParams(), RobotParams(), dt=DT)
            pose, _, body = jax.vmap(go)(solids, carry[0], carry[1], commands)
            return (pose, body), (body.contact, body.depth)

        return jax.lax.scan(tick, (poses, bodies), None, length=ticks)

    worlds = jax.tree.map(jnp.asarray, stack_worlds(list(every)))

    @jax.jit
    def slide(poses: Any, twists: Any) -> tuple:
        def tick(carry: tuple, _: None) -> tuple:
            go = lambda *a: kinematic.step(RobotParams(), *a, DT)  # noqa: E731
            pose, twist = jax.vmap(go)(*carry, commands)
            return (pose, twist), jax.vmap(contact.clearance)(worlds, pose[:, :2])

        return jax.lax.scan(tick, (poses, twists), None, length=ticks)

    state: dict[str, Any] = {"end": (poses, bodies), "deepest": 0.0}

    def ours() -> Any:
        state["end"], (state["touched"], depth) = drive(*state["end"])
        state["deepest"] = max(state["deepest"], float(jnp.max(depth)))
        return depth

    mujoco, model, data = native(spec, every[0])
    data.qpos[:], data.ctrl[:] = starts[0], (0.8, 0.0, 0.3)
    calls: list[Callable[[], object]] = [
        ours, lambda: slide(poses, jnp.zeros((batch, 2), jnp.float32)), lambda: mujoco.mj_step(model, data, nstep=steps),
        matmul(),
    ]  # fmt: skip
    seconds, kinematic_s, native_s, reference = interleaved(calls, repeats)
    return {
        "steps_per_s": batch * steps / seconds,
        "ticks_per_s": batch * ticks / seconds,
        "kinematic_steps_per_s": batch * ticks / kinematic_s,
        "native_steps_per_s": steps / native_s,
        "ratio": batch * native_s / seconds,
        "touched": float(jnp.mean(state["touched"])),
        "deepest_m": state["deepest"],
        "timestep_s": spec.timestep, "worlds": batch, "obstacles": num_boxes,
        "matmul_ms": 1e3 * reference,
        "load_average": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
    }  # fmt: skip
