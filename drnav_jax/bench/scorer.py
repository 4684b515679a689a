"""The scoring kernel in the fields and at the places of a recorded drive: its rate and its error.

One program of XLA's runs the kernel on one thread of a CPU; where threads share the candidates, the result says how many.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from drnav_jax import geometry, navigator
from drnav_jax.bench.drive import Drive
from drnav_jax.bench.timing import interleaved, matmul
from drnav_jax.navigator import NavParams, NavState
from drnav_jax.planning import costmap, goal_generator, scoring
from drnav_jax.planning.goal_generator import GeneratorSpec
from drnav_jax.types import GridMap, Observation

NUM_STEPS = 56  # T
THREADS = {4096: 1, 65536: 2}  # that share so many candidates


def candidates(params: NavParams, seen: Observation, state: NavState, num: int) -> scoring.Candidates:
    """`num` controls of a moving robot at a stop of a drive: every speed with every turn rate."""
    speeds = 16 if num <= 4096 else 64
    spec = GeneratorSpec(num_speeds=speeds, num_turns=num // speeds)
    twist = jnp.asarray([0.6, 0.4], jnp.float32)
    controls, _ = goal_generator.candidates(
        spec, params.score, params.robot, seen.pose, twist, seen.goal, state.local_goal, params.hysteresis
    )
    return controls


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


def scoring_times(drive: Drive, repeats: int) -> tuple[dict[str, dict[str, float]], dict[str, float], float]:
    """Candidate-steps per second of `scoring.score`, its error, and the time of the reference matmul [ms].

    T = `NUM_STEPS` steps of 0.1 s, risk and obstacle cost, limited in acceleration from a moving state, in the field
    that the navigator makes. Rates are those of the generator's controls (`product`), and of as many candidates that
    nothing is known of (`list`). The error is that of nearest packed look-ups against bilinear look-ups in float, over
    all stops of the drive.
    """
    params = drive.params.score._replace(horizon=jnp.asarray(0.1 * NUM_STEPS, jnp.float32))
    field_of = jax.jit(navigator.rollout_field, static_argnums=0)
    cell = drive.spec.filter.grid.resolution

    def score(field: Any, chosen: scoring.Candidates, **how: Any) -> jax.Array:
        return scoring.score(field, chosen, params, drive.params.robot, dt=0.1, num_steps=NUM_STEPS, **how)

    pairs = []
    for seen, state in drive.stops:
        clear, words = field_of(drive.spec, drive.params, state)
        window = geometry.window_origin(state.belief.corner, drive.spec.filter.grid)
        value = GridMap(costmap.unpack(state.plan)[2], window, cell)
        chosen = candidates(drive.params, seen, state, 4096)
        smooth = score((clear, GridMap(state.risk, window, cell), value), chosen, reader=BILINEAR)
        pairs.append((np.asarray(score(words, chosen), float).ravel(), np.asarray(smooth, float).ravel()))

    words = field_of(drive.spec, drive.params, drive.stops[0][1])[1]
    products = [candidates(drive.params, *drive.stops[0], n) for n in THREADS]
    lists = [scoring.at(some, jnp.arange(n)) for some, n in zip(products, THREADS, strict=True)]
    calls = [_scorer(words, some, params, drive.params) for some in (*products, *lists)]
    *seconds, reference = interleaved([*calls, matmul()], repeats)
    rate = lambda spent: {str(n): n * NUM_STEPS / s for n, s in zip(THREADS, spent, strict=True)}  # noqa: E731
    rates = {"product": rate(seconds[: len(products)]), "list": rate(seconds[len(products) :])}
    return rates, _difference(pairs), 1e3 * reference


def _scorer(
    words: GridMap, chosen: scoring.Candidates, weights: scoring.ScoreParams, params: NavParams
) -> Callable[[], jax.Array]:
    """Scores candidates on as many threads as they get."""
    workers = THREADS[math.prod(chosen.shape)]
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
