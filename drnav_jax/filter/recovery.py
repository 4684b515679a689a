"""Recovery points: places to go back to, remembered as a fixed-size masked set in odom.

The paper names them (§IV-C, §IV-D) without a rule; the authors' code stores a point wherever a
direction is open, ranked by the number of open directions, merged within 1 m, at most 50.
Here they are read off the belief instead of the classifier's flags:

1. A cell is passable if it is known to be free, reachable and P_dead < p_max. (All that follows is
   on cells of twice the edge, passable where all four are.)
2. A direction is open if all cells up to `open_distance` from c are passable. rank(c) = number of
   open directions that are at least 60 degrees apart: 1 in the end of a dead end, 2 in a corridor,
   3 where a T joins, 6 on open ground.
3. The best cell of each block of the window is a candidate: by clearance, in steps of a cell up to
   1 m, then by rank, then by nearness to the middle of the block.
4. Remembered points and candidates are taken greedily by (rank, last seen); what lies within
   `merge_distance` of a point already taken merges into it. The first M stay.

Points survive the window's moves. They are forgotten after `max_age`, or when their cell, back
inside the window, turns out to be occupied or a dead end.
"""

import dataclasses
import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from drnav_jax import geometry, grids
from drnav_jax.types import GridMap, GridSpec, LocalMap, Scalar

_APART = 6  # open directions count once per 1/6 of a turn
_CLEARANCE = 1.0  # [m] more clearance than this is no better for a candidate


@dataclasses.dataclass(frozen=True)
class RecoverySpec:
    """Sizes of the set and of the search for candidates.

    Attributes:
        grid: The rolling window that candidates are read from.
        capacity: M, points remembered at most.
        num_directions: Directions in which openness is tested, around the circle.
        open_distance: Length of free ground that makes a direction open [m].
        block: Edge of the blocks of the window that give one candidate each [cells].
    """

    grid: GridSpec = GridSpec()
    capacity: int = 50
    num_directions: int = 36
    open_distance: float = 2.5
    block: int = 20

    def __post_init__(self) -> None:
        """Check sizes."""
        if self.capacity < 1:
            raise ValueError(f"capacity must be >= 1 point, got {self.capacity}.")
        if not 8 <= self.num_directions <= 200:
            raise ValueError(f"num_directions must be 8..200, got {self.num_directions}.")
        if self.open_distance <= 0:
            raise ValueError(f"open_distance must be > 0 m, got {self.open_distance}.")
        if self.block < 2 or self.block % 2:
            raise ValueError(f"block must be an even number of cells >= 2, got {self.block}.")


class RecoveryParams(NamedTuple):
    """What counts as a recovery point, and for how long."""

    p_max: Scalar = 0.5  # [] cells with P_dead at or above this are not passable
    min_rank: Scalar = 2.0  # [] fewer open directions make no candidate
    merge_distance: Scalar = 1.0  # [] points nearer than this are one [m]
    max_age: Scalar = 300.0  # [] a point not seen for longer is forgotten [s]


class RecoveryPoints(NamedTuple):
    """The set; valid points come first, best rank first."""

    xy: Array  # [M, 2] position in odom [m]
    rank: Array  # [M] number of open directions, 1..6
    last_seen: Array  # [M] time of the last sighting [s]
    valid: Array  # [M] bool


def init(spec: RecoverySpec) -> RecoveryPoints:
    """The empty set."""
    m = spec.capacity
    return RecoveryPoints(
        xy=jnp.zeros((m, 2), jnp.float32),
        rank=jnp.zeros(m, jnp.float32),
        last_seen=jnp.zeros(m, jnp.float32),
        valid=jnp.zeros(m, bool),
    )


def openness(passable: Bool[Array, "h w"], num_directions: int, reach: int) -> Float[Array, "h w"]:
    """Number of open directions, no two of them closer than 60 degrees.

    They are taken counter-clockwise, beginning at +x, so a wide opening counts by its width and a
    narrow one once.

    Args:
        passable: Cells one may drive on; beyond the edge nothing is.
        num_directions: Static number of directions that are tested, the first along +x.
        reach: Static length of the rays [cells].
    """
    h, w = passable.shape
    padded = jnp.pad(passable, reach)
    angle = 2 * np.pi * np.arange(num_directions)[:, None] / num_directions
    along = np.arange(reach + 1)[None, :]
    rows = jnp.asarray(np.round(along * np.sin(angle)) + reach, jnp.int32)
    cols = jnp.asarray(np.round(along * np.cos(angle)) + reach, jnp.int32)
    gap = jnp.uint8(-(-num_directions // _APART))
    one = jnp.uint8(1)

    def add(carry: tuple, ray: tuple) -> tuple[tuple, None]:
        count, since, first = carry
        i, j, d = ray
        is_open = passable
        for k in range(1, reach + 1):
            is_open &= jax.lax.dynamic_slice(padded, (i[k], j[k]), (h, w))
        taken = is_open & (since >= gap)
        first = jnp.where(taken & (count == 0), d, first)
        return (count + taken.astype(jnp.uint8), jnp.where(taken, one, since + one), first), None

    # One program for all directions: unrolled, XLA stops vectorising it.
    blank = jnp.zeros((h, w), jnp.uint8)
    directions = jnp.arange(num_directions, dtype=jnp.uint8)
    start = (blank, blank + gap, blank)
    (count, since, first), _ = jax.lax.scan(add, start, (rows, cols, directions))
    twice = (count > 1) & (since + first < gap)  # the last one taken is too near to the first
    return (count - twice.astype(jnp.uint8)).astype(jnp.float32)


def candidates(
    spec: RecoverySpec,
    params: RecoveryParams,
    local_map: LocalMap,
    p_dead: Float[Array, "H W"],
    reachable: Bool[Array, "H W"],
) -> tuple[Float[Array, "C 2"], Float[Array, " C"], Bool[Array, " C"]]:
    """The best place of each block of the window (steps 1-3 of the module docstring).

    Args:
        spec: Sizes.
        params: Thresholds.
        local_map: Occupancy belief.
        p_dead: Dead-end probability.
        reachable: Cells that the robot can reach from where it is.

    Returns:
        Position in odom [m], rank and validity of each candidate.
    """
    h, w = spec.grid.shape
    edge = 2 * spec.grid.resolution
    known_free = local_map.seen & (local_map.occupancy < 0)
    passable = known_free & reachable & (p_dead < params.p_max)
    passable = grids.once(grids.pool(passable, 2, "all"))
    rank = openness(passable, spec.num_directions, math.ceil(spec.open_distance / edge - 1e-6))
    clearance = jnp.floor(grids.distance_transform(~passable, edge, _CLEARANCE) / edge + 1e-3)
    score = clearance * (_APART + 1.0) + rank
    score = jnp.where(passable & (rank >= params.min_rank), score, -1.0)

    n = spec.block // 2
    score = jnp.pad(score, ((0, -(h // 2) % n), (0, -(w // 2) % n)), constant_values=-1.0)
    rows, cols = score.shape[0] // n, score.shape[1] // n
    blocks = score.reshape(rows, n, cols, n).transpose(0, 2, 1, 3).reshape(rows * cols, n * n)
    value = jnp.max(blocks, axis=1)
    k = np.arange(n) - (n - 1) / 2
    central = jnp.asarray(2.0 * n - np.hypot(*np.meshgrid(k, k)).ravel(), jnp.float32)
    central = jnp.where(blocks == value[:, None], central[None, :], 0.0)
    best = jnp.argmax(central, axis=1).astype(jnp.int32)
    block = jnp.arange(rows * cols, dtype=jnp.int32)
    row, col = block // cols * n + best // n, block % cols * n + best % n
    centre = (jnp.stack([col, row], axis=-1).astype(jnp.float32) + 0.5) * edge
    xy = local_map.origin[None, :] + centre
    return xy, jnp.mod(value, _APART + 1.0), value >= 0


def merge(
    params: RecoveryParams,
    points: RecoveryPoints,
    xy: Float[Array, "C 2"],
    rank: Float[Array, " C"],
    valid: Bool[Array, " C"],
    time: Scalar,
) -> RecoveryPoints:
    """Fold candidates seen now into the set (step 4 of the module docstring).

    Of points within `merge_distance` the one of highest rank stays, on a tie the remembered one;
    it takes over the latest sighting. When full, the lowest ranks go, and among those the oldest.
    """
    now = jnp.asarray(time, jnp.float32)
    reach = jnp.square(params.merge_distance)
    apart = _squared(points.xy, xy)
    again = jnp.any((apart < reach) & valid[None, :], axis=1)
    last_seen = jnp.where(again & points.valid, now, points.last_seen)

    xy = jnp.concatenate([points.xy, xy])
    rank = jnp.concatenate([points.rank, rank])
    last_seen = jnp.concatenate([last_seen, jnp.broadcast_to(now, valid.shape)])
    valid = jnp.concatenate([points.valid, valid]) & (now - last_seen <= params.max_age)
    # Most significant key last; ties keep their order, and the remembered points come first.
    order = jnp.lexsort((-last_seen, -rank, ~valid))
    xy, rank, last_seen, valid = xy[order], rank[order], last_seen[order], valid[order]

    apart = _squared(xy, xy)
    near = (apart < reach) & valid[None, :] & valid[:, None]
    better = jnp.tril(near, -1)
    taken = _greedy(better) & valid
    index = jnp.argsort(~taken, stable=True)[: points.valid.shape[0]]
    sighted = jnp.max(jnp.where(near, last_seen[None, :], last_seen[:, None]), axis=1)
    kept = taken[index]
    return RecoveryPoints(
        xy=jnp.where(kept[:, None], xy[index], 0.0),
        rank=jnp.where(kept, rank[index], 0.0),
        last_seen=jnp.where(kept, sighted[index], 0.0),
        valid=kept,
    )


def _squared(a: Float[Array, "M 2"], b: Float[Array, "C 2"]) -> Float[Array, "M C"]:
    """Squared distances between points (coordinate by coordinate: summing over an axis of two is slow)."""
    return jnp.square(a[:, :1] - b[None, :, 0]) + jnp.square(a[:, 1:] - b[None, :, 1])


def _greedy(better: Bool[Array, "N N"]) -> Bool[Array, " N"]:
    """Items taken in order when each one taken excludes those it is better than.

    `better[i, j]`: j comes before i and excludes it. Each sweep settles one more link of every
    chain, so this ends after the longest chain, not after N steps.
    """

    def sweep(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        before, _ = carry
        after = ~jnp.any(better & before[None, :], axis=1)
        return after, jnp.any(after != before)

    start = jnp.ones(better.shape[0], bool), jnp.asarray(True)
    return jax.lax.while_loop(lambda carry: carry[1], sweep, start)[0]


@partial(jax.jit, static_argnames="spec")
def observe(
    spec: RecoverySpec,
    params: RecoveryParams,
    points: RecoveryPoints,
    local_map: LocalMap,
    p_dead: Float[Array, "H W"],
    reachable: Bool[Array, "H W"],
    time: Scalar,
) -> RecoveryPoints:
    """Update the set from the belief; meant for about 2 Hz.

    Args:
        spec: Sizes.
        params: Thresholds.
        points: The set so far.
        local_map: Occupancy belief on the window.
        p_dead: Dead-end probability on the window.
        reachable: Cells that the robot can reach from where it is, with its radius.
        time: Now [s], on the clock of `last_seen`.
    """
    bad = (local_map.seen & (local_map.occupancy > 0)) | (p_dead >= params.p_max)
    grid = GridMap(values=bad, origin=local_map.origin, resolution=spec.grid.resolution)
    dropped = jax.vmap(lambda xy: geometry.sample_nearest(grid, xy, fill=0.0))(points.xy)
    points = points._replace(valid=points.valid & ~dropped)
    xy, rank, valid = candidates(spec, params, local_map, p_dead, reachable)
    return merge(params, points, xy, rank, valid, time)
