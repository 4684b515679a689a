"""How times and memory grow: over candidates, steps, robots and the size of the map (`drnav bench --scaling`).

Every point is one program, timed in turn with the others of its curve. Memory is what the program needs beside its
arguments and results, as XLA planned it. A curve's exponent is the slope of log time over log size: 1 is linear, 0 does
not grow.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from drnav_jax import grids, navigator, viz
from drnav_jax.bench import mppi
from drnav_jax.bench.drive import STRIDE, Drive, record
from drnav_jax.bench.machine import machine
from drnav_jax.bench.mppi import ours
from drnav_jax.bench.scorer import NUM_STEPS, candidates
from drnav_jax.bench.timing import interleaved
from drnav_jax.planning import scoring
from drnav_jax.planning.noise import NoiseSpec
from drnav_jax.types import GridMap

COUNTS, LENGTHS = (1024, 4096, 16384, 65536), (14, 28, 56, 112)  # K and T of the scoring kernel
SAMPLES = (500, 1000, 2000, 4000, 8000)  # K of MPPI
ROBOTS = (1, 4, 16, 64)  # of 1,024 candidates each
EDGES = (64, 128, 256, 512, 1024)  # of the map [cells]


def _program(function: Callable, *args: Any) -> tuple[Callable[[], Any], float]:
    """A call of a compiled function, and the memory [MB] that it works in."""
    program = jax.jit(function).lower(*args).compile()
    planned = program.memory_analysis()
    return lambda: program(*args), getattr(planned, "temp_size_in_bytes", 0) / 1e6


def _curve(over: str, sizes: tuple[int, ...], make: Callable[[int], tuple[Callable[[], Any], float]], repeats: int) -> dict:
    """Times and memory for each size of what `make` makes of it."""
    calls, memory = zip(*map(make, sizes), strict=True)
    ms = [1e3 * s for s in interleaved(list(calls), repeats)]
    slope = np.polyfit(np.log(sizes), np.log(ms), 1)[0]
    return {"over": over, "sizes": list(sizes), "ms": ms, "mb": list(memory), "exponent": float(slope)}


def _field(drive: Drive) -> GridMap:
    """The packed words at the first stop of a drive."""
    return jax.jit(navigator.rollout_field, static_argnums=0)(drive.spec, drive.params, drive.stops[0][1])[1]


def _scores(drive: Drive, words: GridMap, num: int, steps: int, robots: int = 0) -> tuple[Callable[[], Any], float]:
    """Scores of `num` candidates, or of as many for each of several robots with a map of its own."""
    chosen = candidates(drive.params, *drive.stops[0], num)
    params = drive.params.score._replace(horizon=jnp.asarray(0.1 * steps, jnp.float32))

    def score(words: GridMap, chosen: scoring.Candidates, params: scoring.ScoreParams) -> jax.Array:
        return scoring.score(words, chosen, params, drive.params.robot, dt=0.1, num_steps=steps)

    if not robots:
        return _program(score, words, chosen, params)
    words, chosen = jax.tree.map(lambda a: jnp.stack([jnp.asarray(a)] * robots), (words, chosen))
    return _program(jax.vmap(score, in_axes=(0, 0, None)), words, chosen, params)


def _tiled(words: GridMap, edge: int) -> GridMap:
    """The same cells around the middle of a map of another size."""
    size = words.values.shape[0]
    if edge <= size:
        first = (size - edge) // 2
        values = words.values[first : first + edge, first : first + edge]
    else:
        first = -(edge - size) // 2
        values = jnp.roll(jnp.tile(words.values, (edge // size + 1,) * 2), (-first, -first), (0, 1))[:edge, :edge]
    return words._replace(values=values, origin=words.origin + jnp.float32(first) * words.resolution)


def _control(num: int, steps: int) -> tuple[Callable[[], Any], float]:
    """A command of MPPI with noise out of a bank."""
    plan, given = ours.planner(mppi.make(steps), num, NoiseSpec(bank=4 * num))
    return _program(plan, *given, jax.random.key(1))


def _route(edge: int) -> tuple[Callable[[], Any], float]:
    """The cost-to-go from one corner of a map of boxes."""
    task = mppi.make(size=edge)
    closed = task.cost >= 253.0
    closed[:4, :4] = False
    cost = np.where(closed, grids.UNREACHABLE, 1.0 + task.cost / 254.0).astype(np.float32)
    initial = np.full_like(cost, grids.UNREACHABLE)
    initial[0, 0] = 0.0
    solve = lambda cost, initial: grids.cost_to_go(cost, initial, resolution=task.resolution)  # noqa: E731
    return _program(solve, jnp.asarray(cost), jnp.asarray(initial))


def measure(*, quick: bool = False) -> dict[str, Any]:
    """All curves.

    Args:
        quick: The two smallest sizes of each, few repeats.

    Returns:
        `curves`: for each `over`, `sizes`, `ms` (medians), `mb` and `exponent`; `machine`. The scoring kernel and its maps
        are those at the beginning of a recorded drive, MPPI's those of `mppi.make`.
    """
    few, repeats = (slice(2), 3) if quick else (slice(None), 20)
    drive = record(STRIDE)
    words = _field(drive)
    return {
        "curves": {
            "scoring": _curve("candidates", COUNTS[few], lambda n: _scores(drive, words, n, NUM_STEPS), repeats),
            "scoring, 4,096": _curve("steps", LENGTHS[few], lambda n: _scores(drive, words, 4096, n), repeats),
            "scoring, 1,024 each": _curve(
                "robots", ROBOTS[few], lambda n: _scores(drive, words, 1024, NUM_STEPS, n), repeats
            ),
            "scoring, 4,096 x 56": _curve(
                "edge of the map [cells]", EDGES[few], lambda n: _scores(drive, _tiled(words, n), 4096, NUM_STEPS), repeats
            ),
            "MPPI": _curve("samples", SAMPLES[few], lambda n: _control(n, NUM_STEPS), repeats),
            "MPPI, 2,000": _curve("steps", LENGTHS[few], lambda n: _control(2000, n), repeats),
            "cost-to-go": _curve("edge of the map [cells]", EDGES[few], _route, repeats),
        },
        "machine": machine(),
    }


def table(curves: dict[str, dict]) -> str:
    """The curves in Markdown."""
    lines = ["| part | over | size | ms | us per unit | MB | exponent |", "|---|---|--:|--:|--:|--:|--:|"]
    for name, curve in curves.items():
        for k, (size, ms, mb) in enumerate(zip(curve["sizes"], curve["ms"], curve["mb"], strict=True)):
            first = (name, curve["over"], f"{curve['exponent']:.2f}") if not k else ("", "", "")
            lines.append(
                f"| {first[0]} | {first[1]} | {size:,} | {ms:.2f} | {1e3 * ms / size:.2f} | {mb:.2f} | {first[2]} |"
            )
    return "\n".join(lines) + "\n"


def write(folder: Path, result: dict[str, Any]) -> None:
    """`scaling.json`, `scaling.md` and `scaling.png` of what `measure` gave.

    Raises:
        MissingExtra: If matplotlib is not installed; the figures are written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scaling.json").write_text(json.dumps(result, indent=2, allow_nan=False) + "\n")
    (folder / "scaling.md").write_text(table(result["curves"]))
    curves = {
        name: viz.Curve(curve["over"], curve["sizes"], curve["ms"], curve["mb"]) for name, curve in result["curves"].items()
    }
    title = "{cores} x {cpu}, jax {jax}; grey: linear".format(**result["machine"])
    viz.growth(folder / "scaling.png", curves, title)
