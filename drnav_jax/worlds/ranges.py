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
        "columns": ((5, 9), (5, 11)),  # cells along the trip: 5 to 8, 5 to 10
        "rows": ((4, 8), (4, 10)),  # cells across: 4 to 7, 4 to 9
        "width": ((1.6, 2.3), (1.5, 2.6)),  # of the passages
        "winding": ((0.5, 0.95), (0.2, 1)),  # 0 = short branches, 1 = long ones
        "loops": ((0, 0.06), (0, 0.1)),  # probability that a wall which no tree needs open is open
        "decisions": ((2, 5), (2, 7)),  # branches off the way that lead nowhere, at least
        "more": ((0, 3), (0, 4)),  # dead ends that the open twin has open beside the shortcut
        "decoys": ((2, 7), (2, 9)),  # things in passages that both twins have open or closed
        "stem": ((5, 7), (4, 8)),  # length of the stem in which the robot starts
        "behind": ((2, 4), (2, 5)),  # exit to goal
    },
    "office": {
        "cross": ((2, 4), (2, 4.6)),  # cross corridors: 2 or 3, in test up to 4
        "corridors": ((2, 3.4), (2, 3.7)),  # corridors: 2 or 3
        "width": ((1.6, 2.2), (1.5, 2.5)),  # of all of them
        "block": ((7, 11), (6, 13)),  # between cross corridors
        "between": ((5, 9.5), (4.5, 11)),  # between corridors: one row of rooms, or two
        "room": ((3.5, 5), (3, 6)),  # depth of the rooms at the outer walls
        "halls": ((0.3, 0.6), (0.2, 0.8)),  # share of the blocks that one may cross
        "rooms": ((0.35, 0.65), (0.3, 0.7)),  # share of the rooms that stand open
        "loops": ((0, 0.2), (0, 0.3)),  # share of the ways that no tree needs open but are
        "decisions": ((3, 6), (3, 8)),  # shut ways and corridor ends that the trip meets, at least
        "more": ((0, 2), (0, 3)),  # ways that the open twin has open beside the shortcut
        "decoys": ((0.1, 0.3), (0.1, 0.4)),  # share of the open ways with an open door, empty frame, ... across
        "standing": ((0, 6), (0, 8)),  # cabinets along the corridors
        "stem": ((5, 7), (4, 8)),  # length of the stem in which the robot starts
        "behind": ((2, 4), (2, 5)),  # exit to goal
    },
    "site": {
        "columns": ((3, 5), (3, 6)),  # cells along the trip: 3 or 4, in test up to 5
        "rows": ((3, 5), (3, 5)),  # cells across: 3 or 4
        "cell": ((9.5, 13), (8.5, 15)),  # edge of a cell
        "houses": ((0.3, 0.6), (0.2, 0.7)),  # share of the cells that are houses, not yards
        "loops": ((0, 0.1), (0, 0.15)),  # share of the ways that no tree needs open but are
        "winding": ((0.4, 0.9), (0.2, 1)),  # 0 = short branches, 1 = long ones
        "branches": ((2, 4), (2, 5)),  # that leave the trip and lead nowhere, at least
        "decisions": ((4, 10), (4, 12.9)),  # branches, blind corridors and culs-de-sac on the trip
        "more": ((0, 2), (0, 3)),  # ways that the open twin has open beside the shortcut
        "decoys": ((0.2, 0.5), (0.1, 0.6)),  # share of the walls that look like a way that is shut
        "plain": ((0.2, 0.5), (0.1, 0.6)),  # share of the ways in which nothing stands
        "stem": ((5, 7), (4, 8)),  # length of the lane in which the robot starts
        "behind": ((3, 5), (2, 6)),  # gate to goal
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
