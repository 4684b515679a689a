"""Published EfficientNet weights, as torchvision names and lays them out, for an encoder of this package.

A file holds (stage N from 1, block K of it; convolutions are `[out, in, rows, columns]`)

    features.0.0.weight, features.0.1.*                 stem and its batch norm
    features.N.K.block.0.0.weight, ...0.1.*             expansion; blocks whose `expand` is 1 lack it, what follows moves up
    features.N.K.block.1.0.weight, ...1.1.*             depthwise
    features.N.K.block.2.fc1.*, ...2.fc2.*              squeeze and excitation
    features.N.K.block.3.0.weight, ...3.1.*             projection
    features.L.0.weight, features.L.1.*                 head, L = number of stages + 1
    classifier.1.weight, classifier.1.bias

A batch norm whose statistics are fixed only scales and shifts, which is what N is when `norm="affine"`:

    (1)  scale = γ / √(variance + ε),  bias = β - scale · mean
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors

from drnav_jax.models.efficientnet import EncoderSpec

EPSILON = 1e-5  # of the batch norms of B0 to B4; those of B5 and larger have 1e-3
_SHOWN = 3  # names in an error


class _Taken:
    """The tensors of a file; it remembers which were asked for."""

    def __init__(self, tensors: Mapping[str, np.ndarray], epsilon: float) -> None:
        self.tensors, self.epsilon = tensors, epsilon
        self.asked: set[str] = set()
        self.missing: list[str] = []

    def __call__(self, name: str) -> np.ndarray | None:
        self.asked.add(name)
        if name not in self.tensors:
            self.missing.append(name)
            return None
        return np.asarray(self.tensors[name], np.float32)

    def moved(self, name: str, change: Callable[[np.ndarray], np.ndarray], rank: int) -> np.ndarray | None:
        values = self(name)
        if values is not None and values.ndim != rank:
            raise ValueError(f"{name} must have {rank} axes, has shape {values.shape}.")
        return None if values is None else change(values)

    def conv(self, name: str) -> dict[str, Any]:
        return {"kernel": self.moved(f"{name}.weight", lambda w: w.transpose(2, 3, 1, 0), 4)}

    def point(self, name: str) -> dict[str, Any]:
        """A convolution of single pixels."""
        return {"kernel": self.moved(f"{name}.weight", lambda w: w[:, :, 0, 0].T if w.shape[2:] == (1, 1) else w, 4)}

    def norm(self, name: str) -> dict[str, Any]:
        self.asked.add(f"{name}.num_batches_tracked")
        parts = [self(f"{name}.{part}") for part in ("weight", "bias", "running_mean", "running_var")]
        if any(part is None for part in parts):
            return {"scale": None, "bias": None}
        gamma, beta, mean, variance = (np.asarray(part, np.float64) for part in parts)
        scale = gamma / np.sqrt(variance + self.epsilon)
        return {"scale": scale, "bias": beta - scale * mean}


def _excite(take: _Taken, name: str) -> dict[str, Any]:
    return {ours: take.point(f"{name}.{theirs}") | {"bias": take(f"{name}.{theirs}.bias")}
            for ours, theirs in (("reduce", "fc1"), ("expand", "fc2"))}  # fmt: skip


def _tree(spec: EncoderSpec, take: _Taken) -> dict[str, Any]:
    """The encoder's parameters; None for what the file lacks."""
    tree: dict[str, Any] = {"stem": take.conv("features.0.0"), "stem_norm": take.norm("features.0.1")}
    before, k = -1, 0
    for number, (stage, expand, *_) in enumerate(spec.blocks()):
        before, k = stage, k + 1 if stage == before else 0
        name = f"features.{stage + 1}.{k}.block"
        block, at = {}, 0
        if expand > 1:
            block |= {"expand": take.point(f"{name}.0.0"), "expand_norm": take.norm(f"{name}.0.1")}
            at = 1
        block["depthwise"] = take.moved(f"{name}.{at}.0.weight", lambda w: w[:, 0].transpose(1, 2, 0), 4)
        block["depthwise_norm"] = take.norm(f"{name}.{at}.1")
        block["excite"] = _excite(take, f"{name}.{at + 1}")
        block |= {"project": take.point(f"{name}.{at + 2}.0"), "project_norm": take.norm(f"{name}.{at + 2}.1")}
        tree[f"block{number}"] = block
    if spec.head:
        last = f"features.{len(spec.stages) + 1}"
        tree |= {"head": take.point(f"{last}.0"), "head_norm": take.norm(f"{last}.1")}
    if spec.num_classes:
        weights = take.moved("classifier.1.weight", np.transpose, 2)
        tree["classifier"] = {"kernel": weights, "bias": take("classifier.1.bias")}
    return tree


def _some(names: list[str]) -> str:
    return ", ".join(names[:_SHOWN]) + (f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else "")


def load(file: Path, spec: EncoderSpec, params: Any, *, epsilon: float = EPSILON) -> Any:
    """The encoder's parameters with the file's values in their place.

    Args:
        file: `.safetensors` with the module docstring's tensors, such as those of torchvision's `efficientnet_b0`.
        spec: Whose `norm` is "affine", such as `b0(norm="affine", num_classes=1000)`; without classes the file's
            classifier is left out.
        params: Of `EfficientNet(spec)` (or their shapes), which the file's must agree with.
        epsilon: Of the batch norms.

    Raises:
        ValueError: If the file is damaged, or lacks a tensor, or has others, or one of another shape.
        FileNotFoundError: If there is none.
    """
    if spec.norm != "affine":
        raise ValueError(f'batch norms fold into norm="affine", the encoder has norm="{spec.norm}".')
    if not file.is_file():
        raise FileNotFoundError(f"there are no weights at {file}.")
    try:
        with safetensors.safe_open(file, framework="numpy") as held:
            tensors = {name: held.get_tensor(name) for name in held.keys()}  # noqa: SIM118
    except (safetensors.SafetensorError, TypeError) as error:
        raise ValueError(f"{file} cannot be read ({error}): write it as float32 or float16 safetensors.") from None
    take = _Taken(tensors, epsilon)
    tree = _tree(spec, take)
    if take.missing:
        raise ValueError(f"{file} lacks {_some(take.missing)}: it is of another network than the encoder's.")
    left = [name for name in sorted(tensors) if name not in take.asked]
    left = [name for name in left if spec.num_classes or not name.startswith("classifier.")]
    if left:
        raise ValueError(f"{file} also holds {_some(left)}: it is of another network than the encoder's.")
    theirs, ours = (dict(_named(t)) for t in (tree, params))
    if set(theirs) != set(ours):
        raise ValueError(f"params are not those of the encoder: {_some(sorted(set(theirs) ^ set(ours)))}.")
    other = [f"{n} {theirs[n].shape} (not {ours[n].shape})" for n in ours if theirs[n].shape != ours[n].shape]
    if other:
        raise ValueError(f"{file} holds arrays of other shapes: {_some(other)}; give the encoder that it belongs to.")
    return jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), tree)


def _named(tree: Any) -> list[tuple[str, Any]]:
    return [(jax.tree_util.keystr(path), leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(tree)]
