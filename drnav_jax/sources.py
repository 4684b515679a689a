"""Worlds and trips as one names them: a seeded family, a map file, a BARN world, a Moving AI map."""

import contextlib
import dataclasses
import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from drnav_jax import worlds
from drnav_jax.worlds import Scene

MIN_TRIP = 8.0  # [m] least length of sampled trips
MAX_TRIP = 100.0  # [m] longest trip taken from a Moving AI scenario
CELL = 1.0  # [m] of Moving AI maps: the robot must fit through one
OUTSIDE_GAP = 1.0  # [m] the light outside of a floor plan comes in through gaps that are wider
ONE_OF = "--world FAMILY:SEED, --map FILE, --barn FILE_OR_DIR or --movingai FILE"


@dataclasses.dataclass(frozen=True)
class Source:
    """What the flags of the same names say.

    Attributes:
        world: FAMILY:SEED.
        map: map_server yaml or image.
        barn: BARN `.world` file or a folder of them.
        movingai: Moving AI `.map`.
        resolution: Edge of a cell of an image or a Moving AI map [m].
        start: "X,Y,YAW".
        goal: "X,Y".
        episodes: Seeds of a family, sampled trips of a map, repeats of a given trip.
        seed: Of the sampled trips.
        split: Of a family.
    """

    world: str | None = None
    map: Path | None = None
    barn: Path | None = None
    movingai: Path | None = None
    resolution: float | None = None
    start: str | None = None
    goal: str | None = None
    episodes: int = 1
    seed: int = 0
    split: str = "test"

    def __post_init__(self) -> None:
        """Check what does not need a file."""
        given = [name for name in ("world", "map", "barn", "movingai") if getattr(self, name) is not None]
        if len(given) != 1:
            got = " and ".join(f"--{name}" for name in given) or "none"
            raise ValueError(f"give exactly one of {ONE_OF}; got {got}.")
        if self.episodes < 1 or self.seed < 0:
            raise ValueError(f"--episodes must be >= 1 and --seed >= 0, got {self.episodes} and {self.seed}.")
        if self.resolution is not None and given[0] in ("world", "barn"):
            raise ValueError(f"--resolution belongs to --map or --movingai, not to --{given[0]}.")


def _numbers(text: str | None, count: int, flag: str, what: str) -> tuple[float, ...] | None:
    if text is None:
        return None
    try:
        values = tuple(float(word) for word in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count or not all(map(math.isfinite, values)):
        raise ValueError(f'{flag} must be {what}, {count} numbers with commas between them, got "{text}".')
    return values


def load(source: Source, radius: float, clearance: float) -> list[Scene]:
    """The worlds and trips that are named.

    Args:
        source: What is named.
        radius: Of the robot [m].
        clearance: Distance that sampled trips keep to walls, from the robot's centre [m].

    Raises:
        ValueError: If a name, a number or a file is malformed, or there is no such trip.
    """
    start, goal = _numbers(source.start, 3, "--start", "X,Y,YAW"), _numbers(source.goal, 2, "--goal", "X,Y")
    trip: dict[str, Any] = {name: v for name, v in (("start", start), ("goal", goal)) if v is not None}
    if trip:
        trip["reference_length"] = None  # it belonged to another trip
    if source.world is not None:
        family, _, seed = source.world.partition(":")
        if not (family and seed.isascii() and seed.isdigit()):
            raise ValueError(f'--world must be FAMILY:SEED such as u:0, got "{source.world}".')
        scenes = [worlds.sample(family, int(seed) + k, source.split) for k in range(source.episodes)]
        return [dataclasses.replace(scene, **trip) for scene in scenes]
    if source.barn is not None:
        files = [source.barn]
        if source.barn.is_dir():
            number = lambda f: (int(re.sub(r"\D", "", f.stem) or 0), f.name)  # noqa: E731
            files = sorted(source.barn.glob("*.world"), key=number)
            if not files:
                raise ValueError(f"{source.barn}: there is no .world file in this folder.")
        return [dataclasses.replace(worlds.load_barn(f), **trip) for f in files for _ in range(source.episodes)]
    scene = _map_scene(source)
    if len(trip) == 3:
        return [dataclasses.replace(scene, **trip)] * source.episodes
    if trip:
        raise ValueError("a map has no trip of its own: give both --start and --goal, or neither.")
    found = _scenario_trips(source, scene, radius, clearance)
    return found or worlds.sample_trips(scene, source.episodes, source.seed, clearance, MIN_TRIP)


def states_scale(file: Path) -> bool:
    """Whether a map's file says how large a cell is: map_server's does, an image does not."""
    return file.suffix.lower() in (".yaml", ".yml")


def _map_scene(source: Source) -> Scene:
    if source.movingai is not None:
        return worlds.load_moving_ai(source.movingai, CELL if source.resolution is None else source.resolution)
    assert source.map is not None
    if states_scale(source.map):
        if source.resolution is not None:
            raise ValueError(f"{source.map} states its own resolution: leave out --resolution.")
        return worlds.load_map_server(source.map)
    if source.map.suffix.lower() == ".map":
        raise ValueError(f"{source.map} looks like a Moving AI map: use --movingai.")
    if source.resolution is None:
        raise ValueError(f"{source.map} has no scale: add --resolution M, the edge of a pixel in metres.")
    with contextlib.suppress(ValueError):  # of a plan without closed outer walls nothing would be left
        return worlds.load_floor_plan(source.map, source.resolution, OUTSIDE_GAP)
    return worlds.load_floor_plan(source.map, source.resolution)


def _scenario_trips(source: Source, scene: Scene, radius: float, clearance: float) -> list[Scene]:
    """Trips of the scenario beside a Moving AI map, drawn by seed; none if too few are of a length for a robot."""
    file = None if source.movingai is None else source.movingai.with_name(source.movingai.name + ".scen")
    if file is None or not file.is_file():
        return []
    lines = worlds.load_scenario(file)
    fit = [line for line in lines if MIN_TRIP <= line.optimal_length * scene.resolution <= MAX_TRIP]
    trips: list[Scene] = []
    for k in np.random.default_rng(np.random.SeedSequence(source.seed)).permutation(len(fit)):
        trip = dataclasses.replace(
            worlds.with_scenario(scene, fit[k]), name=f"{scene.name}#{len(trips)}", reference_length=None
        )
        with contextlib.suppress(ValueError):  # the robot is no point: not every trip is one for it
            worlds.check_trip(trip, radius, clearance)
            trips.append(trip)
        if len(trips) == source.episodes:
            return trips
    return []
