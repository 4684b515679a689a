"""Times of the two physics: steps per second of a batch of worlds, and native MuJoCo's on the same model."""

import functools
import statistics
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from drnav_jax.bench_sensors import random_obstacles
from drnav_jax.sim import kinematic, mjx
from drnav_jax.sim.mjx import MjxParams, MjxSpec
from drnav_jax.types import Command, RobotParams

TICK = 0.1  # [s]


def _commands(num_ticks: int, num_worlds: int) -> Command:
    """Commands that change every second, `[T, B]`."""
    draws = np.random.default_rng(0).uniform([0.2, -1.0], [1.0, 1.0], (-(-num_ticks // 10), num_worlds, 2))
    held = np.repeat(draws, 10, axis=0)[:num_ticks].astype(np.float32)
    return Command(v=jnp.asarray(held[..., 0]), omega=jnp.asarray(held[..., 1]))


def _native_rate(spec: MjxSpec, num_steps: int) -> float:
    """Steps per second of `mj_step` on the same model, one robot on one thread, in contact with nothing."""
    mujoco, _ = mjx.load()
    model = mujoco.MjModel.from_xml_string(mjx.xml(spec))
    data = mujoco.MjData(model)
    begin = time.perf_counter()
    mujoco.mj_step(model, data, nstep=num_steps)
    return num_steps / (time.perf_counter() - begin)


def physics_rates(
    num_worlds: int = 256, num_boxes: int = 100, num_ticks: int = 20, repeats: int = 5, spec: MjxSpec = MjxSpec()  # noqa: B008
) -> dict[str, Any]:
    """Steps per second of a batch, contacts on, in turn with the kinematic physics.

    Args:
        num_worlds: Robots, each in a world of its own.
        num_boxes: Obstacles of a world, half of them boxes.
        num_ticks: Ticks of 0.1 s in a call.
        repeats: Calls that are timed.
        spec: The model.

    Returns:
        `steps_per_s` of MJX (its own time steps), `kinematic_steps_per_s` (ticks), `ticks_per_s` of MJX,
        `native_steps_per_s`, the share of robots that touched something, and the sizes.
    """
    worlds = [random_obstacles(seed, num_boxes, extent=8.0, gap=0.6) for seed in range(num_worlds)]
    solids = jax.tree.map(jnp.asarray, mjx.solids_of(worlds, spec))
    robot, commands = RobotParams(), _commands(num_ticks, num_worlds)
    pose, body = jnp.zeros((num_worlds, 3), jnp.float32), mjx.init()
    body = jax.tree.map(lambda a: jnp.broadcast_to(a, (num_worlds, *a.shape)), body)
    twist = jnp.zeros((num_worlds, 2), jnp.float32)

    @jax.jit
    def with_mjx() -> tuple[Any, jax.Array]:
        def tick(carry: Any, command: Command) -> tuple[Any, jax.Array]:
            move = lambda s, p, b, c: mjx.step(spec, MjxParams(), robot, s, p, b, c, TICK)  # noqa: E731
            p, _, b = jax.vmap(move)(solids, carry[0], carry[1], command)
            return (p, b), b.contact

        return jax.lax.scan(tick, (pose, body), commands)

    @jax.jit
    def with_kinematic() -> Any:
        def tick(carry: Any, command: Command) -> tuple[Any, None]:
            move = lambda p, t, c: kinematic.step(robot, p, t, c, TICK)  # noqa: E731
            return jax.vmap(move)(carry[0], carry[1], command), None

        return jax.lax.scan(tick, (pose, twist), commands)[0]

    touched = float(np.mean(np.asarray(with_mjx()[1]).any(axis=0)))
    jax.block_until_ready(with_kinematic())
    calls: list[Any] = [with_mjx, with_kinematic, functools.partial(_native_rate, spec, 20_000)]
    spent: list[list[float]] = [[], [], []]
    for _ in range(repeats):
        for call, times in zip(calls, spent, strict=True):
            begin = time.perf_counter()
            jax.block_until_ready(call())
            times.append(time.perf_counter() - begin)
    mjx_s, kinematic_s, native_s = (statistics.median(times) for times in spent)
    ticks = num_worlds * num_ticks
    return {
        "steps_per_s": ticks * spec.steps_in(TICK) / mjx_s, "ticks_per_s": ticks / mjx_s,
        "kinematic_steps_per_s": ticks / kinematic_s, "native_steps_per_s": 20_000 / native_s,
        "touched": touched, "worlds": num_worlds, "obstacles": num_boxes, "timestep_s": spec.timestep,
    }  # fmt: skip
