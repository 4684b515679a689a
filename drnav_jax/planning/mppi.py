"""Model predictive path integral control as in Nav2, for any cost (`mppi_critics` has Nav2's).

One step, with u the control sequence kept from the last one, eps noise of K samples, c = u + sigma eps:

    J = cost of driving c (`mppi_rollout`) + sum_axes gamma / sigma^2 sum_t u_t (c_t - u_t)                              (1)
    w = exp(-(J - min J) / temperature), normalised (`mppi_weights`);   u <- sum w c                                     (2)
    u <- Savitzky-Golay(u);   u_t clamped to the speed limits and to what is reachable from u_{t-1} (u_{-1}: measured)   (3)
    send u_1 (u_0 where commands act at once), shift u to the left, repeat its last element                              (4)

If every trajectory collides, u and the history are reset and the step is tried again; then it fails, and brakes.

Beside it: other noise (`noise`); `rate_space` perturbs the rate of the control instead (eps is summed up over time, and the
squared change per step is paid, Kim et al. 2022); each sample driven with D disturbed gains of v and omega and judged by
the mean of the worst share `tail` of its costs (CVaR; 0 is the worst case); and the temperature found at which the
effective sample size (sum w)^2 / sum w^2 is a given share of K.

What bounds it: random numbers if they are fresh (`NoiseSpec.bank`, `antithetic`), else the rollout.
"""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from drnav_jax import grids
from drnav_jax.planning import dynamics, mppi_rollout, mppi_weights, noise, savitzky_golay
from drnav_jax.planning.mppi_rollout import Cost, Limits
from drnav_jax.planning.noise import NoiseParams, NoiseSpec
from drnav_jax.types import Command, Scalar


@dataclasses.dataclass(frozen=True)
class MppiSpec:
    """Sizes and switches.

    Attributes:
        num_samples: K.
        num_steps: T.
        dt: Step of the model, and time between two commands [s].
        num_iterations: Updates per command.
        noise: What c is perturbed by.
        rate_space: Perturb the rate of the control.
        num_disturbances: D; 1 drives every sample once, undisturbed.
        adapt_temperature: Choose the temperature by `MppiParams.effective_share`.
        smooth: Savitzky-Golay filter.
        clamp: Clamp u to the limits.
        immediate: Commands act at once, not a step later as Nav2 has it.
        num_explained: Best candidates whose terms are in Info.
    """

    num_samples: int = 2000
    num_steps: int = 56
    dt: float = 0.05
    num_iterations: int = 1
    noise: NoiseSpec = NoiseSpec()
    rate_space: bool = False
    num_disturbances: int = 1
    adapt_temperature: bool = False
    smooth: bool = True
    clamp: bool = True
    immediate: bool = False
    num_explained: int = 10

    def __post_init__(self) -> None:
        """Check sizes."""
        if self.num_steps < 2 or self.dt <= 0:
            raise ValueError(f"num_steps must be >= 2 and dt > 0 s, got {self.num_steps} and {self.dt}.")
        if min(self.num_iterations, self.num_disturbances) < 1 or not 1 <= self.num_explained <= self.num_samples:
            raise ValueError(
                "num_iterations and num_disturbances must be >= 1 and num_explained within 1..num_samples, "
                f"got {self.num_iterations}, {self.num_disturbances}, {self.num_explained}."
            )


class MppiParams(NamedTuple):
    """Nav2's defaults, and what the rest needs."""

    temperature: Scalar = 0.3  # []
    gamma: Scalar = 0.015  # []
    std_v: Scalar = 0.2  # [] sigma of v [m/s] (in rate space [m/s^2])
    std_w: Scalar = 0.4  # [] sigma of omega [rad/s] (in rate space [rad/s^2])
    retries: Scalar = 1  # [] attempts beyond the first
    noise: NoiseParams = NoiseParams()
    change: Scalar = 0.0  # [] price of the squared change of c per step (rate space only)
    disturbance: Scalar = 0.1  # [] standard deviation of the gains of v and omega
    tail: Scalar = 0.25  # [] share of the disturbed costs that counts, the worst ones
    effective_share: Scalar = 0.02  # [] effective sample size over K


class MppiState(NamedTuple):
    """Kept between commands."""

    control: Array  # [T, 2] u: v [m/s], omega [rad/s]
    history: Array  # [4, 2] the last commands sent, the newest last
    bank: Array  # [T, 2, B] of noise


class Info(NamedTuple):
    """What one looks at."""

    failed: Array  # [] bool, every trajectory collides or has no finite cost: the command brakes
    cost: Array  # [] least J of the last update
    chosen: Array  # [C] terms of the cost, averaged over the samples as the update weights them
    best: Array  # [n, C] terms of the n best samples, the best first
    best_index: Array  # [n] int32, which samples those are
    best_cost: Array  # [n] their J: the terms, and the control cost of (1)
    effective: Array  # [] effective sample size
    temperature: Array  # [] as used


@partial(jax.jit, static_argnames="spec")
def init(spec: MppiSpec, params: MppiParams, key: PRNGKeyArray) -> MppiState:
    """Standing still; the key is for the bank of noise."""
    return MppiState(
        control=jnp.zeros((spec.num_steps, 2), jnp.float32),
        history=jnp.zeros((savitzky_golay.HISTORY, 2), jnp.float32),
        bank=noise.fill(spec.noise, params.noise, key, spec.num_steps, spec.num_samples),
    )


def clamp(
    limits: Limits, control: Float[Array, "T 2"], twist: Float[Array, "2"], dt: float
) -> Float[Array, "T 2"]:
    """The clamps of (3); what is not finite becomes braking."""
    control = jnp.where(jnp.isfinite(control), control, 0.0)
    up, down, turn = limits.a_max * dt, -limits.a_min * dt, limits.alpha_max * dt
    v = jnp.clip(control[:, 0], limits.v_min, limits.v_max)
    w = jnp.clip(control[:, 1], -limits.w_max, limits.w_max)

    def step(last: tuple[Array, Array], wanted: tuple[Array, Array]) -> tuple[tuple[Array, Array], Array]:
        now = mppi_rollout.reachable(last[0], wanted[0], up, down), dynamics.approach(last[1], wanted[1], turn)
        return now, jnp.stack(now)

    return jax.lax.scan(step, (twist[0], twist[1]), (v, w))[1]


def update(
    spec: MppiSpec,
    params: MppiParams,
    limits: Limits,
    cost: Cost,
    data: Any,
    control: Float[Array, "T 2"],
    eps: Float[Array, "T 2 K"],
    sign: Float[Array, "2"],
    pose: Float[Array, "3"],
    twist: Float[Array, "2"],
    key: PRNGKeyArray,
) -> tuple[Float[Array, "T 2"], Info]:
    """Equations (1) and (2), once. Arguments as in `plan`; eps is taken times sign; the key is for the disturbances.

    A sample whose cost is not finite has no weight.
    """
    sigma = jnp.stack([jnp.asarray(params.std_v, jnp.float32), jnp.asarray(params.std_w, jnp.float32)]) * sign
    pull = jnp.where(sigma != 0.0, params.gamma / jnp.where(sigma != 0.0, sigma, 1.0), 0.0)[None, :]
    deviation, wanted = eps, control
    if spec.rate_space:
        deviation = jnp.cumsum(eps, axis=0) * spec.dt
        wanted = (control - jnp.concatenate([twist[None], control[:-1]])) / spec.dt
    gains = None
    if spec.num_disturbances > 1:
        gains = 1.0 + params.disturbance * jax.random.normal(key, (2, spec.num_disturbances), jnp.float32)
    priced = mppi_rollout.rollout(
        cost, data, limits, pose, twist, control, deviation, sigma, dt=spec.dt, gains=gains, immediate=spec.immediate
    )
    if spec.num_disturbances > 1:
        priced = mppi_weights.tail_mean(priced, spec.num_samples, params.tail)
    total = priced.total + (pull * wanted).reshape(-1) @ eps.reshape(-1, spec.num_samples)
    if spec.rate_space:  # |c_t - c_{t-1}|^2, without what all samples share
        step = spec.dt * sigma[None, :]
        bent = jnp.square(step)[:, :, None] * jnp.square(eps) + 2.0 * (step * spec.dt * wanted)[:, :, None] * eps
        total = total + params.change * jnp.sum(bent, axis=(0, 1))
    priced_well = jnp.isfinite(total)
    worst = jnp.max(jnp.where(priced_well, total, -jnp.inf))
    total = jnp.where(priced_well, total, jnp.where(jnp.isfinite(worst), worst, 0.0))
    temperature = jnp.asarray(params.temperature, jnp.float32)
    if spec.adapt_temperature:
        temperature = mppi_weights.temperature_for(total, params.effective_share)
    total = jnp.where(priced_well | ~jnp.isfinite(worst), total, jnp.inf)
    weight, terms = mppi_weights.softmin(total, temperature), jnp.where(jnp.isfinite(priced.terms), priced.terms, 0.0)
    control = control + sigma[None, :] * (deviation @ weight)
    least, index = grids.least(total, spec.num_explained)
    return control, Info(
        failed=jnp.all(priced.collides | ~priced_well), cost=jnp.min(total), chosen=terms @ weight,
        best=terms[:, index].T, best_index=index.astype(jnp.int32), best_cost=least,
        effective=mppi_weights.effective_size(weight), temperature=temperature,
    )  # fmt: skip


@partial(jax.jit, static_argnames=("spec", "cost"))
def plan(
    spec: MppiSpec,
    params: MppiParams,
    limits: Limits,
    cost: Cost,
    data: Any,
    state: MppiState,
    pose: Float[Array, "3"],
    twist: Float[Array, "2"],
    key: PRNGKeyArray,
) -> tuple[MppiState, Command, Info]:
    """One command (module docstring).

    Args:
        spec: Sizes and switches (static).
        params: Temperature, noise, control cost.
        limits: Of the robot.
        cost: Prices of trajectories (static).
        data: What the cost looks at, any pytree.
        state: From `init` or the last command.
        pose: Robot (x, y, yaw) in the frame of `data`.
        twist: Its measured speeds (v, omega).
        key: Randomness.
    """

    def attempt(carry: tuple) -> tuple:
        count, control, history, _ = carry
        info = None
        for k, (eps, sign) in enumerate(held):
            key_gains = jax.random.fold_in(jax.random.fold_in(key, count), k)
            sign = sign * noise.mirror(count)
            control, info = update(spec, params, limits, cost, data, control, eps, sign, pose, twist, key_gains)
        assert info is not None
        # a sequence that collides is not built upon: the next attempt begins anew
        control, history = (jnp.where(info.failed, 0.0, a) for a in (control, history))
        return count + 1, control, history, info

    # drawn here and not in the loop, which would copy the bank
    held = [
        noise.draw(spec.noise, params.noise, state.bank, k, spec.num_samples)
        for k in jax.random.split(key, spec.num_iterations)
    ]
    begin = (jnp.zeros((), jnp.int32), state.control, state.history)
    shapes = jax.eval_shape(lambda: attempt((*begin, None)))[3]
    blank = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes)
    retries = jnp.asarray(params.retries, jnp.int32)  # also where all parameters were made floats
    again = lambda c: (c[0] == 0) | (c[3].failed & (c[0] <= retries))  # noqa: E731
    _, control, history, info = jax.lax.while_loop(again, attempt, (*begin, blank))
    if spec.smooth:
        control = savitzky_golay.smooth(control, history)
    if spec.clamp:
        control = clamp(limits, control, twist, spec.dt)
    sent = jnp.where(info.failed, 0.0, control[0 if spec.immediate else 1])
    shifted = jnp.concatenate([control[1:], control[-1:]])
    state = MppiState(
        control=jnp.where(info.failed, 0.0, shifted),
        history=jnp.concatenate([history[1:], sent[None]]),
        bank=state.bank,
    )
    return state, Command(v=sent[0], omega=sent[1]), info
