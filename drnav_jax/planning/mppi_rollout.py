"""Driving K perturbed control sequences, and pricing them on the way: the half of MPPI (`mppi`) that takes the time.

With c = u + sigma eps, and v_0, omega_0 measured,

    v_t = clip(c_{t-1}, v_{t-1} - down dt, v_{t-1} + up dt),  omega likewise with alpha_max                              (1)
        where (up, down) = (a_max, |a_min|) if v_{t-1} > 0, else (|a_min|, a_max)
    yaw_t = yaw_0 + sum_{k<=t} omega_k dt,  x_t = x_0 + sum_{k<=t} v_k cos(yaw_{k-1}) dt,  y likewise                    (2)

So Nav2 takes it that a command acts a step after it was sent, and it sends the second one. `immediate` is for robots whose
commands act at once: v_t = clip(c_t, ...) from v_{-1} measured.

What bounds it: one table look-up per sample and step, if the cost has one. State is a structure of `[K]` arrays carried by
a scan, the heading turns by a polynomial, and costs accumulate while rolling out, so nothing of size T x K is written. No
two steps are written out one after the other: XLA on a CPU would compute the first anew for each use in the second.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drnav_jax.planning import dynamics
from drnav_jax.planning.dynamics import Motion
from drnav_jax.types import RobotParams, Scalar


class Limits(NamedTuple):
    """What the robot can do."""

    v_min: Scalar  # [] [m/s]
    v_max: Scalar  # [] [m/s]
    w_max: Scalar  # [] [rad/s]
    a_max: Scalar  # [] speeding up [m/s^2]
    a_min: Scalar  # [] slowing down, negative [m/s^2]
    alpha_max: Scalar  # [] [rad/s^2]


def limits_of(robot: RobotParams) -> Limits:
    """The limits of a robot that brakes as hard as it speeds up."""
    return Limits(robot.v_min, robot.v_max, robot.w_max, robot.a_max, -robot.a_max, robot.alpha_max)


class Priced(NamedTuple):
    """Costs of K trajectories."""

    total: Float[Array, " K"]
    terms: Float[Array, "C K"]  # what it is the sum of
    collides: Bool[Array, " K"]


@dataclasses.dataclass(frozen=True)
class Cost:
    """Functions that price trajectories while they are rolled out; `data` is what they look at, any pytree.

    Attributes:
        begin: (data, motion at t = 0) -> carry.
        step: (data, carry, motion at t, t) -> carry, for t = 1..T - 1.
        finish: (data, carry, motion at T - 1) -> Priced.
        seldom: (data, carry, motion) -> carry, after `step` at every multiple of `period`; for what is dear.
        period: See `seldom`.
    """

    begin: Callable[[Any, Motion], Any]
    step: Callable[[Any, Any, Motion, Array], Any]
    finish: Callable[[Any, Any, Motion], Priced]
    seldom: Callable[[Any, Any, Motion], Any] | None = None
    period: int = 1


def running(price: Callable[[Any, Motion], Array]) -> Cost:
    """The cost that is the sum of `price(data, motion)` `[K]` over all steps. Make it once: it is a static argument."""

    def finish(data: Any, total: Array, motion: Motion) -> Priced:
        del data, motion
        return Priced(total, total[None], jnp.zeros(total.shape, bool))

    return Cost(begin=price, step=lambda data, total, m, _: total + price(data, m), finish=finish)


def reachable(v: Array, target: Array, up: Scalar, down: Scalar) -> Array:
    """Equation (1): `target`, as far as v gets towards it by changes of at most `up` and `down` (> 0) [m/s]."""
    # both answers, then the choice: choosing between two scalars first makes the whole rollout twice as slow
    forward = dynamics.lesser(dynamics.greater(target, v - down), v + up)
    backward = dynamics.lesser(dynamics.greater(target, v - up), v + down)
    return jnp.where(v > 0, forward, backward)


def rollout(
    cost: Cost,
    data: Any,
    limits: Limits,
    pose: Float[Array, "3"],
    twist: Float[Array, "2"],
    control: Float[Array, "T 2"],
    deviation: Float[Array, "T 2 K"],
    scale: Float[Array, "2"],
    *,
    dt: float,
    gains: Float[Array, "2 D"] | None = None,
    immediate: bool = False,
) -> Priced:
    """Drive c = control + scale deviation by (1) and (2), and price it.

    Args:
        cost: Prices.
        data: What the cost looks at.
        limits: Accelerations.
        pose: Robot (x, y, yaw).
        twist: Its speeds (v, omega).
        control: u.
        deviation: eps.
        scale: sigma of v [m/s] and of omega [rad/s].
        dt: Step [s].
        gains: D gains of v and omega between what is commanded and what is driven: every sequence is driven with each,
            and the result holds D blocks of K.
        immediate: Commands act at once.
    """
    num_steps, _, num = deviation.shape
    copies = 1 if gains is None else gains.shape[1]
    gain = None if gains is None else jnp.repeat(gains, num, axis=1)
    up, down, turn = limits.a_max * dt, -limits.a_min * dt, limits.alpha_max * dt

    def drive(m: Motion, v: Array, w: Array) -> Motion:
        """Equation (2): the position moves along the old heading."""
        dv, dw = (v, w) if gain is None else (v * gain[0], w * gain[1])
        c, s = dynamics.rotate(m.c, m.s, dw * dt)
        return Motion(x=m.x + dv * dt * m.c, y=m.y + dv * dt * m.s, c=c, s=s, v=dv, w=dw)

    def speeds(v: Array, w: Array, u: Array, eps: Array) -> tuple[Array, Array]:
        """Equation (1)."""
        c = u[:, None] + scale[:, None] * eps
        c = jnp.tile(c, (1, copies)) if copies > 1 else c
        return reachable(v, c[0], up, down), dynamics.approach(w, c[1], turn)

    def step(carry: tuple, now: tuple[Array, Array, Array]) -> tuple[tuple, None]:
        m, v, w, costs = carry
        u, eps, t = now
        v, w = speeds(v, w, u, eps)
        m = drive(m, v, w)
        return (m, v, w, cost.step(data, costs, m, t)), None

    begin = dynamics.start(pose, twist, num * copies)
    v, w = begin.v, begin.w
    if immediate:
        v, w = speeds(v, w, control[0], deviation[0])
        control, deviation = control[1:], deviation[1:]
    first = drive(begin, v, w)
    carry = (first, v, w, cost.begin(data, first))
    steps = num_steps - 1
    inputs = (control[:steps], deviation[:steps], jnp.arange(1, num_steps))
    blocks = 0 if cost.seldom is None else steps // cost.period

    def block(carry: tuple, part: tuple[Array, Array, Array]) -> tuple[tuple, None]:
        m, v, w, costs = jax.lax.scan(step, carry, part)[0]
        assert cost.seldom is not None
        return (m, v, w, cost.seldom(data, costs, m)), None

    if blocks:
        whole = jax.tree.map(lambda a: a[: blocks * cost.period].reshape(blocks, cost.period, *a.shape[1:]), inputs)
        carry, _ = jax.lax.scan(block, carry, whole)
    if steps > blocks * cost.period or not blocks:
        carry, _ = jax.lax.scan(step, carry, jax.tree.map(lambda a: a[blocks * cost.period :], inputs))
    return cost.finish(data, carry[3], carry[0])
