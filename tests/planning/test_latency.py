"""How late commands act: found from what the simulator measures, and where the robot will be by then."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drnav_jax.planning import latency
from drnav_jax.planning.latency import MAX_TICKS, LatencyParams
from drnav_jax.sim import kinematic
from drnav_jax.sim.kinematic import FaultParams
from drnav_jax.types import Command, RobotParams

ROBOT, PARAMS, DT = RobotParams(), LatencyParams(), 0.1

update = jax.jit(latency.update)
ahead = jax.jit(latency.ahead)


def driven(late, ticks=60, seed=0, noise=0.0, still=0):
    """(state, pose, twist) per tick, each before the command of that tick; commands wander within the limits."""
    rng, faults = np.random.default_rng(seed), FaultParams(delay=DT * late)
    pending, pose, twist = jnp.zeros((10, 2)), jnp.asarray([1.0, -2.0, 3.0]), jnp.zeros(2)
    state, wanted, seen = latency.init(), np.zeros(2), []
    for k in range(ticks):
        state = update(PARAMS, state, twist + noise * jnp.asarray(rng.normal(size=2), jnp.float32), ROBOT, DT)
        seen.append((state, pose, twist))
        if k >= still:
            wanted = np.clip(wanted + rng.uniform((-0.25, -0.32), (0.25, 0.32)), (-0.2, -1.5), (1.0, 1.5))
        command = Command(v=jnp.float32(wanted[0]), omega=jnp.float32(wanted[1]))
        state = latency.sent(state, command)
        pending, reached = kinematic.delayed(pending, command, DT, faults)
        pose, twist = kinematic.step(ROBOT, pose, twist, reached, DT, faults)
    return seen


@pytest.mark.parametrize("late", range(MAX_TICKS + 1))
def test_the_delay_is_found_and_the_robot_is_where_it_is_foretold(late):
    seen = driven(late, still=7)
    found = [int(state.ticks) for state, *_ in seen]
    assert found[:7] == [0] * 7, "who stands learns nothing"
    assert found[7 + late + 4 :] == [late] * len(found[7 + late + 4 :])
    for k in range(20, 50):
        state, pose, twist = seen[k]
        pose, twist = ahead(state, pose, twist, ROBOT, DT)
        _, there, speeds = seen[k + late]
        np.testing.assert_allclose(twist, speeds, atol=1e-6)
        np.testing.assert_allclose(pose, there, atol=5e-4)  # the chord of an arc


def test_a_robot_that_obeys_at_once_is_left_where_it_is():
    for state, pose, twist in driven(0):
        got = ahead(state, pose, twist, ROBOT, DT)
        np.testing.assert_array_equal(got[0], pose)
        np.testing.assert_array_equal(got[1], twist)


@pytest.mark.parametrize("late", [0, 2, 4])
def test_noise_does_not_hide_it(late):
    found = [int(state.ticks) for state, *_ in driven(late, noise=0.03, seed=1)]
    assert found[25:] == [late] * len(found[25:])


def test_speeds_that_nobody_asked_for_are_no_delay():
    """Somebody pushes the robot; then it goes as it is told."""
    state = latency.init()
    for k in range(30):
        state = update(PARAMS, state, jnp.asarray([1e30 if k == 3 else 0.5 * np.sin(k), 1.0], jnp.float32), ROBOT, DT)
        state = latency.sent(state, Command(jnp.float32(0.0), jnp.float32(0.0)))
    assert int(state.ticks) == 0 and bool(jnp.all(jnp.isfinite(state.error)))


def test_a_robot_that_is_held_fast_is_not_late():
    """From the start; and after it drove."""
    for begun in (0, 20):
        state, twist, found = latency.init(), jnp.zeros(2), []
        for k in range(80):
            state = update(PARAMS, state, twist, ROBOT, DT)
            found.append(int(state.ticks))
            command = Command(jnp.float32(min(0.1 * k, 1.0)), jnp.float32(0.2))
            state = latency.sent(state, command)
            _, twist = kinematic.step(ROBOT, jnp.zeros(3), twist, command, DT)
            twist = twist if k < begun else jnp.zeros(2)
        assert found == [0] * 80


def test_longer_delays_count_as_the_longest():
    assert {int(state.ticks) for state, *_ in driven(9)} <= set(range(MAX_TICKS + 1))


def test_a_batch_is_its_members():
    seen = [driven(late)[40] for late in (0, 3)]
    many = jax.vmap(lambda s, p, t: latency.ahead(s, p, t, ROBOT, DT))(*jax.tree.map(lambda *a: jnp.stack(a), *seen))
    one = [ahead(*s, ROBOT, DT) for s in seen]
    chex.assert_trees_all_close(jax.tree.map(lambda *a: jnp.stack(a), *one), many, rtol=1e-6)
