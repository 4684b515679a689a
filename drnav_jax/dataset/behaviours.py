"""How the robot that gathers frames drives: it knows the world, so that it sees much, not so that it drives well.

| kind | what it does |
|---|---|
| `tour` | follows a way into dead ends and out again, then on to the goal, with a wandering heading and looks around |
| `errand` | the same along shortest ways to random places |
| `wall` | keeps a distance to the nearest wall and follows it, on the left or on the right |
| `reach` | drives straight at the goal with the DWA of the planners: into what lies in between; then at other places |

A behaviour is a function of the true pose, pure and vmapped over worlds of one kind; `routes` draws its plan on the host.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from drnav_jax.geometry import wrap_angle
from drnav_jax.planning import tracker
from drnav_jax.planning.tracker import TrackerParams, TrackerSpec
from drnav_jax.sim import contact
from drnav_jax.types import Command, GridMap, RobotParams
from drnav_jax.worlds.world import World

KINDS = ("tour", "errand", "wall", "reach")

NEXT = 0.6  # [m] from a point of the way the next one is steered for
ARRIVED = 0.75  # [m] from a place it counts as reached
PATIENCE = 40  # ticks without getting `MOVED` farther before another place is tried
MOVED = 0.3  # [m]
LOOK = 0.006  # probability per tick of beginning to look around
LOOK_TICKS = (8, 26)  # how long that takes
WANDER = 0.25  # [rad] standard deviation of the heading's wandering
FIELD_CELLS, FIELD_CELL = 40, 0.15  # of the true clearance that `reach` rolls out in; cells, [m]


class Plan(NamedTuple):
    """What one episode is to do."""

    kind: Array  # [] int32, index into `KINDS`
    start: Array  # [3] x, y, yaw
    points: Array  # [L, 2] corners of the way, or places to reach; the last one repeats [m]
    speed: Array  # [] share of the robot's fastest speed
    side: Array  # [] +1 keeps the wall on the left, -1 on the right
    gap: Array  # [] distance kept to it [m]


class Memory(NamedTuple):
    """What a behaviour carries from tick to tick."""

    at: Array  # [] int32, the point steered for
    wander: Array  # [] heading error [rad]
    look: Array  # [] int32, ticks left of looking around
    turn: Array  # [] +1 or -1, which way round
    anchor: Array  # [2] where the robot last got away from [m]
    waited: Array  # [] int32, ticks since


def begin(plan: Plan) -> Memory:
    """The memory before the first tick."""
    zero = jnp.zeros((), jnp.int32)
    return Memory(
        at=zero, wander=jnp.zeros((), jnp.float32), look=zero, turn=jnp.ones((), jnp.float32),
        anchor=jnp.asarray(plan.start[:2], jnp.float32), waited=zero,
    )  # fmt: skip


def _toward(robot: RobotParams, plan: Plan, heading: Array, yaw: Array) -> Command:
    """Turn to a heading and drive the faster the better it is met; on the spot when it lies to the side."""
    error = wrap_angle(heading - yaw)
    v = plan.speed * robot.v_max * jnp.clip(jnp.cos(error) * 1.5 - 0.5, 0.0, 1.0)
    return Command(v=v, omega=jnp.clip(2.5 * error, -robot.w_max, robot.w_max))


def follow(robot: RobotParams, plan: Plan, memory: Memory, pose: Array) -> tuple[Memory, Command]:
    """Steer along the points; at the end stay and look around."""
    last = plan.points.shape[0] - 1
    point = plan.points[memory.at]
    near = jnp.hypot(point[0] - pose[0], point[1] - pose[1]) < NEXT
    at = jnp.minimum(memory.at + near.astype(jnp.int32), last)
    point = plan.points[at]
    heading = jnp.arctan2(point[1] - pose[1], point[0] - pose[0])
    done = jnp.hypot(point[0] - pose[0], point[1] - pose[1]) < 0.2
    command = _toward(robot, plan, heading + memory.wander, pose[2])
    around = 0.5 * plan.side * robot.w_max
    stay = Command(v=jnp.zeros_like(command.v), omega=jnp.zeros_like(command.v) + around)
    return memory._replace(at=at), jax.tree.map(lambda a, b: jnp.where(done, a, b), stay, command)


def along_wall(robot: RobotParams, plan: Plan, memory: Memory, pose: Array, world: World) -> tuple[Memory, Command]:
    """Keep `gap` to the nearest surface while moving along it."""
    distance, away = jax.value_and_grad(lambda xy: contact.clearance(world, xy))(pose[:2])
    away = jnp.where(jnp.all(jnp.isfinite(away)), away, 0.0)
    distance = jnp.where(jnp.isfinite(distance), distance, plan.gap)
    inward = jnp.clip(2.0 * (plan.gap - distance), -1.5, 1.5)
    x, y = plan.side * away[1] + inward * away[0], -plan.side * away[0] + inward * away[1]
    return memory, _toward(robot, plan, jnp.arctan2(y, x) + 0.5 * memory.wander, pose[2])


def reach(
    robot: RobotParams, plan: Plan, memory: Memory, pose: Array, twist: Array, world: World
) -> tuple[Memory, Command]:
    """Straight at the place, as the reactive baseline does it; after `PATIENCE` at the next one."""
    place = plan.points[memory.at]
    there = jnp.hypot(place[0] - pose[0], place[1] - pose[1]) < ARRIVED
    at = (memory.at + (there | (memory.waited > PATIENCE)).astype(jnp.int32)) % plan.points.shape[0]
    n, cell = FIELD_CELLS, FIELD_CELL
    origin = pose[:2] - 0.5 * n * cell
    steps = (jnp.arange(n, dtype=jnp.float32) + 0.5) * cell
    xy = jnp.stack(jnp.meshgrid(origin[0] + steps, origin[1] + steps), axis=-1)
    room = jax.vmap(jax.vmap(lambda p: contact.clearance(world, p)))(xy)
    field = GridMap(jnp.clip(room, 0.0, 1.0), origin, jnp.asarray(cell, jnp.float32))
    nowhere = jnp.asarray(False)
    chosen = tracker.track(
        TrackerSpec(), TrackerParams(), robot, field, pose, twist, plan.points[at], nowhere
    )
    return memory._replace(at=at), chosen.command


def _mood(memory: Memory, pose: Array, key: PRNGKeyArray) -> Memory:
    """Wandering of the heading, looks around, and how long the robot has not got away from where it was."""
    k_wander, k_look, k_long, k_turn = jax.random.split(key, 4)
    wander = 0.95 * memory.wander + 0.31 * WANDER * jax.random.normal(k_wander, (), jnp.float32)
    begins = (memory.look == 0) & (jax.random.uniform(k_look, (), jnp.float32) < LOOK)
    ticks = jax.random.randint(k_long, (), *LOOK_TICKS, jnp.int32)
    turn = jnp.where(jax.random.bernoulli(k_turn), 1.0, -1.0).astype(jnp.float32)
    away = jnp.hypot(pose[0] - memory.anchor[0], pose[1] - memory.anchor[1]) > MOVED
    return memory._replace(
        wander=wander,
        look=jnp.where(begins, ticks, jnp.maximum(memory.look - 1, 0)),
        turn=jnp.where(begins, turn, memory.turn),
        anchor=jnp.where(away, pose[:2], memory.anchor),
        waited=jnp.where(away | (memory.waited > PATIENCE), 0, memory.waited + 1),
    )


def step(
    kind: str, robot: RobotParams, world: World, plan: Plan, memory: Memory, pose: Float[Array, "3"],
    twist: Float[Array, "2"], key: PRNGKeyArray,
) -> tuple[Memory, Command]:  # fmt: skip
    """One tick of a behaviour.

    Args:
        kind: One of `KINDS` (static): worlds of one kind are worked on together.
        robot: Radius and limits.
        world: As it is, not as it is seen.
        plan: What to do.
        memory: Carried over.
        pose: x, y, yaw in the world [m, rad].
        twist: Speeds (v, omega).
        key: Randomness of this tick.
    """
    if kind == "wall":
        memory, command = along_wall(robot, plan, memory, pose, world)
    elif kind == "reach":
        memory, command = reach(robot, plan, memory, pose, twist, world)
    else:
        memory, command = follow(robot, plan, memory, pose)
    looking = memory.look > 0
    command = Command(
        v=jnp.where(looking, 0.0, command.v),
        omega=jnp.where(looking, memory.turn * 0.8 * robot.w_max, command.omega),
    )
    return _mood(memory, pose, key), command
