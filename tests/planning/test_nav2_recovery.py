"""Nav2's recovery, rule by rule: what it does when, in which order, and when it gives up."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drnav_jax.planning import nav2_recovery as recovery
from drnav_jax.planning.nav2_recovery import ABORT, BACKUP, FOLLOW, SPIN, WAIT, Nav2Params
from drnav_jax.types import GridMap, RobotParams

PARAMS, ROBOT = Nav2Params(), RobotParams()
DT = 0.1
FREE = GridMap(jnp.zeros((80, 80)), jnp.asarray([-2.0, -2.0]), 0.05)

update = jax.jit(chex.assert_max_traces(recovery.update.__wrapped__, n=1))


def f32(values):
    return jnp.asarray(values, jnp.float32)


def drive(seconds, good=lambda t: True, move=None, costs=FREE, waiting=lambda t: False):
    """Closed loop of the recovery alone, `move` = speed of the controller; [(t, mode, command, clear, pose)]."""
    pose = np.zeros(3)
    state, log = recovery.init(f32(pose)), []
    for k in range(round(seconds / DT)):
        t = k * DT
        state, command, clear = update(
            PARAMS, state, costs, ROBOT, f32(pose), f32(t), jnp.asarray(good(t)), jnp.asarray(waiting(t))
        )
        v, w = map(float, command)
        if int(state.mode) == FOLLOW:
            assert v == w == 0
            v = move or 0.0
        log.append((t, int(state.mode), (v, w), bool(clear), pose.copy()))
        pose = pose + DT * np.array([v * np.cos(pose[2]), v * np.sin(pose[2]), w])
    return log, state


def phases(log):
    """[(mode, its length [s])] in order."""
    out = []
    for _, mode, *_ in log:
        if out and out[-1][0] == mode:
            out[-1][1] += DT
        else:
            out.append([mode, DT])
    return out


def test_a_robot_that_makes_progress_is_left_alone():
    log, state = drive(60, move=0.06)
    assert {mode for _, mode, *_ in log} == {FOLLOW} and not any(clear for *_, clear, _ in log)
    assert int(state.retries) == 0


def test_without_progress_it_goes_round_robin_and_gives_up():
    log, state = drive(200)
    order = [mode for mode, _ in phases(log) if mode != FOLLOW]
    assert order == [SPIN, WAIT, BACKUP, SPIN, ABORT], "six actions, two of which clear"
    clears = [t for t, _, _, clear, _ in log if clear]
    assert len(clears) == 3, "once before all actions, twice in turn"
    assert clears[0] == pytest.approx(PARAMS.progress_time, abs=0.2)
    assert int(state.retries) == 6 and log[-1][1] == ABORT and log[-1][2] == (0.0, 0.0)
    turned = [abs(b[4][2] - a[4][2]) for a, b in zip(log[:-1], log[1:], strict=True) if a[1] == SPIN]
    assert sum(turned) == pytest.approx(2 * PARAMS.spin, abs=0.1)
    waited = [length for mode, length in phases(log) if mode == WAIT]
    assert waited[0] == pytest.approx(PARAMS.wait, abs=0.2)
    back = [a for a in log if a[1] == BACKUP]
    assert len(back) * DT == pytest.approx(PARAMS.back / PARAMS.back_speed, abs=0.2)
    assert all(a[2] == (pytest.approx(-PARAMS.back_speed), 0.0) for a in back)


def test_a_controller_that_fails_is_noticed_at_once():
    log, _ = drive(3, good=lambda t: t < 1.0, move=0.3)
    clear = [t for t, _, _, clear, _ in log if clear]
    assert clear[0] == pytest.approx(1.0 + PARAMS.failure_tolerance, abs=0.2)


def test_progress_makes_clearing_the_first_answer_again():
    """Bad for a moment every few metres: the map is cleared each time, no action is taken."""
    log, state = drive(60, good=lambda t: t % 6.0 < 5.5, move=0.5)
    assert int(state.retries) == 0 and sum(clear for *_, clear, _ in log) >= 8
    assert {mode for _, mode, *_ in log} == {FOLLOW}


def test_it_waits_with_the_robot():
    log, _ = drive(60, good=lambda t: False, waiting=lambda t: True)
    assert {mode for _, mode, *_ in log} == {FOLLOW} and not any(clear for *_, clear, _ in log)


def test_it_backs_into_nothing():
    values = np.zeros((80, 80))
    values[:, :37] = values[:37] = 254  # x or y below -0.15: behind, before and after the first spin
    log, state = drive(120, costs=FREE._replace(values=f32(values)))
    assert BACKUP not in {mode for _, mode, *_ in log}, "the next action is taken instead"
    assert min(pose[0] for *_, pose in log) > -0.01 and int(state.retries) == 6


def test_where_it_collides_it_does_not_spin():
    log, _ = drive(120, costs=FREE._replace(values=f32(np.full((80, 80), 253.0))))
    assert {mode for _, mode, *_ in log} == {FOLLOW, WAIT, ABORT}
    assert max(abs(v) + abs(w) for _, _, (v, w), _, _ in log) == 0


def test_modes_have_names_and_counterparts():
    assert len(recovery.MODES) == 5
    assert [int(recovery.as_drnav(jnp.asarray(m))) for m in range(5)] == [0, 1, 1, 1, 3]
