"""The adversarial cases: none is hit, none goes on for ever; and the judge sees what is wrong."""

import jax.numpy as jnp
import numpy as np
import pytest

from drnav_jax.sim import kinematic
from drnav_jax.sim.kinematic import FaultParams
from drnav_jax.types import Command, RobotParams
from experiments import adversarial
from experiments.adversarial import CASES, RADIUS, Config

ROBOT = RobotParams(radius=RADIUS)
# arrived or given up within three quarters of a minute
QUICK = (
    "walled in", "goal in a pocket", "goal in a block indoors", "gap of 2R + 0.1 m", "delay of 0.3 s", "slip of 20 %",
    "drift of 2 %",
)  # fmt: skip


def fails(records):
    return {name: found for name, found in records.items() if found["verdict"] != "ok"}


@pytest.mark.slow
def test_no_case_breaks_the_planner():
    records = adversarial.driven(Config(cases=",".join(QUICK), minutes=0.75), "drnav")
    assert list(records) == list(QUICK) and fails(records) == {}


@pytest.mark.parametrize("late", [0, 3])
def test_speeds_that_commands_meet_are_the_simulators(late):
    rng = np.random.default_rng(0)
    commands = rng.uniform((-0.4, -2.0), (1.3, 2.0), (40, 2))
    faults, pending = FaultParams(delay=0.1 * late), jnp.zeros((10, 2), jnp.float32)
    pose, twist, want = jnp.zeros(3, jnp.float32), jnp.zeros(2, jnp.float32), []
    for v, omega in commands:
        want.append(np.asarray(twist))
        given = Command(v=jnp.float32(v), omega=jnp.float32(omega))
        pending, reached = kinematic.delayed(pending, given, 0.1, faults)
        pose, twist = kinematic.step(ROBOT, pose, twist, reached, 0.1, faults)
    np.testing.assert_allclose(adversarial.motors(commands, ROBOT, 0.1)[: 40 - late], want[late:], atol=1e-5)


def test_commands_beyond_the_limits_are_counted():
    good = np.array([[0.25, 0.0], [0.5, 0.3], [0.6, 0.0], [0.35, -0.3]])
    assert adversarial.beyond(good, ROBOT, 0.1) == 0
    for place, wrong in [((0, 0), 0.3), ((1, 1), 0.4), ((2, 0), np.nan), ((3, 1), np.inf), ((3, 0), 1.2)]:
        bad = good.copy()
        bad[place] = wrong
        assert adversarial.beyond(bad, ROBOT, 0.1) >= 1, (place, wrong)


def test_verdicts():
    fine = {
        "collision": False, "finite": True, "beyond_limits": 0, "success": True, "stopped": False, "says_arrived": False,
        "off_m": 0.5, "distance_m": 20.0,
    }  # fmt: skip
    must, never, either = (CASES[name]() for name in ("goal behind", "walled in", "gap of 2R + 0.1 m"))
    assert [adversarial.verdict(case, fine) for case in (must, never, either)] == ["ok", "impossible", "ok"]
    stands = fine | {"success": False, "stopped": True}
    assert [adversarial.verdict(case, stands) for case in (must, never, either)] == ["gave up", "ok", "ok"]
    assert adversarial.verdict(never, fine | {"success": False}) == "livelock"
    there = stands | {"says_arrived": True, "off_m": 1.1}
    assert adversarial.verdict(CASES["drift of 2 %"](), there) == "ok"
    assert adversarial.verdict(CASES["drift of 2 %"](), there | {"off_m": 1.2}) == "gave up"
    assert adversarial.verdict(must, there) == "gave up", "where odometry is exact, near is not there"
    assert adversarial.verdict(must, fine | {"collision": True}) == "collision"
    assert adversarial.verdict(must, fine | {"beyond_limits": 1}) == "broken command"


def test_the_config_is_checked():
    wrongs = [
        ({"cases": "fire"}, "no case"), ({"predictor": "oracle"}, "no labels"), ({"minutes": 0.1}, "minutes"),
        ({"planners": "x"}, "no planner"),
    ]  # fmt: skip
    for wrong, message in wrongs:
        with pytest.raises(ValueError, match=message):
            Config(**wrong)
