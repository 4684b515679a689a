"""How MPPI (`mppi`) turns costs into weights.

With J_k the cost of sample k, and D its costs under as many disturbances:

    w_k = exp(-(J_k - min J) / temperature) / sum                                                                        (1)
    effective sample size = (sum w)^2 / sum w^2, which grows with the temperature                                        (2)
    CVaR over D disturbances: the mean of the worst tail D of a sample's D costs                                         (3)
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from drnav_jax.planning.mppi_rollout import Priced
from drnav_jax.types import Scalar


def tail_mean(priced: Priced, num: int, tail: Scalar) -> Priced:
    """Of D blocks of K costs, one block per disturbance: the mean of each sample's worst share `tail` (CVaR).

    Args:
        priced: `[D K]`.
        num: K.
        tail: Share, 0..1; at most 1 / D is the worst case, 1 the mean.
    """
    total = priced.total.reshape(-1, num)
    count = total.shape[0]
    order = jnp.argsort(-total, axis=0)
    size = jnp.clip(jnp.asarray(tail, jnp.float32) * count, 1.0, count)
    weight = jnp.clip(size - jnp.arange(count, dtype=jnp.float32), 0.0, 1.0) / size
    average = lambda a: jnp.sum(jnp.take_along_axis(a, order, axis=0) * weight[:, None], axis=0)  # noqa: E731
    terms = jax.vmap(average)(priced.terms.reshape(priced.terms.shape[0], count, num))
    return Priced(average(total), terms, jnp.any(priced.collides.reshape(count, num), axis=0))


def softmin(cost: Float[Array, " K"], temperature: Scalar) -> Float[Array, " K"]:
    """Weights of equation (1); at a temperature of 0 the best sample's alone."""
    weight = jnp.exp((jnp.min(cost) - cost) / jnp.maximum(temperature, 1e-12))
    return weight / jnp.sum(weight)


def effective_size(weight: Float[Array, " K"]) -> Float[Array, ""]:
    """Effective number of samples of normalised weights, 1..K."""
    return 1.0 / jnp.sum(jnp.square(weight))


def temperature_for(cost: Float[Array, " K"], share: Scalar) -> Float[Array, ""]:
    """The temperature at which the effective sample size is `share` of K, by bisection of its logarithm.

    The size grows with the temperature. Where samples tie for the best it cannot fall below their number.
    """
    count = cost.shape[0]
    wanted = jnp.clip(jnp.asarray(share, jnp.float32) * count, 1.0, count)
    # samples that collide are so far off that the spread of all says nothing: take twice the lower half's
    spread = jnp.maximum(2.0 * (jnp.median(cost) - jnp.min(cost)), 1e-3)
    bounds = jnp.log(jnp.stack([1e-5 * spread, 1e3 * spread]))

    def halve(_: Array, bounds: Array) -> Array:
        middle = 0.5 * (bounds[0] + bounds[1])
        cold = effective_size(softmin(cost, jnp.exp(middle))) < wanted
        return jnp.where(cold, jnp.stack([middle, bounds[1]]), jnp.stack([bounds[0], middle]))

    return jnp.exp(jnp.mean(jax.lax.fori_loop(0, 24, halve, bounds)))
