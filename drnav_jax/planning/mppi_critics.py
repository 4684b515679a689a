"""Nav2's MPPI critics, and EDE as one more: each adds (w term)^power to the cost of a trajectory.

With L the length of the path ahead, n its points, F the furthest path point that is nearest to the end of any trajectory:

    Constraint        sum_t dt [(v - v_max)_+ + (v_min - v)_+]
    Cost              every 2nd point: 0 where the costmap is < 1, 300 at >= 253, else the costmap unless L < near_goal; 1e6
                      if a point collides (254; 253 for a disc; 255, also off the map, unless unknown space is tracked);
                      w / 254 of the sum over the number of points
    Obstacles         20 raw + 1.5 rep, d = (ln 253 - ln c) / s for a disc, raw = sum_t (margin - d)_+ or 1e5 on collision,
                      rep = (sum_t (R - d) - the least of the batch) / T unless L < near_goal; where the costmap is >= 1
    Goal              mean_t distance to the last path point, if L <= 1.4
    GoalAngle         mean_t |yaw - goal yaw|, if L <= 0.5
    PathAlign         if L >= 0.5, F >= 20, and <= 5 % or <= 2 of the points before F are blocked: every 4th point, distance
                      to the path point (of the first n - 1) at equal arc length; mean over those that are not blocked
    PathFollow        if L >= 1.4: distance from the end to path[min(F + 5, n - 1)], moved past blocked points
    PathAngle         if L >= 0.5 and |robot -> path[F + 4]| >= 1 rad: |yaw - bearing of that point| at the end
    PreferForward     sum_t dt (-v)_+, if L >= 0.5
    Twirling          mean_t |omega|, off within the goal's tolerance
    VelocityDeadband  sum_t dt [(deadband_v - |v|)_+ + (deadband_w - |omega|)_+]
    Exposure          sum_t exp(-decay s_t) P_dead^foot(x_t) max(ds_t, STANDING_SPEED dt)                    (`exposure`)

Numbers are those of Nav2's bringup, all of them Params. Costmap and P_dead^foot share one word per cell, so there is one
look-up per point however many critics read it. A critic that is off costs nothing but its steps.
"""

import functools
import math
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drnav_jax import geometry
from drnav_jax.planning import mppi_path_critics as along
from drnav_jax.planning.costmap import InflationParams
from drnav_jax.planning.dynamics import Motion, greater, lesser
from drnav_jax.planning.exposure import STANDING_SPEED
from drnav_jax.planning.mppi_critic_params import CriticParams, CriticSpec, Weight
from drnav_jax.planning.mppi_path_critics import Ahead
from drnav_jax.planning.mppi_rollout import Cost, Limits, Priced
from drnav_jax.planning.path import Path, end
from drnav_jax.types import GridMap, Scalar

LETHAL, INSCRIBED, UNKNOWN = 254.0, 253.0, 255.0
RISK_STEP = 1.0 / 65535.0
_LOG_INSCRIBED = math.log(INSCRIBED)
_HIT = 1e9  # added to a sum by a collision: far above what any trajectory adds up to


class Scene(NamedTuple):
    """What the critics look at; from `look`."""

    params: CriticParams
    limits: Limits
    inflation: InflationParams
    words: GridMap  # [H, W] int32 of `pack`
    ahead: Ahead  # the path
    pose: Array  # [3] robot
    goal_yaw: Array  # [] [rad]
    at_goal: Array  # [] bool, within the goal's tolerance


def pack(cost: Float[Array, "H W"], risk: Float[Array, "H W"]) -> Int[Array, "H W"]:
    """One word per cell: costmap 0..255 in bits 0-7, P_dead^foot above the prior in steps of 1/65535 in bits 8-23."""
    share = jnp.round(jnp.clip(risk, 0.0, 1.0) * (1.0 / RISK_STEP)).astype(jnp.int32)
    return (share << 8) | jnp.clip(cost, 0.0, 255.0).astype(jnp.int32)


def read(words: GridMap, x: Float[Array, " K"], y: Float[Array, " K"]) -> tuple[Array, Array]:
    """Costmap and risk of the cells under (x, y); off the map it is unknown, without risk."""
    h, w = words.values.shape
    inv = 1.0 / words.resolution
    fx, fy = (x - words.origin[0]) * inv, (y - words.origin[1]) * inv
    col = lesser(greater(fx, 0.0), w - 1.0).astype(jnp.int32)
    row = lesser(greater(fy, 0.0), h - 1.0).astype(jnp.int32)
    word = words.values.reshape(-1).at[row * w + col].get(mode="promise_in_bounds")
    on = (fx >= 0.0) & (fy >= 0.0) & (fx < w) & (fy < h)
    cost = jnp.where(on, (word & 255).astype(jnp.float32), UNKNOWN)
    return cost, jnp.where(on, (word >> 8).astype(jnp.float32) * RISK_STEP, 0.0)


def collides(spec: CriticSpec, cost: Float[Array, " K"]) -> Bool[Array, " K"]:
    """Whether a robot whose centre stands on such cells collides."""
    hit = (cost == LETHAL) | ((cost == INSCRIBED) & spec.circular)
    return hit if spec.track_unknown else hit | (cost == UNKNOWN)


def look(
    spec: CriticSpec,
    params: CriticParams,
    limits: Limits,
    inflation: InflationParams,
    words: GridMap,
    path: Path,
    pose: Float[Array, "3"],
    goal_yaw: Scalar,
    goal_tolerance: Scalar,
) -> Scene:
    """Prepare what the critics look at.

    Args:
        spec: Which critics.
        params: Their numbers.
        limits: Of the robot.
        inflation: With which the costmap was made (Obstacles turns costs back into distances).
        words: Costmap and risk, from `pack`.
        path: What lies ahead of the robot (`path.ahead`).
        pose: Robot, in the frame of the map.
        goal_yaw: Yaw wanted at the end of the path [rad].
        goal_tolerance: Nearer than this to the end of the path the robot is there [m].
    """
    cost, _ = read(words, path.x, path.y)
    goal = end(path)
    near = jnp.square(goal[0] - pose[0]) + jnp.square(goal[1] - pose[1]) < jnp.square(goal_tolerance)
    return Scene(
        params=params, limits=limits, inflation=inflation, words=words, ahead=along.look(path, collides(spec, cost)),
        pose=pose, goal_yaw=jnp.asarray(goal_yaw, jnp.float32), at_goal=near,
    )  # fmt: skip


@functools.cache
def nav2(spec: CriticSpec, num_steps: int, dt: float) -> Cost:
    """The cost that the critics add up to; its data is a `Scene`.

    Args:
        spec: Which critics.
        num_steps: T of the rollouts.
        dt: Their step [s].
    """
    used = frozenset(spec.critics)
    looked_at = (num_steps - 1) // spec.cost_every + 1

    def step(scene: Scene, sums: dict, m: Motion, t: Array) -> dict:
        """Add one point to the sums of all critics but PathAlign."""
        new, params, limits = dict(sums), scene.params, scene.limits

        def add(name: str, amount: Array) -> None:
            new[name] = sums[name] + amount

        if "Constraint" in used:
            add("Constraint", dt * (greater(m.v - limits.v_max, 0.0) + greater(limits.v_min - m.v, 0.0)))
        if "PreferForward" in used:
            add("PreferForward", dt * greater(-m.v, 0.0))
        if "Twirling" in used:
            add("Twirling", jnp.abs(m.w))
        if "VelocityDeadband" in used:
            band = params.deadband
            add("VelocityDeadband", dt * (greater(band.v - jnp.abs(m.v), 0.0) + greater(band.w - jnp.abs(m.w), 0.0)))
        if "Goal" in used:
            goal = end(scene.ahead.path)
            add("Goal", jnp.sqrt(jnp.square(m.x - goal[0]) + jnp.square(m.y - goal[1])))
        if "GoalAngle" in used:
            add("yaw", dt * m.w)
            add("GoalAngle", jnp.abs(geometry.wrap_angle(new["yaw"] - scene.goal_yaw)))
        cost = risk = hit = jnp.zeros(())
        if used & {"Cost", "Obstacles", "Exposure"}:
            cost, risk = read(scene.words, m.x, m.y)
            hit = collides(spec, cost)
        if "Cost" in used:
            plain = jnp.where(scene.ahead.length < params.cost.near_goal, 0.0, cost)
            price = jnp.where(cost >= INSCRIBED, params.cost.critical, jnp.where(cost < 1.0, 0.0, plain))
            looked = (t % spec.cost_every == 0).astype(jnp.float32)
            add("Cost", looked * jnp.where(hit, _HIT, price))
        if "Obstacles" in used:
            near = cost >= 1.0
            away = (_LOG_INSCRIBED - jnp.log(greater(cost, 1.0))) / scene.inflation.scaling
            raw = jnp.where(near, greater(params.obstacles.margin - away, 0.0), 0.0)
            add("raw", jnp.where(hit, _HIT, raw))
            add("repulsion", jnp.where(near & (new["raw"] < _HIT), scene.inflation.radius - away, 0.0))
        if "Exposure" in used:
            ds = jnp.abs(m.v) * dt
            add("arc", ds)
            add("Exposure", jnp.exp(-params.exposure.decay * new["arc"]) * risk * greater(ds, STANDING_SPEED * dt))
        return new

    def begin(scene: Scene, m: Motion) -> dict:
        zero = jnp.zeros_like(m.x)
        sums: dict = {name: zero for name in used - {"PathAlign", "Obstacles"}}
        if "GoalAngle" in used:
            sums["yaw"] = zero + scene.pose[2]
        if "Obstacles" in used:
            sums |= {"raw": zero, "repulsion": zero}
        if "Exposure" in used:
            sums["arc"] = zero
        if "PathAlign" in used:
            sums["PathAlign"] = along.begin_align(m)
        return step(scene, sums, m, jnp.zeros((), jnp.int32))

    def seldom(scene: Scene, sums: dict, m: Motion) -> dict:
        return sums | {"PathAlign": along.step_align(scene.ahead, sums["PathAlign"], m)}

    def finish(scene: Scene, sums: dict, m: Motion) -> Priced:
        params, ahead = scene.params, scene.ahead
        mean = 1.0 / num_steps
        left = ahead.length
        of: Any
        reached: Any = None
        if used & {"PathAlign", "PathFollow", "PathAngle"}:
            reached = along.furthest(ahead.path, m.x, m.y)
        hit = jnp.zeros(m.x.shape, bool)
        terms = []
        for name in spec.critics:
            sum_: Any = sums.get(name)
            if name == "Constraint":
                term, of = sum_, params.constraint
            elif name == "Cost":
                hit = hit | (sum_ >= _HIT)
                term = jnp.where(sum_ >= _HIT, params.cost.collision, sum_) / (254.0 * looked_at)
                of = params.cost
            elif name == "Obstacles":
                hit, of = hit | (sums["raw"] >= _HIT), Weight(1.0, params.obstacles.power)
                raw = jnp.where(sums["raw"] >= _HIT, params.obstacles.collision, sums["raw"])
                rep = jnp.where(left < params.obstacles.near_goal, 0.0, sums["repulsion"])
                term = params.obstacles.critical * raw + params.obstacles.repulsion * mean * (rep - jnp.min(rep))
            elif name == "Goal":
                term, of = jnp.where(left <= params.goal.within, mean * sum_, 0.0), params.goal
            elif name == "GoalAngle":
                term, of = jnp.where(left <= params.goal_angle.within, mean * sum_, 0.0), params.goal_angle
            elif name == "PathAlign":
                term, of = along.align(params.align, ahead, sum_, reached), params.align
            elif name == "PathFollow":
                term, of = along.follow(params.follow, ahead, m, reached), params.follow
            elif name == "PathAngle":
                term, of = along.angle(params.angle, ahead, scene.pose, m, reached), params.angle
            elif name == "PreferForward":
                term, of = jnp.where(left >= params.forward.beyond, sum_, 0.0), params.forward
            elif name == "Twirling":
                term, of = jnp.where(scene.at_goal, 0.0, mean * sum_), params.twirling
            elif name == "VelocityDeadband":
                term, of = sum_, params.deadband
            else:
                term, of = sum_, params.exposure
            terms.append(jnp.power(of.weight * term, of.power))
        return Priced(functools.reduce(jnp.add, terms), jnp.stack(terms), hit)

    return Cost(
        begin=begin, step=step, finish=finish, seldom=seldom if "PathAlign" in used else None, period=spec.align_every
    )
