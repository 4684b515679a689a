"""Nav2's recovery: what its default behaviour tree does when the controller or the planner fails.

FOLLOW fails if the controller has had no command for `failure_tolerance`, if there is no path for as long, or if the robot
has not come `progress_radius` away from where it was within `progress_time`. Then:

    1. the first time since it last made progress: clear the map around the robot, and follow again
    2. else the next action of the round robin clear -> spin -> wait -> back up -> clear ..., and follow again
    3. after `retries` actions on one trip: ABORT, stand still for good

SPIN turns by 1.57 rad, faster the farther it still has to go; WAIT stands for 5 s; BACKUP drives 0.30 m backwards at
0.15 m/s. Spinning where the robot already collides, or backing into an obstacle, fails, and the next action is taken.
The clearing itself is for the owner of the map.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drnav_jax import geometry
from drnav_jax.planning import recovery
from drnav_jax.types import GridMap, RobotParams, Scalar

FOLLOW, SPIN, WAIT, BACKUP, ABORT = range(5)
MODES = ("follow", "spin", "wait", "back up", "abort")
_ROUND = (FOLLOW, SPIN, WAIT, BACKUP)  # what follows on clearing is to follow the path again
COLLISION = 253.0
_AS_DRNAV = (recovery.DRIVE, recovery.CLEAR, recovery.CLEAR, recovery.CLEAR, recovery.STOP)


class Nav2Params(NamedTuple):
    """Nav2's defaults."""

    failure_tolerance: Scalar = 0.3  # [] [s]
    progress_radius: Scalar = 0.5  # [] [m]
    progress_time: Scalar = 10.0  # [] [s]
    retries: Scalar = 6  # [] actions per trip
    spin: Scalar = 1.57  # [] [rad]
    spin_max: Scalar = 1.0  # [] [rad/s]
    spin_min: Scalar = 0.4  # [] [rad/s]
    wait: Scalar = 5.0  # [] [s]
    back: Scalar = 0.3  # [] [m]
    back_speed: Scalar = 0.15  # [] [m/s]
    allowance: Scalar = 10.0  # [] longest spin or drive [s]
    look_ahead: Scalar = 2.0  # [] time driven ahead in search of collisions [s]
    clear_radius: Scalar = 1.5  # [] half the edge of the square that is cleared [m]


class Nav2State(NamedTuple):
    """Carried between ticks."""

    mode: Array  # [] int32 FOLLOW, SPIN, WAIT, BACKUP, ABORT
    since: Array  # [] time the mode began [s]
    begin: Array  # [3] pose at which it began
    turned: Array  # [] by SPIN so far [rad]
    yaw: Array  # [] yaw at the last tick [rad]
    good_time: Array  # [] when there was last a command and a path [s]
    anchor: Array  # [2] where it last made progress [m]
    anchor_time: Array  # [] when [s]
    cleared: Array  # [] bool, rule 1 is used up
    turn: Array  # [] int32, next of the round robin
    retries: Array  # [] int32, actions so far


def init(pose: Float[Array, "3"]) -> Nav2State:
    """Following."""
    zero, count = jnp.zeros((), jnp.float32), jnp.zeros((), jnp.int32)
    return Nav2State(
        mode=count, since=zero, begin=pose, turned=zero, yaw=pose[2], good_time=zero, anchor=pose[:2], anchor_time=zero,
        cleared=jnp.asarray(False), turn=count, retries=count,
    )  # fmt: skip


def as_drnav(mode: Array) -> Array:
    """The mode of `planning.recovery` that says the same."""
    return jnp.asarray(_AS_DRNAV, jnp.int32)[mode]


def _hits(costs: GridMap, x: Array, y: Array) -> Array:
    cost = geometry.sample_nearest(costs, jnp.stack([x, y], axis=-1), fill=255.0)
    return cost >= COLLISION


@jax.jit
def update(
    params: Nav2Params,
    state: Nav2State,
    costs: GridMap,
    robot: RobotParams,
    pose: Float[Array, "3"],
    time: Scalar,
    good: Bool[Array, ""],
    waiting: Bool[Array, ""],
) -> tuple[Nav2State, Float[Array, "2"], Bool[Array, ""]]:
    """Apply the rules of the module docstring once.

    Args:
        params: Nav2's numbers.
        state: So far.
        costs: Costmap 0..255 around the robot.
        robot: Limits.
        pose: Robot.
        time: Now [s].
        good: The controller has a command, and there is a path.
        waiting: The robot stands for a reason (it has arrived, or has no pose): its clocks stand, too.

    Returns:
        The new state; the command of its mode, if that is not FOLLOW; whether to clear the map around the robot.
    """
    now = jnp.asarray(time, jnp.float32)
    following = state.mode == FOLLOW
    moved = jnp.hypot(pose[0] - state.anchor[0], pose[1] - state.anchor[1]) > params.progress_radius
    fresh = moved | ~following | waiting
    anchor, anchor_time = jnp.where(fresh, pose[:2], state.anchor), jnp.where(fresh, now, state.anchor_time)
    good_time = jnp.where(good | ~following | waiting, now, state.good_time)
    failed = following & ((now - good_time > params.failure_tolerance) | (now - anchor_time > params.progress_time))

    # the action under way
    turned = state.turned + jnp.abs(geometry.wrap_angle(pose[2] - state.yaw))
    driven = jnp.hypot(pose[0] - state.begin[0], pose[1] - state.begin[1])
    here = _hits(costs, pose[0], pose[1])
    # a robot that is on its way stops where it would collide, and drives no farther than it still has to
    along = jnp.linspace(0.0, 1.0, 7, dtype=jnp.float32)[1:]
    far = jnp.minimum(params.back_speed * params.look_ahead, params.back)
    behind = lambda length: jnp.any(  # noqa: E731
        _hits(costs, pose[0] - along * length * jnp.cos(pose[2]), pose[1] - along * length * jnp.sin(pose[2]))
    )
    blocked = behind(far)
    late = now - state.since > params.allowance
    ahead = jnp.clip(params.back - driven, 0.0, far)
    done = jnp.select(
        [state.mode == SPIN, state.mode == WAIT, state.mode == BACKUP],
        [(turned >= params.spin) | here, now - state.since >= params.wait, (driven >= params.back) | behind(ahead)],
        jnp.asarray(False),
    )
    done = done | (late & ((state.mode == SPIN) | (state.mode == BACKUP)))

    # what comes next
    first = failed & ~state.cleared & ~moved
    act = failed & ~first
    over = act & (state.retries >= params.retries)
    possible = jnp.stack([jnp.asarray(True), ~here, jnp.asarray(True), ~blocked])
    order = (state.turn + jnp.arange(4)) % 4
    which = order[jnp.argmax(possible[order])]
    mode = jnp.where(done, FOLLOW, state.mode)
    mode = jnp.where(act, jnp.asarray(_ROUND, jnp.int32)[which], mode)
    mode = jnp.where(over, ABORT, mode).astype(jnp.int32)
    began = (mode != state.mode) | failed
    clear = first | (act & ~over & (which == 0))
    new = Nav2State(
        mode=mode,
        since=jnp.where(began, now, state.since),
        begin=jnp.where(began, pose, state.begin),
        turned=jnp.where(began, 0.0, turned),
        yaw=pose[2],
        good_time=jnp.where(failed, now, good_time),
        anchor=anchor,
        anchor_time=jnp.where(failed, now, anchor_time),
        cleared=jnp.where(moved & following, False, state.cleared | first),
        turn=jnp.where(act & ~over, (which + 1) % 4, state.turn).astype(jnp.int32),
        retries=state.retries + jnp.where(act & ~over, 1, 0),
    )
    left = jnp.maximum(params.spin - new.turned, 0.0)
    omega = jnp.clip(jnp.sqrt(2.0 * robot.alpha_max * left), params.spin_min, jnp.minimum(params.spin_max, robot.w_max))
    v = -jnp.minimum(params.back_speed, -jnp.asarray(robot.v_min, jnp.float32))
    zero = jnp.zeros((), jnp.float32)
    command = jnp.stack([jnp.where(mode == BACKUP, v, zero), jnp.where(mode == SPIN, omega, zero)])
    return new, command, clear
