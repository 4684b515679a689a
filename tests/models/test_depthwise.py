"""Depthwise convolution and its gradients: the same as a loop over pixels, and as XLA's grouped convolution."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_network as reference

from drnav_jax.models.depthwise import depthwise, grouped, shifted, size_after

# sums of up to 25 (taps) or 90 (pixels of two images) products in float32 against float64, inputs of order 1
CLOSE = {"rtol": 2e-5, "atol": 2e-5}
CASES = [
    (7, 9, 3, 1), (7, 9, 3, 2), (8, 6, 3, 2), (7, 6, 5, 1), (5, 8, 5, 2), (9, 5, 5, 2), (2, 3, 5, 1), (7, 8, 3, 3),
    (1, 1, 3, 2),
]  # fmt: skip


def case(h, w, kernel, stride, seed=0):
    rng = np.random.default_rng(seed)
    x, k = rng.normal(size=(2, h, w, 3)), rng.normal(size=(kernel, kernel, 3))
    g = rng.normal(size=(2, size_after(h, kernel, stride), size_after(w, kernel, stride), 3))
    return [a.astype(np.float32) for a in (x, k, g)]


@pytest.mark.parametrize(("h", "w", "kernel", "stride"), CASES)
def test_forward_and_gradients_are_those_of_a_loop_and_of_xla(h, w, kernel, stride):
    x, k, g = case(h, w, kernel, stride)
    ours, pull = jax.vjp(lambda x, k: shifted(x, k, stride), jnp.asarray(x), jnp.asarray(k))
    theirs, other_pull = jax.vjp(lambda x, k: grouped(x, k, stride), jnp.asarray(x), jnp.asarray(k))
    np.testing.assert_allclose(ours, reference.depthwise(x, k, stride), **CLOSE)
    np.testing.assert_allclose(theirs, reference.depthwise(x, k, stride), **CLOSE)
    for mine, loop, xla in zip(
        pull(jnp.asarray(g)), reference.depthwise_gradients(x, k, stride, g), other_pull(jnp.asarray(g)), strict=True
    ):
        assert mine.dtype == jnp.float32 and mine.shape == xla.shape
        np.testing.assert_allclose(mine, loop, **CLOSE)
        np.testing.assert_allclose(mine, xla, **CLOSE)


def test_under_vmap_and_jit_as_image_by_image():
    x, k, g = case(5, 4, 3, 2)
    stack = lambda a: jnp.stack([jnp.asarray(a), 2 * jnp.asarray(a)])  # noqa: E731

    @jax.jit
    def gradients(x, k, g):
        return jax.vjp(lambda x, k: shifted(x, k, 2), x, k)[1](g)

    many = jax.vmap(gradients)(stack(x), stack(k), stack(g))
    for n in range(2):
        for batched, alone in zip(many, gradients(*(stack(a)[n] for a in (x, k, g))), strict=True):
            np.testing.assert_allclose(batched[n], alone, **CLOSE)


def test_each_backend_has_its_own(monkeypatch):
    x, k, _ = (jnp.asarray(a) for a in case(7, 6, 5, 2))
    for backend, own in (("cpu", shifted), ("gpu", grouped)):
        monkeypatch.setattr(jax, "default_backend", lambda backend=backend: backend)
        assert str(jax.make_jaxpr(lambda: depthwise(x, k, 2))()) == str(jax.make_jaxpr(lambda own=own: own(x, k, 2))())
