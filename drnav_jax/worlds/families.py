"""Seeded families of worlds: each puts a decision on the way from start to goal.

| family | what lies on the way |
|---|---|
| `open` | a field of cylinders and boxes, no dead end |
| `u` | a cul-de-sac in the open, its mouth to the start, the goal behind its back |
| `corridor` | a corridor straight toward the goal that ends, beside one that goes through |
| `t` | a stem and two arms that bend out of sight; the one nearer to the goal is blocked |
| `l` | a corridor toward the goal that turns and ends; a longer one aside goes through |

Each but `open` has an open twin (`u-open` ...): same seed, same everything, but the dead end has a
way through, which then is the shortest way. `corridor`, `t` and `l` are ways through a solid block
in a wall that runs on for `WING` metres to either side: nobody gets around it, yet all that is free
touches the edge of the ground truth. In `t` and `l` the robot starts inside a stem, in `corridor`
beside a fence, so that turning back never looks like a short way either.

A layout is drawn in a frame in which the trip runs along +x, from a generator seeded with (split,
family, seed); then it is mirrored, turned by a multiple of 90 degrees and a little more, and moved.
Clutter leaves `WAY` metres free all along every passage, blocked ones included.

`val` draws other seeds from the ranges of `train`; both are narrower than those of `test`. `RANGES`
is the table of what that means for each family.
"""

import math
import zlib

import numpy as np

from drnav_jax.worlds.layouts import LAYOUTS, clutter, world_of
from drnav_jax.worlds.world import Scene, rasterise

RESOLUTION = 0.1  # [m] of the ground truth
MARGIN = 3.0  # [m] of ground truth around everything but the wings
SPLITS = ("train", "val", "test")

# family: {what: (range of train and val, range of test)} [m, degrees, pieces].
RANGES: dict[str, dict[str, tuple[tuple[float, float], tuple[float, float]]]] = {
    "open": {
        "length": ((16, 22), (15, 28)),  # start to goal
        "count": ((8, 16), (6, 22)),  # obstacles
    },
    "u": {
        "ahead": ((4, 8), (3, 9)),  # start to mouth
        "depth": ((5, 8), (4, 10)),  # mouth to back wall
        "width": ((3, 4.2), (2.8, 4.7)),  # between the side walls, at the back
        "flare": ((0, 10), (-5, 20)),  # angle by which a side wall opens toward the mouth
        "door": ((1.6, 2.2), (1.4, 2.2)),  # in the back wall of the open twin
        "behind": ((4, 7), (3, 8)),  # back wall to goal
    },
    "corridor": {
        "ahead": ((2.5, 5), (2, 6)),  # start to block
        "depth": ((4, 7), (3.5, 10)),  # of the dead end
        "end": ((0.3, 1), (0.2, 2)),  # thickness of what closes it
        "width": ((1.8, 2.6), (1.5, 3)),  # of the dead end
        "through": ((1.8, 2.6), (1.5, 3)),  # width of the way through
        "aside": ((4, 6), (3.5, 8)),  # from one centre line to the other
        "behind": ((3, 5), (2, 6)),  # block to goal
    },
    "t": {
        "stem": ((6, 9), (5, 11)),  # start to the centre line of the arms
        "width": ((1.8, 2.6), (1.6, 3)),  # of stem and arms
        "arm": ((4.5, 6), (4, 7.5)),  # stem to the corner of the blocked arm
        "longer": ((-0.5, 1), (-0.5, 2)),  # by how much the other arm is longer
        "depth": ((2.5, 5), (2, 8)),  # corner to the end of the blocked arm
        "end": ((1.5, 3), (1, 4)),  # thickness of what closes it
        "behind": ((2, 4), (2, 5)),  # block to goal
    },
    "l": {
        "stem": ((5, 7), (4, 9)),  # start to fork
        "width": ((1.8, 2.6), (1.6, 3)),  # of all corridors
        "straight": ((4.5, 6.5), (3.5, 8.5)),  # fork to corner
        "depth": ((3, 5), (2.5, 7)),  # corner to dead end
        "end": ((1.5, 3), (1, 4)),  # from there to the far side of the block
        "aside": ((4.5, 6.5), (4, 8.5)),  # fork to the corner of the detour
        "behind": ((3, 5), (2, 6)),  # block to goal
    },
}
TURN = ((-5, 5), (-15, 15))  # of every layout, beyond a multiple of 90 degrees

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


def _moved(rows: list[np.ndarray], mirror: float, angle: float, shift: np.ndarray, has_yaw: bool):
    """Rows x, y(, yaw), ... mirrored at the x axis if `mirror` is -1, turned and moved."""
    out = []
    c, s = math.cos(angle), math.sin(angle)
    for row in rows:
        x, y = row[0], mirror * row[1]
        moved = np.array([c * x - s * y, s * x + c * y, *row[2:]], np.float64)
        moved[:2] += shift
        if has_yaw:
            moved[2] = math.remainder(mirror * row[2] + angle, 2 * math.pi)
        out.append(moved)
    return out


def sample(family: str, seed: int, split: str = "test") -> Scene:
    """The world of a family, a seed and a split.

    Args:
        family: One of `FAMILIES`.
        seed: Any integer >= 0; a family and its open twin share what a seed gives.
        split: "train", "val" or "test": other worlds each, and wider ranges in test (`RANGES`).

    Returns:
        The scene, with start and goal; its ground truth reaches `MARGIN` beyond everything but the
        wings, and outside is free.

    Raises:
        ValueError: If there is no such family or split, or the seed is negative.
    """
    if family not in FAMILIES:
        raise ValueError(f"unknown family {family!r}; there are {', '.join(FAMILIES)}.")
    if split not in SPLITS:
        raise ValueError(f"unknown split {split!r}; there are {', '.join(SPLITS)}.")
    if seed < 0:
        raise ValueError(f"a seed must be >= 0, got {seed}.")
    base = FAMILIES[family]
    key = zlib.crc32(f"{split}/{base}".encode())
    rng = np.random.default_rng(np.random.SeedSequence([key, seed]))
    which = 1 if split == "test" else 0
    layout = LAYOUTS[base](lambda name: rng.uniform(*RANGES[base][name][which]), rng)
    boxes, cylinders = clutter(layout, rng)

    mirror = rng.choice([-1.0, 1.0])
    angle = math.pi / 2 * rng.integers(4) + math.radians(rng.uniform(*TURN[which]))
    shift = rng.uniform(-5.0, 5.0, 2)
    start_yaw = math.remainder(angle + rng.uniform(-0.3, 0.3), 2 * math.pi)
    walls = layout.walls + (layout.plugs if family == base else layout.doorposts)
    world = world_of(
        _moved(walls + boxes, mirror, angle, shift, True),
        _moved(cylinders, mirror, angle, shift, False),
    )
    start, goal = _moved([np.array(layout.start), np.array(layout.goal)], mirror, angle, shift, False)
    x0, y0, x1, y1 = layout.hull
    corners = [np.array([x, y]) for x in (x0, x1) for y in (y0, y1)]
    extent = np.array([start, goal, *_moved(corners, mirror, angle, shift, False)])
    low = np.floor((extent.min(0) - MARGIN) / RESOLUTION) * RESOLUTION
    columns, rows = np.ceil((extent.max(0) + MARGIN - low) / RESOLUTION).astype(int)
    origin = (float(low[0]), float(low[1]))
    return Scene(
        name=f"{family}:{seed}",
        world=world,
        occupied=rasterise(world, origin, (int(rows), int(columns)), RESOLUTION),
        origin=origin,
        resolution=RESOLUTION,
        start=(float(start[0]), float(start[1]), start_yaw),
        goal=(float(goal[0]), float(goal[1])),
    )
