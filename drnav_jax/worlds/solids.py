"""What layouts are made of: upright boxes and cylinders that know which role they play, and layouts themselves.

A layout is drawn in its own frame: the trip runs along +x, and the place that is a way or a dead end lies ahead. What
a solid is made of is left open here; `dressing` chooses by its role.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

WAY = 1.2  # [m] width that clutter leaves free along every passage
WING = 50.0  # [m] of wall to either side of a block
REAR = 7.0  # [m] of stem or fence behind the start
LINTEL = 2.1  # [m] height of doors
TOP = math.inf  # as z_max: up to the ceiling, or to the common height of walls under the sky

Rect = tuple[float, float, float, float]  # x_min, y_min, x_max, y_max
Point = tuple[float, float]
Draw = Callable[[str], float]


class Solid(NamedTuple):
    """One box or cylinder. Solids of one role look the same, so a role ends in ":NUMBER" where they should not."""

    row: np.ndarray  # x, y, yaw, half length, half width, z_min, z_max; or x, y, radius, z_min, z_max
    role: str  # key of `dressing.ROLES` (, ":NUMBER")

    @property
    def is_box(self) -> bool:
        """Or a cylinder."""
        return len(self.row) == 7


@dataclasses.dataclass(frozen=True)
class Layout:
    """A layout in its own frame."""

    solids: list[Solid]  # of both twins
    plugs: list[Solid]  # of the closed one: they close the way
    doorposts: list[Solid]  # of the open one, in place of plugs
    ways: list[np.ndarray]  # polylines [L, 2] along which clutter leaves WAY
    hull: Rect  # everything but the wings, start and goal
    start: Point
    goal: Point
    corridors: list[tuple[np.ndarray, float]] = dataclasses.field(default_factory=list)
    """Polylines along whose walls clutter stands, and their widths."""
    yards: list[Rect] = dataclasses.field(default_factory=list)  # where clutter stands freely
    num_clutter: int = 5


def wall(a: Point, b: Point, thickness: float, role: str = "wall", low: float = 0.0, high: float = TOP) -> Solid:
    """The box around a segment, longer by half its thickness at both ends."""
    (ax, ay), (bx, by) = a, b
    length = math.hypot(bx - ax, by - ay)
    yaw = math.atan2(by - ay, bx - ax)
    half = (length + thickness) / 2
    return Solid(np.array([(ax + bx) / 2, (ay + by) / 2, yaw, half, thickness / 2, low, high]), role)


def box(rect: Rect, role: str = "wall", low: float = 0.0, high: float = TOP) -> Solid:
    """The box over a rectangle."""
    x0, y0, x1, y1 = rect
    return Solid(np.array([(x0 + x1) / 2, (y0 + y1) / 2, 0.0, (x1 - x0) / 2, (y1 - y0) / 2, low, high]), role)


def slab(x: float, y: float, yaw: float, length: float, width: float, role: str, low: float, high: float) -> Solid:
    """The box of a length along its yaw and a width across, both whole."""
    return Solid(np.array([x, y, yaw, length / 2, width / 2, low, high]), role)


def post(x: float, y: float, radius: float, role: str, high: float, low: float = 0.0) -> Solid:
    """A cylinder."""
    return Solid(np.array([x, y, radius, low, high]), role)


def carved(block: Rect, free: list[Rect], role: str = "wall") -> list[Solid]:
    """Boxes that fill a block but for some rectangles: strips along y, merged along x."""
    xs = sorted({min(max(x, block[0]), block[2]) for r in [block, *free] for x in (r[0], r[2])})
    ys = sorted({min(max(y, block[1]), block[3]) for r in [block, *free] for y in (r[1], r[3])})
    running: dict[tuple[float, float], float] = {}  # strips that reach the current x, and from where
    boxes = []
    for x0, x1 in [*zip(xs[:-1], xs[1:], strict=True), (block[2], block[2])]:
        x = (x0 + x1) / 2
        strips: list[tuple[float, float]] = []
        for y0, y1 in zip(ys[:-1], ys[1:], strict=True):
            y = (y0 + y1) / 2
            hollow = any(r[0] < x < r[2] and r[1] < y < r[3] for r in free)
            if hollow or x1 == x0:
                continue
            if strips and strips[-1][1] == y0:
                strips[-1] = (strips[-1][0], y1)
            else:
                strips.append((y0, y1))
        for strip in [s for s in running if s not in strips]:
            boxes.append(box((running.pop(strip), strip[0], x0, strip[1]), role))
        for strip in strips:
            running.setdefault(strip, x0)
    return boxes


def block(hull: Rect, free: list[Rect], rng: np.random.Generator, fence: float = 0.0, role: str = "wall") -> list[Solid]:
    """A block with passages and the wall that it stands in, which on one side runs back first.

    The block is of the given role; the wall always is one.
    """
    thickness = rng.uniform(0.2, 0.3)
    x, back, low, high = hull[0] + thickness / 2, hull[0] - fence, hull[1], hull[3]
    turns = [(x, high), (back, high)] if fence > 0 else [(x, high)]
    wing = [*turns, (turns[-1][0], high + WING)]
    walls = [wall(a, b, thickness) for a, b in zip(wing[:-1], wing[1:], strict=True)]
    return [*carved(hull, free, role), *walls, wall((x, low), (x, low - WING), thickness)]


def wings(x: float, low: float, high: float, thickness: float, role: str = "wall") -> list[Solid]:
    """Walls that run on for `WING` metres below and above a front at x, so that nobody gets around it."""
    return [wall((x, high), (x, high + WING), thickness, role), wall((x, low), (x, low - WING), thickness, role)]


def moved(points: np.ndarray, mirror: float, angle: float, shift: np.ndarray) -> np.ndarray:
    """Points `[N, 2]`, mirrored at the x axis if `mirror` is -1, turned and moved."""
    c, s = math.cos(angle), math.sin(angle)
    x, y = points[:, 0], mirror * points[:, 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=1) + shift


def moved_solid(solid: Solid, mirror: float, angle: float, shift: np.ndarray) -> Solid:
    """A solid, moved as `moved` does points."""
    row = solid.row.astype(np.float64)
    row[:2] = moved(row[None, :2], mirror, angle, shift)[0]
    if solid.is_box:
        row[2] = math.remainder(mirror * row[2] + angle, 2 * math.pi)
    return Solid(row, solid.role)


class Fork(NamedTuple):
    """A stem in which the robot starts, and a detour that leaves it to the right, all through one block."""

    free: list[Rect]
    stem: np.ndarray  # centre line [L, 2], from behind the start to where the way ahead begins
    detour: np.ndarray  # centre line [L, 2], from the stem to the far side


def fork(at: float, ahead: float, aside: float, far: float, width: float) -> Fork:
    """A stem up to x = ahead, with a detour at x = at that runs at y = -aside to the far side."""
    h = width / 2
    return Fork(
        free=[
            (-REAR, -h, ahead, h),
            (at - h, -aside - h, at + h, h),
            (at - h, -aside - h, far, -aside + h),
        ],
        stem=np.array([[-REAR, 0.0], [ahead, 0.0]]),
        detour=np.array([[at, 0.0], [at, -aside], [far, -aside]]),
    )


def portal(
    x: float, y: float, along_x: bool, width: float, role: str, jamb: float = 0.08, depth: float = 0.08
) -> list[Solid]:
    """Two jambs around an opening of a width, and a lintel over it, centred at x, y.

    Args:
        x: Of the centre [m].
        y: Of the centre [m].
        along_x: Whether one passes it along x, or along y.
        width: Of the opening between the jambs [m].
        role: Of all three.
        jamb: Width of a jamb [m].
        depth: Of jambs and lintel in the way's direction [m].
    """
    yaw = math.pi / 2 if along_x else 0.0  # of the lintel
    ux, uy = math.cos(yaw), math.sin(yaw)
    d = (width + jamb) / 2
    sides = [slab(x + s * d * ux, y + s * d * uy, yaw, jamb, depth, role, 0.0, LINTEL + jamb) for s in (-1, 1)]
    return [*sides, slab(x, y, yaw, width, depth, role, LINTEL, LINTEL + jamb)]


def leaf(hinge: Point, angle: float, length: float, role: str, thickness: float = 0.06) -> Solid:
    """A door leaf from its hinge in a direction."""
    c, s = math.cos(angle), math.sin(angle)
    return slab(hinge[0] + c * length / 2, hinge[1] + s * length / 2, angle, length, thickness, role, 0.0, LINTEL)
