"""What the network reads and what it is trained towards, as batches: B frames on axis 0 of every field.

N cameras, P points, h x w cells of the bird's-eye grid (`BevSpec`). Integer images and rules count in 1/255, so that frames
can be fed as they are stored.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from drnav_jax.models.bev import FREE, OCCUPIED, UNKNOWN
from drnav_jax.types import CameraRig

NOW, BEFORE, NEVER = range(3)  # classes of `Targets.visibility`

__all__ = ["BEFORE", "FREE", "NEVER", "NOW", "OCCUPIED", "UNKNOWN", "Batch", "Inputs", "Targets", "batch_of", "shares"]


class Inputs(NamedTuple):
    """What the sensors and the filter say."""

    images: Any  # [B, N, rows, columns, 3] uint8, or float32 in 0..1
    image_valid: Any  # [B, N] bool
    points: Any  # [B, P, 3] in base_link [m]
    point_valid: Any  # [B, P] bool
    rig: CameraRig  # fields [B, N, ...]
    local_map: Any  # [B, h, w] uint8, `UNKNOWN`, `FREE` or `OCCUPIED`
    rule_p: Any  # [B, h, w] p̂ of the geometric rule, uint8 or float32 in 0..1
    rule_confidence: Any  # [B, h, w] its confidence, likewise


class Targets(NamedTuple):
    """What is true; nothing of it is known to the network."""

    visibility: Any  # [B, h, w] uint8, `NOW`, `BEFORE` or `NEVER`
    dead_end: Any  # [B, h, w] bool
    inside: Any  # [B, h, w] bool, in the world: where `traversable` means something
    valid: Any  # [B, h, w] bool, where the other cell labels do
    depth: Any  # [B, h, w] beyond the mouth [m]
    traversable: Any  # [B, h, w] bool
    recoverability: Any  # [B, h, w] 0..1
    interior: Any  # [B, h, w] bool, where the open twin's label differs
    path: Any  # [B, 3] bool, front, left, right is open
    path_stable: Any  # [B, 3] bool, unchanged by a step aside
    dead_end_flag: Any  # [B] bool, no path is open
    flag_stable: Any  # [B] bool
    family: Any  # [B] int32
    seed: Any  # [B] int32
    closed: Any  # [B] bool
    strata: Any  # [B] uint8, bits of what stands in the world
    strata_seen: Any  # [B] uint8, bits of what a camera sees


class Batch(NamedTuple):
    """Frames to learn from."""

    inputs: Inputs
    targets: Targets


def batch_of(fields: Mapping[str, Any]) -> Batch:
    """A batch from arrays by name, those of the rig among them (`focal`, `centre`, `position`, `rotation`).

    Args:
        fields: At least the fields of `Inputs`, `Targets` and `CameraRig`; others are left out.

    Raises:
        ValueError: If one is missing.
    """
    wanted = [*CameraRig._fields, *Inputs._fields, *Targets._fields]
    missing = [name for name in wanted if name not in fields and name != "rig"]
    if missing:
        raise ValueError(f"frames lack {', '.join(missing)}: write the dataset anew with this version.")
    rig = CameraRig(**{name: fields[name] for name in CameraRig._fields})
    return Batch(
        inputs=Inputs(rig=rig, **{name: fields[name] for name in Inputs._fields if name != "rig"}),
        targets=Targets(**{name: fields[name] for name in Targets._fields}),
    )


def shares(values: Array) -> Array:
    """Stored integers as float32 in 0..1; floats as they are."""
    if jnp.issubdtype(values.dtype, jnp.integer):
        return values.astype(jnp.float32) * (1.0 / 255.0)
    return values.astype(jnp.float32)
