"""Batched closed-loop episodes per second."""

import time

import jax
import numpy as np

from drnav_jax import evaluate, worlds
from drnav_jax.evaluate import Setup
from drnav_jax.sim import episode
from drnav_jax.sim.episode import EpisodeSpec

FAMILIES = ("u", "t", "l", "corridor", "open")  # in turn
PACE = 0.2  # [m/s] limit of speed, so that none arrives within its 600 steps


def episode_rate(
    batch: int = 16, num_steps: int = 600, *, spec: EpisodeSpec = EpisodeSpec(), workers: int = 2  # noqa: B008 (immutable)
) -> tuple[float, dict[str, int]]:
    """Closed-loop episodes of 600 steps per second, in one batched call after compilation.

    Geometric predictor, 1,024 candidates, worlds of all `FAMILIES` in turn. The robots are so slow (`PACE`) that they
    are among the obstacles all the time and none arrives.

    Args:
        batch: Episodes.
        num_steps: Steps of each.
        spec: Sizes of the simulation.
        workers: Threads that share the batch.

    Returns:
        Episodes per second (steps driven / 600 / time), and what was run.
    """
    scenes = [worlds.sample(FAMILIES[k % len(FAMILIES)], k // len(FAMILIES)) for k in range(batch)]
    setup = Setup(max_speed=PACE, time_limit=num_steps * spec.dt)
    policy = evaluate.policy_of(setup.nav)
    params = evaluate.episode_params(evaluate.prepare(scenes, setup), setup)
    keys = jax.random.split(jax.random.key(0), batch)
    short = params._replace(time_limit=np.full_like(params.time_limit, spec.dt))
    episode.run(spec, policy, short, keys, workers=workers)  # compiles
    begin = time.perf_counter()
    result = episode.run(spec, policy, params, keys, workers=workers)
    wall = time.perf_counter() - begin
    steps = int(result.log.active.sum())
    return steps / 600 / wall, {"batch": batch, "steps": steps, "lanes": spec.lanes, "workers": workers}
