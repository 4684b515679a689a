"""`drnav bench --scaling`: exponents are those of the times, memory is what XLA plans, and the files hold the figures."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from drnav_jax.bench import drive, growth


def test_the_exponent_is_the_slope(monkeypatch):
    monkeypatch.setattr(growth, "interleaved", lambda calls, repeats: [1e-3 * call() for call in calls])
    curve = growth._curve("units", (2, 4, 8), lambda n: (lambda: 3.0 * n**1.5, 0.5 * n), 1)
    assert curve["over"] == "units" and curve["sizes"] == [2, 4, 8] and curve["mb"] == [1.0, 2.0, 4.0]
    np.testing.assert_allclose(curve["ms"], 3.0 * np.asarray([2.0, 4.0, 8.0]) ** 1.5)
    assert curve["exponent"] == pytest.approx(1.5)


def test_memory_is_that_of_the_program():
    values = jnp.ones((100, 1000), jnp.float32)
    call, memory = growth._program(lambda a: jnp.sort(jnp.sin(a), axis=0).sum(), values)
    assert float(call()) == pytest.approx(1e5 * np.sin(1.0), rel=1e-4)
    assert memory >= 4 * values.size / 1e6, "what is sorted is kept once at least"


@pytest.fixture(scope="module")
def recorded():
    return drive.record(drive.STRIDE)


@pytest.mark.long
def test_memory_of_the_scoring_kernel_is_flat_in_candidates(recorded):
    words = growth._field(recorded)
    used = [growth._scores(recorded, words, num, 8)[1] for num in (8192, 32768)]
    # what grows is the candidates themselves, not the state that they are rolled out in
    assert used[1] - used[0] < 24576 * 12 * 4 / 1e6
    assert used[1] < 2.0 * used[0]


@pytest.mark.long
def test_maps_of_all_sizes_hold_the_same_cells_in_the_middle(recorded):
    words = growth._field(recorded)
    size, cell = words.values.shape[0], float(words.resolution)
    middle = np.asarray(words.origin) + 0.5 * size * cell
    held = np.asarray(words.values)
    for edge in (size // 2, size, 2 * size, 4 * size):
        tiled = growth._tiled(words, edge)
        assert tiled.values.shape == (edge, edge)
        np.testing.assert_allclose(np.asarray(tiled.origin) + 0.5 * edge * cell, middle, atol=1e-3)
        half, near = edge // 2, size // 4
        got = np.asarray(tiled.values)[half - near : half + near, half - near : half + near]
        np.testing.assert_array_equal(got, held[size // 2 - near : size // 2 + near, size // 2 - near : size // 2 + near])


def test_table_and_picture(tmp_path):
    pytest.importorskip("matplotlib")
    curves = {
        "a part": {"over": "things", "sizes": [10, 1000], "ms": [1.0, 50.0], "mb": [0.25, 0.25], "exponent": 0.85},
        "another": {"over": "edge", "sizes": [64], "ms": [2.0], "mb": [0.0], "exponent": 0.0},
    }
    machine = {"cores": 2, "cpu": "a processor", "jax": "0.10"}
    growth.write(tmp_path / "new", {"curves": curves, "machine": machine})
    assert json.loads((tmp_path / "new" / "scaling.json").read_text())["curves"] == curves
    lines = (tmp_path / "new" / "scaling.md").read_text().splitlines()
    assert lines[2] == "| a part | things | 10 | 1.00 | 100.00 | 0.25 | 0.85 |"
    assert lines[3] == "|  |  | 1,000 | 50.00 | 50.00 | 0.25 |  |"
    assert len(lines) == 5 and (tmp_path / "new" / "scaling.png").stat().st_size > 10_000


@pytest.mark.slow
def test_all_curves():
    result = growth.measure(quick=True)
    assert {curve["over"] for curve in result["curves"].values()} == {
        "candidates", "steps", "robots", "edge of the map [cells]", "samples"
    }  # fmt: skip
    assert all(min(curve["ms"]) > 0 and len(curve["ms"]) == 2 for curve in result["curves"].values())
    assert json.loads(json.dumps(result, allow_nan=False)) == result
