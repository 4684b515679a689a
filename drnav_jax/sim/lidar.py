"""A spinning LiDAR, ray-cast against a world.

The sensor sits upright at the `base_link` origin, `height` above the ground. A ray of azimuth a
and elevation e that has run the horizontal distance s is at height and range

    z(s) = height + s tan(e),    r = s / cos(e)                                               (1)

so everything is done in s. An upright obstacle covers one interval of s per azimuth (its
footprint, the same for all rings) and one per ring (its height, the same for all azimuths); a
ray meets it where the two overlap. A grid map has one wall distance per azimuth (`field.py`): a
ray meets that wall, passes over it, or reaches the ground before it.

A scan is ring-major: point `i * azimuths + j` is of ring i (0 = lowest) at the azimuth
-pi + (j + 1/2) 2 pi / azimuths.
"""

import dataclasses
import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from drnav_jax.grids import once
from drnav_jax.sim.field import wall_distance
from drnav_jax.types import Scalar
from drnav_jax.worlds.world import WALL_HEIGHT, World

HIT_MARGIN = 0.01  # [m] a return reads at most max_range less this: a beam at max_range met nothing

_f32 = functools.partial(jnp.asarray, dtype=jnp.float32)


@dataclasses.dataclass(frozen=True)
class LidarSpec:
    """The beams of a LiDAR.

    Attributes:
        rings: Beams stacked in elevation.
        azimuths: Beams in one turn.
        elevation_min: Elevation of the lowest ring [rad].
        elevation_max: Elevation of the highest ring [rad].
    """

    rings: int = 16
    azimuths: int = 180
    elevation_min: float = -math.radians(15.0)
    elevation_max: float = math.radians(15.0)

    def __post_init__(self) -> None:
        """Check counts and angles."""
        if min(self.rings, self.azimuths) < 1:
            raise ValueError(
                f"rings and azimuths must be >= 1, got {self.rings} and {self.azimuths}."
            )
        if not -math.pi / 2 < self.elevation_min <= self.elevation_max < math.pi / 2:
            raise ValueError(
                "elevations must satisfy -pi/2 < elevation_min <= elevation_max < pi/2 rad, "
                f"got {self.elevation_min} and {self.elevation_max}."
            )

    @property
    def num_points(self) -> int:
        """P, points of a scan."""
        return self.rings * self.azimuths

    @property
    def elevations(self) -> np.ndarray:
        """Elevation of each ring [rad], `[rings]`, lowest first."""
        return np.linspace(self.elevation_min, self.elevation_max, self.rings)

    @property
    def bearings(self) -> np.ndarray:
        """Azimuth of each beam in `base_link` [rad], `[azimuths]`."""
        return -np.pi + (np.arange(self.azimuths) + 0.5) * (2 * np.pi / self.azimuths)


class LidarParams(NamedTuple):
    """How far and how well the LiDAR measures."""

    max_range: Scalar = 12.0  # [] [m]
    height: Scalar = 0.5  # [] above the ground, below the top of a grid map's walls [m]
    noise_std: Scalar = 0.02  # [] standard deviation of a measured range [m]
    dropout: Scalar = 0.01  # [] probability that a beam gives no reading


class _Spans(NamedTuple):
    """Where rays enter and leave upright obstacles, in horizontal distance; inf = never."""

    entry: Array  # [N, A] through the side
    leave: Array  # [N, A]
    within: Array  # [N] whether the sensor is in the footprint
    low: Array  # [N] bottom, relative to the sensor
    high: Array  # [N] top


def _box_spans(boxes: Array, height: Array, pose: Array, dx: Array, dy: Array) -> _Spans:
    c, s = jnp.cos(boxes[:, 2]), jnp.sin(boxes[:, 2])
    rx, ry = pose[0] - boxes[:, 0], pose[1] - boxes[:, 1]
    entry, leave, within = [], [], []
    for axis_x, axis_y, half in ((c, s, boxes[:, 3]), (-s, c, boxes[:, 4])):
        at = axis_x * rx + axis_y * ry
        along = axis_x[:, None] * dx[None] + axis_y[:, None] * dy[None]
        inverse = 1 / jnp.where(jnp.abs(along) < 1e-9, 1e-9, along)
        a, b = (-half - at)[:, None] * inverse, (half - at)[:, None] * inverse
        entry.append(jnp.minimum(a, b))
        leave.append(jnp.maximum(a, b))
        within.append(jnp.abs(at) < half)
    return _Spans(
        entry=jnp.maximum(*entry),
        leave=jnp.minimum(*leave),
        within=within[0] & within[1],
        low=boxes[:, 5] - height,
        high=boxes[:, 6] - height,
    )


def _cylinder_spans(cylinders: Array, height: Array, pose: Array, dx: Array, dy: Array) -> _Spans:
    rx, ry, r = cylinders[:, 0] - pose[0], cylinders[:, 1] - pose[1], cylinders[:, 2]
    along = rx[:, None] * dx[None] + ry[:, None] * dy[None]
    aside = jnp.abs(rx[:, None] * dy[None] - ry[:, None] * dx[None])
    # (r - a)(r + a) and not r^2 - a^2: a ray that just touches keeps its digits.
    half = jnp.sqrt(jnp.maximum((r[:, None] - aside) * (r[:, None] + aside), 0.0))
    return _Spans(
        entry=along - half,
        leave=along + half,
        within=rx * rx + ry * ry < r * r,
        low=cylinders[:, 3] - height,
        high=cylinders[:, 4] - height,
    )


def _meet(spans: _Spans, slope: Array) -> Array:
    """Horizontal distance `[rings, A]` to the first obstacle on rays of these slopes; inf = none."""
    a, b = spans.low[:, None] / slope[None], spans.high[:, None] / slope[None]
    above, below = jnp.minimum(a, b), jnp.maximum(a, b)
    # Inside an obstacle the ray meets its far side. The nearest of several needs no pairs: it is
    # the nearest exit through a side (per azimuth) or through a top or bottom (per ring).
    within = (spans.within & (spans.low < 0) & (spans.high > 0))[:, None]
    sides = jnp.min(jnp.where(within, spans.leave, jnp.inf), axis=0)
    caps = jnp.min(jnp.where(within, below, jnp.inf), axis=0)
    # What lies behind the sensor, in either sense, is taken out: then an overlap is a hit ahead.
    entry = jnp.where((spans.leave <= 0) | within, jnp.inf, spans.entry)
    above = jnp.where(below <= 0, jnp.inf, above)

    def nearer(n: Array, met: Array) -> Array:
        first = jnp.maximum(entry[n][None, :], above[n][:, None])
        last = jnp.minimum(spans.leave[n][None, :], below[n][:, None])
        return jnp.minimum(met, jnp.where(first < last, first, jnp.inf))

    # One obstacle at a time, all rays at once: the ranges stay in the first-level cache.
    met = jnp.minimum(sides[None, :], caps[:, None])
    return jnp.maximum(jax.lax.fori_loop(0, entry.shape[0], nearer, met), 0.0)


@functools.partial(jax.jit, static_argnames="spec")
def cast(
    spec: LidarSpec, params: LidarParams, world: World, pose: Float[Array, "3"]
) -> Float[Array, "rings azimuths"]:
    """Exact ranges to the first surface (obstacle, wall or ground), without noise.

    A sensor inside an obstacle sees the obstacle's far side, as in MuJoCo.

    Args:
        spec: The beams.
        params: Range and mounting height.
        world: What can be met, besides the ground at z = 0.
        pose: x, y, yaw of `base_link` in the world's frame [m, rad].

    Returns:
        Ranges [m], `[rings, azimuths]`; inf where nothing is met within `max_range`.
    """
    world, height = jax.tree.map(_f32, world), _f32(params.height)
    slope, cos = np.tan(spec.elevations), np.cos(spec.elevations)
    slope, cos = _f32(np.where(np.abs(slope) < 1e-9, 1e-9, slope)), _f32(cos)
    reach = _f32(params.max_range) * cos
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    along_x, along_y = _f32(np.cos(spec.bearings)), _f32(np.sin(spec.bearings))
    dx, dy = c * along_x - s * along_y, s * along_x + c * along_y

    met = jnp.where(slope < 0, -height / slope, jnp.inf)[:, None]
    kinds = ((world.boxes, _box_spans), (world.cylinders, _cylinder_spans))
    spans = [of(rows, height, pose, dx, dy) for rows, of in kinds if rows.shape[0]]
    if spans:
        every = jax.tree.map(lambda *parts: jnp.concatenate(parts), *spans)
        met = jnp.minimum(met, _meet(every, slope))
    if world.field.values.size:
        wall = wall_distance(world.field, pose[:2], dx, dy, jnp.max(reach))[None, :]
        over = height + wall * slope[:, None] > WALL_HEIGHT
        met = jnp.minimum(met, jnp.where(over, jnp.inf, wall))
    met = jnp.broadcast_to(met, (spec.rings, spec.azimuths))
    return jnp.where(met <= reach[:, None], met / cos[:, None], jnp.inf)


def _noise(key: PRNGKeyArray, shape: tuple[int, int]) -> tuple[Array, Array]:
    """Standard normal and uniform numbers, made of the two halves of one random word each.

    The normal goes to 4.2 standard deviations and the uniform has steps of 1.5e-5, which is
    enough for a sensor and half the price of drawing both in full.
    """
    bits = jax.random.bits(key, shape, jnp.uint32)
    half = (bits >> 16).astype(jnp.float32)
    normal = math.sqrt(2.0) * jax.scipy.special.erfinv((half + 0.5) * 2.0**-15 - 1.0)
    return normal, (bits & 0xFFFF).astype(jnp.float32) * 2.0**-16


@functools.partial(jax.jit, static_argnames="spec")
def scan(
    spec: LidarSpec,
    params: LidarParams,
    world: World,
    pose: Float[Array, "3"],
    key: PRNGKeyArray,
) -> tuple[Float[Array, "points 3"], Bool[Array, " points"]]:
    """One turn of the LiDAR, as a sensor reports it.

    Ranges have Gaussian noise. A beam that meets nothing is a valid point at `max_range` from the
    sensor (to rounding); a return reads at most `max_range - HIT_MARGIN`. A beam that drops out is
    invalid, its point lies at the sensor.

    Args:
        spec: The beams.
        params: Range, mounting height, noise and dropout.
        world: What can be met.
        pose: x, y, yaw of `base_link` in the world's frame [m, rad].
        key: Randomness of this scan.

    Returns:
        Points in `base_link`, z up from the ground [m], `[rings * azimuths, 3]`, ring-major; and
        which of them are valid.
    """
    ranges = cast(spec, params, world, pose)
    max_range = _f32(params.max_range)
    normal, uniform = _noise(key, (spec.rings, spec.azimuths))
    measured = ranges + _f32(params.noise_std) * normal
    measured = jnp.clip(measured, 0.0, max_range - HIT_MARGIN)
    measured = jnp.where(jnp.isinf(ranges), max_range, measured)
    valid = uniform >= _f32(params.dropout)
    measured = jnp.where(valid, measured, 0.0).reshape(-1, 1)

    e, a = np.meshgrid(spec.elevations, spec.bearings, indexing="ij")
    beams = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)
    sensor = jnp.stack([_f32(0.0), _f32(0.0), _f32(params.height)])
    # Scaling constant beams is 8 times as fast here as stacking three coordinates.
    # Once: each use of a point would draw its noise anew.
    return once((measured * _f32(beams.reshape(-1, 3)) + sensor[None, :], valid.reshape(-1)))
