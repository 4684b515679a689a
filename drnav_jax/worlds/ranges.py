"""How large the layouts of each split are.

`val` draws other seeds from the ranges of `train`; both are narrower than those of `test`. Families without ranges of
`train` are `HELD_OUT`: nothing is trained or tuned on them.
"""

import numpy as np

Range = tuple[float, float]

# family: {what: (range of train and val, range of test)} [m, degrees, pieces].
RANGES: dict[str, dict[str, tuple[Range | None, Range]]] = {
    "open": {
        "length": ((16, 22), (15, 28)),  # start to goal
        "count": ((8, 16), (6, 22)),  # obstacles
    },
    "u": {
        "ahead": ((4, 8), (3, 9)),  # start to mouth
        "depth": ((5, 8), (4, 10)),  # mouth to back wall
        "width": ((3, 4.2), (2.8, 4.7)),  # between the side walls, at the back
        "flare": ((0, 10), (-5, 20)),  # angle by which a side wall opens toward the mouth
        "door": ((1.6, 2.2), (1.4, 2.2)),  # in the back wall of the open twin
        "behind": ((4, 7), (3, 8)),  # back wall to goal
    },
    "corridor": {
        "ahead": ((2.5, 5), (2, 6)),  # start to block
        "depth": ((4, 7), (3.5, 10)),  # of the dead end
        "end": ((0.3, 1), (0.2, 2)),  # thickness of what closes it
        "width": ((1.8, 2.6), (1.5, 3)),  # of the dead end
        "through": ((1.8, 2.6), (1.5, 3)),  # width of the way through
        "aside": ((4, 6), (3.5, 8)),  # from one centre line to the other
        "behind": ((3, 5), (2, 6)),  # block to goal
    },
    "t": {
        "stem": ((6, 9), (5, 11)),  # start to the centre line of the arms
        "width": ((1.8, 2.6), (1.6, 3)),  # of stem and arms
        "arm": ((4.5, 6), (4, 7.5)),  # stem to the corner of the blocked arm
        "longer": ((-0.5, 1), (-0.5, 2)),  # by how much the other arm is longer
        "depth": ((2.5, 5), (2, 8)),  # corner to the end of the blocked arm
        "end": ((1.5, 3), (1, 4)),  # thickness of what closes it
        "behind": ((2, 4), (2, 5)),  # block to goal
    },
    "l": {
        "stem": ((5, 7), (4, 9)),  # start to fork
        "width": ((1.8, 2.6), (1.6, 3)),  # of all corridors
        "straight": ((4.5, 6.5), (3.5, 8.5)),  # fork to corner
        "depth": ((3, 5), (2.5, 7)),  # corner to dead end
        "end": ((1.5, 3), (1, 4)),  # from there to the far side of the block
        "aside": ((4.5, 6.5), (4, 8.5)),  # fork to the corner of the detour
        "behind": ((3, 5), (2, 6)),  # block to goal
    },
    "t-both": {
        "fork": ((3, 4.5), (2.5, 5.5)),  # start to the detour
        "stem": ((4.5, 6), (4, 7)),  # from there to the centre line of the arms
        "width": ((1.8, 2.6), (1.6, 3)),  # of all corridors
        "arm": ((4, 5), (3.5, 6)),  # stem to the corner of one arm
        "longer": ((-0.5, 0.5), (-0.5, 1.5)),  # by how much the other arm is longer
        "depth": ((2.5, 4), (2, 6)),  # corner to the end of an arm
        "end": ((1.5, 3), (1, 4)),  # thickness of what closes it
        "behind": ((2, 4), (2, 5)),  # block to goal
    },
    "lobby": {
        "stem": (None, (4, 7)),  # start to the detour
        "run": (None, (3, 5)),  # from there to the lobby
        "width": (None, (1.8, 2.8)),  # of the corridors
        "depth": (None, (3, 5)),  # of the lobby
        "hall": (None, (4, 6.5)),  # width of the lobby
        "door": (None, (1.4, 1.8)),  # of a lift, or of the passage in its place
        "end": (None, (1.5, 4)),  # lobby to the far side of the block
        "aside": (None, (5, 7)),  # stem to the way round
        "behind": (None, (3, 5)),  # block to goal
    },
    "room": {
        "stem": ((4, 6), (3, 7)),  # start to the detour
        "run": ((2.5, 4), (2.2, 5)),  # from there to the room
        "width": ((1.8, 2.6), (1.7, 3)),  # of the corridors
        "depth": ((4.5, 6.5), (4, 8)),  # of the room
        "hall": ((4.5, 6.5), (4, 8)),  # width of the room
        "door": ((1.3, 1.42), (1.25, 1.48)),
        "end": ((2.5, 4), (2.2, 5)),  # room to the far side of the block
        "aside": ((5, 7), (4.5, 8)),  # stem to the way round
        "behind": ((3, 5), (2, 6)),  # block to goal
    },
    "glass": {
        "stem": ((4.5, 6), (4, 7)),  # start to the detour
        "run": ((1.6, 3), (1.6, 4)),  # from there to the hall
        "width": ((1.8, 2.4), (1.6, 2.8)),  # of the corridors
        "hall": ((2.2, 4.2), (1.9, 4.8)),  # width of the hall
        "before": ((3.5, 6), (3.2, 8)),  # depth of the hall before the glass
        "door": ((1.4, 1.7), (1.35, 1.9)),  # bay of the door
        "after": ((2.5, 4), (2, 5)),  # glass to the far side of the block
        "aside": ((5, 7), (4.5, 8)),  # stem to the way round
        "behind": ((3, 5), (2, 6)),  # block to goal
    },
    "dock": {
        "stem": (None, (5, 7)),  # start to the detour
        "run": (None, (1.6, 3)),  # from there to the deck
        "width": (None, (1.8, 2.8)),  # of the ways
        "deck": (None, (2.4, 4.8)),  # width of the deck
        "apron": (None, (3, 5.5)),  # of the deck before the edge
        "bay": (None, (2.5, 5)),  # length of the drop, or between the painted lines
        "end": (None, (1.5, 3)),  # from there to the far side of the block
        "paint": (None, (0.25, 0.5)),  # width of the painted edge
        "aside": (None, (5, 7)),  # stem to the way round
        "behind": (None, (3, 5)),  # block to goal
    },
    "cars": {
        "stem": ((4, 6), (3.5, 7)),  # start to the detour
        "run": ((1.8, 3), (1.6, 4)),  # from there to the lot
        "width": ((2.2, 2.8), (2, 3.2)),  # of the ways
        "gap": ((0.24, 0.3), (0.22, 0.33)),  # between cars side by side
        "row": ((3, 5), (3, 5)),  # cars across the end: 3 or 4
        "aisle": ((2, 3), (1, 4)),  # cars along each side
        "aside": ((7, 8), (6, 9)),  # stem to the way round
        "behind": ((3, 5), (2, 6)),  # block to goal
    },
    "trail": {
        "stem": ((4, 6), (3.5, 7)),  # start to the detour
        "run": ((4, 6), (3.5, 8)),  # from there to the plants that cross
        "width": ((1.8, 2.4), (1.6, 2.8)),  # of the trails
        "deep": ((0.9, 1.4), (0.8, 1.8)),  # of the plants that cross
        "top": ((1.0, 1.5), (0.8, 1.7)),  # their height
        "end": ((2, 3.5), (1.5, 4.5)),  # from there to the far side of the hedges
        "aside": ((3.5, 5), (3, 6.5)),  # stem to the way round, less the width
        "behind": ((3, 5), (2, 6)),  # hedges to goal
    },
    "field": {
        "ahead": ((4, 7), (3, 8)),  # start to the pocket on the way
        "depth": ((4, 6), (3.5, 8)),  # of the pocket
        "width": ((2.4, 3.6), (2, 4)),  # of the pocket
        "door": ((1.5, 2), (1.4, 2.2)),  # least hole in the back of the open twin
        "behind": ((5, 7), (4, 8)),  # pocket to goal
        "pockets": ((2, 5), (1, 6)),  # elsewhere, where there is room
        "count": ((6, 12), (4, 16)),  # obstacles between them
    },
    "maze": {
        "columns": ((5, 7), (4, 8)),  # cells along the trip
        "rows": ((4, 5), (3, 6)),  # cells across it
        "pitch": ((2.0, 2.6), (1.8, 3.0)),  # of the cells
        "behind": ((2, 4), (2, 5)),  # maze to goal
    },
    "office": {
        "length": ((18, 24), (16, 28)),  # start to the far side
        "width": ((1.8, 2.4), (1.6, 2.8)),  # of the corridors
        "deep": ((5, 7), (4.5, 8)),  # of the rooms between them
        "end": ((0.3, 2), (0.2, 3)),  # thickness of what closes the corridor
        "through": ((0.1, 0.3), (0.0, 0.5)),  # share of middle rooms with two doors
        "shut": ((0.15, 0.4), (0.1, 0.5)),  # share of rooms whose door is shut
        "glazed": ((0.1, 0.4), (0.0, 0.6)),  # share of walls beside doors that are of glass
        "behind": ((2, 4), (2, 5)),  # far side to goal
    },
    "site": {
        "count": ((4, 5), (4, 6)),  # modules
    },
}
TURN = ((-5.0, 5.0), (-15.0, 15.0))  # of every layout, beyond a multiple of 90 degrees

HELD_OUT = tuple(family for family, of in RANGES.items() if any(train is None for train, _ in of.values()))


class Draws:
    """Numbers of one layout, drawn from a family's ranges as they are asked for by name."""

    def __init__(self, family: str, test: bool, rng: np.random.Generator) -> None:
        """Of a family, in the split test or in the others."""
        self._ranges, self._test, self._rng = RANGES[family], test, rng

    def __call__(self, name: str) -> float:
        """A number out of the named range."""
        of_train, of_test = self._ranges[name]
        low, high = of_test if self._test or of_train is None else of_train
        return self._rng.uniform(low, high)

    def of(self, family: str) -> "Draws":
        """The same for a module of another family."""
        return Draws(family, self._test, self._rng)

    def has(self, family: str) -> bool:
        """Whether this split may use a family."""
        return self._test or family not in HELD_OUT
