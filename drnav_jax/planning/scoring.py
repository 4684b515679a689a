"""One kernel that rolls out and scores thousands of candidates.

Every prefix x_0..x_k of a rollout is a candidate path; its score is the paper's eq. 7-8,

    Score = J_geom + risk_weight * EDE                                                                   (eq. 7, 8)
    J_geom = collision + clearance + smoothness + range bias + progress
      collision   w_c [the rollout meets an obstacle within its horizon]
      clearance   w_o sum_k ((d_soft - d_k) / (d_soft - d_block))_+^2 ds_k
      smoothness  w_y (total turning [rad])
      range bias  w_r (range_min - s_k)_+
      progress    w_p (value-to-go(x_k) + s_k)
    EDE = sum_k exp(-decay s_k) P_dead^foot(x_k) max(ds_k, STANDING_SPEED dt)

and the best prefix represents its candidate: its end is g(theta). With risk_weight = 0 the score is J_geom bit for bit.
`score` says only how good each candidate is; `explain` looks at the few one cares about.

What bounds it. One step of one candidate is one table look-up and some 100 arithmetic operations. The look-up is the
only thing that a CPU does lane by lane; so all layers sit in one word per cell (`costmap`), and positions are counted in
cells. The rest is spent in loads and stores: XLA turns the body of the scan into one small loop over the block for each
array that the scan carries, and their number decides. Hence

- half of it depends on the speed alone (arc length, discount, range bias) or on the turn rate alone (heading): where
  candidates are an outer product, arrays that broadcast, it is done once per speed and per turn rate;
- whatever a step needs of the speeds is a function of the step's number (a target approached at a limited rate is a
  ramp), of exp(-decay s_k) the factor per step likewise: no exponential and no trigonometry inside;
- a carried array is read by its own update only, or it would be copied first (only c and s are);
- what several updates read is `held`: carried, though the next step ignores it, so that it is computed once;
- no update does more arithmetic than it moves bytes, or XLA splits it among threads, at more than its own cost;
- at which step a score was best only `explain` asks;
- blocks of candidates stay in the second-level cache, so memory is flat in K.

One program runs on one thread of a CPU; `score_on_threads` shares the candidates among several.
"""

import functools
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from drnav_jax.grids import greater, lesser
from drnav_jax.planning import costmap
from drnav_jax.planning.dynamics import Motion, approach, rotate
from drnav_jax.planning.exposure import STANDING_SPEED
from drnav_jax.types import GridMap, RobotParams, Scalar

BLOCKED = 1e9  # score of a candidate none of whose prefixes is free
BLOCK_SIZE = {"cpu": 8192}  # candidates worked on at a time; elsewhere all the more
_MANY = 1 << 18

# what becomes of a candidate: it goes on, this step was its last, it has ended, it met an obstacle
_GOING, _LAST, _ENDED, _HIT = 2.0, 1.0, 0.0, -1.0


class ScoreParams(NamedTuple):
    """Weights of J_geom and EDE; all may be swept."""

    collision: Scalar = 0.1  # [] w_c [m]
    clearance: Scalar = 1.0  # [] w_o []
    smoothness: Scalar = 0.1  # [] w_y [m/rad]
    range_bias: Scalar = 0.5  # [] w_r []
    progress: Scalar = 1.0  # [] w_p []
    risk_weight: Scalar = 3.0  # [] lambda of eq. 1 and 7 [m/m]
    decay: Scalar = 0.1  # [] lambda of w_k = exp(-lambda s_k) [1/m]
    range_min: Scalar = 3.0  # [] endpoints nearer than this pay the range bias [m]
    range_least: Scalar = 0.3  # [] shorter prefixes are no candidates [m]
    range_max: Scalar = 5.0  # [] endpoints lie no farther than this [m]
    soft_clearance: Scalar = 0.4  # [] beyond the radius: where the clearance term begins [m]
    margin: Scalar = 0.045  # [] beyond the radius: closer is blocked; more than the tracker's, less than a cell [m]
    curved: Scalar = 2.0  # [] handicap of curved candidates, whose end the tracker does not approach along the curve [m]
    horizon: Scalar = 4.0  # [] H [s]


class Candidates(NamedTuple):
    """K ways to go on: arrays `[K]`, or any that broadcast, such as speeds `[S, 1]` and turn rates `[1, N]` (K = S N)."""

    motion: Motion  # where each begins
    v: Array  # speed it tends to [m/s]
    w: Array  # turn rate it tends to [rad/s]
    turned: Array  # turning already spent to begin there [rad]
    reach: Array  # arc length at which it ends [m]
    bias: Array  # added to its score (hysteresis) [m]

    @property
    def shape(self) -> tuple[int, ...]:
        """Of them all.

        Raises:
            ValueError: If not all arrays have as many axes: nobody could tell rows from columns.
        """
        shapes = [jnp.shape(a) for a in jax.tree.leaves(self)]
        if len({len(shape) for shape in shapes}) > 1:
            raise ValueError(f"all arrays of Candidates need as many axes, such as [S, 1] and [1, N], got {shapes}.")
        return jnp.broadcast_shapes(*shapes)


class Best(NamedTuple):
    """The best prefix of each candidate, looked at; all `[K]`."""

    score: Array  # J_geom + risk_weight EDE; `BLOCKED` if no prefix is free
    step: Array  # int32, how many steps it takes; 0 if no prefix is free
    x: Array  # its end [m]
    y: Array  # [m]
    arc: Array  # its length [m]
    geometric: Array  # J_geom
    exposure: Array  # EDE


class Terms(NamedTuple):
    """What a score is made of; all `[K]`, weighted, they add up to it."""

    collision: Array
    clearance: Array
    smoothness: Array
    range_bias: Array
    progress: Array
    exposure: Array
    bias: Array


class Reader(NamedTuple):
    """How a field is read. The kernel counts x and y from the reader's origin, in the reader's unit."""

    frame: Callable[[Any], tuple[Array, Scalar]]  # field -> origin [m] `[2]`, unit [m]
    locate: Callable[[Any, Array, Array], Any]  # (field, x, y) -> places: arrays like x, of finite numbers
    read: Callable[[Any, Any], tuple[Array, ...]]  # (field, places) -> clearance [m], risk, value [m]


_Each = TypeVar("_Each", Candidates, Best, Terms)


def _frame(field: GridMap) -> tuple[Array, Scalar]:
    return field.origin, field.resolution


def _locate(field: GridMap, x: Array, y: Array) -> Array:
    """The cells at (x, y) [cells], counted row by row; beyond the edge the edge's."""
    h, w = field.values.shape
    col = lesser(greater(x, 0.0), w - 1.0).astype(jnp.int32)
    row = lesser(greater(y, 0.0), h - 1.0).astype(jnp.int32)
    return row * w + col


def _read(field: GridMap, cell: Array) -> tuple[Array, Array, Array]:
    """Clearance [m], risk and value [m] out of packed words."""
    # unsigned: numbers below zero would be counted from the end, at three instructions each
    index = cell.astype(jnp.uint32)
    return costmap.unpack(field.values.reshape(-1).at[index].get(mode="promise_in_bounds"))


PACKED = Reader(_frame, _locate, _read)


def _score_block(
    reader: Reader, field: Any, start: Candidates, params: ScoreParams, robot: RobotParams, block: Array, dt: float,
    num_steps: int, detailed: bool,
) -> tuple[Array, Array, tuple[Array, ...]]:
    """Scores of one block (module docstring), what collisions cost it and, if `detailed`, the best prefixes' details."""
    dv, dw = robot.a_max * dt, robot.alpha_max * dt
    soft = robot.radius + params.soft_clearance
    slope = 1.0 / jnp.maximum(params.soft_clearance - params.margin, 1e-3)
    reach = jnp.minimum(start.reach, params.range_max)
    v0, w0 = start.motion.v, start.motion.w
    origin, unit = reader.frame(field)
    pace = dt / unit
    x0, y0 = (start.motion.x - origin[0]) / unit, (start.motion.y - origin[1]) / unit
    paced, turning = (jnp.broadcast_shapes(*map(jnp.shape, a)) for a in ((v0, start.v), (w0, start.w, start.motion.c)))
    zero = jnp.zeros(start.shape, jnp.float32)
    k = jnp.arange(1, num_steps + 1, dtype=jnp.float32)
    within = k * dt <= params.horizon + 1e-3 * dt  # k dt is rounded
    # exp(-decay v dt) is held to the limits of v: no exponential is evaluated in the loop
    thin0, thin_end = jnp.exp(-params.decay * dt * v0), jnp.exp(-params.decay * dt * start.v)
    gain = jnp.exp(jnp.minimum((params.decay * dt * dv) * k, 80.0))  # finite for any decay
    # beyond the horizon no prefix ends and nothing blocks
    least, blocked_below = jnp.where(within, params.range_least, jnp.inf), jnp.where(within, block, -jnp.inf)

    def step(carry: tuple, now: tuple[Array, ...]) -> tuple[tuple, None]:
        (x, y, c, s), arc, weight, cost, state, best, _, sums, kept = carry
        k, gain, least, blocked_below = now
        v, w = approach(v0, start.v, k * dv), approach(w0, start.w, k * dw)
        twice = w + approach(w0, start.w, (k - 1.0) * dw)
        c, s = rotate(c, s, (0.5 * dt) * twice)  # heading at the middle of the step
        x, y = x + v * pace * c, y + v * pace * s
        place = reader.locate(field, x, y)
        near, risk, value = reader.read(field, place)
        ds = jnp.abs(v) * dt
        arc = arc + ds
        lack = greater((soft - near) * slope, 0.0)
        thin = lesser(greater(thin_end, thin0 / gain), thin0 * gain)
        weight = weight * lesser(thin, 1.0 / thin)
        exposed = weight * risk * greater(ds, STANDING_SPEED * dt)
        paid = (params.clearance * lack * lack + params.progress) * ds + (params.smoothness * dt) * jnp.abs(w)
        cost = cost + (paid + params.risk_weight * exposed)
        after = jnp.where(near < blocked_below, _HIT, jnp.where(arc < reach, _GOING, _LAST))
        state = jnp.where(state == _GOING, after, lesser(state, _ENDED))
        score = cost + params.progress * value + params.range_bias * greater(params.range_min - arc, 0.0)
        score = jnp.where((state >= _LAST) & (arc >= least), score, BLOCKED)
        if detailed:
            sums = (sums[0] + lack * lack * ds, sums[1] + exposed, sums[2] + jnp.abs(w) * dt)
            found = (k, x, y, arc, *sums, value)
            better = (score <= best) & (score < BLOCKED)  # of equal prefixes the longest
            kept = tuple(jnp.where(better, a, b) for a, b in zip(found, kept, strict=True))
        best = lesser(score, best)
        held = (v, w, twice, place, lack)
        return ((x, y, c, s), arc, weight, cost, state, best, held, sums, kept), None

    m = start.motion
    # the scan keeps the heading at mid-step: the first half turn starts from a standing turn rate of zero
    c0, s0 = (jnp.broadcast_to(a, turning) for a in rotate(m.c, m.s, -0.5 * dt * w0))
    x0, y0 = zero + x0, zero + y0
    slow, straight = jnp.zeros(paced, jnp.float32), jnp.zeros(turning, jnp.float32)
    sums, kept = ((zero, zero, zero + start.turned), (zero, x0, y0) + (zero,) * 5) if detailed else ((), ())
    carry = (
        (x0, y0, c0, s0), slow, slow + 1.0, zero + params.smoothness * start.turned,
        zero + jnp.where(reach > 0, _GOING, _ENDED), zero + BLOCKED,
        (slow, straight, straight, reader.locate(field, x0, y0), zero), sums, kept,
    )  # fmt: skip
    carry, _ = jax.lax.scan(step, carry, (k, gain, least, blocked_below))
    *_, state, best, held, _, kept = carry
    # what is held must be a result of the loop, or it is not stored, but computed anew wherever the body uses it
    finite = [a.astype(jnp.float32) > -jnp.inf for a in jax.tree.leaves(held)]
    free = functools.reduce(jnp.logical_and, finite, best < BLOCKED)
    collision = params.collision * (state == _HIT).astype(jnp.float32)
    score = jnp.where(free, best + (collision + start.bias), BLOCKED)
    return score, collision, kept


@partial(jax.jit, static_argnames=("dt", "num_steps", "block_size", "reader"))
def score(
    field: Any,
    candidates: Candidates,
    params: ScoreParams,
    robot: RobotParams,
    *,
    dt: float,
    num_steps: int,
    block_size: int | None = None,
    reader: Reader = PACKED,
) -> Array:
    """Roll out K candidates and score them (module docstring).

    Args:
        field: Packed words (`costmap`) `[H, W]` in the frame of the candidates, or what `reader` reads.
        candidates: K ways to go on. What depends on fewer axes than they have is computed once for all others: an outer
            product of speeds `[S, 1]` and turn rates `[1, N]` takes half the time of a list of as many.
        params: Weights and ranges.
        robot: Radius and limits.
        dt: Step of the rollout [s].
        num_steps: T, steps rolled out; `params.horizon` masks what lies beyond it.
        block_size: Candidates worked on at a time, whole rows of the first axis; None = what suits the device.
        reader: How `field` is read at (x, y): clearance, risk, value. Another one may read other layers.
    """
    size = block_size or BLOCK_SIZE.get(jax.default_backend(), _MANY)
    count, *others = candidates.shape
    rows = max(size // max(math.prod(others), 1), 1)
    block = _block(reader, field, candidates, params, robot)

    def run(part: Candidates) -> Array:
        return _score_block(reader, field, part, params, robot, block, dt, num_steps, detailed=False)[0]

    if count <= rows:
        return run(candidates)
    whole = count // rows * rows
    starts = jnp.arange(0, whole, rows)
    scores = jax.lax.map(lambda start: run(_rows(candidates, start, rows)), starts)
    scores = scores.reshape(whole, *others)
    if whole == count:
        return scores
    return jnp.concatenate([scores, run(_rows(candidates, whole, count - whole))])


def _rows(candidates: Candidates, first: Array | int, num: int) -> Candidates:
    """Those of `num` places along the first axis."""
    count = candidates.shape[0]
    cut = lambda a: jax.lax.dynamic_slice_in_dim(a, first, num) if a.shape[0] == count else a  # noqa: E731
    return jax.tree.map(cut, candidates)


@partial(jax.jit, static_argnames=("num", "dt", "num_steps", "block_size", "reader"))
def _score_some(first: Array, field: Any, candidates: Candidates, *rest: Any, num: int, **static: Any) -> Array:
    """Scores of `num` places along the first axis from the `first` on."""
    return score(field, _rows(candidates, first, num), *rest, **static)


@functools.cache
def _pool(workers: int) -> ThreadPoolExecutor:
    """Threads that are kept: to start two of them takes as long as scoring a thousand candidates."""
    return ThreadPoolExecutor(workers)


def score_on_threads(
    field: Any, candidates: Candidates, params: ScoreParams, robot: RobotParams, *, workers: int = 2, **static: Any
) -> Array:
    """`score`, shared by `workers` threads: for many candidates, and not inside jit. Scores do not depend on `workers`."""
    count = candidates.shape[0]
    num = -(-count // workers)
    starts = [min(k * num, count - num) for k in range(workers)]  # the last may do some again

    def work(first: int) -> Array:
        part = _score_some(jnp.int32(first), field, candidates, params, robot, num=num, **static)
        return jax.block_until_ready(part)

    parts = list(_pool(workers).map(work, starts))
    fresh = [k * num - first for k, first in enumerate(starts)]
    return jnp.concatenate([v[f:] for f, v in zip(fresh, parts, strict=True)])


@partial(jax.jit, static_argnames=("dt", "num_steps", "reader"))
def explain(
    field: Any,
    candidates: Candidates,
    params: ScoreParams,
    robot: RobotParams,
    *,
    dt: float,
    num_steps: int,
    reader: Reader = PACKED,
) -> tuple[Best, Terms]:
    """Where the best prefixes of K (few) candidates end, and the terms of their scores; arguments as in `score`."""
    block = _block(reader, field, candidates, params, robot)
    scores, collision, (steps, x, y, arc, lack, risk, turned, value) = _score_block(
        reader, field, candidates, params, robot, block, dt, num_steps, detailed=True
    )
    origin, unit = reader.frame(field)
    free = scores < BLOCKED
    best = Best(
        score=scores, step=jnp.where(free, steps, 0.0).astype(jnp.int32), x=origin[0] + x * unit, y=origin[1] + y * unit,
        arc=arc, exposure=risk, geometric=jnp.where(free, scores - params.risk_weight * risk, BLOCKED),
    )  # fmt: skip
    terms = Terms(
        collision=collision, clearance=params.clearance * lack, smoothness=params.smoothness * turned,
        range_bias=params.range_bias * jnp.maximum(params.range_min - arc, 0.0),
        progress=params.progress * (value + arc), exposure=params.risk_weight * risk, bias=candidates.bias,
    )  # fmt: skip
    return best, terms


def _block(reader: Reader, field: Any, candidates: Candidates, params: ScoreParams, robot: RobotParams) -> Array:
    """Clearance [m] below which a pose is blocked."""
    origin, unit = reader.frame(field)
    x, y = ((jnp.ravel(a)[:1] - o) / unit for a, o in zip(candidates.motion[:2], origin, strict=True))
    near, _, _ = reader.read(field, reader.locate(field, x, y))
    # a robot that stands closer than the margin may leave: nothing blocks it but coming closer still
    return jnp.minimum(robot.radius + params.margin, near[0] - costmap.CLEARANCE_STEP)


def at(values: _Each, index: Array) -> _Each:
    """Candidates `index` `[n]` (or one, `[]`), counted row by row, of any of the tuples here: arrays of length n (or 1)."""
    shape = jnp.broadcast_shapes(*map(jnp.shape, jax.tree.leaves(values)))
    place = jnp.unravel_index(jnp.atleast_1d(index), shape)
    pick = lambda a: jnp.broadcast_to(a, shape).at[place].get(mode="promise_in_bounds")  # noqa: E731
    return jax.tree.map(pick, values)


def path_of(candidate: Candidates, robot: RobotParams, *, dt: float, num_steps: int) -> Float[Array, "T 2"]:
    """The points [m] that one candidate (arrays of length 1) passes, for pictures and tests."""

    def step(m: Motion, _: None) -> tuple[Motion, Array]:
        v, w = approach(m.v, candidate.v, robot.a_max * dt), approach(m.w, candidate.w, robot.alpha_max * dt)
        c, s = rotate(m.c, m.s, (0.5 * dt) * (m.w + w))
        m = Motion(x=m.x + v * dt * c, y=m.y + v * dt * s, c=c, s=s, v=v, w=w)
        return m, jnp.stack([m.x[0], m.y[0]])

    m = candidate.motion
    c, s = rotate(m.c, m.s, -0.5 * dt * m.w)
    return jax.lax.scan(step, m._replace(c=c, s=s), None, length=num_steps)[1]
