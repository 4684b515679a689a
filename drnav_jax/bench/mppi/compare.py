"""All of them in turn within one run: times, ratios, and how far their answers are apart for the same noise."""

from collections.abc import Callable
from typing import Any

import numpy as np

from drnav_jax.bench.mppi import in_numba, in_numpy, in_torch, ours
from drnav_jax.bench.mppi.task import Task, Update, make
from drnav_jax.bench.timing import cores, interleaved
from drnav_jax.planning.noise import NoiseSpec

THREADS = 2  # of each rival that can use several
BANK = 4  # sequences in a bank, over K
ELSEWHERE = 1e-4  # relative difference of a sample's cost above which it has read another cell somewhere
NOISES = {"ours": {"bank": BANK}, "antithetic": {"antithetic": True}, "fresh": {}}
EXTRA = "needs the extra: pip install drnav_jax[bench]"


def _updaters(task: Task, num_samples: int) -> tuple[dict[str, Callable[[np.ndarray], Update]], Any, dict[str, str]]:
    """Rivals by name, the controller of `pytorch_mppi` or None, and why those are missing that are."""
    found, missing, controller = {"numpy": in_numpy.updater(task)}, {}, None
    try:
        found["numba"] = in_numba.updater(task, THREADS)
    except ImportError as error:
        missing["numba"] = f"{error}; {EXTRA}"
    try:
        controller = in_torch.Controller(task, num_samples, THREADS)
        found["pytorch_mppi"] = controller.update
    except ImportError as error:
        missing["pytorch_mppi"] = f"{error}; {EXTRA}"
    return found, controller, missing


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


def side_by_side(num_samples: int = 2000, num_steps: int = 56, repeats: int = 50) -> dict[str, Any]:
    """Times [ms] of one command, medians of interleaved repeats.

    Args:
        num_samples: K.
        num_steps: T.
        repeats: How often each is timed.

    Returns:
        `ours_ms` (noise out of a bank), `antithetic_ms` (fresh pairs), `fresh_ms` (independent fresh normals);
        `pytorch_mppi_ms` (fresh, it has nothing else); `numpy_ms` and `numba_ms` (noise out of a bank), `numpy_fresh_ms`
        and `numba_fresh_ms` (NumPy's generator). `ratio`, `antithetic_ratio`, `fresh_ratio`: how often ours fits into
        `pytorch_mppi_ms`; `numba_ratio`, `numpy_ratio` and their `_fresh_` likewise for equal noise. `difference` of each
        rival's answer from ours for the same noise (m/s and rad/s for controls), `missing`: why a rival has no figures
        (None), `threads`, `samples`, `steps`.
    """
    task = make(num_steps)
    rng = np.random.default_rng(1)
    rivals, controller, missing = _updaters(task, num_samples)
    bank = rng.standard_normal((num_steps, 2, BANK * num_samples), np.float32)

    def banked(update: Callable[[np.ndarray], Update]) -> Callable[[], Update]:
        def call() -> Update:
            first = rng.integers(0, bank.shape[2] - num_samples + 1)
            return update(np.ascontiguousarray(bank[:, :, first : first + num_samples]))

        return call

    def fresh(update: Callable[[np.ndarray], Update]) -> Callable[[], Update]:
        return lambda: update(rng.standard_normal((num_steps, 2, num_samples), np.float32))

    calls: dict[str, Callable[[], object]] = {}
    for name, how in NOISES.items():
        noise = NoiseSpec(**(how | ({"bank": BANK * num_samples} if "bank" in how else {})))
        calls[name] = ours.command(task, num_samples, noise)
    for name in ("numpy", "numba"):
        if name in rivals:
            calls |= {name: banked(rivals[name]), f"{name}_fresh": fresh(rivals[name])}
    if controller is not None:
        calls["pytorch_mppi"] = controller.command
    eps = rng.standard_normal((num_steps, 2, num_samples), np.float32)
    expected = ours.update(task, eps)
    apart = {name: difference(update(eps), expected) for name, update in rivals.items()}
    spent = dict(zip(calls, interleaved(list(calls.values()), repeats, rest=1e-3), strict=True))
    ms = {name: 1e3 * spent[name] if name in spent else None for name in _NAMES}
    over = lambda rival, own: ms[rival] / ms[own] if ms[rival] else None  # noqa: E731
    return {
        **{f"{name}_ms": value for name, value in ms.items()},
        "ratio": over("pytorch_mppi", "ours"), "antithetic_ratio": over("pytorch_mppi", "antithetic"),
        "fresh_ratio": over("pytorch_mppi", "fresh"),
        **{f"{n}_ratio": over(n, "ours") for n in ("numpy", "numba")},
        **{f"{n}_fresh_ratio": over(f"{n}_fresh", "fresh") for n in ("numpy", "numba")},
        "difference": apart, "missing": missing, "samples": num_samples, "steps": num_steps,
        "threads": {"ours": cores(), "pytorch_mppi": THREADS, "numba": THREADS, "numpy": 1},
    }  # fmt: skip


_NAMES = (*NOISES, "numpy", "numpy_fresh", "numba", "numba_fresh", "pytorch_mppi")
