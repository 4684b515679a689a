"""Labels as a robot sees them: the ground truth sampled under its pose, and whether the ways before it are open.

With the pose's cell c of the world under each cell of the bird's-eye grid (`BevSpec`), and depth beyond the mouth of the
outermost pocket:

    (1)  recoverability(c) = exp(-depth(c) / 4 m)    1 outside of pockets; 0 where nothing can drive or no way leads out
    (2)  mask(c)           = c is in the world, traversable, and no crevice that is further than R from where a robot can be

Where the mask is 0 labels mean nothing: keep them from the loss.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float16, UInt8

from drnav_jax import geometry
from drnav_jax.types import BevSpec, GridMap, Scalar
from drnav_jax.worlds.openings import OpeningSpec, openings
from drnav_jax.worlds.truth import GroundTruth

RETREAT = 4.0  # [m] of depth by which recoverability falls to 1/e
NOW, BEFORE, NEVER = range(3)  # visibility classes
_CHUNK = 128  # poses at a time


class FrameLabels(NamedTuple):
    """Labels of N frames; cells as in `BevSpec`, ways in the order front, left, right. Flags are 0 or 1."""

    label: UInt8[np.ndarray, "N h w"]  # 1 = dead end
    depth: Float16[np.ndarray, "N h w"]  # [m] beyond the mouth
    traversable: UInt8[np.ndarray, "N h w"]  # 1 where nothing stops a robot
    recoverability: Float16[np.ndarray, "N h w"]  # 0..1
    interior: UInt8[np.ndarray, "N h w"]  # 1 where the label is another one in the twin
    inside: UInt8[np.ndarray, "N h w"]  # 1 in the world: where `traversable` means something
    mask: UInt8[np.ndarray, "N h w"]  # 1 where the other labels do
    path: UInt8[np.ndarray, "N 3"]  # 1 = OPEN
    path_stable: UInt8[np.ndarray, "N 3"]
    dead_end: UInt8[np.ndarray, " N"]  # 1 = all three are BLOCKED
    dead_end_stable: UInt8[np.ndarray, " N"]


def frames(
    truth: GroundTruth,
    poses: Float[np.ndarray, "N 3"],
    bev: BevSpec = BevSpec(),  # noqa: B008 (immutable)
    *,
    interior: Bool[np.ndarray, "H W"] | None = None,
    spec: OpeningSpec = OpeningSpec(),  # noqa: B008 (immutable)
) -> FrameLabels:
    """Labels of many frames of one world.

    Args:
        truth: Of the world.
        poses: x, y, yaw in the world [m, rad].
        bev: The grid in base_link.
        interior: From `truth.interior` for worlds with a twin.
        spec: What makes a way open.

    Raises:
        ValueError: If a pose is not finite, or `interior` is not on the truth's grid.
    """
    if interior is not None and interior.shape != truth.label.shape:
        raise ValueError(f"interior must be on the truth's grid {truth.label.shape}, got {interior.shape}.")
    if not np.isfinite(poses).all():
        raise ValueError("poses must be finite numbers.")
    poses = np.asarray(poses, np.float64)
    twin = np.zeros(truth.label.shape, bool) if interior is None else interior
    lost = truth.label & (truth.depth == 0)
    recovery = np.where(lost, 0.0, np.exp(-truth.depth.astype(np.float32) / RETREAT)).astype(np.float16)
    h, w = bev.shape
    ways = openings(truth, poses, spec)
    flags = ("label", "traversable", "interior", "inside", "mask")
    out = {name: np.zeros((len(poses), h, w), np.uint8) for name in flags}
    out |= {name: np.zeros((len(poses), h, w), np.float16) for name in ("depth", "recoverability")}
    quarter = bev.resolution / 4
    for k in range(0, len(poses), _CHUNK):
        part = slice(k, k + _CHUNK)
        index, inside = _cells(truth, poses[part], bev, 0.0, 0.0)
        free = inside.copy()
        for dx, dy in ((-1, -1), (-1, 1), (1, -1), (1, 1)):  # a wall may be thinner than a cell
            corner, there = _cells(truth, poses[part], bev, dx * quarter, dy * quarter)
            free &= truth.traversable.ravel()[corner] | ~there
        out["inside"][part], out["traversable"][part] = inside, free
        out["label"][part] = truth.label.ravel()[index] & inside
        out["interior"][part] = twin.ravel()[index] & inside
        out["mask"][part] = free & truth.defined.ravel()[index]
        out["depth"][part] = np.where(inside, truth.depth.ravel()[index], 0)
        out["recoverability"][part] = np.where(free, recovery.ravel()[index], 0)
    return FrameLabels(
        **out,
        path=ways.open.astype(np.uint8),
        path_stable=ways.stable.astype(np.uint8),
        dead_end=ways.dead_end.astype(np.uint8),
        dead_end_stable=ways.dead_end_stable.astype(np.uint8),
    )


def _cells(truth: GroundTruth, poses: np.ndarray, bev: BevSpec, dx: float, dy: float) -> tuple[np.ndarray, np.ndarray]:
    """Flat cell of the world under each cell of the bird's-eye grid, moved by dx, dy [m]; and if it is on the grid."""
    h, w = bev.shape
    x = bev.origin[0] + dx + (np.arange(w) + 0.5) * bev.resolution
    y = bev.origin[1] + dy + (np.arange(h)[:, None] + 0.5) * bev.resolution
    c, s = np.cos(poses[:, 2, None, None]), np.sin(poses[:, 2, None, None])
    column = np.floor((c * x - s * y + poses[:, 0, None, None] - truth.origin[0]) / truth.resolution).astype(int)
    row = np.floor((s * x + c * y + poses[:, 1, None, None] - truth.origin[1]) / truth.resolution).astype(int)
    rows, columns = truth.label.shape
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    return np.clip(row, 0, rows - 1) * columns + np.clip(column, 0, columns - 1), inside


def visibility(
    seen_now: Bool[Array, "H W"],
    seen: Bool[Array, "H W"],
    origin: Float[Array, "2"],
    resolution: Scalar,
    pose: Float[Array, "3"],
    bev: BevSpec = BevSpec(),  # noqa: B008 (immutable)
) -> UInt8[Array, "h w"]:
    """Visibility class of each cell of the bird's-eye grid: `NOW`, `BEFORE` or `NEVER` (0, 1, 2).

    Pure and jittable (`bev` static); for one robot.

    Args:
        seen_now: Cells of the filter's window that this scan observed.
        seen: Cells observed at least once since the window holds them.
        origin: x, y of the outer corner of the window's cell (0, 0) [m].
        resolution: Edge of a cell of the window [m].
        pose: x, y, yaw of the robot, in the frame of `origin`.
        bev: The grid in base_link; cells outside of the window were never seen.
    """
    x, y = geometry.cell_centres(bev.shape, jnp.asarray(bev.origin, jnp.float32), bev.resolution)
    xy = geometry.transform(pose, jnp.stack(jnp.broadcast_arrays(x, y), axis=-1))
    classes = jnp.where(seen_now, jnp.uint8(NOW), jnp.where(seen, jnp.uint8(BEFORE), jnp.uint8(NEVER)))
    return geometry.sample_nearest(GridMap(classes, origin, resolution), xy, fill=NEVER)
