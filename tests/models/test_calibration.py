"""Temperatures: a head that is too sure is found out, by how much."""

import jax.numpy as jnp
import numpy as np
import pytest
from reference_network import sigmoid

from drnav_jax.models import calibration
from drnav_jax.models.calibration import Calibration, Temperature
from drnav_jax.models.network import Outputs


def drawn(scale, offset, count=200_000, seed=0):
    """Logits, and truths that come true as often as σ(z / scale + offset) says."""
    rng = np.random.default_rng(seed)
    logits = 3 * rng.normal(size=count)
    return logits, rng.random(count) < sigmoid(logits / scale + offset)


def nll(p, truth):
    return -np.mean(np.log(np.where(truth, p, 1 - p)))


@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (2.5, 0.7), (0.6, -1.2), (6.0, 0.3)])
def test_the_temperature_and_offset_are_found(scale, offset):
    logits, truth = drawn(scale, offset)
    got = calibration.fit(logits.reshape(400, 500), truth.reshape(400, 500))
    # the standard error of both is about 1/sqrt(200,000 x mean p(1 - p)) x their scale: 0.7 % and 0.007
    assert got.scale == pytest.approx(scale, rel=0.03) and got.offset == pytest.approx(offset, abs=0.03)


def test_it_is_the_best_there_is():
    """No other pair within reach has a lower cross-entropy: a grid of them, in double precision."""
    logits, truth = drawn(2.5, 0.7, 3000)
    got = calibration.fit(logits, truth)
    at = lambda t, b: nll(sigmoid(logits / t + b), truth)  # noqa: E731
    best = at(got.scale, got.offset)
    assert best < at(1.0, 0.0) - 0.1
    for t in got.scale * np.linspace(0.8, 1.25, 10):
        for b in got.offset + np.linspace(-0.3, 0.3, 11):
            assert best <= at(t, b) + 1e-7


def test_weights_count_like_repeats():
    logits, truth = drawn(1.7, -0.4, 500)
    weights = np.random.default_rng(1).integers(0, 4, 500)
    weighed = calibration.fit(logits, truth, weights)
    repeated = calibration.fit(np.repeat(logits, weights), np.repeat(truth, weights))
    assert weighed.scale == pytest.approx(repeated.scale, rel=1e-3)
    assert weighed.offset == pytest.approx(repeated.offset, abs=1e-3)


@pytest.mark.parametrize("truth", [np.zeros(4, bool), np.ones(4, bool), np.zeros(0, bool)])
def test_one_kind_teaches_nothing(truth):
    with pytest.raises(ValueError, match="frames of both kinds"):
        calibration.fit(np.linspace(-1, 1, truth.size), truth)


def test_what_weighs_nothing_teaches_nothing():
    with pytest.raises(ValueError, match="frames of both kinds"):
        calibration.fit(np.array([1.0, -1.0, 0.5]), np.array([True, False, True]), np.array([1.0, 0.0, 1.0]))


def test_perfect_separation_stays_finite():
    logits = np.array([-3.0, -1.0, 1.0, 3.0])
    got = calibration.fit(logits, logits > 0)
    assert np.isfinite([got.scale, got.offset]).all() and 0 < got.scale < 1  # as sure as it may be


def test_calibrated_logits_give_the_calibrated_probability():
    rng = np.random.default_rng(0)
    f32 = lambda *s: jnp.asarray(rng.normal(size=s), jnp.float32)  # noqa: E731
    out = Outputs(f32(2, 3), f32(2), f32(2, 3, 4), f32(2, 3, 4), f32(2, 3, 4), f32(2, 3, 4), f32(2, 1), f32(2, 1))
    held = Calibration(Temperature(2.0, 0.5), Temperature(0.5, -1.0), Temperature(3.0, 0.1), Temperature(1.5, 0.2))
    got = calibration.calibrated(held, out)
    for name in Calibration._fields:
        t, z = getattr(held, name), getattr(out, name)
        want = sigmoid(np.float64(z) / t.scale + t.offset)
        np.testing.assert_allclose(sigmoid(np.float64(getattr(got, name))), want, rtol=1e-5)
        np.testing.assert_allclose(calibration.probability(t, z), want, rtol=1e-5)
    for name in ("recoverability", "depth", "alpha", "beta"):
        assert getattr(got, name) is getattr(out, name)
    for name, raw in zip(out._fields, calibration.calibrated(Calibration(), out), strict=True):
        np.testing.assert_array_equal(raw, getattr(out, name))
