"""Layers that the networks share, with gradients that are fast on a CPU.

XLA's CPU backend sums over all but the last axis, which every bias and every scale asks for in its gradient, at a fraction
of the speed of a matrix product. So (g is the incoming gradient, one row per pixel, point or token)

    (1)  d(x + b)/db: 1ᵀ g        d(x · a)/da: 1ᵀ (x ∘ g)        as products with a row of ones

Everything is float32, channels last, and without state: normalisation is over the channels of each pixel.
"""

from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

EPSILON = 1e-5  # added to variances
ACTIVATIONS: dict[str, Callable[[Array], Array]] = {"silu": nn.silu, "relu": nn.relu}

he_normal = nn.initializers.variance_scaling(2.0, "fan_in", "truncated_normal", dtype=jnp.float32)
lecun_normal = nn.initializers.variance_scaling(1.0, "fan_in", "truncated_normal", dtype=jnp.float32)
small = nn.initializers.variance_scaling(1e-3, "fan_in", "truncated_normal", dtype=jnp.float32)
zeros = nn.initializers.zeros_init()
ones = nn.initializers.ones_init()


def embedding(key: PRNGKeyArray, shape: tuple[int, ...], dtype: Any = jnp.float32) -> Array:
    """Initial values of learned places of tokens and cells."""
    return 0.1 * jax.random.normal(key, shape, dtype)


def column_sums(values: Float[Array, "*rows c"]) -> Float[Array, " c"]:
    """Sum over all axes but the last."""
    rows = values.reshape(-1, values.shape[-1])
    return (jnp.ones((1, rows.shape[0]), rows.dtype) @ rows)[0]


def _along(vector: Array, rank: int) -> Array:
    return vector.reshape((1,) * (rank - 1) + (-1,))


@jax.custom_vjp
def add(x: Float[Array, "*rows c"], bias: Float[Array, " c"]) -> Float[Array, "*rows c"]:
    """One number per channel added (eq. 1)."""
    return x + _along(bias, x.ndim)


add.defvjp(lambda x, b: (add(x, b), None), lambda _, g: (g, column_sums(g)))


@jax.custom_vjp
def multiply(x: Float[Array, "*rows c"], scale: Float[Array, " c"]) -> Float[Array, "*rows c"]:
    """Each channel times its number (eq. 1)."""
    return x * _along(scale, x.ndim)


multiply.defvjp(
    lambda x, a: (multiply(x, a), (x, a)), lambda kept, g: (g * _along(kept[1], g.ndim), column_sums(kept[0] * g))
)


class Dense(nn.Module):
    """Affine map of the last axis.

    Attributes:
        features: Channels out.
        bias: Whether to add one.
        kernel_init: Of the weights.
    """

    features: int
    bias: bool = True
    kernel_init: Any = he_normal

    @nn.compact
    def __call__(self, x: Float[Array, "*rows c"]) -> Float[Array, "*rows d"]:
        """Apply it; as one product of two matrices."""
        kernel = self.param("kernel", self.kernel_init, (x.shape[-1], self.features))
        y = x.reshape(-1, x.shape[-1]) @ kernel
        if self.bias:
            y = add(y, self.param("bias", zeros, (self.features,)))
        return y.reshape(*x.shape[:-1], self.features)


class Norm(nn.Module):
    """Scale and shift per channel, after normalising over the channels of each pixel if `kind` is "layer".

    Attributes:
        kind: "layer", or "affine": scale and shift only, which is what a batch norm is once its statistics are fixed.
    """

    kind: str = "layer"

    @nn.compact
    def __call__(self, x: Float[Array, "*rows c"]) -> Float[Array, "*rows c"]:
        """Apply it."""
        if self.kind == "layer":
            x = x - jnp.mean(x, axis=-1, keepdims=True)
            x = x * jax.lax.rsqrt(jnp.mean(jnp.square(x), axis=-1, keepdims=True) + EPSILON)
        scale = self.param("scale", ones, (x.shape[-1],))
        return add(multiply(x, scale), self.param("bias", zeros, (x.shape[-1],)))


def masked_softmax(scores: Float[Array, "*s k"], mask: Bool[Array, "*#s k"]) -> Float[Array, "*s k"]:
    """Softmax over the entries that the mask holds; all zero where it holds none."""
    scores = jnp.where(mask, scores, -jnp.inf)
    top = jax.lax.stop_gradient(jnp.max(scores, axis=-1, keepdims=True, initial=-jnp.inf))
    weights = jnp.where(mask, jnp.exp(scores - jnp.where(jnp.isfinite(top), top, 0.0)), 0.0)
    return weights / jnp.maximum(jnp.sum(weights, axis=-1, keepdims=True), 1e-9)


def masked_mean(values: Float[Array, "b k d"], mask: Bool[Array, "b k"]) -> Float[Array, "b d"]:
    """Mean over the entries that the mask holds; zero where it holds none."""
    weights = mask.astype(values.dtype)
    total = jnp.einsum("bkd,bk->bd", values, weights)
    return total / jnp.maximum(jnp.sum(weights, axis=-1), 1.0)[:, None]


def to_depth(x: Float[Array, "b h w c"], by: int) -> Float[Array, "b h2 w2 c2"]:
    """Blocks of `by` x `by` pixels as channels (rows first)."""
    b, h, w, c = x.shape
    x = x.reshape(b, h // by, by, w // by, by, c)
    return x.transpose(0, 1, 3, 2, 4, 5).reshape(b, h // by, w // by, by * by * c)


def to_space(x: Float[Array, "b h w c"], by: int) -> Float[Array, "b h2 w2 c2"]:
    """Channels as blocks of `by` x `by` pixels; undoes `to_depth`."""
    b, h, w, c = x.shape
    x = x.reshape(b, h, w, by, by, c // (by * by))
    return x.transpose(0, 1, 3, 2, 4, 5).reshape(b, h * by, w * by, c // (by * by))
