"""The EfficientNet family: published sizes, shapes, and the whole encoder against NumPy."""

import functools
import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_network as reference
from small_network import filled, run

from drnav_jax.models.efficientnet import Conv, EfficientNet, EncoderSpec, b0
from drnav_jax.models.network import count

pytestmark = pytest.mark.relaxed  # flax


@functools.cache
def shapes(spec, image=(32, 32)):
    """Shapes of parameters and of feature maps; nothing is computed."""
    net, images = EfficientNet(spec), jax.ShapeDtypeStruct((2, *image, 3), jnp.float32)
    params = jax.eval_shape(net.init, jax.random.key(0), images)["params"]
    return params, jax.eval_shape(lambda p, x: net.apply({"params": p}, x), params, images)


def test_width_and_depth():
    for width in np.arange(0.3, 2.2, 0.1):
        spec = b0(width=float(width), depth=1.7)
        for base in (8, 16, 24, 40, 80, 112, 192, 320):
            wanted, found = base * float(width), spec.channels(base)
            multiples = [m for m in range(8, 1000, 8) if m >= 0.9 * wanted]
            nearest = min(abs(m - wanted) for m in multiples)
            assert found in multiples and abs(found - wanted) == pytest.approx(nearest, abs=1e-9)
    repeats = [sum(b[0] == stage for b in b0(depth=1.7).blocks()) for stage in range(7)]
    assert repeats == [math.ceil(1.7 * n) for n in (1, 2, 2, 3, 3, 4, 1)]


SMALL = (
    EncoderSpec(stages=((2, 3, 2, 8, 1), (1, 5, 1, 8, 2)), stem=(4, 4, 8), norm="block", activation="relu"),
    EncoderSpec(stages=((1, 3, 1, 8, 1), (3, 5, 2, 16, 2)), stem=(3, 2, 8), head=24, norm="layer", num_classes=5),
    EncoderSpec(stages=((2, 5, 2, 8, 2),), stem=(3, 1, 8), norm="affine", head=16),
)


@pytest.mark.parametrize("spec", SMALL, ids=lambda s: s.norm)
def test_the_encoder_is_that_of_a_loop(spec):
    params = filled(shapes(spec)[0])
    images = np.random.default_rng(1).random((2, 13, 10, 3)).astype(np.float32)
    got = run(lambda p, x: EfficientNet(spec).apply({"params": p}, x), params, jnp.asarray(images))
    want = reference.encoder(spec, params, images)
    assert set(got) == set(want) and set(spec.strides) == set(want) - {0}
    for stride, found in want.items():
        # float32 through up to nine layers, against float64
        np.testing.assert_allclose(got[stride], found, rtol=1e-3, atol=1e-3 * np.abs(found).max())


@pytest.mark.parametrize("image", [(48, 34), (31, 47)])
@pytest.mark.parametrize(
    "spec",
    [
        *SMALL, EncoderSpec(), EncoderSpec(resolution=(40, 28)),
        EncoderSpec(stages=((1, 3, 3, 8, 1), (2, 3, 2, 8, 1)), stem=(5, 5, 8)),
        EncoderSpec(stages=((1, 5, 5, 8, 2),), stem=(1, 1, 8)),
    ],
    ids=str,
)  # fmt: skip
def test_size_is_that_of_the_maps(spec, image):
    _, maps = shapes(spec, image)
    assert {s: m.shape[1:3] for s, m in maps.items() if s} == {s: spec.size(image, s) for s in spec.strides}


def test_images_are_brought_to_the_resolution():
    spec = EncoderSpec(stages=((1, 3, 2, 8, 1),), stem=(3, 2, 8), resolution=(12, 20))
    params = filled(shapes(spec)[0])
    plain = EncoderSpec(stages=spec.stages, stem=spec.stem)
    ramp = np.linspace(0.1, 0.9, 10)[None, None, :, None] * np.ones((1, 6, 1, 3))
    # twice the columns, linear between pixel centres: inside, the ramp goes on by half steps
    fine = np.interp((np.arange(20) + 0.5) / 2 - 0.5, np.arange(10), ramp[0, 0, :, 0])
    wide = np.broadcast_to(fine[None, None, :, None], (1, 12, 20, 3))
    apply = lambda s: partial(lambda p, x: EfficientNet(s).apply({"params": p}, x), params)  # noqa: E731
    got = run(apply(spec), jnp.asarray(ramp, jnp.float32))
    want = run(apply(plain), jnp.asarray(wide, jnp.float32))
    for stride in want:
        np.testing.assert_allclose(got[stride], want[stride], rtol=1e-4, atol=1e-4)  # float32


@pytest.mark.parametrize(("kernel", "stride", "pad"), [(3, 2, 1), (5, 1, 2), (4, 4, 0), (3, 3, 0), (1, 1, 0)])
def test_full_convolution(kernel, stride, pad):
    rng = np.random.default_rng(0)
    x, k = rng.normal(size=(2, 9, 11, 3)), rng.normal(size=(kernel, kernel, 3, 4))
    f32 = lambda a: jnp.asarray(a, jnp.float32)  # noqa: E731
    got = Conv(kernel, stride, 4).apply({"params": {"kernel": f32(k)}}, f32(x))
    np.testing.assert_allclose(got, reference.convolve(x, k, stride, pad), rtol=1e-4, atol=1e-4)  # 75 products


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"stages": ()}, "stages"), ({"stages": ((1, 4, 1, 8, 1),)}, "odd kernel"), ({"stem": (4, 2, 8)}, "stem"),
        ({"stem": (3, 2, 0)}, "stem"), ({"width": 0.0}, "width"), ({"norm": "batch"}, "norm"),
        ({"activation": "gelu"}, "activation"), ({"resolution": (4, 32)}, "resolution"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(changes, says):
    with pytest.raises(ValueError, match=says):
        EncoderSpec(**changes)


# Published: width, depth, and parameters with 1,000 classes of B0 and B2
PUBLISHED = [(1.0, 1.0, 5_288_548), pytest.param(1.1, 1.2, 9_109_994, marks=pytest.mark.long)]


@pytest.mark.parametrize(("width", "depth", "parameters"), PUBLISHED)
def test_the_family_has_its_published_sizes(width, depth, parameters):
    spec = b0(width, depth, num_classes=1000)
    params, _ = shapes(spec)
    assert count(params) == parameters


def test_b0_is_b0():
    params, maps = shapes(b0(), (224, 224))
    assert count(params) == 4_007_548
    sizes = {stride: found.shape[1:] for stride, found in maps.items()}
    assert sizes == {2: (112, 112, 16), 4: (56, 56, 24), 8: (28, 28, 40), 16: (14, 14, 112), 32: (7, 7, 1280)}
    blocks = b0().blocks()
    assert [b[4] for b in blocks] == [16] + [24] * 2 + [40] * 2 + [80] * 3 + [112] * 3 + [192] * 4 + [320]
    assert [b[2] for b in blocks] == [3] + [3] * 2 + [5] * 2 + [3] * 3 + [5] * 3 + [5] * 4 + [3]
    assert [n for n, b in enumerate(blocks) if b[3] == 2] == [1, 3, 5, 11]
    assert [b[1] for b in blocks] == [1] + [6] * 15
    squeezed = [params[f"block{n}"]["excite"]["reduce"]["bias"].shape[0] for n in range(16)]
    assert squeezed == [8, 4] + [6] * 2 + [10] * 2 + [20] * 3 + [28] * 3 + [48] * 4
