"""A world is data: upright boxes and cylinders, or the distance field of a grid map, or both.

`World` holds what a simulator needs, as arrays, so that worlds batch; `Scene` is one world with a
name, its ground-truth occupancy grid, a start and a goal, on the host.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int
from scipy import ndimage

from drnav_jax.types import GridMap, Scalar
from drnav_jax.worlds.materials import BLOCKS, Material

WALL_HEIGHT = 2.5  # [m] what grid maps are extruded to
HEADROOM = 1.5  # [m] a robot passes under what begins higher: lintels, tree tops
FAR = 1e6  # [m] where padding rows lie: they are never met


class Surfaces(NamedTuple):
    """What N solids are made of."""

    material: Int[Array, " N"]  # `Material`
    colour: Float[Array, "N 3"]  # albedo, RGB in 0..1


class Scenery(NamedTuple):
    """Ground, sky, light, and what a grid map's walls are made of."""

    ground_material: Scalar = int(Material.CONCRETE)  # [] `Material`
    ground_colour: Array | np.ndarray | tuple = (0.45, 0.45, 0.43)  # [3] albedo
    wall_material: Scalar = int(Material.WALL)  # [] `Material` of the walls of `World.field`
    wall_colour: Array | np.ndarray | tuple = (0.75, 0.73, 0.68)  # [3] albedo
    ceiling: Scalar = np.inf  # [] height [m]; inf = open sky
    ceiling_colour: Array | np.ndarray | tuple = (0.85, 0.85, 0.85)  # [3] albedo
    sun: Array | np.ndarray | tuple = (0.48, 0.32, 0.82)  # [3] unit vector towards the light
    ambient: Scalar = 0.5  # [] share of the light that has no direction, 0..1
    sky_colour: Array | np.ndarray | tuple = (0.55, 0.72, 0.95)  # [3]
    fog: Scalar = 0.0  # [] extinction of light in the air [1/m]
    exposure: Scalar = 1.0  # [] gain of the camera
    texture_seed: Scalar = 0  # [] int: places bricks, spots and stains


class World(NamedTuple):
    """Geometry as arrays. Rows that only fill up a batch lie at `FAR` and have zero size."""

    boxes: Float[Array, "Nb 7"]  # centre x, y, yaw, half length (along yaw), half width, z_min, _max
    cylinders: Float[Array, "Nc 5"]  # centre x, y, radius, z_min, z_max
    field: GridMap  # [H, W] signed distance [m] to a map's walls (< 0 inside); (0, 0) if no map
    box_surfaces: Surfaces  # of the boxes
    cylinder_surfaces: Surfaces  # of the cylinders
    scenery: Scenery


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
        family: Seeded family that it is of, or None.
        split: Split that its family and seed are of, or None.
        twin: Name of the world, of the same split, that differs in one way being open or closed; None if there is none.
        closed: Whether that way is closed here; False if there is no twin.
        strata: What is in the world or its twin that one sensor alone cannot judge: of "drop", "glass", "vegetation".
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
    family: str | None = None
    split: str | None = None
    twin: str | None = None
    closed: bool = False
    strata: tuple[str, ...] = ()


def _float32(values: Any) -> Any:
    """Host values as NumPy float32; `Any`, since containers declare their fields for JAX's arrays."""
    return np.asarray(values, np.float32)


def _filled(values: Any, shape: tuple[int, ...], dtype: Any) -> Any:
    """A fresh array of that shape, out of one value for all rows or one for each."""
    return np.array(np.broadcast_to(np.asarray(values, dtype), shape))


def no_field() -> GridMap:
    """The field of a world that is made of boxes and cylinders only."""
    return GridMap(
        values=_float32(np.zeros((0, 0))), origin=_float32([0, 0]), resolution=_float32(1)
    )


def surfaces(count: int, materials: Any = Material.WALL, colours: Any = (0.7, 0.7, 0.7)) -> Surfaces:
    """Surfaces of `count` solids, from one material and colour for all or one for each."""
    return Surfaces(material=_filled(materials, (count,), np.int32), colour=_filled(colours, (count, 3), np.float32))


def make_world(
    boxes: Sequence | np.ndarray = (),
    cylinders: Sequence | np.ndarray = (),
    field: GridMap | None = None,
    *,
    box_surfaces: Surfaces | None = None,
    cylinder_surfaces: Surfaces | None = None,
    scenery: Scenery = Scenery(),  # noqa: B008 (immutable)
) -> World:
    """A world on the host (NumPy) out of rows as `World` has them; what has no surface is a grey wall.

    Raises:
        ValueError: If there are not as many surfaces as solids.
    """
    box_rows = _float32(np.reshape(np.asarray(boxes, np.float32), (-1, 7)))
    cylinder_rows = _float32(np.reshape(np.asarray(cylinders, np.float32), (-1, 5)))
    of_boxes = surfaces(len(box_rows)) if box_surfaces is None else box_surfaces
    of_cylinders = surfaces(len(cylinder_rows)) if cylinder_surfaces is None else cylinder_surfaces
    for name, solids, given in (("box", box_rows, of_boxes), ("cylinder", cylinder_rows, of_cylinders)):
        if len(given.material) != len(solids) or np.shape(given.colour) != (len(solids), 3):
            raise ValueError(
                f"{name}_surfaces must have {len(solids)} rows, one per {name}, got {len(given.material)} materials "
                f"and colours of shape {np.shape(given.colour)}."
            )
    integers = ("ground_material", "wall_material", "texture_seed")
    lit: Any = {
        name: np.asarray(value, np.int32 if name in integers else np.float32)
        for name, value in scenery._asdict().items()
    }
    return World(
        boxes=box_rows,
        cylinders=cylinder_rows,
        field=no_field() if field is None else field,
        box_surfaces=of_boxes,
        cylinder_surfaces=of_cylinders,
        scenery=Scenery(**lit),
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


def blocking(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the boxes and of the cylinders that stop a robot, float64."""
    boxes, cylinders = np.asarray(world.boxes, np.float64), np.asarray(world.cylinders, np.float64)
    return (
        boxes[BLOCKS[world.box_surfaces.material] & (boxes[:, 5] < HEADROOM)],
        cylinders[BLOCKS[world.cylinder_surfaces.material] & (cylinders[:, 3] < HEADROOM)],
    )


def _windows(rows: np.ndarray, pad: float, origin: Any, shape: tuple[int, int], resolution: float) -> list:
    """Of each solid the slices of a grid that hold every centre within `pad` [m] of it; None if there are none."""
    if rows.shape[1] == 7:
        c, s = np.abs(np.cos(rows[:, 2])), np.abs(np.sin(rows[:, 2]))
        half = np.stack([c * rows[:, 3] + s * rows[:, 4], s * rows[:, 3] + c * rows[:, 4]], axis=1)
    else:
        half = np.repeat(rows[:, 2:3], 2, axis=1)
    reach = half + pad
    low = np.floor((rows[:, :2] - reach - origin) / resolution).clip(0, shape[::-1]).astype(int)
    high = np.ceil((rows[:, :2] + reach - origin) / resolution).clip(0, shape[::-1]).astype(int)
    return [np.s_[y0:y1, x0:x1] if x1 > x0 and y1 > y0 else None for (x0, y0), (x1, y1) in zip(low, high, strict=True)]


def rasterise(
    world: World, origin: tuple[float, float], shape: tuple[int, int], resolution: float
) -> np.ndarray:
    """Ground truth `[H, W]`: True where a cell's centre is inside a box or cylinder that stops a robot.

    A box thinner than a cell, such as a pane, counts as one cell thick: else it could lie between the centres.
    """
    x = origin[0] + (np.arange(shape[1]) + 0.5) * resolution
    y = origin[1] + (np.arange(shape[0]) + 0.5) * resolution
    x, y = x[None, :], y[:, None]
    occupied = np.zeros(shape, bool)
    boxes, cylinders = blocking(world)
    for (bx, by, yaw, hx, hy, _, _), at in zip(boxes, _windows(boxes, resolution, origin, shape, resolution), strict=True):
        if at is None:
            continue
        c, s, px, py = np.cos(yaw), np.sin(yaw), x[:, at[1]], y[at[0]]
        along, across = c * (px - bx) + s * (py - by), -s * (px - bx) + c * (py - by)
        occupied[at] |= (np.abs(along) <= max(hx, resolution / 2)) & (np.abs(across) <= max(hy, resolution / 2))
    for (cx, cy, r, _, _), at in zip(cylinders, _windows(cylinders, resolution, origin, shape, resolution), strict=True):
        if at is not None:
            occupied[at] |= (x[:, at[1]] - cx) ** 2 + (y[at[0]] - cy) ** 2 <= r * r
    return occupied


def near_distance(
    world: World, origin: Any, shape: tuple[int, int], resolution: float, reach: float
) -> np.ndarray:
    """`signed_distance` at the centres of a grid's cells `[H, W]`, cut off at `reach` [m].

    Each solid costs no more than the cells around it, so worlds may be large.
    """
    x = origin[0] + (np.arange(shape[1]) + 0.5) * resolution
    y = origin[1] + (np.arange(shape[0]) + 0.5) * resolution
    distance = np.full(shape, reach)
    boxes, cylinders = blocking(world)
    for name, rows in (("boxes", boxes), ("cylinders", cylinders)):
        for row, at in zip(rows, _windows(rows, reach, origin, shape, resolution), strict=True):
            if at is not None:
                points = np.stack(np.broadcast_arrays(x[None, at[1]], y[at[0], None]), axis=-1)
                here = signed_distance(make_world(**{name: row[None]}), points.reshape(-1, 2))
                np.minimum(distance[at], here.reshape(points.shape[:2]), out=distance[at])
    if np.asarray(world.field.values).size:
        points = np.stack(np.broadcast_arrays(x[None, :], y[:, None]), axis=-1)
        walls = signed_distance(make_world(field=world.field), points.reshape(-1, 2))
        np.minimum(distance, walls.reshape(shape), out=distance)
    return distance


def signed_distance(world: World, points: np.ndarray) -> np.ndarray:
    """Distance [m] from points to the nearest solid that stops a robot, < 0 inside one; only `HEADROOM` counts of heights.

    Args:
        world: One world. Boxes and cylinders are exact, a map's field is interpolated bilinearly.
        points: x, y `[N, 2]` [m].

    Returns:
        `[N]` float64; `FAR` in an empty world.
    """
    x, y = np.asarray(points, np.float64).reshape(-1, 2).T
    distance = np.full(len(x), FAR)
    boxes, cylinders = blocking(world)
    for bx, by, yaw, hx, hy, _, _ in boxes:
        c, s = np.cos(yaw), np.sin(yaw)
        qx = np.abs(c * (x - bx) + s * (y - by)) - hx
        qy = np.abs(-s * (x - bx) + c * (y - by)) - hy
        beyond = np.hypot(np.maximum(qx, 0.0), np.maximum(qy, 0.0))
        np.minimum(distance, beyond + np.minimum(np.maximum(qx, qy), 0.0), out=distance)
    for cx, cy, r, _, _ in cylinders:
        np.minimum(distance, np.hypot(x - cx, y - cy) - r, out=distance)
    field = np.asarray(world.field.values, np.float64)
    if field.size:
        cell = (np.stack([y, x]) - np.asarray(world.field.origin, np.float64)[::-1, None]) / float(
            world.field.resolution
        ) - 0.5
        sampled = ndimage.map_coordinates(field, cell, order=1, mode="nearest")
        np.minimum(distance, sampled, out=distance)
    return distance


def _stacked(arrays: Sequence) -> Any:
    return np.stack([np.asarray(a) for a in arrays])


def stack_worlds(worlds: list[World], multiple_of: int = 1) -> World:
    """One batch `[B, ...]` of worlds, padded to common sizes with rows and cells never met.

    A field is padded by repeating its edge, which is also what sampling beyond the edge of an
    unpadded one gives.

    Args:
        worlds: On the host.
        multiple_of: The common numbers of boxes and of cylinders are rounded up to this: similar batches share programs.

    Raises:
        ValueError: If the list is empty, or mixes grid maps with worlds that have none.
    """
    if not worlds:
        raise ValueError("stack_worlds needs at least one world.")

    def rows(name: str, width: int) -> Any:
        count = -(-max(len(getattr(w, name)) for w in worlds) // multiple_of) * multiple_of
        out = np.zeros((len(worlds), count, width), np.float32)
        out[..., :2] = FAR
        for k, w in enumerate(worlds):
            out[k, : len(getattr(w, name))] = getattr(w, name)
        return out

    def looks(name: str) -> Any:
        count = -(-max(len(getattr(w, name).material) for w in worlds) // multiple_of) * multiple_of
        filled: list[Any] = [surfaces(count) for _ in worlds]
        for out, world in zip(filled, worlds, strict=True):
            given = getattr(world, name)
            out.material[: len(given.material)], out.colour[: len(given.colour)] = given
        return Surfaces(*(_stacked(parts) for parts in zip(*filled, strict=True)))

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
        box_surfaces=looks("box_surfaces"),
        cylinder_surfaces=looks("cylinder_surfaces"),
        scenery=Scenery(*(_stacked(parts) for parts in zip(*(w.scenery for w in worlds), strict=True))),
    )
