"""The goal generator, the tracker and the cost-to-go on a recorded drive."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from drnav_jax import geometry, grids, navigator
from drnav_jax.bench.drive import Drive
from drnav_jax.bench.timing import interleaved
from drnav_jax.planning import costmap, goal_generator, route, tracker
from drnav_jax.planning.goal_generator import GeneratorSpec
from drnav_jax.planning.route import RouteSpec


def plan_times(drive: Drive, repeats: int) -> dict[str, float]:
    """Times [ms] of the goal generator with 4,096 candidates, of the DWA that tracks its goal, and of both (`plan_ms`)."""
    spec, params = drive.spec, drive.params
    generator = GeneratorSpec(num_speeds=16, num_turns=240, num_headings=256)
    seen, state = drive.stops[-1]
    clear, words = jax.jit(navigator.rollout_field, static_argnums=0)(spec, params, state)
    twist, no = jnp.asarray([0.6, 0.4], jnp.float32), jnp.asarray(False)
    hysteresis = jnp.asarray(params.hysteresis, jnp.float32)

    def generate() -> jax.Array:
        return goal_generator.generate(
            generator, params.score, params.robot, words, seen.pose, twist, seen.goal, state.local_goal, hysteresis
        ).xy

    def track(target: jax.Array) -> tracker.Track:
        return tracker.track(spec.tracker, params.tracker, params.robot, clear, seen.pose, twist, target, no)

    last = generate()
    spent = interleaved([generate, lambda: track(last), lambda: track(generate())], repeats)
    return dict(zip(("generator", "tracker", "both"), (1e3 * s for s in spent), strict=True))


def serpentine(size: int = 256, pitch: int = 20, gap: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """Cell costs and values to start from of a way that turns back at every wall: the most rounds for the fewest cells."""
    cost, initial = np.ones((size, size), np.float32), np.full((size, size), grids.UNREACHABLE, np.float32)
    for k, row in enumerate(range(pitch, size - pitch // 2, pitch)):
        cost[row : row + 2, slice(0, size - gap) if k % 2 else slice(gap, size)] = grids.UNREACHABLE
    initial[0, 0] = 0.0
    return cost, initial


def route_times(drive: Drive, repeats: int) -> dict[str, float]:
    """Cost-to-go of the window of a drive: times [ms], and what coarser cells change.

    Returns:
        `window`: the route as the navigator solves it (`RouteSpec.pooling`), `full`: on the map's own cells, both with all
        that makes the costs; `serpentine`: the bare solver, 256x256 cells, where sweeping is at its worst. `median_error`
        and `p95_error` of `window` relative to `full`, on cells from which both find a way.
    """
    spec, params, cell = drive.spec, drive.params, drive.spec.filter.grid.resolution
    seen, state = drive.stops[-1]
    window = geometry.window_origin(state.belief.corner, spec.filter.grid)
    local = navigator.belief.local_map(spec.filter, state.belief)
    clear = costmap.clearance(local.seen & (local.occupancy > 0), cell)
    rows, cols = spec.filter.grid.shape

    def solve(how: RouteSpec) -> jax.Array:
        beyond = jnp.zeros((rows // how.pooling, cols // how.pooling), jnp.float32)  # no more than the straight distance
        return route.solve(
            how, params.route, clear, state.risk, state.recovery.visits, window, cell, seen.pose[:2], seen.goal,
            params.robot, jnp.asarray(False), beyond,
        ).value  # fmt: skip

    ways = (spec.route, RouteSpec(pooling=1, max_iterations=spec.route.max_iterations))
    cost, initial = jax.tree.map(jnp.asarray, serpentine())
    turning = lambda: grids.cost_to_go(cost, initial, resolution=cell)  # noqa: E731
    spent = interleaved([*(functools.partial(solve, how) for how in ways), turning], repeats)
    coarse, fine = (np.asarray(solve(how), float) for how in ways)
    both = (np.maximum(coarse, fine) < 0.5 * grids.UNREACHABLE) & (fine > 1.0)
    error = np.abs(coarse[both] / fine[both] - 1.0)
    return {
        **dict(zip(("window", "full", "serpentine"), (1e3 * s for s in spent), strict=True)),
        "median_error": float(np.median(error)), "p95_error": float(np.percentile(error, 95)),
    }  # fmt: skip
