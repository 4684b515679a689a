"""Occupancy of the rolling window from LiDAR scans: log-odds of hits and ray-cleared cells.

The inverse sensor model of OctoMap (Hornung et al. 2013, eq. 2-4), once per cell and scan:

    l(c) <- clip(l(c) + hit,  l_min, l_max)    a return in the height band lies in c             (a)
    l(c) <- clip(l(c) + miss, l_min, l_max)    c was crossed by rays and holds no return         (b)
    l(c) <- l(c)                               otherwise; a cell never touched stays unknown     (c)

Crossed cells come from a polar profile, not from walking along each ray: a scan is cut in
`num_bearings` bins around the robot, bin j centred on -pi + (j + 1/2) 2 pi / num_bearings, which is
where the default LiDAR has its beams. A bin is clear up to its nearest in-band return; without one,
as far as any of its rays was seen to go within the band. A bin without any valid point (dropout,
which is not "no return") is clear nowhere. A cell is crossed if it lies nearer than the clear range
of its own bin *and of both neighbours*, less a margin: between two beams a wall seen at a grazing
angle is nearer than the farther beam says, and the wall would be eaten away from its far end.

The map is flat. Rays that rise out of the band clear only up to there. Close to the robot the rays
pass over low obstacles, so within `blind_range` what is held to be occupied is not cleared.
"""

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drnav_jax import geometry, grids
from drnav_jax.types import Scalar

# Added to the ranges of rays without an in-band return, so that one scatter-min finds both the
# nearest return and, where there is none, the farthest reach. Far above any range, and small
# enough that float32 still resolves 0.1 mm.
_NO_RETURN = 1000.0
_RANGE_TOLERANCE = 1e-3  # [m] rounding of a point computed as origin + max_range * direction


class OccupancyParams(NamedTuple):
    """Sensor model of the occupancy belief; the log-odds are OctoMap's defaults."""

    hit: Scalar = math.log(0.7 / 0.3)  # [] added where a return lies [nat]
    miss: Scalar = math.log(0.4 / 0.6)  # [] added where rays passed [nat]
    l_min: Scalar = math.log(0.1192 / 0.8808)  # [] saturation, free [nat]
    l_max: Scalar = math.log(0.971 / 0.029)  # [] saturation, occupied [nat]
    z_min: Scalar = 0.1  # [] lower end of the height band [m]; below it is ground
    z_max: Scalar = 1.2  # [] upper end of the height band [m]; above it the robot passes under
    sensor_z: Scalar = 0.5  # [] height of the LiDAR above the ground, over base_link [m]
    max_range: Scalar = 12.0  # [] a point this far from the LiDAR is a beam that met nothing [m]
    min_range: Scalar = 0.15  # [] nearer points are the robot itself and count as invalid [m]
    min_share: Scalar = 0.15  # [] fewer returns than this share of a neighbouring cell's make no hit
    margin: Scalar = 0.7  # [] distance kept from a return when clearing [cells]
    body_radius: Scalar = 0.2  # [] cells this near to the robot's centre are seen free [m]
    blind_range: Scalar = 0.75  # [] nearer than this, occupied cells are not cleared [m]


def bearing(x: Float[Array, "*s"], y: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """Polynomial atan2(y, x) [rad] in [-pi, pi], vectorised on CPU; error below 0.01 degrees."""
    ax, ay = jnp.abs(x), jnp.abs(y)
    t = jnp.minimum(ax, ay) / jnp.maximum(jnp.maximum(ax, ay), 1e-20)
    s = t * t
    a = t * (0.9992150 + s * (-0.3211819 + s * (0.1462766 - 0.0389929 * s)))
    a = jnp.where(ay > ax, 0.5 * jnp.pi - a, a)
    a = jnp.where(x < 0, jnp.pi - a, a)
    return jnp.where(y < 0, -a, a)


def clear_ranges(
    params: OccupancyParams,
    points: Float[Array, "P 3"],
    point_valid: Bool[Array, " P"],
    num_bearings: int,
) -> tuple[Float[Array, " num_bearings"], Bool[Array, " P"]]:
    """The polar profile of a scan.

    Args:
        params: Sensor model.
        points: Points in base_link, z up from the ground [m].
        point_valid: False for beams that gave no reading; non-finite points are invalid as well.
        num_bearings: Number of bins around the robot.

    Returns:
        Horizontal distance [m] up to which each bin is clear, 0 where nothing was read; and which
        points are returns within the height band.
    """
    valid = point_valid & jnp.all(jnp.isfinite(points), axis=-1)
    x, y, z = (jnp.where(valid, points[:, i], 0.0) for i in range(3))
    flat = x * x + y * y
    rise = z - params.sensor_z
    valid &= flat > jnp.square(params.min_range)
    ended = flat + rise * rise < jnp.square(params.max_range - _RANGE_TOLERANCE)
    returned = valid & ended & (z >= params.z_min) & (z <= params.z_max)

    distance = jnp.sqrt(flat)
    # A ray leaves the band through its top at this share of its way.
    share = (params.z_max - params.sensor_z) / jnp.maximum(rise, 1e-6)
    reach = distance * jnp.clip(share, 0.0, 1.0)
    key = jnp.where(returned, distance, _NO_RETURN - reach)
    key = jnp.where(valid, key, _NO_RETURN)  # an invalid point reaches nowhere
    turn = num_bearings / (2 * jnp.pi)
    index = jnp.floor((bearing(x, y) + jnp.pi) * turn).astype(jnp.int32)
    index = jnp.clip(index, 0, num_bearings - 1)
    least = jnp.full(num_bearings, _NO_RETURN, jnp.float32)
    least = least.at[index].min(key, mode="promise_in_bounds")
    return jnp.where(least < 0.5 * _NO_RETURN, least, _NO_RETURN - least), returned


def observed(
    params: OccupancyParams,
    shape: tuple[int, int],
    origin: Float[Array, "2"],
    resolution: Scalar,
    pose: Float[Array, "3"],
    points: Float[Array, "P 3"],
    point_valid: Bool[Array, " P"],
    num_bearings: int = 180,
) -> tuple[Bool[Array, "H W"], Bool[Array, "H W"]]:
    """Cells in which a return of this scan lies, and cells that its rays have crossed.

    Their union is what the scan has seen; no cell is in both.

    Args:
        params: Sensor model.
        shape: (H, W) of the window.
        origin: Odom position of the outer corner of cell (0, 0) [m].
        resolution: Edge of a cell [m].
        pose: Robot pose (x, y, yaw) in odom.
        points: Scan in base_link, z up from the ground [m].
        point_valid: False for beams that gave no reading.
        num_bearings: Bins of the polar profile; at most the number of azimuths of the LiDAR.
    """
    clear, returned = clear_ranges(params, points, point_valid, num_bearings)
    # The least of each bin and its neighbours. As a window reduction, because XLA would fuse
    # anything simpler into the gather below and compute it once per cell.
    around = jnp.concatenate([clear[-1:], clear, clear[:1]])
    least = jax.lax.reduce_window(around, jnp.inf, jax.lax.min, (3,), (1,), "VALID")

    total = _count(shape, origin, resolution, pose, points, returned)
    # range noise throws a few of the many returns of a near wall into the cells before it: those are no wall
    peak = jax.lax.reduce_window(total, 0.0, jax.lax.max, (3, 1), (1, 1), "SAME")
    peak = jax.lax.reduce_window(peak, 0.0, jax.lax.max, (1, 3), (1, 1), "SAME")
    hit = (total > 0) & (total >= params.min_share * peak)

    x, y = geometry.cell_centres(shape, origin, resolution)
    dx, dy = jnp.broadcast_arrays(x - pose[0], y - pose[1])
    turn = num_bearings / (2 * jnp.pi)
    # Bearings in odom; the yaw only shifts the bin.
    offset = jnp.mod((jnp.pi - pose[2]) * turn, 1.0 * num_bearings)
    place = bearing(dx, dy) * turn + offset
    place = jnp.where(place < 0, place + num_bearings, place)
    place = jnp.where(place >= num_bearings, place - num_bearings, place)
    index = grids.once(jnp.clip(place.astype(jnp.int32), 0, num_bearings - 1))
    limit = least.at[index].get(mode="promise_in_bounds")
    limit = jnp.maximum(limit - params.margin * resolution, params.body_radius)
    return hit, (dx * dx + dy * dy < jnp.square(limit)) & (total == 0)


@partial(jax.jit, static_argnames="num_bearings")
def update(
    params: OccupancyParams,
    occupancy: Float[Array, "H W"],
    seen: Bool[Array, "H W"],
    origin: Float[Array, "2"],
    resolution: Scalar,
    pose: Float[Array, "3"],
    points: Float[Array, "P 3"],
    point_valid: Bool[Array, " P"],
    *,
    num_bearings: int = 180,
) -> tuple[Float[Array, "H W"], Bool[Array, "H W"]]:
    """Fold one scan into the belief (module docstring, a-c).

    Args:
        params: Sensor model.
        occupancy: Log-odds of being occupied [nat]; 0 where never seen.
        seen: Cells observed at least once.
        origin: Odom position of the outer corner of cell (0, 0) [m].
        resolution: Edge of a cell [m].
        pose: Robot pose (x, y, yaw) in odom.
        points: Scan in base_link, z up from the ground [m].
        point_valid: False for beams that gave no reading.
        num_bearings: Bins of the polar profile; at most the number of azimuths of the LiDAR.

    Returns:
        The new `(occupancy, seen)`.
    """
    h, w = occupancy.shape
    hit, crossed = observed(params, (h, w), origin, resolution, pose, points, point_valid, num_bearings)
    return apply(params, occupancy, seen, origin, resolution, pose, hit, crossed)


def apply(
    params: OccupancyParams,
    occupancy: Float[Array, "H W"],
    seen: Bool[Array, "H W"],
    origin: Float[Array, "2"],
    resolution: Scalar,
    pose: Float[Array, "3"],
    hit: Bool[Array, "H W"],
    crossed: Bool[Array, "H W"],
) -> tuple[Float[Array, "H W"], Bool[Array, "H W"]]:
    """The log-odds step for known masks (what `observed` gives); see `update`."""
    h, w = occupancy.shape
    x, y = geometry.cell_centres((h, w), origin, resolution)
    squared = jnp.square(x - pose[0]) + jnp.square(y - pose[1])
    blind = (squared < jnp.square(params.blind_range)) & (occupancy > 0)
    blind &= squared >= jnp.square(params.body_radius)
    lowered = jnp.clip(occupancy + params.miss, params.l_min, params.l_max)
    raised = jnp.clip(occupancy + params.hit, params.l_min, params.l_max)
    value = jnp.where(crossed & ~blind, lowered, occupancy)
    return jnp.where(hit, raised, value), seen | hit | crossed


def fine_returns(
    params: OccupancyParams,
    shape: tuple[int, int],
    origin: Float[Array, "2"],
    resolution: Scalar,
    pose: Float[Array, "3"],
    points: Float[Array, "P 3"],
    point_valid: Bool[Array, " P"],
    num_bearings: int = 180,
) -> Float[Array, "h w"]:
    """Number of in-band returns of a scan in each cell of a grid; arguments as in `observed`."""
    _, returned = clear_ranges(params, points, point_valid, num_bearings)
    return _count(shape, origin, resolution, pose, points, returned)


def _count(
    shape: tuple[int, int], origin: Array, resolution: Scalar, pose: Array, points: Array, returned: Array
) -> Float[Array, "h w"]:
    h, w = shape
    xy = grids.once(geometry.transform(pose, jnp.where(returned[:, None], points[:, :2], 0.0)))
    cell = geometry.cell_of(xy, origin, resolution)
    index = jnp.where(returned & geometry.inside(cell, shape), cell[:, 0] * w + cell[:, 1], h * w)
    return jnp.zeros(h * w, jnp.float32).at[index].add(1.0, mode="drop").reshape(h, w)


def refine(surface: Float[Array, "h w"], returns: Float[Array, "h w"], rate: float = 0.2) -> Float[Array, "h w"]:
    """Share of a cell's returns that fall into each of its quarters: a running mean over the scans that saw it.

    Args:
        surface: So far, on cells of half the map's edge, 0..1.
        returns: Of this scan, on the same cells.
        rate: Weight of one scan.
    """
    total = grids.repeat(grids.once(grids.pool(returns, 2, "sum")), 2)
    return surface + jnp.where(total > 0, rate * (returns / jnp.maximum(total, 1.0) - surface), 0.0)


def fine_obstacles(
    params: OccupancyParams, occupied: Bool[Array, "H W"], surface: Float[Array, "h w"]
) -> Bool[Array, "h w"]:
    """Obstacles on cells of half the edge: the quarters of occupied cells into which returns fall.

    Args:
        params: `min_share` is the share from which on a quarter counts.
        occupied: Map cells held to be occupied.
        surface: `refine` on the same area, half the edge.
    """
    quarters = surface >= params.min_share * 0.5
    # a cell that became occupied before it came this near is solid until its quarters are known
    solid = occupied & ~grids.pool(quarters, 2, "any")
    return (quarters & grids.repeat(occupied, 2)) | grids.repeat(solid, 2)
