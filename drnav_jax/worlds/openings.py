"""Which ways lie open to a robot: front, left, right (host code).

A sector is OPEN iff some continuation in it gets `straight` away within `travel` without being a dead end:

    (1)  open(s) = some c in F : |c - x| >= straight, |bearing(c) - s| <= 45 deg, way(x, c) <= travel, good(c)
    (2)  good(c) = c is no dead end, or depth(c) <= depth(x) - |c - x| / sqrt 2

with x the robot, s in {0, 90, -90 deg} to the left of its heading, F where its centre may be, and way(x, c) the length of
the way in F that never enters the quadrant behind the robot: to turn back is no continuation. The second half of eq. 2
is for a robot that is in a dead end itself: the way out is none.

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
from jaxtyping import Bool, Float, Int

from drnav_jax.worlds.truth import GroundTruth

SECTORS = ("front", "left", "right")
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


class Floor(NamedTuple):
    """What is asked of a `GroundTruth` here, for grids that are none: what a rule believes, say."""

    label: Bool[np.ndarray, "H W"]  # dead ends
    depth: Float[np.ndarray, "H W"]  # of them [m]
    standable: Bool[np.ndarray, "H W"]  # F
    origin: Float[np.ndarray, "2"]  # x, y of the outer corner of cell (0, 0) [m]
    resolution: float  # [m]
    outside_is_free: bool  # whether one may drive beyond the grid


class Openings(NamedTuple):
    """What N robots have before them; sectors in the order of `SECTORS`."""

    open: Bool[np.ndarray, "N 3"]  # else the way is BLOCKED
    stable: Bool[np.ndarray, "N 3"]
    dead_end: Bool[np.ndarray, " N"]  # all three are BLOCKED
    dead_end_stable: Bool[np.ndarray, " N"]


def openings(
    truth: GroundTruth | Floor,
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
    places = poses[:, None, :2] + ahead * moves[:, :1] + aside * moves[:, 1:]
    shape = (len(poses), len(moves), len(turns))
    near = np.empty((*shape, 3))
    near[..., :2], near[..., 2] = places[:, :, None], poses[:, 2, None, None] + turns
    near = near.reshape(len(poses), len(moves) * len(turns), 3)
    size = max(1, 64 // near.shape[1])
    found = [_open(truth, near[k : k + size], spec) for k in range(0, len(poses), size)]
    is_open = np.concatenate([np.zeros((0, near.shape[1], 3), bool), *(f for f, _ in found)])
    known = np.concatenate([np.zeros((0, near.shape[1]), bool), *(k for _, k in found)])
    dead_end = np.logical_not(np.any(is_open, axis=-1))
    same = np.all((is_open == is_open[:, :1]) | ~known[..., None], axis=1)
    same_end = np.all((dead_end == dead_end[:, :1]) | ~known, axis=1)
    there = known[:, 0]
    return Openings(is_open[:, 0], same & there[:, None], dead_end[:, 0], same_end & there)


def _open(
    truth: GroundTruth | Floor, poses: Float[np.ndarray, "n M 3"], spec: OpeningSpec
) -> tuple[Bool[np.ndarray, "n M 3"], Bool[np.ndarray, "n M"]]:
    """Eq. 1 for n robots, each in M poses about its first; and which of them are in F."""
    n, m = poses.shape[:2]
    cell = truth.resolution
    num_steps = round(_OCTAGON * spec.travel / cell)
    half = num_steps + math.ceil(spec.shift / cell) + math.ceil(_ASTRAY / cell) + 2
    at = np.floor((poses[..., 1::-1] - truth.origin[::-1]) / cell).astype(int)  # (row, column)
    corner = at[:, 0] - half
    rows, columns = (corner[:, k, None] + np.arange(2 * half + 1) for k in (0, 1))
    free, label, depth = _crops(truth, rows, columns)
    free[:, [0, -1]] = free[:, :, [0, -1]] = False  # shifts never wrap around
    at -= corner[:, None]
    known = free[np.arange(n)[:, None], at[..., 0], at[..., 1]]
    for k in np.flatnonzero(~known[:, 0]):
        cells = np.argwhere(free[k])
        centre = (cells + corner[k] + 0.5)[:, ::-1] * cell + truth.origin
        away = np.hypot(*(centre - poses[k, 0, :2]).T)
        if len(away) and away.min() <= max(_ASTRAY, 1.5 * cell):
            same = (poses[k, :, :2] == poses[k, 0, :2]).all(axis=1)
            at[k, same], known[k, same] = cells[away.argmin()], True

    sets = np.zeros((2, 64, *free.shape[1:]), bool)  # where each may be, and is at first
    fits = np.empty((n * m, 3, *free.shape[1:]), bool)  # cells of eq. 1 but for the way there
    for b in range(n * m):
        k, (i, j) = b // m, at[b // m, b % m]
        x, y, yaw = poses[k, b % m]
        x = (columns[k] + 0.5) * cell + truth.origin[0] - x
        y = ((rows[k] + 0.5) * cell + truth.origin[1] - y)[:, None]
        c, s = math.cos(yaw + math.pi / 4), math.sin(yaw + math.pi / 4)
        left, right = c * x >= -s * y, s * x >= c * y  # of the lines at -45 and 45 degrees: both are in front
        good = ~label[k]
        if label[k, i, j]:
            good |= depth[k] <= depth[k, i, j] - np.hypot(x, y) / math.sqrt(2)
        good &= x**2 >= spec.straight**2 - y**2
        for sector, within in enumerate((left & right, left & ~right, right & ~left)):
            np.logical_and(good, within, out=fits[b, sector])
        if known[k, b % m]:
            np.logical_and(free[k], left | right, out=sets[0, b])
            sets[:, b, i, j] = True
    reached = _spread(sets[1], sets[0], num_steps)
    is_open = [(fits[b] & reached[b]).any(axis=(1, 2)) for b in range(n * m)]
    return np.reshape(is_open, (n, m, 3)), known


def _crops(
    truth: GroundTruth | Floor, rows: Int[np.ndarray, "n L"], columns: Int[np.ndarray, "n L"]
) -> tuple[Bool[np.ndarray, "n L L"], Bool[np.ndarray, "n L L"], Float[np.ndarray, "n L L"]]:
    """F, dead ends and depth [m] in windows, which may reach beyond the grid."""
    h, w = truth.label.shape
    inside = ((rows >= 0) & (rows < h))[:, :, None] & ((columns >= 0) & (columns < w))[:, None, :]
    index = np.clip(rows, 0, h - 1)[:, :, None] * w + np.clip(columns, 0, w - 1)[:, None, :]
    free = np.where(inside, truth.standable.ravel()[index], truth.outside_is_free)
    label = inside & truth.label.ravel()[index]
    return free, label, np.where(inside, truth.depth.ravel()[index], 0).astype(np.float32)


def _spread(
    starts: Bool[np.ndarray, "64 L L"], free: Bool[np.ndarray, "64 L L"], num_steps: int
) -> Bool[np.ndarray, "64 L L"]:
    """64 sets of cells after some steps through what is free for each; the grid's edge must not be."""
    width = free.shape[2]
    now, may = (
        np.ascontiguousarray(np.packbits(s.reshape(64, -1), axis=0).T).view(np.uint64)[:, 0] for s in (starts, free)
    )

    def grown(cells: np.ndarray, by: int) -> np.ndarray:
        out = cells.copy()
        out[by:] |= cells[:-by]
        out[:-by] |= cells[by:]
        out &= may
        return out

    diagonals = np.floor(np.arange(num_steps + 1) * (math.sqrt(2) - 1))
    for is_diagonal in np.diff(diagonals) > 0:
        along, across = grown(now, 1), grown(now, width)
        if is_diagonal:  # around a corner only by way of a cell beside it
            along, across = grown(along, width), grown(across, 1)
        now = along
        now |= across
    words = np.ascontiguousarray(now[:, None].view(np.uint8).T)
    return np.unpackbits(words, axis=0).reshape(free.shape).view(bool)
