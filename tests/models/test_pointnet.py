"""The PointNet: its tokens are those of a loop over sectors, whatever the order of the points and whatever is missing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_network import dense, layer_norm, softmax
from small_network import filled

from drnav_jax.models.pointnet import PointNet, point_features, sector_of

SECTORS, HEADS, POINTS = 5, 2, 23
NET = PointNet(widths=(6, 8), features=4, num_sectors=SECTORS, num_heads=HEADS)
PARAMS = filled(
    jax.eval_shape(NET.init, jax.random.key(0), jnp.zeros((1, 3, 3), jnp.float32), jnp.zeros((1, 3), bool))["params"]
)
CLOSE = {"rtol": 2e-4, "atol": 2e-5}  # float32 through five layers against float64, or in another order

pytestmark = pytest.mark.relaxed  # flax

net = jax.jit(
    lambda points, valid: NET.apply({"params": PARAMS}, points, valid))


def clouds(seed=0):
    """Three: with holes, with two empty sectors, and with one point only."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(3, POINTS, 3)) * [4.0, 4.0, 0.4] + [0.0, 0.0, 0.6]
    points[1, :, 1] = np.abs(points[1, :, 1]) + 0.1
    valid = rng.random((3, POINTS)) < 0.7
    middle = -np.pi + (np.arange(SECTORS) + 0.5) * 2 * np.pi / SECTORS  # of each sector, in the first cloud
    points[0, :SECTORS, :2], valid[0, :SECTORS] = 3 * np.stack([np.cos(middle), np.sin(middle)], axis=-1), True
    valid[2] = np.arange(POINTS) == 7
    return points.astype(np.float32), valid


def sector(x, y):
    """Of a turn that begins straight behind and goes counter-clockwise."""
    return min(int((np.arctan2(np.float64(y), np.float64(x)) + np.pi) / (2 * np.pi) * SECTORS), SECTORS - 1)


def oracle(points, valid):
    features = np.asarray(point_features(jnp.asarray(points)), np.float64)
    tokens, filled_, beta = [], np.zeros((len(points), SECTORS), bool), np.zeros(valid.shape)
    for b in range(len(points)):
        there = np.flatnonzero(valid[b])
        h = features[b, there]
        for name in ("point0", "point1"):
            h = np.maximum(dense(PARAMS[name], h), 0)
        u = h.max(axis=0) if there.size else np.zeros(8)
        inner = dense(PARAMS["score_point"], h) + dense(PARAMS["score_scan"], u)
        phi = 8.0 * np.tanh(dense(PARAMS["score"], np.maximum(inner, 0)) / 8.0)  # [points, heads]
        of = np.array([sector(*points[b, i, :2]) for i in there], int)
        for m in range(SECTORS):
            mine = np.flatnonzero(of == m)
            filled_[b, m] = mine.size > 0
            z, share = np.zeros(8), np.zeros(HEADS)
            for head in range(HEADS) if mine.size else ():
                weights, part = softmax(phi[mine, head]), slice(head * 4, head * 4 + 4)
                z[part] = weights @ h[mine, part]
                share[head] = np.exp(phi[mine, head]).sum() / np.exp(phi[:, head]).sum()
                beta[b, there[mine]] += weights / HEADS
            token = dense(PARAMS["token"], np.concatenate([z, np.log1p(SECTORS * share), u]))
            tokens.append(layer_norm(PARAMS["norm"], token) + PARAMS["place"][m])
    return np.reshape(tokens, (len(points), SECTORS, 4)), filled_, beta


def test_tokens_and_weights_are_those_of_a_loop():
    points, valid = clouds()
    token, there, beta = net(points, valid)
    want_token, want_there, want_beta = oracle(points, valid)
    np.testing.assert_array_equal(there, want_there)
    assert want_there[0].all() and not want_there[1].all() and want_there[2].sum() == 1
    np.testing.assert_allclose(token, want_token, **CLOSE)
    np.testing.assert_allclose(beta, want_beta, **CLOSE)
    for b in range(3):  # β sums to 1 in each sector that has points
        sums = [sum(beta[b, i] for i in range(POINTS) if sector(*points[b, i, :2]) == m) for m in range(SECTORS)]
        np.testing.assert_allclose(sums, want_there[b].astype(float), atol=1e-5)


def test_the_order_of_points_does_not_matter():
    points, valid = clouds()
    order = np.random.default_rng(3).permutation(POINTS)
    token, there, beta = net(points, valid)
    other = net(points[:, order], valid[:, order])
    np.testing.assert_allclose(other[0], token, **CLOSE)
    np.testing.assert_array_equal(other[1], there)
    np.testing.assert_allclose(other[2], beta[:, order], **CLOSE)


def test_padding_does_not_matter():
    points, valid = clouds()
    more = np.pad(points, ((0, 0), (0, 9), (0, 0)), constant_values=3.7)
    token, there, beta = net(more, np.pad(valid, ((0, 0), (0, 9))))
    short = net(points, valid)
    np.testing.assert_allclose(token, short[0], **CLOSE)
    np.testing.assert_array_equal(there, short[1])
    np.testing.assert_allclose(beta[:, :POINTS], short[2], **CLOSE)
    assert not np.asarray(beta)[:, POINTS:].any()


@pytest.mark.parametrize("broken", [np.nan, np.inf, 1e30])
def test_missing_points_have_no_influence(broken):
    points, valid = clouds()
    spoilt = np.where(valid[..., None], points, np.float32(broken))
    for mine, clean in zip(net(spoilt, valid), net(points, valid), strict=True):
        np.testing.assert_array_equal(mine, clean)


def test_when_all_are_missing():
    points, valid = clouds()
    token, there, beta = net(np.full_like(points, np.nan), np.zeros_like(valid))
    assert np.isfinite(token).all() and not np.asarray(there).any() and not np.asarray(beta).any()
    none = net(points[:, :0], valid[:, :0])  # a robot without LiDAR
    np.testing.assert_allclose(none[0], token, **CLOSE)
    assert not np.asarray(none[1]).any() and none[2].shape == (3, 0)


def test_gradients_are_finite_though_points_are_missing():
    points, valid = clouds()
    valid[0] = False
    points[~valid] = np.nan

    def loss(params):
        token, _, beta = NET.apply({"params": params}, jnp.asarray(points), jnp.asarray(valid))
        return jnp.sum(jnp.square(token)) + jnp.sum(jnp.square(beta))

    gradient = jax.jit(jax.grad(loss))(PARAMS)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    assert np.abs(gradient["score"]["kernel"]).max() > 0


def test_sectors_and_their_borders():
    turns = np.linspace(-np.pi, np.pi, 401)[:-1] + np.pi / 400
    points = np.stack([2 * np.cos(turns), 2 * np.sin(turns), np.ones_like(turns)], axis=-1)[None]
    got = np.asarray(sector_of(jnp.asarray(points, jnp.float32), 4))[0]
    np.testing.assert_array_equal(got.sum(axis=-1), np.ones(400))
    np.testing.assert_array_equal(got.argmax(axis=-1), np.repeat(np.arange(4), 100))
    on = [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (-1.0, -0.0), (0.0, 0.0)]  # straight behind is the end of both
    borders = jnp.asarray([[[x, y, 0.0] for x, y in on]], jnp.float32)
    found = np.asarray(sector_of(borders, 4))[0]
    np.testing.assert_array_equal(found.argmax(axis=-1), [2, 3, 3, 0, 2])
    np.testing.assert_array_equal(found.sum(axis=-1), np.ones(len(on)))


def test_what_is_known_of_a_point():
    points = np.array([[[3.0, 4.0, 0.7], [-6.0, 0.0, -9.0], [60.0, -80.0, 8.0]]], np.float32)
    got = np.asarray(point_features(jnp.asarray(points)))[0]
    want = [
        [3 / 6, 4 / 6, 0.7, 0.6, 0.8, 5 / 6, 1 / 5.3],
        [-1.0, 0.0, -5.0, -1.0, 0.0, 1.0, 1 / 6.3],
        [18 / 6, -24 / 6, 5.0, 0.6, -0.8, 30 / 6, 1 / 30.3],  # farther than 30 m is taken for 30 m
    ]
    np.testing.assert_allclose(got, want, atol=3e-4)  # the direction of a point at 5 m is short by 1e-3 / 5
    at_zero = np.asarray(point_features(jnp.zeros((1, 1, 3), jnp.float32)))
    assert np.isfinite(at_zero).all()
