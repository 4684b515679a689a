"""How late commands act, found out while driving, and where the robot will be when the next one does.

A command that acts d ticks late meets a robot that has moved on: what was certified for where it stands now is not what it
drives. The delay is that one for which the speeds that are measured follow from the commands that were sent,

    e_d <- keep e_d + |(twist - reached(twist before, command sent d + 1 ticks ago)) / (v_max, w_max)|^2            (1)
    d   <- argmin e, if that is less than `share` of the error of the d in force, and that one's is above `floor`;
           0 if even the d in force explains nothing, e_d > `doubt`                                                 (2)

Speeds that have not changed by `floor` tell nothing: a robot that is held fast is not late. The planner begins where the
d commands under way will have brought the robot (Smith 1957). A robot that obeys at once has d = 0, and nothing is changed.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from drnav_jax.planning import dynamics
from drnav_jax.types import Command, RobotParams, Scalar

MAX_TICKS = 5  # longer delays count as that long


class LatencyParams(NamedTuple):
    """When a delay is believed."""

    keep: Scalar = 0.97  # [] of eq. 1, per tick
    share: Scalar = 0.5  # [] of eq. 2
    floor: Scalar = 0.01  # [] of eq. 2: a tenth of the limits, once
    doubt: Scalar = 0.2  # [] of eq. 2


class LatencyState(NamedTuple):
    """Kept from tick to tick; D = `MAX_TICKS`."""

    sent: Array  # [D + 1, 2] commands v [m/s], omega [rad/s], the newest first
    error: Array  # [D + 1] e_d
    changed: Array  # [] what measured speeds changed by, summed like e_d
    twist: Array  # [2] measured at the last tick
    ticks: Array  # [] int32, d


def init() -> LatencyState:
    """A robot that stands and obeys at once."""
    nothing = jnp.zeros((MAX_TICKS + 1, 2), jnp.float32)
    return LatencyState(nothing, nothing[:, 0], nothing[0, 0], nothing[0], jnp.zeros((), jnp.int32))


def update(
    params: LatencyParams, state: LatencyState, twist: Float[Array, "2"], robot: RobotParams, dt: Scalar
) -> LatencyState:
    """Equations (1) and (2), after `twist` (v, omega) was measured."""
    reached = dynamics.limit(state.sent[:, 0], state.sent[:, 1], state.twist, robot, dt)

    def gathered(before: Array, v: Array, omega: Array) -> Array:
        off = jnp.square((twist[0] - v) / robot.v_max) + jnp.square((twist[1] - omega) / robot.w_max)
        return params.keep * before + jnp.minimum(off, 1.0)

    error = gathered(state.error, reached.v, reached.omega)
    changed = gathered(state.changed, state.twist[0], state.twist[1])
    best = jnp.argmin(error).astype(jnp.int32)  # of equals the shortest
    held = error[state.ticks]
    found = (held > params.floor) & (changed > params.floor) & (error[best] < params.share * held)
    ticks = jnp.where(found, best, state.ticks)
    ticks = jnp.where(error[ticks] > params.doubt, 0, ticks)
    return LatencyState(state.sent, error, changed, twist, ticks)


def ahead(
    state: LatencyState, pose: Float[Array, "3"], twist: Float[Array, "2"], robot: RobotParams, dt: Scalar
) -> tuple[Float[Array, "3"], Float[Array, "2"]]:
    """(pose, twist) when the command of this tick begins to act.

    Args:
        state: After `update`.
        pose: Robot (x, y, yaw) now, in odom.
        twist: Its speeds (v, omega) now.
        robot: Limits.
        dt: Tick [s].
    """
    m = dynamics.start(pose, twist, 1)
    for k in range(MAX_TICKS - 1, -1, -1):  # the oldest first
        moved = dynamics.advance(m, state.sent[k, 0], state.sent[k, 1], robot, dt)
        m = jax.tree.map(lambda a, b, k=k: jnp.where(k < state.ticks, a, b), moved, m)
    late, there = state.ticks > 0, jnp.concatenate([m.x, m.y, jnp.arctan2(m.s, m.c)])
    return jnp.where(late, there, pose), jnp.where(late, jnp.concatenate([m.v, m.w]), twist)


def sent(state: LatencyState, command: Command) -> LatencyState:
    """After a command was sent."""
    return state._replace(sent=jnp.concatenate([jnp.stack(command)[None], state.sent[:-1]]))
