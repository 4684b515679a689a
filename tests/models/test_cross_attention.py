"""Fusion of tokens: attention is that of a loop over heads, and missing tokens are keys to nobody."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_network import attention, dense, layer_norm, silu
from small_network import filled

from drnav_jax.models.cross_attention import Attention, CrossModal, FeedForward, Integration

pytestmark = pytest.mark.relaxed  # flax
CLOSE = {"rtol": 5e-4, "atol": 5e-5}  # float32 through up to ten layers against float64
HEADS, D = 2, 4

# frames: both there; some missing; no image; no LiDAR; nothing
IMAGE_MASK = np.array([[1, 1, 1], [1, 0, 1], [0, 0, 0], [1, 1, 0], [0, 0, 0]], bool)
LIDAR_MASK = np.array([[1, 1], [0, 1], [1, 1], [0, 0], [0, 0]], bool)


def tokens(seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(5, 3, D)).astype(np.float32), rng.normal(size=(5, 2, D)).astype(np.float32)


def built(net, *args):
    """(apply, parameters)"""
    params = filled(jax.eval_shape(net.init, jax.random.key(0), *args)["params"])
    return jax.jit(lambda p, *a: net.apply({"params": p}, *a)), params


def test_attention_is_that_of_a_loop():
    image, lidar = tokens()
    apply, params = built(Attention(HEADS), image, lidar, LIDAR_MASK)
    got = apply(params, image, lidar, LIDAR_MASK)
    np.testing.assert_allclose(got, attention(params, image, lidar, LIDAR_MASK, HEADS), **CLOSE)
    assert not np.asarray(got)[~LIDAR_MASK.any(axis=1)].any()  # without keys it adds nothing


def feed_forward(params, x):
    return x + dense(params["outer"], silu(dense(params["inner"], layer_norm(params["norm"], x))))


def fused(params, image, lidar, layers):
    """Eqs. 1 and 2: both directions read the tokens as they came in."""
    for k in range(max(1, layers)):
        if layers:
            a, b = layer_norm(params[f"image_norm{k}"], image), layer_norm(params[f"lidar_norm{k}"], lidar)
            from_lidar = attention(params[f"image_to_lidar{k}"], a, b, LIDAR_MASK, HEADS)
            from_image = attention(params[f"lidar_to_image{k}"], b, a, IMAGE_MASK, HEADS)
            image, lidar = image + from_lidar, lidar + from_image
        image, lidar = (feed_forward(params[f"feed_forward{k}"], x) for x in (image, lidar))
    return image, lidar


@pytest.mark.parametrize("layers", [0, 1, 2])
def test_both_directions_are_those_of_a_loop(layers):
    image, lidar = tokens()
    args = (image, IMAGE_MASK, lidar, LIDAR_MASK)
    apply, params = built(CrossModal(HEADS, layers), *args)
    assert ("image_to_lidar0" in params) == (layers > 0)
    got = apply(params, *args)
    for mine, want in zip(got, fused(params, image, lidar, layers), strict=True):
        np.testing.assert_allclose(mine, want, **CLOSE)

    other_image, other_lidar = tokens(1)
    swapped = (
        apply(params, image, IMAGE_MASK, other_lidar, LIDAR_MASK), apply(params, other_image, IMAGE_MASK, lidar, LIDAR_MASK)
    )  # fmt: skip
    moved = [np.abs(np.asarray(s[k]) - np.asarray(got[k])).max(axis=(1, 2)) for k, s in enumerate(swapped)]
    if layers:  # each kind hears of the other exactly where the other is there
        np.testing.assert_array_equal(moved[0] > 1e-3, LIDAR_MASK.any(axis=1))
        np.testing.assert_array_equal(moved[1] > 1e-3, IMAGE_MASK.any(axis=1))
    else:
        assert not moved[0].any() and not moved[1].any()


def test_missing_tokens_are_keys_to_nobody():
    image, lidar = tokens()
    args = (image, IMAGE_MASK, lidar, LIDAR_MASK)
    apply, params = built(CrossModal(HEADS, 2), *args)
    clean = apply(params, *args)
    loud = lambda x, mask: np.where(mask[..., None], x, np.float32(1e3) * np.arange(1, D + 1, dtype=np.float32))  # noqa: E731
    spoilt = apply(params, loud(image, IMAGE_MASK), IMAGE_MASK, loud(lidar, LIDAR_MASK), LIDAR_MASK)
    np.testing.assert_array_equal(np.asarray(spoilt[0])[IMAGE_MASK], np.asarray(clean[0])[IMAGE_MASK])
    np.testing.assert_array_equal(np.asarray(spoilt[1])[LIDAR_MASK], np.asarray(clean[1])[LIDAR_MASK])


def test_one_kind_alone():
    """A network of one sensor has no tokens of the other at all."""
    image, lidar = tokens()
    none, nothing = np.zeros((5, 0, D), np.float32), np.zeros((5, 0), bool)
    apply, params = built(CrossModal(HEADS, 1), image, IMAGE_MASK, lidar, LIDAR_MASK)
    alone, empty = apply(params, image, IMAGE_MASK, none, nothing)
    assert empty.shape == (5, 0, D)
    np.testing.assert_allclose(alone, feed_forward(params["feed_forward0"], image), **CLOSE)


def test_integration_is_means_and_a_maximum():
    image, lidar = tokens()
    args = (image, IMAGE_MASK, lidar, LIDAR_MASK)
    apply, params = built(Integration(6), *args)
    got = apply(params, *args)
    for b in range(5):
        a, c = np.float64(image[b, IMAGE_MASK[b]]), np.float64(lidar[b, LIDAR_MASK[b]])
        every = np.concatenate([a, c])
        joined = [x.mean(axis=0) if len(x) else np.zeros(D) for x in (a, c)]
        joined.append(every.max(axis=0) if len(every) else np.zeros(D))
        want = silu(dense(params["outer"], silu(dense(params["inner"], np.concatenate(joined)))))
        np.testing.assert_allclose(got[b], want, **CLOSE)
    none, nothing = jnp.zeros((5, 0, D), jnp.float32), jnp.zeros((5, 0), bool)
    np.testing.assert_allclose(apply(params, none, nothing, none, nothing), np.tile(got[4], (5, 1)), **CLOSE)


def test_feed_forward():
    image, _ = tokens()
    apply, params = built(FeedForward(3), image)
    assert params["inner"]["kernel"].shape == (D, 3 * D)
    np.testing.assert_allclose(apply(params, image), feed_forward(params, np.float64(image)), **CLOSE)
