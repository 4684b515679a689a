"""Standard EfficientNet weights: a file that the tests make, against a forward pass with the batch norms as they are."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
from reference_network import convolve, depthwise, sigmoid, silu
from small_network import filled, run

from drnav_jax.models import pretrained
from drnav_jax.models.efficientnet import EfficientNet, EncoderSpec, b0

SMALL = EncoderSpec(
    stages=((1, 3, 1, 8, 1), (6, 5, 2, 16, 2), (4, 3, 1, 16, 1)), stem=(3, 2, 8), head=24, norm="affine", num_classes=7
)
# of torchvision's efficientnet_b0, as its state_dict spells and lays them out
KNOWN = {
    "features.0.0.weight": (32, 3, 3, 3), "features.0.1.running_var": (32,),
    "features.1.0.block.0.0.weight": (32, 1, 3, 3), "features.1.0.block.1.fc1.weight": (8, 32, 1, 1),
    "features.1.0.block.2.0.weight": (16, 32, 1, 1), "features.2.0.block.0.0.weight": (96, 16, 1, 1),
    "features.2.1.block.2.fc2.bias": (144,), "features.3.0.block.1.0.weight": (144, 1, 5, 5),
    "features.6.3.block.3.0.weight": (192, 1152, 1, 1), "features.6.3.block.3.1.weight": (192,),
    "features.7.0.block.3.1.bias": (320,), "features.8.0.weight": (1280, 320, 1, 1),
    "features.8.1.num_batches_tracked": (), "classifier.1.weight": (1000, 1280), "classifier.1.bias": (1000,),
}  # fmt: skip


def torch_layout(spec, seed=0):
    """A file's tensors for an encoder, built from the published architecture: names, layouts, batch norms."""
    rng, tensors = np.random.default_rng(seed), {}

    def conv(name, out, inside, kernel):
        tensors[f"{name}.weight"] = rng.normal(size=(out, inside, kernel, kernel)) / (inside * kernel**2) ** 0.5

    def norm(name, size):
        tensors[f"{name}.weight"], tensors[f"{name}.bias"] = rng.uniform(0.5, 1.5, size), rng.normal(size=size) * 0.2
        tensors[f"{name}.running_mean"] = rng.normal(size=size) * 0.3
        tensors[f"{name}.running_var"] = rng.uniform(0.0, 2.0, size)
        tensors[f"{name}.num_batches_tracked"] = np.int64(1234)

    now = spec.stem[2]
    conv("features.0.0", now, 3, spec.stem[0])
    norm("features.0.1", now)
    for stage, (expand, kernel, _, out, repeats) in enumerate(spec.stages):
        for k in range(repeats):
            name, wide, at = f"features.{stage + 1}.{k}.block", now * expand, 0
            if expand != 1:
                conv(f"{name}.0.0", wide, now, 1)
                norm(f"{name}.0.1", wide)
                at = 1
            conv(f"{name}.{at}.0", wide, 1, kernel)
            norm(f"{name}.{at}.1", wide)
            squeezed = max(1, now // 4)
            for part, a, b in (("fc1", squeezed, wide), ("fc2", wide, squeezed)):
                conv(f"{name}.{at + 1}.{part}", a, b, 1)
                tensors[f"{name}.{at + 1}.{part}.bias"] = rng.normal(size=a) * 0.2
            conv(f"{name}.{at + 2}.0", out, wide, 1)
            norm(f"{name}.{at + 2}.1", out)
            now = out
    last = len(spec.stages) + 1
    conv(f"features.{last}.0", spec.head, now, 1)
    norm(f"features.{last}.1", spec.head)
    tensors["classifier.1.weight"] = rng.normal(size=(spec.num_classes, spec.head)) / spec.head**0.5
    tensors["classifier.1.bias"] = rng.normal(size=spec.num_classes)
    return {name: np.asarray(v, np.int64 if "tracked" in name else np.float32) for name, v in tensors.items()}


def forward(spec, t, images):
    """Class scores by the file's own tensors, batch norms with their statistics (evaluation mode)."""

    def conv(name, x, stride=1):
        w = t[f"{name}.weight"].astype(np.float64)
        if w.shape[1] == 1 and x.shape[-1] != 1:
            return depthwise(x, w[:, 0].transpose(1, 2, 0), stride)
        return convolve(x, w.transpose(2, 3, 1, 0), stride, w.shape[2] // 2) + t.get(f"{name}.bias", 0.0)

    def norm(name, x):
        mean, var, gamma, beta = (t[f"{name}.{p}"] for p in ("running_mean", "running_var", "weight", "bias"))
        return (x - mean) / np.sqrt(var.astype(np.float64) + 1e-5) * gamma + beta

    x = (images - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    x = silu(norm("features.0.1", conv("features.0.0", x, spec.stem[1])))
    for stage, (_, _, stride, _, repeats) in enumerate(spec.stages):
        for k in range(repeats):
            name, y, step = f"features.{stage + 1}.{k}.block", x, stride if k == 0 else 1
            depth = 0 if t[f"{name}.0.0.weight"].shape[1] == 1 else 1  # the expansion is no depthwise convolution
            if depth:
                y = silu(norm(f"{name}.0.1", conv(f"{name}.0.0", y)))
            y = silu(norm(f"{name}.{depth}.1", conv(f"{name}.{depth}.0", y, step)))
            s = conv(f"{name}.{depth + 1}.fc2", silu(conv(f"{name}.{depth + 1}.fc1", y.mean((1, 2), keepdims=True))))
            y = norm(f"{name}.{depth + 2}.1", conv(f"{name}.{depth + 2}.0", y * sigmoid(s)))
            x = x + y if x.shape == y.shape else y
    last = f"features.{len(spec.stages) + 1}"
    x = silu(norm(f"{last}.1", conv(f"{last}.0", x)))
    return x.mean((1, 2)) @ t["classifier.1.weight"].T.astype(np.float64) + t["classifier.1.bias"]


@functools.cache
def shapes(spec):
    net = EfficientNet(spec)
    return jax.eval_shape(net.init, jax.random.key(0), jax.ShapeDtypeStruct((1, 32, 32, 3), jnp.float32))["params"]


def written(tmp_path, tensors):
    file = tmp_path / "weights.safetensors"
    safetensors.numpy.save_file(tensors, file)
    return file


@pytest.mark.relaxed
def test_class_scores_are_those_of_the_file(tmp_path):
    tensors = torch_layout(SMALL)
    params = pretrained.load(written(tmp_path, tensors), SMALL, filled(shapes(SMALL)))
    images = np.random.default_rng(1).random((2, 12, 9, 3)).astype(np.float32)
    got = run(lambda p, x: EfficientNet(SMALL).apply({"params": p}, x)[0], params, jnp.asarray(images))
    want = forward(SMALL, tensors, images)
    assert np.abs(want - want[::-1]).max() > 0.01  # the images differ
    np.testing.assert_allclose(got, want, rtol=1e-3, atol=1e-3)  # float32 through twelve layers against float64


@pytest.mark.relaxed
def test_b0_takes_the_file_that_torchvision_would_write(tmp_path):
    spec = b0(norm="affine", num_classes=1000)
    tensors = torch_layout(spec)
    assert {name: tensors[name].shape for name in KNOWN} == KNOWN
    assert sum(t.size for name, t in tensors.items() if "running" not in name and "tracked" not in name) == 5_288_548
    params = pretrained.load(written(tmp_path, tensors), spec, shapes(spec))
    kinds = lambda tree: jax.tree.map(lambda a: (a.shape, a.dtype), tree)  # noqa: E731
    assert kinds(params) == kinds(shapes(spec))
    np.testing.assert_array_equal(params["classifier"]["kernel"], tensors["classifier.1.weight"].T)
    taps = tensors["features.5.2.block.1.0.weight"][:, 0, 1, 4]
    np.testing.assert_array_equal(params["block10"]["depthwise"][1, 4], taps)
    # without classes the same file serves, and its classifier stays out
    bare = b0(norm="affine")
    trunk = pretrained.load(tmp_path / "weights.safetensors", bare, shapes(bare))
    assert "classifier" not in trunk
    jax.tree.map(np.testing.assert_array_equal, trunk, {k: v for k, v in params.items() if k != "classifier"})


def test_half_precision_files(tmp_path):
    tensors = torch_layout(SMALL)
    half = {n: t.astype(np.float16) if t.dtype == np.float32 else t for n, t in tensors.items()}
    params = pretrained.load(written(tmp_path, half), SMALL, shapes(SMALL))
    want = half["features.4.0.weight"].astype(np.float32)[:, :, 0, 0].T
    np.testing.assert_array_equal(params["head"]["kernel"], want)


MISTAKES = {
    "missing": (lambda t: t.pop("features.2.1.block.1.0.weight"), r"lacks features\.2\.1\.block\.1\.0\.weight:"),
    "half a norm": (lambda t: t.pop("features.0.1.running_var"), r"lacks features\.0\.1\.running_var:"),
    "many missing": (lambda t: [t.pop(n) for n in list(t) if n.startswith("features.3")], r"lacks .* and \d+ more"),
    "extra": (lambda t: t.update({"features.9.0.weight": np.zeros(3, np.float32)}), r"also holds features\.9\.0\.weight:"),
    "other shape": (
        lambda t: t.update({"classifier.1.bias": np.zeros(9, np.float32)}), r"classifier.*bias.*\(9,\) \(not \(7,\)\)"
    ),
    "other kernel": (
        lambda t: t.update({"features.1.0.block.0.0.weight": np.zeros((8, 1, 5, 5), np.float32)}),
        r"depthwise.*\(5, 5, 8\) \(not \(3, 3, 8\)\)",
    ),
    "other rank": (
        lambda t: t.update({"features.4.0.weight": np.zeros((24, 16), np.float32)}),
        r"features\.4\.0\.weight must have 4 axes",
    ),
    "no pixel": (
        lambda t: t.update({"features.4.0.weight": np.zeros((24, 16, 3, 3), np.float32)}), r"head.*\(24, 16, 3, 3\)"
    ),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_file_of_another_network_is_refused(tmp_path, mistake):
    change, says = MISTAKES[mistake]
    tensors = torch_layout(SMALL)
    change(tensors)
    with pytest.raises(ValueError, match=says):
        pretrained.load(written(tmp_path, tensors), SMALL, shapes(SMALL))


def test_other_mistakes(tmp_path):
    file = written(tmp_path, torch_layout(SMALL))
    with pytest.raises(ValueError, match='norm="layer"'):
        pretrained.load(file, b0(), {})
    with pytest.raises(ValueError, match="params are not those of the encoder"):
        pretrained.load(file, SMALL, {"stem": {"kernel": np.zeros((3, 3, 3, 8))}})
    with pytest.raises(FileNotFoundError, match="no weights at"):
        pretrained.load(tmp_path / "none.safetensors", SMALL, shapes(SMALL))
    file.write_bytes(file.read_bytes()[:500])
    with pytest.raises(ValueError, match="cannot be read"):
        pretrained.load(file, SMALL, shapes(SMALL))
