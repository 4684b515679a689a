"""Trained parameters as safetensors, with the Spec and the temperatures they belong to, checked on load.

`blocks/name/...` are the arrays, in float16 or float32. The header's metadata holds what cannot be an array: format,
network Spec, calibration, notes, and the SHA-256 of the arrays.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy

from drnav_jax.models import network, settings
from drnav_jax.models.calibration import Calibration, Temperature
from drnav_jax.models.network import NetworkSpec

FORMAT = 1
ABLATED = ("attention_layers", "lift", "head", "sensors")  # settings of a network that may differ in `begun`
SHIPPED = Path(__file__).resolve().parent / "fusion.safetensors"


class Trained(NamedTuple):
    """What a file of weights holds."""

    spec: NetworkSpec
    params: Any
    calibration: Calibration
    notes: dict[str, Any]  # data, seeds, figures: the model card in numbers
    sha256: str  # of the arrays


def _flat(tree: Any, prefix: str = "") -> dict[str, np.ndarray]:
    found = {}
    for name, value in tree.items():
        found |= _flat(value, f"{prefix}{name}/") if isinstance(value, Mapping) else {prefix + name: np.asarray(value)}
    return found


def _nested(flat: Mapping[str, np.ndarray]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for name, value in flat.items():
        *path, last = name.split("/")
        at = tree
        for part in path:
            at = at.setdefault(part, {})
        at[last] = jnp.asarray(value, jnp.float32)
    return tree


def _differences(mine: NetworkSpec, theirs: NetworkSpec) -> list[str]:
    """Settings in which they differ."""
    a, b = settings.plain(mine), settings.plain(theirs)
    return [name for name in a if a[name] != b[name]]


def _digest(arrays: Mapping[str, np.ndarray]) -> str:
    hash_ = hashlib.sha256()
    for name in sorted(arrays):
        a = np.ascontiguousarray(arrays[name])
        hash_.update(f"{name} {a.dtype} {a.shape}\n".encode())
        hash_.update(a.tobytes())
    return hash_.hexdigest()


def save(
    file: Path, spec: NetworkSpec, params: Any, calibration: Calibration, notes: Mapping[str, Any], *, half: bool = False
) -> str:
    """Write a file of weights; the SHA-256 of its arrays.

    Args:
        file: `.safetensors`.
        spec: What the parameters are for.
        params: From training.
        calibration: Temperatures that were fitted for them.
        notes: JSON values: data, seeds, figures.
        half: Store float16.
    """
    arrays = {k: v.astype(np.float16 if half else np.float32) for k, v in _flat(jax.device_get(params)).items()}
    digest = _digest(arrays)
    temper = {name: [float(t.scale), float(t.offset)] for name, t in calibration._asdict().items()}
    about = {"spec": settings.plain(spec), "calibration": temper, "notes": dict(notes)}
    metadata = {"format": str(FORMAT), "sha256": digest, "about": json.dumps(about, sort_keys=True)}
    content = safetensors.numpy.save(arrays, metadata)
    part = file.with_name(f".{file.name}.part")
    part.write_bytes(content)
    part.replace(file)
    return digest


def load(file: Path = SHIPPED, expected: NetworkSpec | None = None) -> Trained:
    """Read a file of weights.

    Args:
        file: From `save`; default the weights that come with the package.
        expected: The Spec they must be for; None = any.

    Raises:
        ValueError: If the file is damaged, of another format, or for another Spec.
        FileNotFoundError: If there is none.
    """
    if not file.is_file():
        raise FileNotFoundError(f"there are no weights at {file}: train some with `drnav train`.")
    try:
        with safetensors.safe_open(file, framework="numpy") as held:
            metadata = held.metadata() or {}
            arrays = {name: held.get_tensor(name) for name in held.keys()}  # noqa: SIM118
    except safetensors.SafetensorError as error:
        raise ValueError(f"{file} is damaged ({error}): fetch or train it again.") from None
    if metadata.get("format") != str(FORMAT):
        raise ValueError(f"{file} has format {metadata.get('format')}, this version reads {FORMAT}: train it anew.")
    if _digest(arrays) != metadata.get("sha256"):
        raise ValueError(f"{file} is damaged: its arrays do not have the hash it names; fetch or train it again.")
    about = json.loads(metadata["about"])
    try:
        spec = settings.built(NetworkSpec, about["spec"])
    except ValueError as error:
        raise ValueError(f"{file} is of another version ({error}): train it anew.") from None
    if expected is not None and spec != expected:
        other = ", ".join(_differences(expected, spec))
        raise ValueError(f"{file} holds a network with another {other}: load it with its own Spec, or train it anew.")
    params = _nested(arrays)
    shapes = jax.tree.map(lambda a: a.shape, jax.eval_shape(lambda: network.init(jax.random.key(0), spec)))
    if jax.tree.map(lambda a: a.shape, params) != shapes:
        raise ValueError(f"{file} does not hold the arrays of its network: this version builds another; train it anew.")
    temper = Calibration(**{name: Temperature(*pair) for name, pair in about["calibration"].items()})
    return Trained(spec, params, temper, about["notes"], metadata["sha256"])


def begun(file: Path, spec: NetworkSpec, seed: int = 0) -> Any:
    """Parameters to go on training from: a file's, as far as a network of this Spec has them, else random ones.

    Args:
        file: From `save`.
        spec: May differ from the file's in what an ablation takes away (`ABLATED`), in nothing else.
        seed: Of the random ones.

    Raises:
        ValueError: As `load`, or if the networks differ in anything else.
        FileNotFoundError: If there is no such file.
    """
    held = load(file)
    other = [name for name in _differences(spec, held.spec) if name not in ABLATED]
    if other:
        raise ValueError(
            f"{file} holds a network with another {', '.join(other)}: to go on from it a network may differ in "
            f"{', '.join(ABLATED)} only."
        )
    if spec == held.spec:
        return held.params
    old, fresh = _flat(held.params), _flat(network.init(jax.random.key(seed), spec))
    return _nested({k: old[k] if k in old and old[k].shape == a.shape else a for k, a in fresh.items()})
