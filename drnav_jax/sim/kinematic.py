"""A disc robot that drives like a unicycle, without contact forces.

With the twist (v, omega) held over dt the robot moves along an arc, whose chord points half-way
through the turn; with sinc(a) = sin(a) / a,

    (x', y') = (x, y) + v dt sinc(omega dt / 2) (cos, sin)(yaw + omega dt / 2)                (1)
    yaw' = yaw + omega dt                                                                     (2)
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from drnav_jax.geometry import compose, inverse, wrap_angle
from drnav_jax.types import Command, RobotParams, Scalar


class FaultParams(NamedTuple):
    """What goes wrong between wheels, ground and odometry. Zero is a perfect robot."""

    slip_v: Scalar = 0.0  # [] fraction of the wheels' speed that does not reach the ground
    slip_omega: Scalar = 0.0  # [] fraction of the wheels' turn rate that does not reach the ground
    drift_distance: Scalar = 0.0  # [] fraction by which odometry over-reports what is travelled
    drift_yaw: Scalar = 0.0  # [] heading error that odometry gathers [rad/m]
    delay: Scalar = 0.0  # [] between a command and the motors; whole ticks, rounded [s]


@jax.jit
def delayed(
    pending: Float[Array, "ticks 2"], command: Command, dt: Scalar, faults: FaultParams
) -> tuple[Float[Array, "ticks 2"], Command]:
    """What reaches the motors at this tick.

    Args:
        pending: The commands of the last ticks, newest first; zeros before there were any.
        command: The one given now.
        dt: Tick [s].
        faults: The delay; what is longer than `pending` counts as that long.

    Returns:
        (pending for the next tick, command that has come through now).
    """
    every = jnp.concatenate([jnp.stack([command.v, command.omega])[None], pending])
    ticks = jnp.round(jnp.asarray(faults.delay, jnp.float32) / dt).astype(jnp.int32)
    through = every[jnp.clip(ticks, 0, pending.shape[0])]
    return every[:-1], Command(v=through[0], omega=through[1])


@jax.jit
def step(
    params: RobotParams,
    pose: Float[Array, "3"],
    twist: Float[Array, "2"],
    command: Command,
    dt: Scalar,
    faults: FaultParams = FaultParams(),  # noqa: B008 (immutable)
) -> tuple[Float[Array, "3"], Float[Array, "2"]]:
    """Drive for one time step.

    The command is clipped to the speed limits and then to what the acceleration limits allow; a
    command that is not a number counts as zero.

    Args:
        params: Limits of the robot.
        pose: x, y, yaw [m, rad].
        twist: v [m/s], omega [rad/s] of the wheels.
        command: The twist asked for.
        dt: Time step [s].
        faults: Slip.

    Returns:
        (pose, twist) after the step: yaw in [-pi, pi); the twist is that of the wheels, slip or not.
    """
    v, omega = (jnp.where(jnp.isnan(u), 0.0, u) for u in (command.v, command.omega))
    v = jnp.clip(v, params.v_min, params.v_max)
    omega = jnp.clip(omega, -params.w_max, params.w_max)
    v = jnp.clip(v, twist[0] - params.a_max * dt, twist[0] + params.a_max * dt)
    omega = jnp.clip(omega, twist[1] - params.alpha_max * dt, twist[1] + params.alpha_max * dt)

    length, turn = v * (1 - faults.slip_v) * dt, omega * (1 - faults.slip_omega) * dt
    chord, heading = length * jnp.sinc(turn / (2 * jnp.pi)), pose[2] + turn / 2
    x, y = pose[0] + chord * jnp.cos(heading), pose[1] + chord * jnp.sin(heading)
    return jnp.stack([x, y, wrap_angle(pose[2] + turn)]), jnp.stack([v, omega])


@jax.jit
def odometry(
    estimate: Float[Array, "3"],
    before: Float[Array, "3"],
    after: Float[Array, "3"],
    faults: FaultParams,
) -> Float[Array, "3"]:
    """Where the robot believes it is after it moved from one true pose to the next.

    Args:
        estimate: The believed x, y, yaw at `before` [m, rad].
        before: The true pose then.
        after: The true pose now.
        faults: Drift.

    Returns:
        The believed pose now.
    """
    moved = compose(inverse(before), after)
    distance = jnp.hypot(moved[0], moved[1])
    scale = 1 + faults.drift_distance
    yaw = moved[2] + distance * faults.drift_yaw
    return compose(estimate, jnp.stack([moved[0] * scale, moved[1] * scale, yaw]))
