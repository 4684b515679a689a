"""Litter: legs of chairs and tables, posts, and what makes walls rough, for the worlds that training frames are drawn in.

Robots' own maps are full of such things, a cell or two each, and the families of worlds have none. A network that has never
seen any takes the floor between them for panes of glass. Twins get the same litter; the shortest way of each stays free.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage

from drnav_jax.worlds.clutter import to_polyline
from drnav_jax.worlds.dressing import COLOURS
from drnav_jax.worlds.materials import Material
from drnav_jax.worlds.trips import check_trip
from drnav_jax.worlds.world import Scene, Surfaces, rasterise

CELL = 0.1  # [m] of the families' grids
THINGS = (6, 24)  # tried in a world
PIECES = 48  # at most that stand in it
ALONG_WALLS = 0.4  # share of things
RADIUS = (0.02, 0.07)  # [m] of a piece
HEIGHT = (0.4, 2.2)  # [m]
ENDS = 0.6  # [m] around start and goal that stays free
BODY = 0.25  # [m] radius of the robot whose ways stay free
FREE = 0.45  # [m] to either side of its ways
REACH = 6.0  # [m] from its ways within which there is litter
MATERIALS = (Material.WOOD, Material.METAL, Material.WALL, Material.CONCRETE)


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
    free, beside = np.argwhere(free), np.argwhere(free & ndimage.binary_dilation(occupied))
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


def _near(ways: Sequence[np.ndarray], scene: Scene) -> np.ndarray:
    """Cells `[H, W]` within `REACH` of a way."""
    apart = np.ones(scene.occupied.shape, bool)
    for way in ways:
        steps = np.linspace(0.0, 1.0, 200)
        length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
        along = np.stack([np.interp(steps * length[-1], length, way[:, k]) for k in (1, 0)], axis=-1)
        cells = np.floor((along - np.asarray(scene.origin)[::-1]) / scene.resolution).astype(int)
        i, j = np.clip(cells, 0, np.array(apart.shape) - 1).T
        apart[i, j] = False
    return ndimage.distance_transform_edt(apart) * scene.resolution < REACH


def littered(twins: Sequence[Scene], rng: np.random.Generator) -> list[Scene]:
    """The scenes with litter, the same in each.

    Args:
        twins: A world and its twin, on the same grid with cells of 0.1 m, or one world alone.
        rng: Randomness.
    """
    first = twins[0]
    occupied = np.any([scene.occupied for scene in twins], axis=0)
    ways = [check_trip(scene, BODY)[1] for scene in twins]
    ends = np.array([np.array(scene.start)[:2] for scene in twins] + [scene.goal for scene in twins])
    rows: list[list[float]] = []
    for cells in _things(occupied, _near(ways, first), rng):
        j, i = np.floor(cells).astype(int).T
        inside = (i >= 0) & (i < occupied.shape[0]) & (j >= 0) & (j < occupied.shape[1])
        xy = np.asarray(first.origin) + cells * first.resolution
        away = np.min([to_polyline(xy, way) for way in ways], axis=0) > FREE
        away &= np.linalg.norm(xy[:, None] - ends, axis=-1).min(1) > ENDS
        height = rng.uniform(*HEIGHT)
        for k in np.flatnonzero(inside & away):
            if not occupied[i[k], j[k]] and len(rows) < PIECES:
                rows.append([*xy[k], rng.uniform(*RADIUS), 0.0, height])
    made_of = [MATERIALS[rng.integers(len(MATERIALS))] for _ in rows]
    colours = [COLOURS[m][rng.integers(len(COLOURS[m]))] for m in made_of]
    return [_with(scene, rows, made_of, colours) for scene in twins] if rows else list(twins)


def _with(scene: Scene, rows: list[list[float]], materials: list[Material], colours: list[tuple]) -> Scene:
    """The scene and some cylinders."""
    world = scene.world
    held = world.cylinder_surfaces
    world = world._replace(
        cylinders=np.concatenate([world.cylinders, np.asarray(rows, np.float32)]),
        cylinder_surfaces=Surfaces(
            np.concatenate([held.material, np.asarray(materials, np.int32)]),
            np.concatenate([held.colour, np.asarray(colours, np.float32)]),
        ),
    )
    return replace(scene, world=world, occupied=rasterise(world, scene.origin, scene.occupied.shape, scene.resolution))
