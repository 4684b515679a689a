"""Temperatures: how sure the network's heads may be (Guo et al. 2017, with an offset).

    p = σ(z / T + b)        T, b: least cross-entropy on frames that the network was not trained on

T > 1 makes a head less sure. The offset corrects a base rate that training weighted differently (`losses`, eq. 1).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import optimize

from drnav_jax.models.network import Outputs


class Temperature(NamedTuple):
    """T and b of one head."""

    scale: float | Array = 1.0
    offset: float | Array = 0.0


class Calibration(NamedTuple):
    """Of every head that gives a probability."""

    path: Temperature = Temperature()
    flag: Temperature = Temperature()
    dead: Temperature = Temperature()
    traversable: Temperature = Temperature()  # training leaves it: what reads it has thresholds of its own


def probability(temperature: Temperature, logits: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """Calibrated probability."""
    return jax.nn.sigmoid(logits / jnp.maximum(temperature.scale, 1e-2) + temperature.offset)


def calibrated(calibration: Calibration, outputs: Outputs) -> Outputs:
    """The outputs with logits whose sigmoid is calibrated."""
    fields = {}
    for name in Calibration._fields:
        t = getattr(calibration, name)
        fields[name] = getattr(outputs, name) / jnp.maximum(t.scale, 1e-2) + t.offset
    return outputs._replace(**fields)


def fit(logits: np.ndarray, truth: np.ndarray, weights: np.ndarray | None = None) -> Temperature:
    """T and b of least cross-entropy (host code).

    Args:
        logits: Any shape.
        truth: The same shape, bool.
        weights: The same shape; None = 1 everywhere.

    Raises:
        ValueError: If the truth is the same everywhere, so that nothing can be learned.
    """
    z, y = np.asarray(logits, np.float64).ravel(), np.asarray(truth).ravel().astype(np.float64)
    w = np.ones_like(z) if weights is None else np.asarray(weights, np.float64).ravel()
    z, y, w = z[w > 0], y[w > 0], w[w > 0]
    if y.size == 0 or y.min() == y.max():
        raise ValueError("calibration needs frames of both kinds: give it more of them.")
    w = w / w.sum()

    def loss(x: np.ndarray) -> tuple[float, np.ndarray]:
        slope, offset = np.exp(x[0]), x[1]
        a = slope * z + offset
        wrong = w * (1.0 / (1.0 + np.exp(-np.clip(a, -500, 500))) - y)
        return float(np.sum(w * (np.logaddexp(0.0, a) - y * a))), np.array([np.sum(wrong * z) * slope, np.sum(wrong)])

    bounds = [(-4.0, 4.0), (-8.0, 8.0)]
    found = optimize.minimize(loss, np.zeros(2), jac=True, bounds=bounds, method="L-BFGS-B")
    return Temperature(scale=float(np.exp(-found.x[0])), offset=float(found.x[1]))
