"""The EfficientNet family (Tan & Le 2019): inverted bottlenecks with squeeze-and-excitation, scaled in width and depth.

    (1)  block(x) = [x +] N(P(SE(a(N(D(a(N(E x))))))))       E: 1x1, widens by `expand`; D: depthwise; P: 1x1; a: activation
    (2)  SE(y)    = y · σ(V a(U mean(y)))                     U: to a quarter of the block's input channels
    (3)  width:  channels to the nearest multiple of 8 (never below 90 %);  depth: repeats rounded up

Without state: in place of batch norm N normalises over channels, or only scales and shifts ("affine": what a batch norm is
once its statistics are folded in), or stands once before the block ("block": fewest values to normalise). With a scale
and a shift per channel, as batch norm has, B0 counts 5,288,548 parameters, 4,007,548 of them without the classifier.
"""

import dataclasses
import math
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from drnav_jax.models.depthwise import depthwise, size_after
from drnav_jax.models.layers import ACTIVATIONS, Dense, Norm, add, he_normal, lecun_normal, to_depth

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet, which published weights expect
NORMS = ("layer", "affine", "block")

Stage = tuple[int, int, int, int, int]  # expand, kernel, stride, channels, repeats
B0_STAGES: tuple[Stage, ...] = (
    (1, 3, 1, 16, 1), (6, 3, 2, 24, 2), (6, 5, 2, 40, 2), (6, 3, 2, 80, 3), (6, 5, 1, 112, 3), (6, 5, 2, 192, 4),
    (6, 3, 1, 320, 1),
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class EncoderSpec:
    """A member of the family.

    Attributes:
        stages: (expand, kernel, stride, channels, repeats) of each stage.
        stem: (kernel, stride, channels) of the first convolution; with kernel = stride the image is cut in patches.
        head: Channels of the last 1x1 convolution; 0 = none.
        width: Factor on all channels (eq. 3).
        depth: Factor on all repeats (eq. 3).
        resolution: (rows, columns) images are resized to; None = as they come.
        norm: One of `NORMS`.
        activation: "silu" or "relu".
        num_classes: Of a classifier on top; 0 = none.
    """

    stages: tuple[Stage, ...] = ((2, 3, 1, 32, 1), (3, 5, 2, 64, 2), (4, 3, 2, 96, 2))
    stem: tuple[int, int, int] = (6, 6, 32)
    head: int = 0
    width: float = 1.0
    depth: float = 1.0
    resolution: tuple[int, int] | None = None
    norm: str = "block"
    activation: str = "silu"
    num_classes: int = 0

    def __post_init__(self) -> None:
        """Check ranges."""
        if not self.stages or any(min(s) < 1 or len(s) != 5 or s[1] % 2 == 0 for s in self.stages):
            raise ValueError(f"stages must be (expand, odd kernel, stride, channels, repeats) >= 1, got {self.stages}.")
        kernel, stride, channels = self.stem
        if min(self.stem) < 1 or (kernel % 2 == 0 and kernel != stride):
            raise ValueError(f"stem must be (odd kernel, or kernel = stride; stride; channels), got {self.stem}.")
        if self.width <= 0 or self.depth <= 0 or channels < 1:
            raise ValueError(f"width and depth must be > 0, got {self.width} and {self.depth}.")
        if self.norm not in NORMS or self.activation not in ACTIVATIONS:
            raise ValueError(f"norm must be one of {NORMS} and activation of {tuple(ACTIVATIONS)}, got {self}.")
        if self.resolution is not None and min(self.resolution) < 8:
            raise ValueError(f"resolution must be >= 8 pixels, got {self.resolution}.")

    def channels(self, base: int) -> int:
        """Eq. 3 on a number of channels."""
        wanted = base * self.width
        rounded = max(8, int(wanted + 4) // 8 * 8)
        return rounded if rounded >= 0.9 * wanted else rounded + 8

    def blocks(self) -> list[tuple[int, int, int, int, int]]:
        """(stage, expand, kernel, stride, channels) of each block, in order."""
        found = []
        for number, (expand, kernel, stride, channels, repeats) in enumerate(self.stages):
            for k in range(math.ceil(repeats * self.depth)):
                found.append((number, expand, kernel, stride if k == 0 else 1, self.channels(channels)))
        return found

    @property
    def strides(self) -> tuple[int, ...]:
        """Pixels per feature at which the encoder has feature maps, fine to coarse."""
        now, found = self.stem[1], {self.stem[1]: None}
        for _, _, _, stride, _ in self.blocks():
            now *= stride
            found[now] = None
        return tuple(found)

    def size(self, shape: tuple[int, int], stride: int) -> tuple[int, int]:
        """(rows, columns) of the feature map at a stride, for images of a shape."""
        kernel, first, _ = self.stem
        shape = shape if self.resolution is None else self.resolution
        rows, columns = (n // first if kernel == first else size_after(n, kernel, first) for n in shape)
        now = first
        for _, _, k, s, _ in self.blocks():
            now *= s
            if now > stride:
                break
            rows, columns = size_after(rows, k, s), size_after(columns, k, s)
        return rows, columns


def b0(width: float = 1.0, depth: float = 1.0, **changes) -> EncoderSpec:
    """B0, or a scaled one; `norm`, `resolution` and `num_classes` as in `EncoderSpec`."""
    kept = {"norm": "layer", **changes}
    return EncoderSpec(stages=B0_STAGES, stem=(3, 2, 32), head=1280, width=width, depth=depth, **kept)


class Conv(nn.Module):
    """A full convolution with padding `kernel // 2` (none where kernel = stride), without bias."""

    kernel: int
    stride: int
    features: int

    @nn.compact
    def __call__(self, x: Float[Array, "n h w c"]) -> Float[Array, "n h2 w2 d"]:
        """Apply it; over patches as a product of matrices."""
        k, c = self.kernel, x.shape[-1]
        weights = self.param("kernel", he_normal, (k, k, c, self.features))
        if k == self.stride:
            rows, columns = (n // k * k for n in x.shape[1:3])
            patches = to_depth(x[:, :rows, :columns], k)
            flat = patches.reshape(-1, k * k * c) @ weights.reshape(k * k * c, -1)
            return flat.reshape(*patches.shape[:3], self.features)
        pad = (k // 2, k // 2)
        return jax.lax.conv_general_dilated(
            x, weights, (self.stride, self.stride), (pad, pad), dimension_numbers=("NHWC", "HWIO", "NHWC")
        )


class SqueezeExcite(nn.Module):
    """Eq. 2."""

    squeezed: int
    activation: str

    @nn.compact
    def __call__(self, y: Float[Array, "n h w c"]) -> Float[Array, "n h w c"]:
        """Weigh the channels of each image."""
        n, h, w, c = y.shape
        pixels = y.reshape(n, h * w, c)
        mean = jnp.einsum("npc,p->nc", pixels, jnp.full(h * w, 1.0 / (h * w), y.dtype))
        inner = ACTIVATIONS[self.activation](Dense(self.squeezed, name="reduce")(mean))
        return y * jax.nn.sigmoid(Dense(c, kernel_init=lecun_normal, name="expand")(inner))[:, None, None, :]


class MBConv(nn.Module):
    """Eq. 1."""

    expand: int
    kernel: int
    stride: int
    channels: int
    norm: str
    activation: str

    @nn.compact
    def __call__(self, x: Float[Array, "n h w c"]) -> Float[Array, "n h2 w2 d"]:
        """Apply it; the input is added where shapes allow it."""
        act, c = ACTIVATIONS[self.activation], x.shape[-1]
        bias = self.norm == "block"

        def inside(name: str, y: Any) -> Any:
            return y if bias else Norm(self.norm, name=name)(y)

        y: Any = Norm("layer", name="norm")(x) if self.norm == "block" else x
        if self.expand > 1:
            y = act(inside("expand_norm", Dense(c * self.expand, bias=bias, name="expand")(y)))
        kernel = self.param("depthwise", _depthwise_init, (self.kernel, self.kernel, y.shape[-1]))
        y = depthwise(y, kernel, self.stride)
        if bias:
            y = add(y, self.param("depthwise_bias", nn.initializers.zeros_init(), (y.shape[-1],)))
        y = act(inside("depthwise_norm", y))
        y = SqueezeExcite(max(1, c // 4), self.activation, name="excite")(y)
        y = inside("project_norm", Dense(self.channels, bias=bias, kernel_init=lecun_normal, name="project")(y))
        return x + y if self.stride == 1 and c == self.channels else y


def _depthwise_init(key: Array, shape: tuple[int, int, int]) -> Array:
    return jax.random.normal(key, shape, jnp.float32) * (2.0 / (shape[0] * shape[1])) ** 0.5


class EfficientNet(nn.Module):
    """Images to feature maps.

    Attributes:
        spec: The member of the family.
    """

    spec: EncoderSpec

    @nn.compact
    def __call__(self, images: Float[Array, "n h w 3"]) -> dict[int, Array]:
        """Feature maps by stride, the coarsest after the head.

        Args:
            images: 0..1.

        Returns:
            stride -> `[n, rows, columns, channels]`; and under 0 class scores `[n, num_classes]`, if the Spec has any.
        """
        spec = self.spec
        act = ACTIVATIONS[spec.activation]
        norm = "layer" if spec.norm == "block" else spec.norm
        if spec.resolution is not None and images.shape[1:3] != spec.resolution:
            images = jax.image.resize(images, (images.shape[0], *spec.resolution, 3), "linear")
        mean, std = (jnp.asarray(v, jnp.float32)[None, None, None, :] for v in (MEAN, STD))
        kernel, stride, channels = spec.stem
        x = Conv(kernel, stride, spec.channels(channels), name="stem")((images - mean) / std)
        x = act(Norm(norm, name="stem_norm")(x))
        now, maps = stride, {stride: x}
        for number, (_, expand, kernel, step, out) in enumerate(spec.blocks()):
            x = MBConv(expand, kernel, step, out, spec.norm, spec.activation, name=f"block{number}")(x)
            now *= step
            maps[now] = x
        if spec.head:
            x = Dense(spec.channels(spec.head), bias=False, name="head")(x)
            x = act(Norm(norm, name="head_norm")(x))
            maps[now] = x
        if spec.num_classes:
            pooled = jnp.mean(x, axis=(1, 2))
            maps[0] = Dense(spec.num_classes, kernel_init=lecun_normal, name="classifier")(pooled)
        return maps
