"""Which ways lie open to a robot: front, left, right (host code).

A sector is OPEN iff some continuation in it gets `straight` away within `travel` without being a dead end:

    (1)  open(s) = some c in F : |c - x| >= straight, |bearing(c) - s| <= 45 deg, way(x, c) <= travel, good(c)
    (2)  good(c) = c is no dead end, or depth(c) <= depth(x) - |c - x| / sqrt 2

with x the robot, s in {0, 90, -90 deg} to the left of its heading, F where its centre may be and way(x, c) the length of
the way in F. The second half of eq. 2 is for a robot that is in a dead end itself: the way out of it is none.

Ways are not measured, only told apart by whether they are short enough. Of n = 0.96 travel / cell steps every
sqrt 2 + 1st, on average, goes to 8 neighbours and the others to 4, so what n steps reach in the open is a regular octagon
within 4 % of the circle, and around corners it errs as little. 64 of these sets grow at once, one in each bit of a word.

A label is stable iff it is the same wherever in F a robot is found that stands up to `shift` ahead, behind or aside of
the pose, or not at all, and is turned by up to `turn`, or not at all.
"""

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt64

from drnav_jax.worlds.truth import GroundTruth

SECTORS = ("front", "left", "right")
_QUADRANT = (0, 1, 3)  # quarter turns to the left of the heading
_OCTAGON = 0.96  # half way between the circles within and around the octagon
_ASTRAY = 0.3  # [m] a robot is this near to F at least, however coarse the grid


@dataclasses.dataclass(frozen=True)
class OpeningSpec:
    """What makes a way open, and a label stable.

    Attributes:
        straight: Least straight distance to get away [m].
        travel: Longest way there [m].
        shift: Change of position that a stable label stands [m].
        turn: Change of heading that a stable label stands [rad].
    """

    straight: float = 2.5
    travel: float = 5.0
    shift: float = 0.1
    turn: float = math.radians(5.0)

    def __post_init__(self) -> None:
        """Check ranges."""
        if not 0 < self.straight <= self.travel < math.inf:
            raise ValueError(f"0 < straight <= travel must hold, got {self.straight} m and {self.travel} m.")
        if not (self.shift >= 0 and 0 <= self.turn < math.pi / 4):
            raise ValueError(
                f"shift must be >= 0 m and turn in [0, pi/4) rad, got {self.shift} and {self.turn}."
            )


class Openings(NamedTuple):
    """What N robots have before them; sectors in the order of `SECTORS`."""

    open: Bool[np.ndarray, "N 3"]  # else the way is BLOCKED
    stable: Bool[np.ndarray, "N 3"]
    dead_end: Bool[np.ndarray, " N"]  # all three are BLOCKED
    dead_end_stable: Bool[np.ndarray, " N"]


def openings(
    truth: GroundTruth,
    poses: Float[np.ndarray, "N 3"],
    spec: OpeningSpec = OpeningSpec(),  # noqa: B008 (immutable)
) -> Openings:
    """Path labels of robots in one world.

    Args:
        truth: Of the world.
        poses: x, y, yaw in the world [m, rad]. Who is found up to 0.3 m off F, touching a wall say, counts as in
            its nearest cell; whoever is further off has no way open, and no stable label.
        spec: Distances.
    """
    moves = spec.shift * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    turns = spec.turn * np.array([0, 1, -1])
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    ahead, aside = np.stack([c, s], axis=1)[:, None], np.stack([-s, c], axis=1)[:, None]
    starts = poses[:, None, :2] + ahead * moves[:, :1] + aside * moves[:, 1:]
    size = 64 // len(moves)
    parts = [slice(k, k + size) for k in range(0, len(poses), size)]
    found = [_open(truth, starts[p], poses[p, 2, None] + turns, spec) for p in parts]
    shape = (0, len(moves), len(turns), 3)
    is_open = np.concatenate([np.zeros(shape, bool), *(f for f, _ in found)])
    known = np.concatenate([np.zeros(shape[:2], bool), *(k for _, k in found)])[..., None]
    dead_end, nominal = ~is_open.any(axis=-1), is_open[:, 0, 0]
    same = ((is_open == nominal[:, None, None]) | ~known[..., None]).all(axis=(1, 2))
    same_end = ((dead_end == dead_end[:, :1, :1]) | ~known).all(axis=(1, 2))
    there = known[:, 0, 0]
    return Openings(nominal, same & there[:, None], dead_end[:, 0, 0], same_end & there)


def _open(
    truth: GroundTruth, starts: Float[np.ndarray, "n M 2"], yaws: Float[np.ndarray, "n Y"], spec: OpeningSpec
) -> tuple[Bool[np.ndarray, "n M Y 3"], Bool[np.ndarray, "n M"]]:
    """Eq. 1 for n robots, each from M places with Y headings; and which of the places are in F."""
    n, m = starts.shape[:2]
    cell = truth.resolution
    num_steps = round(_OCTAGON * spec.travel / cell)
    half = num_steps + math.ceil(spec.shift / cell) + math.ceil(_ASTRAY / cell) + 2
    corner = np.floor((starts[:, 0, ::-1] - truth.origin[::-1]) / cell).astype(int) - half
    rows, columns = (corner[:, k, None] + np.arange(2 * half + 1) for k in (0, 1))
    free, label, depth = _crops(truth, rows, columns)
    free[:, [0, -1]] = free[:, :, [0, -1]] = False  # shifts never wrap around

    at = np.floor((starts[..., ::-1] - truth.origin[::-1]) / cell).astype(int) - corner[:, None]
    known = free[np.arange(n)[:, None], at[..., 0], at[..., 1]]
    for k in np.flatnonzero(~known[:, 0]):
        cells = np.argwhere(free[k])
        centre = (cells + corner[k] + 0.5)[:, ::-1] * cell + truth.origin
        away = np.hypot(*(centre - starts[k, 0]).T)
        if len(away) and away.min() <= max(_ASTRAY, 1.5 * cell):
            at[k, 0], known[k, 0] = cells[away.argmin()], True

    bit = np.uint64(1) << np.arange(n * m, dtype=np.uint64).reshape(n, m)
    words = np.bitwise_or.reduce(
        np.where(free, np.bitwise_or.reduce(bit, axis=1)[:, None, None], np.uint64(0)), axis=0
    )
    reached = np.zeros_like(words)
    np.bitwise_or.at(reached, (at[known][:, 0], at[known][:, 1]), bit[known])
    reached = _spread(reached, words, num_steps)

    lit = np.unpackbits(reached.astype("<u8").view(np.uint8).reshape(*reached.shape, 8), axis=-1, bitorder="little")
    i, j, b = np.nonzero(lit)
    robot, place = np.divmod(b, m)
    x = (columns[robot, j] + 0.5) * cell + truth.origin[0] - starts[robot, place, 0]
    y = (rows[robot, i] + 0.5) * cell + truth.origin[1] - starts[robot, place, 1]
    distance = np.hypot(x, y)
    here = depth[np.arange(n)[:, None], at[..., 0], at[..., 1]]
    good = ~label[robot, i, j] | (depth[robot, i, j] <= here[robot, place] - distance / math.sqrt(2))
    good &= distance >= spec.straight - 1e-9
    x, y, robot, b = x[good], y[good], robot[good], b[good]
    bearing = np.arctan2(y, x)
    is_open = np.zeros((n * m, yaws.shape[1], 4), bool)
    for k in range(yaws.shape[1]):
        quarter = np.floor((bearing - yaws[robot, k]) / (math.pi / 2) + 0.5).astype(int) % 4
        is_open[b, k, quarter] = True
    return is_open.reshape(n, m, -1, 4)[..., _QUADRANT], known


def _crops(
    truth: GroundTruth, rows: Int[np.ndarray, "n L"], columns: Int[np.ndarray, "n L"]
) -> tuple[Bool[np.ndarray, "n L L"], Bool[np.ndarray, "n L L"], Float[np.ndarray, "n L L"]]:
    """F, dead ends and depth [m] in windows, which may reach beyond the grid."""
    h, w = truth.label.shape
    inside = ((rows >= 0) & (rows < h))[:, :, None] & ((columns >= 0) & (columns < w))[:, None, :]
    index = np.clip(rows, 0, h - 1)[:, :, None] * w + np.clip(columns, 0, w - 1)[:, None, :]
    free = np.where(inside, truth.standable.ravel()[index], truth.outside_is_free)
    label = inside & truth.label.ravel()[index]
    return free, label, np.where(inside, truth.depth.ravel()[index], 0).astype(np.float32)


def _spread(
    reached: UInt64[np.ndarray, "L L"], free: UInt64[np.ndarray, "L L"], num_steps: int
) -> UInt64[np.ndarray, "L L"]:
    """Sets of cells, one in each bit, after some steps in what is free for each; its edge must not be."""
    width = reached.shape[1]
    free, now = free.ravel(), reached.ravel() & free.ravel()

    def grown(cells: np.ndarray, by: int) -> np.ndarray:
        out = cells.copy()
        out[by:] |= cells[:-by]
        out[:-by] |= cells[by:]
        out &= free
        return out

    diagonals = np.floor(np.arange(num_steps + 1) * (math.sqrt(2) - 1))
    for is_diagonal in np.diff(diagonals) > 0:
        along, across = grown(now, 1), grown(now, width)
        if is_diagonal:  # around a corner only by way of a cell beside it
            along, across = grown(along, width), grown(across, 1)
        now = along | across
    return now.reshape(reached.shape)
