"""Containers that every layer shares: Specs (static), Params (traced, swept), data (traced, carried).

Frames follow REP-103/105: x forward, y left, yaw counter-clockwise; `odom` is the fixed frame, `base_link` the robot.
Units are metres, seconds and radians. A grid is `[H, W]`: row = y, column = x, row 0 at the smallest y.
"""

import dataclasses
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
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
    image_age: Array  # [N] time since capture [s]
    point_age: Array  # [] time since the scan [s]


def empty_observation(num_points: int, num_cameras: int = 0, image_shape: tuple[int, int] = (96, 96)) -> Observation:
    """An observation of the given sizes in which every sensor is missing.

    Args:
        num_points: P, number of LiDAR points.
        num_cameras: N, number of cameras.
        image_shape: (h, w) of an image.

    Raises:
        ValueError: If a size is negative.
    """
    if min(num_points, num_cameras, *image_shape) < 0:
        raise ValueError(f"sizes must be >= 0, got {num_points} points, {num_cameras} cameras, images {image_shape}.")
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
    )


class LocalMap(NamedTuple):
    """What a predictor may know of the surroundings: the rolling window as the filter believes it."""

    occupancy: Float[Array, "H W"]  # log-odds of being occupied [nat]; 0 where never seen
    seen: Bool[Array, "H W"]  # observed at least once since the window holds the cell
    origin: Float[Array, "2"]  # odom x, y of the outer corner of cell (0, 0) [m]
    resolution: Scalar  # [] [m / cell]


class Evidence(NamedTuple):
    """Per-cell dead-end evidence on the rolling window (`Observation -> Evidence` is what a predictor does)."""

    p_dead: Float[Array, "H W"]  # probability that the cell is a dead end
    confidence: Float[Array, "H W"]  # 0 = no evidence here (the belief is left alone) .. 1 = full weight


class Command(NamedTuple):
    """Velocity command; finite and within the limits, always."""

    v: Float[Array, ""]  # [m/s]
    omega: Float[Array, ""]  # [rad/s]
