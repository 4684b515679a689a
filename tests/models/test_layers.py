"""Layers with hand-written gradients against plain ones; masks that hold nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_network as reference

from drnav_jax.models import layers
from drnav_jax.models.layers import Dense, Norm

CLOSE = {"rtol": 1e-5, "atol": 1e-5}  # float32 against float64 in sums of at most 24 numbers of order 1
RNG = np.random.default_rng(0)


def normal(*shape):
    return jnp.asarray(RNG.normal(size=shape), jnp.float32)


@pytest.mark.parametrize("shape", [(4,), (3, 4), (2, 3, 4), (2, 3, 1, 4)])
@pytest.mark.parametrize("name", ["add", "multiply"])
def test_a_number_per_channel_and_its_gradients(name, shape):
    x, v, g = np.float64(normal(*shape)), np.float64(normal(4)), np.float64(normal(*shape))
    f32 = lambda a: jnp.asarray(a, jnp.float32)  # noqa: E731
    y, pull = jax.vjp(getattr(layers, name), f32(x), f32(v))
    dx, dv = pull(f32(g))
    by_rows = lambda a: a.reshape(-1, 4).sum(axis=0)  # noqa: E731
    expected = (x + v, g, by_rows(g)) if name == "add" else (x * v, g * v, by_rows(g * x))
    for got, want in zip((y, dx, dv), expected, strict=True):
        assert got.shape == want.shape
        np.testing.assert_allclose(got, want, **CLOSE)


def plain_dense(params, x):
    return jnp.einsum("...c,cd->...d", x, params["kernel"]) + params.get("bias", jnp.zeros(()))


def plain_norm(params, x, kind="layer"):
    if kind == "layer":
        x = (x - x.mean(-1, keepdims=True)) / jnp.sqrt(x.var(-1, keepdims=True) + layers.EPSILON)
    return x * params["scale"] + params["bias"]


@pytest.mark.relaxed  # flax
@pytest.mark.parametrize(
    ("module", "plain"),
    [
        (Dense(5), plain_dense),
        (Dense(5, bias=False), plain_dense),
        (Norm(), plain_norm),
        (Norm("affine"), lambda p, x: plain_norm(p, x, "affine")),
    ],
    ids=["dense", "no_bias", "layer", "affine"],
)
def test_modules_and_their_gradients_are_the_plain_formulas(module, plain):
    x = normal(2, 3, 4)
    params = module.init(jax.random.key(0), x)["params"]
    params = jax.tree.map(lambda a: normal(*a.shape), params)  # no zeros, no ones
    g = normal(*module.apply({"params": params}, x).shape)
    ours, pull = jax.vjp(lambda p, x: module.apply({"params": p}, x), params, x)
    theirs, other = jax.vjp(plain, params, x)
    np.testing.assert_allclose(ours, theirs, **CLOSE)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, **CLOSE), pull(g), other(g))


@pytest.mark.relaxed
def test_layer_norm_of_a_constant_is_the_bias():
    """No division by the variance, which is 0."""
    params = {"scale": normal(4), "bias": normal(4)}
    y, pull = jax.vjp(lambda x: Norm().apply({"params": params}, x), jnp.full((2, 4), 3.0, jnp.float32))
    np.testing.assert_allclose(y, np.tile(params["bias"], (2, 1)), **CLOSE)
    assert np.isfinite(pull(jnp.ones_like(y))[0]).all()


def test_masked_softmax_is_a_softmax_over_what_the_mask_holds():
    scores = 3 * normal(2, 3, 5)
    mask = np.array([[1, 0, 1, 1, 0], [0, 0, 0, 1, 0]], bool)[:, None, :]
    got = np.asarray(layers.masked_softmax(scores, jnp.asarray(mask)))
    for b in range(2):
        there = mask[b, 0]
        for row in range(3):
            np.testing.assert_allclose(got[b, row, there], reference.softmax(np.float64(scores[b, row])[there]), **CLOSE)
            assert (got[b, row, ~there] == 0).all()


@pytest.mark.parametrize("broken", [jnp.inf, -jnp.inf, jnp.nan, 1e30])
def test_masked_scores_do_not_matter(broken):
    mask = jnp.asarray([[True, False, True]])
    scores = jnp.asarray([[0.3, 0.0, -200.0]], jnp.float32)
    clean = layers.masked_softmax(scores, mask)
    np.testing.assert_array_equal(layers.masked_softmax(scores.at[0, 1].set(broken), mask), clean)


def test_masked_softmax_without_anything_valid_is_zero_and_so_is_its_gradient():
    scores, mask = normal(2, 4), jnp.asarray([[False] * 4, [True, False, False, False]])
    weights, pull = jax.vjp(lambda s: layers.masked_softmax(s, mask), scores)
    np.testing.assert_array_equal(weights, [[0, 0, 0, 0], [1, 0, 0, 0]])
    np.testing.assert_array_equal(pull(normal(2, 4))[0], np.zeros((2, 4)))


def test_softmax_of_large_scores_neither_overflows_nor_vanishes():
    scores, mask = jnp.asarray([[1e4, 1e4 - 1.0, -1e4]], jnp.float32), jnp.ones((1, 3), bool)
    want = reference.softmax(np.array([1.0, 0.0, -2e4]))
    np.testing.assert_allclose(layers.masked_softmax(scores, mask)[0], want, **CLOSE)


def test_masked_mean():
    values = normal(3, 4, 2)
    mask = np.array([[1, 1, 1, 1], [0, 1, 0, 1], [0, 0, 0, 0]], bool)
    got, pull = jax.vjp(lambda v: layers.masked_mean(v, jnp.asarray(mask)), values)
    np.testing.assert_allclose(got[0], np.mean(values[0], axis=0), **CLOSE)
    np.testing.assert_allclose(got[1], (np.float64(values[1, 1]) + np.float64(values[1, 3])) / 2, **CLOSE)
    np.testing.assert_array_equal(got[2], [0, 0])
    np.testing.assert_allclose(pull(jnp.ones((3, 2)))[0][:, :, 0], mask / np.array([[4], [2], [1]]), **CLOSE)


def test_depth_and_space():
    x = np.arange(2 * 4 * 6 * 3).reshape(2, 4, 6, 3)
    deep = np.asarray(layers.to_depth(jnp.asarray(x, jnp.float32), 2))
    assert deep.shape == (2, 2, 3, 12)
    for i in range(2):
        for j in range(3):
            block = [x[:, 2 * i + a, 2 * j + b] for a in range(2) for b in range(2)]
            np.testing.assert_array_equal(deep[:, i, j], np.concatenate(block, axis=-1))
    np.testing.assert_array_equal(layers.to_space(jnp.asarray(deep), 2), x)
