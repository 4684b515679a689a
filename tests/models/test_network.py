"""The whole network: any sensor may be missing, and what is missing does not matter."""

import dataclasses
import itertools
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_network import BEV, RIG, SPEC, inputs, params_of, run

from drnav_jax.models import network
from drnav_jax.models.network import NetworkSpec, Outputs
from drnav_jax.types import Mount, RigSpec

pytestmark = pytest.mark.relaxed  # flax
SAME = {"rtol": 1e-4, "atol": 1e-4}  # float32, sums in another order
COMBINATIONS = list(itertools.product([True, False], repeat=4))  # of three cameras and the LiDAR


@pytest.fixture(scope="module")
def params():
    return params_of()


@pytest.fixture(scope="module")
def apply(params):
    """The small network, compiled once for batches of 16."""
    compiled = jax.jit(partial(network.apply, SPEC))
    return lambda x: jax.tree.map(np.asarray, compiled(params, x))


def combinations():
    """One frame 16 times, with every combination of missing sensors."""
    x = jax.tree.map(lambda a: jnp.repeat(a, 16, axis=0), inputs(1))
    there = jnp.asarray(COMBINATIONS)
    return x._replace(image_valid=there[:, :3], point_valid=x.point_valid & there[:, 3:])


def finite(out):
    return all(np.isfinite(leaf).all() for leaf in out)


def test_shapes_and_all_combinations_of_missing_sensors(apply):
    out = apply(combinations())
    cells = (16, *BEV.shape)
    shapes = {name: getattr(out, name).shape for name in Outputs._fields}
    assert shapes == {
        "path": (16, 3), "flag": (16,), "dead": cells, "traversable": cells, "recoverability": cells, "depth": cells,
        "alpha": (16, 3, 2, 3), "beta": (16, 14),
    }  # fmt: skip
    assert finite(out)
    there = np.array(COMBINATIONS)
    np.testing.assert_allclose(out.alpha.sum(axis=(2, 3)), there[:, :3], atol=1e-5)  # α sums to 1 in each image
    assert (out.beta[there[:, 3]].sum(axis=1) >= 1 - 1e-5).all() and not out.beta[~there[:, 3]].any()
    # every sensor has a say: all 16 answers differ
    for a, b in itertools.combinations(range(16), 2):
        assert np.abs(out.dead[a] - out.dead[b]).max() > 1e-3


@pytest.mark.parametrize("broken", [np.nan, np.inf, 1e6])
def test_masked_values_do_not_matter(apply, broken):
    """Not even as 0 x NaN; nor does the mount of a camera that is not there."""
    x = combinations()
    image, point = np.asarray(x.image_valid), np.asarray(x.point_valid)
    spoil = lambda a, there: jnp.asarray(  # noqa: E731
        np.where(there.reshape(*there.shape, *[1] * (a.ndim - there.ndim)), a, np.float32(broken))
    )
    spoilt = x._replace(
        images=spoil(x.images, image), points=spoil(x.points, point), rig=jax.tree.map(lambda a: spoil(a, image), x.rig)
    )
    assert not all(np.isfinite(leaf).all() for leaf in (spoilt.images, spoilt.points)) or broken == 1e6
    chex.assert_trees_all_equal(apply(spoilt), apply(x))


def test_cameras_that_only_pad_a_batch_may_have_no_mount(apply):
    """All zeros, as padding has it: a focal length of 0 divides nothing."""
    x = combinations()
    there = x.image_valid
    zero = jax.tree.map(lambda a: a * there.reshape(16, 3, *[1] * (a.ndim - 2)).astype(jnp.float32), x.rig)
    chex.assert_trees_all_equal(apply(x._replace(rig=zero)), apply(x))


def test_the_order_of_cameras_does_not_matter(apply):
    x, order = combinations(), np.array([2, 0, 1])
    turned = x._replace(
        images=x.images[:, order], image_valid=x.image_valid[:, order], rig=jax.tree.map(lambda a: a[:, order], x.rig)
    )
    a, b = apply(x), apply(turned)
    chex.assert_trees_all_close(b._replace(alpha=None), a._replace(alpha=None), **SAME)
    np.testing.assert_allclose(b.alpha, a.alpha[:, order], **SAME)


def test_the_order_of_points_does_not_matter(apply):
    x, order = combinations(), np.random.default_rng(0).permutation(14)
    a, b = apply(x), apply(x._replace(points=x.points[:, order], point_valid=x.point_valid[:, order]))
    chex.assert_trees_all_close(b._replace(beta=None), a._replace(beta=None), **SAME)
    np.testing.assert_allclose(b.beta, a.beta[:, order], **SAME)


def test_frames_of_a_batch_do_not_mix(apply):
    x = inputs(16, seed=4)
    back = jax.tree.map(lambda a: a[::-1], x)
    chex.assert_trees_all_close(jax.tree.map(lambda a: a[::-1], apply(back)), apply(x), **SAME)


def test_stored_integers_are_shares(apply):
    x = inputs(16, seed=5)
    rng = np.random.default_rng(6)
    whole = {name: rng.integers(0, 256, getattr(x, name).shape).astype(np.uint8) for name in ("rule_p", "rule_confidence")}
    whole["images"] = rng.integers(0, 256, x.images.shape).astype(np.uint8)
    real = {name: jnp.asarray(v / 255.0, jnp.float32) for name, v in whole.items()}
    run16 = run(partial(network.apply, SPEC), params_of(), x._replace(**{k: jnp.asarray(v) for k, v in whole.items()}))
    chex.assert_trees_all_close(jax.tree.map(np.asarray, run16), apply(x._replace(**real)), **SAME)


@pytest.mark.parametrize(
    ("rig", "points"),
    [(RigSpec((Mount(pitch=-0.1, fov=1.2),), (20, 12)), 5), (RigSpec((Mount(),) * 4, (8, 24)), 40), (RigSpec(()), 0)],
    ids=["one", "four", "none"],
)
def test_cameras_images_and_points_need_not_be_as_many_as_in_training(params, rig, points):
    x = inputs(1, rig, points)
    out = run(partial(network.apply, SPEC), params, x)
    assert finite(out) and out.dead.shape == (1, *BEV.shape)
    assert out.alpha.shape[:2] == (1, len(rig.mounts)) and out.beta.shape == (1, points)


def test_a_robot_without_sensors_is_one_whose_sensors_are_missing(params, apply):
    """Neither cameras nor points at all, or all of them masked: one answer."""
    x = combinations()
    bare = inputs(1, RigSpec(()), 0)._replace(
        local_map=x.local_map[:1], rule_p=x.rule_p[:1], rule_confidence=x.rule_confidence[:1]
    )
    none, masked = run(partial(network.apply, SPEC), params, bare), apply(x)  # whose last frame lacks everything
    for name in ("path", "flag", "dead", "traversable", "recoverability", "depth"):
        np.testing.assert_allclose(getattr(none, name)[0], getattr(masked, name)[-1], **SAME)


ABLATIONS = {
    "no_attention": {"attention_layers": 0}, "two_layers": {"attention_layers": 2}, "no_lift": {"lift": False},
    "tokens": {"head": "tokens"}, "image": {"sensors": "image"}, "lidar": {"sensors": "lidar"}, "no_rule": {"rule": False},
}  # fmt: skip


def built(**changes):
    return dataclasses.replace(SPEC, **changes)


@pytest.mark.parametrize("name", ABLATIONS)
def test_ablations_build_and_lack_what_they_should(name):
    spec = built(**ABLATIONS[name])
    shapes = jax.eval_shape(lambda: network.init(jax.random.key(0), spec))
    out = jax.eval_shape(partial(network.apply, spec), shapes, inputs())
    assert out.dead.shape == (2, *BEV.shape) and out.path.shape == (2, 3) and out.flag.shape == (2,)
    assert ("lift" in shapes) == (name not in ("no_lift", "tokens", "lidar"))
    assert ("encoder" in shapes) == (name != "lidar") and ("points" in shapes) == (name != "image")
    layers = {k for k in shapes["fusion"] if k.startswith("image_to_lidar")}
    count = {"no_attention": 0, "two_layers": 2, "image": 0, "lidar": 0}.get(name, 1)
    assert layers == {f"image_to_lidar{k}" for k in range(count)}


@pytest.mark.parametrize("name", ["image", "lidar", "tokens"])
def test_one_sensor_alone_hears_of_nothing_else(name):
    spec = built(**ABLATIONS[name])
    compiled = jax.jit(partial(network.apply, spec, params_of(spec)))
    apply = lambda x: jax.tree.map(np.asarray, compiled(x))  # noqa: E731
    x, y = inputs(2), inputs(2, seed=9)
    base = apply(x)
    assert finite(base)
    images = x._replace(images=y.images)
    cloud = x._replace(points=y.points, point_valid=y.point_valid)
    known = x._replace(local_map=y.local_map, rule_p=y.rule_p, rule_confidence=y.rule_confidence)
    heard = [bool(np.abs(apply(changed).dead - base.dead).max() > 1e-4) for changed in (images, cloud, known)]
    # the paper's wording has no place for the known map
    assert heard == {"image": [True, False, False], "lidar": [False, True, True], "tokens": [True, True, False]}[name]
    blind = apply(x._replace(image_valid=~x.image_valid, point_valid=jnp.zeros_like(x.point_valid)))
    assert finite(blind)


def test_without_the_rule_its_verdict_does_not_matter():
    spec = built(rule=False)
    shapes = jax.eval_shape(lambda: network.init(jax.random.key(0), spec))
    with_rule = jax.eval_shape(lambda: network.init(jax.random.key(0), SPEC))
    lost = with_rule["cells"]["enter"]["kernel"].shape[0] - shapes["cells"]["enter"]["kernel"].shape[0]
    assert lost == 2 * 4  # two channels of four cells each


def test_inference_is_traced_once_per_shape():
    counted = chex.assert_max_traces(network.infer.__wrapped__, n=2)
    infer = jax.jit(counted, static_argnames="spec")
    first, other = params_of(), params_of(seed=1)
    for params, x in ((first, inputs(1)), (other, inputs(1, seed=1)), (first, inputs(2)), (other, inputs(2, seed=2))):
        infer(SPEC, params, x)


@pytest.mark.long
def test_initial_parameters():
    """float32, of the stated shapes, another for another key; and near to indifferent about everything."""
    init = jax.jit(
        network.init.__wrapped__, static_argnames="spec")
    a, b = init(jax.random.key(0), SPEC), init(jax.random.key(1), SPEC)
    assert {leaf.dtype for leaf in jax.tree.leaves(a)} == {jnp.dtype(jnp.float32)}
    sizes = lambda tree: jax.tree.map(lambda leaf: leaf.shape, tree)  # noqa: E731
    assert sizes(a) == sizes(params_of())
    assert network.count(a) == sum(np.prod(leaf.shape) for leaf in jax.tree.leaves(a))
    differ = jax.tree.map(lambda x, y: bool(np.abs(x - y).max() > 0), a, b)
    assert differ["encoder"]["stem"]["kernel"] and differ["cells"]["place8"] and differ["points"]["place"]
    out = run(partial(network.apply, SPEC), a, inputs(1))
    assert finite(out) and max(np.abs(out.dead).max(), np.abs(out.path).max(), np.abs(out.flag).max()) < 0.5


def test_an_example_is_a_robot_without_sensors():
    x = network.example(SPEC, RIG, 7, 2)
    assert x.images.shape == (2, 3, *RIG.shape, 3) and x.points.shape == (2, 7, 3) and x.rig.rotation.shape == (2, 3, 3, 3)
    assert not np.asarray(x.image_valid).any() and not np.asarray(x.point_valid).any()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"head": "grids"}, "head"), ({"sensors": "radar"}, "sensors"), ({"features": 0}, "features"),
        ({"features": 9}, "multiples"), ({"point_widths": ()}, "point_widths"), ({"point_widths": (8, 9)}, "multiples"),
        ({"attention_layers": -1}, "attention_layers"), ({"lift_depths": 1}, "lift_depths"),
        ({"lift_stride": 5}, "lift_stride"),
        ({"bev": dataclasses.replace(BEV, shape=(12, 16))}, "multiples of 8"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(changes, says):
    with pytest.raises(ValueError, match=says):
        built(**changes)


def test_the_default_network_is_of_its_stated_size():
    shapes = jax.eval_shape(lambda: network.init(jax.random.key(0), NetworkSpec()))
    assert 2e5 < network.count(shapes) < 2e6
    one = inputs(1, RigSpec(), 2880, NetworkSpec().bev)
    out = jax.eval_shape(partial(network.apply, NetworkSpec()), shapes, one)
    assert out.dead.shape == (1, 64, 64) and out.alpha.shape == (1, 3, 4, 4)
