"""Random control sequences for MPPI: K sequences of T steps on two axes, zero mean, unit variance at every step.

With z white, and w(f) the spectral density of the wanted noise, f = 0..1/2 [1/step],

    white        eps = z
    coloured     eps = C z,  C C' = [r(t - s)],  r(n) = sum_f w(f) cos(2 pi f n) / sum_f w(f),  w = max(f, 1/T)^-beta    (1)
    low_pass     likewise with w = 1 / (1 + (f / cutoff)^4), a second-order Butterworth filter                           (2)
    log_normal   eps = z exp(s eta - s^2), eta white: heavier tails, same variance (log-MPPI, Mohamed et al. 2022)       (3)

so any spectrum costs T random numbers per sequence and one small matrix product. On a CPU the random numbers are what is
dear, not the rollouts: `antithetic` uses each sequence and its negative, and a bank is drawn once and then read from a
random place each time, with a random sign per axis.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from drnav_jax.types import Scalar

KINDS = ("white", "coloured", "low_pass", "log_normal")
_FREQUENCIES = 512  # of the sums in (1): four per period of the longest horizon in use


@dataclasses.dataclass(frozen=True)
class NoiseSpec:
    """Which noise.

    Attributes:
        kind: One of `KINDS`.
        antithetic: The second half of the sequences is the negative of the first.
        bank: Sequences drawn once and reused, an even number of antithetic ones; 0 draws fresh ones every time.
    """

    kind: str = "white"
    antithetic: bool = False
    bank: int = 0

    def __post_init__(self) -> None:
        """Check the kind and the size of the bank."""
        if self.kind not in KINDS:
            raise ValueError(f'There is no noise "{self.kind}": choose from {", ".join(KINDS)}.')
        if self.bank < 0:
            raise ValueError(f"bank must be >= 0 sequences, got {self.bank}.")
        if self.antithetic and self.bank % 2:
            raise ValueError(f"a bank of antithetic sequences holds pairs: its size must be even, got {self.bank}.")


class NoiseParams(NamedTuple):
    """Shape of the spectrum and of the tails."""

    beta: Scalar = 1.0  # [] exponent of coloured noise: 0 white, 1 pink, 2 red
    cutoff: Scalar = 0.1  # [] corner of low-pass noise [1/step]
    log_std: Scalar = 0.5  # [] s of log-normal noise


def covariance(spec: NoiseSpec, params: NoiseParams, num_steps: int) -> Float[Array, "T T"]:
    """Covariance of the steps of one sequence, equations (1) and (2); the identity for uncorrelated noise."""
    if spec.kind not in ("coloured", "low_pass"):
        return jnp.eye(num_steps, dtype=jnp.float32)
    f = (jnp.arange(_FREQUENCIES, dtype=jnp.float32) + 0.5) * (0.5 / _FREQUENCIES)
    if spec.kind == "coloured":
        density = jnp.exp(-params.beta * jnp.log(jnp.maximum(f, 1.0 / num_steps)))
    else:
        density = 1.0 / (1.0 + jnp.square(jnp.square(f / params.cutoff)))
    lag = jnp.arange(num_steps, dtype=jnp.float32)
    wave = jnp.cos((2 * jnp.pi) * lag[:, None] * f[None, :])
    r = jnp.sum(wave * density[None, :], axis=1) / jnp.sum(density)
    step = jnp.arange(num_steps)
    return r[jnp.abs(step[:, None] - step[None, :])]


def sample(
    spec: NoiseSpec, params: NoiseParams, key: PRNGKeyArray, num_steps: int, num_samples: int
) -> Float[Array, "T 2 K"]:
    """Fresh sequences.

    Args:
        spec: Which noise.
        params: Its shape.
        key: Randomness.
        num_steps: T.
        num_samples: K.
    """
    fresh = (num_samples + 1) // 2 if spec.antithetic else num_samples
    key_z, key_eta = jax.random.split(key)
    eps = jax.random.normal(key_z, (num_steps, 2, fresh), jnp.float32)
    if spec.kind in ("coloured", "low_pass"):
        # a smooth spectrum makes neighbours nearly equal, and the matrix singular in float32
        smooth = covariance(spec, params, num_steps) + 1e-4 * jnp.eye(num_steps, dtype=jnp.float32)
        factor = jnp.linalg.cholesky(smooth)
        eps = (factor @ eps.reshape(num_steps, -1)).reshape(eps.shape)
    elif spec.kind == "log_normal":
        s = jnp.asarray(params.log_std, jnp.float32)
        eps = eps * jnp.exp(s * jax.random.normal(key_eta, eps.shape, jnp.float32) - s * s)
    return jnp.concatenate([eps, -eps], axis=2)[:, :, :num_samples] if spec.antithetic else eps


def fill(
    spec: NoiseSpec, params: NoiseParams, key: PRNGKeyArray, num_steps: int, num_samples: int
) -> Float[Array, "T 2 B"]:
    """The bank; no columns if the spec asks for none.

    Raises:
        ValueError: If the bank is smaller than what is drawn from it at a time.
    """
    if 0 < spec.bank < num_samples:
        raise ValueError(f"a bank of {spec.bank} sequences cannot give {num_samples} of them: bank must be >= num_samples.")
    if not spec.bank:
        return jnp.zeros((num_steps, 2, 0), jnp.float32)
    return sample(spec, params, key, num_steps, spec.bank)


def draw(
    spec: NoiseSpec, params: NoiseParams, bank: Float[Array, "T 2 B"], key: PRNGKeyArray, num_samples: int
) -> tuple[Float[Array, "T 2 K"], Float[Array, "2"]]:
    """K sequences out of the bank, or fresh ones if there is none, and the sign to take each axis with.

    Args:
        spec: Which noise.
        params: Its shape.
        bank: From `fill`.
        key: Randomness.
        num_samples: K.
    """
    num_steps, _, held = bank.shape
    if not held:
        return sample(spec, params, key, num_steps, num_samples), jnp.ones(2, jnp.float32)
    key_place, key_sign = jax.random.split(key)
    # an antithetic bank keeps its pairs together: a stretch of the first half and the same stretch of the second
    half = num_samples // 2 if spec.antithetic else num_samples
    width = held // 2 if spec.antithetic else held
    place = jax.random.randint(key_place, (), 0, width - half + 1)
    sign = jnp.where(jax.random.bernoulli(key_sign, 0.5, (2,)), 1.0, -1.0).astype(jnp.float32)
    take = lambda begin, size: jax.lax.dynamic_slice_in_dim(bank, begin, size, axis=2)  # noqa: E731
    parts = [take(place, half), take(place + width, num_samples - half)] if spec.antithetic else [take(place, half)]
    return jnp.concatenate(parts, axis=2), sign  # multiplying would take as long as a rollout


def mirror(attempt: Int[Array, ""]) -> Float[Array, "2"]:
    """Signs that make other sequences of the same: none changed at attempt 0, then omega's, v's, both."""
    return jnp.stack([1 - 2 * ((attempt // 2) % 2), 1 - 2 * (attempt % 2)]).astype(jnp.float32)
