"""Times of the parts next to their rivals, measured in turn within one run.

What is timed: the planner on a recorded drive (`bench_planning`), the fusion network alone and in the tick
(`bench_network`), the LiDAR and the cameras against native MuJoCo (`bench_sensors`), the physics (`bench_physics`), and
batched closed-loop episodes. A fixed matmul from the same run tells a slow hour from slow code.
"""

import os
import platform
import re
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from drnav_jax import evaluate, worlds
from drnav_jax.bench_network import network_times
from drnav_jax.bench_physics import physics_rates
from drnav_jax.bench_planning import NUM_STEPS, STRIDE, parts, record, scoring_times, tick_times
from drnav_jax.bench_sensors import camera_against_mujoco, lidar_against_mujoco
from drnav_jax.evaluate import Setup
from drnav_jax.sim import episode
from drnav_jax.sim.episode import EpisodeSpec

FAMILIES = ("u", "t", "l", "corridor", "open")  # of the batched episodes, in turn
PACE = 0.2  # [m/s] limit of the batched episodes, so that none arrives within its 600 steps


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


def machine() -> dict[str, Any]:
    """What this was measured on."""
    info = Path("/proc/cpuinfo")
    named = re.search(r"model name\s*:\s*(.*)", info.read_text() if info.exists() else "")
    return {
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "cpu": named[1] if named else platform.processor() or platform.machine(),
        "platform": platform.platform(),
        "device": jax.default_backend(),
        "jax": jax.__version__,
        "python": platform.python_version(),
    }


def run(*, quick: bool = False) -> dict[str, Any]:
    """All of it.

    Args:
        quick: Few repeats and short episodes: the same keys in less time, figures that mean little.

    Returns:
        `tick_lidar_ms`, `network_ms`, `network` and `tick_fusion_ms` (`bench_network`), `scoring` (candidate-steps per
        second by number of candidates), `scoring_error`, `plan_ms` (goal generator with 4,096 candidates and DWA),
        `cost_to_go_ms` (256x256), `planning` (`bench_planning.parts`), `lidar`, `camera`, `mjx`, `episodes_per_s`,
        `episodes`, `reference_matmul_ms`, `machine`.
    """
    warm_up = 5 if quick else 20
    drive = record(2 * STRIDE if quick else warm_up + 200)
    seeing = network_times(drive, warm_up, 3 if quick else 100)
    rates, error, reference = scoring_times(drive, 3 if quick else 50)
    lidar = lidar_against_mujoco(repeats=3 if quick else 30)
    camera = camera_against_mujoco(repeats=3 if quick else 20)
    physics = physics_rates(8, 20, 2, 2) if quick else physics_rates()
    per_second, episodes = episode_rate(2, 10, spec=EpisodeSpec(chunk_ticks=10)) if quick else episode_rate()
    planning = parts(drive, quick=quick)
    return {
        "tick_lidar_ms": tick_times(drive, warm_up), "network_ms": seeing["network"]["median"],
        "network": seeing["network"], "tick_fusion_ms": seeing["tick_fusion"], "scoring": rates, "scoring_error": error,
        "plan_ms": planning["plan"]["both"], "cost_to_go_ms": planning["cost_to_go"]["full"], "planning": planning,
        "lidar": lidar, "camera": camera, "mjx": physics, "episodes_per_s": per_second, "episodes": episodes,
        "reference_matmul_ms": reference, "machine": machine(),
    }  # fmt: skip


def table(result: dict[str, Any]) -> str:
    """The result of `run` for people."""
    tick, error, lidar, camera, physics, episodes = (
        result[k] for k in ("tick_lidar_ms", "scoring_error", "lidar", "camera", "mjx", "episodes")
    )
    plan, route = (result["planning"][k] for k in ("plan", "cost_to_go"))
    sees = result["tick_fusion_ms"]
    rival = camera["no_mujoco"] or f"{camera['ratio']:.1f} x MuJoCo"
    rates = {f"scoring, {int(n):,} x {NUM_STEPS}": rate for n, rate in result["scoring"].items()}
    rows = [
        ("tick, 4,096 candidates", f"{tick['median']:.1f} ms median, {tick['p95']:.1f} p95, {tick['max']:.1f} max"),
        ("tick that replans", f"{tick['replan_median']:.1f} ms median, {tick['replan_p95']:.1f} p95"),
        ("fusion network", f"{result['network_ms']:.1f} ms median, {result['network']['p95']:.1f} p95"),
        (
            "tick with it",
            f"{sees['median']:.1f} ms median, {sees['p95']:.1f} p95; replanning {sees['replan_p95']:.1f} p95",
        ),
        *((name, f"{rate / 1e6:.0f} M candidate-steps/s") for name, rate in rates.items()),
        (
            "  against bilinear",
            f"{100 * error['median_relative']:.2f} % median, {100 * error['p95_relative']:.2f} % p95; "
            f"its choices cost {100 * error['median_regret_m']:.1f} cm more (median)",
        ),
        ("goal generator + DWA", f"{result['plan_ms']:.2f} ms ({plan['generator']:.2f} + {plan['tracker']:.2f})"),
        (
            "cost-to-go, 256x256",
            f"{result['cost_to_go_ms']:.1f} ms; {route['window']:.1f} on coarser cells, within "
            f"{100 * route['median_error']:.2f} % (median); {route['serpentine']:.1f} through a serpentine",
        ),
        ("LiDAR 16x360, 100 obstacles", f"{lidar['rays_per_s'] / 1e6:.1f} M rays/s, {lidar['ratio']:.1f} x MuJoCo"),
        ("  against MuJoCo", f"max error {lidar['max_error_m']:.1e} m"),
        ("camera 96x96, 100 obstacles", f"{camera['images_per_s']:.0f} images/s, {rival}"),
        (
            f"MJX, {physics['worlds']} worlds of {physics['obstacles']}",
            f"{physics['steps_per_s'] / 1e3:.0f} k steps/s with contacts, {physics['ratio']:.2f} x MuJoCo; "
            f"kinematic {physics['kinematic_steps_per_s'] / 1e6:.1f} M ticks/s",
        ),
        ("episodes of 600 steps", f"{result['episodes_per_s']:.2f} /s ({episodes['batch']} in one call)"),
        ("matmul 1024^3 float32", f"{result['reference_matmul_ms']:.1f} ms"),
        ("machine", "{cores} x {cpu}, {device}, jax {jax}, python {python}".format(**result["machine"])),
    ]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {text}" for name, text in rows)
