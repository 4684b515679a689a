"""Containers that every layer shares: Specs (static), Params (traced, swept), data (traced, carried).

Frames follow REP-103/105: x forward, y left, yaw counter-clockwise; `odom` is the fixed frame, `base_link` the robot.
Units are metres, seconds and radians. A grid is `[H, W]`: row = y, column = x, row 0 at the smallest y.
"""

import dataclasses
import math
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

Scalar: TypeAlias = int | float | Array


@dataclasses.dataclass(frozen=True)
class GridSpec:
    """The rolling window of the local map, aligned with `odom`.

    Attributes:
        shape: (H, W) cells; row = +y, column = +x.
        resolution: Edge of a cell [m].
        stride: The window moves by multiples of this many cells, so that coarser grids laid over it stay on one
            lattice and nothing is moved in most ticks.
    """

    shape: tuple[int, int] = (256, 256)
    resolution: float = 0.1
    stride: int = 8

    def __post_init__(self) -> None:
        """Check sizes."""
        if self.resolution <= 0:
            raise ValueError(f"resolution must be > 0 m, got {self.resolution}.")
        if self.stride < 1:
            raise ValueError(f"stride must be >= 1 cell, got {self.stride}.")
        if min(self.shape) < 8 or any(n % 2 for n in self.shape):
            raise ValueError(f"shape must be even numbers of cells >= 8, got {self.shape}.")


class RobotParams(NamedTuple):
    """A disc robot that drives like a unicycle."""

    radius: Scalar = 0.25  # [] footprint radius [m]
    v_min: Scalar = -0.2  # [] slowest (backing up) speed [m/s]
    v_max: Scalar = 1.0  # [] fastest speed [m/s]
    w_max: Scalar = 1.5  # [] fastest turn rate, both ways [rad/s]
    a_max: Scalar = 2.5  # [] linear acceleration, both ways [m/s^2]
    alpha_max: Scalar = 3.2  # [] angular acceleration, both ways [rad/s^2]


class GridMap(NamedTuple):
    """Values on a grid and where that grid lies."""

    values: Array  # [H, W]
    origin: Array  # [2] world x, y of the outer corner of cell (0, 0) [m]
    resolution: Scalar  # [] edge of a cell [m]


@dataclasses.dataclass(frozen=True)
class BevSpec:
    """The bird's-eye grid in `base_link` on which frames are labelled and the network predicts: row = +y, column = +x.

    Attributes:
        shape: (h, w) cells.
        resolution: Edge of a cell [m].
        ahead: How far the grid's centre lies in front of the robot [m].
    """

    shape: tuple[int, int] = (64, 64)
    resolution: float = 0.2
    ahead: float = 3.2

    def __post_init__(self) -> None:
        """Check sizes."""
        if min(self.shape) < 1 or self.resolution <= 0:
            raise ValueError(f"shape must be >= 1 cell and resolution > 0 m, got {self.shape} and {self.resolution}.")

    @property
    def origin(self) -> tuple[float, float]:
        """base_link x, y of the outer corner of cell (0, 0) [m]."""
        h, w = self.shape
        return self.ahead - w * self.resolution / 2, -h * self.resolution / 2


@dataclasses.dataclass(frozen=True)
class Mount:
    """One pinhole camera on the robot: where it sits in `base_link` and where it looks.

    Attributes:
        x: Forward [m].
        y: To the left [m].
        z: Above the ground [m].
        yaw: To the left of straight ahead [rad].
        pitch: Downwards [rad].
        roll: About the optical axis [rad].
        fov: Horizontal field of view [rad].
    """

    x: float = 0.1
    y: float = 0.0
    z: float = 0.5
    yaw: float = 0.0
    pitch: float = 0.0
    roll: float = 0.0
    fov: float = math.pi / 2

    def __post_init__(self) -> None:
        """Check the field of view and the height."""
        if not 0 < self.fov < math.pi:
            raise ValueError(f"fov must lie in (0, pi) rad, got {self.fov}.")
        if self.z <= 0:
            raise ValueError(f"a camera sits above the ground: z must be > 0 m, got {self.z}.")


FRONT_LEFT_RIGHT = (Mount(), Mount(x=0.0, y=0.1, yaw=math.pi / 2), Mount(x=0.0, y=-0.1, yaw=-math.pi / 2))


@dataclasses.dataclass(frozen=True)
class RigSpec:
    """The cameras of a robot, and the size of their images.

    Attributes:
        mounts: N cameras; default front, left and right.
        shape: (h, w) of an image [pixels].
    """

    mounts: tuple[Mount, ...] = FRONT_LEFT_RIGHT
    shape: tuple[int, int] = (96, 96)

    def __post_init__(self) -> None:
        """Check sizes."""
        if min(self.shape) < 1:
            raise ValueError(f"an image must be >= 1 pixel wide and high, got {self.shape}.")


class CameraRig(NamedTuple):
    """Geometry of N cameras as arrays. Optical frame: x right, y down, z along the view (REP-103 `_optical`)."""

    focal: Array  # [N, 2] focal lengths fx, fy [pixels]
    centre: Array  # [N, 2] principal point cx, cy; the outer corner of the first pixel is (0, 0) [pixels]
    position: Array  # [N, 3] of the optical centre in base_link [m]
    rotation: Array  # [N, 3, 3] takes directions from the optical frame to base_link


def rig_of(spec: RigSpec) -> CameraRig:
    """The arrays (float32) of a rig with square pixels and the principal point in the middle."""
    h, w = spec.shape
    focal, rotation = [], []
    for mount in spec.mounts:
        focal.append([0.5 * w / math.tan(mount.fov / 2)] * 2)
        cy, sy, cp, sp = math.cos(mount.yaw), math.sin(mount.yaw), math.cos(mount.pitch), math.sin(mount.pitch)
        cr, sr = math.cos(mount.roll), math.sin(mount.roll)
        yaw = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        pitch = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        roll = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
        optical = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # columns: right, down, along the view
        rotation.append(yaw @ pitch @ roll @ optical)
    count = len(spec.mounts)
    return CameraRig(
        focal=jnp.asarray(np.reshape(focal, (count, 2)), jnp.float32),
        centre=jnp.asarray(np.tile([[0.5 * w, 0.5 * h]], (count, 1)), jnp.float32),
        position=jnp.asarray(np.reshape([[m.x, m.y, m.z] for m in spec.mounts], (count, 3)), jnp.float32),
        rotation=jnp.asarray(np.reshape(rotation, (count, 3, 3)), jnp.float32),
    )


class Observation(NamedTuple):
    """What the sensors say at one tick. Missing sensors are masks, never exceptions.

    A point at or beyond the sensor's maximum range is a beam that met nothing (it clears, it marks nothing);
    a beam that gave no reading at all (dropout) is a point with `point_valid` False.
    """

    images: Array  # [N, h, w, 3] float32 in 0..1
    image_valid: Array  # [N] bool
    points: Array  # [P, 3] in base_link (z up from the ground) [m]
    point_valid: Array  # [P] bool
    pose: Array  # [3] x, y, yaw in odom
    twist: Array  # [2] measured v [m/s], omega [rad/s]
    goal: Array  # [2] x, y in odom [m]
    image_age: Array  # [N] time since capture [s], or [0]: none; what is too old counts as missing (`NavParams.max_age`)
    point_age: Array  # [] time since the scan [s]
    rig: CameraRig  # where the cameras sit and look


NO_CAMERAS = RigSpec(mounts=())


def empty_observation(num_points: int, rig: RigSpec = NO_CAMERAS) -> Observation:
    """An observation of the given sizes in which every sensor is missing.

    Args:
        num_points: P, number of LiDAR points.
        rig: The cameras.

    Raises:
        ValueError: If a size is negative.
    """
    if num_points < 0:
        raise ValueError(f"num_points must be >= 0, got {num_points}.")
    num_cameras, image_shape = len(rig.mounts), rig.shape
    return Observation(
        images=jnp.zeros((num_cameras, *image_shape, 3), jnp.float32),
        image_valid=jnp.zeros(num_cameras, bool),
        points=jnp.zeros((num_points, 3), jnp.float32),
        point_valid=jnp.zeros(num_points, bool),
        pose=jnp.zeros(3, jnp.float32),
        twist=jnp.zeros(2, jnp.float32),
        goal=jnp.zeros(2, jnp.float32),
        image_age=jnp.zeros(num_cameras, jnp.float32),
        point_age=jnp.zeros((), jnp.float32),
        rig=rig_of(rig),
    )


def sane(
    seen: Observation, pose: Float[Array, "3"], twist: Float[Array, "2"], max_age: Scalar
) -> tuple[Observation, Bool[Array, ""]]:
    """An observation without broken values, and whether its pose can be used.

    Args:
        seen: As it came; what is not finite counts as missing.
        pose: What stands in for a broken pose; then no point is valid, since nobody knows where it is.
        twist: What stands in for broken speeds.
        max_age: Images and scans older than this count as missing [s].
    """
    pose_ok = jnp.all(jnp.isfinite(seen.pose))
    pose = jnp.where(pose_ok, seen.pose, pose)
    valid = seen.point_valid & jnp.all(jnp.isfinite(seen.points), axis=-1) & pose_ok & (seen.point_age <= max_age)
    image_ok = jnp.all(jnp.isfinite(seen.images), axis=(1, 2, 3))
    if seen.image_age.shape == image_ok.shape:  # who gives images and no ages has fresh ones
        image_ok &= seen.image_age <= max_age
    return seen._replace(
        pose=pose,
        twist=jnp.where(jnp.all(jnp.isfinite(seen.twist)), seen.twist, twist),
        points=jnp.where(valid[:, None], seen.points, 0.0),
        point_valid=valid,
        images=jnp.where(image_ok[:, None, None, None], seen.images, 0.0),
        image_valid=seen.image_valid & image_ok,
        goal=jnp.where(jnp.all(jnp.isfinite(seen.goal)), seen.goal, pose[:2]),
    ), pose_ok


class LocalMap(NamedTuple):
    """What a predictor may know of the surroundings: the rolling window as the filter believes it."""

    occupancy: Float[Array, "H W"]  # log-odds of being occupied [nat]; 0 where never seen
    seen: Bool[Array, "H W"]  # observed at least once since the window holds the cell
    origin: Float[Array, "2"]  # odom x, y of the outer corner of cell (0, 0) [m]
    resolution: Scalar  # [] [m / cell]
    closed: Array | None = None  # [H, W] bool, what stops a robot as all sensors say; None: what is occupied does


class Evidence(NamedTuple):
    """Per-cell dead-end evidence on the rolling window (`Observation -> Evidence` is what a predictor does)."""

    p_dead: Float[Array, "H W"]  # probability that the cell is a dead end
    confidence: Float[Array, "H W"]  # 0 = no evidence here (the belief is left alone) .. 1 = full weight
    blocked: Array | None = None  # [H, W] log-odds that something stops a robot [nat], 0 = no opinion; None: none at all
    repeats: Scalar | None = None  # [] share by which it stands for earlier evidence too; None: 0, frames are independent


class Command(NamedTuple):
    """Velocity command; finite and within the limits, always."""

    v: Float[Array, ""]  # [m/s]
    omega: Float[Array, ""]  # [rad/s]
