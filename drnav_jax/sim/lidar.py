"""A spinning LiDAR, ray-cast against a world.

The sensor sits upright at the `base_link` origin, `height` above the ground. A ray of azimuth a
and elevation e that has run the horizontal distance s is at height and range

    z(s) = height + s tan(e),    r = s / cos(e)                                               (1)

so everything is done in s. An upright obstacle covers one interval of s per azimuth (its
footprint, the same for all rings) and one per ring (its height, the same for all azimuths); a
ray meets it where the two overlap. A grid map has one wall distance per azimuth (`field.py`): a
ray meets that wall, passes over it, or reaches the ground before it.

Of a solid's material (`worlds.materials`) counts its extinction k: a beam comes out of it, after a way l in it, with

    P = exp(-k l)                                                                             (2)

So it ends at opaque solids (k = inf), passes glass (k = 0), and returns from plants at a random depth or passes them too.
Over a drop there is no ground: the beam goes on to the drop's floor or far wall. Paint and floors are the ground.

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
from drnav_jax.sim.spans import DROPS, OPAQUE, VEILS, Spans, box_spans, cylinder_spans, down_drops, each
from drnav_jax.types import Scalar
from drnav_jax.worlds.materials import EXTINCTION
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


def _opaque(spans: Spans, opaque: Array, slope: Array, reach: Array) -> Array:
    """Horizontal distance `[rings, A]` to the first opaque solid on rays of these slopes; inf = none."""
    a, b = spans.low[:, None] / slope[None], spans.high[:, None] / slope[None]
    above, below = jnp.minimum(a, b), jnp.maximum(a, b)
    # Inside an obstacle the ray meets its far side. The nearest of several needs no pairs: it is
    # the nearest exit through a side (per azimuth) or through a top or bottom (per ring).
    within = (opaque & spans.within & (spans.low < 0) & (spans.high > 0))[:, None]
    sides = jnp.min(jnp.where(within, spans.leave, jnp.inf), axis=0)
    caps = jnp.min(jnp.where(within, below, jnp.inf), axis=0)
    # What lies behind the sensor, in either sense, is taken out: then an overlap is a hit ahead.
    entry = jnp.where((spans.leave <= 0) | within, jnp.inf, spans.entry)
    above = jnp.where(below <= 0, jnp.inf, above)

    def nearer(n: Array, met: Array) -> Array:
        first = jnp.maximum(entry[n][None, :], above[n][:, None])
        last = jnp.minimum(spans.leave[n][None, :], below[n][:, None])
        return jnp.minimum(met, jnp.where(first < last, first, jnp.inf))

    met = jnp.minimum(sides[None, :], caps[:, None])
    return jnp.maximum(each(opaque & (spans.near <= reach), nearer, met, group=4), 0.0)


def _veiled(
    spans: Spans, veils: Array, extinction: Array, slope: Array, cos: Array, reach: Array, met: Array, word: Array | None
) -> Array:
    """`met` `[rings, A]`, or less where a beam returns from a veil before it.

    With `word` (random, `[rings, A]`) a beam runs an exponential length into each plant, of its own: so the first of
    all returns is distributed as eq. 2 says, whatever plants overlap. Without, it returns from every veil's surface.
    """

    def nearer(n: Array, met: Array) -> Array:
        a, b = spans.low[n] / slope, spans.high[n] / slope
        first = jnp.maximum(spans.entry[n][None, :], jnp.minimum(a, b)[:, None])
        last = jnp.minimum(spans.leave[n][None, :], jnp.maximum(a, b)[:, None])
        at = first = jnp.maximum(first, 0.0)
        if word is not None:
            length = -jnp.log(_uniform(word, n)) / jnp.maximum(extinction[n], 1e-9)
            at = first + length * cos[:, None]
        return jnp.where((at < last) & (first < last), jnp.minimum(met, at), met)

    return each(veils & (spans.near <= reach), nearer, met)


def _uniform(word: Array, n: Array) -> Array:
    """A number in (0, 1) for each random word and a solid's index: the word's bits, mixed anew for each index."""
    bits = word ^ ((n.astype(jnp.uint32) + 1) * jnp.uint32(0x9E3779B9))
    bits = (bits ^ (bits >> 16)) * jnp.uint32(0x85EBCA6B)
    bits = (bits ^ (bits >> 13)) * jnp.uint32(0xC2B2AE35)
    bits = bits ^ (bits >> 16)
    return ((bits >> 9).astype(jnp.float32) + 0.5) * 2.0**-23


def _trace(
    spec: LidarSpec, params: LidarParams, world: World, pose: Array, *, veils: bool, word: Array | None = None
) -> Array:
    """Ranges `[rings, azimuths]` as `cast`; with `word` plants return beams at random."""
    scenery, height = world.scenery, _f32(params.height)
    slope, cos = np.tan(spec.elevations), np.cos(spec.elevations)
    slope, cos = _f32(np.where(np.abs(slope) < 1e-9, 1e-9, slope)), _f32(cos)
    reach, shape = _f32(params.max_range) * cos, (spec.rings, spec.azimuths)
    far = jnp.max(reach)  # horizontally
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    along_x, along_y = _f32(np.cos(spec.bearings)), _f32(np.sin(spec.bearings))
    dx, dy = c * along_x - s * along_y, s * along_x + c * along_y

    ground = jnp.where(slope < 0, -height / slope, jnp.inf)[:, None]
    ceiling = jnp.where(slope > 0, (_f32(scenery.ceiling) - height) / slope, jnp.inf)[:, None]
    rows, looks = (world.boxes, world.cylinders), (world.box_surfaces, world.cylinder_surfaces)
    spans_of = (box_spans, cylinder_spans)
    kinds = [(_f32(r), a.material, of) for r, a, of in zip(rows, looks, spans_of, strict=True) if len(r)]
    if not kinds:
        met = jnp.minimum(ground, ceiling)
    else:
        spans = jax.tree.map(lambda *parts: jnp.concatenate(parts), *(of(r, height, pose, dx, dy) for r, _, of in kinds))
        material = jnp.concatenate([jnp.asarray(m, jnp.int32) for _, m, _ in kinds])
        opaque, veiling, drops = (jnp.asarray(kind)[material] for kind in (OPAQUE, VEILS, DROPS))

        def floor(n: Array) -> Array:
            return jnp.maximum(spans.low[n] / slope, spans.high[n] / slope)[:, None]

        def footprint(n: Array) -> tuple[Array, Array]:
            return spans.entry[n][None, :], spans.leave[n][None, :]

        end, _ = down_drops(jnp.broadcast_to(ground, shape), drops, footprint, floor)
        met = jnp.minimum(jnp.minimum(end, ceiling), _opaque(spans, opaque, slope, far))
        if veils:
            met = _veiled(spans, veiling, jnp.asarray(EXTINCTION)[material], slope, cos, far, met, word)
    if world.field.values.size:
        wall = wall_distance(jax.tree.map(_f32, world.field), pose[:2], dx, dy, far)[None, :]
        over = height + wall * slope[:, None] > WALL_HEIGHT
        met = jnp.minimum(met, jnp.where(over, jnp.inf, wall))
    met = jnp.broadcast_to(met, shape)
    return jnp.where(met <= reach[:, None], met / cos[:, None], jnp.inf)


@functools.partial(jax.jit, static_argnames=("spec", "veils"))
def cast(
    spec: LidarSpec, params: LidarParams, world: World, pose: Float[Array, "3"], *, veils: bool = False
) -> Float[Array, "rings azimuths"]:
    """Exact ranges to the first opaque surface (obstacle, wall, ceiling, ground or what is below a drop), without noise.

    A sensor inside an obstacle sees the obstacle's far side, as in MuJoCo.

    Args:
        spec: The beams.
        params: Range and mounting height.
        world: What can be met, besides the ground at z = 0.
        pose: x, y, yaw of `base_link` in the world's frame [m, rad].
        veils: Whether panes and plants count as if they were opaque; otherwise the rays pass them.

    Returns:
        Ranges [m], `[rings, azimuths]`; inf where nothing is met within `max_range`.
    """
    return _trace(spec, params, world, pose, veils=veils)


def _noise(word: Array) -> tuple[Array, Array]:
    """Standard normal and uniform numbers, made of the two halves of one random word each.

    The normal goes to 4.2 standard deviations and the uniform has steps of 1.5e-5, which is
    enough for a sensor and half the price of drawing both in full.
    """
    half = (word >> 16).astype(jnp.float32)
    normal = math.sqrt(2.0) * jax.scipy.special.erfinv((half + 0.5) * 2.0**-15 - 1.0)
    return normal, (word & 0xFFFF).astype(jnp.float32) * 2.0**-16


@functools.partial(jax.jit, static_argnames="spec")
def scan(
    spec: LidarSpec,
    params: LidarParams,
    world: World,
    pose: Float[Array, "3"],
    key: PRNGKeyArray,
) -> tuple[Float[Array, "points 3"], Bool[Array, " points"]]:
    """One turn of the LiDAR, as a sensor reports it.

    Beams pass glass, and return from plants at random depths (eq. 2). Ranges have Gaussian noise. A beam that meets
    nothing is a valid point at `max_range` from the sensor (to rounding); a return reads at most `max_range -
    HIT_MARGIN`. A beam that drops out is invalid, its point lies at the sensor.

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
    word = jax.random.bits(key, (spec.rings, spec.azimuths), jnp.uint32)
    ranges = _trace(spec, params, world, pose, veils=True, word=word)
    max_range = _f32(params.max_range)
    normal, uniform = _noise(word)
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
