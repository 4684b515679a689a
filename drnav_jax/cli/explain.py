"""`drnav run --explain`: which critic decided?

Two choices are made in every tick: where to, g* (planners with a goal generator), and the command. Each has the least
cost among its candidates, and each cost is a sum of terms. A term decided as far as the runners-up - the next nine of the
ten best - pay more for it than the best.
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from drnav_jax import report
from drnav_jax.evaluate import Evaluation
from drnav_jax.navigator import NavSpec
from drnav_jax.planning import follower, recovery
from drnav_jax.planning.scoring import BLOCKED, Terms

ROWS = 12  # of a table, about
TITLES = {"goal": "where to: g*", "command": "how: the command"}


class Told(NamedTuple):
    """What the ticks of one evaluation tell; each a mapping that JSON can hold."""

    episodes: list[list[dict[str, Any]]]  # of each finished episode its ticks
    names: list[str]  # of their worlds


def told(evaluation: Evaluation, spec: NavSpec, dt: float) -> Told:
    """Gather every tick of the finished episodes.

    Args:
        evaluation: Driven with `explained`.
        spec: The robot's.
        dt: Tick [s].
    """
    log, why = evaluation.result.log, {}
    if spec.planner.generates:
        why["goal"] = (Terms._fields, log.policy["why_goal"])
    why["command"] = (follower.critics(spec.follower, spec.planner), log.policy["why_command"])
    episodes = []
    for number, k in enumerate(evaluation.kept):
        ticks = []
        for t in np.flatnonzero(log.active[k]).tolist():
            tick = {
                "episode": number, "world": evaluation.trips[number].scene.name, "time_s": round(t * dt, 3),
                "mode": recovery.MODES[int(log.policy["mode"][k, t])],
                "v": _short(log.command[k, t, 0]), "omega": _short(log.command[k, t, 1]),
                "g": [_short(x) for x in log.policy["local_goal"][k, t]],
                "certified": bool(log.policy["certified"][k, t]),
            }  # fmt: skip
            ticks.append(tick | {what: _costs(names, at, k, t) for what, (names, at) in why.items()})
        episodes.append(ticks)
    return Told(episodes, [trip.scene.name for trip in evaluation.trips])


def _short(value: Any) -> float:
    """Five digits: what is read, and a third of the file."""
    return float(f"{float(value):.5g}")


def _costs(names: tuple[str, ...], why: Any, k: int, t: int) -> dict[str, Any]:
    """Term by term: of the choice, and of the best candidates that are admissible."""
    total = why.best_cost[k, t]
    count = int(np.sum(np.isfinite(total) & (total < BLOCKED)))
    chosen, best = why.chosen[k, t], why.best[k, t, :count]
    return {
        "chosen": {name: _short(chosen[c]) for c, name in enumerate(names)},
        "best": {name: [_short(x) for x in best[:, c]] for c, name in enumerate(names)},
        "cost": [_short(x) for x in total[:count]],
    }


def write(file: Path, what: Told) -> None:
    """One JSON object per tick and line."""
    with file.open("w") as lines:
        for ticks in what.episodes:
            lines.writelines(json.dumps(report.finite(tick), allow_nan=False) + "\n" for tick in ticks)


def lead(costs: Mapping[str, Any]) -> dict[str, float]:
    """What the runners-up pay more for each term than the best candidate, on average; empty if there is none."""
    if len(costs["cost"]) < 2:
        return {}
    return {name: sum(values[1:]) / len(values[1:]) - values[0] for name, values in costs["best"].items()}


def moments(ticks: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The first tick, changes of mode, the last, and as many evenly between as a table holds."""
    changes = [k for k in range(1, len(ticks)) if ticks[k]["mode"] != ticks[k - 1]["mode"]][: ROWS // 2]
    even = np.linspace(0, len(ticks) - 1, max(ROWS - len(changes), 2)).round().astype(int).tolist()
    return [ticks[k] for k in sorted({*changes, *even})]


def _rows(what: str, shown: list[dict[str, Any]]) -> Iterator[list[str]]:
    terms = [n for n in shown[0][what]["chosen"] if any(abs(tick[what]["chosen"][n]) >= 5e-3 for tick in shown)]
    yield ["time", "mode", "v", "omega", "g*", *terms, "decided by"]
    for tick in shown:
        ahead = lead(tick[what])
        by = max(ahead, key=lambda name: ahead[name], default="")
        decided = f"{by} +{ahead[by]:.2g}" if by and ahead[by] >= 5e-4 else "a tie" if ahead else "no other"
        if not tick[what]["cost"]:
            decided = "all blocked"
        x, y = tick["g"]
        yield [
            f"{tick['time_s']:.1f} s", tick["mode"], f"{tick['v']:.2f}", f"{tick['omega']:.2f}", f"({x:.1f}, {y:.1f})",
            *(f"{tick[what]['chosen'][name]:.2f}" for name in terms), decided,
        ]  # fmt: skip


def table(what: Told, planner: str) -> str:
    """Text about chosen ticks of the first episode: costs of the choice, and what the runners-up pay more for most."""
    ticks = what.episodes[0]
    shown = moments(ticks)
    lines = [
        f"Which critic decided? {planner} in {what.names[0]}: what the choice costs, term by term, and the term for which",
        "the runners-up (the next nine candidates) pay most beyond the best. Every tick is in explain.jsonl.",
    ]
    for part in [name for name in TITLES if name in ticks[0]]:
        rows = list(_rows(part, shown))
        widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
        left = (1, len(widths) - 1)  # words; all else are numbers
        text = ["  ".join(c.ljust(w) if k in left else c.rjust(w) for k, (c, w) in enumerate(zip(row, widths, strict=True)))
                for row in rows]  # fmt: skip
        lines += ["", TITLES[part], *(line.rstrip() for line in text)]
    return "\n".join(lines)
