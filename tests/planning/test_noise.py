"""Noise: its moments and spectrum are the ones asked for, pairs are pairs, and a bank gives what it holds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drnav_jax.planning import noise
from drnav_jax.planning.noise import KINDS, NoiseParams, NoiseSpec

KEY = jax.random.key(0)
STEPS, SAMPLES = 32, 4000
# five standard errors of a mean over the samples
MEAN, POWER = 5 / np.sqrt(SAMPLES), 5 * np.sqrt(2 / SAMPLES)


def draw(spec, num=SAMPLES, **params):
    return np.asarray(noise.sample(spec, NoiseParams(**params), KEY, STEPS, num), np.float64)


@pytest.mark.parametrize("kind", KINDS)
def test_zero_mean_and_unit_variance_at_every_step(kind):
    eps = draw(NoiseSpec(kind))
    assert eps.shape == (STEPS, 2, SAMPLES)
    assert np.abs(eps.mean(axis=2)).max() < MEAN
    heavy = 4.0 if kind == "log_normal" else 1.0  # its fourth moment is larger
    assert np.abs((eps**2).mean(axis=2) - 1).max() < heavy * POWER
    assert abs((eps[:, 0] * eps[:, 1]).mean()) < MEAN, "the axes are independent"


@pytest.mark.parametrize(("kind", "params"), [("coloured", {"beta": 1.5}), ("low_pass", {"cutoff": 0.08})])
def test_the_correlation_is_that_of_the_spectrum(kind, params):
    eps = draw(NoiseSpec(kind), **params)
    f = (np.arange(512) + 0.5) / 1024
    density = np.maximum(f, 1 / STEPS) ** -1.5 if kind == "coloured" else 1 / (1 + (f / 0.08) ** 4)
    want = [np.sum(density * np.cos(2 * np.pi * f * n)) / density.sum() for n in range(STEPS)]
    got = [(eps[n:] * eps[: STEPS - n]).mean() for n in range(STEPS)]
    np.testing.assert_allclose(got, want, atol=POWER)
    assert want[1] > 0.6, "smoother than white noise"


def test_white_is_white_and_log_normal_has_heavy_tails():
    white, heavy = draw(NoiseSpec()), draw(NoiseSpec("log_normal"))
    assert abs((white[1:] * white[:-1]).mean()) < MEAN
    kurtosis = lambda a: (a**4).mean() / (a**2).mean() ** 2  # noqa: E731
    assert abs(kurtosis(white) - 3) < 0.3 and kurtosis(heavy) > 5
    np.testing.assert_allclose(draw(NoiseSpec("log_normal"), log_std=0.0).std(), 1.0, atol=0.02)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("num", [8, 9])
def test_antithetic_pairs(kind, num):
    eps = draw(NoiseSpec(kind, antithetic=True), num=num)
    half = (num + 1) // 2
    np.testing.assert_array_equal(eps[:, :, half:], -eps[:, :, : num - half])
    assert eps.shape[2] == num and np.abs(eps).min() > 0


@pytest.mark.parametrize("antithetic", [False, True])
def test_a_bank_gives_stretches_of_itself_with_either_sign(antithetic):
    spec = NoiseSpec(antithetic=antithetic, bank=50)
    bank = noise.fill(spec, NoiseParams(), KEY, STEPS, 20)
    assert bank.shape == (STEPS, 2, 50)
    held, seen, signs = np.asarray(bank), set(), set()
    for k in range(40):
        eps, sign = map(np.asarray, noise.draw(spec, NoiseParams(), bank, jax.random.key(k), 20))
        signs.add(tuple(sign.tolist()))
        assert eps.shape == (STEPS, 2, 20)
        for j in range(20):
            assert (np.abs(held - eps[:, :, j : j + 1]).max(axis=(0, 1)) == 0).any(), "each column is one of the bank's"
        if antithetic:
            np.testing.assert_array_equal(eps[:, :, 10:], -eps[:, :, :10])
        seen.add(eps[0, 0, 0])
    assert len(seen) > 10 and signs == {(a, b) for a in (-1.0, 1.0) for b in (-1.0, 1.0)}


def test_without_a_bank_every_draw_is_fresh():
    spec = NoiseSpec()
    bank = noise.fill(spec, NoiseParams(), KEY, STEPS, 20)
    assert bank.shape == (STEPS, 2, 0)
    (a, sign), (b, _) = (noise.draw(spec, NoiseParams(), bank, jax.random.key(k), 20) for k in (0, 1))
    np.testing.assert_array_equal(sign, [1, 1])
    assert float(jnp.abs(a - b).min()) > 0
    np.testing.assert_array_equal(a, noise.sample(spec, NoiseParams(), jax.random.key(0), STEPS, 20))


def test_mirrors_are_four_different_pairs_of_signs():
    signs = [tuple(np.asarray(noise.mirror(jnp.asarray(k))).tolist()) for k in range(5)]
    assert signs[0] == signs[4] == (1.0, 1.0) and len(set(signs)) == 4


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match='no noise "pink": choose from white'):
        NoiseSpec("pink")
    with pytest.raises(ValueError, match="bank must be >= 0"):
        NoiseSpec(bank=-1)
    with pytest.raises(ValueError, match="must be even, got 51"):
        NoiseSpec(antithetic=True, bank=51)
    with pytest.raises(ValueError, match="bank must be >= num_samples"):
        noise.fill(NoiseSpec(bank=10), NoiseParams(), KEY, STEPS, 20)
