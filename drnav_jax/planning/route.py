"""Cost-to-go over the rolling window: where the goal is by way, not by air.

Optimistic (unknown = free), on cells `pooling` times as coarse as the map's. A cell's cost per metre is

    1 + w_o ((d_soft - d) / (d_soft - d_block))_+^2 + min(risk_weight * risk, risk_cap) + w_v visits

with the clearance term of J_geom (`scoring`), so that the value falls along a good path at least as fast as the path's own
cost grows. Thus the predicted dead ends are inside the value and not a force against it; risk stays bounded, because the
only way may look like a dead end. Edge cells of the window are worth what `memory` says of the world beyond, at least
their straight distance to the goal.
"""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drnav_jax import geometry, grids
from drnav_jax.planning import costmap
from drnav_jax.types import GridMap, RobotParams, Scalar


@dataclasses.dataclass(frozen=True)
class RouteSpec:
    """Resolution of the solve.

    Attributes:
        pooling: Map cells per cell of the route, along each axis.
        max_iterations: Bound on the solver's sweeps.
    """

    pooling: int = 2
    max_iterations: int = 1000

    def __post_init__(self) -> None:
        """Check sizes."""
        if self.pooling < 1 or self.max_iterations < 1:
            raise ValueError(f"pooling and max_iterations must be >= 1, got {self.pooling}, {self.max_iterations}.")


class RouteParams(NamedTuple):
    """What the route costs."""

    closed_margin: Scalar = 0.06  # [] beyond the radius: cells with less clearance are closed [m]
    squeeze_margin: Scalar = 0.04  # [] the same, once no way was found at `closed_margin` [m]
    clearance: Scalar = 1.0  # [] w_o
    soft_clearance: Scalar = 0.4  # [] beyond the radius: where the clearance term begins [m]
    risk_weight: Scalar = 3.0  # [] lambda inside the cell cost
    risk_cap: Scalar = 4.0  # [] most that risk adds to a metre
    visit_weight: Scalar = 4.0  # [] w_v
    escape_radius: Scalar = 0.6  # [] a robot that stands on a closed cell may pass such this near [m]


class Route(NamedTuple):
    """The value-to-go and whether it exists where the robot is."""

    value: Float[Array, "H W"]  # [m] on the map's cells; `UNREACHABLE` where there is no way
    reachable: Bool[Array, ""]  # the robot has a way (possibly out of the window) to the goal
    coarse: Float[Array, "h w"]  # the value on the route's own cells [m]
    cost: Float[Array, "h w"]  # what leaving each of them costs per metre
    east: Bool[Array, "h w"]  # one can pass to the cell at higher x
    north: Bool[Array, "h w"]  # one can pass to the cell at higher y


def _spread(value: Array, by: int) -> Array:
    """Coarse values on the fine cells: bilinear where all neighbours are reachable, else the cell's own."""
    own = grids.repeat(value, by)
    h, w = value.shape
    padded = jnp.pad(value, 1, mode="edge")
    out = jnp.zeros_like(own).reshape(h, by, w, by)
    for i in range(by):
        for j in range(by):
            di, dj = (i + 0.5) / by - 0.5, (j + 0.5) / by - 0.5
            a, b = (1 if di > 0 else -1), (1 if dj > 0 else -1)
            u, v = abs(di), abs(dj)
            near_i, near_j = padded[1 + a : 1 + a + h, 1:-1], padded[1:-1, 1 + b : 1 + b + w]
            near_ij = padded[1 + a : 1 + a + h, 1 + b : 1 + b + w]
            mixed = (1 - u) * ((1 - v) * value + v * near_j) + u * ((1 - v) * near_i + v * near_ij)
            worst = jnp.maximum(jnp.maximum(near_i, near_j), near_ij)
            out = out.at[:, i, :, j].set(jnp.where(worst < 0.5 * grids.UNREACHABLE, mixed, value))
    return jnp.where(own < 0.5 * grids.UNREACHABLE, out.reshape(own.shape), grids.UNREACHABLE)


@partial(jax.jit, static_argnames=("spec", "resolution"))
def solve(
    spec: RouteSpec,
    params: RouteParams,
    clear: Float[Array, "H W"],
    risk: Float[Array, "H W"],
    visits: Float[Array, "H W"],
    origin: Float[Array, "2"],
    resolution: float,
    xy: Float[Array, "2"],
    goal: Float[Array, "2"],
    robot: RobotParams,
    squeeze: Bool[Array, ""],
    beyond: Float[Array, "h w"],
) -> Route:
    """The optimistic cost-to-go on the window (module docstring).

    Args:
        spec: Resolution of the solve.
        params: Costs.
        clear: Clearance of each map cell [m]; unknown cells count as free.
        risk: Dead-end risk of each map cell, 0..1 (all 0: plain cost-to-go).
        visits: Where the robot got stuck before, 0..1.
        origin: Odom position of the window's outer corner [m].
        resolution: Edge of a map cell [m].
        xy: Robot [m].
        goal: Where to go [m].
        robot: Its radius.
        squeeze: Use `squeeze_margin`.
        beyond: What leaving the window there is worth [m], on the route's cells; only its edge is read, and never below
            the straight distance to the goal.
    """
    by, size = spec.pooling, resolution * spec.pooling
    rows, cols = clear.shape
    x, y = geometry.cell_centres((rows, cols), origin, resolution)
    near = jnp.hypot(x - xy[0], y - xy[1]) < params.escape_radius
    # closed, unless the robot stands there already or the goal is there
    at_goal = jnp.hypot(x - goal[0], y - goal[1]) <= 1.5 * size
    closed = robot.radius + jnp.where(squeeze, params.squeeze_margin, params.closed_margin)
    here = geometry.sample_nearest(GridMap(clear, origin, resolution), xy)
    leave = near & (here < closed) & (clear >= here - resolution)
    free = grids.once((clear >= closed) | leave | (at_goal & (clear > 0.5 * robot.radius)))
    east, north = costmap.sides(free, by)
    clear, risk, visits = (grids.pool(a, by, "mean") for a in (clear, risk, visits))
    h, w = clear.shape
    x, y = geometry.cell_centres((h, w), origin, size)
    to_goal, to_robot = jnp.hypot(x - goal[0], y - goal[1]), jnp.hypot(x - xy[0], y - xy[1])
    slope = 1.0 / jnp.maximum(params.soft_clearance - params.closed_margin, 1e-3)
    lack = jnp.maximum((robot.radius + params.soft_clearance - clear) * slope, 0.0)
    cost = (
        1.0
        + params.clearance * lack * lack
        + jnp.minimum(params.risk_weight * risk, params.risk_cap)
        + params.visit_weight * visits
    )
    cost = jnp.where(grids.pool(free, by, "any"), cost, grids.UNREACHABLE)
    row, col = jnp.arange(h)[:, None], jnp.arange(w)[None, :]
    edge = (row == 0) | (row == h - 1) | (col == 0) | (col == w - 1)
    held = geometry.inside(geometry.cell_of(goal, origin, size), (h, w))
    far = jnp.where(edge, jnp.maximum(beyond, to_goal), grids.UNREACHABLE)
    initial = jnp.where(held & (to_goal <= 1.5 * size), to_goal, far)
    initial = jnp.where(cost < grids.UNREACHABLE, initial, grids.UNREACHABLE)
    value = grids.cost_to_go(
        cost, initial, resolution=size, east=east, north=north, max_iterations=spec.max_iterations
    )
    nearby = jnp.where(to_robot < 2.0 * size, value, grids.UNREACHABLE)
    return Route(
        value=_spread(value, by), reachable=jnp.min(nearby) < 0.5 * grids.UNREACHABLE, coarse=value, cost=cost, east=east,
        north=north,
    )  # fmt: skip


def straight(
    shape: tuple[int, int], origin: Float[Array, "2"], resolution: float, goal: Float[Array, "2"]
) -> Float[Array, "H W"]:
    """The paper's progress: straight distance [m] from every cell to the goal."""
    x, y = geometry.cell_centres(shape, origin, resolution)
    return jnp.hypot(x - goal[0], y - goal[1])
