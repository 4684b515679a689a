"""Yards of a compound: free but for crates, culs-de-sac and sheds, parked cars, plants, a loading bay."""

import math
from typing import NamedTuple

import numpy as np

from drnav_jax.worlds.cells import DIRECTION, EAST, NORTH, SOUTH, WEST, Cell, clipped, hub, inside, meet
from drnav_jax.worlds.closures import CAR, parked
from drnav_jax.worlds.clutter import to_polyline
from drnav_jax.worlds.covering import cover
from drnav_jax.worlds.solids import WAY, Point, Rect, Solid, box, post, slab

YARDS = ("yard", "parking", "garden", "dock")
APRON = 2.6  # [m] kept free before a port


class _Free(NamedTuple):
    """What a yard keeps free, and what it holds."""

    cell: Cell
    ways: list[np.ndarray]
    taken: list[Rect]

    def holds(self, rect: Rect, apart: float, wall: float = 0.05) -> bool:
        """Whether a rectangle keeps clear of the ways by WAY / 2, of what stands there, and of the walls."""
        if not inside(rect, self.cell.rect, wall) or any(meet(rect, r, apart) for r in self.taken):
            return False
        x0, y0, x1, y1 = rect
        n = 2 + math.ceil(max(x1 - x0, y1 - y0) / 0.3)
        x, y = np.linspace(x0, x1, n), np.linspace(y0, y1, n)
        outline = np.concatenate([np.stack([x, np.full(n, e)], 1) for e in (y0, y1)])
        outline = np.concatenate([outline, *(np.stack([np.full(n, e), y], 1) for e in (x0, x1))])
        return bool(min(to_polyline(outline, way).min() for way in self.ways) > WAY / 2 + 0.1)


def yard(cell: Cell, kind: str, rng: np.random.Generator) -> list[Solid]:
    """A yard of a kind of `YARDS`."""
    x0, y0, x1, y1 = cell.rect
    middle = hub(cell)
    ways = [np.array([middle, (middle[0] + 0.1, middle[1])])]
    taken = []
    for port in cell.ports:
        at, before = cell.point(port), cell.point(port, APRON)
        ways.append(np.array([at, before, middle]))
        h = port.width / 2 + 0.5
        taken.append(
            (min(at[0], before[0]), at[1] - h, max(at[0], before[0]), at[1] + h)
            if port.side in (EAST, WEST)
            else (at[0] - h, min(at[1], before[1]), at[0] + h, max(at[1], before[1]))
        )
    free = _Free(cell, ways, taken)
    solids: list[Solid] = []
    for k in range(cell.culs):
        solids += _cul(free, middle, k, rng)
    if kind == "parking":
        solids += _parking(free, rng)
    elif kind == "garden":
        solids += _garden(free, rng)
    elif kind == "dock":
        solids += _bay(free, rng)
    return solids + _clutter(free, int(rng.integers(0, 5)), rng)


def _cul(free: _Free, middle: Point, k: int, rng: np.random.Generator) -> list[Solid]:
    """A cul-de-sac or a shed with a door, its mouth to the ways."""
    x0, y0, x1, y1 = free.cell.rect
    t, role = rng.uniform(0.15, 0.3), f"house:{free.cell.number}.{k}"
    for tries in range(200):
        wide = rng.uniform(1.6, 4.0 - 0.01 * tries)
        deep = max(rng.uniform(2.4, 4.2 - 0.008 * tries), 1.1 * wide)
        side = int(rng.integers(4))
        size = (deep + t, wide + 2 * t) if side in (EAST, WEST) else (wide + 2 * t, deep + t)
        # At a wall, or far enough away to walk behind it.
        x, y = (
            low if at - low < WAY else high if high - at < WAY else at
            for low, high in ((x0, x1 - size[0]), (y0, y1 - size[1]))
            for at in [rng.uniform(low, max(high, low))]
        )
        outer = (x, y, x + size[0], y + size[1])
        a, b, c, d = outer
        inner, front = {
            EAST: ((a + t, b + t, c, d - t), (c, b, c + 1.3, d)),
            WEST: ((a, b + t, c - t, d - t), (a - 1.3, b, a, d)),
            NORTH: ((a + t, b + t, c - t, d), (a, d, c, d + 1.3)),
            SOUTH: ((a + t, b, c - t, d - t), (a, b - 1.3, c, b)),
        }[side]
        toward = DIRECTION[side]
        faces = toward[0] * (middle[0] - (a + c) / 2) + toward[1] * (middle[1] - (b + d) / 2) > 0.5
        if not (faces and free.holds(outer, WAY, -0.01) and inside(front, free.cell.rect, 0.0)):
            continue
        free.taken.extend([(a - 0.6, b - 0.6, c + 0.6, d + 0.6), front])
        walls, hollow = [outer], [inner]
        if wide > 2.2 and rng.random() < 0.4:  # a shed: its front is closed but for a door
            half = rng.uniform(0.5, 0.65)
            at = rng.uniform(half + 0.1, wide - half - 0.1) + t
            hollow = [
                clipped(inner, (a + t, b + t, c - t, d - t)),
                (a, b + at - half, c, b + at + half) if side in (EAST, WEST) else (a + at - half, b, a + at + half, d),
            ]
            back = {EAST: (a, b, a + t, d), WEST: (c - t, b, c, d), NORTH: (a, b, c, b + t), SOUTH: (a, d - t, c, d)}
            rest = cover(walls, hollow)
            return [box(r, role) for r in [*rest, back[side]]]
        return [box(r, role) for r in cover(walls, hollow)]
    return []


def _parking(free: _Free, rng: np.random.Generator) -> list[Solid]:
    """Rows of cars along opposite walls, an aisle between them."""
    x0, y0, x1, y1 = free.cell.rect
    solids: list[Solid] = []
    for side in ((EAST, WEST), (NORTH, SOUTH))[rng.integers(2)]:
        if side in (EAST, WEST):
            span, lo, hi = x1 - x0, y0, y1
        else:
            span, lo, hi = y1 - y0, x0, x1
        nose = span > 11.0 and rng.random() < 0.8  # nose to the wall, or along it
        deep, wide = (CAR if nose else CAR[::-1])
        s = lo + rng.uniform(0.3, 0.9)
        while s + wide < hi - 0.3:
            gap = 0.3 + deep / 2
            along = s + wide / 2
            x, y = {
                EAST: (x1 - gap, along), WEST: (x0 + gap, along), NORTH: (along, y1 - gap), SOUTH: (along, y0 + gap),
            }[side]  # fmt: skip
            hx, hy = (deep / 2, wide / 2) if side in (EAST, WEST) else (wide / 2, deep / 2)
            rect = (x - hx, y - hy, x + hx, y + hy)
            if rng.random() < 0.7 and free.holds(rect, 0.2, 0.25):
                free.taken.append(rect)
                yaw = (0.0 if side in (EAST, WEST) else math.pi / 2) + (0.0 if nose else math.pi / 2)
                number = 100 * free.cell.number + len(solids)
                solids += parked(x, y, yaw + rng.choice([0.0, math.pi]), number)
            s += wide + rng.uniform(0.25, 0.38)
    return solids


def _garden(free: _Free, rng: np.random.Generator) -> list[Solid]:
    """Bushes along the walls and beside the ways, trees, and grass anywhere."""
    x0, y0, x1, y1 = free.cell.rect
    solids: list[Solid] = []
    for side in range(4):
        deep, top = rng.uniform(0.5, 1.0), rng.uniform(0.8, 1.4)
        lo, hi = (y0, y1) if side in (EAST, WEST) else (x0, x1)
        cuts = sorted(
            s for p in free.cell.ports if p.side == side for s in (p.at - p.width / 2 - 0.4, p.at + p.width / 2 + 0.4)
        )
        for a, b in zip([lo, *cuts[1::2]], [*cuts[::2], hi], strict=True):
            if b - a < 1.0 or rng.random() < 0.35:
                continue
            strip = {
                EAST: (x1 - deep, a, x1, b), WEST: (x0, a, x0 + deep, b),
                NORTH: (a, y1 - deep, b, y1), SOUTH: (a, y0, b, y0 + deep),
            }[side]  # fmt: skip
            if free.holds(strip, 0.0, -0.01):
                free.taken.append(strip)
                solids.append(box(strip, "bush", 0.0, top))
    for _ in range(int(rng.integers(5, 11))):
        radius = rng.uniform(0.3, 0.7)
        x, y = rng.uniform(x0 + 1, x1 - 1), rng.uniform(y0 + 1, y1 - 1)
        rect = (x - radius, y - radius, x + radius, y + radius)
        if not free.holds(rect, 0.9, 0.9):
            continue
        free.taken.append(rect)
        if rng.random() < 0.3:
            solids += [post(x, y, 0.16, "trunk", 2.6), post(x, y, rng.uniform(0.8, 1.4), "bush:tree", 4.0, 2.2)]
        else:
            solids.append(post(x, y, radius, "bush", rng.uniform(0.7, 1.3)))
    for _ in range(int(rng.integers(2, 5))):
        x, y = rng.uniform(x0 + 1.5, x1 - 1.5), rng.uniform(y0 + 1.5, y1 - 1.5)
        solids.append(
            slab(x, y, rng.uniform(-3, 3), rng.uniform(1.5, 3), rng.uniform(1, 2), "grass", 0.0, rng.uniform(0.4, 1.1))
        )
    return solids


def _bay(free: _Free, rng: np.random.Generator) -> list[Solid]:
    """A loading bay: a drop before a wall, its edge painted."""
    x0, y0, x1, y1 = free.cell.rect
    for _ in range(60):
        side, wide, reach = int(rng.integers(4)), rng.uniform(2.5, 5.0), rng.uniform(1.8, 3.0)
        lo, hi = (y0, y1) if side in (EAST, WEST) else (x0, x1)
        if hi - lo < wide + 1.0:
            continue
        a = rng.uniform(lo, hi - wide)
        pit, edge = {
            EAST: ((x1 - reach, a, x1, a + wide), (x1 - reach - 0.2, a, x1 - reach, a + wide)),
            WEST: ((x0, a, x0 + reach, a + wide), (x0 + reach, a, x0 + reach + 0.2, a + wide)),
            NORTH: ((a, y1 - reach, a + wide, y1), (a, y1 - reach - 0.2, a + wide, y1 - reach)),
            SOUTH: ((a, y0, a + wide, y0 + reach), (a, y0 + reach, a + wide, y0 + reach + 0.2)),
        }[side]
        if free.holds(pit, 0.3, -0.01):
            free.taken.append(pit)
            return [box(pit, "drop", -rng.uniform(0.8, 1.2), 0.0), box(edge, "stripe", 0.0, 0.01)]
    return []


def _clutter(free: _Free, num: int, rng: np.random.Generator) -> list[Solid]:
    """Crates, barrels and columns, WAY apart from all else."""
    x0, y0, x1, y1 = free.cell.rect
    solids: list[Solid] = []
    for _ in range(6 * num):
        radius = rng.uniform(0.2, 0.7)
        x, y = rng.uniform(x0 + radius, x1 - radius), rng.uniform(y0 + radius, y1 - radius)
        rect = (x - radius, y - radius, x + radius, y + radius)
        if len(solids) >= num or not free.holds(rect, WAY, WAY):
            continue
        free.taken.append(rect)
        name = f"{free.cell.number}.{len(solids)}"
        if rng.random() < 0.5:
            solids.append(post(x, y, radius, f"barrel:{name}", rng.uniform(0.7, 1.8)))
        else:
            half = radius / math.sqrt(2)
            length, wide = 2 * half, rng.uniform(half, 2 * half)
            solids.append(slab(x, y, rng.uniform(-3, 3), length, wide, f"crate:{name}", 0.0, rng.uniform(0.6, 1.8)))
    return solids
