"""Procedural office floors: corridors, rooms along them, corridor ends, doors open and shut, glass, furniture.

Corridors along x and cross corridors along y make a grid; rooms stand along the former, in one row or back to back.
Where a block between two corridors has a *hall*, one may cross it by its two doors. Corridors and halls are the edges of a
network (`networks`): some are shut halfway, so that both their halves are corridor ends. The open twin has one that makes
the trip shorter by `SAVING` metres or more open, and perhaps others. Rooms have one door, or none: then nothing but the
leaf in the wall is built.
"""

import math
from typing import NamedTuple

import numpy as np

from drnav_jax.worlds import networks
from drnav_jax.worlds.closures import FRAME, close, fits
from drnav_jax.worlds.clutter import furniture
from drnav_jax.worlds.covering import cover
from drnav_jax.worlds.networks import Edge
from drnav_jax.worlds.ranges import Draws
from drnav_jax.worlds.solids import LINTEL, TOP, WAY, Layout, Point, Rect, Solid, box, portal

WING = 120.0  # [m] of wall to either side: nobody walks around the building
SAVING = 4.0  # [m] by which a shortcut is shorter
TRIES = 200  # floors drawn until one is as it should
LEAST = 3.2  # [m] of corridor in which something can stand across
KINDS = ("wall", "glass", "door", "glass", "door", "crates")


class _Floor(NamedTuple):
    """Where the corridors are; all centre lines and edges in the building's frame."""

    xs: list[float]  # of the cross corridors, between the first and the last corridor
    ys: list[float]  # of the corridors, from wall to wall
    length: float  # of the building
    depth: float
    width: float  # of all corridors
    thick: float  # of walls


class _Hall(NamedTuple):
    """A room between two corridors that one may cross."""

    rect: Rect
    low: Point  # where its doors are, on the faces of the corridors' walls
    high: Point


class _Way(NamedTuple):
    """An edge of the network."""

    a: Point
    b: Point
    hall: _Hall | None


def office(draw: Draws, rng: np.random.Generator) -> Layout:
    """An office floor between a stem in which the robot starts and an exit on the far side."""
    floor = _floor(draw, rng)
    halls = _halls(floor, draw("halls"), rng)
    nodes, ways, ends = _network(floor, halls)
    passable, opened, entry, out, trip = _choose(ways, ends, draw, rng)

    free: list[Rect] = _corridors(floor)
    solids: list[Solid] = []
    plugs: list[Solid] = []
    doorposts: list[Solid] = []
    crossings: list[Point] = []  # where nothing else may stand
    number = 0
    for e, way in sorted(ways.items()):
        is_open = e in passable
        if way.hall is None and (is_open and rng.random() > draw("decoys") or math.dist(way.a, way.b) < LEAST):
            continue
        number += 1
        for side, (p, q) in enumerate(_jambs(floor, way, rng)):
            middle = ((p[0] + q[0]) / 2, (p[1] + q[1]) / 2)
            crossings.append(middle)
            width, depth = math.dist(p, q), (floor.thick + 0.6 if way.hall is None else 3.0)
            kinds = [k for k in KINDS if fits(k, width, depth)] if way.hall is None else ["door"]
            inward = 0.0 if way.hall is None else (1.0, -1.0)[side]
            made = close(kinds[rng.integers(len(kinds))], p, q, floor.thick, depth, rng, number=number, side=inward)
            if way.hall is not None:
                free.append(_doorway(p, q, floor.thick))
                if side != number % 2:  # one of a hall's doors is always open
                    solids += made.fixed(is_open=True)
                    continue
            if e in opened:
                solids, plugs, doorposts = solids + made.both, plugs + made.closed, doorposts + made.opened
            else:
                solids += made.fixed(is_open)

    for hall in halls:
        free.append(hall.rect)
        line = np.array([hall.low, [hall.low[0], hall.low[1] + 1.2], [hall.high[0], hall.high[1] - 1.2], hall.high])
        solids += _renamed(furniture(hall.rect, [line], int(rng.integers(0, 4)), rng), number)
        number += 1
    for row in _rows(floor, halls):
        number = _rooms(row, floor, draw, rng, free, solids, crossings, number)
    solids += _ends(floor, ends, entry, out, draw.has("lobby"), rng)
    solids += _standing(floor, crossings, int(draw("standing")), rng)

    (_, y), (far, goal_y), stem = nodes[entry], nodes[out], draw("stem")
    h, t = floor.width / 2, floor.thick
    block = (-t, -t, floor.length + t, floor.depth + t)
    free += [(-t, y - h, 0.0, y + h), (floor.length, goal_y - h, floor.length + t, goal_y + h)]
    rails = [(-stem, y - h - t, -t, y - h), (-stem, y + h, -t, y + h + t)]
    solids += [box(r) for r in cover([block, *rails], free)]
    solids += [box((-t, a, 0.0, b)) for a, b in ((-WING, -t), (floor.depth + t, floor.depth + WING))]
    start = (-stem + rng.uniform(0.8, 1.5), y)
    goal = (far + t + draw("behind"), goal_y + rng.uniform(-1.5, 1.5))
    return Layout(
        solids=solids,
        plugs=plugs,
        doorposts=doorposts,
        ways=[np.array([start, *(nodes[n] for n in trip), goal])],
        hull=(-stem, -t, floor.length + t, floor.depth + t),
        start=start,
        goal=goal,
    )


def _floor(draw: Draws, rng: np.random.Generator) -> _Floor:
    width, thick = draw("width"), rng.uniform(0.14, 0.22)
    xs, x = [], draw("room") + width / 2
    for _ in range(int(draw("cross"))):
        xs.append(x)
        x += draw("block") + width
    ys, y = [], draw("room") + width / 2
    for _ in range(int(draw("corridors"))):
        ys.append(y)
        y += draw("between") + width
    return _Floor(xs, ys, xs[-1] + width / 2 + draw("room"), ys[-1] + width / 2 + draw("room"), width, thick)


def _corridors(f: _Floor) -> list[Rect]:
    h = f.width / 2
    across = [(x - h, f.ys[0] - h, x + h, f.ys[-1] + h) for x in f.xs]
    return across + [(0.0, y - h, f.length, y + h) for y in f.ys]


def _halls(f: _Floor, share: float, rng: np.random.Generator) -> list[_Hall]:
    """At most one in each block between corridors."""
    halls, h, t = [], f.width / 2, f.thick
    for x0, x1 in zip(f.xs[:-1], f.xs[1:], strict=True):
        for y0, y1 in zip(f.ys[:-1], f.ys[1:], strict=True):
            low, high, left, right = y0 + h + t, y1 - h - t, x0 + h + t, x1 - h - t
            if rng.random() >= share or right - left < 4.0:
                continue
            wide = min(rng.uniform(3.5, 6.5), right - left)
            x = rng.uniform(left, right - wide)
            doors = rng.uniform(x + 0.8, x + wide - 0.8, 2)
            rect = (x, low, x + wide, high)
            halls.append(_Hall(rect, (float(doors[0]), low - t), (float(doors[1]), high + t)))
    return halls


def _network(f: _Floor, halls: list[_Hall]) -> tuple[list[Point], dict[Edge, _Way], list[tuple[int, int]]]:
    """Places, ways between them, and the two ends of each corridor."""
    h, nodes = f.width / 2, []
    ways: dict[Edge, _Way] = {}
    at: dict[tuple[float, float], int] = {}
    ends = []
    for y in f.ys:
        doors = [hall.low[0] for hall in halls if abs(hall.low[1] - y - h) < 1e-6]
        doors += [hall.high[0] for hall in halls if abs(hall.high[1] - y + h) < 1e-6]
        line = sorted([0.0, f.length, *f.xs, *doors])
        for x in line:
            at[x, y] = len(nodes)
            nodes.append((x, y))
        ends.append((at[0.0, y], at[f.length, y]))
        for p, q in zip(line[:-1], line[1:], strict=True):
            ways[at[p, y], at[q, y]] = _Way((p, y), (q, y), None)
    for x in f.xs:
        for p, q in zip(f.ys[:-1], f.ys[1:], strict=True):
            ways[at[x, p], at[x, q]] = _Way((x, p), (x, q), None)
    for hall in halls:
        a, b = (hall.low[0], hall.low[1] - h), (hall.high[0], hall.high[1] + h)
        near = lambda p: min(at, key=lambda q: math.dist(p, q))  # noqa: E731  (sums of floats)
        ways[networks.edge(at[near(a)], at[near(b)])] = _Way(a, b, hall)
    return nodes, ways, ends


def _choose(
    ways: dict[Edge, _Way], ends: list[tuple[int, int]], draw: Draws, rng: np.random.Generator
) -> tuple[set[Edge], list[Edge], int, int, list[int]]:
    """Ways open in both twins, those only in the open one, the nodes of entry and exit, and the closed twin's way."""
    length = {e: math.dist(w.a, w.b) for e, w in ways.items()}
    stubs = {n for pair in ends for n in pair}
    # Corridor ends lead nowhere as it is, and where there is no room nothing stands across.
    always = {e for e in ways if stubs & set(e) or (ways[e].hall is None and length[e] < LEAST)}
    root, loops, wanted = ends[0][0], draw("loops"), int(draw("decisions"))
    best: tuple | None = None
    for _ in range(TRIES):
        entry, out = ends[rng.integers(len(ends))][0], ends[rng.integers(len(ends))][1]
        tree = networks.grow(sorted(ways), root, 0.7, rng)
        passable = networks.braid(sorted(ways), tree | always, loops, rng)
        shut = set(ways) - passable
        short = networks.shortcuts(shut, passable, length, entry, out, SAVING)
        trip = networks.route(passable, length, entry, out).nodes
        met = sum(bool(set(e) & set(trip)) for e in shut | {e for e in always if stubs - {entry, out} & set(e)})
        if short and (best is None or met > best[0]):
            best = (met, passable, shut, short, entry, out, trip)
        if best is not None and best[0] >= wanted:
            break
    if best is None:
        raise RuntimeError(f"{TRIES} office floors had no shortcut.")
    _, passable, shut, short, entry, out, trip = best
    opened = [short[int(rng.integers(min(2, len(short))))]]
    others = sorted(shut - set(opened))
    opened += [others[k] for k in rng.permutation(len(others))[: int(draw("more"))]]
    return passable, opened, entry, out, trip


def _jambs(f: _Floor, way: _Way, rng: np.random.Generator) -> list[tuple[Point, Point]]:
    """What is closed on a way: the corridor at one place, or a hall's lower and upper door."""
    h, t = f.width / 2, f.thick / 2
    if way.hall is not None:
        half = rng.uniform(0.5, 0.6)
        faces = ((way.hall.low, t), (way.hall.high, -t))
        return [((x - half, y + s), (x + half, y + s)) for (x, y), s in faces]
    share = rng.uniform(0.4, 0.6)
    x, y = (way.a[k] + share * (way.b[k] - way.a[k]) for k in (0, 1))
    return [((x, y - h), (x, y + h))] if way.a[1] == way.b[1] else [((x - h, y), (x + h, y))]


def _doorway(p: Point, q: Point, thick: float) -> Rect:
    return (p[0], p[1] - thick / 2, q[0], q[1] + thick / 2)


class _Row(NamedTuple):
    """Where rooms stand along one side of a corridor."""

    rect: Rect
    up: bool  # whether the corridor is above


def _rows(f: _Floor, halls: list[_Hall]) -> list[_Row]:
    h, t = f.width / 2, f.thick
    rows = [_Row((0.0, 0.0, f.length, f.ys[0] - h - t), True)]
    rows.append(_Row((0.0, f.ys[-1] + h + t, f.length, f.depth), False))
    spans = [0.0, *(s for x in f.xs for s in (x - h - t, x + h + t)), f.length]
    for low, high in zip(f.ys[:-1], f.ys[1:], strict=True):
        y0, y1 = low + h + t, high - h - t
        middle = (y0 + y1) / 2
        bands = [(y0, middle - t / 2, False), (middle + t / 2, y1, True)] if y1 - y0 > 6.0 else [(y0, y1, False)]
        for x0, x1 in zip(spans[::2], spans[1::2], strict=True):
            taken = [hall.rect for hall in halls if hall.rect[1] == y0 and x0 - t < hall.rect[0] < x1]
            parts = [(x0, taken[0][0] - t), (taken[0][2] + t, x1)] if taken else [(x0, x1)]
            rows += [_Row((p, a, q, b), up) for p, q in parts if q - p > 2.4 for a, b, up in bands]
    return rows


def _rooms(
    row: _Row,
    f: _Floor,
    draw: Draws,
    rng: np.random.Generator,
    free: list[Rect],
    solids: list[Solid],
    crossings: list[Point],
    number: int,
) -> int:
    """Rooms of one row: hollow with a door, or solid with a shut leaf in the wall."""
    x0, y0, x1, y1 = row.rect
    share, t = draw("rooms"), f.thick
    cuts = [x0]
    while x1 - cuts[-1] > 3.0:
        wide = rng.uniform(2.6, 5.5)
        cuts.append(cuts[-1] + wide if x1 - cuts[-1] - wide > 2.6 else x1)
    for left, right in zip(cuts[:-1], cuts[1:], strict=True):
        number += 1
        right -= 0.0 if right == x1 else t
        half = rng.uniform(0.5, 0.6)
        face = y1 if row.up else y0 - t  # lower face of the wall to the corridor
        corridor = face + t if row.up else face
        tries = rng.uniform(left + half + 0.15, right - half - 0.15, 4).tolist()
        clear = [x for x in tries if all(abs(x - px) > 1.3 or abs(corridor - py) > f.width for px, py in crossings)]
        x = clear[0] if clear else tries[0]
        if rng.random() >= share or not clear:
            if clear and rng.random() < 0.5:
                solids.append(box((x - half, corridor - 0.03, x + half, corridor + 0.03), f"leaf:{number}", 0.0, LINTEL))
            continue
        crossings.append((x, corridor))
        free += [(left, y0, right, y1), (x - half, face, x + half, face + t)]
        p, q = (x - half, face + t / 2), (x + half, face + t / 2)
        if rng.random() < 0.7:
            made = close("door", p, q, t, 3.0, rng, number=number, side=-1.0 if row.up else 1.0)
            solids += made.fixed(is_open=True)
        else:
            solids.append(box((x - half, face, x + half, face + t), "wall", LINTEL, TOP))
        inside = y1 - 1.2 if row.up else y0 + 1.2
        line = np.array([[x, corridor], [x, inside]])
        solids += _renamed(furniture((left, y0, right, y1), [line], int(rng.integers(0, 2)), rng), number)
    return number


def _renamed(pieces: list[Solid], number: int) -> list[Solid]:
    """Furniture with colours of its own in each room."""
    return [Solid(s.row, f"crate:{number}.{k}") for k, s in enumerate(pieces)]


def _ends(
    f: _Floor, ends: list[tuple[int, int]], entry: int, out: int, lifts: bool, rng: np.random.Generator
) -> list[Solid]:
    """What corridors end at: a wall, a shut door, or a lift; entry and exit may have an empty frame."""
    solids: list[Solid] = []
    h = f.width / 2
    for k, (a, b) in enumerate(ends):
        for node, x, inward in ((a, 0.0, 1.0), (b, f.length, -1.0)):
            y, kind = f.ys[k], rng.integers(3)
            if node in (entry, out):
                if kind == 0:
                    solids += portal(x + inward * 0.2, y, True, f.width - 2 * FRAME, f"frame:end{node}", FRAME, FRAME)
                continue
            if kind == 0:
                solids.append(box((x - 0.03, y - 0.5, x + 0.03, y + 0.5), f"leaf:end{node}", 0.0, LINTEL))
            elif kind == 1 and lifts:
                solids.append(box((x - 0.03, y - h + 0.2, x + 0.03, y + h - 0.2), "lift", 0.0, LINTEL))
                solids += portal(x, y, True, f.width - 0.4, "frame:lift", 0.1, 0.1)
    return solids


def _standing(f: _Floor, crossings: list[Point], num: int, rng: np.random.Generator) -> list[Solid]:
    """Cabinets and boxes along the corridors' walls, away from doors and crossings, that leave WAY."""
    depth = min(f.width - WAY - 0.05, 0.5)
    placed: list[Solid] = []
    if depth < 0.2:
        return placed
    kept = crossings + [(x, y) for x in f.xs for y in f.ys]
    for k in range(6 * num):
        y, side, length = f.ys[rng.integers(len(f.ys))], rng.choice([-1, 1]), rng.uniform(0.5, 1.4)
        x, deep = rng.uniform(1.5, f.length - 1.5), rng.uniform(0.2, depth)
        wall = y + side * f.width / 2
        near = min((abs(x - px) for px, py in kept if abs(py - y) < f.width), default=9.0)
        if near > length / 2 + f.width / 2 + 0.8 and len(placed) < num:
            kept.append((x, y))
            rect = (x - length / 2, min(wall, wall - side * deep), x + length / 2, max(wall, wall - side * deep))
            placed.append(box(rect, f"crate:s{k}", 0.0, rng.uniform(0.6, 1.9)))
    return placed
