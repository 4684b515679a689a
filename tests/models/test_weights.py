"""Files of weights: what goes in comes out, and what is not whole or not the right one is refused."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors
import safetensors.numpy
from small_network import SPEC, params_of

from drnav_jax.models import weights
from drnav_jax.models.calibration import Calibration, Temperature
from drnav_jax.models.network import NetworkSpec

pytestmark = pytest.mark.relaxed  # flax
HELD = Calibration(path=Temperature(1.25, -0.5), dead=Temperature(jnp.asarray(2.0), jnp.asarray(0.25)))
NOTES = {"figures": {"accuracy": 0.5}, "seeds": [1, 2], "data": "none"}


@pytest.fixture(scope="module")
def params():
    return params_of()


@pytest.fixture
def file(tmp_path, params):
    weights.save(tmp_path / "w.safetensors", SPEC, params, HELD, NOTES)
    return tmp_path / "w.safetensors"


def test_there_and_back(file, params):
    got = weights.load(file, SPEC)
    assert got.spec == SPEC and hash(got.spec) == hash(SPEC) and got.notes == NOTES
    jax.tree.map(np.testing.assert_array_equal, got.params, params)
    assert {leaf.dtype for leaf in jax.tree.leaves(got.params)} == {jnp.dtype(jnp.float32)}
    assert got.calibration == Calibration(Temperature(1.25, -0.5), dead=Temperature(2.0, 0.25))
    assert [p.name for p in file.parent.iterdir()] == ["w.safetensors"]  # nothing is left beside it


def test_half_precision_halves_the_file_and_rounds(tmp_path, file, params):
    half = tmp_path / "half.safetensors"
    digest = weights.save(half, SPEC, params, HELD, NOTES, half=True)
    got = weights.load(half)
    assert got.sha256 == digest != weights.load(file).sha256
    rounded = jax.tree.map(lambda a: np.asarray(a).astype(np.float16).astype(np.float32), params)
    jax.tree.map(np.testing.assert_array_equal, got.params, rounded)
    arrays = lambda f: sum(a.nbytes for a in safetensors.numpy.load_file(f).values())  # noqa: E731
    assert arrays(half) * 2 == arrays(file)


def test_the_same_parameters_have_the_same_hash(tmp_path, params):
    one = weights.save(tmp_path / "a.safetensors", SPEC, params, HELD, {})
    two = weights.save(tmp_path / "b.safetensors", SPEC, jax.tree.map(jnp.array, params), Calibration(), NOTES)
    assert one == two and len(one) == 64
    other = jax.tree.map(lambda a: a + 1e-3, params)
    assert weights.save(tmp_path / "c.safetensors", SPEC, other, HELD, {}) != one


@pytest.mark.parametrize(
    ("change", "field"),
    [({"features": 16}, "features"), ({"head": "tokens"}, "head"), ({"sectors": 5, "rule": False}, "sectors, rule")],
)
def test_another_network_is_refused_by_the_name_of_what_differs(file, change, field):
    with pytest.raises(ValueError, match=f"another {field}:"):
        weights.load(file, dataclasses.replace(SPEC, **change))


def test_a_difference_deep_inside_is_named_by_its_part(file):
    encoder = dataclasses.replace(SPEC.encoder, activation="relu")
    with pytest.raises(ValueError, match="another encoder:"):
        weights.load(file, dataclasses.replace(SPEC, encoder=encoder))


def test_no_file(tmp_path):
    with pytest.raises(FileNotFoundError, match="no weights at .*drnav train"):
        weights.load(tmp_path / "w.safetensors")


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.999])
def test_a_truncated_file(file, share):
    content = file.read_bytes()
    file.write_bytes(content[: int(len(content) * share)])
    with pytest.raises(ValueError, match="damaged"):
        weights.load(file)


def test_a_flipped_bit(file):
    content = bytearray(file.read_bytes())
    content[-40] ^= 1
    file.write_bytes(content)
    with pytest.raises(ValueError, match="damaged: its arrays do not have the hash"):
        weights.load(file)


def rewritten(file, arrays=None, **metadata):
    with safetensors.safe_open(file, framework="numpy") as held:
        kept = held.metadata()
    arrays = safetensors.numpy.load_file(file) if arrays is None else arrays
    safetensors.numpy.save_file(arrays, file, kept | metadata)


def test_a_file_of_something_else(file):
    rewritten(file, format="99")
    with pytest.raises(ValueError, match="format 99, this version reads 1"):
        weights.load(file)
    safetensors.numpy.save_file({"x": np.zeros(3, np.float32)}, file)
    with pytest.raises(ValueError, match="format None"):
        weights.load(file)


def test_a_spec_from_a_version_that_knows_more(file):
    with safetensors.safe_open(file, framework="numpy") as held:
        about = json.loads(held.metadata()["about"])
    about["spec"]["wings"] = 2
    rewritten(file, about=json.dumps(about))
    with pytest.raises(ValueError, match=r"w\.safetensors.*no wings"):
        weights.load(file)


def test_arrays_that_are_not_those_of_the_network(tmp_path, params):
    """As when the code has changed since: the hash is right, the arrays are not."""
    for number, change in enumerate((
        lambda p: p.pop("ways"), lambda p: p["ways"]["out"].update(bias=np.zeros(9, np.float32)),
        lambda p: p.update(more={"bias": np.zeros(2, np.float32)}),
    )):  # fmt: skip
        other = jax.tree.map(lambda a: a, params)
        change(other)
        file = tmp_path / f"{number}.safetensors"
        weights.save(file, SPEC, other, HELD, {})
        with pytest.raises(ValueError, match="does not hold the arrays of its network"):
            weights.load(file)


def test_a_kill_while_writing_leaves_the_old_file(file, params, monkeypatch):
    before = file.read_bytes()

    def killed(self, content):
        raise KeyboardInterrupt

    monkeypatch.setattr("pathlib.Path.write_bytes", killed)
    with pytest.raises(KeyboardInterrupt):
        weights.save(file, SPEC, jax.tree.map(jnp.zeros_like, params), HELD, {})
    assert file.read_bytes() == before


def test_the_weights_that_come_along():
    """What `--predictor fusion` and the model card rely on."""
    trained = weights.load(expected=NetworkSpec())
    assert weights.SHIPPED.stat().st_size < 12e6
    card = (Path(__file__).resolve().parents[2] / "docs" / "model_card.md").read_text()
    figures = trained.notes["figures"]
    assert f"ways {100 * figures['accuracy']:.1f} %" in card and f"ECE {figures['ece']:.3f}" in card
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(trained.params))
