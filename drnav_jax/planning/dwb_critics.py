"""DWB's stock critics, as Nav2 has them: the raw score of every trajectory, and whether it is legal.

    RotateToGoal   0 outside the goal window (<= 0.25 m, latched). Inside, not yet rotating: illegal if v^2 >= the current
                   v^2, else 5 v^2 + |goal yaw - yaw at the end|. Rotating (latched once |v| <= 0.25 m/s): illegal if v
                   is not 0, else the yaw difference                                                    scale 32
    Oscillation    0; illegal if it reverses a sign trend that has flipped (v always; omega only if |v| <= 0.05 m/s when
                   the trend was set); forgotten after 0.05 m or 0.2 rad                                       1
    BaseObstacle   costmap at the last pose; illegal where any pose is >= 253, unknown or off the grid      0.02
    GoalAlign      GoalDist of a point 0.1 m ahead of the last pose, the goal moved 0.1 m robot -> goal   24 res / 2
    PathAlign      PathDist of that point; off within 0.1 m of the goal                                   32 res / 2
    PathDist       L1 distance [cells] of the last pose to the path's cells                               32 res / 2
    GoalDist       L1 distance [cells] of the last pose to the last path cell on the map                  24 res / 2

The path's cells are those known cells that its points lie in, from the first on the map up to the last before it leaves the
map. Distances ignore obstacles. PathDist and GoalDist are illegal where a pose is off the grid, or there is no such cell;
the Align critics where their point is. A critic with scale 0 is not asked.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drnav_jax import geometry
from drnav_jax.planning.path import Path
from drnav_jax.types import GridMap, Scalar

CRITICS = ("RotateToGoal", "Oscillation", "BaseObstacle", "GoalAlign", "PathAlign", "PathDist", "GoalDist")
UNREACHED = 1e6  # [cells] distance where there is no path on the map


class DwbParams(NamedTuple):
    """Numbers of the critics."""

    rotate_to_goal: Scalar = 32.0  # [] scales
    oscillation: Scalar = 1.0  # []
    base_obstacle: Scalar = 0.02  # []
    goal_align: Scalar = 24.0  # []
    path_align: Scalar = 32.0  # []
    path_dist: Scalar = 32.0  # []
    goal_dist: Scalar = 24.0  # []
    goal_tolerance: Scalar = 0.25  # [] of the goal window [m]
    stopped: Scalar = 0.25  # [] slower than this it has stopped [m/s]
    slowing: Scalar = 5.0  # [] factor of v^2 in the goal window
    forward_point: Scalar = 0.1  # [] how far ahead the Align critics look [m]
    reset_distance: Scalar = 0.05  # [] after which trends are forgotten [m]
    reset_angle: Scalar = 0.2  # [] [rad]
    only_x: Scalar = 0.05  # [] faster than this, omega sets no trend [m/s]


class DwbState(NamedTuple):
    """What the critics latch. Trends are (v, omega)."""

    in_window: Array  # [] bool
    rotating: Array  # [] bool
    sign: Array  # [2] int32, last sign commanded, 0 none
    positive_only: Array  # [2] bool
    negative_only: Array  # [2] bool
    place: Array  # [3] pose at which a trend flipped last


class Trajectories(NamedTuple):
    """K rolled-out twists; all `[K]`."""

    v: Array  # the twist [m/s]
    w: Array  # [rad/s]
    x: Array  # last pose [m]
    y: Array  # [m]
    c: Array  # cosine of its yaw
    s: Array  # sine
    cost: Array  # costmap there
    on_grid: Array  # bool, of all poses
    blocked: Array  # bool, a pose is >= 253 (unknown is 255)


class Judged(NamedTuple):
    """What the critics say."""

    raw: Float[Array, "7 K"]
    legal: Bool[Array, "7 K"]
    scale: Float[Array, "7"]


def init() -> DwbState:
    """Nothing latched."""
    no, none = jnp.asarray(False), jnp.zeros(2, bool)
    return DwbState(no, no, jnp.zeros(2, jnp.int32), none, none, jnp.zeros(3, jnp.float32))


def path_cells(costs: GridMap, path: Path) -> tuple[Int[Array, "N 2"], Bool[Array, " N"]]:
    """(row, column) of the path's points, and which of them are its cells (module docstring)."""
    h, w = costs.values.shape
    index = jnp.arange(path.x.shape[0])
    cell = geometry.cell_of(jnp.stack([path.x, path.y], axis=-1), costs.origin, costs.resolution)
    held = jnp.clip(cell, 0, jnp.asarray([h - 1, w - 1], jnp.int32)[None, :])
    known = geometry.inside(cell, (h, w)) & (costs.values[held[:, 0], held[:, 1]] != 255.0) & (index < path.count)
    began = jnp.cumsum(known.astype(jnp.int32)) > 0
    left = jnp.cumsum((began & ~known).astype(jnp.int32)) > 0
    return cell, known & ~left


def _cells_away(cell: Int[Array, "K 2"], seeds: Int[Array, "N 2"], used: Bool[Array, " N"]) -> Float[Array, " K"]:
    """L1 distance to the nearest seed [cells]: what an exact transform of the grid holds there."""
    away = jnp.sum(jnp.abs(cell[:, None, :] - seeds[None, :, :]), axis=-1).astype(jnp.float32)
    return jnp.min(jnp.where(used[None, :], away, UNREACHED), axis=1)


def judge(
    params: DwbParams,
    state: DwbState,
    costs: GridMap,
    path: Path,
    pose: Float[Array, "3"],
    twist: Float[Array, "2"],
    goal: Float[Array, "3"],
    rolled: Trajectories,
) -> Judged:
    """All critics on all trajectories.

    Args:
        params: Numbers.
        state: With this tick's window latched (`enter`).
        costs: Costmap 0..255.
        path: What lies ahead.
        pose: Robot.
        twist: Its speeds.
        goal: x, y, yaw.
        rolled: Trajectories.
    """
    shape = costs.values.shape[0], costs.values.shape[1]
    none, fine = jnp.zeros_like(rolled.v), jnp.ones(rolled.v.shape, bool)
    # RotateToGoal
    turn = jnp.abs(geometry.wrap_angle(goal[2] - jnp.arctan2(rolled.s, rolled.c)))
    square = jnp.square(rolled.v)
    slowing = jnp.where(state.rotating, 0.0, params.slowing * square)
    rotate = jnp.where(state.in_window, slowing + turn, 0.0)
    rotate_legal = ~state.in_window | jnp.where(state.rotating, rolled.v == 0.0, square < jnp.square(twist[0]))
    # Oscillation
    speeds = jnp.stack([rolled.v, rolled.w])
    swings = (state.positive_only[:, None] & (speeds < 0)) | (state.negative_only[:, None] & (speeds > 0))
    # the map grids
    seeds, used = path_cells(costs, path)
    last = jnp.max(jnp.where(used, jnp.arange(used.shape[0]), 0))
    at_last = jnp.arange(used.shape[0]) == last
    here = geometry.cell_of(jnp.stack([rolled.x, rolled.y], axis=-1), costs.origin, costs.resolution)
    nose_xy = jnp.stack([rolled.x + params.forward_point * rolled.c, rolled.y + params.forward_point * rolled.s], axis=-1)
    nose = geometry.cell_of(nose_xy, costs.origin, costs.resolution)
    nose_on = geometry.inside(nose, shape)
    to_goal = jnp.arctan2(goal[1] - pose[1], goal[0] - pose[0])
    ahead = jnp.stack([jnp.cos(to_goal), jnp.sin(to_goal)]) * params.forward_point
    moved = jnp.arange(path.x.shape[0]) >= path.count - 1
    moved_path = path._replace(
        x=path.x + jnp.where(moved, ahead[0], 0.0), y=path.y + jnp.where(moved, ahead[1], 0.0)
    )
    moved_seeds, moved_used = path_cells(costs, moved_path)
    moved_last = jnp.arange(used.shape[0]) == jnp.max(jnp.where(moved_used, jnp.arange(used.shape[0]), 0))
    path_dist, goal_dist = _cells_away(here, seeds, used), _cells_away(here, seeds, used & at_last)
    path_align, goal_align = _cells_away(nose, seeds, used), _cells_away(nose, moved_seeds, moved_used & moved_last)
    near = jnp.hypot(goal[0] - pose[0], goal[1] - pose[1]) <= params.forward_point
    half = 0.5 * costs.resolution
    scale = [
        params.rotate_to_goal, params.oscillation, params.base_obstacle, params.goal_align * half,
        jnp.where(near, 0.0, params.path_align * half), params.path_dist * half, params.goal_dist * half,
    ]  # fmt: skip
    return Judged(
        raw=jnp.stack([rotate, none, rolled.cost, goal_align, path_align, path_dist, goal_dist]),
        legal=jnp.stack([
            fine & rotate_legal, ~jnp.any(swings, axis=0), rolled.on_grid & ~rolled.blocked,
            nose_on, nose_on,
            rolled.on_grid & (path_dist < UNREACHED), rolled.on_grid & (goal_dist < UNREACHED),
        ]),
        scale=jnp.stack([jnp.asarray(a, jnp.float32) for a in scale]),
    )  # fmt: skip


def enter(
    params: DwbParams, state: DwbState, pose: Float[Array, "3"], twist: Float[Array, "2"], goal: Float[Array, "3"]
) -> DwbState:
    """Latch the goal window and the rotation in it, before scoring."""
    near = jnp.hypot(goal[0] - pose[0], goal[1] - pose[1]) <= params.goal_tolerance
    in_window = state.in_window | near
    return state._replace(
        in_window=in_window, rotating=state.rotating | (in_window & (jnp.abs(twist[0]) <= params.stopped))
    )


def remember(params: DwbParams, state: DwbState, pose: Float[Array, "3"], sent: Float[Array, "2"]) -> DwbState:
    """Follow the signs of what is commanded, after scoring; forget the trends where the robot has moved on.

    Args:
        params: Numbers.
        state: So far.
        pose: Robot.
        sent: v, omega commanded.
    """
    sign = jnp.sign(sent).astype(jnp.int32)
    counts = jnp.stack([jnp.asarray(True), jnp.abs(sent[0]) <= params.only_x]) & (sign != 0)
    flipped = counts & (sign == -state.sign)
    negative = state.negative_only | (flipped & (sign < 0))
    positive = state.positive_only | (flipped & (sign > 0))
    place = jnp.where(jnp.any(flipped), pose, state.place)
    away = jnp.hypot(pose[0] - place[0], pose[1] - place[1]) > params.reset_distance
    turned = jnp.abs(geometry.wrap_angle(pose[2] - place[2])) > params.reset_angle
    reset = (jnp.any(negative) | jnp.any(positive)) & (away | turned)
    return state._replace(
        sign=jnp.where(reset, 0, jnp.where(counts, sign, state.sign)),
        positive_only=positive & ~reset, negative_only=negative & ~reset, place=place,
    )  # fmt: skip
