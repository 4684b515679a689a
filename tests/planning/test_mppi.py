"""MPPI: its update against plain loops and pytorch_mppi, what it keeps, and that it drives."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_nav2 as reference
from scipy import signal

from drnav_jax.planning import mppi, mppi_critics, mppi_rollout, mppi_weights, noise
from drnav_jax.planning import path as paths
from drnav_jax.planning.costmap import InflationParams
from drnav_jax.planning.mppi import MppiParams, MppiSpec
from drnav_jax.planning.mppi_critic_params import CriticParams, CriticSpec
from drnav_jax.planning.mppi_rollout import Limits, Priced
from drnav_jax.planning.noise import NoiseSpec
from drnav_jax.types import GridMap

CLOSE = 1e-5  # relative: float32 sums over samples and steps
STEPS, SAMPLES, DT = 24, 40, 0.05
LIMITS = Limits(v_min=-0.35, v_max=0.5, w_max=1.9, a_max=3.0, a_min=-2.3, alpha_max=3.5)
PARAMS = MppiParams()
PLAIN = MppiSpec(num_samples=SAMPLES, num_steps=STEPS, dt=DT, smooth=False, clamp=False)
POSE, TWIST = np.float32([0.3, -0.2, 0.8]), np.float32([0.2, -0.1])
GOAL = (1.5, 0.7)
KEY = jax.random.key(0)

plan = jax.jit(mppi.plan.__wrapped__, static_argnames=("spec", "cost"))


def f32(values):
    return jnp.asarray(values, jnp.float32)


def to_goal(goal, m):
    """A smooth running cost: distance to the goal, and turning."""
    return jnp.sqrt(jnp.square(m.x - goal[0]) + jnp.square(m.y - goal[1])) + 0.1 * jnp.square(m.w)


COST = mppi_rollout.running(to_goal)


def loops(u, eps, params=PARAMS, gains=((1.0, 1.0),), pose=POSE, twist=TWIST):
    """(c `[K, T, 2]`, costs `[D, K]`) in double precision."""
    c = u[None] + np.array([params.std_v, params.std_w]) * np.moveaxis(eps, 2, 0)
    costs = np.zeros((len(gains), len(c)))
    for d, (gain_v, gain_w) in enumerate(gains):
        for k, controls in enumerate(c):
            _, _, _, v, w = reference.mppi_rollout(pose, twist, controls, LIMITS, DT)
            x, y, yaw = map(float, pose)
            for a, b in zip(v * gain_v, w * gain_w, strict=True):
                x, y, yaw = x + a * np.cos(yaw) * DT, y + a * np.sin(yaw) * DT, yaw + b * DT
                costs[d, k] += np.hypot(x - GOAL[0], y - GOAL[1]) + 0.1 * b**2
    return c, costs


def draws(seed=0):
    rng = np.random.default_rng(seed)
    u = rng.normal(0, 0.2, (STEPS, 2)).astype(np.float32)
    return u, rng.normal(size=(STEPS, 2, SAMPLES)).astype(np.float32)


def update(u, eps, spec=PLAIN, params=PARAMS, key=KEY, sign=(1, 1)):
    return mppi.update(spec, params, LIMITS, COST, f32(GOAL), f32(u), f32(eps), f32(sign), f32(POSE), f32(TWIST), key)


@pytest.mark.parametrize("seed", range(3))
def test_the_update_is_that_of_the_loops(seed):
    u, eps = draws(seed)
    got, info = update(u, eps)
    c, costs = loops(u.astype(float), eps.astype(float))
    want, weight = reference.mppi_update(u, c, costs[0], 0.015, (0.2, 0.4), 0.3)
    np.testing.assert_allclose(got, want, rtol=CLOSE, atol=CLOSE)
    assert float(info.effective) == pytest.approx(1 / np.sum(weight**2), rel=1e-4)
    assert float(info.chosen[0]) == pytest.approx(float(weight @ costs[0]), rel=CLOSE)
    best = int(info.best_index[0])
    assert float(info.best[0, 0]) == pytest.approx(costs[0, best], rel=CLOSE)
    assert not bool(info.failed)


@pytest.mark.parametrize("rate_space", [False, True])
def test_signs_are_those_of_the_noise(rate_space):
    spec, params = dataclasses.replace(PLAIN, rate_space=rate_space), PARAMS._replace(change=2.0)
    u, eps = draws(8)
    want, _ = update(u, eps * np.float32([1, -1])[None, :, None], spec, params)
    got, _ = update(u, eps, spec, params, sign=(1, -1))
    np.testing.assert_allclose(got, want, rtol=CLOSE, atol=CLOSE)


def test_the_update_is_pytorch_mppis():
    """Same noise, dynamics and cost; gamma is its temperature."""
    torch = pytest.importorskip("torch", reason="needs the bench extra")
    pytorch_mppi = pytest.importorskip("pytorch_mppi", reason="needs the bench extra")
    u, eps = draws(7)
    params = PARAMS._replace(gamma=PARAMS.temperature)
    up, down, turn = LIMITS.a_max * DT, -LIMITS.a_min * DT, LIMITS.alpha_max * DT

    def dynamics(state, control):
        x, y, yaw, v, w = state.unbind(dim=1)
        x, y, yaw = x + v * torch.cos(yaw) * DT, y + v * torch.sin(yaw) * DT, yaw + w * DT
        low, high = torch.where(v > 0, v - down, v - up), torch.where(v > 0, v + up, v + down)
        v = torch.minimum(torch.maximum(control[:, 0], low), high)
        w = torch.minimum(torch.maximum(control[:, 1], w - turn), w + turn)
        return torch.stack([x, y, yaw, v, w], dim=1)

    def cost(state, control):
        # its dynamics hand on the next speed; the turn rate that led here is the change of yaw
        return torch.hypot(state[:, 0] - GOAL[0], state[:, 1] - GOAL[1])

    sigma = torch.diag(torch.tensor([params.std_v**2, params.std_w**2], dtype=torch.float64))
    controller = pytorch_mppi.MPPI(
        dynamics, cost, 5, sigma, num_samples=SAMPLES, horizon=STEPS, lambda_=params.temperature,
        U_init=torch.tensor(u, dtype=torch.float64),
    )  # fmt: skip
    scaled = np.moveaxis(eps, 2, 0) * np.array([params.std_v, params.std_w])
    controller._sample_noise = lambda shape: torch.tensor(scaled, dtype=torch.float64)
    controller.command(torch.tensor([*POSE, *TWIST], dtype=torch.float64), shift_nominal_trajectory=False)
    only_distance = mppi_rollout.running(lambda goal, m: jnp.sqrt(jnp.square(m.x - goal[0]) + jnp.square(m.y - goal[1])))
    got, _ = mppi.update(
        PLAIN, params, LIMITS, only_distance, f32(GOAL), f32(u), f32(eps), f32([1, 1]), f32(POSE), f32(TWIST), KEY
    )
    np.testing.assert_allclose(got, controller.U.numpy(), rtol=CLOSE, atol=CLOSE)


def test_clamping_is_that_of_the_loops():
    rng = np.random.default_rng(1)
    for twist in ([0.0, 0.0], [0.45, 1.0], [-0.3, -1.8]):
        u = rng.normal(0, 1.5, (STEPS, 2)).astype(np.float32)
        got = mppi.clamp(LIMITS, f32(u), f32(twist), DT)
        np.testing.assert_allclose(got, reference.mppi_clamp(u, twist, LIMITS, DT), rtol=CLOSE, atol=CLOSE)


def test_one_command_smooths_clamps_sends_the_second_and_shifts():
    spec = dataclasses.replace(PLAIN, smooth=True, clamp=True)
    u, _ = draws(2)
    history = np.random.default_rng(3).normal(0, 0.1, (4, 2)).astype(np.float32)
    state = mppi.init(spec, PARAMS, KEY)._replace(control=f32(u), history=f32(history))
    after, command, _ = plan(spec, PARAMS, LIMITS, COST, f32(GOAL), state, f32(POSE), f32(TWIST), KEY)
    eps, _ = noise.draw(spec.noise, PARAMS.noise, state.bank, jax.random.split(KEY, 1)[0], SAMPLES)
    updated, _ = update(u, eps)
    padded = np.concatenate([history, updated, np.repeat(updated[-1:], 4, axis=0)])
    smooth = np.concatenate([signal.savgol_filter(padded, 9, 2, axis=0)[4:-5], updated[-1:]])
    want = reference.mppi_clamp(smooth, TWIST, LIMITS, DT)
    np.testing.assert_allclose([command.v, command.omega], want[1], rtol=CLOSE, atol=CLOSE)
    np.testing.assert_allclose(after.control, np.concatenate([want[1:], want[-1:]]), rtol=CLOSE, atol=CLOSE)
    np.testing.assert_allclose(after.history, np.concatenate([history[1:], want[1:2]]), rtol=CLOSE, atol=CLOSE)


def test_all_colliding_is_tried_again_then_fails_and_forgets():
    def finish(data, carry, m):
        del carry
        return Priced(m.x * 0.0, (m.x * 0.0)[None], jnp.broadcast_to(data, m.x.shape))

    cost = mppi_rollout.Cost(begin=lambda d, m: m.x, step=lambda d, c, m, t: c, finish=finish)
    u, _ = draws()
    state = mppi.init(PLAIN, PARAMS, KEY)._replace(control=f32(u), history=jnp.ones((4, 2)))
    for hits in (True, False):
        after, command, info = plan(PLAIN, PARAMS, LIMITS, cost, jnp.asarray(hits), state, f32(POSE), f32(TWIST), KEY)
        assert bool(info.failed) == hits
        assert (float(jnp.abs(after.control).max()) == 0) == hits and (float(jnp.abs(after.history).max()) == 0) == hits
        assert (float(command.v) == float(command.omega) == 0) == hits


def test_worst_cases_count_as_the_share_says():
    rng = np.random.default_rng(0)
    costs = rng.normal(size=(8, 5)).astype(np.float32)
    priced = Priced(f32(costs.ravel()), f32(np.stack([costs.ravel(), 2 * costs.ravel()])), jnp.zeros(40, bool))
    ordered = np.sort(costs, axis=0)[::-1]
    for tail, want in ((0.0, ordered[0]), (0.125, ordered[0]), (0.5, ordered[:4].mean(axis=0)), (1.0, costs.mean(axis=0))):
        got = mppi_weights.tail_mean(priced, 5, tail)
        np.testing.assert_allclose(got.total, want, rtol=CLOSE, atol=CLOSE)
        np.testing.assert_allclose(got.terms, [want, 2 * want], rtol=CLOSE, atol=CLOSE)
    part = mppi_weights.tail_mean(priced, 5, 0.3).total  # 2.4 of 8
    np.testing.assert_allclose(part, (ordered[0] + ordered[1] + 0.4 * ordered[2]) / 2.4, rtol=CLOSE, atol=CLOSE)


def test_disturbed_samples_are_judged_by_their_tail():
    spec = dataclasses.replace(PLAIN, num_disturbances=3)
    params = PARAMS._replace(tail=0.5, disturbance=0.3)
    u, eps = draws(4)
    got, _ = update(u, eps, spec, params)
    gains = 1 + 0.3 * np.asarray(jax.random.normal(KEY, (2, 3), jnp.float32))
    c, costs = loops(u.astype(float), eps.astype(float), gains=gains.T)
    ordered = np.sort(costs, axis=0)[::-1]
    want, _ = reference.mppi_update(u, c, (ordered[0] + 0.5 * ordered[1]) / 1.5, 0.015, (0.2, 0.4), 0.3)
    np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-5)


def test_rate_space_perturbs_rates():
    spec = dataclasses.replace(PLAIN, rate_space=True)
    params = PARAMS._replace(std_v=1.0, std_w=2.0, change=3.0)
    u, eps = draws(5)
    got, _ = update(u, eps, spec, params)
    summed = np.cumsum(eps.astype(float), axis=0) * DT
    c, costs = loops(u.astype(float), summed, params)
    rate = np.diff(np.concatenate([TWIST[None], u]).astype(float), axis=0) / DT
    sigma = np.array([1.0, 2.0])
    for k in range(SAMPLES):
        costs[0, k] += np.sum(0.015 / sigma**2 * rate * sigma * eps[:, :, k])
        costs[0, k] += 3.0 * np.sum(np.diff(np.concatenate([TWIST[None], c[k]]), axis=0) ** 2)
    weight = np.exp(-(costs[0] - costs[0].min()) / 0.3)
    weight /= weight.sum()
    np.testing.assert_allclose(got, np.einsum("k,kta->ta", weight, c), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("share", [0.05, 0.3, 0.9])
def test_the_temperature_gives_the_effective_sample_size(share):
    cost = f32(np.random.default_rng(0).gamma(2.0, 3.0, 500))
    temperature = mppi_weights.temperature_for(cost, share)
    size = mppi_weights.effective_size(mppi_weights.softmin(cost, temperature))
    assert float(size) == pytest.approx(share * 500, rel=0.01)
    crashed = cost.at[:200].set(1e6)
    size = mppi_weights.effective_size(mppi_weights.softmin(crashed, mppi_weights.temperature_for(crashed, 0.3)))
    assert float(size) == pytest.approx(150, rel=0.01)


def test_it_adapts_the_temperature():
    spec = dataclasses.replace(PLAIN, adapt_temperature=True)
    u, eps = draws(6)
    _, info = update(u, eps, spec, PARAMS._replace(effective_share=0.25))
    assert float(info.effective) == pytest.approx(10, rel=0.01)
    assert float(info.temperature) != pytest.approx(0.3)


NAV2 = CriticSpec()


def drive(spec, params, ticks, wall=True):
    """Closed loop along a straight path of 3 m past a wall that reaches onto it."""
    values = np.zeros((80, 120))
    if wall:
        values[:38, 60:63] = 254
    cost = GridMap(f32(values), f32([-1.52, -2.02]), f32(0.05))
    words = cost._replace(values=mppi_critics.pack(cost.values, jnp.zeros((80, 120))))
    path = paths.straight(f32([0, 0]), f32([3, 0]), spacing=0.05, num_points=64)
    state = mppi.init(spec, params, KEY)
    price = mppi_critics.nav2(NAV2, spec.num_steps, spec.dt)

    @jax.jit
    def step(state, pose, twist, key):
        ahead = paths.ahead(path, pose[:2], 1.7, num_points=48)
        scene = mppi_critics.look(NAV2, CriticParams(), LIMITS, InflationParams(), words, ahead, pose, 0.0, 0.25)
        return mppi.plan(spec, params, LIMITS, price, scene, state, pose, twist, key)

    pose, twist, log = f32([0.0, 0.1, 0.3]), jnp.zeros(2), []
    for k in range(ticks):
        state, command, info = step(state, pose, twist, jax.random.key(k))
        twist = jnp.stack([command.v, command.omega])
        pose = pose + spec.dt * jnp.stack([twist[0] * jnp.cos(pose[2]), twist[0] * jnp.sin(pose[2]), twist[1]])
        log.append((np.asarray(pose), np.asarray(twist), info))
    return log


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"noise": NoiseSpec(antithetic=True, bank=1000), "num_disturbances": 3},
        pytest.param({"noise": NoiseSpec(kind="low_pass", bank=400), "adapt_temperature": True}, marks=pytest.mark.long),
        {"rate_space": True},
        pytest.param({"immediate": True, "noise": NoiseSpec(bank=400)}, marks=pytest.mark.long),
    ],
)
def test_it_drives_along_the_path_within_the_limits(change):
    spec = MppiSpec(num_samples=300, **change)
    params = PARAMS._replace(std_v=1.0, std_w=2.5) if spec.rate_space else PARAMS
    log = drive(spec, params, 120, wall=False)
    poses, twists = np.stack([p for p, _, _ in log]), np.stack([t for _, t, _ in log])
    assert poses[-1, 0] > 2.0 and np.abs(poses[20:, 1]).max() < 0.3
    tiny = 1e-5
    assert (twists[:, 0] <= 0.5 + tiny).all() and (twists[:, 0] >= -0.35 - tiny).all()
    assert (np.abs(twists[:, 1]) <= 1.9 + tiny).all()
    step = np.diff(np.concatenate([np.zeros((1, 2)), twists]), axis=0)
    ticks = 1 if spec.immediate else 2  # what is sent is the second of the sequence
    assert np.abs(step[:, 0]).max() <= ticks * 3.0 * 0.05 + tiny
    assert np.abs(step[:, 1]).max() <= ticks * 3.5 * 0.05 + tiny


def test_it_passes_an_obstacle_on_the_path():
    log = drive(MppiSpec(num_samples=500), PARAMS, 160)
    poses = np.stack([p for p, _, _ in log])
    assert poses[-1, 0] > 2.0 and not any(bool(info.failed) for _, _, info in log)
    beside = (poses[:, 0] > 1.46) & (poses[:, 0] < 1.65)
    assert beside.any() and (poses[beside, 1] > -0.12).all(), "the wall's end is at y = -0.12"


def test_one_trace_for_a_sweep_and_a_batch_is_what_its_robots_are():
    once = jax.jit(chex.assert_max_traces(mppi.plan.__wrapped__, n=1), static_argnames=("spec", "cost"))
    spec = MppiSpec(num_samples=64, num_steps=STEPS)
    state = mppi.init(spec, PARAMS, KEY)
    args = lambda t: (spec, PARAMS._replace(temperature=f32(t)), LIMITS, COST, f32(GOAL), state)  # noqa: E731
    poses = f32(np.random.default_rng(0).normal(size=(5, 3)))
    keys = jax.random.split(KEY, 5)
    for t in (0.1, 0.3):
        one = [once(*args(t), pose, f32(TWIST), key)[1] for pose, key in zip(poses, keys, strict=True)]
        many = jax.vmap(lambda pose, key, t=t: mppi.plan(*args(t), pose, f32(TWIST), key)[1])(poses, keys)
        np.testing.assert_allclose(many, np.transpose([[c.v, c.omega] for c in one]), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"num_steps": 1}, "num_steps must be >= 2"),
        ({"num_disturbances": 0}, "must be >= 1"),
        ({"num_explained": 3000}, "within 1..num_samples"),
    ],
)
def test_the_spec_is_checked(wrong, message):
    with pytest.raises(ValueError, match=message):
        MppiSpec(**wrong)
