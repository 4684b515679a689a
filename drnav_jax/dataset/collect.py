"""From worlds to frames: drive a group of worlds, sense along the way, label.

1. `drive`: all worlds of a group at once, a behaviour each, through the physics -> true poses.
2. `sense`: along the poses of one world, LiDAR into the filter, cameras at every frame -> what a robot has there.
3. `label`: what is true at those poses (host code, `worlds.truth`).

The group, not the call, fixes every number: how many groups are worked on side by side changes nothing.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from drnav_jax.dataset import behaviours
from drnav_jax.dataset.behaviours import Plan
from drnav_jax.dataset.frames import FrameSpec
from drnav_jax.filter import FilterParams, FilterSpec, belief
from drnav_jax.models import bev, geometric
from drnav_jax.models.geometric import GeometricParams
from drnav_jax.sim import CameraParams, lidar, mjx, render
from drnav_jax.sim.kinematic import FaultParams
from drnav_jax.sim.lidar import LidarParams
from drnav_jax.sim.mjx import MjxParams, MjxSpec, Solids
from drnav_jax.types import CameraRig, GridMap, RobotParams, empty_observation
from drnav_jax.worlds.frames import visibility
from drnav_jax.worlds.world import World

TICK = 0.1  # [s]
PHYSICS = MjxSpec()
BODIES = (MjxParams(), MjxParams())  # least and largest of what is drawn for each world
FAULTS = (FaultParams(), FaultParams(slip_v=0.1, slip_omega=0.1))
FAR_GOAL = 1e4  # [m] labels know no goal, so the rule shall know none


class Sensors(NamedTuple):
    """How one world is sensed."""

    lidar: LidarParams
    camera: CameraParams
    rig: CameraRig


@partial(jax.jit, static_argnames=("num_ticks", "kinds"))
def drive(
    num_ticks: int, kinds: tuple[str, ...], robot: RobotParams, worlds: World, solids: Solids, plans: Plan,
    bodies: MjxParams, faults: FaultParams, key: PRNGKeyArray,
) -> Float[Array, "W T 3"]:  # fmt: skip
    """True poses of W robots, one per world, at each of T ticks.

    Args:
        num_ticks: T (static).
        kinds: The behaviours of the worlds, which lie in as many equal runs along axis 0 (static).
        robot: Radius and limits.
        worlds: `[W, ...]`.
        solids: Of these worlds, `[W, ...]` (`sim.mjx.solids_of`).
        plans: `[W, ...]`.
        bodies: `[W]`, inertia, load and motors.
        faults: `[W]`, slip.
        key: Randomness.
    """
    count = plans.start.shape[0]
    each = count // len(kinds)
    parts = [jax.tree.map(lambda a, k=k: a[k * each : (k + 1) * each], (worlds, plans)) for k in range(len(kinds))]

    def tick(carry: Any, k: Array) -> tuple[Any, Array]:
        memory, pose, twist, body = carry
        keys = jax.random.split(jax.random.fold_in(key, k), count)
        new, commands = [], []
        for n, (kind, (world, plan)) in enumerate(zip(kinds, parts, strict=True)):
            mine = jax.tree.map(lambda a, n=n: a[n * each : (n + 1) * each], (memory, pose, twist, keys))
            one = jax.vmap(partial(behaviours.step, kind, robot))
            remembered, command = one(world, plan, *mine)
            new.append(remembered)
            commands.append(command)
        memory, command = (jax.tree.map(lambda *a: jnp.concatenate(a), *some) for some in (new, commands))
        move = lambda mass, fault, solid, p, b, c: mjx.step(PHYSICS, mass, robot, solid, p, b, c, TICK, fault)  # noqa: E731
        pose, twist, body = jax.vmap(move)(bodies, faults, solids, pose, body, command)
        return (memory, pose, twist, body), pose

    bodies_now = jax.tree.map(lambda a: jnp.broadcast_to(a, (count, *a.shape)), mjx.init())
    begin = (jax.vmap(behaviours.begin)(plans), plans.start, jnp.zeros((count, 2), jnp.float32), bodies_now)
    _, poses = jax.lax.scan(tick, begin, jnp.arange(num_ticks))
    return jnp.swapaxes(poses, 0, 1)


@partial(jax.jit, static_argnames=("spec", "every"))
def sense(
    spec: FrameSpec, every: int, world: World, sensors: Sensors, poses: Float[Array, "T 3"], key: PRNGKeyArray
) -> dict[str, Array]:
    """What a robot has sensed after every `every`-th of T ticks: F = T / every frames, fields of `Frame`.

    Args:
        spec: Sensors and grid (static).
        every: Ticks per frame (static).
        world: One world.
        sensors: How it is sensed.
        poses: Where the robot is, from the start on.
        key: Randomness of the sensors.
    """
    held, params = FilterSpec(), FilterParams()
    params = params._replace(occupancy=params.occupancy._replace(max_range=sensors.lidar.max_range))

    def look(state: Any, pose: Array, k: Array) -> tuple[Any, tuple]:
        points, valid = lidar.scan(spec.lidar, sensors.lidar, world, pose, jax.random.fold_in(key, k))
        state, now = belief.observe(held, params, state, pose, points, valid)
        return state, (points, valid, now)

    def frame(state: Any, part: tuple[Array, Array]) -> tuple[Any, dict[str, Array]]:
        pose, number = part
        skip = lambda s, x: (look(s, *x)[0], None)  # noqa: E731
        state, _ = jax.lax.scan(skip, state, (pose[:-1], number[:-1]))
        here = pose[-1]
        state, (points, valid, now) = look(state, here, number[-1])
        known = belief.local_map(held, state)
        seen = empty_observation(0)._replace(pose=here, goal=jnp.full(2, FAR_GOAL, jnp.float32))
        rule = geometric.predict(GeometricParams(), seen, known)
        at = lambda values: bev.resample(spec.bev, GridMap(values, known.origin, known.resolution), here, 0)  # noqa: E731
        byte = lambda share: jnp.round(share * 255).astype(jnp.uint8)  # noqa: E731
        shown = render(spec.rig, sensors.camera, world, sensors.rig, here, jax.random.fold_in(key, -1 - number[-1]))
        return state, {
            "images": byte(shown),
            "image_valid": jnp.ones(len(spec.rig.mounts), bool),
            **sensors.rig._asdict(),
            "points": points.astype(jnp.float16),
            "point_valid": valid,
            "local_map": bev.classes(spec.bev, known, here),
            "rule_p": byte(at(rule.p_dead)),
            "rule_confidence": byte(at(rule.confidence)),
            "visibility": visibility(now, known.seen, known.origin, known.resolution, here, spec.bev),
            "pose": here,
        }

    state = belief.init(held, params, poses[0, :2])
    grouped = (poses.reshape(-1, every, 3), jnp.arange(poses.shape[0]).reshape(-1, every))
    return jax.lax.scan(frame, state, grouped)[1]
