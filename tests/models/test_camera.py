"""Patch attention (eqs. 1 and 2) against NumPy; what the network knows of a mount."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_network import dense, layer_norm, silu, softmax
from small_network import filled

from drnav_jax.models.camera import PatchAttention, RigEmbedding, rig_features
from drnav_jax.types import CameraRig, Mount, RigSpec, rig_of

pytestmark = pytest.mark.relaxed  # flax
CLOSE = {"rtol": 1e-4, "atol": 1e-5}  # float32 through three layers against float64


def batched(rig):
    return jax.tree.map(lambda a: a[None], rig)


def test_attention_over_patches_is_that_of_a_loop():
    rng = np.random.default_rng(0)
    maps = jnp.asarray(rng.normal(size=(3, 4, 5, 6)), jnp.float32)
    net = PatchAttention(features=8, num_tokens=2)
    params = filled(jax.eval_shape(net.init, jax.random.key(0), maps)["params"])
    tokens, alpha = net.apply({"params": params}, maps)
    assert tokens.shape == (3, 2, 8) and alpha.shape == (3, 2, 4, 5)
    for m in range(3):
        f = dense(params["patches"], layer_norm(params["norm"], maps[m].reshape(20, 6)))
        query = f.mean(axis=0) @ np.float64(params["query"]["kernel"])
        for t in range(2):
            weights = softmax(f @ query[8 * t : 8 * t + 8] / math.sqrt(8))
            np.testing.assert_allclose(np.ravel(alpha[m, t]), weights, **CLOSE)
            np.testing.assert_allclose(tokens[m, t], weights @ f, **CLOSE)
            assert np.ptp(weights) > 0.01, "it prefers some patches"
    np.testing.assert_allclose(np.sum(alpha, axis=(2, 3)), np.ones((3, 2)), rtol=1e-5)


def test_a_mount_as_numbers():
    rig = rig_of(RigSpec((Mount(x=0.3, y=-0.2, z=0.7, yaw=math.pi / 2, fov=math.pi / 2),), (50, 80)))
    got = np.asarray(rig_features(batched(rig), (50, 80)))[0, 0]
    # focal lengths and centre in images (half an image wide; the centre in the middle), place, and where the
    # optical axes point: right is +x (ahead of a camera that looks left), down is -z, along the view is +y
    want = [0.5, 0.8, 0.0, 0.0, 0.3, -0.2, 0.7, 1, 0, 0, 0, 0, 1, 0, -1, 0]
    np.testing.assert_allclose(got, want, atol=1e-6)


def test_the_size_of_images_does_not_matter_to_what_is_known_of_a_mount():
    mounts = (Mount(pitch=0.2), Mount(yaw=-1.0, roll=0.1, fov=1.2))
    small, large = (rig_features(batched(rig_of(RigSpec(mounts, s))), s) for s in ((30, 40), (90, 120)))
    np.testing.assert_allclose(small, large, rtol=1e-5, atol=1e-6)
    assert np.abs(small[0, 0] - small[0, 1]).max() > 0.1


def test_the_embedding_is_two_layers_of_it():
    rig = batched(rig_of(RigSpec(shape=(6, 8))))
    net = RigEmbedding(5)
    params = filled(jax.eval_shape(lambda: net.init(jax.random.key(0), rig, (6, 8)))["params"])
    features = np.asarray(rig_features(rig, (6, 8)))
    want = dense(params["outer"], silu(dense(params["inner"], features)))
    np.testing.assert_allclose(net.apply({"params": params}, rig, (6, 8)), want, **CLOSE)


def test_fields_in_double_precision_become_float32():
    rig = CameraRig(*(np.asarray(a, np.float64)[None] for a in rig_of(RigSpec(shape=(6, 8)))))
    assert rig_features(rig, (6, 8)).dtype == jnp.float32
