"""The planner on a recorded drive: its whole tick, its parts, and how they grow with what they are given.

Scores, plans and routes are timed in the fields and at the places of one drive, in turn within one run. One program of
XLA's runs the kernel on one thread of a CPU; where threads share the candidates, the result says how many.
"""

import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from drnav_jax import evaluate, geometry, grids, navigator, worlds
from drnav_jax.bench_sensors import interleaved
from drnav_jax.evaluate import Setup
from drnav_jax.navigator import NavParams, NavSpec, NavState
from drnav_jax.planning import costmap, goal_generator, route, scoring, tracker
from drnav_jax.planning.goal_generator import GeneratorSpec
from drnav_jax.planning.route import RouteSpec
from drnav_jax.sim import LidarParams, LidarSpec, kinematic, scan
from drnav_jax.types import GridMap, Observation, empty_observation

DRIVE = "t"  # family whose world is driven for the recording: corridors, a fork, a dead end
STRIDE = 20  # ticks of the drive between two places at which candidates are scored
NUM_STEPS = 56  # T of the scoring
THREADS = {4096: 1, 65536: 2}  # that share so many candidates
COUNTS, LENGTHS = (1024, 4096, 16384, 65536), (14, 28, 56, 112)  # K and T of the scaling


class Drive(NamedTuple):
    """A recorded drive: what the robot was, what it sensed at each tick, and what it knew then, now and again."""

    spec: NavSpec
    params: NavParams
    begin: NavState
    observations: list[Observation]
    stops: list[tuple[Observation, NavState]]  # every `STRIDE` ticks


def record(num_ticks: int, num_candidates: int = 4096, seed: int = 0) -> Drive:
    """Drive through a world of `DRIVE` in closed loop and keep what was sensed.

    Args:
        num_ticks: Ticks to drive; it ends sooner if the robot arrives.
        num_candidates: Candidates of the goal generator.
        seed: Of the world and of the sensor's noise.
    """
    scene = worlds.sample(DRIVE, seed)
    assert scene.start is not None and scene.goal is not None
    setup = Setup(num_candidates=num_candidates, seed=seed)
    spec = setup.nav
    params = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), evaluate.params_of(setup))
    lidar, beams = LidarParams(max_range=setup.lidar_range), LidarSpec()
    pose, twist = jnp.asarray(scene.start, jnp.float32), jnp.zeros(2, jnp.float32)
    goal = jnp.asarray(scene.goal, jnp.float32)
    keys = jax.random.split(jax.random.key(seed), num_ticks)
    state = begin = navigator.init(spec, params, pose)
    observations, stops = [], []
    for k in range(num_ticks):
        points, valid = scan(beams, lidar, scene.world, pose, keys[k])
        seen = empty_observation(points.shape[0])._replace(
            points=points, point_valid=valid, pose=pose, twist=twist, goal=goal
        )
        observations.append(seen)
        state, command, info = navigator.step(spec, params, state, seen, keys[k], replan=k % spec.replan_every == 0)
        if k % STRIDE == STRIDE - 1:
            stops.append((seen, state))
        if info.arrived:
            break
        pose, twist = kinematic.step(params.robot, pose, twist, command, spec.dt)
    return Drive(spec, params, begin, observations, stops)


def tick_times(drive: Drive, warm_up: int = 20) -> dict[str, float]:
    """Times [ms] of `navigator.step` on a recorded drive, ticks that replan included; the state is carried along.

    Args:
        drive: From `record`.
        warm_up: First ticks that do not count.
    """
    state, key, every = drive.begin, jax.random.key(0), drive.spec.replan_every
    spent = []
    for k, seen in enumerate(drive.observations):
        begin = time.perf_counter()
        state, command, _ = navigator.step(drive.spec, drive.params, state, seen, key, replan=k % every == 0)
        jax.block_until_ready((state, command))
        spent.append(1e3 * (time.perf_counter() - begin))
    counted, replans = np.asarray(spent[warm_up:]), np.arange(warm_up, len(spent)) % every == 0
    return {
        "median": float(np.median(counted)),
        "p95": float(np.percentile(counted, 95)),
        "max": float(np.max(counted)),
        "replan_median": float(np.median(counted[replans])),
        "replan_p95": float(np.percentile(counted[replans], 95)),
        "ticks": len(counted),
    }


def _candidates(params: NavParams, seen: Observation, state: NavState, num: int) -> scoring.Candidates:
    """`num` candidates of a moving robot at a stop of a drive."""
    speeds = 16 if num <= 4096 else 64
    spec = GeneratorSpec(num_speeds=speeds, num_turns=(num - 256) // speeds, num_headings=256)
    twist = jnp.asarray([0.6, 0.4], jnp.float32)
    return goal_generator.candidates(
        spec, params.score, params.robot, seen.pose, twist, seen.goal, state.local_goal, params.hysteresis
    )


def _read(layers: tuple[GridMap, GridMap, GridMap], at: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, ...]:
    xy = jnp.stack(at, axis=-1)
    clear, risk, value = layers
    # beside closed cells nothing can be interpolated
    smooth, own = geometry.sample_bilinear(value, xy), geometry.sample_nearest(value, xy)
    return (
        geometry.sample_bilinear(clear, xy), geometry.sample_bilinear(risk, xy),
        jnp.where(jnp.abs(smooth - own) < 2 * value.resolution, smooth, own),
    )  # fmt: skip


# what `scoring.PACKED` reads, but from float layers and between the cells' centres
BILINEAR = scoring.Reader(lambda layers: (jnp.zeros(2, jnp.float32), 1.0), lambda layers, x, y: (x, y), _read)


def scoring_times(drive: Drive, repeats: int) -> tuple[dict[str, float], dict[str, float], float]:
    """Candidate-steps per second of `scoring.score`, its error, and the time of the reference matmul [ms].

    T = `NUM_STEPS` steps of 0.1 s, risk and obstacle cost, limited in acceleration from a moving state, in the field
    that the navigator makes. The error is that of nearest packed look-ups against bilinear look-ups in float, over all
    stops of the drive.
    """
    params = drive.params.score._replace(horizon=jnp.asarray(0.1 * NUM_STEPS, jnp.float32))
    field_of = jax.jit(navigator.rollout_field, static_argnums=0)
    cell = drive.spec.filter.grid.resolution

    def score(field: Any, chosen: scoring.Candidates, **how: Any) -> scoring.Scores:
        return scoring.score(field, chosen, params, drive.params.robot, dt=0.1, num_steps=NUM_STEPS, **how)

    pairs = []
    for seen, state in drive.stops:
        clear, words = field_of(drive.spec, drive.params, state)
        window = geometry.window_origin(state.belief.corner, drive.spec.filter.grid)
        value = GridMap(costmap.unpack(state.plan)[2], window, cell)
        chosen = _candidates(drive.params, seen, state, 4096)
        smooth = score((clear, GridMap(state.risk, window, cell), value), chosen, reader=BILINEAR)
        pairs.append((np.asarray(score(words, chosen).score, float), np.asarray(smooth.score, float)))

    words = field_of(drive.spec, drive.params, drive.stops[0][1])[1]
    square = jax.random.normal(jax.random.key(0), (1024, 1024), jnp.float32)
    matmul = jax.jit(lambda a: a @ a)
    calls = [_scorer(words, _candidates(drive.params, *drive.stops[0], n), params, drive.params, n) for n in THREADS]
    *seconds, reference = interleaved([*calls, lambda: matmul(square)], repeats)
    rates = {str(n): n * NUM_STEPS / s for n, s in zip(THREADS, seconds, strict=True)}
    return rates, _difference(pairs), 1e3 * reference


def _scorer(
    words: GridMap, chosen: scoring.Candidates, weights: scoring.ScoreParams, params: NavParams, num: int
) -> Callable[[], scoring.Scores]:
    """Scores `num` candidates on as many threads as they get."""
    workers = THREADS[num]
    score = scoring.score if workers == 1 else functools.partial(scoring.score_on_threads, workers=workers)
    return lambda: score(words, chosen, weights, params.robot, dt=0.1, num_steps=NUM_STEPS)


def _difference(pairs: list[tuple[np.ndarray, np.ndarray]]) -> dict[str, float]:
    """How scores differ from smooth scores of the same candidates, at several places."""
    a, b = (np.concatenate(side) for side in zip(*pairs, strict=True))
    free_a, free_b = a < scoring.BLOCKED, b < scoring.BLOCKED
    both = free_a & free_b
    error = np.abs(a[both] - b[both])
    relative = error / np.maximum(np.abs(b[both]), 1e-3)
    chosen = [(smooth[ours.argmin()], smooth) for ours, smooth in pairs]
    free = [(best, smooth) for best, smooth in chosen if best < scoring.BLOCKED]
    return {
        "median_relative": float(np.median(relative)),
        "p95_relative": float(np.percentile(relative, 95)),
        "median_m": float(np.median(error)),
        "p95_m": float(np.percentile(error, 95)),
        "blocked_in_one_only": float(np.mean(free_a != free_b)),
        "candidates": a.size,
        # the choices by the packed scores, judged by the smooth ones; ranks from 0
        "choices": len(chosen),
        "choices_blocked": len(chosen) - len(free),
        "median_rank_of_choice": float(np.median([np.sum(smooth < best) for best, smooth in free])),
        "median_regret_m": float(np.median([best - smooth.min() for best, smooth in free])),
        "max_regret_m": float(np.max([best - smooth.min() for best, smooth in free])),
    }


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


def scaling(drive: Drive, repeats: int, counts: tuple[int, ...] = COUNTS, lengths: tuple[int, ...] = LENGTHS) -> dict:
    """Times [ms] of the scoring kernel, on one thread: over K at T = `NUM_STEPS`, over T at K = 4,096."""
    seen, state = drive.stops[0]
    words = jax.jit(navigator.rollout_field, static_argnums=0)(drive.spec, drive.params, state)[1]

    def call(num: int, steps: int) -> Callable[[], scoring.Scores]:
        chosen = _candidates(drive.params, seen, state, num)
        params = drive.params.score._replace(horizon=jnp.asarray(0.1 * steps, jnp.float32))
        return lambda: scoring.score(words, chosen, params, drive.params.robot, dt=0.1, num_steps=steps)

    spent = interleaved(
        [*(call(num, NUM_STEPS) for num in counts), *(call(4096, steps) for steps in lengths)], repeats
    )
    times = [1e3 * s for s in spent]
    return {
        "candidates": dict(zip(map(str, counts), times[: len(counts)], strict=True)),
        "steps": dict(zip(map(str, lengths), times[len(counts) :], strict=True)),
    }


def parts(drive: Drive, *, quick: bool = False) -> dict[str, Any]:
    """`plan_times`, `route_times`, `scaling` (of fewer counts and lengths if `quick`) and `threads` by candidates."""
    repeats, few = (3, slice(2)) if quick else (30, slice(None))
    return {
        "plan": plan_times(drive, repeats), "cost_to_go": route_times(drive, repeats),
        "scaling": scaling(drive, repeats // 3, COUNTS[few], LENGTHS[few]),
        "threads": {str(num): workers for num, workers in THREADS.items()},
    }  # fmt: skip
