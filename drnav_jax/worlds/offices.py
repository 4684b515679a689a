"""An office floor: two corridors with rooms on both sides of each, joined by a cross corridor and by some of the rooms.

The corridor that the robot starts in leads straight to the goal, and in the closed variant ends in a wall; the other one
always leads out. Rooms have one door, a few a second one to the other corridor; some doors are shut, and some rooms are
closed off by glass instead of a wall.
"""

import math

import numpy as np

from drnav_jax.worlds.clutter import furniture
from drnav_jax.worlds.solids import LINTEL, REAR, Draw, Layout, Rect, Solid, block, box, leaf, portal, wall

DOOR = (0.95, 1.2)  # [m] width


def _door(x: float, y: float, width: float, thick: float, inward: float, rng: np.random.Generator) -> list[Solid]:
    """Frame, wall over it and open leaf of a door in a wall along x; `inward` is the side that it opens to."""
    hinge, side = rng.choice([-1.0, 1.0]), inward
    swing = math.pi / 2 * side - hinge * side * math.radians(rng.uniform(-10, 15))
    solids = [
        *portal(x, y, False, width - 0.02, "frame", 0.05, thick + 0.04),
        box((x - width / 2, y - thick / 2, x + width / 2, y + thick / 2), "wall", LINTEL + 0.05, 10.0),
    ]
    if rng.random() < 0.7:
        at = (x + hinge * (width / 2 - 0.04), y + side * (thick / 2 + 0.05))
        solids.append(leaf(at, swing, width - 0.1, "leaf", 0.05))
    return solids


def office(draw: Draw, rng: np.random.Generator) -> Layout:
    """The layout of `office`."""
    length, width, deep, behind = (draw(name) for name in ("length", "width", "deep", "behind"))
    thick, h = rng.uniform(0.15, 0.25), width / 2
    far, other = length, deep + 2 * h + 2 * thick  # x of the far side, y of the second corridor
    end, cross = draw("end"), rng.uniform(0.3, 0.6) * length
    back = rng.uniform(5.0, 6.5)  # depth of the outer rooms
    hull = (-REAR, -h - thick - back - thick, far, other + h + thick + back + thick)
    begin_b = cross - h - rng.uniform(4, 8)
    free: list[Rect] = [
        (-REAR, -h, far, h), (cross - h, -h, cross + h, other + h), (begin_b, other - h, far, other + h),
    ]  # fmt: skip
    solids: list[Solid] = []
    ways = [
        np.array([[-REAR, 0.0], [far, 0.0]]), np.array([[cross, 0.0], [cross, other], [far, other]]),
    ]  # fmt: skip
    rooms: list[tuple[Rect, list[tuple[float, float, float]]]] = []  # room, doors x, y, side that they open to
    rows = (  # low, high, walls with a door: its y and the direction into the room
        (-h - thick - back, -h - thick, [(-h - thick / 2, -1.0)], -REAR + 1.0),
        (h + thick, other - h - thick, [(h + thick / 2, 1.0), (other - h - thick / 2, -1.0)], 0.0),
        (other + h + thick, other + h + thick + back, [(other + h + thick / 2, 1.0)], begin_b),
    )
    for low, high, walls, first in rows:
        x = first + rng.uniform(0.0, 2.0)
        while True:
            size = rng.uniform(3.0, 5.5)
            if low > 0 and high < other and x < cross + h + thick and x + size > cross - h - thick:
                x = cross + h + thick  # behind the cross corridor
            if x + size > far - thick:
                break
            middle = len(walls) == 2
            usable = [w for w in walls if w[0] < other / 2 or x > begin_b]
            joins = middle and len(usable) == 2 and x + size < 0.75 * far and rng.random() < draw("through")
            chosen = usable if joins else [usable[rng.integers(len(usable))]]
            doors = [(x + rng.uniform(0.9, size - 0.9), y, side) for y, side in chosen]
            if rng.random() < draw("shut"):  # nothing is seen of the room but its door
                for dx, y, side in doors:
                    face = y - side * (thick / 2 + 0.02)
                    solids += [
                        leaf((dx - 0.5, face), 0.0, 1.0, "leaf", 0.05), *portal(dx, face, False, 1.0, "frame", 0.06, 0.08)
                    ]  # fmt: skip
            else:
                rooms.append(((x, low, x + size, high), doors))
            x += size + thick
    for room, doors in rooms:
        free.append(room)
        lines = []
        for x, y, side in doors:
            w = rng.uniform(*DOOR)
            free.append((x - w / 2, y - thick / 2 - 1e-3, x + w / 2, y + thick / 2 + 1e-3))
            solids += _door(x, y, w, thick, side, rng)
            lines.append([x, y])
            lines.append([x, y + side * 1.2])
        if len(doors) == 2:
            lines[2:] = lines[:1:-1]
        # the glass of a meeting room: a slit in the wall beside the door, too low and too narrow to drive through
        x, y, _ = doors[0]
        for x0, x1 in ((room[0] + 0.3, x - 0.9), (x + 0.9, room[2] - 0.3)):
            if x1 - x0 > 1.0 and rng.random() < draw("glazed"):
                free.append((x0, y - thick / 2 - 1e-3, x1, y + thick / 2 + 1e-3))
                solids.append(wall((x0 - 0.02, y), (x1 + 0.02, y), 0.03, "pane", 0.0, LINTEL))
                solids.append(box((x0, y - thick / 2, x1, y + thick / 2), "wall", LINTEL, 10.0))
        solids += furniture(room, [np.array(lines)], int(rng.integers(0, 4)), rng)
    goal = (far + behind, rng.uniform(-1.0, 1.0))
    return Layout(
        solids=[*block(hull, free, rng), *solids],
        plugs=[box((far - end, -h, far, h), "end")],
        doorposts=[],
        ways=[np.array([*way, goal]) for way in ways],
        hull=hull,
        start=(0.0, rng.uniform(-0.2, 0.2)),
        goal=goal,
        corridors=[(way, width) for way in ways],
        yards=[(far + 0.5, -2.0, goal[0] + 1, other + 2.0)],
    )


LAYOUTS = {"office": office}
