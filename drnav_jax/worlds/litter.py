"""Worlds of the families as a robot's own map has them, for the worlds that training frames are drawn in.

`littered`: with legs of chairs and tables, posts, and what makes walls rough; the families of worlds have none. `charted`:
the same as an occupancy grid whose cells are extruded, as every map is that a robot drives in here. To a network that has
never seen such walls all of a real building is doubtful. Twins get the same litter; the shortest way of each stays free.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import ndimage

from drnav_jax.worlds.dressing import COLOURS
from drnav_jax.worlds.materials import Material
from drnav_jax.worlds.trips import check_trip
from drnav_jax.worlds.world import Scene, Surfaces, from_grid, rasterise, surfaces

CELL = 0.1  # [m] of the families' grids
THINGS = (6, 24)  # tried in a world
PIECES = 48  # at most that stand in it
ALONG_WALLS = 0.4  # share of things
RADIUS = (0.02, 0.07)  # [m] of a piece
HEIGHT = (0.4, 2.2)  # [m]
ENDS = 0.6  # [m] around start and goal that stays free
BODY = 0.25  # [m] radius of the robot whose ways stay free
FREE = 0.45  # [m] to either side of its ways
ROUGH = 0.4  # most of the cells along a wall that are added to it
PLAIN = 0.6  # share of charted worlds that look as maps do
REACH = 6.0  # [m] from its ways within which there is litter
MATERIALS = (Material.WOOD, Material.METAL, Material.WALL, Material.CONCRETE)


def _grown(mask: np.ndarray) -> np.ndarray:
    """True cells and those beside them."""
    return np.asarray(ndimage.binary_dilation(mask), bool)


def _legs(rng: np.random.Generator) -> np.ndarray:
    """Pieces of one thing `[N, 2]` [m]: a chair, a table, or posts in a row."""
    kind, n = rng.integers(3), rng.integers(2, 7)
    if kind == 2:
        return np.stack([np.arange(n) * rng.uniform(0.4, 1.5), np.zeros(n)], axis=-1)
    half = rng.uniform(0.17, 0.27, 2) if kind == 0 else rng.uniform(0.3, 0.9, 2)
    return np.array([[a, b] for a in (-1, 1) for b in (-1, 1)]) * half


def _things(occupied: np.ndarray, near_ways: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
    """Pieces of things in free places `[N, 2]`, x and y in cells."""
    free = ~occupied & near_ways
    free, beside = np.argwhere(free), np.argwhere(free & _grown(occupied))
    found = []
    for _ in range(rng.integers(*THINGS) if len(free) else 0):
        if len(beside) and rng.random() < ALONG_WALLS:
            middle = beside[rng.integers(len(beside))]
            near = beside[np.abs(beside - middle).max(1) <= 8]
            chosen = near[rng.integers(len(near), size=rng.integers(3, 10))]
            found.append(chosen[:, ::-1] + rng.uniform(0.0, 1.0, chosen.shape))
        else:
            middle, turn = free[rng.integers(len(free))], rng.uniform(-math.pi, math.pi)
            c, s = math.cos(turn), math.sin(turn)
            found.append(middle[::-1] + 0.5 + _legs(rng) / CELL @ np.array([[c, s], [-s, c]]))
    return found


def _apart(twins: Sequence[Scene]) -> np.ndarray:
    """Distance `[H, W]` [m] of cells to the shortest ways."""
    first = twins[0]
    h, w = first.occupied.shape
    away = np.ones((h, w), bool)
    for scene in twins:
        way = check_trip(scene, BODY)[1]
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
        at = np.arange(0.0, length[-1], first.resolution / 2)
        along = np.stack([np.interp(at, length, way[:, k]) for k in (1, 0)], axis=-1)
        i, j = np.floor((along - np.asarray(first.origin)[::-1]) / first.resolution).astype(int).T
        inside = (i >= 0) & (i < h) & (j >= 0) & (j < w)
        away[i[inside], j[inside]] = False
    return np.asarray(ndimage.distance_transform_edt(away)) * first.resolution


def _pieces(twins: Sequence[Scene], apart: np.ndarray, rng: np.random.Generator) -> list[np.ndarray]:
    """Pieces of things that stand in nobody's way `[N, 2]`, x and y in cells."""
    first = twins[0]
    occupied = np.any([scene.occupied for scene in twins], axis=0)
    ends = np.array([np.array(scene.start)[:2] for scene in twins] + [scene.goal for scene in twins])
    found, left = [], PIECES
    for cells in _things(occupied, apart < REACH, rng):
        j, i = np.floor(cells).astype(int).T
        inside = (i >= 0) & (i < occupied.shape[0]) & (j >= 0) & (j < occupied.shape[1])
        cells, i, j = cells[inside], i[inside], j[inside]
        xy = np.asarray(first.origin) + cells * first.resolution
        fits = ~occupied[i, j] & (apart[i, j] > FREE) & (np.linalg.norm(xy[:, None] - ends, axis=-1).min(1) > ENDS)
        found.append(cells[fits][:left])
        left -= len(found[-1])
    return found


def littered(twins: Sequence[Scene], rng: np.random.Generator) -> list[Scene]:
    """The scenes with litter, the same in each.

    Args:
        twins: A world and its twin, on the same grid with cells of `CELL`, or one world alone.
        rng: Randomness.
    """
    first = twins[0]
    rows: list[list[float]] = []
    for cells in _pieces(twins, _apart(twins), rng):
        height = rng.uniform(*HEIGHT)
        xy = np.asarray(first.origin) + cells * first.resolution
        rows += [[x, y, rng.uniform(*RADIUS), 0.0, height] for x, y in xy]
    made_of = [MATERIALS[rng.integers(len(MATERIALS))] for _ in rows]
    colours = [COLOURS[m][rng.integers(len(COLOURS[m]))] for m in made_of]
    return [_with(scene, rows, made_of, colours) for scene in twins] if rows else list(twins)


def charted(twins: Sequence[Scene], rng: np.random.Generator) -> list[Scene]:
    """The scenes as occupancy grids with litter and rough walls, the same in each; they look as maps do, or as they did.

    Args:
        twins: As above. A pane or a drop becomes a wall, and grass is gone: a map's own walls hide nothing from a sensor.
        rng: Randomness.
    """
    apart = _apart(twins)
    added = (apart > FREE) & (rng.random(apart.shape) < rng.uniform(0.0, ROUGH))
    added &= _grown(np.all([scene.occupied for scene in twins], axis=0))
    for cells in _pieces(twins, apart, rng):
        j, i = np.floor(cells).astype(int).T
        added[i, j] = True
    plain = rng.random() < PLAIN
    return [_drawn(scene, scene.occupied | added, plain) for scene in twins]


def _drawn(scene: Scene, occupied: np.ndarray, plain: bool) -> Scene:
    """The scene as a grid."""
    world = from_grid(occupied, scene.origin, scene.resolution)
    world = world if plain else world._replace(scenery=scene.world.scenery)
    return replace(scene, world=world, occupied=occupied, strata=())


def _joined(a: Any, b: Any) -> Any:
    """Rows after rows."""
    return np.concatenate([a, b])


def _with(scene: Scene, rows: list[list[float]], materials: list[Material], colours: list[tuple]) -> Scene:
    """The scene and some cylinders."""
    world = scene.world
    added = surfaces(len(rows), materials, colours)
    world = world._replace(
        cylinders=np.concatenate([world.cylinders, np.asarray(rows, np.float32)]),
        cylinder_surfaces=Surfaces(*map(_joined, world.cylinder_surfaces, added)),
    )
    return replace(scene, world=world, occupied=rasterise(world, scene.origin, scene.occupied.shape, scene.resolution))
