"""Which recovery point to go back to. Every term is in metres of driving, so a weight says what a thing is worth.

    worth(i) = w_n n_i + w_d min(d_i, d_max) - w_l W_i - w_g V_i - w_a age_i - w_v visits_i                              (1)
    W_i      = min over ways from the robot to i:  w_t |turn before driving off| + sum c(cell) ds                        (2)

n_i is the point's number of open directions (`filter.recovery`), d_i its clearance, V_i the route's value from there to
the goal: length, and exposure to predicted dead ends at its price. W_i leads over known free cells only, each at the
route's cost per metre (1, closeness to obstacles, risk, visits); together with the turning it is what the way takes of a
robot's energy on level ground. A point to which there is no such way is none, nor is one nearer than `least_distance`.

So the point of the most worth is open, near, easy to get to and on the way to the goal, seen lately, and not where the
robot got stuck. The paper (section IV-D) goes back to "the best-ranked" point; the ranking is its future work.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drnav_jax import geometry, grids
from drnav_jax.types import GridMap, Scalar


class RefugeParams(NamedTuple):
    """Weights of (1) and (2)."""

    openness: Scalar = 1.0  # [] w_n, of one open direction [m]
    clearance: Scalar = 1.0  # [] w_d []
    clearance_max: Scalar = 1.0  # [] d_max [m]
    way: Scalar = 1.0  # [] w_l []
    turning: Scalar = 0.3  # [] w_t [m/rad]
    onward: Scalar = 0.5  # [] w_g []
    age: Scalar = 0.02  # [] w_a [m/s]
    visits: Scalar = 10.0  # [] w_v [m]
    least_distance: Scalar = 1.0  # [] nearer points are no retreat [m]


class Refuge(NamedTuple):
    """The choice."""

    xy: Float[Array, "2"]  # in odom [m]; the robot's own place if there is none
    found: Bool[Array, ""]
    worth: Float[Array, " M"]  # (1) of every point; -inf for those that are none


def ways(
    params: RefugeParams, cost: Float[Array, "h w"], east: Bool[Array, "h w"], north: Bool[Array, "h w"],
    free: Bool[Array, "h w"], origin: Float[Array, "2"], resolution: float, pose: Float[Array, "3"],
) -> Float[Array, "h w"]:  # fmt: skip
    """Equation (2) for every cell [m]; `grids.UNREACHABLE` where no known way leads.

    Args:
        params: Weight of turning.
        cost: What a metre costs on each of the route's cells (`route.Route`).
        east: One can pass to the cell at higher x.
        north: One can pass to the cell at higher y.
        free: Known to be free.
        origin: Odom position of the cells' outer corner [m].
        resolution: Edge of a cell [m].
        pose: Robot.
    """
    h, w = cost.shape
    x, y = geometry.cell_centres((h, w), origin, resolution)
    dx, dy = x - pose[0], y - pose[1]
    away = jnp.hypot(dx, dy)
    begin = away <= 2.0 * resolution
    turn = jnp.abs(geometry.wrap_angle(jnp.arctan2(dy, dx) - pose[2]))
    own = away <= 0.75 * resolution  # there is no direction to where one stands
    seed = away + jnp.where(own, jnp.inf, params.turning * turn)
    open_cells = (free | begin) & (cost < grids.UNREACHABLE)
    initial = jnp.where(begin & open_cells, jnp.minimum(seed, grids.UNREACHABLE), grids.UNREACHABLE)
    passable = jnp.where(open_cells & ~own, cost, grids.UNREACHABLE)
    return grids.cost_to_go(passable, initial, resolution=resolution, east=east, north=north)


def choose(
    params: RefugeParams,
    points: Float[Array, "M 2"],
    rank: Float[Array, " M"],
    age: Float[Array, " M"],
    valid: Bool[Array, " M"],
    way: GridMap,
    onward: GridMap,
    clear: GridMap,
    visits: GridMap,
    xy: Float[Array, "2"],
) -> Refuge:
    """The recovery point of the most worth, equation (1).

    Args:
        params: Weights.
        points: Recovery points in odom [m].
        rank: Their numbers of open directions.
        age: Time since each was seen [s].
        valid: Which of them exist.
        way: From `ways` [m].
        onward: Value-to-go to the goal [m].
        clear: Clearance [m].
        visits: Where the robot got stuck, 0..1.
        xy: Robot [m].
    """
    at = lambda field, fill: geometry.sample_nearest(field, points, fill=fill)  # noqa: E731
    there, on = at(way, grids.UNREACHABLE), at(onward, grids.UNREACHABLE)
    worth = (
        params.openness * rank
        + params.clearance * jnp.minimum(at(clear, 0.0), params.clearance_max)
        - params.way * there
        - params.onward * jnp.minimum(on, grids.UNREACHABLE)
        - params.age * age
        - params.visits * at(visits, 0.0)
    )
    far = jnp.hypot(points[:, 0] - xy[0], points[:, 1] - xy[1]) > params.least_distance
    worth = jnp.where(valid & far & (there < 0.5 * grids.UNREACHABLE), worth, -jnp.inf)
    best = jnp.argmax(worth)
    found = jnp.isfinite(worth[best])
    return Refuge(xy=jnp.where(found, points[best], xy), found=found, worth=worth)
