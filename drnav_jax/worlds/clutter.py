"""Clutter: boxes and cylinders that stand freely in a layout's yards or flush with the walls of its corridors.

Whatever it is, `WAY` metres stay free along every passage, blocked ones included.
"""

import math

import numpy as np

from drnav_jax.worlds.solids import WAY, Layout, Rect, Solid, box
from drnav_jax.worlds.world import World, make_world, signed_distance


def to_polyline(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """Distance [m] of points `[N, 2]` to a polyline `[L, 2]`."""
    a, d = line[:-1], np.diff(line, axis=0)
    t = np.einsum("nld,ld->nl", points[:, None] - a, d) / np.maximum((d * d).sum(1), 1e-12)
    nearest = a + np.clip(t, 0, 1)[..., None] * d
    return np.linalg.norm(points[:, None] - nearest, axis=-1).min(1)


def _shape(solids: list[Solid]) -> World:
    """Solids as if all of them stopped a robot: clutter keeps clear of grass and lintels, too."""
    rows = [[*s.row[:-2], 0.0, 1.0] for s in solids]
    return make_world([r for r in rows if len(r) == 7], [r for r in rows if len(r) == 5])


def clutter(layout: Layout, rng: np.random.Generator) -> list[Solid]:
    """Solids in a layout's yards and corridors, at most `num_clutter` of them in the yards."""
    placed: list[Solid] = []
    fixed = layout.solids + layout.plugs + layout.doorposts
    ends = np.array([layout.start, layout.goal])

    def place(x: float, y: float, yaw: float, size: float, free_standing: bool) -> None:
        is_box, height = rng.random() < 0.5, rng.uniform(0.7, 2.0)
        half = size * rng.uniform(0.6, 1.0, 2)
        if not free_standing:
            half[1] = size  # from the wall to the way
        reach = math.hypot(*half) if is_box and free_standing else size
        centre = np.array([[x, y]])
        ways = layout.ways if free_standing else [line for line, _ in layout.corridors]
        gap = min(to_polyline(centre, way)[0] for way in ways) - reach
        room = signed_distance(_shape(fixed + placed if free_standing else placed), centre)[0] - reach
        to_ends = np.linalg.norm(centre - ends, axis=1).min() - reach
        if gap < WAY / 2 or room < WAY or to_ends < WAY:
            return
        row = [x, y, yaw, *half, 0.0, height] if is_box else [x, y, size, 0.0, height]
        placed.append(Solid(np.array(row), f"{'crate' if is_box else 'barrel'}:{len(placed)}"))

    for _ in range(3 * layout.num_clutter if layout.yards else 0):
        x0, y0, x1, y1 = layout.yards[rng.integers(len(layout.yards))]
        x, y, yaw = rng.uniform(x0, x1), rng.uniform(y0, y1), rng.uniform(-math.pi, math.pi)
        size = rng.uniform(0.15, 0.6)
        if len(placed) < layout.num_clutter:
            place(x, y, yaw, size, free_standing=True)
    for line, width in layout.corridors:
        size = (width - WAY) / 4
        for k in range(len(line) - 1):
            t, side = rng.uniform(0.1, 0.9), rng.choice([-1.0, 1.0])
            d = line[k + 1] - line[k]
            unit = d / np.linalg.norm(d)
            x, y = line[k] + t * d + side * (width / 2 - size) * np.array([-unit[1], unit[0]])
            if size > 0.12 and rng.random() < 0.5:
                place(x, y, math.atan2(unit[1], unit[0]), size - 1e-3, free_standing=False)
    return placed


def furniture(room: Rect, ways: list[np.ndarray], num: int, rng: np.random.Generator) -> list[Solid]:
    """At most `num` tables, shelves and cabinets flush with the walls of a room, away from polylines."""
    x0, y0, x1, y1 = room
    placed: list[Solid] = []
    for k in range(4 * num):
        length, depth, height = rng.uniform(0.6, 1.6), rng.uniform(0.3, 0.6), rng.uniform(0.7, 2.0)
        side, t = rng.integers(4), rng.uniform()
        if side < 2:
            x = x0 + t * (x1 - x0 - length)
            rect = (x, y0, x + length, y0 + depth) if side == 0 else (x, y1 - depth, x + length, y1)
        else:
            y = y0 + t * (y1 - y0 - length)
            rect = (x0, y, x0 + depth, y + length) if side == 2 else (x1 - depth, y, x1, y + length)
        edge = np.array([[rect[i], rect[j]] for i in (0, 2) for j in (1, 3)])
        middle = np.array([[(rect[0] + rect[2]) / 2, (rect[1] + rect[3]) / 2]])
        outline = np.concatenate([edge, middle, (edge + middle) / 2, (edge + edge[[1, 3, 0, 2]]) / 2])
        apart = signed_distance(_shape(placed), outline).min() if placed else WAY
        if min(to_polyline(outline, way).min() for way in ways) > WAY / 2 + 0.1 and apart > 0 and len(placed) < num:
            placed.append(box(rect, f"crate:f{k}", 0.0, height))
    return placed
