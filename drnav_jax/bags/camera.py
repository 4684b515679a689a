"""Recorded images as those of the cameras that the network knows: small, pinhole, level.

The new camera stands at the optical centre of the real one and looks the same way along the ground, so what it sees is a
matter of directions alone. Through the middle of each new pixel goes a ray

    d = R_realᵀ R_new ((u - c) / f, 1)                                                                    (1)

which meets the real image where its calibration says. What the real camera does not see is black.
`CameraInfo` counts pixels from the middle of the first one, `CameraRig` from its outer corner.
"""

import dataclasses
import io
import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image

from drnav_jax.bags.transforms import Rigid
from drnav_jax.types import Mount, RigSpec, rig_of

RAW, COMPRESSED, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
_CHANNELS = {
    "rgb8": (0, 1, 2), "bgr8": (2, 1, 0), "rgba8": (0, 1, 2), "bgra8": (2, 1, 0), "mono8": (0, 0, 0),
}  # fmt: skip
_DEPTH = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1}  # bytes per pixel
MODELS = ("plumb_bob", "rational_polynomial", "equidistant", "fisheye")


@dataclasses.dataclass(frozen=True)
class ImageSpec:
    """The new cameras.

    Attributes:
        shape: (h, w) [pixels].
        fov: Horizontal field of view [rad].
    """

    shape: tuple[int, int] = RigSpec().shape
    fov: float = Mount().fov

    def __post_init__(self) -> None:
        """Check sizes."""
        if min(self.shape) < 1 or not 0 < self.fov < math.pi:
            raise ValueError(f"shape must be >= 1 pixel and fov in (0, pi) rad, got {self.shape} and {self.fov}.")


class Lens(NamedTuple):
    """A calibrated camera."""

    focal: np.ndarray  # [2] fx, fy [pixels]
    centre: np.ndarray  # [2] cx, cy from the outer corner of the first pixel [pixels]
    shape: tuple[int, int]  # (rows, columns) that these count in
    model: str
    distortion: np.ndarray  # [k] as in CameraInfo


class View(NamedTuple):
    """A new camera and its image."""

    image: np.ndarray  # [h, w, 3] float32 in 0..1
    seen: np.ndarray  # [h, w] bool: the real camera sees it
    focal: np.ndarray  # [2] float32
    centre: np.ndarray  # [2] float32
    position: np.ndarray  # [3] float32 in base_link
    rotation: np.ndarray  # [3, 3] float32 to base_link


def decoded(message: Any) -> UInt8[np.ndarray, "rows columns 3"]:
    """RGB of an Image or CompressedImage.

    Raises:
        ValueError: If the encoding is unknown or the data are damaged.
    """
    if hasattr(message, "format"):
        try:
            with Image.open(io.BytesIO(np.asarray(message.data, np.uint8).tobytes())) as picture:
                return np.array(picture.convert("RGB"))
        except (OSError, SyntaxError) as error:
            raise ValueError(f"a compressed image ({message.format}) is damaged or no JPEG or PNG: {error}.") from None
    if message.encoding not in _CHANNELS:
        known = ", ".join(_CHANNELS)
        raise ValueError(f'encoding "{message.encoding}" cannot be read: record one of {known}, or compressed images.')
    depth, data = _DEPTH[message.encoding], np.asarray(message.data, np.uint8)
    if message.step < message.width * depth or data.size < message.height * message.step:
        raise ValueError(f"an image of {message.height} x {message.width} has only {data.size} bytes: it is cut off.")
    rows = data[: message.height * message.step].reshape(message.height, message.step)[:, : message.width * depth]
    return rows.reshape(message.height, message.width, depth)[..., _CHANNELS[message.encoding]]


def lens_of(info: Any, rectified: bool) -> Lens:
    """The calibration of a CameraInfo.

    Args:
        info: The message.
        rectified: Of the rectified image (P, no distortion), not of the raw one (K, D).

    Raises:
        ValueError: If the camera was never calibrated, or in a way that is not known.
    """
    matrix = getattr(info, "p" if rectified else "k", None)  # ROS 1 spells them large
    matrix = np.asarray(getattr(info, "P" if rectified else "K") if matrix is None else matrix, float).reshape(3, -1)
    distortion = np.asarray(info.D if hasattr(info, "D") else info.d, float)
    if not (matrix[0, 0] > 0 and matrix[1, 1] > 0 and info.width and info.height):
        raise ValueError(
            f"the camera {info.header.frame_id} is not calibrated (its CameraInfo has focal length {matrix[0, 0]:g}, size "
            f"{info.width} x {info.height}): calibrate it, or leave its topic out."
        )
    used = np.zeros(0) if rectified or not distortion.any() else distortion
    if used.size and (info.distortion_model not in MODELS or used.size < 4):
        raise ValueError(
            f'distortion "{info.distortion_model}" with {used.size} values is not known: use rectified images, or one of '
            f"{', '.join(MODELS)}."
        )
    return Lens(
        focal=np.array([matrix[0, 0], matrix[1, 1]]), centre=np.array([matrix[0, 2], matrix[1, 2]]) + 0.5,
        shape=(int(info.height), int(info.width)), model=info.distortion_model, distortion=used,
    )  # fmt: skip


def _radial(lens: Lens, r: np.ndarray) -> np.ndarray:
    """How far from the axis, in units of the focal length, the lens puts a ray of slope r, over r."""
    k = np.pad(lens.distortion, (0, 14))
    if lens.model in ("equidistant", "fisheye"):
        angle = np.arctan(r)
        a = angle**2
        bent = angle * (1 + a * (k[0] + a * (k[1] + a * (k[2] + a * k[3]))))
        return np.where(r > 1e-9, bent / np.maximum(r, 1e-9), 1.0)
    s = r * r
    above = 1 + s * (k[0] + s * (k[1] + s * k[4]))
    return above / (1 + s * (k[5] + s * (k[6] + s * k[7]))) if lens.model == "rational_polynomial" else above


def pixels_of(lens: Lens, rays: Float[np.ndarray, "*s 3"]) -> tuple[Float[np.ndarray, "*s 2"], Bool[np.ndarray, "*s"]]:
    """Where rays of the optical frame meet the image [pixels], and which of them do.

    A polynomial bends rays far from the axis back into the image: beyond its first turning point nothing is seen.
    """
    rows, columns = lens.shape
    ahead = rays[..., 2] > 1e-6
    x, y = (np.where(ahead, rays[..., k] / np.where(ahead, rays[..., 2], 1.0), 0.0) for k in (0, 1))
    if lens.distortion.size:
        r = np.hypot(x, y)
        tested = np.linspace(0.0, max(float(r.max()), 1e-6), 2000)
        falls = np.flatnonzero(np.diff(tested * _radial(lens, tested)) <= 0)
        if falls.size:
            ahead = ahead & (r < tested[falls[0]])
        scale, s = _radial(lens, r), r * r
        p1, p2 = (0.0, 0.0) if lens.model in ("equidistant", "fisheye") else lens.distortion[2:4]
        x, y = (
            x * scale + 2 * p1 * x * y + p2 * (s + 2 * x * x),
            y * scale + p1 * (s + 2 * y * y) + 2 * p2 * x * y,
        )
    at = np.stack([x, y], axis=-1) * lens.focal + lens.centre
    inside = ahead & (at >= 0).all(axis=-1) & (at[..., 0] <= columns) & (at[..., 1] <= rows)
    return at, inside


def _bilinear(image: Float[np.ndarray, "r c 3"], at: Float[np.ndarray, "*s 2"]) -> Float[np.ndarray, "*s 3"]:
    """Colours at pixel positions; beyond the middle of the outermost pixels theirs."""
    rows, columns = image.shape[:2]
    column, row = np.clip(at[..., 0] - 0.5, 0, columns - 1), np.clip(at[..., 1] - 0.5, 0, rows - 1)
    j, i = column.astype(int), row.astype(int)
    b, a = (column - j)[..., None], (row - i)[..., None]
    right, below = np.minimum(j + 1, columns - 1), np.minimum(i + 1, rows - 1)
    upper = (1 - b) * image[i, j] + b * image[i, right]
    return (1 - a) * upper + a * ((1 - b) * image[below, j] + b * image[below, right])


def redrawn(spec: ImageSpec, lens: Lens, put: Rigid, image: UInt8[np.ndarray, "rows columns 3"] | None) -> View:
    """What the new camera sees (eq. 1).

    Args:
        spec: The new camera.
        lens: Of the real one.
        put: The optical frame of the real one in base_link.
        image: Its image; None = there is none.

    Raises:
        ValueError: If the image has another size than the calibration says.
    """
    if image is not None and image.shape[:2] != lens.shape:
        raise ValueError(
            f"the image has {image.shape[0]} x {image.shape[1]} pixels, its CameraInfo is for {lens.shape[0]} x "
            f"{lens.shape[1]}: record the CameraInfo of this resolution."
        )
    along = put.rotation[:, 2]
    mount = Mount(yaw=math.atan2(along[1], along[0]), fov=spec.fov)
    new = rig_of(RigSpec((mount,), spec.shape))
    focal, centre, rotation = (np.asarray(a[0], np.float64) for a in (new.focal, new.centre, new.rotation))
    h, w = spec.shape
    drawn, seen = np.zeros((h, w, 3), np.float32), np.zeros((h, w), bool)
    if image is not None:
        u, v = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
        rays = np.stack([(u - centre[0]) / focal[0], (v - centre[1]) / focal[1], np.ones_like(u)], axis=-1)
        at, seen = pixels_of(lens, rays @ (put.rotation.T @ rotation).T)
        shrunk = max(1, int(min(lens.focal / focal)))  # first to about the new resolution, or fine detail would alias
        small = np.asarray(Image.fromarray(np.ascontiguousarray(image)).reduce(shrunk), np.float32) / 255
        drawn = np.where(seen[..., None], _bilinear(small, at / shrunk), 0.0).astype(np.float32)
    return View(
        image=drawn, seen=seen, focal=focal.astype(np.float32),
        centre=centre.astype(np.float32), position=put.translation.astype(np.float32), rotation=rotation.astype(np.float32),
    )  # fmt: skip
