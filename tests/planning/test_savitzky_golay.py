"""The filter is SciPy's, on the sequence as Nav2 continues it."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

from drnav_jax.planning import savitzky_golay

ROUNDING = 1e-5  # float32, weights of both signs


@pytest.mark.parametrize("steps", [21, 28, 56])
def test_it_is_scipys_filter(steps):
    rng = np.random.default_rng(steps)
    u, history = rng.normal(size=(steps, 2)), rng.normal(size=(4, 2))
    got = savitzky_golay.smooth(jnp.asarray(u, jnp.float32), jnp.asarray(history, jnp.float32))
    padded = np.concatenate([history, u, np.repeat(u[-1:], 4, axis=0)])
    want = signal.savgol_filter(padded, 9, 2, axis=0)[4:-4]
    np.testing.assert_allclose(got[:-1], want[:-1], rtol=ROUNDING, atol=ROUNDING)
    np.testing.assert_array_equal(got[-1], np.float32(u[-1]))


def test_parabolas_pass_unchanged_and_noise_shrinks():
    t = np.arange(-4, 40)
    curve = np.stack([0.3 - 0.02 * t + 1e-3 * t**2, np.full(44, 0.5)], axis=1)
    got = savitzky_golay.smooth(jnp.asarray(curve[4:], jnp.float32), jnp.asarray(curve[:4], jnp.float32))
    np.testing.assert_allclose(got[:-4], curve[4:-4], rtol=ROUNDING, atol=ROUNDING)
    white = np.random.default_rng(0).normal(size=(400, 2))
    smooth = savitzky_golay.smooth(jnp.asarray(white, jnp.float32), jnp.zeros((4, 2)))
    assert np.std(smooth) < 0.6 * np.std(white)  # sum of a_j^2 = 59 / 231, its root 0.505


def test_short_sequences_are_left_alone():
    u = jnp.asarray(np.random.default_rng(0).normal(size=(20, 2)), jnp.float32)
    assert savitzky_golay.smooth(u, jnp.ones((4, 2))) is u
