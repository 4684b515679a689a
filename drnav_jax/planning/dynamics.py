"""The unicycle with speed and acceleration limits, as every planner here rolls it out.

    v_k     = clip(v_target, v_{k-1} -+ a dt),  omega alike          (the limits of `RobotParams`)
    yaw_k   = yaw_{k-1} + omega_k dt
    x_k     = x_{k-1} + v_k dt cos(yaw_{k-1} + omega_k dt / 2)       (midpoint rule: third-order exact on arcs)

Inside a rollout the heading is the unit vector (c, s), turned each step by the angle omega dt through a polynomial: no
sine or cosine is evaluated in the loop (for |omega dt| <= 0.3 rad the error is below 2e-6 per step).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from drnav_jax.grids import greater, lesser
from drnav_jax.types import Command, RobotParams, Scalar


class Motion(NamedTuple):
    """Where K rolled-out robots are; all `[K]`."""

    x: Array  # [m]
    y: Array  # [m]
    c: Array  # cosine of the yaw
    s: Array  # sine of the yaw
    v: Array  # [m/s]
    w: Array  # [rad/s]


def approach(value: Array, target: Array, step: Scalar) -> Array:
    """`target`, as far as `value` may change by `step` (>= 0) in one tick."""
    return lesser(greater(target, value - step), value + step)


def rotate(c: Array, s: Array, angle: Array) -> tuple[Array, Array]:
    """Turn the unit vector (c, s) by a small angle [rad]; see the module docstring for the error."""
    a2 = angle * angle
    ca = 1.0 - a2 * (0.5 - a2 * (1.0 / 24.0))
    sa = angle * (1.0 - a2 * (1.0 / 6.0 - a2 * (1.0 / 120.0)))
    return c * ca - s * sa, s * ca + c * sa


def start(pose: Float[Array, "3"], twist: Float[Array, "2"], num: int) -> Motion:
    """K copies of the robot at `pose` (x, y, yaw) with `twist` (v, omega)."""
    one = jnp.ones(num, jnp.float32)
    return Motion(
        x=pose[0] * one, y=pose[1] * one, c=jnp.cos(pose[2]) * one, s=jnp.sin(pose[2]) * one,
        v=twist[0] * one, w=twist[1] * one,
    )  # fmt: skip


def advance(motion: Motion, v_target: Array, w_target: Array, robot: RobotParams, dt: Scalar) -> Motion:
    """One step of `dt` [s] towards the target speeds, all `[K]`."""
    v = approach(motion.v, v_target, robot.a_max * dt)
    w = approach(motion.w, w_target, robot.alpha_max * dt)
    half = 0.5 * dt * w
    c_mid, s_mid = rotate(motion.c, motion.s, half)
    c, s = rotate(c_mid, s_mid, half)
    return Motion(x=motion.x + v * dt * c_mid, y=motion.y + v * dt * s_mid, c=c, s=s, v=v, w=w)


def limit(v: Scalar, omega: Scalar, twist: Float[Array, "2"], robot: RobotParams, dt: Scalar) -> Command:
    """The nearest command within speed and acceleration limits; what is not finite becomes braking.

    Args:
        v: Wanted speed [m/s].
        omega: Wanted turn rate [rad/s].
        twist: Speeds now (v, omega), finite.
        robot: Limits.
        dt: Time until the next command [s].
    """
    v, omega = jnp.asarray(v, jnp.float32), jnp.asarray(omega, jnp.float32)
    sane = jnp.isfinite(v) & jnp.isfinite(omega)
    v, omega = jnp.where(sane, v, 0.0), jnp.where(sane, omega, 0.0)
    v = jnp.clip(approach(twist[0], v, robot.a_max * dt), robot.v_min, robot.v_max)
    omega = jnp.clip(approach(twist[1], omega, robot.alpha_max * dt), -robot.w_max, robot.w_max)
    return Command(v=v, omega=omega)
