"""MPPI next to its rivals: every implementation does the task of the plain loops, and what is not installed is said."""

import json
import sys

import jax
import numpy as np
import pytest

from drnav_jax.bench import mppi, suite
from drnav_jax.bench.mppi import compare, in_numba, in_numpy, in_torch, ours

STEPS, SAMPLES = 20, 150
CLOSE = 1e-5  # relative: float32 sums over samples and steps
EDGES = 0.02  # share of the samples that rounding may send across a cell's edge, where the cost jumps
NEEDED = {"numpy": (), "numba": ("numba",), "pytorch_mppi": ("torch", "pytorch_mppi")}


def loops(task, eps):
    """(controls `[T, 2]`, running costs `[K]`) in double precision, one sample and one step at a time."""
    u, sigma, top = task.control.astype(float), task.sigma.astype(float), task.accelerations.astype(float) * task.dt
    running, total = np.zeros(eps.shape[2]), np.zeros(eps.shape[2])
    for k in range(eps.shape[2]):
        (x, y, yaw), (v, w) = task.pose.astype(float), task.twist.astype(float)
        for t in range(len(u)):
            c = u[t] + sigma * eps[t, :, k]
            v, w = v + np.clip(c[0] - v, -top[0], top[0]), w + np.clip(c[1] - w, -top[1], top[1])
            x, y, yaw = x + v * task.dt * np.cos(yaw), y + v * task.dt * np.sin(yaw), yaw + w * task.dt
            col, row = (int(np.floor((a - o) / task.resolution)) for a, o in zip((x, y), task.origin, strict=True))
            running[k] += np.hypot(x - task.goal[0], y - task.goal[1])
            running[k] += task.cost_weight * task.cost[row, col] / 254
            running[k] += task.risk_weight * task.risk[row, col] * abs(v) * task.dt
            total[k] += task.temperature * np.sum(u[t] * (c - u[t]) / sigma**2)
    total += running
    weight = np.exp(-(total - total.min()) / task.temperature)
    weight /= weight.sum()
    return u + np.einsum("k,tak->ta", weight, sigma[None, :, None] * eps), running


def updater(name, task):
    """What answers for a rival; skips where it is not installed."""
    for package in NEEDED[name]:
        pytest.importorskip(package, reason="needs the bench extra")
    if name == "numba":
        return in_numba.updater(task)
    return in_numpy.updater(task) if name == "numpy" else in_torch.Controller(task, SAMPLES).update


def noise():
    return np.random.default_rng(3).standard_normal((STEPS, 2, SAMPLES), np.float32)


def flat(task):
    """The task where all cells are alike, so that it does not matter on which side of an edge a point is."""
    return task._replace(cost=np.full_like(task.cost, 37.0), risk=np.full_like(task.risk, 0.25))


@pytest.mark.parametrize("name", ["ours", *NEEDED])
def test_every_answer_is_that_of_the_loops(name):
    task, eps = mppi.make(STEPS, size=128), noise()
    for case, share in ((flat(task), 0.0), (task, EDGES)):
        update = (lambda e, c=case: ours.update(c, e)) if name == "ours" else updater(name, case)
        control, running = update(eps)
        expected, costs = loops(case, eps)
        assert np.mean(np.abs(running / costs - 1) > CLOSE) <= share
        if not share:
            np.testing.assert_allclose(control, expected, rtol=1e-4, atol=1e-5)


def test_the_layers_matter():
    task, eps = mppi.make(STEPS, size=128), noise()
    answers = [loops(case, eps)[1] for case in (task, task._replace(risk_weight=0.0), task._replace(cost_weight=0.0))]
    for other in answers[1:]:
        assert np.mean(np.abs(answers[0] / other - 1) > 1e-3) > 0.5


def test_difference_tells_another_cell_from_rounding():
    one = mppi.Update(np.zeros((2, 2)), np.asarray([1.0, 2.0, 4.0, 8.0]))
    other = mppi.Update(np.asarray([[0, 0], [0, 3e-3]]), np.asarray([1.0, 2.0, 4.0, 10.0]))
    found = compare.difference(one, other)
    assert found["cost_median"] == 0 and found["cost_elsewhere"] == 0.25
    assert found["cost_max"] == pytest.approx(0.2) and found["control_max"] == pytest.approx(3e-3)


def test_pytorch_mppi_draws_afresh_after_a_given_noise():
    task = mppi.make(STEPS, size=128)
    update = updater("pytorch_mppi", task)
    update(noise())
    command = update.__self__.command
    assert np.abs(command().numpy() - command().numpy()).max() > 1e-4


def test_commands_differ_by_their_noise_only():
    task = mppi.make(STEPS, size=128)
    for how in compare.NOISES:
        call = ours.command(task, SAMPLES, compare.noise_of(how, SAMPLES))
        one, other = np.asarray(call()), np.asarray(call())
        assert np.abs(one - other).max() > 1e-4
        # a mean of normal noise, whatever the weights, around the task's controls, shifted by the step that is sent
        around = np.concatenate([task.control[1:], task.control[-1:]])
        assert (np.abs(np.stack([one, other]) - around) < 6 * task.sigma).all()


@pytest.fixture(scope="module")
def result():
    with pytest.MonkeyPatch.context() as patch:  # as if the extra were not there
        for package in ("numba", "torch", "pytorch_mppi"):
            patch.setitem(sys.modules, package, None)
        found = mppi.side_by_side(SAMPLES, STEPS, repeats=2)
    jax.block_until_ready(found)
    return found


def test_what_is_missing_is_said(result):
    assert set(result["missing"]) == {"numba", "pytorch_mppi"}
    assert all("pip install drnav_jax[bench]" in why for why in result["missing"].values())
    assert result["pytorch_mppi_ms"] is result["ratio"] is result["fresh_ratio"] is result["numba_ms"] is None
    assert min(result[f"{n}_ms"] for n in ("ours", "antithetic", "fresh", "numpy", "numpy_fresh")) > 0
    assert result["numpy_ratio"] == pytest.approx(result["numpy_ms"] / result["ours_ms"])
    assert set(result["difference"]) == {"numpy"} and result["difference"]["numpy"]["cost_median"] < CLOSE
    assert json.loads(json.dumps(result, allow_nan=False)) == result


def test_rows_for_people(result):
    names, texts = zip(*suite.mppi_rows(result), strict=True)
    assert names == ("MPPI, 150 x 20", "  numpy", "  numba", "  pytorch_mppi")
    assert texts[3].startswith("not here: ") and "x ours" in texts[1]


def test_ratios_are_of_the_rivals_to_ours():
    for package in ("numba", "torch", "pytorch_mppi"):
        pytest.importorskip(package, reason="needs the bench extra")
    found = mppi.side_by_side(SAMPLES, STEPS, repeats=2)
    assert found["missing"] == {} and set(found["difference"]) == set(NEEDED)
    for key, rival, own in (
        ("ratio", "pytorch_mppi", "ours"), ("antithetic_ratio", "pytorch_mppi", "antithetic"),
        ("fresh_ratio", "pytorch_mppi", "fresh"), ("numba_ratio", "numba", "ours"),
        ("numba_fresh_ratio", "numba_fresh", "fresh"),
    ):  # fmt: skip
        assert found[key] == pytest.approx(found[f"{rival}_ms"] / found[f"{own}_ms"])
    assert all("not here" not in text for _, text in suite.mppi_rows(found))
    for name, times in found["by_threads"].items():
        assert set(times) == ({"1"} if name.startswith("numpy") else {"1", "2"})
        assert found[f"{name}_ms"] == min(times.values())
