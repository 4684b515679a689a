"""A world is data: upright boxes and cylinders, or the distance field of a grid map, or both.

`World` holds what a simulator needs, as arrays, so that worlds batch; `Scene` is one world with a
name, its ground-truth occupancy grid, a start and a goal, on the host.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float
from scipy import ndimage

from drnav_jax.types import GridMap

WALL_HEIGHT = 2.5  # [m] what grid maps are extruded to
FAR = 1e6  # [m] where padding rows lie: they are never met


class World(NamedTuple):
    """Geometry as arrays. Rows that only fill up a batch lie at `FAR` and have zero size."""

    boxes: Float[Array, "Nb 7"]  # centre x, y, yaw, half length (along yaw), half width, z_min, _max
    cylinders: Float[Array, "Nc 5"]  # centre x, y, radius, z_min, z_max
    field: GridMap  # [H, W] signed distance [m] to a map's walls (< 0 inside); (0, 0) if no map


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """One world to drive in: geometry, ground truth, and (perhaps) a trip.

    Attributes:
        name: FAMILY:SEED, or the map's file name.
        world: Geometry, numpy arrays.
        occupied: Ground truth `[H, W]` bool, True = obstacle (row 0 at the smallest y).
        origin: World x, y of the outer corner of cell (0, 0) [m].
        resolution: Edge of a ground-truth cell [m].
        start: x, y, yaw [m, rad], or None when trips are to be sampled.
        goal: x, y [m], or None.
        goal_tolerance: Radius around the goal that counts as arrived [m]; None = the default.
        time_limit: Seconds allowed; None = the default rule.
        reference_length: Length [m] of the source's own reference path (BARN, Moving AI), or None.
        outside_is_free: Whether one may drive beyond the grid's edge (open field) or not (maps).
    """

    name: str
    world: World
    occupied: np.ndarray
    origin: tuple[float, float]
    resolution: float
    start: tuple[float, float, float] | None = None
    goal: tuple[float, float] | None = None
    goal_tolerance: float | None = None
    time_limit: float | None = None
    reference_length: float | None = None
    outside_is_free: bool = True


def _float32(values: Any) -> Any:
    """Host values as NumPy float32; `Any`, since containers declare their fields for JAX's arrays."""
    return np.asarray(values, np.float32)


def no_field() -> GridMap:
    """The field of a world that is made of boxes and cylinders only."""
    return GridMap(
        values=_float32(np.zeros((0, 0))), origin=_float32([0, 0]), resolution=_float32(1)
    )


def make_world(
    boxes: Sequence | np.ndarray = (),
    cylinders: Sequence | np.ndarray = (),
    field: GridMap | None = None,
) -> World:
    """A world on the host (NumPy, float32) out of rows as `World` has them."""
    return World(
        boxes=_float32(np.reshape(np.asarray(boxes, np.float32), (-1, 7))),
        cylinders=_float32(np.reshape(np.asarray(cylinders, np.float32), (-1, 5))),
        field=no_field() if field is None else field,
    )


def distance_field(occupied: np.ndarray, resolution: float) -> np.ndarray:
    """Signed distance [m] from cell centres to the edge of the occupied cells, `[H, W]` float32.

    It is < 0 inside. Between an occupied and a free neighbour it crosses zero at their common edge
    (+-1/2 cell at the two centres).
    """
    if not occupied.any():
        return np.full(occupied.shape, FAR, np.float32)
    outside = np.asarray(ndimage.distance_transform_edt(~occupied)) - 0.5
    inside = np.asarray(ndimage.distance_transform_edt(occupied)) - 0.5
    return (np.where(occupied, -inside, outside) * resolution).astype(np.float32)


def from_grid(occupied: np.ndarray, origin: tuple[float, float], resolution: float) -> World:
    """The world of an occupancy grid: its walls extruded to `WALL_HEIGHT`, as a distance field."""
    field = GridMap(
        values=_float32(distance_field(occupied, resolution)),
        origin=_float32(origin),
        resolution=_float32(resolution),
    )
    return make_world(field=field)


def rasterise(
    world: World, origin: tuple[float, float], shape: tuple[int, int], resolution: float
) -> np.ndarray:
    """Ground truth `[H, W]` of boxes and cylinders: True where a cell's centre is inside one."""
    x = origin[0] + (np.arange(shape[1]) + 0.5) * resolution
    y = origin[1] + (np.arange(shape[0]) + 0.5) * resolution
    x, y = x[None, :], y[:, None]
    occupied = np.zeros(shape, bool)
    for bx, by, yaw, hx, hy, _, _ in np.asarray(world.boxes, np.float64):
        c, s = np.cos(yaw), np.sin(yaw)
        along, across = c * (x - bx) + s * (y - by), -s * (x - bx) + c * (y - by)
        occupied |= (np.abs(along) <= hx) & (np.abs(across) <= hy)
    for cx, cy, r, _, _ in np.asarray(world.cylinders, np.float64):
        occupied |= (x - cx) ** 2 + (y - cy) ** 2 <= r * r
    return occupied


def signed_distance(world: World, points: np.ndarray) -> np.ndarray:
    """Distance [m] from points to the nearest solid, < 0 inside one; heights are ignored.

    Args:
        world: One world. Boxes and cylinders are exact, a map's field is interpolated bilinearly.
        points: x, y `[N, 2]` [m].

    Returns:
        `[N]` float64; `FAR` in an empty world.
    """
    x, y = np.asarray(points, np.float64).reshape(-1, 2).T
    distance = np.full(len(x), FAR)
    for bx, by, yaw, hx, hy, _, _ in np.asarray(world.boxes, np.float64):
        c, s = np.cos(yaw), np.sin(yaw)
        qx = np.abs(c * (x - bx) + s * (y - by)) - hx
        qy = np.abs(-s * (x - bx) + c * (y - by)) - hy
        beyond = np.hypot(np.maximum(qx, 0.0), np.maximum(qy, 0.0))
        np.minimum(distance, beyond + np.minimum(np.maximum(qx, qy), 0.0), out=distance)
    for cx, cy, r, _, _ in np.asarray(world.cylinders, np.float64):
        np.minimum(distance, np.hypot(x - cx, y - cy) - r, out=distance)
    field = np.asarray(world.field.values, np.float64)
    if field.size:
        cell = (np.stack([y, x]) - np.asarray(world.field.origin, np.float64)[::-1, None]) / float(
            world.field.resolution
        ) - 0.5
        sampled = ndimage.map_coordinates(field, cell, order=1, mode="nearest")
        np.minimum(distance, sampled, out=distance)
    return distance


def stack_worlds(worlds: list[World]) -> World:
    """One batch `[B, ...]` of worlds, padded to common sizes with rows and cells never met.

    A field is padded by repeating its edge, which is also what sampling beyond the edge of an
    unpadded one gives.

    Raises:
        ValueError: If the list is empty, or mixes grid maps with worlds that have none.
    """
    if not worlds:
        raise ValueError("stack_worlds needs at least one world.")

    def rows(name: str, width: int) -> Any:
        count = max(len(getattr(w, name)) for w in worlds)
        out = np.zeros((len(worlds), count, width), np.float32)
        out[..., :2] = FAR
        for k, w in enumerate(worlds):
            out[k, : len(getattr(w, name))] = getattr(w, name)
        return out

    h, w = (max(world.field.values.shape[a] for world in worlds) for a in (0, 1))
    fields = []
    for world in worlds:
        a, b = world.field.values.shape
        if (a == 0) != (h == 0):
            raise ValueError("worlds with and without a map do not batch: run them separately.")
        pad = ((0, h - a), (0, w - b))
        fields.append(np.pad(world.field.values, pad, mode="edge" if a else "empty"))
    return World(
        boxes=rows("boxes", 7),
        cylinders=rows("cylinders", 5),
        field=GridMap(
            values=_float32(fields),
            origin=_float32([x.field.origin for x in worlds]),
            resolution=_float32([x.field.resolution for x in worlds]),
        ),
    )
