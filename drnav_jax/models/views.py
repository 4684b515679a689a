"""Which camera shows which way, and what judges of images alone say of the ways (`vlm`, `clip`; host code).

With a_k the optical axis of camera k in base_link and s_d = (1, 0, 0), (0, 1, 0), (0, -1, 0) the way to the front, left
and right

    (1)  camera(d) = argmax_k a_k . s_d  over the cameras with an image, if that is > cos 45 deg; else none

No camera shows two ways, and one that looks half between two of them shows neither.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from drnav_jax.types import CameraRig

WAYS = ("front", "left", "right")  # in the order of the path labels
NO_CAMERA = -1
_AXES = np.array([[1, 0, 0], [0, 1, 0], [0, -1, 0]], np.float32)  # of the ways, in base_link
_WITHIN = math.cos(math.radians(45)) + 1e-4  # rotations come in float32


class Judgement(NamedTuple):
    """What is believed of one frame, or of B frames with a leading axis; NaN where nothing is known."""

    path: Any  # [3] float32, probability that the way to the front, left, right is open
    dead_end: Any  # [] float32, probability that none is


def cameras_of(
    rotation: Float[np.ndarray, "*b n 3 3"], valid: Bool[np.ndarray, "*b n"]
) -> Int[np.ndarray, "*b 3"]:
    """Eq. 1: index of the camera that shows each of the `WAYS`, or `NO_CAMERA`.

    Args:
        rotation: Of each camera, from its optical frame to base_link (`CameraRig.rotation`).
        valid: Which cameras have an image.
    """
    none = np.full((*valid.shape[:-1], 3), NO_CAMERA)
    if valid.shape[-1] == 0:
        return none
    along = np.einsum("...ki,di->...kd", rotation[..., 2], _AXES)
    along = np.where(valid[..., None], along, -2.0)
    return np.where(along.max(axis=-2) > _WITHIN, along.argmax(axis=-2), none)


def shown(
    images: Shaped[np.ndarray, "b n h w 3"], rig: CameraRig, valid: Bool[np.ndarray, "b n"] | None
) -> Int[np.ndarray, "b 3"]:
    """`cameras_of` for frames whose rig may be one and the same.

    Args:
        images: RGB.
        rig: Fields `[B, N, ...]`, or `[N, ...]` for all frames.
        valid: Which images are there; None = all.

    Raises:
        ValueError: If the images are no uint8, or the rig has another number of cameras.
    """
    if images.dtype != np.uint8:
        raise ValueError(f"images must be uint8 (of floats in 0..1 give round(255 x)), got {images.dtype}.")
    b, n = images.shape[:2]
    rotation = np.asarray(rig.rotation, np.float32)
    if rotation.shape not in ((n, 3, 3), (b, n, 3, 3)):
        raise ValueError(f"{b} frames of {n} images need a rig with as many cameras, got rotations {rotation.shape}.")
    there = np.ones((b, n), bool) if valid is None else valid
    return cameras_of(np.broadcast_to(rotation, (b, n, 3, 3)), there)
