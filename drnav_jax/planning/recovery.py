"""Semantic recovery: what to do when nothing can be done, and when to stop doing it.

Modes and the rules between them (time in seconds; every rule is a Param):

    DRIVE    follow the generator. Left for CLEAR when the robot is stuck: it has not left a circle of `stuck_radius` for
             `stuck_time`, or one of `circle_radius` for `circle_time`, or every candidate was blocked for `blocked_time`.
    CLEAR    move to where there is room (turning and backing up allowed), for `clear_time`. Then DRIVE after the first
             attempt at a place, RETREAT after further ones.
    RETREAT  follow the cost-to-go to a recovery point. Left for DRIVE within `arrive_radius` of it, after
             `retreat_time`, or when it cannot be reached.
    STOP     no way to the goal is known and none was found for `hopeless_time`: stand still and say so. Left for DRIVE
             as soon as a way is known.

Where the robot got stuck is remembered in a field of visits of its own, which decays and is never written into P_dead:
a retreat stamped into the belief would close the only way. Driving leaves a faint visit, too: the window forgets what
rolls out of it, and a robot that swings between two ways of which it always forgets one drives each time at a higher
price until it goes on. Attempts are counted until the robot is `forget_radius` away
from where the first one began, so it does not swing between the same two answers.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drnav_jax import geometry
from drnav_jax.types import GridSpec, Scalar

DRIVE, CLEAR, RETREAT, STOP = range(4)
MODES = ("drive", "clear", "retreat", "stop")


class RecoveryParams(NamedTuple):
    """When recovery begins, what it does, when it ends."""

    stuck_radius: Scalar = 0.3  # [] [m]
    stuck_time: Scalar = 5.0  # [] [s]
    circle_radius: Scalar = 1.5  # [] [m]
    circle_time: Scalar = 20.0  # [] [s]
    blocked_time: Scalar = 1.0  # [] [s]
    clear_time: Scalar = 1.5  # [] [s]
    retreat_time: Scalar = 15.0  # [] [s]
    arrive_radius: Scalar = 0.5  # [] [m]
    forget_radius: Scalar = 3.0  # [] [m]
    hopeless_time: Scalar = 10.0  # [] [s]
    visit_radius: Scalar = 1.0  # [] extent of one visit [m]
    visit_time: Scalar = 100.0  # [] decay time of visits [s]
    visit_driven: Scalar = 0.1  # [] visit left per metre driven [1/m]
    openness: Scalar = 1.0  # [] worth of one open direction of a recovery point [m]
    min_distance: Scalar = 1.0  # [] recovery points nearer than this are no retreat [m]


class RecoveryState(NamedTuple):
    """Carried between ticks."""

    mode: Array  # [] int32: DRIVE, CLEAR, RETREAT, STOP
    since: Array  # [] time the mode began [s]
    anchor: Array  # [2] centre of the small circle [m]
    anchor_time: Array  # [] when the robot came into it [s]
    circle: Array  # [2] centre of the large circle [m]
    circle_time: Array  # [] when the robot came into it [s]
    free_time: Array  # [] when a candidate was last free [s]
    way_time: Array  # [] when a way to the goal was last known [s]
    attempts: Array  # [] int32 at this place
    place: Array  # [2] where the attempts began [m]
    target: Array  # [2] recovery point retreated to [m]
    entries: Array  # [] int32, how often recovery began
    visits: Array  # [H, W] 0..1, on the window


def init(spec: GridSpec, xy: Float[Array, "2"]) -> RecoveryState:
    """Driving, with nothing remembered."""
    xy, zero, count = jnp.asarray(xy, jnp.float32), jnp.zeros((), jnp.float32), jnp.zeros((), jnp.int32)
    return RecoveryState(
        mode=count, since=zero, anchor=xy, anchor_time=zero, circle=xy, circle_time=zero, free_time=zero,
        way_time=zero, attempts=count, place=xy, target=xy, entries=count, visits=jnp.zeros(spec.shape, jnp.float32),
    )  # fmt: skip


def choose(
    params: RecoveryParams, points: Float[Array, "M 2"], rank: Float[Array, " M"], valid: Bool[Array, " M"],
    visits: Float[Array, " M"], xy: Float[Array, "2"],
) -> tuple[Float[Array, "2"], Bool[Array, ""]]:  # fmt: skip
    """The recovery point to retreat to: many open directions, near, not visited; and whether there is one.

    Args:
        params: Worth of openness, least distance.
        points: Recovery points in odom [m].
        rank: Their numbers of open directions.
        valid: Which of them exist.
        visits: Visits at each.
        xy: Robot [m].
    """
    distance = jnp.hypot(points[:, 0] - xy[0], points[:, 1] - xy[1])
    worth = params.openness * rank - distance - 10.0 * visits
    worth = jnp.where(valid & (distance > params.min_distance), worth, -jnp.inf)
    best = jnp.argmax(worth)
    return jnp.where(jnp.isfinite(worth[best]), points[best], xy), jnp.isfinite(worth[best])


def wait(state: RecoveryState, time: Scalar, waiting: Bool[Array, ""]) -> RecoveryState:
    """While `waiting` the clocks start anew: a robot that stands still for a reason (arrived, no pose) is not stuck."""
    now = lambda clock: jnp.where(waiting, time, clock)  # noqa: E731
    return state._replace(
        anchor_time=now(state.anchor_time), circle_time=now(state.circle_time), free_time=now(state.free_time),
        way_time=now(state.way_time),
    )  # fmt: skip


@partial(jax.jit, static_argnames="spec")
def update(
    spec: GridSpec,
    params: RecoveryParams,
    state: RecoveryState,
    time: Scalar,
    dt: Scalar,
    xy: Float[Array, "2"],
    driven: Scalar,
    origin: Float[Array, "2"],
    candidate_free: Bool[Array, ""],
    has_way: Bool[Array, ""],
    refuge: Float[Array, "2"],
    has_refuge: Bool[Array, ""],
) -> RecoveryState:
    """Apply the rules of the module docstring once.

    Args:
        spec: The window.
        params: The rules' numbers.
        state: So far.
        time: Now [s].
        dt: Since the last call [s].
        xy: Robot in odom [m].
        driven: Since the last call [m].
        origin: Odom position of the window's outer corner [m].
        candidate_free: The generator found a free candidate.
        has_way: A way to the goal (or to the recovery point, in RETREAT) is known.
        refuge: Recovery point that `choose` would take [m].
        has_refuge: Whether there is one.
    """
    time = jnp.asarray(time, jnp.float32)

    def away(centre: Array, radius: Scalar) -> Array:
        return jnp.hypot(xy[0] - centre[0], xy[1] - centre[1]) > radius

    driving = state.mode == DRIVE
    moved, roamed = away(state.anchor, params.stuck_radius), away(state.circle, params.circle_radius)
    anchor_time = jnp.where(moved | ~driving, time, state.anchor_time)
    circle_time = jnp.where(roamed | ~driving, time, state.circle_time)
    free_time = jnp.where(candidate_free | ~driving, time, state.free_time)
    way_time = jnp.where(has_way, time, state.way_time)
    stuck = (
        (time - anchor_time > params.stuck_time)
        | (time - circle_time > params.circle_time)
        | (time - free_time > params.blocked_time)
    )
    enter = driving & stuck
    hopeless = (time - way_time > params.hopeless_time) & (driving | (state.mode == STOP))
    attempts = jnp.where(away(state.place, params.forget_radius), 0, state.attempts)
    place = jnp.where(enter & (attempts == 0), xy, state.place)
    attempts = jnp.where(enter, attempts + 1, attempts)

    in_mode = time - state.since
    cleared = (state.mode == CLEAR) & (in_mode >= params.clear_time)
    retreat = cleared & (attempts > 1) & has_refuge
    arrived = ~away(state.target, params.arrive_radius)
    returned = (state.mode == RETREAT) & (arrived | (in_mode > params.retreat_time) | ((in_mode > 1.0) & ~has_way))
    mode = jnp.where(enter, CLEAR, state.mode)
    mode = jnp.where(cleared, jnp.where(retreat, RETREAT, DRIVE), mode)
    mode = jnp.where(returned, DRIVE, mode)
    mode = jnp.where(hopeless, STOP, jnp.where((mode == STOP) & has_way, DRIVE, mode)).astype(jnp.int32)

    x, y = geometry.cell_centres(spec.shape, origin, spec.resolution)
    here = jnp.square(x - xy[0]) + jnp.square(y - xy[1]) <= jnp.square(params.visit_radius)
    stamp = enter & (attempts > 1)
    visits = state.visits * jnp.exp(-jnp.asarray(dt, jnp.float32) / params.visit_time)
    return RecoveryState(
        mode=mode,
        since=jnp.where(mode != state.mode, time, state.since),
        anchor=jnp.where(moved | ~driving, xy, state.anchor),
        anchor_time=anchor_time,
        circle=jnp.where(roamed | ~driving, xy, state.circle),
        circle_time=circle_time,
        free_time=free_time,
        way_time=way_time,
        attempts=attempts,
        place=place,
        target=jnp.where(retreat, refuge, state.target),
        entries=state.entries + enter.astype(jnp.int32),
        visits=jnp.minimum(visits + jnp.where(here, jnp.where(stamp, 1.0, params.visit_driven * driven), 0.0), 1.0),
    )
