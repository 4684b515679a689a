"""A rosbag as observations: one for each LiDAR message (each image of the first camera where there is no LiDAR).

Cameras and odometry are those nearest in time (`sync`), within the tolerance; what is missing is a mask. Points are in
`base_link` with z = 0 on the ground. Clouds are taken as they were recorded: the motion during one turn is left in.
"""

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from drnav_jax.bags import camera, scan, sync, transforms
from drnav_jax.bags.camera import ImageSpec, Lens, View
from drnav_jax.bags.reader import Bag, Message, chosen, listing, messages, opened
from drnav_jax.bags.scan import Ground, ScanSpec
from drnav_jax.bags.transforms import IDENTITY, Rigid, Tree
from drnav_jax.types import CameraRig, Observation

ODOMETRY = "nav_msgs/msg/Odometry"
_RIG = {"focal": (2,), "centre": (2,), "position": (3,), "rotation": (3, 3)}  # shapes of a camera's `CameraRig`
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")


@dataclasses.dataclass(frozen=True)
class BagSpec:
    """Which topics are read, and as what.

    Attributes:
        images: Topics of the N cameras, raw or compressed; None = all there are. `CameraInfo` comes from the topic
            camera_info beside each.
        points: Topic of the LiDAR, PointCloud2 or LaserScan; None = the only one.
        odometry: Topic; None = the only one; "" = it is not read.
        base_frame: The frame that stands for base_link.
        base_height: Its origin above the ground [m].
        level: Find the ground in each cloud and take it for z = 0 (`scan.level`).
        tolerance: Farther off in time than this a message belongs to another observation [s].
        image: The cameras that images are given as.
        scan: The LiDAR that clouds are given as.
    """

    images: tuple[str, ...] | None = None
    points: str | None = None
    odometry: str | None = None
    base_frame: str = "base_link"
    base_height: float = 0.0
    level: bool = False
    tolerance: float = 0.1
    image: ImageSpec = ImageSpec()
    scan: ScanSpec = ScanSpec()

    def __post_init__(self) -> None:
        """Check the tolerance."""
        if not 0 <= self.tolerance < sync.PATIENCE * 1e-9:
            raise ValueError(f"tolerance must be >= 0 s and < {sync.PATIENCE * 1e-9:g} s, got {self.tolerance}.")


class Recorded(NamedTuple):
    """One observation, and what it was made of."""

    observation: Observation  # on the host; goal zero, pose and twist zero without odometry, NaN where it has a gap
    time: float  # [s] stamp of the message that set the pace
    photos: tuple[np.ndarray | None, ...]  # N images as recorded [rows, columns, 3] uint8
    cloud: np.ndarray  # [n, 3] all points in base_link [m]
    ground: Ground | None  # as it was found; None if it was not


class _Sensors(NamedTuple):
    images: tuple[str, ...]
    points: str | None
    odometry: str | None
    lenses: dict[str, Lens]
    mounts: dict[str, Rigid]  # topic -> its frame in base_link


def _image_topics(bag: Bag, wanted: tuple[str, ...] | None) -> tuple[str, ...]:
    kinds = (camera.RAW, camera.COMPRESSED)
    if wanted is not None:
        return tuple(str(chosen(bag, name, kinds, "camera")) for name in wanted)
    found = sorted(name for name, kind in bag.kinds.items() if kind in kinds and bag.counts[name])
    return tuple(name for name in found if name.removesuffix("/compressed") not in found or "/compressed" not in name)


def _info_topic(image: str) -> str:
    return image.removesuffix("/compressed").rpartition("/")[0] + "/camera_info"


def _sensors(bag: Bag, spec: BagSpec) -> _Sensors:
    """Topics, calibrations and mounts.

    Raises:
        ValueError: If one is missing.
    """
    images = _image_topics(bag, spec.images)
    points = chosen(bag, spec.points, (scan.CLOUD, scan.LASER), "LiDAR")
    odometry = None if spec.odometry == "" else chosen(bag, spec.odometry, (ODOMETRY,), "odometry")
    seeing = (*images, *([points] if points else []))
    if not seeing:
        raise ValueError(f"{bag.path} has neither images nor a point cloud or laser scan; it has {listing(bag)}.")
    if spec.level and (points is None or bag.kinds[points] != scan.CLOUD):
        raise ValueError("the ground is found in a PointCloud2 only: give base_height in place of level.")
    infos = {name: _info_topic(name) for name in images}
    for image, info in infos.items():
        if bag.kinds.get(info) != camera.INFO or not bag.counts[info]:
            raise ValueError(
                f"{bag.path} has no calibration for {image}: record {info} (sensor_msgs/msg/CameraInfo) too, or name "
                "other images."
            )
    first: dict[str, Any] = {}
    for message in messages(bag, {*seeing, *infos.values()}):
        first.setdefault(message.topic, message.content)
        if len(first) == len({*seeing, *infos.values()}):
            break
    lenses = {name: camera.lens_of(first[info], "_rect" in name) for name, info in infos.items()}
    frames = {name: first[name].header.frame_id.lstrip("/") for name in seeing}
    return _Sensors(images, points, odometry, lenses, _mounts(bag, spec, frames))


def _mounts(bag: Bag, spec: BagSpec, frames: dict[str, str]) -> dict[str, Rigid]:
    tree, base = Tree(), spec.base_frame.lstrip("/")
    raised = Rigid(np.eye(3), np.array([0.0, 0.0, spec.base_height]))
    apart = lambda: [f for f in frames.values() if f != base and tree.between(base, f) is None]  # noqa: E731
    if apart():
        for message in messages(bag, [name for name, kind in bag.kinds.items() if kind in TRANSFORMS]):
            tree.add(message.content)
            if not apart():
                break
    if missing := apart():
        raise ValueError(
            f'{bag.path} does not say where "{missing[0]}" sits on "{base}" (tf knows '
            f"{', '.join(tree.frames()) or 'no frames'}): record /tf_static too, or give the frame that stands for "
            "base_link as base_frame."
        )
    put = {frame: IDENTITY if frame == base else tree.between(base, frame) for frame in frames.values()}
    return {name: raised @ (put[frame] or IDENTITY) for name, frame in frames.items()}


def read(path: str | Path, spec: BagSpec = BagSpec()) -> Iterator[Recorded]:
    """Observations of a bag, in their order.

    Args:
        path: `.bag` file (ROS 1) or folder (ROS 2).
        spec: What to read, and as what.

    Raises:
        FileNotFoundError: If there is no bag.
        ValueError: If it is broken, or a topic, a calibration or a mount is missing or of no use.
    """
    with opened(path) as bag:
        sensors = _sensors(bag, spec)
        topics = [name for name in (sensors.points, *sensors.images, sensors.odometry) if name]
        tolerance = round(spec.tolerance * 1e9)
        for first, partners in sync.matched(messages(bag, topics), topics[0], topics[1:], tolerance):
            yield _recorded(spec, sensors, {**partners, first.topic: first}, first.time)


def _recorded(spec: BagSpec, sensors: _Sensors, held: dict[str, Message | None], time: int) -> Recorded:
    latest = max(message.time for message in held.values() if message)
    age = lambda message: (latest - message.time) * 1e-9 if message else 0.0  # noqa: E731
    lidar = held[sensors.points] if sensors.points else None
    cloud, found = np.zeros((0, 3)), None
    if lidar is not None and sensors.points:
        cloud = sensors.mounts[sensors.points].of(scan.points_of(lidar.content))
        found = scan.level(cloud) if spec.level else None
    levelled = found.put if found else IDENTITY
    cloud = levelled.of(cloud)
    scanned = scan.scan_of(spec.scan, cloud)
    shown = [held[name] for name in sensors.images]
    photos = tuple(camera.decoded(message.content) if message else None for message in shown)
    views = [
        camera.redrawn(spec.image, sensors.lenses[name], levelled @ sensors.mounts[name], photo)
        for name, photo in zip(sensors.images, photos, strict=True)
    ]
    rig: dict[str, Any] = {name: _stacked(views, name, shape) for name, shape in _RIG.items()}
    pose, twist = _odometry(spec, sensors, held)
    fields: dict[str, Any] = {
        "images": _stacked(views, "image", (*spec.image.shape, 3)),
        "image_valid": np.array([photo is not None for photo in photos], bool),
        "points": scanned.points, "point_valid": scanned.valid, "pose": pose, "twist": twist,
        "goal": np.zeros(2, np.float32), "image_age": np.array([age(m) for m in shown], np.float32),
        "point_age": np.float32(age(lidar)), "rig": CameraRig(**rig),
    }  # fmt: skip
    return Recorded(Observation(**fields), time * 1e-9, photos, cloud.astype(np.float32), found)


def _stacked(views: list[View], field: str, shape: tuple[int, ...]) -> np.ndarray:
    return np.stack([getattr(view, field) for view in views]) if views else np.zeros((0, *shape), np.float32)


def _odometry(spec: BagSpec, sensors: _Sensors, held: dict[str, Message | None]) -> tuple[np.ndarray, np.ndarray]:
    """Pose [3] and twist [2].

    Raises:
        ValueError: If it is that of another frame than base_link.
    """
    if sensors.odometry is None:
        return np.zeros(3, np.float32), np.zeros(2, np.float32)
    message = held[sensors.odometry]
    if message is None:
        return np.full(3, math.nan, np.float32), np.full(2, math.nan, np.float32)
    said = message.content
    child, base = said.child_frame_id.lstrip("/"), spec.base_frame.lstrip("/")
    if child and child != base:
        raise ValueError(f'{sensors.odometry} moves "{child}", not "{base}": give it as base_frame.')
    at, speed = said.pose.pose, said.twist.twist
    pose = np.array([at.position.x, at.position.y, transforms.yaw_of(at.orientation)], np.float32)
    return pose, np.array([speed.linear.x, speed.angular.z], np.float32)
