"""Depthwise convolution: one filter per channel, on CPU as shifts and products.

XLA's grouped convolution is fast on accelerators and slow on CPU. In its place there, with the padded input x̄, stride s
and kernel w (k x k, one per channel)

    (1)  y[i, j]  = Σ_ab w[a, b] x̄[s i + a, s j + b]
    (2)  dx̄[i, j] = Σ_ab w[a, b] ḡ[i - a, j - b]            ḡ: the gradient g with s - 1 zeros between its entries
    (3)  dw[a, b] = Σ_ij x̄[s i + a, s j + b] g[i, j]        as a product with a row of ones

Results are computed once (`grids.once`): fused into what comes after, all k x k products are done anew for every use.

Padding is k // 2 on all sides, as PyTorch has it, so that weights from there mean the same here.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from drnav_jax.grids import once
from drnav_jax.models.layers import column_sums


def size_after(size: int, kernel: int, stride: int) -> int:
    """Pixels along an edge after a convolution with padding `kernel // 2`."""
    return (size + 2 * (kernel // 2) - kernel) // stride + 1


def _window(padded: Array, a: int, b: int, shape: tuple[int, int], stride: int) -> Array:
    """x̄[s i + a, s j + b] for all i, j."""
    n, _, _, c = padded.shape
    last = (n, a + (shape[0] - 1) * stride + 1, b + (shape[1] - 1) * stride + 1, c)
    return jax.lax.slice(padded, (0, a, b, 0), last, (1, stride, stride, 1))


def _pad(x: Array, kernel: int) -> Array:
    by = kernel // 2
    return jnp.pad(x, ((0, 0), (by, by), (by, by), (0, 0)))


def _forward(x: Array, kernel: Array, stride: int) -> Array:
    k = kernel.shape[0]
    out = (size_after(x.shape[1], k, stride), size_after(x.shape[2], k, stride))
    padded, total = once(_pad(x, k)), None
    for a in range(k):
        for b in range(k):
            term = _window(padded, a, b, out, stride) * kernel[a, b][None, None, None, :]
            total = term if total is None else total + term
    assert total is not None
    return once(total)


def depthwise(x: Float[Array, "n h w c"], kernel: Float[Array, "k k c"], stride: int = 1) -> Float[Array, "n h2 w2 c"]:
    """Each channel filtered by its own kernel (eq. 1), as the default backend does it fastest.

    Args:
        x: Images.
        kernel: k odd.
        stride: Pixels per step (static).
    """
    return (shifted if jax.default_backend() == "cpu" else grouped)(x, kernel, stride)


def grouped(x: Float[Array, "n h w c"], kernel: Float[Array, "k k c"], stride: int = 1) -> Float[Array, "n h2 w2 c"]:
    """`depthwise` by XLA's convolution."""
    half = kernel.shape[0] // 2
    return jax.lax.conv_general_dilated(
        x, kernel[:, :, None, :], (stride, stride), ((half, half), (half, half)),
        dimension_numbers=("NHWC", "HWIO", "NHWC"), feature_group_count=x.shape[-1],
    )  # fmt: skip


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def shifted(x: Float[Array, "n h w c"], kernel: Float[Array, "k k c"], stride: int = 1) -> Float[Array, "n h2 w2 c"]:
    """`depthwise` by eqs. 1 to 3."""
    return _forward(x, kernel, stride)


def _keep(x: Array, kernel: Array, stride: int) -> tuple[Array, tuple[Array, Array]]:
    return _forward(x, kernel, stride), (x, kernel)


def _gradient(stride: int, kept: tuple[Array, Array], g: Array) -> tuple[Array, Array]:
    (x, kernel), g = kept, once(g)
    k, (_, h, w, c) = kernel.shape[0], x.shape
    out, by = (g.shape[1], g.shape[2]), k // 2

    def of_image(total: Array, pair: tuple[Array, Array]) -> tuple[Array, None]:
        padded, gradient = (part[None] for part in pair)
        taps = [column_sums(_window(padded, a, b, out, stride) * gradient) for a in range(k) for b in range(k)]
        return total + jnp.stack(taps), None

    # image by image: what lies between product and sum stays in the cache; 5 to 12 times as fast as all images at once
    summed, _ = jax.lax.scan(of_image, jnp.zeros((k * k, c), x.dtype), (_pad(x, k), g))
    # ḡ, so padded that its entry (k - 1 - a, ...) of a k x k window is the one that eq. 2 multiplies by w[a, b]
    spans = [stride * (n - 1) + 1 for n in out]
    low = k - 1 - by
    high = [edge - span + by for edge, span in zip((h, w), spans, strict=True)]
    spread = once(jax.lax.pad(
        g, jnp.zeros((), g.dtype), ((0, 0, 0), (low, high[0], stride - 1), (low, high[1], stride - 1), (0, 0, 0))
    ))
    return _forward_full(spread, kernel, (h, w)), summed.reshape(k, k, c)


def _forward_full(spread: Array, kernel: Array, shape: tuple[int, int]) -> Array:
    """Eq. 2 on the spread and padded gradient."""
    k, total = kernel.shape[0], None
    for a in range(k):
        for b in range(k):
            term = _window(spread, k - 1 - a, k - 1 - b, shape, 1) * kernel[a, b][None, None, None, :]
            total = term if total is None else total + term
    assert total is not None
    return once(total)


shifted.defvjp(_keep, _gradient)
