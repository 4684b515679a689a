"""What the robot believes about its surroundings - occupancy, dead ends, holes and barriers - on one rolling window.

The window is aligned with odom and moves by whole strides of cells, so beliefs are moved and never
blurred; what rolls in is unknown (never seen, log-odds 0, dead-end belief at its prior l_0).
"""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drnav_jax import geometry
from drnav_jax.filter import barrier, dead_end, occupancy
from drnav_jax.filter.barrier import BarrierParams
from drnav_jax.filter.dead_end import DeadEndParams
from drnav_jax.filter.occupancy import OccupancyParams
from drnav_jax.types import Evidence, GridSpec, LocalMap, Scalar


@dataclasses.dataclass(frozen=True)
class FilterSpec:
    """Sizes of the belief.

    Attributes:
        grid: The rolling window.
        num_bearings: Bins of the polar profile that clears cells; at most the number of azimuths
            of the LiDAR, or bins stay empty and clear nothing.
        local_cells: Edge of the square around the robot where surfaces are known to half a cell, and which rollouts may
            use [cells].
    """

    grid: GridSpec = GridSpec()
    num_bearings: int = 180
    local_cells: int = 128

    def __post_init__(self) -> None:
        """Check sizes."""
        if self.num_bearings < 8:
            raise ValueError(f"num_bearings must be >= 8 bins, got {self.num_bearings}.")
        if self.local_cells % 2 or not 8 <= self.local_cells <= min(self.grid.shape):
            raise ValueError(
                f"local_cells must be even and within 8..{min(self.grid.shape)}, got {self.local_cells}."
            )


class FilterParams(NamedTuple):
    """Parameters of the beliefs."""

    occupancy: OccupancyParams = OccupancyParams()
    dead_end: DeadEndParams = DeadEndParams()
    barrier: BarrierParams = BarrierParams()


class FilterState(NamedTuple):
    """The belief on the window."""

    occupancy: Array  # [H, W] log-odds of being occupied [nat]; 0 where never seen
    seen: Array  # [H, W] bool, observed since the window holds the cell
    surface: Array  # [2n, 2n] around the robot: share of a cell's returns in each of its quarters (`occupancy.refine`)
    dead_end: Array  # [H, W] log-odds of being a dead end [nat]
    hole: Array  # [H, W] log-odds of missing ground [nat]; 0 = nothing known
    barrier: Array  # [H, W] log-odds that something unseen by LiDAR stops a robot [nat]; < 0: what it sees does not
    corner: Array  # [2] int32 (row, column) of cell (0, 0) on the odom lattice


@partial(jax.jit, static_argnames="spec")
def init(spec: FilterSpec, params: FilterParams, xy: Float[Array, "2"]) -> FilterState:
    """A belief that knows nothing, on the window around `xy` (odom) [m]."""
    shape = spec.grid.shape
    return FilterState(
        occupancy=jnp.zeros(shape, jnp.float32),
        seen=jnp.zeros(shape, bool),
        surface=jnp.zeros((2 * spec.local_cells,) * 2, jnp.float32),
        dead_end=jnp.full(shape, dead_end.prior_log_odds(params.dead_end)),
        hole=jnp.zeros(shape, jnp.float32),
        barrier=jnp.zeros(shape, jnp.float32),
        corner=geometry.window_corner(xy, spec.grid),
    )


@partial(jax.jit, static_argnames="spec")
def move(spec: FilterSpec, params: FilterParams, state: FilterState, xy: Float[Array, "2"]) -> FilterState:
    """Re-centre the window on `xy` (odom) [m] by whole strides; costs nothing while it stays.

    (Under vmap both branches run: the shift is then paid in every call.)
    """
    corner = geometry.window_corner(xy, spec.grid)
    by = corner - state.corner

    def moved(state: FilterState) -> FilterState:
        return FilterState(
            occupancy=geometry.shift(state.occupancy, by, 0.0),
            seen=geometry.shift(state.seen, by, 0.0),
            surface=geometry.shift(state.surface, 2 * by, 0.0),
            dead_end=geometry.shift(state.dead_end, by, dead_end.prior_log_odds(params.dead_end)),
            hole=geometry.shift(state.hole, by, 0.0),
            barrier=geometry.shift(state.barrier, by, 0.0),
            corner=corner,
        )

    return jax.lax.cond(jnp.any(by != 0), moved, lambda state: state, state)


def local_corner(spec: FilterSpec) -> tuple[int, int]:
    """(row, column) of the window at which the square of `local_cells` begins."""
    h, w = spec.grid.shape
    return (h - spec.local_cells) // 2, (w - spec.local_cells) // 2


def occupied(state: FilterState) -> Bool[Array, "H W"]:
    """Cells that LiDAR returned from, as believed."""
    return state.seen & (state.occupancy > 0)


def closed(params: FilterParams, state: FilterState) -> Bool[Array, "H W"]:
    """Cells that stop a robot: what LiDAR returned from, but for what does not (grass), and what it does not show."""
    return barrier.closed(params.barrier, occupied(state), state.hole, state.barrier)


def obstacles(spec: FilterSpec, params: FilterParams, state: FilterState) -> Bool[Array, "n n"]:
    """What stops a robot around it, on cells of half the map's edge; begins at `local_corner`."""
    n, (top, left) = spec.local_cells, local_corner(spec)
    near = closed(params, state)[top : top + n, left : left + n]
    return occupancy.fine_obstacles(params.occupancy, near, state.surface)


def local_map(spec: FilterSpec, state: FilterState, params: FilterParams | None = None) -> LocalMap:
    """The map as predictors read it; with `params` also what is closed to a robot."""
    return LocalMap(
        occupancy=state.occupancy,
        seen=state.seen,
        origin=geometry.window_origin(state.corner, spec.grid),
        resolution=jnp.asarray(spec.grid.resolution, jnp.float32),
        closed=None if params is None else closed(params, state),
    )


def forget(spec: FilterSpec, state: FilterState, xy: Float[Array, "2"], radius: Scalar) -> FilterState:
    """Forget the obstacles in a square of half edge `radius` [m] around `xy`, as Nav2 clears its costmaps."""
    resolution = spec.grid.resolution
    origin = geometry.window_origin(state.corner, spec.grid)
    x, y = geometry.cell_centres(spec.grid.shape, origin, resolution)
    near = jnp.maximum(jnp.abs(x - xy[0]), jnp.abs(y - xy[1])) <= radius
    n, (top, left) = spec.local_cells, local_corner(spec)
    fine = jnp.repeat(jnp.repeat(near[top : top + n, left : left + n], 2, axis=0), 2, axis=1)
    return state._replace(
        occupancy=jnp.where(near, 0.0, state.occupancy), seen=state.seen & ~near,
        surface=jnp.where(fine, 0.0, state.surface), hole=jnp.where(near, 0.0, state.hole),
        barrier=jnp.where(near, 0.0, state.barrier),
    )  # fmt: skip


@partial(jax.jit, static_argnames="spec")
def observe(
    spec: FilterSpec,
    params: FilterParams,
    state: FilterState,
    pose: Float[Array, "3"],
    points: Float[Array, "P 3"],
    point_valid: Bool[Array, " P"],
) -> tuple[FilterState, Bool[Array, "H W"]]:
    """Move the window to the robot and fold in one LiDAR scan taken there.

    Args:
        spec: Sizes.
        params: Parameters of the belief.
        state: The belief so far.
        pose: Robot pose (x, y, yaw) in odom at the time of the scan.
        points: Scan in base_link, z up from the ground [m].
        point_valid: False for beams that gave no reading.

    Returns:
        The new belief, and which cells this scan has seen.
    """
    state = move(spec, params, state, pose[:2])
    origin = geometry.window_origin(state.corner, spec.grid)
    resolution = spec.grid.resolution
    hit, crossed = occupancy.observed(
        params.occupancy,
        spec.grid.shape,
        origin,
        resolution,
        pose,
        points,
        point_valid,
        spec.num_bearings,
    )
    top, left = local_corner(spec)
    corner = origin + jnp.asarray([left, top], jnp.float32) * resolution
    fine = 2 * spec.local_cells
    returns = occupancy.fine_returns(
        params.occupancy, (fine, fine), corner, resolution / 2, pose, points, point_valid, spec.num_bearings
    )
    surface = occupancy.refine(state.surface, returns)
    belief, seen = occupancy.apply(
        params.occupancy, state.occupancy, state.seen, origin, resolution, pose, hit, crossed
    )
    fell, landed = barrier.fallen(
        params.barrier, params.occupancy.sensor_z, spec.grid.shape, origin, resolution, pose, points, point_valid
    )
    hole = barrier.observe(params.barrier, state.hole, fell, landed)
    return state._replace(occupancy=belief, seen=seen, surface=surface, hole=hole), hit | crossed


@jax.jit
def assimilate(
    params: FilterParams,
    state: FilterState,
    evidence: Evidence,
    visible: Bool[Array, "H W"],
    dt: Scalar,
) -> FilterState:
    """Fold a predictor's evidence into the beliefs about dead ends (eq. 5, `dead_end.update`) and barriers."""
    belief = dead_end.update(params.dead_end, state.dead_end, evidence, visible, dt)
    state = state._replace(dead_end=belief)
    if evidence.blocked is None:
        return state
    return state._replace(barrier=barrier.assimilate(params.barrier, state.barrier, evidence.blocked, occupied(state)))
