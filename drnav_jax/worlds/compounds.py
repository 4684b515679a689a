"""Compounds: sites of houses and yards, 30-80 m across, on which a trip meets many decisions.

A site is a grid of cells of unequal size between walls (`cells`). Ways through the walls between cells are the edges of a
network (`networks`): a spanning tree and perhaps a few loops are open; what branches off the trip leads nowhere: into
corridors that end, lobbies, rooms, loading bays, parking lots, gardens, yards behind a pane. The open twin has some of
the shut ways open, one of which makes the trip shorter by `SAVING` metres or more. Shut ways are walls, or something
that stands across and elsewhere on the site is open (`closures`).

`decisions` counts branches off the trip, corridors that end in the houses on it and culs-de-sac in its yards.
"""

import math
from typing import NamedTuple

import numpy as np

from drnav_jax.worlds import networks
from drnav_jax.worlds.cells import EAST, NORTH, SOUTH, WEST, Cell, Port, hub
from drnav_jax.worlds.closures import close
from drnav_jax.worlds.covering import cover
from drnav_jax.worlds.houses import HOUSES, house
from drnav_jax.worlds.networks import Edge
from drnav_jax.worlds.ranges import Draws
from drnav_jax.worlds.solids import Layout, Point, Rect, Solid, box
from drnav_jax.worlds.yards import YARDS, yard

WING = 200.0  # [m] of wall to either side: nobody walks around the site
SAVING = 6.0  # [m] by which a shortcut is shorter
TRIES = 300  # networks drawn until one is as it should
TRIP = (45.0, 125.0)  # [m] least and greatest length of the way from cell to cell
CORNER = 1.4  # [m] between a port and the corner of a cell

KINDS: dict[str, tuple[str, ...]] = {
    "house": ("door", "glass", "wall", "glass"),
    "yard": ("crates", "drop", "drop", "cars", "wall"),
    "parking": ("cars", "cars", "crates"),
    "garden": ("hedge", "hedge", "crates"),
    "dock": ("drop", "drop", "crates"),
}
WIDTHS: dict[str, tuple[float, float]] = {
    "wall": (1.6, 3.8),
    "glass": (1.5, 3.8),
    "door": (1.02, 1.25),
    "hedge": (1.7, 3.2),
    "drop": (1.7, 3.4),
    "cars": (4.3, 4.9),
    "crates": (1.9, 3.6),
}  # [m] of the passages that each kind stands in


class _Plan(NamedTuple):
    """Who is whose neighbour, and how one gets from one to the other."""

    xs: list[float]  # centre lines of the walls along y
    ys: list[float]
    thick: float
    ways: set[Edge]  # open in both twins
    opened: list[Edge]  # open in the open one
    entry: int
    out: int
    trip: list[int]
    branches: int

    @property
    def columns(self) -> int:
        return len(self.xs) - 1

    def rect(self, node: int) -> Rect:
        """Of a cell, between its walls."""
        j, i = divmod(node, self.columns)
        h = self.thick / 2
        return (self.xs[i] + h, self.ys[j] + h, self.xs[i + 1] - h, self.ys[j + 1] - h)

    def side(self, node: int, other: int) -> int:
        """On which side of a cell its neighbour lies."""
        step = other - node
        return {1: EAST, -1: WEST, self.columns: NORTH, -self.columns: SOUTH}[step]


class _Passage(NamedTuple):
    """What stands in the wall between two cells."""

    kind: str
    middle: float  # along the wall
    width: float


def site(draw: Draws, rng: np.random.Generator) -> Layout:
    """A compound between a lane in which the robot starts and a gate on the far side, beyond which the goal lies."""
    plan = _plan(draw, rng)
    count = plan.columns * (len(plan.ys) - 1)
    kinds = _kinds(plan, draw, rng)
    widths = rng.uniform(1.8, 2.6, count).tolist()
    passages = _passages(plan, kinds, widths, draw, rng)
    ends = {n: _end(plan, kinds[n], widths[n], n, rng) for n in (plan.entry, plan.out)}
    blind, culs = _extras(plan, kinds, passages, int(draw("decisions")), rng)

    solids: list[Solid] = []
    plugs: list[Solid] = []
    doorposts: list[Solid] = []
    holes: list[Rect] = []
    ports: dict[int, list[Port]] = {n: [] for n in range(count)}
    for n, side in ((plan.entry, WEST), (plan.out, EAST)):
        ports[n].append(Port(side, *ends[n]))
    for number, (e, passage) in enumerate(sorted(passages.items())):
        for n, other in (e, e[::-1]):
            ports[n].append(Port(plan.side(n, other), passage.middle, passage.width))
        a, b, hole = _hole(plan, e, passage)
        holes.append(hole)
        made = close(passage.kind, a, b, plan.thick, 5.0 if passage.kind == "cars" else 2.4, rng, number=number)
        if e in plan.opened:
            solids, plugs, doorposts = solids + made.both, plugs + made.closed, doorposts + made.opened
        else:
            solids += made.fixed(is_open=e in plan.ways)
    hubs: list[Point] = []
    for n in range(count):
        cell = Cell(plan.rect(n), ports[n], blind.get(n, []), culs.get(n, 0), n)
        hubs.append(hub(cell))
        solids += house(cell, kinds[n], widths[n], rng) if kinds[n] in HOUSES else yard(cell, kinds[n], rng)

    stem, far = draw("stem"), plan.xs[-1]
    solids += _fences(plan, ends, holes, stem)
    start = (-stem + rng.uniform(0.8, 1.5), ends[plan.entry][0])
    goal = (far + draw("behind"), ends[plan.out][0] + rng.uniform(-2.0, 2.0))
    t = plan.thick
    return Layout(
        solids=solids,
        plugs=plugs,
        doorposts=doorposts,
        ways=[np.array([start, *(hubs[n] for n in plan.trip), goal])],
        hull=(-stem, -t / 2, far + t / 2, plan.ys[-1] + t / 2),
        start=start,
        goal=goal,
    )


def _plan(draw: Draws, rng: np.random.Generator) -> _Plan:
    columns, rows, loops, winding = int(draw("columns")), int(draw("rows")), draw("loops"), draw("winding")
    xs = np.cumsum([0.0, *(draw("cell") for _ in range(columns))]).tolist()
    ys = np.cumsum([0.0, *(draw("cell") for _ in range(rows))]).tolist()
    edges = networks.grid_edges(columns, rows)
    x, y = (np.array(v)[:-1] + np.diff(v) / 2 for v in (xs, ys))
    centre = [(x[n % columns], y[n // columns]) for n in range(columns * rows)]
    length = {e: math.dist(centre[e[0]], centre[e[1]]) for e in edges}
    wanted, more = int(draw("branches")), int(draw("more"))
    best: tuple | None = None
    for _ in range(TRIES):
        entry, out = (columns * int(rng.integers(rows)) + i for i in (0, columns - 1))
        tree = networks.grow(edges, int(rng.integers(columns * rows)), winding, rng)
        ways = networks.braid(edges, tree, loops, rng)
        way = networks.route(ways, length, entry, out)
        if not TRIP[0] <= way.length + 10.0 <= TRIP[1]:
            continue
        branches = networks.side_branches(ways, way.nodes)
        leads = set().union(*branches.values()) if branches else set()
        shut = [e for e in edges if e not in ways and leads & set(e)]
        short = networks.shortcuts(shut, ways, length, entry, out, SAVING)
        # A branch that lies toward the goal tempts.
        score = len(branches)
        if short and (best is None or score > best[0]):
            best = (score, ways, short, leads, entry, out, way.nodes)
        if best is not None and best[0] >= wanted:
            break
    if best is None:
        raise RuntimeError(f"{TRIES} sites of {columns} x {rows} cells had no shortcut.")
    score, ways, short, leads, entry, out, trip = best
    opened = [short[int(rng.integers(min(3, len(short))))]]
    others = [e for e in edges if e not in ways and e not in opened and leads & set(e)]
    opened += [others[k] for k in rng.permutation(len(others))[:more]]
    return _Plan(xs, ys, rng.uniform(0.25, 0.4), ways, opened, entry, out, trip, score)


def _kinds(plan: _Plan, draw: Draws, rng: np.random.Generator) -> list[str]:
    """What each cell is; a lobby has one way in. What a held-out family is about stays out of training here, too."""
    houses, yards = draw("houses"), [kind for kind in YARDS if kind != "dock" or draw.has("dock")]
    near = networks.neighbours(plan.ways | set(plan.opened))
    kinds = []
    for n in range(plan.columns * (len(plan.ys) - 1)):
        if rng.random() >= houses:
            kinds.append(yards[rng.integers(len(yards))])
        elif draw.has("lobby") and len(near[n]) == 1 and n not in (plan.entry, plan.out) and rng.random() < 0.6:
            kinds.append("lobby")
        else:
            kinds.append("rooms" if rng.random() < 0.6 else "corridors")
    return kinds


def _passages(
    plan: _Plan, kinds: list[str], widths: list[float], draw: Draws, rng: np.random.Generator
) -> dict[Edge, _Passage]:
    """Ways between cells, and places that only look like ways; plain walls are not among them."""
    out: dict[Edge, _Passage] = {}
    decoys, plain = draw("decoys"), draw("plain")
    for e in networks.grid_edges(plan.columns, len(plan.ys) - 1):
        shut = e not in plan.ways and e not in plan.opened
        if shut and ("lobby" in (kinds[e[0]], kinds[e[1]]) or rng.random() >= decoys):
            continue
        of = ["house" if kinds[n] in HOUSES else kinds[n] for n in e]
        wide = min([widths[n] for n in e if kinds[n] in HOUSES], default=9.0)
        rect = plan.rect(e[0])
        lo, hi = (rect[1], rect[3]) if abs(e[1] - e[0]) == 1 else (rect[0], rect[2])
        most = min(wide, hi - lo - 2 * CORNER)
        choices = [k for o in of for k in KINDS[o] if WIDTHS[k][0] <= most and not (k == "wall" and shut)]
        kind = choices[rng.integers(len(choices))] if choices else "door"
        if e in plan.ways and rng.random() < plain:
            kind = "wall"
        low, high = WIDTHS[kind]
        width = rng.uniform(low, min(high, most))
        middle = rng.uniform(lo + CORNER + width / 2, hi - CORNER - width / 2)
        out[e] = _Passage(kind, float(middle), float(width))
    return out


def _end(plan: _Plan, kind: str, width: float, node: int, rng: np.random.Generator) -> tuple[float, float]:
    """Middle and width of the passage from the lane into the first cell, or from the last one out."""
    _, y0, _, y1 = plan.rect(node)
    wide = width if kind in HOUSES else rng.uniform(1.8, 3.0)
    return float(rng.uniform(y0 + CORNER + wide / 2, y1 - CORNER - wide / 2)), float(wide)


def _extras(
    plan: _Plan, kinds: list[str], passages: dict[Edge, _Passage], wanted: int, rng: np.random.Generator
) -> tuple[dict[int, list[int]], dict[int, int]]:
    """Blind corridors in houses and culs-de-sac in yards on the trip, up to `wanted` decisions in all."""
    blind: dict[int, list[int]] = {}
    culs: dict[int, int] = {}
    met = plan.branches
    # A place in a house that only looks like a way ends a corridor.
    met += sum(
        kinds[n] in HOUSES for e in passages if e not in plan.ways for n in e if n in plan.trip
    )
    order = rng.permutation(plan.trip).tolist()
    for n in [*order, *order]:
        if met >= wanted:
            break
        if kinds[n] not in HOUSES:
            culs[n] = min(culs.get(n, 0) + 1, 1)
            met += 1
            continue
        used = {plan.side(n, o) for e in passages if n in e for o in e if o != n} | set(blind.get(n, []))
        used |= {WEST} if n == plan.entry else set()
        used |= {EAST} if n == plan.out else set()
        left = [s for s in (EAST, NORTH, WEST, SOUTH) if s not in used]
        if left:
            blind.setdefault(n, []).append(left[rng.integers(len(left))])
            met += 1
    for n in range(len(kinds)):  # elsewhere, too
        if n not in plan.trip and kinds[n] in YARDS and rng.random() < 0.3:
            culs[n] = 1
    return blind, culs


def _hole(plan: _Plan, e: Edge, passage: _Passage) -> tuple[Point, Point, Rect]:
    """Jambs of a passage, and the hole in the wall."""
    x0, y0, x1, y1 = plan.rect(e[0])
    h, t, w = passage.width / 2, plan.thick, passage.middle
    if plan.side(*e) == EAST:
        x = x1 + t / 2
        return (x, w - h), (x, w + h), (x1, w - h, x1 + t, w + h)
    y = y1 + t / 2
    return (w - h, y), (w + h, y), (w - h, y1, w + h, y1 + t)


def _fences(plan: _Plan, ends: dict[int, tuple[float, float]], holes: list[Rect], stem: float) -> list[Solid]:
    """The walls around all cells, the lane in which the robot starts, and the wings."""
    h, low, high = plan.thick / 2, plan.ys[0], plan.ys[-1]
    walls = [(x - h, low - h, x + h, high + h) for x in plan.xs]
    walls += [(plan.xs[0] - h, y - h, plan.xs[-1] + h, y + h) for y in plan.ys]
    for n, x in ((plan.entry, plan.xs[0]), (plan.out, plan.xs[-1])):
        y, width = ends[n]
        holes = [*holes, (x - h, y - width / 2, x + h, y + width / 2)]
    y, width = ends[plan.entry]
    lane = [(-stem, y - width / 2 - 2 * h, h, y - width / 2), (-stem, y + width / 2, h, y + width / 2 + 2 * h)]
    wings = [(-h, a, h, b) for a, b in ((low - WING, low - h), (high + h, high + WING))]
    return [box(r) for r in [*cover([*walls, *lane], holes), *wings]]
