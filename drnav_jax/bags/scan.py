"""Clouds and scans as the points of an observation.

A cloud of more points than a scan holds is given as the LiDAR of a `ScanSpec` would see it: of all points whose bearing and
elevation from there fall to one of its beams, the nearest is that beam's return. So whatever LiDAR recorded it, the cloud
comes with the density and the field of view that the network was trained on.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from drnav_jax.bags.transforms import Rigid

CLOUD, LASER = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/LaserScan"
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # of sensor_msgs/PointField
_REACH = 15.0  # [m] of `level`: the ground is not flat for ever
_WITHIN = (0.4, 0.2, 0.1, 0.1)  # [m] of the plane so far, so that walls and kerbs drop out one after the other
_AGREEING = 100  # points


@dataclasses.dataclass(frozen=True)
class ScanSpec:
    """The LiDAR that an observation is given as; its fields are those of `sim.lidar`.

    Attributes:
        rings: Beams stacked in elevation.
        azimuths: Beams in one turn.
        elevation_min: Of the lowest ring [rad].
        elevation_max: Of the highest ring [rad].
        height: Above the ground [m].
        min_range: Nearer points are the robot's own body [m].
    """

    rings: int = 16
    azimuths: int = 180
    elevation_min: float = -math.radians(15.0)
    elevation_max: float = math.radians(15.0)
    height: float = 0.5
    min_range: float = 0.2

    def __post_init__(self) -> None:
        """Check counts, angles and lengths."""
        if self.rings < 2 or self.azimuths < 1:
            raise ValueError(f"rings must be >= 2 and azimuths >= 1, got {self.rings} and {self.azimuths}.")
        if not -math.pi / 2 < self.elevation_min < self.elevation_max < math.pi / 2:
            raise ValueError(
                "elevations must satisfy -pi/2 < elevation_min < elevation_max < pi/2 rad, "
                f"got {self.elevation_min} and {self.elevation_max}."
            )
        if self.height <= 0 or self.min_range < 0:
            raise ValueError(f"height must be > 0 m and min_range >= 0 m, got {self.height} and {self.min_range}.")

    @property
    def num_points(self) -> int:
        """P."""
        return self.rings * self.azimuths


class Scan(NamedTuple):
    """P points of an observation."""

    points: np.ndarray  # [P, 3] float32 in base_link [m]
    valid: np.ndarray  # [P] bool


def points_of(message: Any) -> Float[np.ndarray, "n 3"]:
    """Points of a PointCloud2 or LaserScan in the sensor's frame [m]; NaN where a beam gave no reading.

    A beam of a LaserScan that met nothing (+inf, or `range_max` and more) ends at `range_max` (REP 117).

    Raises:
        ValueError: If a cloud has no x, y, z, or fewer bytes than it says.
    """
    if hasattr(message, "ranges"):
        r = np.asarray(message.ranges, np.float64)
        r = np.where(r >= message.range_max, message.range_max, r)
        r = np.where(r >= message.range_min, r, np.nan)
        angle = message.angle_min + np.arange(len(r)) * message.angle_increment
        return np.stack([r * np.cos(angle), r * np.sin(angle), 0.0 * r], axis=-1)
    fields = {field.name: field for field in message.fields}
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        raise ValueError(f"a point cloud needs x, y and z, this one has {', '.join(fields) or 'no fields'}.")
    order = ">" if message.is_bigendian else "<"
    kind = np.dtype({
        "names": list("xyz"), "formats": [order + _TYPES[fields[name].datatype] for name in "xyz"],
        "offsets": [fields[name].offset for name in "xyz"], "itemsize": message.point_step,
    })  # fmt: skip
    raw, row = np.ascontiguousarray(message.data), message.point_step * message.width
    if message.height and (message.row_step < row or raw.size < message.row_step * message.height):
        raise ValueError(f"a cloud of {message.height} x {message.width} points has only {raw.size} bytes: it is cut off.")
    if not row * message.height:
        return np.zeros((0, 3))
    raw = raw[: message.row_step * message.height].reshape(message.height, -1)[:, :row]
    found = np.frombuffer(raw.tobytes(), kind)
    return np.stack([found[name].astype(np.float64) for name in "xyz"], axis=-1)


def scan_of(spec: ScanSpec, points: Float[np.ndarray, "n 3"]) -> Scan:
    """An observation's points (module docstring); with at most P of them all are kept.

    Args:
        spec: The LiDAR to give them as.
        points: In base_link, z up from the ground [m]; what is not finite is no reading.
    """
    points = points[np.isfinite(points).all(axis=1)]
    points = points[np.hypot(points[:, 0], points[:, 1]) >= spec.min_range]
    out, valid = np.zeros((spec.num_points, 3), np.float32), np.zeros(spec.num_points, bool)
    if len(points) <= spec.num_points:
        out[: len(points)], valid[: len(points)] = points, True
        return Scan(out, valid)
    rise, away = points[:, 2] - spec.height, np.hypot(points[:, 0], points[:, 1])
    step = (spec.elevation_max - spec.elevation_min) / (spec.rings - 1)
    ring = np.round((np.arctan2(rise, away) - spec.elevation_min) / step).astype(int)
    turn = (np.arctan2(points[:, 1], points[:, 0]) + np.pi) * (spec.azimuths / (2 * np.pi))
    beam = ring * spec.azimuths + np.minimum(turn.astype(int), spec.azimuths - 1)
    inside = (ring >= 0) & (ring < spec.rings)
    order = np.argsort(np.where(inside, -np.hypot(rise, away), -np.inf), kind="stable")  # the nearest are written last
    order = order[inside[order]]
    out[beam[order]], valid[beam[order]] = points[order], True
    return Scan(out, valid)


class Ground(NamedTuple):
    """A plane that was found under the robot, as seen from the frame it was looked for in."""

    put: Rigid  # from there to a frame whose z = 0 is the plane
    height: float  # [m] of the plane above the old z = 0 under the robot
    tilt: float  # [rad] of the plane


def level(points: Float[np.ndarray, "n 3"]) -> Ground | None:
    """The ground by trimmed least squares, z = a x + b y + c; None where too few points agree on one.

    Args:
        points: In a frame whose z is about up and about 0 on the ground [m].
    """
    sound = points[np.isfinite(points).all(axis=1)]
    near = sound[np.hypot(sound[:, 0], sound[:, 1]) < _REACH]
    plane = np.zeros(3)
    basis = np.column_stack([near[:, :2], np.ones(len(near))])
    for within in _WITHIN:
        agree = np.abs(near[:, 2] - basis @ plane) < within
        if agree.sum() < _AGREEING:
            return None
        plane = np.linalg.lstsq(basis[agree], near[agree, 2], rcond=None)[0]
    up = np.array([-plane[0], -plane[1], 1.0]) / math.sqrt(1.0 + plane[0] ** 2 + plane[1] ** 2)
    ahead = np.array([1.0, 0.0, 0.0]) - up[0] * up
    ahead /= np.linalg.norm(ahead)
    turn = np.stack([ahead, np.cross(up, ahead), up])
    return Ground(Rigid(turn, -turn @ np.array([0.0, 0.0, plane[2]])), float(plane[2]), float(np.arccos(up[2])))
