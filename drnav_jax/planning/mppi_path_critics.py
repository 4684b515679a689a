"""The critics of MPPI that follow a path, as Nav2 has them; their terms are listed in `mppi_critics`.

F is the furthest path point that is nearest to the end of any trajectory: path critics look from there on, so what the
robot can reach is what it is measured by. A path point is blocked where a disc robot would collide; the last one is not
asked.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drnav_jax import geometry, grids
from drnav_jax.planning import path as paths
from drnav_jax.planning.dynamics import Motion
from drnav_jax.planning.mppi_critic_params import AlignParams, AngleParams, FollowParams
from drnav_jax.planning.path import Path
from drnav_jax.types import Scalar


class Ahead(NamedTuple):
    """The path as critics look at it."""

    path: Path  # [N]
    length: Array  # [] L [m]
    blocked: Array  # [N] bool; False from the last point on
    middle: Array  # [N] arc length half-way from each of the first n - 2 points to the next; infinite beyond [m]


class Aligned(NamedTuple):
    """PathAlign's carry; all `[K]`."""

    x: Array  # the last point looked at [m]
    y: Array  # [m]
    arc: Array  # driven so far, in chords between such points [m]
    total: Array  # of the distances [m]
    count: Array  # of points that are not blocked


def look(path: Path, collides: Bool[Array, " N"]) -> Ahead:
    """Prepare a path, given at which of its points a robot collides."""
    index = jnp.arange(path.x.shape[0])
    arc = paths.lengths(path)
    middle = jnp.concatenate([0.5 * (arc[:-1] + arc[1:]), arc[-1:]])
    return Ahead(
        path=path, length=arc[-1], blocked=collides & (index < path.count - 1),
        middle=jnp.where(index < path.count - 2, middle, jnp.inf),
    )  # fmt: skip


def furthest(path: Path, x: Float[Array, " K"], y: Float[Array, " K"]) -> Int[Array, ""]:
    """F."""

    def nearer(j: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        least, index = carry
        away = jnp.square(path.x[j] - x) + jnp.square(path.y[j] - y)
        closer = (away < least) & (j < path.count)
        return jnp.where(closer, away, least), jnp.where(closer, j, index)

    begin = jnp.full_like(x, jnp.inf), jnp.zeros(x.shape, jnp.int32)
    return jnp.max(jax.lax.fori_loop(0, path.x.shape[0], nearer, begin, unroll=8)[1])


def begin_align(m: Motion) -> Aligned:
    """At the first point."""
    zero = jnp.zeros_like(m.x)
    return Aligned(x=m.x, y=m.y, arc=zero, total=zero, count=zero)


def step_align(ahead: Ahead, carry: Aligned, m: Motion) -> Aligned:
    """At each further point that is looked at."""
    arc = carry.arc + jnp.sqrt(jnp.square(m.x - carry.x) + jnp.square(m.y - carry.y))
    at = grids.once(jnp.searchsorted(ahead.middle, arc, side="right", method="scan_unrolled"))
    read = lambda a: a.at[at].get(mode="promise_in_bounds")  # noqa: E731
    away = jnp.sqrt(jnp.square(read(ahead.path.x) - m.x) + jnp.square(read(ahead.path.y) - m.y))
    free = jnp.where(read(ahead.blocked), 0.0, 1.0)
    return Aligned(x=m.x, y=m.y, arc=arc, total=carry.total + free * away, count=carry.count + free)


def align(params: AlignParams, ahead: Ahead, carry: Aligned, reached: Int[Array, ""]) -> Float[Array, " K"]:
    """Mean distance to the path at equal arc length; `reached` is F."""
    index = jnp.arange(ahead.blocked.shape[0])
    blocked = jnp.sum(jnp.where(ahead.blocked & (index < reached), 1.0, 0.0))
    share = blocked / jnp.maximum(reached, 1).astype(jnp.float32)
    used = (ahead.length >= params.beyond) & (reached >= params.furthest) & ((share <= params.blocked) | (blocked <= 2))
    return jnp.where(used, carry.total / jnp.maximum(carry.count, 1.0), 0.0)


def _beyond(ahead: Ahead, reached: Array, offset: Scalar) -> Array:
    """Index of the point `offset` beyond F, the last at most."""
    return jnp.minimum(reached + jnp.asarray(offset, jnp.int32), ahead.path.count - 1)


def follow(params: FollowParams, ahead: Ahead, m: Motion, reached: Int[Array, ""]) -> Float[Array, " K"]:
    """Distance from the end to the point to drive to."""
    index = jnp.arange(ahead.blocked.shape[0])
    first = _beyond(ahead, reached, params.offset)
    # the search for a free point goes as far as the last but one
    may = (index >= first) & (~ahead.blocked | (index >= ahead.path.count - 2))
    at = jnp.argmax(may)
    away = jnp.sqrt(jnp.square(ahead.path.x[at] - m.x) + jnp.square(ahead.path.y[at] - m.y))
    return jnp.where(ahead.length >= params.beyond, away, 0.0)


def angle(
    params: AngleParams, ahead: Ahead, pose: Float[Array, "3"], m: Motion, reached: Int[Array, ""]
) -> Float[Array, " K"]:
    """How far the end looks away from the point to drive to."""
    at = _beyond(ahead, reached, params.offset)
    x, y = ahead.path.x[at], ahead.path.y[at]
    aside = jnp.abs(geometry.wrap_angle(jnp.arctan2(y - pose[1], x - pose[0]) - pose[2]))
    used = (ahead.length >= params.beyond) & (aside >= params.min_angle)
    dx, dy = x - m.x, y - m.y
    return jnp.where(used, jnp.abs(jnp.arctan2(m.c * dy - m.s * dx, m.c * dx + m.s * dy)), 0.0)
