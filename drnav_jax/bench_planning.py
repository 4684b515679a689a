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

from drnav_jax import evaluate, geometry, navigator, worlds
from drnav_jax.bench_sensors import interleaved
from drnav_jax.evaluate import Setup
from drnav_jax.navigator import NavParams, NavSpec, NavState
from drnav_jax.planning import costmap, goal_generator, scoring
from drnav_jax.planning.goal_generator import GeneratorSpec
from drnav_jax.sim import LidarParams, LidarSpec, kinematic, scan
from drnav_jax.types import GridMap, Observation, empty_observation

DRIVE = "t"  # family whose world is driven for the recording: corridors, a fork, a dead end
STRIDE = 20  # ticks of the drive between two places at which candidates are scored
NUM_STEPS = 56  # T of the scoring
THREADS = {4096: 1, 65536: 2}  # that share so many candidates


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
    spec = evaluate.spec_of(setup.planner, setup.predictor, num_candidates)
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
