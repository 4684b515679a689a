"""All figures of `drnav bench`, and a table of them.

What is timed: the planner on a recorded drive (`drive`, `scorer`, `planner`), MPPI next to other implementations (`mppi`),
the fusion network alone and in the tick (`network`), the LiDAR and the cameras (`lidar`, `camera`) and the physics
(`physics`) against native MuJoCo, ground truth (`labels`), and batched closed-loop episodes (`episodes`). A fixed matmul
from the same run tells a slow hour from slow code.
"""

from typing import Any

from drnav_jax.bench import mppi
from drnav_jax.bench.camera import camera_against_mujoco
from drnav_jax.bench.drive import STRIDE, record, tick_times
from drnav_jax.bench.episodes import episode_rate
from drnav_jax.bench.labels import label_time
from drnav_jax.bench.lidar import lidar_against_mujoco
from drnav_jax.bench.machine import machine
from drnav_jax.bench.network import network_times
from drnav_jax.bench.physics import physics_rates
from drnav_jax.bench.planner import plan_times, route_times
from drnav_jax.bench.scorer import NUM_STEPS, THREADS, scoring_times
from drnav_jax.sim.episode import EpisodeSpec


def run(*, quick: bool = False) -> dict[str, Any]:
    """All of it.

    Args:
        quick: Few repeats and short episodes: the same keys in less time, figures that mean little.

    Returns:
        `tick_lidar_ms`, `network_ms`, `network` and `tick_fusion_ms` (`network`), `scoring` (candidate-steps per
        second by number of candidates, of the generator's controls) and `scoring_list` (of any), `scoring_error`,
        `plan_ms` (goal generator with 4,096 candidates and DWA), `cost_to_go_ms` (256x256), `planning` (both in parts),
        `mppi` (`mppi.side_by_side`), `lidar`, `camera`, `mjx`, `labels_ms` (400x400), `episodes_per_s`, `episodes`,
        `reference_matmul_ms`, `machine`.
    """
    warm_up = 5 if quick else 20
    drive = record(STRIDE if quick else warm_up + 200)
    seeing = network_times(drive, warm_up, 3 if quick else 100)
    rates, error, reference = scoring_times(drive, 3 if quick else 50)
    lidar = lidar_against_mujoco(repeats=3 if quick else 30)
    camera = camera_against_mujoco(repeats=3 if quick else 20)
    physics = physics_rates(8, 20, 2, 2) if quick else physics_rates()
    per_second, episodes = episode_rate(2, 10, spec=EpisodeSpec(chunk_ticks=10)) if quick else episode_rate()
    planning = {
        "plan": plan_times(drive, 3 if quick else 30), "cost_to_go": route_times(drive, 3 if quick else 30),
        "threads": {str(num): workers for num, workers in THREADS.items()},
    }  # fmt: skip
    rivals = mppi.side_by_side(200, 20, 2) if quick else mppi.side_by_side()
    return {
        "tick_lidar_ms": tick_times(drive, warm_up), "network_ms": seeing["network"]["median"],
        "network": seeing["network"], "tick_fusion_ms": seeing["tick_fusion"], "scoring": rates["product"],
        "scoring_list": rates["list"], "scoring_error": error,
        "plan_ms": planning["plan"]["both"], "cost_to_go_ms": planning["cost_to_go"]["full"], "planning": planning,
        "mppi": rivals, "lidar": lidar, "camera": camera, "mjx": physics,
        "labels_ms": label_time(1 if quick else 5), "episodes_per_s": per_second,
        "episodes": episodes, "reference_matmul_ms": reference, "machine": machine(),
    }  # fmt: skip


def mppi_rows(found: dict[str, Any]) -> list[tuple[str, str]]:
    """Rows of `table` about MPPI."""
    bank, pairs, fresh = (found[f"{name}_ms"] for name in ("ours", "antithetic", "fresh"))
    rows = [
        (
            f"MPPI, {found['samples']:,} x {found['steps']}",
            f"{bank:.2f} ms with a bank of noise, {pairs:.2f} with antithetic pairs, {fresh:.2f} with fresh noise",
        )
    ]
    for name in ("numpy", "numba"):
        if name not in found["missing"]:
            ms, over = ([found[f"{name}{kind}_{what}"] for kind in ("", "_fresh")] for what in ("ms", "ratio"))
            text = f"{ms[0]:.2f} ms with a bank ({over[0]:.1f} x ours), {ms[1]:.2f} fresh ({over[1]:.1f} x)"
            rows.append((f"  {name}", text))
    if "pytorch_mppi" not in found["missing"]:
        over = f"{found['ratio']:.1f} x ours with a bank, {found['antithetic_ratio']:.1f} x with antithetic pairs"
        rows.append(("  pytorch_mppi", f"{found['pytorch_mppi_ms']:.2f} ms ({over}, {found['fresh_ratio']:.1f} x fresh)"))
    return rows + [(f"  {name}", f"not here: {why}") for name, why in found["missing"].items()]


def table(result: dict[str, Any]) -> str:
    """The result of `run` for people."""
    tick, error, lidar, camera, physics, episodes = (
        result[k] for k in ("tick_lidar_ms", "scoring_error", "lidar", "camera", "mjx", "episodes")
    )
    plan, route = (result["planning"][k] for k in ("plan", "cost_to_go"))
    sees = result["tick_fusion_ms"]
    rival = camera["no_mujoco"] or f"{camera['ratio']:.1f} x MuJoCo"
    listed = result["scoring_list"]
    rates = [
        (f"scoring, {int(n):,} x {NUM_STEPS}", f"{rate / 1e6:.0f} M candidate-steps/s; as a list {listed[n] / 1e6:.0f} M")
        for n, rate in result["scoring"].items()
    ]
    rows = [
        ("tick, 4,096 candidates", f"{tick['median']:.1f} ms median, {tick['p95']:.1f} p95, {tick['max']:.1f} max"),
        ("tick that replans", f"{tick['replan_median']:.1f} ms median, {tick['replan_p95']:.1f} p95"),
        ("fusion network", f"{result['network_ms']:.1f} ms median, {result['network']['p95']:.1f} p95"),
        (
            "tick with it",
            f"{sees['median']:.1f} ms median, {sees['p95']:.1f} p95; replanning {sees['replan_p95']:.1f} p95",
        ),
        *rates,
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
        *mppi_rows(result["mppi"]),
        ("LiDAR 16x360, 100 obstacles", f"{lidar['rays_per_s'] / 1e6:.1f} M rays/s, {lidar['ratio']:.1f} x MuJoCo"),
        ("  against MuJoCo", f"max error {lidar['max_error_m']:.1e} m"),
        ("camera 96x96, 100 obstacles", f"{camera['images_per_s']:.0f} images/s, {rival}"),
        (
            f"MJX, {physics['worlds']} worlds of {physics['obstacles']}",
            f"{physics['steps_per_s'] / 1e3:.0f} k steps/s with contacts, {physics['ratio']:.2f} x MuJoCo; "
            f"kinematic {physics['kinematic_steps_per_s'] / 1e6:.1f} M ticks/s",
        ),
        ("labels of 400x400 cells", f"{result['labels_ms']:.0f} ms"),
        ("episodes of 600 steps", f"{result['episodes_per_s']:.2f} /s ({episodes['batch']} in one call)"),
        ("matmul 1024^3 float32", f"{result['reference_matmul_ms']:.1f} ms"),
        ("machine", "{cores} x {cpu}, {device}, jax {jax}, python {python}".format(**result["machine"])),
    ]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {text}" for name, text in rows)
