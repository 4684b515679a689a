"""DWA: the velocity that brings the robot to g* soonest, among those from which it can still stop (Fox et al. 1997).

Candidates are the speeds reachable within one tick. Each is certified first: drive it for one tick, then brake both
speeds at their limits; at every sample of that motion the footprint must stay clear (or, if it stands closer than the
margin already, must not come closer; by `DIP` it may). Braking from a certified motion is itself a candidate, so there is
always a certified command in a static world; if the map changed its mind, the answer is to brake.

Certified candidates are then rolled out - one step and then straight on, or half the time along the arc and the rest on
along it, straight, or turning the other way round, at the angular acceleration there is - and ranked by the time still
needed from the last free pose of the best of the four,

    J = (|g - p| + w_c sum ((d_soft - d) / (d_soft - d_block))_+^2 ds) / v_max + w_h |bearing error| / w_max
        + w_r (d_block - d_last)_+ + w_s |omega - omega_0| / w_max

which turns on the spot when the goal is behind, drives arcs when it is not, and needs no case distinction. Clearance is
paid per metre, and w_c < 1: a price per second would make it worth while to stand still beside an obstacle.
"""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drnav_jax import geometry, grids
from drnav_jax.planning import dynamics
from drnav_jax.planning.dynamics import Motion
from drnav_jax.types import Command, GridMap, RobotParams, Scalar

DIP = 0.004  # [m]
WAYS = 4  # to go on after the tick
TERMS = ("distance", "clearance", "heading", "room", "smoothness")  # of J, as `Critics` lists them


@dataclasses.dataclass(frozen=True)
class TrackerSpec:
    """Samples of the dynamic window.

    Attributes:
        num_speeds: Levels of v.
        num_turns: Levels of omega.
        dt: Tick [s].
        num_steps: Steps of each half of the ranking rollout, each `dt`; twice that when slow.
        brake_ticks: Ticks within which every certified motion must have stopped.
        samples: Footprint checks per tick of the certificate.
        num_explained: Best commands whose terms are in Info; all, if there are fewer.
    """

    num_speeds: int = 9
    num_turns: int = 15
    dt: float = 0.1
    num_steps: int = 6
    brake_ticks: int = 10
    samples: int = 2
    num_explained: int = 10

    def __post_init__(self) -> None:
        """Check counts."""
        counts = (self.num_speeds, self.num_turns, self.num_steps, self.brake_ticks, self.samples, self.num_explained)
        if min(counts) < 1 or self.dt <= 0:
            raise ValueError(f"all counts must be >= 1 and dt > 0 s, got {self}.")


class TrackerParams(NamedTuple):
    """Weights of the ranking; times in seconds."""

    margin: Scalar = 0.04  # [] beyond the radius: no certified motion comes closer [m]
    heading: Scalar = 1.0  # [] w_h
    clearance: Scalar = 0.8  # [] w_c
    room: Scalar = 100.0  # [] w_r: ending nearer to an obstacle than the margin [s/m]
    soft_clearance: Scalar = 0.3  # [] beyond the radius: where the clearance term begins [m]
    smoothness: Scalar = 0.05  # [] w_s [s]
    slow: Scalar = 0.3  # [] share of v_max below which the robot is slow


class Critics(NamedTuple):
    """Which critic decided: what a command's cost is the sum of (here `TERMS`; or DWB's or MPPI's critics)."""

    chosen: Array  # [C] of the choice (MPPI: averaged over the samples as they were weighted)
    best: Array  # [n, C] of the best candidates, the best first
    best_cost: Array  # [n] their costs; inf where fewer are admissible


class Track(NamedTuple):
    """The chosen command and what it rests on."""

    command: Command
    certified: Bool[Array, ""]  # False: nothing could be certified, the command brakes
    cost: Float[Array, ""]  # J of the choice [s]
    clearance: Float[Array, ""]  # least clearance of the certified motion [m]
    critics: Critics


def instead(acts: Bool[Array, ""], other: Track, track: Track) -> Track:
    """The other's command where it `acts`; the critics stay those of `track`."""
    merge = lambda a, b: jax.tree.map(lambda x, y: jnp.where(acts, x, y), a, b)  # noqa: E731
    return Track(*[merge(a, b) for a, b in zip(other[:-1], track[:-1], strict=True)], critics=track.critics)


def _grid(num: int, low: Array, high: Array) -> Array:
    """`num` levels from low to high; the middle one is replaced by the level nearest to standing still."""
    levels = low + (high - low) * jnp.linspace(0.0, 1.0, num, dtype=jnp.float32)
    return levels.at[num // 2].set(jnp.clip(0.0, low, high))


@partial(jax.jit, static_argnames="spec")
def track(
    spec: TrackerSpec,
    params: TrackerParams,
    robot: RobotParams,
    clear: GridMap,
    pose: Float[Array, "3"],
    twist: Float[Array, "2"],
    target: Float[Array, "2"],
    seek_room: Bool[Array, ""],
) -> Track:
    """The best certified command towards `target`.

    Args:
        spec: Samples.
        params: Weights.
        robot: Radius and limits.
        clear: Clearance [m] of map cells in odom.
        pose: Robot in odom.
        twist: Its speeds (v, omega).
        target: g* in odom [m].
        seek_room: Rank by clearance instead: gets a robot out of a squeeze.
    """
    dt = spec.dt
    v0, w0 = twist[0], twist[1]
    # never beyond what the robot can still do about its speed, even if it is over a limit now
    v_low, v_high = v0 - robot.a_max * dt, v0 + robot.a_max * dt
    w_low, w_high = w0 - robot.alpha_max * dt, w0 + robot.alpha_max * dt
    v_low, v_high = (jnp.clip(a, robot.v_min, robot.v_max) for a in (v_low, v_high))
    w_low, w_high = (jnp.clip(a, -robot.w_max, robot.w_max) for a in (w_low, w_high))
    v = _grid(spec.num_speeds, v_low, v_high)
    w = _grid(spec.num_turns, w_low, w_high)
    v, w = jnp.repeat(v, spec.num_turns), jnp.tile(w, spec.num_speeds)
    stop = dynamics.limit(0.0, 0.0, twist, robot, dt)
    v, w = jnp.concatenate([v, stop.v[None]]), jnp.concatenate([w, stop.omega[None]])

    def room(m: Motion) -> Array:
        return geometry.sample_bilinear(clear, jnp.stack([m.x, m.y], axis=-1))

    def drive(m: Motion) -> tuple[Motion, Array]:
        """One tick at the speeds of `m`; least clearance on the way."""
        least = jnp.full_like(m.x, jnp.inf)
        for _ in range(spec.samples):
            m = dynamics.advance(m, m.v, m.w, robot, dt / spec.samples)
            least = jnp.minimum(least, room(m))
        return m, least

    start = dynamics.start(pose, twist, v.shape[0])._replace(v=v, w=w)
    here = room(start)[0]

    def brake(carry: tuple[Motion, Array], _: None) -> tuple[tuple[Motion, Array], None]:
        m, least = carry
        m = m._replace(
            v=dynamics.approach(m.v, jnp.zeros_like(v), robot.a_max * dt),
            w=dynamics.approach(m.w, jnp.zeros_like(w), robot.alpha_max * dt),
        )
        m, near = drive(m)
        return (m, jnp.minimum(least, near)), None

    (end, least), _ = jax.lax.scan(brake, drive(start), None, length=spec.brake_ticks)
    # A dip of DIP is noise of the map: who stands at the margin may come closer by that much, or every dip would hold a
    # robot beside a wall. Who is closer still may go if that leads away.
    limit = robot.radius + params.margin
    block = jnp.minimum(limit, here - DIP)
    still = (v == 0) & (w == 0)
    certified = ((least >= block) & (room(end) >= jnp.minimum(limit - DIP, here)) & (jnp.abs(end.v) < 1e-3)) | still

    soft = robot.radius + params.soft_clearance
    slope = 1.0 / jnp.maximum(params.soft_clearance - params.margin, 1e-3)

    # a slow robot looks twice as far ahead in time: what it needs there is room to turn, not reaction
    pace = jnp.where(jnp.abs(v0) < params.slow * robot.v_max, 2.0 * dt, dt)

    def roll(carry: tuple[Motion, Array, Array], turn: Array) -> tuple[tuple[Motion, Array, Array], None]:
        """One step at the speeds of the motion, and turn rates that tend to `turn`."""
        m, lack, free = carry
        ahead = dynamics.advance(m, m.v, turn, robot, pace)
        near = room(ahead)
        free = free & (near >= block)
        m = jax.tree.map(lambda a, b: jnp.where(free, a, b), ahead, m)
        return (m, lack + jnp.square(jnp.maximum((soft - near) * slope, 0.0)) * jnp.abs(m.v) * pace, free), None

    # straight on at once is what ends a turn; the other way round gets a robot through a gap it is not in line with
    begun, _ = roll((start, jnp.zeros_like(v), jnp.ones_like(v, dtype=bool)), w)
    straight = jnp.zeros_like(w)
    halves = jax.tree.map(lambda a: jnp.tile(a, 2), begun)
    turns = jnp.concatenate([w, straight])
    halves, _ = jax.lax.scan(lambda carry, _: roll(carry, turns), halves, None, length=spec.num_steps - 1)
    halves = jax.tree.map(lambda a: jnp.concatenate([jnp.tile(a[: w.size], 3), a[w.size :]]), halves)
    ends = jnp.concatenate([w, straight, -w, straight])
    (last, lack, _), _ = jax.lax.scan(lambda carry, _: roll(carry, ends), halves, None, length=spec.num_steps)
    dx, dy = target[0] - last.x, target[1] - last.y
    distance = jnp.hypot(dx, dy)
    bearing = jnp.abs(jnp.arctan2(last.c * dy - last.s * dx, last.c * dx + last.s * dy))
    near = room(last)
    terms = jnp.stack([
        distance / robot.v_max,
        params.clearance * lack / robot.v_max,
        params.heading * bearing / robot.w_max * jnp.minimum(distance / 0.5, 1.0),
        params.room * jnp.maximum(limit - near, 0.0),
        params.smoothness * jnp.tile(jnp.abs(w - w0), WAYS) / robot.w_max,
    ])  # fmt: skip
    only_room = jnp.asarray([name == "room" for name in TERMS])[:, None]
    terms = jnp.where(seek_room, jnp.where(only_room, -near[None], 0.0), terms)
    cost = jnp.sum(terms, axis=0).reshape(WAYS, -1)
    way, cost = jnp.argmin(cost, axis=0), jnp.min(cost, axis=0)
    cost = jnp.where(certified, cost, jnp.inf)
    count = v.shape[0]
    least_cost, order = grids.least(cost, min(spec.num_explained, count))
    k, best = order[0], terms[:, way[order] * count + order].T
    any_certified = jnp.any(certified)
    command = dynamics.limit(
        jnp.where(any_certified, v[k], 0.0), jnp.where(any_certified, w[k], 0.0), twist, robot, dt
    )
    critics = Critics(chosen=best[0], best=best, best_cost=least_cost)
    return Track(command=command, certified=any_certified, cost=cost[k], clearance=least[k], critics=critics)
