"""The unicycle against fine Euler integration, and its limits and faults."""

import chex
import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drnav_jax import sim
from drnav_jax.types import Command, RobotParams

DT = 0.1
LIMITS = RobotParams()
NONE = sim.FaultParams()
speeds = st.floats(-3, 3)


def drive(pose, twist, v, omega, dt=DT, faults=NONE, params=LIMITS):
    pose, twist = jnp.asarray(pose, jnp.float32), jnp.asarray(twist, jnp.float32)
    pose, twist = sim.step(params, pose, twist, Command(jnp.float32(v), jnp.float32(omega)), dt, faults)
    return np.asarray(pose), np.asarray(twist)


@pytest.mark.parametrize(
    ("v", "omega"), [(1.0, 1.5), (0.7, 0.0), (0.7, 1e-4), (-0.2, -0.9), (0.0, 1.2), (0.0, 0.0)]
)
def test_an_arc_is_exact(v, omega):
    x, y, yaw = 1.0, -2.0, 0.3
    n, dt = 20_000, 2.0
    for k in range(n):  # Euler at mid-heading, error of order (dt / n)^2
        heading = yaw + omega * (k + 0.5) * dt / n
        x, y = x + v * np.cos(heading) * dt / n, y + v * np.sin(heading) * dt / n
    pose, twist = drive([1.0, -2.0, yaw], [v, omega], v, omega, dt=dt)
    turned = (yaw + omega * dt + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(pose, [x, y, turned], atol=2e-6)
    np.testing.assert_allclose(twist, [v, omega], atol=1e-7)


@hypothesis.settings(max_examples=60)
@hypothesis.given(
    v=speeds, omega=speeds, v0=st.floats(-0.2, 1), w0=st.floats(-1.5, 1.5)
)
def test_limits_hold(v, omega, v0, w0):
    _, twist = drive([0, 0, 0], [v0, w0], v, omega)
    rounding = 1e-6
    assert -0.2 - rounding <= twist[0] <= 1.0 + rounding and abs(twist[1]) <= 1.5 + rounding
    assert abs(twist[0] - v0) <= 2.5 * DT + rounding
    assert abs(twist[1] - w0) <= 3.2 * DT + rounding
    if -0.2 <= v <= 1.0 and abs(v - v0) < 2.5 * DT:
        np.testing.assert_allclose(twist[0], v, atol=rounding)


def test_from_beyond_the_limits_it_slows_down_as_fast_as_it_can():
    np.testing.assert_allclose(drive([0, 0, 0], [2.0, -2.0], 2.0, -2.0)[1], [1.75, -1.68])


@pytest.mark.parametrize("v", [np.nan, 0.0])
def test_a_command_that_is_no_number_is_a_stop(v):
    pose, twist = drive([0, 0, 0], [0.5, 0.2], v, np.nan)
    np.testing.assert_allclose(twist, [0.25, 0.0])
    assert np.isfinite(pose).all()
    assert np.isfinite(drive([0, 0, 0], [0, 0], np.inf, -np.inf)[0]).all()


def test_slip_moves_the_robot_less_than_its_wheels():
    faults = sim.FaultParams(slip_v=0.5, slip_omega=1.0)
    pose, twist = drive([0, 0, 0], [1.0, 1.0], 1.0, 1.0, faults=faults)
    np.testing.assert_allclose(pose, [0.05, 0, 0], atol=1e-7)
    np.testing.assert_allclose(twist, [1.0, 1.0])


@pytest.mark.parametrize(
    ("delay", "ticks"), [(0.0, 0), (0.04, 0), (0.06, 1), (0.3, 3), (0.4, 4), (0.7, 4), (-1.0, 0)]
)
def test_commands_come_as_late_as_they_shall(delay, ticks):
    given = np.random.default_rng(0).uniform(-1, 1, (12, 2)).astype(np.float32)
    pending, through = jnp.zeros((4, 2)), []
    for v, omega in given:
        command = Command(jnp.asarray(v), jnp.asarray(omega))
        pending, late = sim.delayed(pending, command, DT, sim.FaultParams(delay=delay))
        through.append([float(late.v), float(late.omega)])
    expected = np.concatenate([np.zeros((ticks, 2)), given])[:12]  # before the first one, it stands
    np.testing.assert_array_equal(through, expected.astype(np.float32))


def test_odometry_without_faults_is_the_truth_and_drifts_with_them():
    rng = np.random.default_rng(0)
    pose, twist = jnp.asarray([3.0, 1.0, 3.0]), jnp.zeros(2)
    exact, scaled, turned = jnp.zeros(3), jnp.zeros(3), jnp.zeros(3)
    start, length = np.asarray(pose, float), 0.0
    for v, omega in rng.uniform((0, -1.5), (1, 1.5), (60, 2)).astype(np.float32):
        before = pose
        pose, twist = sim.step(LIMITS, pose, twist, Command(jnp.float32(v), jnp.float32(omega)), DT)
        length += float(jnp.hypot(*(pose - before)[:2]))
        exact = sim.odometry(exact, before, pose, NONE)
        scaled = sim.odometry(scaled, before, pose, sim.FaultParams(drift_distance=0.1))
        turned = sim.odometry(turned, before, pose, sim.FaultParams(drift_yaw=0.05))
    c, s = np.cos(start[2]), np.sin(start[2])
    x, y, yaw = np.asarray(pose, float) - start
    truth = np.asarray([c * x + s * y, c * y - s * x])
    np.testing.assert_allclose(exact[:2], truth, atol=1e-5)
    np.testing.assert_allclose(scaled[:2], 1.1 * truth, atol=1e-5)
    for estimate, error in ((exact, 0.0), (scaled, 0.0), (turned, 0.05 * length)):
        off = float(estimate[2]) - yaw - error
        np.testing.assert_allclose((off + np.pi) % (2 * np.pi) - np.pi, 0, atol=1e-5)


def test_vmap_is_a_loop_and_a_sweep_compiles_once():
    rng = np.random.default_rng(0)
    poses = jnp.asarray(rng.uniform(-3, 3, (5, 3)), jnp.float32)
    twists = jnp.asarray(rng.uniform(-1, 1, (5, 2)), jnp.float32)
    command = Command(jnp.float32(0.4), jnp.float32(-0.3))

    @jax.jit
    @chex.assert_max_traces(n=1)
    def many(params, faults):
        return jax.vmap(lambda p, t: sim.step(params, p, t, command, DT, faults))(poses, twists)

    for slip in (0.0, 0.2):
        faults = sim.FaultParams(slip_v=slip)
        got = many(LIMITS._replace(v_max=1.0 + slip), faults)
        for k in range(5):
            params = LIMITS._replace(v_max=1.0 + slip)
            one = sim.step(params, poses[k], twists[k], command, DT, faults)
            chex.assert_trees_all_close(jax.tree.map(lambda x, k=k: x[k], got), one, atol=1e-6)
