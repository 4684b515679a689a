"""How long does a robot take to get out of a dead end, and does it stay out?

    python experiments/recovery.py --json

Trips start inside dead ends of every family, `--least` to `--most` metres beyond the mouth, facing anywhere, with a map
that is blank; the goal lies outside. Each row is PLANNER:RECOVERY, the same trips for all: `nav2` recovers by Nav2's round
robin (clear, spin, wait, back up), `drnav` by ranked recovery points, `none` not at all. A robot has escaped when its
centre has passed the mouth. It has entered again when it is afterwards more than `DEEP` inside. Planners that know a way
(drnav, nav2-dwb) follow it out; one that drives straight to the goal (dwa) has nothing but its recovery. The first row's
times are compared with every other row's on the trips that both escape, with bootstrap intervals over trips.
"""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import tyro

from drnav_jax import evaluate, metrics, report, worlds
from drnav_jax.evaluate import Setup, Trip
from drnav_jax.planning.refuge import RefugeParams
from drnav_jax.scripts import script
from drnav_jax.worlds.truth import GroundTruth, TruthSpec, truth

CLOSED = tuple(name for name, base in worlds.FAMILIES.items() if name == base != "open")
WEIGHTS = ("openness", "clearance", "turning", "onward", "age", "visits")  # of the ranking that an ablation sets to 0
DEEP = 1.0  # [m]
DT = 0.1  # [s]


@dataclasses.dataclass(frozen=True)
class Config:
    """What is driven, and where results go.

    Attributes:
        rows: PLANNER:RECOVERY, the one that is compared first.
        trips: How many, over all families in turn.
        families: Closed families.
        least: Least depth of a start beyond the mouth [m].
        most: Greatest [m].
        ablate: PLANNER:RECOVERY whose ranking loses one weight at a time; empty = none.
        predictor: Of dead ends.
        weights: Of the fusion network; None = those that come with the package.
        lidar_range: [m].
        seed: Of worlds, starts and noise.
        out: Folder for the table.
        json: Print one JSON object on stdout, and nothing else there.
    """

    rows: tuple[str, ...] = ("drnav:drnav", "drnav:nav2", "nav2-dwb:nav2", "dwa:drnav", "dwa:nav2", "dwa:none")
    trips: int = 200
    families: tuple[str, ...] = CLOSED
    least: float = 1.0
    most: float = 8.0
    ablate: str = "dwa:drnav"
    predictor: Literal["fusion", "geometric", "oracle", "none"] = "geometric"
    weights: Path | None = None
    lidar_range: float = 12.0
    seed: int = 0
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("results") / "recovery"
    json: bool = False

    def __post_init__(self) -> None:
        """Check names and ranges."""
        if self.trips < 1 or not self.rows or not 0 < self.least < self.most:
            raise ValueError("trips and rows must be >= 1 and 0 < least < most [m].")
        unknown = [name for name in self.families if name not in CLOSED]
        if unknown:
            raise ValueError(f"{', '.join(unknown)} are no closed families; there are {', '.join(CLOSED)}.")
        for row in (*self.rows, *filter(None, [self.ablate])):
            setup_of(self, row)


class Trapped(NamedTuple):
    """A trip that starts in a dead end."""

    trip: Trip
    true: GroundTruth
    pocket: int  # that it starts in
    depth: float  # [m]


def setup_of(config: Config, row: str) -> Setup:
    """The setup of PLANNER:RECOVERY."""
    planner, _, recovery = row.partition(":")
    return Setup(
        planner=planner, recovery=recovery or None, predictor=config.predictor, weights=config.weights,
        lidar_range=config.lidar_range, seed=config.seed,
    )  # fmt: skip


def trapped(config: Config, family: str, seed: int, cache: Path) -> Trapped | None:
    """A trip out of a dead end of this world; None where there is none of the depths, or the goal lies in one."""
    scene = worlds.sample(family, seed)
    assert scene.goal is not None
    true = truth(scene, TruthSpec(), cache=cache)
    if evaluate.values_at(true, true.label, np.asarray([scene.goal]))[0]:
        return None
    depth = np.asarray(true.depth, float)
    margin = evaluate.plan_margin(evaluate.NavParams())
    fit = true.label & true.standable & (np.asarray(true.clearance) > true.radius + margin)
    fit &= (depth >= config.least) & (depth <= config.most)
    if not fit.any():
        return None
    rng = np.random.default_rng(np.random.SeedSequence([config.seed, seed, CLOSED.index(family)]))
    wanted = rng.uniform(config.least, min(config.most, depth[fit].max()))  # deep starts are as likely as shallow ones
    near = np.argwhere(fit & (np.abs(depth - wanted) <= 0.3))
    if not len(near):
        return None
    i, j = near[rng.integers(len(near))]
    x, y = true.origin + (np.array([j, i]) + 0.5) * true.resolution
    begin = (float(x), float(y), float(rng.uniform(-np.pi, np.pi)))
    try:
        trip = evaluate.prepare([dataclasses.replace(scene, start=begin)], Setup())[0]
    except ValueError:  # too narrow to get out of
        return None
    return Trapped(trip, true, int(true.pocket[i, j]), float(depth[i, j]))


def gathered(config: Config) -> list[Trapped]:
    """The trips, families in turn."""
    found: list[Trapped] = []
    for k in range(50 * config.trips):
        turn, place = divmod(k, len(config.families))
        one = trapped(config, config.families[place], config.seed + turn, config.out / "truth")
        if one is not None:
            found.append(one)
        if len(found) == config.trips:
            return found
    raise ValueError(f"{len(found)} of {config.trips} trips were found: widen --least and --most, or add families.")


def judged(one: Trapped, path: np.ndarray, limit: float) -> dict[str, Any]:
    """When the robot passed the mouth, and whether it went in again.

    Args:
        one: The trip.
        path: Places `[T, 2]` of all ticks, the start first [m].
        limit: Time that counts where it never escaped [s].
    """
    inside = evaluate.values_at(one.true, np.asarray(one.true.pocket), path) == one.pocket
    out = np.flatnonzero(~inside)
    if not len(out):
        return {"escaped": False, "escape_s": limit, "entered_again": False}
    deep = inside & (evaluate.values_at(one.true, np.asarray(one.true.depth, float), path) > DEEP)
    return {"escaped": True, "escape_s": DT * int(out[0]), "entered_again": bool(deep[out[0] :].any())}


def driven(config: Config, row: str, trips: list[Trapped], without: str = "") -> list[dict[str, Any]]:
    """One record per trip; `without` names a weight of the ranking to set to 0."""
    setup = setup_of(config, row)
    params = evaluate.params_of(setup)
    if without:
        weights = RefugeParams()._replace(**{without: 0.0})
        params = params._replace(recovery=params.recovery._replace(refuge=weights))
    ended = evaluate.evaluate([one.trip for one in trips], setup, params=params)
    if ended.interrupted:
        raise KeyboardInterrupt
    records = []
    for k, (one, record) in enumerate(zip(trips, ended.records, strict=True)):
        start = one.trip.scene.start
        assert start is not None
        seen = judged(one, evaluate.path_driven(ended.result, k, start), one.trip.time_limit)
        records.append(seen | {name: record[name] for name in ("world", "success", "collision", "time_s", "recoveries")})
    return records


def summed(records: list[dict[str, Any]]) -> dict[str, Any]:
    """Rates and means; intervals are bootstrapped."""
    rate = lambda name: float(np.mean([r[name] for r in records]))  # noqa: E731
    escaped = [r for r in records if r["escaped"]]
    again = [r["entered_again"] for r in escaped]
    return {
        "escape_rate": rate("escaped"), "collisions": int(sum(r["collision"] for r in records)),
        "escape_s": float(np.mean([r["escape_s"] for r in escaped])) if escaped else None,
        "reentry_rate": float(np.mean(again)) if again else None, "success_rate": rate("success"),
        "recoveries": rate("recoveries"),
        "not_escaped": [r["world"] for r in records if not r["escaped"]],
        "entered_again": [r["world"] for r in records if r["entered_again"]],
    }  # fmt: skip


def against(ours: list[dict[str, Any]], theirs: list[dict[str, Any]]) -> dict[str, Any] | None:
    """Ratio of the mean times to escape, on the trips that both escape."""
    both = [(a["escape_s"], b["escape_s"]) for a, b in zip(ours, theirs, strict=True) if a["escaped"] and b["escaped"]]
    return metrics.paired(both)


def main(config: Config) -> dict[str, Any]:
    """Drive every row; the figures, written under `out` as well."""
    trips = gathered(config)
    print(f"recovery: {len(trips)} trips", file=sys.stderr)
    records: dict[str, list[dict[str, Any]]] = {}
    for row in config.rows:
        records[row] = driven(config, row, trips)
        print(f"recovery: {row} done", file=sys.stderr)
    first, *others = config.rows
    result: dict[str, Any] = {
        "experiment": "recovery", "seed": config.seed, "trips": len(trips), "predictor": config.predictor,
        "depth_m": {"mean": float(np.mean([t.depth for t in trips])), "most": float(max(t.depth for t in trips))},
        "rows": {row: summed(found) for row, found in records.items()},
        "time_to_escape": {f"{first} / {row}": against(records[first], records[row]) for row in others},
    }  # fmt: skip
    if config.ablate:
        full = records.get(config.ablate) or driven(config, config.ablate, trips)
        result["ablation"] = {"none": summed(full)}
        for name in WEIGHTS:
            found = driven(config, config.ablate, trips, name)
            result["ablation"][f"{name} = 0"] = summed(found) | {"ratio": against(full, found)}
            print(f"recovery: ablation of {name} done", file=sys.stderr)
    config.out.mkdir(parents=True, exist_ok=True)
    report.write(config.out / f"recovery-{config.seed}.json", result | {"episodes": records})
    return result


def table(result: dict[str, Any]) -> str:
    """The rows as text."""
    heads = ("escape_rate", "collisions", "escape_s", "reentry_rate", "success_rate", "recoveries")
    lines = [f"{'':22}" + "".join(f"{name:>14}" for name in heads)]
    for name, values in (result["rows"] | result.get("ablation", {})).items():
        cells = [values[head] for head in heads]
        lines.append(f"{name:22}" + "".join(f"{'-':>14}" if v is None else f"{v:>14.3g}" for v in cells))
    for name, found in result["time_to_escape"].items():
        if found is not None:
            lines.append(
                f"time to escape {name}: {found['ratio']:.3f} ({found['low']:.3f} to {found['high']:.3f}) on the "
                f"{found['trips']} trips that both escape"
            )
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(script(Config, main, table, __doc__))
