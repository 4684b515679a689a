"""The unicycle against exact arcs, and limits that nothing gets around."""

import math

import hypothesis.strategies as st
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings

import reference
from drnav_jax.planning import dynamics
from drnav_jax.types import RobotParams

DT = 0.1
ROBOT = RobotParams()
ROUNDING = 1e-5  # [m, rad] float32 over 40 steps

anything = st.floats(width=32)
speeds, turns = st.floats(-0.2, 1.0), st.floats(-1.5, 1.5)


def f32(values):
    return jnp.asarray(values, jnp.float32)


def drive(pose, twist, v, w, steps=40):
    """All motions `[steps + 1]` of one robot."""
    motion = dynamics.start(f32(pose), f32(twist), 1)
    motions = [motion]
    for _ in range(steps):
        motion = dynamics.advance(motion, f32([v]), f32([w]), ROBOT, DT)
        motions.append(motion)
    return motions


@pytest.mark.parametrize(("v", "w"), [(1.0, 1.5), (0.6, -0.4), (-0.2, 0.9), (0.8, 0.0), (0.0, 1.5), (0.0, 0.0)])
def test_arcs_are_exact_to_third_order(v, w):
    motions = drive([1.0, -2.0, 0.7], [v, w], v, w)
    for k, m in enumerate(motions):
        t = k * DT
        turned = 0.7 + w * t
        if w:
            x = 1.0 + v / w * (math.sin(turned) - math.sin(0.7))
            y = -2.0 - v / w * (math.cos(turned) - math.cos(0.7))
        else:
            x, y = 1.0 + v * t * math.cos(0.7), -2.0 + v * t * math.sin(0.7)
        # each chord is (w dt)^2 / 24 too long
        assert math.hypot(m.x[0] - x, m.y[0] - y) <= abs(v) * t * (w * DT) ** 2 / 24 * 1.01 + ROUNDING
        np.testing.assert_allclose([m.c[0], m.s[0]], [math.cos(turned), math.sin(turned)], atol=ROUNDING)


@settings(max_examples=40)
@given(speeds, turns, speeds, turns, st.floats(-3.1, 3.1))
def test_rollouts_equal_a_plain_loop(v0, w0, v, w, yaw):
    motions = drive([0.3, 0.1, yaw], [v0, w0], v, w, steps=15)[1:]
    want = reference.rollout([0.3, 0.1, yaw], [v0, w0], v, w, ROBOT, DT, 15)
    got = [(m.x[0], m.y[0], m.v[0], m.w[0]) for m in motions]
    np.testing.assert_allclose(got, [(x, y, a, b) for x, y, _, a, b in want], atol=ROUNDING)
    headings = [reference.wrap(math.atan2(m.s[0], m.c[0]) - p[2]) for m, p in zip(motions, want, strict=True)]
    np.testing.assert_allclose(headings, 0.0, atol=ROUNDING)


@given(st.floats(-0.3, 0.3), st.floats(-3.1, 3.1))
def test_turning_without_trigonometry(angle, yaw):
    c, s = dynamics.rotate(f32(math.cos(yaw)), f32(math.sin(yaw)), f32(angle))
    np.testing.assert_allclose([c, s], [math.cos(yaw + angle), math.sin(yaw + angle)], atol=2e-6)


def test_speeds_change_no_faster_than_they_may():
    motions = drive([0, 0, 0], [-0.2, -1.5], 1.0, 1.5, steps=12)
    v, w = np.array([m.v[0] for m in motions]), np.array([m.w[0] for m in motions])
    np.testing.assert_allclose(v, np.minimum(-0.2 + 0.25 * np.arange(13), 1.0), atol=1e-6)
    np.testing.assert_allclose(w, np.minimum(-1.5 + 0.32 * np.arange(13), 1.5), atol=1e-6)


@given(anything, anything, st.floats(-3, 3, width=32), st.floats(-4, 4, width=32))
def test_no_command_is_beyond_the_limits(v, omega, v0, w0):
    command = dynamics.limit(f32(v), f32(omega), f32([v0, w0]), ROBOT, DT)
    got_v, got_w = float(command.v), float(command.omega)
    tiny = 1e-6
    assert -0.2 - tiny <= got_v <= 1.0 + tiny and abs(got_w) <= 1.5 + tiny
    if -0.2 <= v0 <= 1.0:
        assert abs(got_v - v0) <= 2.5 * DT + tiny
    if abs(w0) <= 1.5:
        assert abs(got_w - w0) <= 3.2 * DT + tiny
    if not (math.isfinite(v) and math.isfinite(omega)):  # braking, both at once
        assert abs(got_v) <= max(min(abs(v0), 1.0) - 2.5 * DT, 0.0) + tiny
        assert abs(got_w) <= max(min(abs(w0), 1.5) - 3.2 * DT, 0.0) + tiny or abs(w0) > 1.5
    elif -0.2 <= v <= 1.0 and abs(omega) <= 1.5 and abs(v - v0) <= 2.5 * DT and abs(omega - w0) <= 3.2 * DT:
        assert (got_v, got_w) == pytest.approx((v, omega), abs=tiny)
