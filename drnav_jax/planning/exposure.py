"""Expected dead-end exposure (paper, section IV-C).

Along a path with arc length s and discount w(s) = exp(-decay s):

    EDE(path) = sum_k w_k P_dead^foot(c_k)                              (discrete)
    EDE(path) = integral_0^L w(s) P_dead^foot(x(s)) ds                  (continuous)

The sum depends on the step of the path, the integral does not; planners use the integral (`scoring` as a sum over the
steps of a rollout). Both are differentiable in the path and in the map. A robot that stands or turns on the spot moves
along no arc and would be exposed to nothing; the integral charges it P^foot times an equivalent length per second.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from drnav_jax import geometry
from drnav_jax.types import GridMap, Scalar

STANDING_SPEED = 0.25  # [m/s] equivalent length per second of standing still


def arc_lengths(path: Float[Array, "T 2"]) -> Float[Array, " T"]:
    """Arc length s_k [m] at each point; 0 at the first."""
    step = jnp.sqrt(jnp.sum(jnp.square(path[1:] - path[:-1]), axis=-1) + 1e-12)  # smooth where points coincide
    return jnp.concatenate([jnp.zeros(1, path.dtype), jnp.cumsum(step)])


@jax.jit
def exposure_sum(risk: Float[Array, " T"], arc: Float[Array, " T"], decay: Scalar) -> Float[Array, ""]:
    """The paper's discrete sum over the cells of a path.

    Args:
        risk: P_dead^foot(c_k) of each cell.
        arc: Arc length s_k at each cell [m].
        decay: Path discount, lambda of w_k = exp(-lambda s_k) [1/m].
    """
    return jnp.sum(jnp.exp(-decay * arc) * risk)


@partial(jax.jit, static_argnames="substeps")
def exposure_integral(
    risk: GridMap, path: Float[Array, "T 2"], decay: Scalar, *, dt: Scalar = 0.0, substeps: int = 4
) -> Float[Array, ""]:
    """The continuous exposure by Simpson's rule on every segment of the path.

    Args:
        risk: P_dead^foot on a grid; interpolated bilinearly, no risk outside.
        path: Points in the grid's frame [m].
        decay: Path discount [1/m].
        dt: Time per segment [s]; segments shorter than `STANDING_SPEED` * dt count as that long.
        substeps: Simpson panels per segment (static).
    """
    arc = arc_lengths(path)
    fraction = jnp.linspace(0.0, 1.0, 2 * substeps + 1, dtype=jnp.float32)
    weight = jnp.where(jnp.arange(2 * substeps + 1) % 2 == 1, 4.0, 2.0).astype(jnp.float32)
    weight = weight.at[0].set(1.0).at[-1].set(1.0) / (6.0 * substeps)
    points = path[:-1, None, :] + fraction[None, :, None] * (path[1:] - path[:-1])[:, None, :]
    length = arc[1:] - arc[:-1]
    s = arc[:-1, None] + fraction[None, :] * length[:, None]
    density = jnp.exp(-decay * s) * geometry.sample_bilinear(risk, points, fill=0.0)
    return jnp.sum(jnp.maximum(length, STANDING_SPEED * dt) * jnp.sum(density * weight[None, :], axis=-1))
