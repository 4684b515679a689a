"""DWB as in Nav2: every twist of a grid is rolled out, judged by critics (`dwb_critics`), and the first of the best wins.

Twists, with T = sim_time and the window reachable within it,

    v in linspace(max(v_min, v_0 - a T), min(v_max, v_0 + a T), num_speeds),  omega alike                                (1)

with an exact 0 inserted where the samples step over it, a single sample where the window is a point, and (0, 0) left out.
(Such is the window of v_y of a robot that cannot move sideways.) From rest with Nav2's stock limits: 20 x 21 - 1 = 419.

    N = max(1, ceil(max(|v| T / linear granularity, |omega| T / angular granularity))),  dt = T / N                      (2)
    v_k = approach(v_{k-1}, v, a dt);  x_k = x_{k-1} + v_k cos(yaw_{k-1}) dt;  yaw_k = yaw_{k-1} + omega_k dt            (3)

The pose at the start counts, too. Total = sum of scale times raw over all critics; a trajectory that is illegal to any of
them is dropped. If none is left, DWB fails and commands 0.

All twists at once, `[K]` arrays in a scan over the longest N, in which shorter ones stand still at their end.
"""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drnav_jax import grids
from drnav_jax.planning import dwb_critics, dynamics
from drnav_jax.planning.dwb_critics import DwbParams, DwbState, Trajectories
from drnav_jax.planning.path import Path
from drnav_jax.types import Command, GridMap, RobotParams, Scalar

EPSILON = 1e-5  # [m/s] windows narrower than this are a point
ROUNDING = 1e-4  # [steps] by which float32 may miss an integer in (2)


@dataclasses.dataclass(frozen=True)
class DwbSpec:
    """Samples.

    Attributes:
        num_speeds: Of v.
        num_turns: Of omega.
        max_steps: Bound on N; a twist that needs more is rolled out in this many, coarser steps.
        num_explained: Best trajectories whose scores are in Info.
    """

    num_speeds: int = 20
    num_turns: int = 20
    max_steps: int = 128
    num_explained: int = 10

    def __post_init__(self) -> None:
        """Check counts."""
        if min(self.num_speeds, self.num_turns) < 2 or self.max_steps < 1:
            raise ValueError(
                "num_speeds and num_turns must be >= 2 and max_steps >= 1, "
                f"got {self.num_speeds}, {self.num_turns}, {self.max_steps}."
            )
        if not 1 <= self.num_explained <= self.num_speeds * self.num_turns:
            raise ValueError(f"num_explained must lie within 1..num_speeds num_turns, got {self.num_explained}.")


class Sampling(NamedTuple):
    """Nav2's bringup."""

    sim_time: Scalar = 1.7  # [] [s]
    linear: Scalar = 0.05  # [] granularity [m]
    angular: Scalar = 0.025  # [] granularity [rad]


class Info(NamedTuple):
    """What one looks at."""

    failed: Array  # [] bool, no legal trajectory
    cost: Array  # [] total of the chosen
    chosen: Array  # [7] scale times raw of the chosen
    best: Array  # [n, 7] of the best n legal trajectories, the best first
    best_index: Array  # [n] int32, which those are
    best_cost: Array  # [n] their totals; inf where fewer are legal
    num_legal: Array  # [] int32
    illegal: Array  # [7] int32, trajectories that each critic calls illegal


def levels(low: Scalar, high: Scalar, num: int) -> tuple[Float[Array, " n"], Bool[Array, " n"]]:
    """The num + 1 places for samples of equation (1), ascending, and which of them are used."""
    low, high = jnp.asarray(low, jnp.float32), jnp.asarray(high, jnp.float32)
    index = jnp.arange(num + 1)
    value = low + index.astype(jnp.float32) * ((high - low) / (num - 1))
    value = jnp.where(index == num - 1, high, value)
    before = jnp.sum((value[:num] < 0).astype(jnp.int32))  # the zero comes after so many
    over = (before > 0) & (before < num)
    over = over & (value[jnp.minimum(before, num - 1)] > 0)
    late = value[jnp.maximum(index - 1, 0)]
    with_zero = jnp.where(index < before, value, jnp.where(index == before, 0.0, late))
    point = jnp.abs(high - low) < EPSILON
    value = jnp.where(over & ~point, with_zero, value)
    return value, jnp.where(point, index == 0, (index < num) | over)


def twists(
    spec: DwbSpec, sampling: Sampling, robot: RobotParams, twist: Float[Array, "2"]
) -> tuple[Float[Array, " K"], Float[Array, " K"], Bool[Array, " K"]]:
    """All v and omega of (1), v outermost, and which of them are used.

    Args:
        spec: Samples.
        sampling: Time of the window.
        robot: Limits.
        twist: Speeds now.
    """

    def window(now: Array, low: Scalar, high: Scalar, rate: Scalar, num: int) -> tuple[Array, Array]:
        now = jnp.clip(now, low, high)
        reach = rate * sampling.sim_time
        return levels(jnp.maximum(low, now - reach), jnp.minimum(high, now + reach), num)

    v, v_used = window(twist[0], robot.v_min, robot.v_max, robot.a_max, spec.num_speeds)
    w, w_used = window(twist[1], -robot.w_max, robot.w_max, robot.alpha_max, spec.num_turns)
    v, v_used = jnp.repeat(v, w.shape[0]), jnp.repeat(v_used, w.shape[0])
    w, w_used = jnp.tile(w, spec.num_speeds + 1), jnp.tile(w_used, spec.num_speeds + 1)
    return v, w, v_used & w_used & ((v != 0) | (w != 0))


def rollout(
    spec: DwbSpec,
    sampling: Sampling,
    robot: RobotParams,
    costs: GridMap,
    pose: Float[Array, "3"],
    twist: Float[Array, "2"],
    v: Float[Array, " K"],
    w: Float[Array, " K"],
) -> Trajectories:
    """Equations (2) and (3), with what the critics ask of every pose.

    Args:
        spec: Bound on N.
        sampling: Time and granularities.
        robot: Accelerations.
        costs: Costmap 0..255 in the frame of the pose.
        pose: Robot.
        twist: Its speeds.
        v: Speeds to tend to [m/s].
        w: Turn rates to tend to [rad/s].
    """
    span = jnp.asarray(sampling.sim_time, jnp.float32)
    needed = jnp.maximum(jnp.abs(v) * span / sampling.linear, jnp.abs(w) * span / sampling.angular)
    steps = jnp.clip(jnp.ceil(needed - ROUNDING), 1, spec.max_steps)
    dt = span / steps
    dv, dw = robot.a_max * dt, robot.alpha_max * dt
    h, width = costs.values.shape
    inv, flat = 1.0 / costs.resolution, costs.values.reshape(-1)

    def look(x: Array, y: Array) -> tuple[Array, Array]:
        fx, fy = (x - costs.origin[0]) * inv, (y - costs.origin[1]) * inv
        col = jnp.clip(fx, 0.0, width - 1.0).astype(jnp.int32)
        row = jnp.clip(fy, 0.0, h - 1.0).astype(jnp.int32)
        on = (fx >= 0) & (fy >= 0) & (fx < width) & (fy < h)
        return flat.at[row * width + col].get(mode="promise_in_bounds"), on

    def step(carry: tuple, k: Array) -> tuple[tuple, None]:
        m, cost, on_grid, blocked = carry
        going = k < steps
        now_v, now_w = dynamics.approach(m.v, v, dv), dynamics.approach(m.w, w, dw)
        c, s = dynamics.rotate(m.c, m.s, now_w * dt)
        ahead = m._replace(x=m.x + now_v * dt * m.c, y=m.y + now_v * dt * m.s, c=c, s=s, v=now_v, w=now_w)
        m = jax.tree.map(lambda a, b: jnp.where(going, a, b), ahead, m)
        found, on = look(m.x, m.y)
        return (m, found, on_grid & on, blocked | (found >= 253.0)), None

    start = dynamics.start(pose, twist, v.shape[0])
    found, on = look(start.x, start.y)
    carry = (start, found, on, found >= 253.0)
    (m, cost, on_grid, blocked), _ = jax.lax.scan(step, carry, jnp.arange(spec.max_steps, dtype=jnp.float32))
    return Trajectories(v=v, w=w, x=m.x, y=m.y, c=m.c, s=m.s, cost=cost, on_grid=on_grid, blocked=blocked)


@partial(jax.jit, static_argnames="spec")
def plan(
    spec: DwbSpec,
    sampling: Sampling,
    params: DwbParams,
    robot: RobotParams,
    costs: GridMap,
    path: Path,
    state: DwbState,
    pose: Float[Array, "3"],
    twist: Float[Array, "2"],
    goal: Float[Array, "3"],
) -> tuple[DwbState, Command, Info]:
    """The best twist (module docstring): a speed to tend to, not one reached within a tick.

    Args:
        spec: Samples (static).
        sampling: Time and granularities.
        params: Numbers of the critics.
        robot: Limits.
        costs: Costmap 0..255, unknown 255.
        path: What lies ahead (`path.ahead`).
        state: From `dwb_critics.init` or the last command.
        pose: Robot, in the frame of map and path.
        twist: Its speeds.
        goal: x, y, yaw.
    """
    v, w, used = twists(spec, sampling, robot, twist)
    rolled = rollout(spec, sampling, robot, costs, pose, twist, v, w)
    state = dwb_critics.enter(params, state, pose, twist, goal)
    judged = dwb_critics.judge(params, state, costs, path, pose, twist, goal, rolled)
    asked = (judged.scale != 0)[:, None]
    terms = judged.scale[:, None] * jnp.where(asked, judged.raw, 0.0)
    legal = used & jnp.all(judged.legal | ~asked, axis=0)
    total = jnp.where(legal, jnp.sum(terms, axis=0), jnp.inf)
    least, index = grids.least(total, spec.num_explained)
    failed = ~jnp.any(legal)
    sent = jnp.where(failed, 0.0, jnp.stack([v[index[0]], w[index[0]]]))
    state = dwb_critics.remember(params, state, pose, sent)
    return state, Command(v=sent[0], omega=sent[1]), Info(
        failed=failed, cost=least[0], chosen=terms[:, index[0]], best=terms[:, index].T,
        best_index=index.astype(jnp.int32), best_cost=least, num_legal=jnp.sum(legal.astype(jnp.int32)),
        illegal=jnp.sum((asked & ~judged.legal & used[None, :]).astype(jnp.int32), axis=1),
    )  # fmt: skip
