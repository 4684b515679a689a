"""All of them in turn within one run: times, ratios, and how far their answers are apart for the same noise."""

from collections.abc import Callable
from typing import Any

import numpy as np

from drnav_jax.bench.mppi import in_numba, in_numpy, in_torch, ours
from drnav_jax.bench.mppi.task import Task, Update, make
from drnav_jax.bench.timing import cores, interleaved
from drnav_jax.planning.noise import NoiseSpec

THREADS = (1, 2)  # of each rival that can use several; its better time counts
BANK = 4  # sequences in a bank, over K
ELSEWHERE = 1e-4  # relative difference of a sample's cost above which it has read another cell somewhere
NOISES = ("ours", "antithetic", "fresh")  # of our commands: out of a bank, fresh pairs, fresh
RIVALS = ("numpy", "numpy_fresh", "numba", "numba_fresh", "pytorch_mppi")
EXTRA = "needs the extra: pip install drnav_jax[bench]"


def _updaters(task: Task, num_samples: int) -> tuple[dict[str, Callable[[np.ndarray], Update]], Any, dict[str, str]]:
    """Rivals by name, the controller of `pytorch_mppi` or None, and why those are missing that are."""
    found, missing, controller = {"numpy": in_numpy.updater(task)}, {}, None
    try:
        found["numba"] = in_numba.updater(task)
    except ImportError as error:
        missing["numba"] = f"{error}; {EXTRA}"
    try:
        controller = in_torch.Controller(task, num_samples)
        found["pytorch_mppi"] = controller.update
    except ImportError as error:
        missing["pytorch_mppi"] = f"{error}; {EXTRA}"
    return found, controller, missing


def noise_of(name: str, num_samples: int) -> NoiseSpec:
    """The noise of our command of this name, out of `NOISES`."""
    return NoiseSpec(antithetic=name == "antithetic", bank=BANK * num_samples if name == "ours" else 0)


def difference(one: Update, other: Update) -> dict[str, float]:
    """How far two answers to the same noise are apart.

    A point that rounding puts on the other side of a cell's edge reads another cell: then one sample's cost differs by
    what the cells differ, which is why the median and the share of such samples are told.
    """
    relative = np.abs(one.running / other.running - 1.0)
    return {
        "cost_median": float(np.median(relative)), "cost_max": float(np.max(relative)),
        "cost_elsewhere": float(np.mean(relative > ELSEWHERE)),
        "control_max": float(np.max(np.abs(one.control - other.control))),
    }  # fmt: skip


def _rival_calls(
    rivals: dict[str, Callable[[np.ndarray], Update]], controller: Any, num_samples: int, num_steps: int
) -> dict[tuple[str, int], Callable[[], object]]:
    """Commands of the rivals, by name (`RIVALS`) and number of threads."""
    rng = np.random.default_rng(1)
    bank = rng.standard_normal((num_steps, 2, BANK * num_samples), np.float32)

    def banked() -> np.ndarray:
        first = rng.integers(0, bank.shape[2] - num_samples + 1)
        return np.ascontiguousarray(bank[:, :, first : first + num_samples])

    def on(use: Callable[[int], None], num: int, command: Callable[[], object]) -> Callable[[], object]:
        def call() -> object:
            use(num)
            return command()

        return call

    calls: dict[tuple[str, int], Callable[[], object]] = {}
    for name in ("numpy", "numba"):
        if name not in rivals:
            continue
        update = rivals[name]
        both = {
            name: lambda update=update: update(banked()),
            f"{name}_fresh": lambda update=update: update(rng.standard_normal((num_steps, 2, num_samples), np.float32)),
        }
        threads = THREADS if name == "numba" else (1,)
        use = in_numba.use_threads if name == "numba" else lambda num: None
        calls |= {(key, num): on(use, num, command) for key, command in both.items() for num in threads}
    if controller is not None:
        calls |= {("pytorch_mppi", num): on(controller.use_threads, num, controller.command) for num in THREADS}
    return calls


def side_by_side(num_samples: int = 2000, num_steps: int = 56, repeats: int = 50) -> dict[str, Any]:
    """Times [ms] of one command, medians of interleaved repeats.

    Args:
        num_samples: K.
        num_steps: T.
        repeats: How often each is timed.

    Returns:
        `ours_ms` (noise out of a bank), `antithetic_ms` (fresh pairs), `fresh_ms` (independent fresh normals);
        `pytorch_mppi_ms` (fresh, it has nothing else); `numpy_ms` and `numba_ms` (noise out of a bank), `numpy_fresh_ms`
        and `numba_fresh_ms` (NumPy's generator); of each rival the time with as many threads as suit it best.
        `ratio`, `antithetic_ratio`, `fresh_ratio`: how often ours fits into `pytorch_mppi_ms`; `numba_ratio`,
        `numpy_ratio` and their `_fresh_` likewise for equal noise. `difference` of each rival's answer from ours for the
        same noise, `missing`: why a rival has no figures (None), `by_threads`: the rivals' times by threads, `threads`:
        those that XLA may use for ours, `samples`, `steps`.
    """
    task = make(num_steps)
    rivals, controller, missing = _updaters(task, num_samples)
    eps = np.random.default_rng(2).standard_normal((num_steps, 2, num_samples), np.float32)
    expected = ours.update(task, eps)
    apart = {name: difference(update(eps), expected) for name, update in rivals.items()}
    theirs = _rival_calls(rivals, controller, num_samples, num_steps)
    own = [ours.command(task, num_samples, noise_of(name, num_samples)) for name in NOISES]
    spent = [1e3 * s for s in interleaved([*own, *theirs.values()], repeats, rest=1e-3)]
    by_threads: dict[str, dict[str, float]] = {}
    for (name, num), value in zip(theirs, spent[len(own) :], strict=True):
        by_threads.setdefault(name, {})[str(num)] = value
    ms = dict(zip(NOISES, spent, strict=False)) | {name: min(times.values()) for name, times in by_threads.items()}
    over = lambda rival, own: ms[rival] / ms[own] if rival in ms else None  # noqa: E731
    return {
        **{f"{name}_ms": ms.get(name) for name in (*NOISES, *RIVALS)},
        "ratio": over("pytorch_mppi", "ours"), "antithetic_ratio": over("pytorch_mppi", "antithetic"),
        "fresh_ratio": over("pytorch_mppi", "fresh"),
        **{f"{name}_ratio": over(name, "ours") for name in ("numpy", "numba")},
        **{f"{name}_fresh_ratio": over(f"{name}_fresh", "fresh") for name in ("numpy", "numba")},
        "difference": apart, "missing": missing, "by_threads": by_threads, "threads": cores(),
        "samples": num_samples, "steps": num_steps,
    }  # fmt: skip
