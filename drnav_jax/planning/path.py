"""Paths that controllers follow: at most N points of even spacing, padded by their last point.

    arc_0 = 0,  arc_i = arc_{i-1} + |p_i - p_{i-1}|

As in Nav2, a controller sees the part of the path ahead of the robot: from the point nearest to it, `reach` metres on.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drnav_jax import geometry, grids
from drnav_jax.planning.route import Route
from drnav_jax.types import Scalar


class Path(NamedTuple):
    """Points of a path; those from `count` on repeat the last."""

    x: Array  # [N] [m]
    y: Array  # [N] [m]
    count: Array  # [] int32, points in use, >= 1


def lengths(path: Path) -> Float[Array, " N"]:
    """Arc length [m] at each point; constant beyond the last."""
    step = jnp.sqrt(jnp.square(path.x[1:] - path.x[:-1]) + jnp.square(path.y[1:] - path.y[:-1]))
    return jnp.concatenate([jnp.zeros(1, jnp.float32), jnp.cumsum(step)])


def end(path: Path) -> Float[Array, "2"]:
    """The last point [m]."""
    return jnp.stack([path.x[-1], path.y[-1]])


@partial(jax.jit, static_argnames="num_points")
def straight(start: Float[Array, "2"], goal: Float[Array, "2"], *, spacing: Scalar, num_points: int) -> Path:
    """The straight line from start to goal, as far as `num_points` reach."""
    away = goal - start
    length = jnp.sqrt(jnp.sum(jnp.square(away)))
    along = jnp.minimum(jnp.arange(num_points, dtype=jnp.float32) * spacing, length)
    share = along / jnp.maximum(length, 1e-6)
    count = jnp.clip(jnp.ceil(length / spacing - 1e-3) + 1, 1, num_points).astype(jnp.int32)
    return _padded(Path(x=start[0] + share * away[0], y=start[1] + share * away[1], count=count))


def _padded(path: Path) -> Path:
    last = path.count - 1
    used = jnp.arange(path.x.shape[0]) <= last
    return path._replace(x=jnp.where(used, path.x, path.x[last]), y=jnp.where(used, path.y, path.y[last]))


@partial(jax.jit, static_argnames=("num_points", "smoothing"))
def resample(
    points: Float[Array, "M 2"], valid: Bool[Array, " M"], *, spacing: Scalar, num_points: int, smoothing: int = 0
) -> Path:
    """Even points along a polyline.

    Args:
        points: Its corners [m].
        valid: Which of them exist, a prefix; at least the first.
        spacing: Of the points of the path, along the polyline [m].
        num_points: N; what lies beyond is cut off.
        smoothing: Each point becomes the mean of those at most this many before and after it (fewer towards the ends,
            which stay), as a grid planner's corners are smoothed before they are driven.
    """
    count = jnp.maximum(jnp.sum(valid.astype(jnp.int32)), 1)
    corners = _padded(Path(points[:, 0], points[:, 1], count))
    arc = lengths(corners)
    along = jnp.minimum(jnp.arange(num_points, dtype=jnp.float32) * spacing, arc[-1])
    x, y = jnp.interp(along, arc, corners.x), jnp.interp(along, arc, corners.y)
    used = jnp.clip(jnp.ceil(arc[-1] / spacing - 1e-3) + 1, 1, num_points).astype(jnp.int32)
    path = _padded(Path(x, y, used))
    if not smoothing:
        return path
    index = jnp.arange(num_points)
    reach = jnp.clip(jnp.minimum(index, path.count - 1 - index), 0, smoothing)
    offset = index[None, :] - index[:, None]
    weight = jnp.where(jnp.abs(offset) <= reach[:, None], 1.0, 0.0) / (2 * reach[:, None] + 1).astype(jnp.float32)
    return _padded(path._replace(x=weight @ path.x, y=weight @ path.y))


@partial(jax.jit, static_argnames=("num_moves", "num_points", "smoothing"))
def down(
    route: Route,
    origin: Float[Array, "2"],
    size: Scalar,
    xy: Float[Array, "2"],
    goal: Float[Array, "2"],
    *,
    num_moves: int,
    spacing: Scalar,
    num_points: int,
    smoothing: int,
) -> Path:
    """The path from a robot down the cost-to-go.

    Args:
        route: As solved.
        origin: Outer corner of its cell (0, 0) [m].
        size: Edge of its cells [m].
        xy: Robot [m].
        goal: Where it leads to [m].
        num_moves: Cells that it goes down at most.
        spacing: Of its points [m].
        num_points: N.
        smoothing: As in `resample`.
    """
    h, w = route.coarse.shape
    x, y = geometry.cell_centres((h, w), origin, size)
    away = jnp.hypot(x - xy[0], y - xy[1])
    # a robot that stands on a closed cell begins on the best of those beside it
    own = jnp.clip(geometry.cell_of(xy, origin, size), 0, jnp.asarray([h - 1, w - 1], jnp.int32))
    best = jnp.argmin(jnp.where(away < 2.0 * size, route.coarse + away, 2.0 * grids.UNREACHABLE))
    other = jnp.stack([best // w, best % w]).astype(jnp.int32)
    first = jnp.where(route.coarse[own[0], own[1]] < 0.5 * grids.UNREACHABLE, own, other)
    cells, moved = grids.descend(
        route.coarse, first, route.cost, resolution=size, num_steps=num_moves, east=route.east, north=route.north
    )
    centres = geometry.centre_of(cells, origin, size)
    count = jnp.sum(moved.astype(jnp.int32))
    last = jnp.where(count > 0, centres[jnp.maximum(count - 1, 0)], xy)
    there = jnp.hypot(last[0] - goal[0], last[1] - goal[1]) <= 2.0 * size
    points = jnp.concatenate([xy[None], centres, xy[None]])
    points = points.at[count + 1].set(jnp.where(there, goal, points[count + 1]))
    valid = jnp.arange(points.shape[0]) < count + 1 + there.astype(jnp.int32)
    return resample(points, valid, spacing=spacing, num_points=num_points, smoothing=smoothing)


@partial(jax.jit, static_argnames="num_points")
def ahead(path: Path, xy: Float[Array, "2"], reach: Scalar, *, num_points: int) -> Path:
    """What lies before a robot: from the point nearest to it, as far as `reach` [m] along the path.

    Args:
        path: The whole path.
        xy: Robot [m].
        reach: Nav2's prune distance [m].
        num_points: N of the result.
    """
    size = path.x.shape[0]
    index = jnp.arange(size)
    away = jnp.square(path.x - xy[0]) + jnp.square(path.y - xy[1])
    first = jnp.argmin(jnp.where(index < path.count, away, jnp.inf))
    arc = lengths(path)
    last = jnp.sum((arc - arc[first] <= reach) & (index < path.count)) - 1
    count = jnp.clip(last - first + 1, 1, num_points).astype(jnp.int32)
    take = jnp.minimum(first + jnp.arange(num_points), size - 1)
    return _padded(Path(path.x[take], path.y[take], count))
