"""Layouts with doors and panes: an elevator lobby, a room, a glass wall.

In each the robot comes up a stem from which a detour leaves, and the way ahead leads through what may be closed.
"""

import math

import numpy as np

from drnav_jax.worlds.clutter import furniture
from drnav_jax.worlds.solids import (
    LINTEL,
    REAR,
    TOP,
    WAY,
    Draw,
    Layout,
    Rect,
    Solid,
    block,
    box,
    fork,
    leaf,
    portal,
    wall,
)


def _hull(aside: float, far: float, high: float, rng: np.random.Generator) -> Rect:
    return (-REAR, -aside - rng.uniform(0.3, 2), far, high + rng.uniform(0.3, 2))


def _lobby(draw: Draw, rng: np.random.Generator) -> Layout:
    """A corridor widens into a lobby with lifts in its back wall; where one could be, a passage goes on."""
    at, run, width, depth = (draw(name) for name in ("stem", "run", "width", "depth"))
    hall, door, end, behind = (draw(name) for name in ("hall", "door", "end", "behind"))
    h, hall, start_x = width / 2, max(hall, 2 * door + 1.6), at + run
    back, far = start_x + depth, start_x + depth + end
    shift = rng.uniform(-0.5, 0.5) * (hall - width)
    low, high = shift - hall / 2, shift + hall / 2
    num = int(hall // (door + 0.6))
    centres = low + hall / num * (np.arange(num) + 0.5)
    way = int(rng.integers(num))
    y = float(centres[way])
    aside = max(draw("aside"), -low + h + 0.5)
    ways = fork(at, start_x, aside, far, width)
    hull = _hull(aside + h, far, max(high, h), rng)
    passage = (back, y - door / 2, far, y + door / 2)
    free = [*ways.free, (start_x, low, back, high), passage]

    def lift(y: float) -> Solid:
        return box((back - 0.02, y - door / 2, back + 0.06, y + door / 2), "lift", 0.0, LINTEL)

    frames = [s for c in centres for s in portal(back - 0.02, float(c), True, door, "frame", 0.12, 0.12)]
    over = box((back + 0.04, y - door / 2, far, y + door / 2), "wall", LINTEL, TOP)
    solids = [*block(hull, free, rng), *frames, over, *(lift(float(c)) for k, c in enumerate(centres) if k != way)]
    if rng.random() < 0.6:  # lifts beside the way round, too
        x = rng.uniform(at + h + door / 2 + 0.3, far - door / 2 - 0.3)
        side = -aside - h
        solids += [box((x - door / 2, side - 0.06, x + door / 2, side + 0.02), "lift", 0.0, LINTEL)]
        solids += portal(x, side + 0.02, False, door, "frame", 0.12, 0.12)
    start, goal = (0.0, rng.uniform(-0.2, 0.2)), (far + behind, rng.uniform(0.0, 1.0) * max(high, 1.0))
    inner = np.array([*ways.stem, [back - 0.8, y], [far, y], goal])
    sights = [np.array([*ways.stem, [back, c]]) for c in centres]
    return Layout(
        solids=solids + furniture((start_x, low, back - 0.1, high), [inner, *sights], int(rng.integers(4)), rng),
        plugs=[lift(y), box((back + 0.06, y - door / 2, far, y + door / 2))],
        doorposts=[],
        ways=[inner, np.array([*ways.detour, goal])],
        hull=hull,
        start=start,
        goal=goal,
        corridors=[(ways.stem, width), (ways.detour, width)],
        yards=[(far + 0.5, -aside, goal[0] + 1, max(high, 2.0))],
    )


def _shut(x: float, y: float, along_x: bool, width: float, role: str) -> Solid:
    angle = math.pi / 2 if along_x else 0.0
    hinge = (x, y - width / 2) if along_x else (x - width / 2, y)
    return leaf(hinge, angle, width, role)


def _room(draw: Draw, rng: np.random.Generator) -> Layout:
    """A room that one enters by one door and leaves by another, in its far wall or around a corner."""
    at, run, width, depth = (draw(name) for name in ("stem", "run", "width", "depth"))
    hall, door, end, behind = (draw(name) for name in ("hall", "door", "end", "behind"))
    thick, h = rng.uniform(0.15, 0.3), width / 2
    near = at + run + thick  # inner face of the wall that the first door is in
    back, far = near + depth, near + depth + thick + end
    shift = rng.uniform(-0.5, 0.5) * (hall - width)
    low, high = min(shift - hall / 2, -h), max(shift + hall / 2, h)
    aside = max(draw("aside"), -low + h + 0.5)
    ways = fork(at, at + run, aside, far, width)
    d = door / 2
    if rng.random() < 0.5:  # in the far wall
        y = rng.uniform(low + h + 0.1, high - h - 0.1)
        out = [(back, y - d, back + thick, y + d), (back + thick, y - h, far, y + h)]
        door_at, along_x, top = (back + thick / 2, y), True, high
        line = [[near + depth / 2, 0], [back - 0.8, y], [far, y]]
    else:
        x, y = rng.uniform(near + h + 0.3, back - h - 0.1), high + thick
        out = [(x - d, high, x + d, y), (x - h, y, far, y + width)]
        door_at, along_x, top = (x, high + thick / 2), False, y + width
        line = [[x, 0], [x, y + h], [far, y + h]]
    hull = _hull(aside + h, far, top, rng)
    free = [*ways.free, (at + run, -d, near, d), (near, low, back, high), *out]
    frame = "frame"
    blocked = block(hull, free, rng)
    # The first door stands open, into the room, to either side.
    side = -1 if rng.random() < 0.5 else 1
    lean = rng.uniform(-45, -5) if side < 0 else rng.uniform(5, 45)
    # The tips of leaves stay off the walls beside them, or what is behind them would be walled in.
    room = math.asin(min(max((high if side > 0 else -low) - d - 0.2, 0.0) / door, 1.0))
    first = leaf((near + 0.03, side * d), side * min(math.radians(abs(lean)), room), door, "leaf")
    solids = [
        *blocked,
        *portal(near - thick / 2, 0.0, True, door, frame, 0.06, thick + 0.06),
        *portal(*door_at, along_x, door, frame, 0.06, thick + 0.06),
        box((at + run, -d, near, d), "wall", LINTEL, TOP),
        box(out[0], "wall", LINTEL, TOP),
        first,
    ]
    # Doors that are shut, in walls with nothing behind them.
    x = rng.uniform(at + h + d + 0.3, far - d - 0.3)
    solids += [_shut(x, -aside - h, False, door, "leaf"), *portal(x, -aside - h, False, door, frame, 0.06, 0.1)]
    if hall - door > 1.5 and rng.random() < 0.6:
        x = rng.uniform(near + d + 0.3, back - d - 0.3)
        solids += [_shut(x, low, False, door, "leaf"), *portal(x, low, False, door, frame, 0.06, 0.1)]
    # Where the way round leaves the stem by less than the way through, the goal lies on the other side.
    start, goal_y = (0.0, rng.uniform(-0.2, 0.2)), rng.uniform(0.0, 1.0) * max(line[-1][1], 1.0)
    goal = (far + behind, max(goal_y, line[-1][1] - aside + 1.0))
    inner = np.array([*ways.stem, *line, goal])
    # The second door opens away from the room, along a wall of what is behind it.
    side = rng.choice([-1.0, 1.0])
    room = math.asin(max(h - d - 0.2, 0.0) / door)
    swing = min(math.radians(rng.uniform(0, 12)), room)
    if along_x:
        hinge, angle = (back + thick + 0.03, door_at[1] + side * d), side * swing
    else:
        hinge, angle = (door_at[0] - d, high + thick + 0.03), math.pi / 2 + swing
    # Furniture stays off the leaf of the first door, too.
    x, y, yaw, half = first.row[:4]
    reach = half * np.array([math.cos(yaw), math.sin(yaw)])
    kept = [inner, np.stack([(x, y) - reach, (x, y) + reach])]
    return Layout(
        solids=solids + furniture((near, low, back, high), kept, int(rng.integers(1, 5)), rng),
        plugs=[_shut(*door_at, along_x, door, "leaf")],
        doorposts=[leaf(hinge, angle, min(door, width - 0.1), "leaf")],
        ways=[inner, np.array([*ways.detour, goal])],
        hull=hull,
        start=start,
        goal=goal,
        corridors=[(ways.stem, width), (ways.detour, width)],
        yards=[(far + 0.5, -aside, goal[0] + 1, max(top, 2.0))],
    )


def _pane(a: tuple[float, float], b: tuple[float, float], high: float = LINTEL, low: float = 0.0) -> Solid:
    return wall(a, b, 0.03, "pane", low, high)


def _stand(a: tuple[float, float], b: tuple[float, float], pane: bool = True) -> list[Solid]:
    """A free-standing frame between two posts, with a pane or empty."""
    posts = [box((x - 0.05, y - 0.05, x + 0.05, y + 0.05), "frame", 0.0, LINTEL) for x, y in (a, b)]
    rail = wall(a, b, 0.08, "frame", LINTEL, LINTEL + 0.08)
    return [*posts, rail, *([_pane(a, b)] if pane else [])]


def _glass(draw: Draw, rng: np.random.Generator) -> Layout:
    """A hall that a glass wall crosses; the door bay of the wall holds a pane, or an empty frame."""
    at, run, width, before = (draw(name) for name in ("stem", "run", "width", "before"))
    hall, door, after, behind = (draw(name) for name in ("hall", "door", "after", "behind"))
    h, near = width / 2, at + run
    glass, far = near + before, near + before + after
    shift = rng.uniform(-0.5, 0.5) * (hall - width) if hall > width else 0.0
    low, high = min(shift - hall / 2, -h), max(shift + hall / 2, h)
    aside = max(draw("aside"), -low + h + 0.5)
    ways = fork(at, near, aside, far, width)
    hull = _hull(aside + h, far, high, rng)
    free = [*ways.free, (near, low, far, high)]

    # Posts at y, panes between them; the door bay is as wide as the hall where that is narrow.
    y = rng.uniform(low + door / 2 + 0.5, high - door / 2 - 0.5) if high - low > door + 1.1 else (low + high) / 2
    wide = high - low > door + 1.1
    bay = (y - door / 2, y + door / 2) if wide else (low + 0.05, high - 0.05)
    posts, panes = {bay[0], bay[1]}, []
    for a, b in ((low + 0.05, bay[0]), (bay[1], high - 0.05)):
        if b - a > 0.01:
            inner = np.linspace(a, b, 2 + int((b - a) // 1.8))
            posts |= set(inner.tolist())
            panes += [_pane((glass, p), (glass, q)) for p, q in zip(inner[:-1], inner[1:], strict=True)]
    solids = [
        *block(hull, free, rng),
        *panes,
        *(box((glass - 0.05, p - 0.05, glass + 0.05, p + 0.05), "frame") for p in sorted(posts)),
        box((glass - 0.04, low, glass + 0.04, high), "frame", LINTEL, LINTEL + 0.08),
        _pane((glass, low), (glass, high), TOP, LINTEL + 0.08),
    ]
    # Empty frames that one passes on either way, and panes that close nothing.
    x = rng.uniform(1.5, at - h - 0.3)
    solids += _stand((x, -h + 0.05), (x, h - 0.05), pane=False)
    x = rng.uniform(at + h + 0.5, far - 0.5)
    solids += _stand((x, -aside - h + 0.05), (x, -aside + h - 0.05), pane=False)
    x, length = rng.uniform(at + h + 0.3, far - 2.0), rng.uniform(1.0, 1.7)
    solids += _stand((x, -aside + h - 0.12), (x + length, -aside + h - 0.12))
    inner = [[(near + glass) / 2, 0.0], [glass - 0.8, y], [glass + 0.8, y], [far, y]]
    if high - low > WAY + 1.6:  # a screen from one wall into the hall
        x, length = near + rng.uniform(0.25, 0.5) * before, rng.uniform(0.7, high - low - WAY - 0.4)
        side = rng.random() < 0.5
        a, b = (low + 0.05, low + length) if side else (high - length, high - 0.05)
        solids += _stand((x, a), (x, b))
        inner[0] = [x, (b + high) / 2 if side else (a + low) / 2]
    start, goal = (0.0, rng.uniform(-0.2, 0.2)), (far + behind, rng.uniform(0.0, 1.0) * max(high, 1.0))
    return Layout(
        solids=solids,
        plugs=[_pane((glass, bay[0]), (glass, bay[1]))],
        doorposts=[],
        ways=[np.array([*ways.stem, *inner, goal]), np.array([*ways.detour, goal])],
        hull=hull,
        start=start,
        goal=goal,
        corridors=[(ways.stem[:1].repeat(2, 0) + [[0, 0], [REAR - 0.5, 0]], width)],
        yards=[(far + 0.5, -aside, goal[0] + 1, max(high, 2.0))],
    )


LAYOUTS = {"lobby": _lobby, "room": _room, "glass": _glass}
