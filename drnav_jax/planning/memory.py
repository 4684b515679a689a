"""What the route remembers beyond the rolling window: where one could pass, on a far coarser and larger grid.

The filter forgets what rolls out of its window. A route that forgot it as well would believe that a way continues beyond
the window's edge which the robot has already seen to end there, drive back to it, and swing between two such ways for
ever. So the window's passable cells are kept, `pooling` map cells to one, over a square of `cells` around the robot:
open if any of its cells is, joined to a neighbour only where map cells join (`route`). Unknown = free. The value-to-go on
that grid says what leaving the window at each of its edge cells is worth.
"""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drnav_jax import geometry, grids
from drnav_jax.planning import costmap
from drnav_jax.types import GridSpec


@dataclasses.dataclass(frozen=True)
class MemorySpec:
    """Size of the memory.

    Attributes:
        cells: Edge of the square [cells]; even.
        pooling: Map cells per cell, along each axis.
        solve_every: Replans between two solves of the value.
    """

    cells: int = 128
    pooling: int = 4
    solve_every: int = 4

    def __post_init__(self) -> None:
        """Check sizes."""
        if self.cells < 2 or self.cells % 2 or self.pooling < 1 or self.solve_every < 1:
            raise ValueError(f"cells must be even and all sizes >= 1, got {self}.")


class MemoryState(NamedTuple):
    """The coarse map, centred like the window."""

    free: Array  # [M, M] bool, unknown counts as free
    east: Array  # [M, M] bool, joined to the cell at higher x
    north: Array  # [M, M] bool, joined to the cell at higher y
    value: Array  # [M, M] value-to-go [m]
    age: Array  # [] int32, replans since the value was solved
    goal: Array  # [2] for which it was solved [m]


def init(spec: MemorySpec) -> MemoryState:
    """Nothing known: all free."""
    free = jnp.ones((spec.cells, spec.cells), bool)
    zero = jnp.zeros(free.shape, jnp.float32)
    return MemoryState(free, free, free, zero, jnp.zeros((), jnp.int32), jnp.full(2, grids.UNREACHABLE, jnp.float32))


def check(spec: MemorySpec, grid: GridSpec, pooling: int) -> None:
    """Raise a ValueError if the memory does not fit around the window, or a route `pooling` map cells wide into it."""
    if spec.pooling % pooling:
        raise ValueError(f"memory pooling {spec.pooling} must be a multiple of the route's, {pooling}.")
    if grid.stride % spec.pooling or any(n % (2 * spec.pooling) for n in grid.shape):
        raise ValueError(
            f"memory pooling {spec.pooling} must divide the window's stride {grid.stride} and half its shape {grid.shape}."
        )
    if max(grid.shape) > spec.cells * spec.pooling:
        raise ValueError(f"the memory of {spec.cells} x {spec.pooling} map cells is smaller than the window {grid.shape}.")


def shift(spec: MemorySpec, state: MemoryState, by: Int[Array, "2"]) -> MemoryState:
    """Follow the window by `by` map cells (row, column); what comes in is unknown."""
    by = by // spec.pooling
    move = lambda a, fill: geometry.shift(a, by, fill)  # noqa: E731
    return MemoryState(
        free=move(state.free, True), east=move(state.east, True), north=move(state.north, True),
        value=move(state.value, grids.UNREACHABLE), age=state.age + spec.solve_every, goal=state.goal,
    )  # fmt: skip


@partial(jax.jit, static_argnames=("spec", "resolution"))
def update(
    spec: MemorySpec,
    state: MemoryState,
    free: Bool[Array, "H W"],
    origin: Float[Array, "2"],
    resolution: float,
    goal: Float[Array, "2"],
) -> MemoryState:
    """Write the window into the memory and, when due or for a new goal, solve for the value-to-go.

    Args:
        spec: Sizes.
        state: So far, centred like the window.
        free: Map cells of the window where the robot may be; unknown = free.
        origin: Odom position of the window's outer corner [m].
        resolution: Edge of a map cell [m].
        goal: Where to go in odom [m].
    """
    by, m = spec.pooling, spec.cells
    h, w = free.shape
    east, north = costmap.sides(free, by)
    corner = ((m - h // by) // 2, (m - w // by) // 2)
    put = lambda whole, part: jax.lax.dynamic_update_slice(whole, part, corner)  # noqa: E731
    # sides at the window's rim look out of it: what was known of them stays
    rim_east = (jnp.arange(w // by) == w // by - 1)[None, :]
    rim_north = (jnp.arange(h // by) == h // by - 1)[:, None]
    old = jax.lax.dynamic_slice(state.east, corner, east.shape), jax.lax.dynamic_slice(state.north, corner, north.shape)
    kept = MemoryState(
        free=put(state.free, grids.pool(free, by, "any")),
        east=put(state.east, jnp.where(rim_east, old[0], east)),
        north=put(state.north, jnp.where(rim_north, old[1], north)),
        value=state.value,
        age=state.age + 1,
        goal=state.goal,
    )
    size = resolution * by
    begin = origin - jnp.asarray([corner[1], corner[0]], jnp.float32) * size

    def solve() -> tuple[Array, Array]:
        x, y = geometry.cell_centres((m, m), begin, size)
        away = jnp.hypot(x - goal[0], y - goal[1])
        cost = jnp.where(kept.free | (away < size), 1.0, grids.UNREACHABLE)
        index = jnp.arange(m)
        rim = (index == 0) | (index == m - 1)
        held = geometry.inside(geometry.cell_of(goal, begin, size), (m, m))
        seeds = jnp.where(held, away < size, rim[:, None] | rim[None, :])
        initial = jnp.where(seeds & (cost < grids.UNREACHABLE), away, grids.UNREACHABLE)
        value = grids.cost_to_go(cost, initial, resolution=size, east=kept.east, north=kept.north)
        return value, jnp.zeros((), jnp.int32)

    due = (kept.age >= spec.solve_every) | jnp.any(goal != state.goal)  # at first it is solved for no goal
    value, age = jax.lax.cond(due, solve, lambda: (kept.value, kept.age))
    return kept._replace(value=value, age=age, goal=jnp.where(due, goal, state.goal))


def beyond(spec: MemorySpec, state: MemoryState, shape: tuple[int, int], pooling: int) -> Float[Array, "h w"]:
    """The memory's value on the cells of a route `pooling` map cells wide, for a window of `shape` map cells."""
    h, w = shape
    by = spec.pooling
    corner = ((spec.cells - h // by) // 2, (spec.cells - w // by) // 2)
    part = jax.lax.dynamic_slice(state.value, corner, (h // by, w // by))
    return grids.repeat(part, by // pooling)
