"""Seeded families of worlds: each puts a decision on the way from start to goal.

| family | what lies on the way |
|---|---|
| `open` | a field of cylinders and boxes, no dead end |
| `u` | a cul-de-sac in the open, its mouth to the start, the goal behind its back |
| `corridor` | a corridor straight toward the goal that ends, beside one that goes through |
| `t` | a stem and two arms that bend out of sight; the one nearer to the goal is blocked |
| `t-both` | a stem and two arms that are both blocked; a way round leaves the stem before |
| `l` | a corridor toward the goal that turns and ends; a longer one aside goes through |
| `lobby` | a corridor that ends in a lobby with lifts; the open twin has a passage in place of one |
| `room` | a room with a door to come in by and a second one, which is shut |
| `glass` | a hall that a glass wall crosses; the open twin's door bay is an empty frame |
| `dock` | a deck that ends at the painted edge of a drop; the open twin's paint is on level ground |
| `cars` | an aisle between parked cars that ends at a row of them; in the open twin one is missing |
| `trail` | a trail that bushes cross; in the open twin it is tall grass, which is no obstacle |
| `field` | clutter that stands in pockets, one of them on the way |
| `maze` | a maze of walls or hedges |
| `office` | an office floor: corridors and cross corridors, some shut halfway, rooms with a door or two |
| `site` | a compound of houses and yards, 30-80 m across, in which all of the above occur |

Each but `open` has an open twin (`u-open` ...): same seed, same everything, but the dead end has a
way through, which then is the shortest way; of the last three families, that hold many decisions, some of the dead
ends have one. All but `open`, `u` and `field` are ways through a solid
block in a wall that runs on for `WING` metres to either side: nobody gets around it, yet all that is
free touches the edge of the ground truth. The robot starts inside a stem, in `corridor` beside a
fence, so that turning back never looks like a short way either.

What only one sensor tells apart occurs in both meanings, in both twins: empty frames that one passes
and panes that close nothing, grass on the way round, paint across it and a drop that is not in the
way, lifts and shut doors along a way that goes through, rows of cars beside it.

A layout is drawn in a frame in which the trip runs along +x, from a generator seeded with (split,
family, seed); then it is mirrored, turned by a multiple of 90 degrees and a little more, and moved.
Clutter leaves `WAY` metres free all along every passage, blocked ones included. What it looks like
comes from other generators (`dressing`).

`val` draws other seeds from the ranges of `train`; both are narrower than those of `test` (`ranges`,
`dressing.LIGHT`). The families of `HELD_OUT` exist in `test` only.
"""

import math
import zlib

import numpy as np

from drnav_jax.worlds import indoor, layouts, outdoor
from drnav_jax.worlds.clutter import clutter
from drnav_jax.worlds.compounds import site
from drnav_jax.worlds.dressing import SETTINGS, Look
from drnav_jax.worlds.mazes import maze
from drnav_jax.worlds.offices import office
from drnav_jax.worlds.ranges import HELD_OUT, TURN, Draws
from drnav_jax.worlds.solids import moved, moved_solid
from drnav_jax.worlds.world import Scene, rasterise

RESOLUTION = 0.1  # [m] of the ground truth
MARGIN = 3.0  # [m] of ground truth around everything but the wings
SPLITS = ("train", "val", "test")
MANY = {"maze": maze, "office": office, "site": site}  # families of many decisions
LAYOUTS = {**layouts.LAYOUTS, **indoor.LAYOUTS, **outdoor.LAYOUTS, **MANY}

# Name of each family -> name of the one whose dead ends are closed.
FAMILIES: dict[str, str] = {name: name for name in LAYOUTS} | {
    f"{name}-open": name for name in LAYOUTS if name != "open"
}


def twin(family: str) -> str | None:
    """The open twin of a family, or the closed one of an open twin; None if there is none."""
    closed = FAMILIES.get(family)
    if closed is None or closed == "open":
        return None
    return closed if closed != family else f"{family}-open"


def sample(family: str, seed: int, split: str = "test") -> Scene:
    """The world of a family, a seed and a split.

    Args:
        family: One of `FAMILIES`.
        seed: Any integer >= 0; a family and its open twin share what a seed gives.
        split: "train", "val" or "test": other worlds each, and wider ranges in test.

    Returns:
        The scene, with start and goal; its ground truth reaches `MARGIN` beyond everything but the
        wings, and outside is free.

    Raises:
        ValueError: If there is no such family or split, the seed is negative, or the family is held
            out and the split is not "test".
    """
    if family not in FAMILIES:
        raise ValueError(f"unknown family {family!r}; there are {', '.join(FAMILIES)}.")
    if split not in SPLITS:
        raise ValueError(f"unknown split {split!r}; there are {', '.join(SPLITS)}.")
    if seed < 0:
        raise ValueError(f"a seed must be >= 0, got {seed}.")
    base = FAMILIES[family]
    if base in HELD_OUT and split != "test":
        raise ValueError(f'family {family!r} is held out of training: it has no split {split!r}, only "test".')
    test = split == "test"
    key = zlib.crc32(f"{split}/{base}".encode())
    rng = np.random.default_rng(np.random.SeedSequence([key, seed]))

    layout = LAYOUTS[base](Draws(base, test, rng), rng)
    placed = clutter(layout, rng)

    mirror = rng.choice([-1.0, 1.0])
    angle = math.pi / 2 * rng.integers(4) + math.radians(rng.uniform(*TURN[test]))
    shift = rng.uniform(-5.0, 5.0, 2)
    start_yaw = math.remainder(angle + rng.uniform(-0.3, 0.3), 2 * math.pi)
    solids = layout.solids + (layout.plugs if family == base else layout.doorposts) + placed
    look = Look(SETTINGS[base], [key, seed], test)
    world = look.world([moved_solid(s, mirror, angle, shift) for s in solids])
    x0, y0, x1, y1 = layout.hull
    corners = [[x, y] for x in (x0, x1) for y in (y0, y1)]
    extent = moved(np.array([layout.start, layout.goal, *corners]), mirror, angle, shift)
    start, goal = extent[:2]
    low = np.floor((extent.min(0) - MARGIN) / RESOLUTION) * RESOLUTION
    columns, rows = np.ceil((extent.max(0) + MARGIN - low) / RESOLUTION).astype(int)
    origin = (float(low[0]), float(low[1]))
    other = twin(family)
    return Scene(
        name=f"{family}:{seed}",
        world=world,
        occupied=rasterise(world, origin, (int(rows), int(columns)), RESOLUTION),
        origin=origin,
        resolution=RESOLUTION,
        start=(float(start[0]), float(start[1]), start_yaw),
        goal=(float(goal[0]), float(goal[1])),
        family=family,
        split=split,
        twin=f"{other}:{seed}" if other else None,
        closed=other is not None and family == base,
        strata=look.strata(layout.solids + layout.plugs + layout.doorposts),
    )
