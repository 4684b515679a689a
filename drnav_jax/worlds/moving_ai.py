"""Worlds out of Moving AI benchmark files: `.map` grids and the trips of `.scen` files.

A cell is passable if it is ground (`.`, `G`) or swamp (`S`); out of bounds (`@`, `O`), trees (`T`)
and water (`W`) are not. Scenarios count cells (x, y) from the upper left corner of the map; in the
world the lower left corner of the map is the origin and y points up.
"""

import dataclasses
import math
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drnav_jax.worlds.maps import check_resolution, map_scene, need_free, read_text
from drnav_jax.worlds.world import Scene

PASSABLE, BLOCKED = ".GS", "@OTW"


class ScenarioTrip(NamedTuple):
    """One line of a Moving AI scenario. Cells are (x, y) with y counted from the top of the map."""

    bucket: int
    map_name: str
    size: tuple[int, int]  # (width, height) of the map [cells]
    start: tuple[int, int]
    goal: tuple[int, int]
    optimal_length: float  # octile length of the shortest path [cells]


def load_moving_ai(path: str | os.PathLike, resolution: float) -> Scene:
    """The world of a Moving AI `.map`: ground and swamp can be driven on, nothing else.

    Args:
        path: The map; its lower left corner becomes the world's origin, its first line is the top.
        resolution: Edge of a cell [m]. The robot must fit through one cell.

    Raises:
        ValueError: If the file is not such a map, or the resolution is not > 0.
    """
    where = str(path)
    resolution = check_resolution(resolution, where)
    lines = read_text(Path(path)).splitlines()
    try:
        kind, height, width, body = (line.split() for line in lines[:4])
        if kind != ["type", "octile"] or body != ["map"]:
            raise ValueError
        if (height[0], width[0]) != ("height", "width"):
            raise ValueError
        h, w = int(height[1]), int(width[1])
    except (ValueError, IndexError):
        raise ValueError(
            f"{where}: must begin with the lines 'type octile', 'height H', 'width W', 'map'."
        ) from None
    rows = lines[4 : 4 + h]
    if h < 1 or w < 1 or len(rows) != h or any(line.strip() for line in lines[4 + h :]):
        raise ValueError(f"{where}: says {h} rows of {w} cells, holds {len(lines) - 4} lines of map.")
    for k, row in enumerate(rows):
        if len(row) != w:
            raise ValueError(f"{where}: line {k + 5} has {len(row)} cells, the width is {w}.")
        if unknown := set(row) - set(PASSABLE + BLOCKED):
            raise ValueError(
                f"{where}: line {k + 5} holds {sorted(unknown)}; "
                f"a cell is one of {PASSABLE + BLOCKED}."
            )
    occupied = ~np.array([[cell in PASSABLE for cell in row] for row in rows])[::-1]
    need_free(occupied, where, f"free cells are one of {PASSABLE}.")
    return map_scene(Path(path).stem, occupied, (0.0, 0.0), resolution)


def load_scenario(path: str | os.PathLike) -> list[ScenarioTrip]:
    """The trips of a Moving AI `.scen`, in the file's order.

    Raises:
        ValueError: If the file is not such a scenario; names the line.
    """
    lines = read_text(Path(path)).splitlines()
    if not lines or not lines[0].startswith("version"):
        raise ValueError(f"{path}: must begin with the line 'version 1'.")
    trips = []
    for number, line in enumerate(lines[1:], 2):
        if not line.strip():
            continue
        fields = line.split("\t") if "\t" in line else line.split()
        try:
            bucket, name, w, h, x0, y0, x1, y1, length = (field.strip() for field in fields)
            trip = ScenarioTrip(
                bucket=int(bucket),
                map_name=name,
                size=(int(w), int(h)),
                start=(int(x0), int(y0)),
                goal=(int(x1), int(y1)),
                optimal_length=float(length),
            )
        except ValueError:
            raise ValueError(
                f"{path}: line {number} must be bucket, map, width, height, start x, start y, "
                f"goal x, goal y, length; got {line[:80]!r}."
            ) from None
        if not math.isfinite(trip.optimal_length) or trip.optimal_length < 0:
            raise ValueError(f"{path}: line {number} has the length {length}; it must be >= 0.")
        for x, y in (trip.start, trip.goal):
            if not (0 <= x < trip.size[0] and 0 <= y < trip.size[1]):
                raise ValueError(
                    f"{path}: line {number}: cell {(x, y)} is outside a map of {trip.size} cells."
                )
        trips.append(trip)
    return trips


def with_scenario(scene: Scene, trip: ScenarioTrip) -> Scene:
    """The scene of a map with the start, the goal and the optimal length of one of its trips.

    The reference length is octile (8 directions), so an any-angle path may be up to 8 % shorter.

    Raises:
        ValueError: If the trip belongs to a map of another size.
    """
    r = scene.resolution
    # The map's lower left corner is the origin; `map_scene` may have put walls around it.
    ring = round(-scene.origin[0] / r)
    height, width = (n - 2 * ring for n in scene.occupied.shape)
    if trip.size != (width, height):
        raise ValueError(
            f"the trip is for a map of {trip.size} cells ({trip.map_name}), {scene.name} has "
            f"{(width, height)}; load the scenario that belongs to the map."
        )

    def centre(cell: tuple[int, int]) -> tuple[float, float]:
        return ((cell[0] + 0.5) * r, (height - 1 - cell[1] + 0.5) * r)

    start, goal = centre(trip.start), centre(trip.goal)
    yaw = math.atan2(goal[1] - start[1], goal[0] - start[0])
    return dataclasses.replace(
        scene, start=(*start, yaw), goal=goal, reference_length=trip.optimal_length * r
    )
