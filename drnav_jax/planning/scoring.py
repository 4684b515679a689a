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

What bounds it: one gather per candidate and step. So all layers sit in one word per cell (`costmap`), state is a
structure of `[K]` arrays carried by a scan, no trigonometry is evaluated inside, and candidates are worked on in blocks
that stay in the cache, so memory is flat in K.
"""

from collections.abc import Callable
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
    margin: Scalar = 0.05  # [] beyond the radius: closer counts as blocked [m]
    curved: Scalar = 2.0  # [] handicap of curved candidates, whose end the tracker does not approach along the curve [m]
    horizon: Scalar = 4.0  # [] H [s]


class Candidates(NamedTuple):
    """K ways to go on; all `[K]`."""

    motion: Motion  # where each begins
    v: Array  # speed it tends to [m/s]
    w: Array  # turn rate it tends to [rad/s]
    turned: Array  # turning already spent to begin there [rad]
    reach: Array  # arc length at which it ends [m]
    bias: Array  # added to its score (hysteresis) [m]


class Scores(NamedTuple):
    """The best prefix of each candidate; all `[K]`."""

    score: Array  # J_geom + risk_weight EDE; `BLOCKED` if no prefix is free
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


_Each = TypeVar("_Each", Candidates, Scores, Terms)
Reader = Callable[[Array, Array], tuple[Array, Array, Array]]  # (x, y) -> clearance, risk, value


def look_up(field: GridMap, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Clearance [m], risk and value [m] of the cells under (x, y), out of packed words; beyond the edge the edge's."""
    h, w = field.values.shape
    inv = 1.0 / field.resolution
    col = lesser(greater((x - field.origin[0]) * inv, 0.0), w - 1.0).astype(jnp.int32)
    row = lesser(greater((y - field.origin[1]) * inv, 0.0), h - 1.0).astype(jnp.int32)
    return costmap.unpack(field.values.reshape(-1).at[row * w + col].get(mode="promise_in_bounds"))


def _score_block(
    read: Reader, start: Candidates, params: ScoreParams, robot: RobotParams, block: Array, dt: float, num_steps: int
) -> tuple[Scores, Terms]:
    """Scores of the candidates of one block (module docstring)."""
    dv, dw = robot.a_max * dt, robot.alpha_max * dt
    soft = robot.radius + params.soft_clearance
    slope = 1.0 / jnp.maximum(params.soft_clearance - params.margin, 1e-3)
    reach = jnp.minimum(start.reach, params.range_max)
    horizon = params.horizon + 1e-3 * dt  # k dt is rounded
    zero = jnp.zeros_like(start.v)

    def step(carry: tuple, k: Array) -> tuple[tuple, None]:
        m, arc, cost, risk_sum, turned, alive, hit, best = carry
        v, w = approach(m.v, start.v, dv), approach(m.w, start.w, dw)
        c, s = rotate(m.c, m.s, (0.5 * dt) * (m.w + w))  # heading at the middle of the step
        ds = jnp.abs(v) * dt
        m = Motion(x=m.x + v * dt * c, y=m.y + v * dt * s, c=c, s=s, v=v, w=w)
        near, risk, value = read(m.x, m.y)
        going = alive & (arc < reach) & (k * dt <= horizon)
        alive = going & (near >= block)
        hit = hit | (going & (near < block))
        arc = arc + ds
        lack = greater((soft - near) * slope, 0.0)
        cost = cost + lack * lack * ds
        risk_sum = risk_sum + jnp.exp(-params.decay * arc) * risk * greater(ds, STANDING_SPEED * dt)
        turned = turned + jnp.abs(w) * dt
        geometric = (
            params.progress * (value + arc)
            + params.clearance * cost
            + params.smoothness * turned
            + params.range_bias * greater(params.range_min - arc, 0.0)
        )
        score = geometric + params.risk_weight * risk_sum
        better = alive & (score < best[0]) & (arc >= params.range_least)
        now = (score, m.x, m.y, arc, geometric, risk_sum, cost, turned, value)
        best = tuple(jnp.where(better, a, b) for a, b in zip(now, best, strict=True))
        return (m, arc, cost, risk_sum, turned, alive, hit, best), None

    m = start.motion
    # the scan keeps the heading at mid-step: the first half turn starts from a standing turn rate of zero
    half = -0.5 * dt * m.w
    c0, s0 = rotate(m.c, m.s, half)
    m = m._replace(c=c0, s=s0)
    best = (jnp.full_like(zero, BLOCKED), m.x, m.y, zero, jnp.full_like(zero, BLOCKED), zero, zero, zero, zero)
    alive = jnp.ones_like(start.v, dtype=bool)
    carry = (m, zero, zero, zero, start.turned, alive, ~alive, best)
    steps = jnp.arange(1, num_steps + 1, dtype=jnp.float32)
    (_, _, _, _, _, _, hit, best), _ = jax.lax.scan(step, carry, steps)
    score, x, y, arc, geometric, risk_sum, cost, turned, value = best
    free = score < BLOCKED
    collision = params.collision * hit.astype(jnp.float32)
    extra = collision + start.bias
    scores = Scores(
        score=jnp.where(free, score + extra, BLOCKED), x=x, y=y, arc=arc,
        geometric=jnp.where(free, geometric + extra, BLOCKED), exposure=risk_sum,
    )  # fmt: skip
    terms = Terms(
        collision=collision, clearance=params.clearance * cost, smoothness=params.smoothness * turned,
        range_bias=params.range_bias * jnp.maximum(params.range_min - arc, 0.0),
        progress=params.progress * (value + arc), exposure=params.risk_weight * risk_sum, bias=start.bias,
    )  # fmt: skip
    return scores, terms


@partial(jax.jit, static_argnames=("dt", "num_steps", "block_size", "reader"))
def score(
    field: Any,
    candidates: Candidates,
    params: ScoreParams,
    robot: RobotParams,
    *,
    dt: float,
    num_steps: int,
    block_size: int = 8192,
    reader: Callable[[Any, Array, Array], tuple[Array, Array, Array]] = look_up,
) -> Scores:
    """Roll out K candidates and score them (module docstring).

    Args:
        field: Packed words (`costmap`) `[H, W]` in the frame of the candidates, or what `reader` reads.
        candidates: K ways to go on.
        params: Weights and ranges.
        robot: Radius and limits.
        dt: Step of the rollout [s].
        num_steps: T, steps rolled out; `params.horizon` masks what lies beyond it.
        block_size: Candidates worked on at a time.
        reader: How `field` is read at (x, y): clearance, risk, value. Another one may read other layers.
    """
    return _blocks(partial(reader, field), candidates, params, robot, dt, num_steps, block_size)[0]


@partial(jax.jit, static_argnames=("dt", "num_steps"))
def explain(
    field: GridMap, candidates: Candidates, params: ScoreParams, robot: RobotParams, *, dt: float, num_steps: int
) -> Terms:
    """The terms of the scores of K (few) candidates; arguments as in `score`."""
    return _blocks(partial(look_up, field), candidates, params, robot, dt, num_steps, candidates.v.shape[0])[1]


def _blocks(
    read: Reader, candidates: Candidates, params: ScoreParams, robot: RobotParams, dt: float, num: int, size: int
) -> tuple[Scores, Terms]:
    count = candidates.v.shape[0]
    # a robot that stands closer than the margin may leave: nothing blocks it but coming closer still
    near, _, _ = read(candidates.motion.x[:1], candidates.motion.y[:1])
    block = jnp.minimum(robot.radius + params.margin, near[0] - costmap.CLEARANCE_STEP)

    def run(part: Candidates) -> tuple[Scores, Terms]:
        return _score_block(read, part, params, robot, block, dt, num)

    if count <= size or count % size:
        return run(candidates)
    parts = jax.tree.map(lambda a: a.reshape(-1, size), candidates)
    return jax.tree.map(lambda a: a.reshape(-1), jax.lax.map(run, parts))


def at(values: _Each, index: Array) -> _Each:
    """Candidate `index` of any of the tuples here, as arrays of length 1."""
    return jax.tree.map(lambda a: jax.lax.dynamic_slice_in_dim(a, index, 1), values)


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
