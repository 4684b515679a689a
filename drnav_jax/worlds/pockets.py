"""What is known of each pocket: its size, its mouth, and the point from which a robot goes on (host code).

Pockets are the outermost ones of `labels`, so that what is nested counts with what holds it. With F where a robot's
centre may be, d the clearance [m] and w(c) the length [m] of the way in F from c to the pocket's edge, the recovery
point is

    (1)  argmax { min(d(c), 2 m) - w(c) / 4 : c in F, in no pocket, 0 < w(c) <= 1 m }.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32
from scipy import ndimage

from drnav_jax.worlds.labels import DeadEndLabels, clearance_of, way_out

NEAR = 1.0  # [m] a recovery point is not further than this from the mouth
AMPLE = 2.0  # [m] more clearance is no better
WAY_WEIGHT = 0.25  # [m of clearance / m of way]


class Pockets(NamedTuple):
    """P pockets; row k is the pocket with the number k + 1."""

    area: Float32[np.ndarray, " P"]  # [m^2] of its cells: where a robot's centre may be
    depth: Float32[np.ndarray, " P"]  # [m] greatest, beyond the mouth
    gap: Float32[np.ndarray, " P"]  # [m] width of the mouth
    gate: Float32[np.ndarray, "P 2"]  # x, y [m] of the middle of the mouth
    is_room: Bool[np.ndarray, " P"]  # whether the area reaches the threshold
    recovery: Float32[np.ndarray, "P 2"]  # x, y [m]; NaN where no way leads out


def pockets(
    labels: DeadEndLabels,
    occupied: Bool[np.ndarray, "H W"],
    origin: tuple[float, float],
    resolution: float,
    *,
    radius: float,
    room_area: float,
) -> Pockets:
    """Facts about the pockets of a map.

    Args:
        labels: Of the map.
        occupied: The map that they are of; outside is free.
        origin: World position of the outer corner of cell (0, 0) [m].
        resolution: Edge of a cell [m].
        radius: Of the robot [m], as the labels have it.
        room_area: From this area on a pocket counts as a room [m^2].
    """
    pad = int(np.ceil(NEAR / resolution)) + 2
    clearance = clearance_of(occupied, resolution, pad=pad)
    free, pocket = clearance > radius, np.pad(labels.pocket, pad)
    value = np.minimum(clearance, AMPLE)
    count = len(labels.mouth)
    recovery = np.full((count, 2), np.nan, np.float32)
    for k, box in enumerate(ndimage.find_objects(pocket, count)):
        rows, columns = (slice(max(b.start - pad, 0), b.stop + pad) for b in box)
        here, outside = pocket[rows, columns] == k + 1, free[rows, columns] & (pocket[rows, columns] == 0)
        near = outside & (np.asarray(ndimage.distance_transform_edt(~here)) * resolution <= NEAR + 1e-6)
        way = way_out(np.pad(near | here, 1), np.pad(near, 1))[1:-1, 1:-1] * resolution
        score = np.where((way > 0) & (way <= NEAR + 1e-6), value[rows, columns] - WAY_WEIGHT * way, -np.inf)
        i, j = np.unravel_index(np.argmax(score), score.shape)
        if np.isfinite(score[i, j]):
            recovery[k] = i + rows.start - pad, j + columns.start - pad
    index = np.arange(1, count + 1)
    area = np.bincount(labels.pocket.ravel(), minlength=count + 1)[1:] * resolution**2

    def place(cells: np.ndarray) -> Float32[np.ndarray, "P 2"]:
        return ((cells[:, ::-1] + 0.5) * resolution + np.asarray(origin)).astype(np.float32)

    return Pockets(
        area=area.astype(np.float32),
        depth=np.asarray(ndimage.maximum(labels.depth, labels.pocket, index), np.float32).reshape(count),
        gap=labels.mouth_gap,
        gate=place(labels.mouth),
        is_room=area >= room_area,
        recovery=place(recovery),
    )
