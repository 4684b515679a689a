"""Sites: compounds of single decisions, joined so that one trip holds several of them.

Modules are layouts of the other families, one behind the other in lanes between fences; a module's goal is the next
one's start. There are two lanes; the second leads back, around the end of the fence between them. Walls that run on
beside a module are cut off at the fences, so that nobody gets around it; the fence between start and goal runs on
beyond the site. Each module is closed or open by chance; the twins differ in one, which is closed in `site` and open in
`site-open`.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np

from drnav_jax.worlds.clutter import clutter
from drnav_jax.worlds.ranges import Draws
from drnav_jax.worlds.solids import WING, Draw, Layout, Solid, moved, moved_solid, wall, wings

GAP = 2.5  # [m] between two modules
YARD = 5.0  # [m] behind the first lane, to turn in
FENCE = 0.2  # [m] thickness
CLOSED = 0.6  # share of modules whose dead end is closed


LayoutOf = Callable[[Draw, np.random.Generator], Layout]


def _extent(solid: Solid) -> tuple[float, float]:
    """Least and largest x of a solid."""
    row = solid.row
    half = abs(math.cos(row[2])) * row[3] + abs(math.sin(row[2])) * row[4] if solid.is_box else row[2]
    return row[0] - half, row[0] + half


def _placed(layout: Layout, rng: np.random.Generator) -> tuple[Layout, float, float]:
    """A module with clutter in its corridors and nothing behind it; least and largest x of what it needs."""
    bare = dataclasses.replace(layout, yards=[])
    inside = [s for s in [*layout.solids, *clutter(bare, rng)] if s.row[0] < layout.hull[2] + 0.2]
    low = min([layout.hull[0], -1.0, *(_extent(s)[0] for s in inside)])
    return dataclasses.replace(layout, solids=inside), low, max([layout.hull[2], *(_extent(s)[1] for s in inside)])


def _clipped(solids: list[Solid], low: float, high: float) -> list[Solid]:
    """Solids of a lane: walls that run on beside a module end at the fences."""
    kept = []
    for solid in solids:
        row = solid.row.copy()
        if solid.is_box and row[3] > WING / 4 and abs(math.cos(row[2])) < 0.1:
            ends = np.clip([row[1] - row[3], row[1] + row[3]], low, high)
            if ends[1] - ends[0] < 0.05:
                continue
            row[1], row[3] = ends.mean(), (ends[1] - ends[0]) / 2
        kept.append(Solid(row, solid.role))
    return kept


def site_of(modules: Mapping[str, LayoutOf]) -> Callable[[Draws, np.random.Generator], Layout]:
    """The layout of `site`, made of modules by name."""
    names = sorted(modules)

    def site(draw: Draws, rng: np.random.Generator) -> Layout:
        count = round(draw("count"))
        usable = [name for name in names if draw.has(name)]
        chosen = [usable[k] for k in rng.permutation(len(usable))[:count]]
        parts = [_placed(modules[name](draw.of(name), rng), rng) for name in chosen]
        closed = rng.random(len(parts)) < CLOSED
        key = int(rng.integers(len(parts)))
        half = (len(parts) + 1) // 2
        lanes = [range(half), range(half, len(parts))]
        reach = [max(max(-parts[n][0].hull[1], parts[n][0].hull[3]) for n in lane) + 1.0 for lane in lanes]
        middles = [0.0, reach[0] + reach[1] + FENCE]
        solids: list[Solid] = []
        plugs: list[Solid] = []
        doorposts: list[Solid] = []
        ways: list[np.ndarray] = []
        turn_at, cursor = 0.0, parts[0][1]
        for k, lane in enumerate(lanes):
            side, angle = (1.0, 0.0) if k == 0 else (-1.0, math.pi)  # the second lane leads back
            for n in lane:
                layout, low, high = parts[n]
                origin = np.array([cursor - side * low, middles[k]])
                place = partial(_moved_all, angle=angle, shift=origin)
                solids += _clipped(place(layout.solids), middles[k] - reach[k], middles[k] + reach[k])
                if n == key:
                    plugs, doorposts = place(layout.plugs), place(layout.doorposts)
                else:
                    solids += place(layout.plugs if closed[n] else layout.doorposts)
                ways += [moved(way, 1.0, angle, origin) for way in layout.ways]
                cursor = origin[0] + side * (high + GAP)
            if k == 0:
                turn_at = cursor
        left = min(parts[0][1], cursor) - 0.5
        right = turn_at + YARD
        bottom, top = -reach[0], middles[1] + reach[1]
        fences = [wall((left, y), (right, y), FENCE, "fence") for y in (bottom, top)]
        fences += wings(left, bottom, top, FENCE, "fence")
        between = reach[0] + FENCE / 2
        fences += [
            wall((right, bottom), (right, top), FENCE, "fence"),
            wall((left - WING, between), (turn_at - GAP, between), FENCE, "fence"),
        ]
        goal = (cursor, middles[1])
        hull = (left, bottom - FENCE, right + FENCE, top + FENCE)
        return Layout(
            solids=solids + fences, plugs=plugs, doorposts=doorposts, ways=ways, hull=hull, start=(0.0, 0.0), goal=goal
        )

    return site


def _moved_all(solids: list[Solid], angle: float, shift: np.ndarray) -> list[Solid]:
    return [moved_solid(solid, 1.0, angle, shift) for solid in solids]
