"""What stops a robot though the returns of a LiDAR do not say so, and what does not though they do.

Two beliefs beside the occupancy, in log-odds; 0 = nothing is known:

    hole(c)     the ground is missing. A beam that ends below the ground, at z < -`depth`, has passed z = 0 over c, where
                there is no ground; one that ends on the ground (|z| < `depth`) has found some.                          (1)
    barrier(c)  a camera's opinion that something stops a robot (`Evidence.blocked`): > 0 a pane of glass that beams go
                through, < 0 tall grass that they return from. Evidence adds up; a predictor tempers its own. It falls
                below 0 only where there are returns: what is free is no grass.                                          (2)

    closed = (occupied and barrier > -`opened`) or hole > 0 or barrier > `closed`                                        (3)

Planners read (3); predictors read the occupancy as it is. A hole is marked `brink` nearer than the beam passed, too:
between two rings, or two scans, the edge lies somewhere before the first beam that falls.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drnav_jax import geometry
from drnav_jax.types import Scalar


class BarrierParams(NamedTuple):
    """Sensor model and thresholds."""

    depth: Scalar = 0.12  # [] deeper below the ground than this is no ground [m]
    brink: Scalar = 0.1  # [] [m]
    hole: Scalar = 0.9  # [] added to a cell over which a beam fell [nat]
    ground: Scalar = -0.4  # [] added to a cell on which one ended [nat]
    limit: Scalar = 3.5  # [] saturation of both beliefs [nat]
    closed: Scalar = 1.5  # [] eq. 3 [nat]
    opened: Scalar = 2.5  # [] eq. 3 [nat]


def fallen(
    params: BarrierParams, sensor_z: Scalar, shape: tuple[int, int], origin: Float[Array, "2"], resolution: Scalar,
    pose: Float[Array, "3"], points: Float[Array, "P 3"], point_valid: Bool[Array, " P"],
) -> tuple[Bool[Array, "H W"], Bool[Array, "H W"]]:  # fmt: skip
    """Cells over which beams of a scan fell below the ground, and cells on which they found it (eq. 1).

    Args:
        params: Sensor model.
        sensor_z: Height of the LiDAR over base_link, which is on the ground [m].
        shape: (H, W) of the window.
        origin: Odom position of the outer corner of cell (0, 0) [m].
        resolution: Edge of a cell [m].
        pose: Robot (x, y, yaw) in odom.
        points: Scan in base_link, z up from the ground [m].
        point_valid: False for beams that gave no reading.
    """
    valid = point_valid & jnp.all(jnp.isfinite(points), axis=-1)
    z, flat = jnp.where(valid, points[:, 2], 1.0), jnp.where(valid[:, None], points[:, :2], 0.0)
    away = jnp.sqrt(jnp.sum(flat * flat, axis=-1))
    falls, lands = valid & (z < -params.depth), valid & (jnp.abs(z) <= params.depth)
    share = jnp.where(falls, sensor_z / jnp.maximum(sensor_z - z, 1e-3), 1.0)
    before = jnp.maximum(share - params.brink / jnp.maximum(away, 1e-3), 0.0)
    h, w = shape

    def mark(xy: Array, which: Array) -> Array:
        cell = geometry.cell_of(geometry.transform(pose, xy), origin, resolution)
        index = jnp.where(which & geometry.inside(cell, shape), cell[:, 0] * w + cell[:, 1], h * w)
        return jnp.zeros(h * w, bool).at[index].set(True, mode="drop").reshape(h, w)

    hole = mark(flat * share[:, None], falls) | mark(flat * before[:, None], falls)
    return hole, mark(flat, lands) & ~hole


def observe(
    params: BarrierParams, hole: Float[Array, "H W"], fell: Bool[Array, "H W"], landed: Bool[Array, "H W"]
) -> Float[Array, "H W"]:
    """Equation (1): the belief about holes after one scan."""
    step = jnp.where(fell, params.hole, jnp.where(landed, params.ground, 0.0))
    return jnp.clip(hole + step, -params.limit, params.limit)


def assimilate(
    params: BarrierParams, barrier: Float[Array, "H W"], blocked: Float[Array, "H W"], occupied: Bool[Array, "H W"]
) -> Float[Array, "H W"]:
    """Equation (2): the belief after a predictor's opinion, in log-odds [nat]; what is not finite is none."""
    said = jnp.where(jnp.isfinite(blocked), blocked, 0.0)
    least = jnp.where(occupied, -params.limit, jnp.minimum(barrier, 0.0))
    return jnp.clip(jnp.maximum(barrier + said, least), -params.limit, params.limit)


def closed(
    params: BarrierParams, occupied: Bool[Array, "H W"], hole: Float[Array, "H W"], barrier: Float[Array, "H W"]
) -> Bool[Array, "H W"]:
    """Equation (3)."""
    return (occupied & (barrier > -params.opened)) | (hole > 0) | (barrier > params.closed)
