"""The short-horizon goal generator (paper, section IV-D, eq. 7-9).

All admissible controls theta = (v, omega) are rolled out over H from the robot's speed, and beside them a family of
straight headings in all directions; each is scored by `scoring`, and g* is the end of the best (eq. 9). The last g* and
the goal are headings of their own, so a choice is kept unless something is better by the hysteresis.
"""

import dataclasses
import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drnav_jax import geometry, grids
from drnav_jax.planning import dynamics, scoring
from drnav_jax.planning.dynamics import Motion
from drnav_jax.planning.scoring import BLOCKED, Candidates, ScoreParams, Terms
from drnav_jax.types import GridMap, RobotParams, Scalar


@dataclasses.dataclass(frozen=True)
class GeneratorSpec:
    """How many candidates, and how they are rolled out.

    Attributes:
        num_speeds: Levels of v among the controls; 0 leaves the controls out.
        num_turns: Levels of omega among the controls.
        num_headings: Straight headings (two of them point to the last g* and to the goal).
        dt: Step of the rollout [s].
        num_steps: Steps rolled out; `ScoreParams.horizon` may use fewer.
        num_explained: Best candidates whose terms are in Info; all, if there are fewer.
    """

    num_speeds: int = 16
    num_turns: int = 240
    num_headings: int = 256
    dt: float = 0.1
    num_steps: int = 40
    num_explained: int = 10

    def __post_init__(self) -> None:
        """Check counts."""
        if min(self.num_speeds, self.num_turns) < 0 or self.num_headings < 3:
            raise ValueError(
                "num_speeds and num_turns must be >= 0 and num_headings >= 3, "
                f"got {self.num_speeds}, {self.num_turns}, {self.num_headings}."
            )
        if self.dt <= 0 or self.num_steps < 1 or self.num_explained < 1:
            raise ValueError(
                "dt must be > 0 s, num_steps and num_explained >= 1, "
                f"got {self.dt}, {self.num_steps} and {self.num_explained}."
            )

    @property
    def num_candidates(self) -> int:
        """K, all candidates together."""
        return self.num_speeds * self.num_turns + self.num_headings


class LocalGoal(NamedTuple):
    """The generator's choice and why."""

    xy: Float[Array, "2"]  # g* in odom [m]
    valid: Bool[Array, ""]  # False: every candidate is blocked, g* is the robot's own place
    score: Float[Array, ""]  # Score(g*)
    exposure: Float[Array, ""]  # EDE of the chosen path
    geometric: Float[Array, ""]  # J_geom of the chosen path
    terms: Terms  # weighted terms of the chosen score, [1] each
    index: Array  # [] int32, which candidate
    best: Terms  # of the best candidates, [n] each, the best (which is the chosen) first
    best_score: Float[Array, " n"]  # `BLOCKED` where fewer are free


def candidates(
    spec: GeneratorSpec,
    params: ScoreParams,
    robot: RobotParams,
    pose: Float[Array, "3"],
    twist: Float[Array, "2"],
    goal: Float[Array, "2"],
    last: Float[Array, "2"],
    hysteresis: Scalar,
) -> tuple[Candidates, Candidates]:
    """Speeds `[num_speeds, 1]` by turn rates `[1, num_turns]`; headings `[num_headings]`, last g* and goal at the end."""
    fan = spec.num_headings - 2
    share = (jnp.arange(spec.num_speeds, dtype=jnp.float32) + 1.0) / max(spec.num_speeds, 1)
    turn = jnp.linspace(-1.0, 1.0, max(spec.num_turns, 1), dtype=jnp.float32)[: spec.num_turns]
    targets = jnp.stack([last, goal]) - pose[None, :2]
    yaw = jnp.concatenate(
        [jnp.arange(fan, dtype=jnp.float32) * (2 * jnp.pi / fan), jnp.arctan2(targets[:, 1], targets[:, 0])]
    )
    span = jnp.sqrt(jnp.sum(targets * targets, axis=-1))
    reach = jnp.concatenate([jnp.full(fan, jnp.float32(1.0)) * params.range_max, span])
    # a heading is a ray: it is walked at the pace that covers range_max within the horizon, though in no longer steps than
    # see any wall: what would hit lies within the radius and the margin of both its sides
    widest = 1.5 * (robot.radius + params.margin) / spec.dt
    ends = jnp.where(jnp.arange(spec.num_headings) < fan, params.range_max, jnp.minimum(reach, params.range_max))
    pace = jnp.minimum(ends / params.horizon, widest)
    # near the last g* there is nothing left to hold on to, or the robot would settle there
    held = hysteresis * jnp.square(jnp.clip(span[0] / params.range_min, 0.0, 1.0))
    one, none = jnp.zeros((1, 1), jnp.float32), jnp.zeros(spec.num_headings, jnp.float32)
    controls = Candidates(
        motion=jax.tree.map(lambda a: a[None], dynamics.start(pose, twist, 1)),
        v=(share * robot.v_max)[:, None], w=(turn * robot.w_max)[None],
        turned=one, reach=one + params.range_max, bias=one + params.curved,
    )  # fmt: skip
    rays = Motion(x=none + pose[0], y=none + pose[1], c=jnp.cos(yaw), s=jnp.sin(yaw), v=pace, w=none)
    turned = jnp.abs(geometry.wrap_angle(yaw - pose[2]))
    return controls, Candidates(rays, v=pace, w=none, turned=turned, reach=reach, bias=none.at[fan].set(-held))


def at(ways: tuple[Candidates, Candidates], index: Array) -> Candidates:
    """Candidates `index` `[n]` (or one, `[]`), counted over the controls, row by row, then over the headings."""
    controls, headings = ways
    count, index = math.prod(controls.shape), jnp.atleast_1d(index)
    rays = scoring.at(headings, jnp.maximum(index - count, 0))
    if not count:
        return rays
    arcs = scoring.at(controls, jnp.minimum(index, count - 1))
    return jax.tree.map(lambda a, b: jnp.where(index < count, a, b), arcs, rays)


def given(spec: GeneratorSpec, xy: Float[Array, "2"]) -> LocalGoal:
    """A local goal that nobody generated: planners without a generator track the mission's goal itself."""
    zero, none = jnp.zeros((), jnp.float32), jnp.zeros(min(spec.num_explained, spec.num_candidates), jnp.float32)
    return LocalGoal(
        xy=xy, valid=jnp.asarray(True), score=zero, exposure=zero, geometric=zero,
        terms=Terms(*[zero[None]] * len(Terms._fields)), index=jnp.asarray(-1, jnp.int32),
        best=Terms(*[none] * len(Terms._fields)), best_score=none + BLOCKED,
    )  # fmt: skip


@partial(jax.jit, static_argnames="spec")
def generate(
    spec: GeneratorSpec,
    params: ScoreParams,
    robot: RobotParams,
    field: GridMap,
    pose: Float[Array, "3"],
    twist: Float[Array, "2"],
    goal: Float[Array, "2"],
    last: Float[Array, "2"],
    hysteresis: Float[Array, ""],
) -> LocalGoal:
    """Choose g* (eq. 9).

    Args:
        spec: Candidates.
        params: Weights.
        robot: Radius and limits.
        field: Packed words (`costmap`) in odom.
        pose: Robot in odom.
        twist: Its speeds.
        goal: The mission's goal in odom [m].
        last: The last g* [m].
        hysteresis: Advantage of the last g* [m].
    """
    ways = candidates(spec, params, robot, pose, twist, goal, last, hysteresis)
    how = {"dt": spec.dt, "num_steps": spec.num_steps}
    scores = [jnp.ravel(scoring.score(field, part, params, robot, **how)) for part in ways]
    # what is looked at of one costs as much as of ten
    _, order = grids.least(jnp.concatenate(scores), min(spec.num_explained, spec.num_candidates))
    best, terms = scoring.explain(field, at(ways, order), params, robot, **how)
    valid = best.score[0] < BLOCKED
    return LocalGoal(
        xy=jnp.where(valid, jnp.stack([best.x[0], best.y[0]]), pose[:2]),
        valid=valid, score=best.score[0], exposure=best.exposure[0], geometric=best.geometric[0],
        terms=jax.tree.map(lambda a: a[:1], terms), index=order[0].astype(jnp.int32), best=terms, best_score=best.score,
    )  # fmt: skip
