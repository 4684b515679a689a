"""One call for research scripts: `plan` a motion for any price, by MPPI (`mppi`, eq. 1-3 there) in the planners' model.

With commands u_t = (v_t, omega_t), t = 1..T, of which the first is for now, limited as `mppi_rollout` has it (eq. 1), and
the heading held through each step (eq. 2),

    yaw_t = yaw_{t-1} + omega_t dt,   x_t = x_{t-1} + v_t (cos, sin)(yaw_{t-1}) dt                                      (1)
    J(u) = sum_t price(x_t, yaw_t, u_t)                                                                                 (2)
    J(u) = sum_t c(x_t) |v_t| dt + |goal - x_T|                                 if c, a cost per metre, is given        (3)

c is what a metre there costs beyond the metre of progress that it gains: 0 where driving is free, lambda P_dead^foot for
the paper's objective (eq. 1 there), inf where nothing drives. Poses, field and goal share one frame, say odom.

`drive` is J and the path of given commands, differentiable by `jax.grad` in commands, pose, field and data. `plan` is a
smooth function of what it is given for one key, differentiable forwards (`jax.jvp`, `jax.jacfwd`): its retries are a loop.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from drnav_jax import geometry
from drnav_jax.planning import mppi, mppi_rollout
from drnav_jax.planning.dynamics import Motion
from drnav_jax.planning.mppi import MppiParams, MppiSpec, MppiState
from drnav_jax.planning.mppi_rollout import Cost, Priced
from drnav_jax.planning.noise import NoiseSpec
from drnav_jax.types import GridMap, RobotParams

COLLISION = 1e6  # [m] added to J where the path comes into a cell of infinite cost

Price = Callable[[Any, Motion], Array]  # (data, where K robots are and how fast they move) -> [K] price of that step


class PlanParams(NamedTuple):
    """What may be swept."""

    robot: RobotParams = RobotParams()
    mppi: MppiParams = MppiParams(temperature=0.05, gamma=0.0, std_v=0.4, std_w=0.8)


class PlanState(NamedTuple):
    """The robot, and what is kept from one plan to the next."""

    pose: Array  # [3] x, y [m], yaw [rad]
    twist: Array  # [2] v [m/s], omega [rad/s]
    mppi: MppiState  # the commands to begin with


class Plan(NamedTuple):
    """The commands and what one looks at."""

    commands: Float[Array, "T 2"]  # v [m/s], omega [rad/s], within the limits; the first is for now
    path: Float[Array, "T 3"]  # pose after each command, in the frame of the state's
    cost: Float[Array, ""]  # J of these commands
    failed: Bool[Array, ""]  # every sample comes into cells of infinite cost: the commands brake
    best: Float[Array, ""]  # least J of a sample of the last iteration, with `MppiParams.gamma`'s share
    effective: Float[Array, ""]  # effective sample size, 1..num_samples
    temperature: Float[Array, ""]  # as used
    state: PlanState  # where the model is after the first command; on a robot replace pose and twist by what is measured


def init(pose: Float[Array, "3"], twist: Float[Array, "2"] | None = None, *, num_steps: int = 40) -> PlanState:
    """A robot with nothing planned yet.

    Args:
        pose: x, y, yaw [m, rad].
        twist: v, omega [m/s, rad/s]; None = it stands.
        num_steps: T, commands planned ahead.

    Raises:
        ValueError: If there are fewer than 2 steps.
    """
    twist = jnp.zeros(2, jnp.float32) if twist is None else twist
    without_bank = jax.random.key(0)  # which nothing is drawn with
    return PlanState(pose=pose, twist=twist, mppi=mppi.init(MppiSpec(num_steps=num_steps), MppiParams(), without_bank))


def _metres(dt: float) -> Cost:
    """Equation (3); its data are the finite costs, which cells are closed, and the goal."""

    def look(data: Any, m: Motion) -> tuple[Array, Array]:
        open_cost, closed, _ = data
        xy = jnp.stack([m.x, m.y], axis=-1)
        return geometry.sample_bilinear(open_cost, xy) * jnp.abs(m.v) * dt, geometry.sample_nearest(closed, xy)

    def step(data: Any, carry: tuple[Array, Array], m: Motion, _: Array) -> tuple[Array, Array]:
        paid, hit = look(data, m)
        return carry[0] + paid, carry[1] | hit

    def finish(data: Any, carry: tuple[Array, Array], m: Motion) -> Priced:
        paid, hit = carry
        goal = data[2]
        # at the goal itself the distance has no gradient, and its square root would give one that is no number
        far = jnp.sqrt(jnp.square(m.x - goal[0]) + jnp.square(m.y - goal[1]) + 1e-12)
        terms = jnp.stack([paid, far, jnp.where(hit, COLLISION, 0.0)])
        return Priced(jnp.sum(terms, axis=0), terms, hit)

    return Cost(begin=look, step=step, finish=finish)


def _meaning(
    cost_fn_or_field: Price | Cost | GridMap, data: Any, goal: Float[Array, "2"] | None
) -> tuple[Price | Cost | None, Any]:
    """What is static of a cost (None: a field) and what is traced."""
    if not isinstance(cost_fn_or_field, GridMap):
        if goal is not None:
            raise ValueError("goal belongs to a field; hand a function what it looks at as data.")
        return cost_fn_or_field, data
    if goal is None or data is not None:
        raise ValueError("a field of cost per metre needs goal=(x, y) [m], and takes no data.")
    closed = jnp.isinf(cost_fn_or_field.values)
    finite = jnp.where(closed, 0.0, cost_fn_or_field.values)
    at = cost_fn_or_field._replace
    return None, (at(values=finite), at(values=closed), jnp.asarray(goal, jnp.float32))


def _cost(price: Price | Cost | None, dt: float) -> Cost:
    if price is None:
        return _metres(dt)
    return price if isinstance(price, Cost) else mppi_rollout.running(price)


def _driven(
    robot: RobotParams, pose: Array, twist: Array, cost: Cost, data: Any, commands: Array, dt: float
) -> tuple[Array, Array, Array]:
    """(commands within the limits, path, J)."""
    limits = mppi_rollout.limits_of(robot)
    u = mppi.clamp(limits, commands, twist, dt)
    yaw = pose[2] + jnp.concatenate([jnp.zeros(1, u.dtype), jnp.cumsum(u[:, 1] * dt)])
    x = pose[0] + jnp.cumsum(u[:, 0] * jnp.cos(yaw[:-1]) * dt)
    y = pose[1] + jnp.cumsum(u[:, 0] * jnp.sin(yaw[:-1]) * dt)
    alone, one = jnp.zeros((*u.shape, 1), u.dtype), jnp.ones(2, u.dtype)
    priced = mppi_rollout.rollout(cost, data, limits, pose, twist, u, alone, one, dt=dt, immediate=True)
    return u, jnp.stack([x, y, geometry.wrap_angle(yaw[1:])], axis=-1), priced.total[0]


@partial(jax.jit, static_argnames=("price", "dt"))
def _drive(params: PlanParams, state: PlanState, price: Any, data: Any, commands: Array, dt: float) -> tuple[Array, Array]:
    _, path, total = _driven(params.robot, state.pose, state.twist, _cost(price, dt), data, commands, dt)
    return path, total


def drive(
    params: PlanParams,
    state: PlanState,
    cost_fn_or_field: Price | Cost | GridMap,
    commands: Float[Array, "T 2"],
    *,
    data: Any = None,
    goal: Float[Array, "2"] | None = None,
    dt: float = 0.1,
) -> tuple[Float[Array, "T 3"], Float[Array, ""]]:
    """Path and J of given commands, as far as the limits allow them; differentiable. Arguments as in `plan`.

    Returns:
        (pose after each command, J).
    """
    price, looked_at = _meaning(cost_fn_or_field, data, goal)
    return _drive(params, state, price, looked_at, commands, dt)


@partial(jax.jit, static_argnames=("spec", "price"))
def _plan(spec: MppiSpec, params: PlanParams, state: PlanState, price: Any, data: Any, key: PRNGKeyArray) -> Plan:
    cost, limits = _cost(price, spec.dt), mppi_rollout.limits_of(params.robot)
    held, sent, info = mppi.plan(spec, params.mppi, limits, cost, data, state.mppi, state.pose, state.twist, key)
    wanted = jnp.concatenate([jnp.stack([sent.v, sent.omega])[None], held.control[:-1]])
    commands, path, total = _driven(params.robot, state.pose, state.twist, cost, data, wanted, spec.dt)
    return Plan(
        commands=commands, path=path, cost=total, failed=info.failed, best=info.cost, effective=info.effective,
        temperature=info.temperature, state=PlanState(pose=path[0], twist=commands[0], mppi=held),
    )  # fmt: skip


def plan(
    params: PlanParams,
    state: PlanState,
    cost_fn_or_field: Price | Cost | GridMap,
    key: PRNGKeyArray,
    *,
    num_samples: int,
    data: Any = None,
    goal: Float[Array, "2"] | None = None,
    dt: float = 0.1,
    num_iterations: int = 1,
    noise: NoiseSpec = NoiseSpec(),  # noqa: B008 (immutable)
    smooth: bool = True,
) -> Plan:
    """Improve the state's commands by samples around them (module docstring). Compiled; the caller vmaps.

    Args:
        params: Robot and MPPI; sweep them without compiling again.
        state: From `init`, or of the last plan.
        cost_fn_or_field: `(data, motion) -> [K]`, the price of one step of K candidates (static: define it once; a sum
            over steps, eq. 2); a `Cost`; or a `GridMap` of cost per metre (traced, eq. 3), bilinear between the centres
            of cells, and its edge's value outside.
        key: Randomness.
        num_samples: K, candidates (static).
        data: What a function looks at; any pytree, traced.
        goal: Where a field's plans lead to [m].
        dt: Time per command [s] (static).
        num_iterations: Improvements (static).
        noise: What candidates are perturbed by (static); without a bank.
        smooth: Pass the commands through MPPI's Savitzky-Golay filter (static).

    Raises:
        ValueError: If a count or dt is out of range, the noise has a bank, or goal and data do not belong to the cost.
    """
    if noise.bank:
        raise ValueError(f"plan draws fresh noise: NoiseSpec.bank must be 0, got {noise.bank}.")
    if num_samples < 1:
        raise ValueError(f"num_samples must be >= 1, got {num_samples}.")
    spec = MppiSpec(
        num_samples=num_samples, num_steps=state.mppi.control.shape[0], dt=dt, num_iterations=num_iterations,
        noise=noise, smooth=smooth, immediate=True, num_explained=1,
    )  # fmt: skip
    price, looked_at = _meaning(cost_fn_or_field, data, goal)
    return _plan(spec, params, state, price, looked_at, key)
