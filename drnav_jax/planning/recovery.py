"""Semantic recovery: what to do when nothing can be done, and when to stop doing it.

Modes and the rules between them (time in seconds; every rule is a Param):

    DRIVE    follow the generator. Left for CLEAR when the robot is stuck: it has not left a circle of `stuck_radius` for
             `stuck_time`, or one of `circle_radius` for `circle_time`, or every candidate was blocked for `blocked_time`.
             Left for RETREAT before it is stuck when even the best candidate has been `risky` for `risky_time`.
    CLEAR    move to where there is room (turning and backing up allowed), for `clear_time`. Then DRIVE after the first
             attempt at a place, RETREAT after further ones.
    RETREAT  follow the cost-to-go to a recovery point (`refuge`) over all the map, narrow ways included: so the way that
             was driven is among those back. Left for DRIVE within `arrive_radius` of it, after `retreat_time`, or when
             it cannot be reached.
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

from drnav_jax import geometry, grids
from drnav_jax.planning import refuge
from drnav_jax.planning.refuge import RefugeParams
from drnav_jax.planning.route import Route
from drnav_jax.types import GridMap, GridSpec, Scalar

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
    risky_exposure: Scalar = 1.5  # [] EDE of the best candidate from which on it is no way to take [m]
    risky_time: Scalar = 1.0  # [] [s]
    refuge: RefugeParams = RefugeParams()


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
    calm_time: Array  # [] when the best candidate was last not risky [s]
    attempts: Array  # [] int32 at this place
    place: Array  # [2] where the attempts began [m]
    refuge: Array  # [2] recovery point that a retreat would lead to [m]
    has_refuge: Array  # [] bool
    target: Array  # [2] recovery point retreated to [m]
    entries: Array  # [] int32, how often recovery began
    visits: Array  # [H, W] 0..1, on the window


def init(spec: GridSpec, xy: Float[Array, "2"]) -> RecoveryState:
    """Driving, with nothing remembered."""
    xy, zero, count = jnp.asarray(xy, jnp.float32), jnp.zeros((), jnp.float32), jnp.zeros((), jnp.int32)
    return RecoveryState(
        mode=count, since=zero, anchor=xy, anchor_time=zero, circle=xy, circle_time=zero, free_time=zero,
        way_time=zero, calm_time=zero, attempts=count, place=xy, refuge=xy, has_refuge=jnp.asarray(False), target=xy,
        entries=count, visits=jnp.zeros(spec.shape, jnp.float32),
    )  # fmt: skip


def looking(state: RecoveryState, time: Scalar) -> Bool[Array, ""]:
    """Whether a retreat may begin soon: then it is time to rank the recovery points."""
    return (state.mode == CLEAR) | ((state.mode == DRIVE) & (state.calm_time < time - 1e-3))


def look_back(
    params: RecoveryParams, state: RecoveryState, time: Scalar, points: Float[Array, "M 2"], rank: Float[Array, " M"],
    last_seen: Float[Array, " M"], valid: Bool[Array, " M"], route: Route, free: Bool[Array, "H W"],
    value: Float[Array, "H W"], clear: Float[Array, "H W"], origin: Float[Array, "2"], resolution: float,
    pose: Float[Array, "3"],
) -> RecoveryState:  # fmt: skip
    """Rank the recovery points (`refuge`) and keep the best as the one to go back to.

    Args:
        params: Weights of the ranking.
        state: So far; its visits lie on the window.
        time: Now [s].
        points: Recovery points in odom [m].
        rank: Their numbers of open directions.
        last_seen: When each was [s].
        valid: Which of them exist.
        route: To the goal, on the window or on coarser cells.
        free: Known to be free, on the window.
        value: Value-to-go to the goal on the window [m].
        clear: Clearance on the window [m].
        origin: Odom position of the window's outer corner [m].
        resolution: Edge of one of its cells [m].
        pose: Robot.
    """
    by = free.shape[0] // route.cost.shape[0]
    size = resolution * by
    way = refuge.ways(params.refuge, route.cost, route.east, route.north, grids.pool(free, by, "all"), origin, size, pose)
    fine = lambda values: GridMap(values, origin, resolution)  # noqa: E731
    best = refuge.choose(
        params.refuge, points, rank, time - last_seen, valid, GridMap(way, origin, size), fine(value), fine(clear),
        fine(state.visits), pose[:2],
    )  # fmt: skip
    return state._replace(refuge=best.xy, has_refuge=best.found)


def wait(state: RecoveryState, time: Scalar, waiting: Bool[Array, ""]) -> RecoveryState:
    """While `waiting` the clocks start anew: a robot that stands still for a reason (arrived, no pose) is not stuck."""
    now = lambda clock: jnp.where(waiting, time, clock)  # noqa: E731
    return state._replace(
        anchor_time=now(state.anchor_time), circle_time=now(state.circle_time), free_time=now(state.free_time),
        way_time=now(state.way_time), calm_time=now(state.calm_time),
    )  # fmt: skip


def forget(state: RecoveryState, leap: Bool[Array, ""]) -> RecoveryState:
    """After a `leap` of odometry no place means anything: drive on, and go back to none that was seen before it."""
    return state._replace(
        mode=jnp.where(leap, DRIVE, state.mode), attempts=jnp.where(leap, 0, state.attempts),
        has_refuge=state.has_refuge & ~leap,
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
    risky: Bool[Array, ""],
    ahead: Float[Array, "2"],
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
        risky: Even the best candidate leads into what is believed to be a dead end, and the robot is not in it yet.
        ahead: Where that candidate ends [m].
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
    calm_time = jnp.where(risky & driving, state.calm_time, time)
    turn_back = driving & ~stuck & (time - calm_time > params.risky_time) & state.has_refuge
    enter = driving & (stuck | turn_back)
    hopeless = (time - way_time > params.hopeless_time) & (driving | (state.mode == STOP))
    attempts = jnp.where(away(state.place, params.forget_radius), 0, state.attempts)
    place = jnp.where(enter & (attempts == 0), xy, state.place)
    attempts = jnp.where(enter, attempts + 1, attempts)

    in_mode = time - state.since
    cleared = (state.mode == CLEAR) & (in_mode >= params.clear_time)
    retreat = (cleared & (attempts > 1) & state.has_refuge) | turn_back
    arrived = ~away(state.target, params.arrive_radius)
    returned = (state.mode == RETREAT) & (arrived | (in_mode > params.retreat_time) | ((in_mode > 1.0) & ~has_way))
    mode = jnp.where(enter, jnp.where(turn_back, RETREAT, CLEAR), state.mode)
    mode = jnp.where(cleared, jnp.where(retreat, RETREAT, DRIVE), mode)
    mode = jnp.where(returned, DRIVE, mode)
    mode = jnp.where(hopeless, STOP, jnp.where((mode == STOP) & has_way, DRIVE, mode)).astype(jnp.int32)

    x, y = geometry.cell_centres(spec.shape, origin, spec.resolution)
    disc = lambda c: jnp.square(x - c[0]) + jnp.square(y - c[1]) <= jnp.square(params.visit_radius)  # noqa: E731
    stamp = (disc(xy) & enter & (attempts > 1)) | (disc(ahead) & turn_back)
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
        calm_time=calm_time,
        attempts=attempts,
        place=place,
        refuge=state.refuge,
        has_refuge=state.has_refuge,
        target=jnp.where(retreat, state.refuge, state.target),
        entries=state.entries + enter.astype(jnp.int32),
        visits=jnp.minimum(visits + jnp.where(stamp, 1.0, jnp.where(disc(xy), params.visit_driven * driven, 0.0)), 1.0),
    )
