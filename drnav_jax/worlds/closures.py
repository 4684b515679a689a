"""What closes a passage, and what stands in the same place where it is open.

Every kind has both meanings, so that it never tells the answer by itself:

| kind | closed | open |
|---|---|---|
| `wall` | wall | nothing |
| `glass` | a pane in a frame, which LiDAR does not see | the frame, empty |
| `door` | a leaf, shut | the leaf, swung aside |
| `hedge` | bushes | tall grass of the same size, which returns LiDAR beams as well |
| `drop` | a trench between painted edges | the paint |
| `cars` | a car that stands across | a car parked at one side |
| `crates` | crates from side to side | a way between crates |

A closure fills the segment from jamb to jamb. What is closed leaves no gap that a robot fits through; what is open leaves
`solids.WAY` metres, or a door's width.
"""

import math
from typing import NamedTuple

import numpy as np

from drnav_jax.worlds.solids import LINTEL, TOP, WAY, Point, Solid, leaf, slab

KINDS = ("wall", "glass", "door", "hedge", "drop", "cars", "crates")
CAR = (4.4, 1.75)  # [m] length and width
SHUT = 0.4  # [m] a gap that no robot fits through
FRAME = 0.07  # [m] width of posts
PANE = 0.03  # [m] thickness of glass
DOOR = 1.0  # [m] width of a door in a wider passage, and the least of any
BAY = WAY + 0.2  # [m] of a glass wall, that in which the pane may be missing


class Closure(NamedTuple):
    """Solids in one passage."""

    both: list[Solid]
    closed: list[Solid]
    opened: list[Solid]

    def fixed(self, is_open: bool) -> list[Solid]:
        """The solids of a passage that is open, or closed, in both twins."""
        return [*self.both, *(self.opened if is_open else self.closed)]


def fits(kind: str, width: float, depth: float) -> bool:
    """Whether a kind can stand in a passage of that width [m], and be so deep in the way's direction [m]."""
    return {
        "wall": True,
        "glass": width >= WAY + 2 * FRAME,
        "door": width >= 2 * DOOR or (DOOR <= width <= 1.3 and depth >= 2 * DOOR),
        "hedge": width >= WAY and depth >= 0.6,
        "drop": width >= WAY and depth >= 0.8,
        "cars": CAR[1] + WAY + 0.3 <= width <= CAR[0] + 2 * SHUT and depth >= CAR[0],
        "crates": width >= WAY + 0.6 and depth >= 0.6,
    }[kind]


def close(
    kind: str,
    a: Point,
    b: Point,
    thickness: float,
    depth: float,
    rng: np.random.Generator,
    *,
    number: int,
    wall: str = "wall",
    side: float = 0.0,
) -> Closure:
    """The closure of a passage.

    Args:
        kind: One of `KINDS`; ask `fits` before.
        a: One jamb, x, y [m].
        b: The other one.
        thickness: Of the wall that the passage goes through [m].
        depth: The greatest in the way's direction [m], that wall included.
        rng: Draws sizes and sides; both twins share what it gives.
        number: Tells the colours of this one from those of others.
        wall: Role of that wall.
        side: To which side of the segment a to b doors swing: 1 = left, -1 = right, 0 = either.

    Raises:
        ValueError: If there is no such kind.
    """
    if kind not in KINDS:
        raise ValueError(f"unknown kind of closure {kind!r}; there are {', '.join(KINDS)}.")
    side = side or float(rng.choice([-1.0, 1.0]))
    if rng.random() < 0.5:  # hinges, gaps and parked cars are at either jamb
        a, b, side = b, a, -side
    return _MAKE[kind](_Passage(a, b, thickness, depth, number, wall, side), rng)


class _Passage(NamedTuple):
    a: Point
    b: Point
    thickness: float
    depth: float
    number: int
    wall: str
    side: float

    @property
    def width(self) -> float:
        return math.dist(self.a, self.b)

    @property
    def yaw(self) -> float:
        return math.atan2(self.b[1] - self.a[1], self.b[0] - self.a[0])

    def at(self, along: float, across: float = 0.0) -> Point:
        """The point so many metres from jamb a, and to the left of the segment."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return (self.a[0] + along * c - across * s, self.a[1] + along * s + across * c)

    def bar(
        self, start: float, end: float, depth: float, role: str, low: float, high: float, across: float = 0.0
    ) -> Solid:
        """A box on the segment from one place to another, `depth` metres in the way's direction."""
        x, y = self.at((start + end) / 2, across)
        return slab(x, y, self.yaw, end - start, depth, role, low, high)


def _wall(p: _Passage, rng: np.random.Generator) -> Closure:
    return Closure([], [p.bar(0.0, p.width, p.thickness, p.wall, 0.0, TOP)], [])


def _lintel(p: _Passage) -> Solid:
    return p.bar(0.0, p.width, p.thickness, p.wall, LINTEL, TOP)


def _glass(p: _Passage, rng: np.random.Generator) -> Closure:
    """A frame from jamb to jamb; where there is room it has a bay that may be empty beside panes that are not."""
    role, posts, panes, bay = f"frame:{p.number}", {0.0, p.width - FRAME}, [], (FRAME, p.width - FRAME)
    if p.width >= BAY + 1.2:
        first = rng.uniform(0.3, p.width - BAY - 0.3)
        bay = (first, first + BAY)
        posts |= {first - FRAME, first + BAY}
        panes = [(FRAME, first - FRAME), (first + BAY + FRAME, p.width - FRAME)]
    frame = [p.bar(x, x + FRAME, FRAME, role, 0.0, LINTEL) for x in sorted(posts)]
    rail = p.bar(0.0, p.width, FRAME, role, LINTEL, LINTEL + FRAME)
    fixed = [p.bar(x0, x1, PANE, "pane", 0.0, LINTEL) for x0, x1 in panes]
    return Closure([*frame, rail, *fixed], [p.bar(*bay, PANE, "pane", 0.0, LINTEL)], [])


def _door(p: _Passage, rng: np.random.Generator) -> Closure:
    """A leaf in a doorway: swung into the room, or flat against the wall that the doorway of a wide passage has."""
    role, thick = f"leaf:{p.number}", 0.05
    if p.width < 2 * DOOR:
        swing = math.radians(rng.uniform(92.0, 105.0)) * p.side  # past 90 degrees it does not narrow the way
        opened = leaf(p.at(0.0, p.side * p.thickness / 2), p.yaw + swing, p.width, role, thick)
        return Closure([_lintel(p)], [p.bar(0.0, p.width, thick, role, 0.0, LINTEL)], [opened])
    width = rng.uniform(DOOR, min(1.2, p.width / 2))
    opened = p.bar(width, 2 * width, thick, role, 0.0, LINTEL, p.side * (p.thickness + thick) / 2)
    stub = p.bar(width, p.width, p.thickness, p.wall, 0.0, TOP)
    above = p.bar(0.0, width, p.thickness, p.wall, LINTEL, TOP)
    return Closure([stub, above], [p.bar(0.0, width, thick, role, 0.0, LINTEL)], [opened])


def _hedge(p: _Passage, rng: np.random.Generator) -> Closure:
    depth, height = rng.uniform(0.6, min(1.3, p.depth)), rng.uniform(0.9, 1.5)
    closed, opened = (p.bar(0.0, p.width, depth, role, 0.0, height) for role in ("bush", "grass"))
    return Closure([], [closed], [opened])


def _drop(p: _Passage, rng: np.random.Generator) -> Closure:
    depth, paint = rng.uniform(0.8, min(1.6, p.depth)), 0.2
    edges = [p.bar(0.0, p.width, paint, "stripe", 0.0, 0.01, s * (depth + paint) / 2) for s in (-1, 1)]
    return Closure(edges, [p.bar(0.0, p.width, depth, "drop", -rng.uniform(0.6, 1.2), 0.0)], [])


def parked(x: float, y: float, yaw: float, number: int) -> list[Solid]:
    """Body and cabin of a car whose nose looks along its yaw."""
    length, width = CAR
    c, s, role = math.cos(yaw), math.sin(yaw), f"car:{number}"
    return [
        slab(x, y, yaw, length, width, role, 0.0, 0.85),
        slab(x - 0.35 * c, y - 0.35 * s, yaw, 0.52 * length, width - 0.12, role, 0.85, 1.48),
    ]


def _cars(p: _Passage, rng: np.random.Generator) -> Closure:
    spare = (p.width - CAR[0]) / 2
    x, y = p.at(p.width / 2 + rng.uniform(-1, 1) * max(SHUT - abs(spare), 0.0))
    across = parked(x, y, p.yaw, p.number)
    x, y = p.at(CAR[1] / 2 + 0.15)
    return Closure([], across, parked(x, y, p.yaw + p.side * math.pi / 2, p.number))


def _crates(p: _Passage, rng: np.random.Generator) -> Closure:
    gap = rng.uniform(WAY + 0.1, min(p.width - 0.3, WAY + 0.6))
    low = rng.uniform(0.1, p.width - gap - 0.1)
    crates = []
    for k, (start, end) in enumerate(((0.0, low), (low, low + gap), (low + gap, p.width))):
        depth, high = rng.uniform(0.5, min(1.0, p.depth)), rng.uniform(0.8, 1.7)
        across = rng.uniform(-0.5, 0.5) * min(p.depth - depth, 0.2)
        crates.append(p.bar(start, end, depth, f"crate:{p.number}.{k}", 0.0, high, across))
    return Closure([crates[0], crates[2]], [crates[1]], [])


_MAKE = {
    "wall": _wall,
    "glass": _glass,
    "door": _door,
    "hedge": _hedge,
    "drop": _drop,
    "cars": _cars,
    "crates": _crates,
}
