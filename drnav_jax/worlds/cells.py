"""Cells of a compound, and where the ways in them meet.

A cell is a rectangle between walls with *ports* in its sides. `houses` and `yards` fill it: nothing stands on the ways
from the ports to the hub, nor before a port.
"""

from typing import NamedTuple

from drnav_jax.worlds.solids import Point, Rect

EAST, NORTH, WEST, SOUTH = range(4)
DIRECTION = ((1, 0), (0, 1), (-1, 0), (0, -1))  # of each side


class Port(NamedTuple):
    """A passage, or what looks like one, in a side of a cell."""

    side: int  # EAST, NORTH, WEST or SOUTH
    at: float  # its middle, along the side [m]
    width: float


class Cell(NamedTuple):
    """A cell of a compound."""

    rect: Rect  # between its walls
    ports: list[Port]
    blind: list[int]  # sides to which corridors lead that end (houses)
    culs: int  # culs-de-sac that stand in it (yards)
    number: int  # tells its colours from those of others

    def point(self, port: Port, inset: float = 0.0) -> Point:
        """The middle of a port, or so many metres before it."""
        x0, y0, x1, y1 = self.rect
        return {
            EAST: (x1 - inset, port.at),
            WEST: (x0 + inset, port.at),
            NORTH: (port.at, y1 - inset),
            SOUTH: (port.at, y0 + inset),
        }[port.side]


def hub(cell: Cell) -> Point:
    """Where a cell's ways meet: straight ahead of a port in x and of one in y, if there are such, else in the middle."""
    x0, y0, x1, y1 = cell.rect
    along = {0: (x0 + x1) / 2, 1: (y0 + y1) / 2}
    for port in reversed(cell.ports):
        along[1 if port.side in (EAST, WEST) else 0] = port.at
    return along[0], along[1]


def clipped(rect: Rect, within: Rect) -> Rect:
    """The part of a rectangle within another."""
    return max(rect[0], within[0]), max(rect[1], within[1]), min(rect[2], within[2]), min(rect[3], within[3])


def meet(a: Rect, b: Rect, margin: float = 0.0) -> bool:
    """Whether two rectangles overlap, or come nearer than a margin [m] in x and y."""
    return bool(a[0] < b[2] + margin and b[0] < a[2] + margin and a[1] < b[3] + margin and b[1] < a[3] + margin)


def inside(a: Rect, b: Rect, margin: float) -> bool:
    """Whether a rectangle lies in another, a margin [m] from its sides."""
    x, y = (a[k] >= b[k] + margin and a[k + 2] <= b[k + 2] - margin for k in (0, 1))
    return bool(x and y)
