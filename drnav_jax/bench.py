"""Times of the parts next to their rivals, measured in turn within one run.

What is timed: the robot's whole tick on a recorded drive, the scoring of candidates in the field of that drive, the
LiDAR and the cameras against native MuJoCo (`bench_sensors`), and batched closed-loop episodes. A fixed matmul from the
same run tells a slow hour from slow code.
"""

import functools
import os
import platform
import re
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from drnav_jax import evaluate, geometry, navigator, worlds
from drnav_jax.bench_sensors import camera_against_mujoco, interleaved, lidar_against_mujoco
from drnav_jax.evaluate import Setup
from drnav_jax.navigator import NavParams, NavSpec, NavState
from drnav_jax.planning import costmap, goal_generator, scoring
from drnav_jax.planning.goal_generator import GeneratorSpec
from drnav_jax.sim import LidarParams, LidarSpec, episode, kinematic, scan
from drnav_jax.sim.episode import EpisodeSpec
from drnav_jax.types import GridMap, Observation, empty_observation

DRIVE = "t"  # family whose world is driven for the recording: corridors, a fork, a dead end
STRIDE = 20  # ticks of the drive between two places at which candidates are scored
FAMILIES = ("u", "t", "l", "corridor", "open")  # of the batched episodes, in turn
NUM_STEPS = 56  # T of the scoring
PACE = 0.2  # [m/s] limit of the batched episodes, so that none arrives within its 600 steps


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


def _bilinear(layers: tuple[GridMap, GridMap, GridMap], x: jax.Array, y: jax.Array) -> tuple[jax.Array, ...]:
    """What `scoring.look_up` reads, from float layers and between the cells' centres."""
    xy = jnp.stack([x, y], axis=-1)
    clear, risk, value = layers
    # beside closed cells nothing can be interpolated
    smooth, own = geometry.sample_bilinear(value, xy), geometry.sample_nearest(value, xy)
    return (
        geometry.sample_bilinear(clear, xy), geometry.sample_bilinear(risk, xy),
        jnp.where(jnp.abs(smooth - own) < 2 * value.resolution, smooth, own),
    )  # fmt: skip


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
        smooth = score((clear, GridMap(state.risk, window, cell), value), chosen, reader=_bilinear)
        pairs.append((np.asarray(score(words, chosen).score, float), np.asarray(smooth.score, float)))

    words = field_of(drive.spec, drive.params, drive.stops[0][1])[1]
    sets = {n: _candidates(drive.params, *drive.stops[0], n) for n in (4096, 65536)}
    square = jax.random.normal(jax.random.key(0), (1024, 1024), jnp.float32)
    matmul = jax.jit(lambda a: a @ a)
    calls = [functools.partial(score, words, chosen) for chosen in sets.values()]
    *seconds, reference = interleaved([*calls, lambda: matmul(square)], repeats)
    rates = {str(n): n * NUM_STEPS / s for n, s in zip(sets, seconds, strict=True)}
    return rates, _difference(pairs), 1e3 * reference


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
    policy = evaluate.policy_of(evaluate.spec_of(setup.planner, setup.predictor, setup.num_candidates))
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
        `tick_lidar_ms`, `scoring` (candidate-steps per second by number of candidates), `scoring_error`, `lidar`,
        `camera`, `episodes_per_s`, `episodes`, `reference_matmul_ms`, `machine`.
    """
    warm_up = 5 if quick else 20
    drive = record(2 * STRIDE if quick else warm_up + 200)
    rates, error, reference = scoring_times(drive, 3 if quick else 50)
    lidar = lidar_against_mujoco(repeats=3 if quick else 30)
    camera = camera_against_mujoco(repeats=3 if quick else 20)
    per_second, episodes = episode_rate(2, 50) if quick else episode_rate()
    return {
        "tick_lidar_ms": tick_times(drive, warm_up), "scoring": rates, "scoring_error": error, "lidar": lidar,
        "camera": camera, "episodes_per_s": per_second, "episodes": episodes, "reference_matmul_ms": reference,
        "machine": machine(),
    }  # fmt: skip


def table(result: dict[str, Any]) -> str:
    """The result of `run` for people."""
    tick, error, lidar, camera, episodes = (
        result[k] for k in ("tick_lidar_ms", "scoring_error", "lidar", "camera", "episodes")
    )
    rival = camera["no_mujoco"] or f"{camera['ratio']:.1f} x MuJoCo"
    rates = {f"scoring, {int(n):,} x {NUM_STEPS}": rate for n, rate in result["scoring"].items()}
    rows = [
        ("tick, 4,096 candidates", f"{tick['median']:.1f} ms median, {tick['p95']:.1f} p95, {tick['max']:.1f} max"),
        ("tick that replans", f"{tick['replan_median']:.1f} ms median, {tick['replan_p95']:.1f} p95"),
        *((name, f"{rate / 1e6:.0f} M candidate-steps/s") for name, rate in rates.items()),
        (
            "  against bilinear",
            f"{100 * error['median_relative']:.2f} % median, {100 * error['p95_relative']:.2f} % p95; "
            f"its choices cost {100 * error['median_regret_m']:.1f} cm more (median)",
        ),
        ("LiDAR 16x360, 100 obstacles", f"{lidar['rays_per_s'] / 1e6:.1f} M rays/s, {lidar['ratio']:.1f} x MuJoCo"),
        ("  against MuJoCo", f"max error {lidar['max_error_m']:.1e} m"),
        ("camera 96x96, 100 obstacles", f"{camera['images_per_s']:.0f} images/s, {rival}"),
        ("episodes of 600 steps", f"{result['episodes_per_s']:.2f} /s ({episodes['batch']} in one call)"),
        ("matmul 1024^3 float32", f"{result['reference_matmul_ms']:.1f} ms"),
        ("machine", "{cores} x {cpu}, {device}, jax {jax}, python {python}".format(**result["machine"])),
    ]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {text}" for name, text in rows)
