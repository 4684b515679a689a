"""How fast does the robot arrive, how far does it drive into dead ends, and how often does its belief raise a false alarm?

    python experiments/closed_loop.py --trips 8 --json
    python experiments/closed_loop.py --groups ../shared/data/maps/willow/map.yaml@12

A group is FAMILY+FAMILY@RANGE (worlds of these families in turn) or a map's file and @RANGE (sampled trips), with the range
of the LiDAR in metres. A row is PLANNER:PREDICTOR; every row drives the same trips. Per row and group: success, collisions,
time to the goal (a failure counts as the limit) and metres driven beyond the mouths of dead ends, by the labels of the trip
(`worlds.labels`); the first row against each other, paired, with bootstrap intervals over trips. Of the first `--watched`
trips of the first row every replan is looked at (`--watched 0`: none):

    false alarm   share of the cells of the shortest way, within the window and known to be free, whose P_dead > 0.5
    recall        share of the dead-end cells, within the window and known to be free, whose P_dead > 0.5
"""

import dataclasses
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro

from drnav_jax import evaluate, metrics, report, sources, worlds
from drnav_jax.evaluate import Evaluation, Setup, Trip
from drnav_jax.filter import belief, dead_end
from drnav_jax.scripts import script
from drnav_jax.sim import episode
from drnav_jax.sim.episode import EpisodeSpec
from drnav_jax.types import GridMap
from drnav_jax.worlds.paths import trip_cells

SPEC = EpisodeSpec()
GROUPS = ("t+l@12", "t+l@6", "maze+office+site@12", "maze+office+site@6")
ALARM = 0.5  # P_dead


@dataclasses.dataclass(frozen=True)
class Config:
    """What is driven, and where results go.

    Attributes:
        rows: PLANNER:PREDICTOR, the one that is compared first.
        groups: FAMILY+FAMILY@RANGE or FILE@RANGE.
        trips: Of each group.
        watched: Trips whose belief is looked at.
        resolution: Edge of a pixel of floor plans [m].
        split: Of the families.
        weights: Of the fusion network; None = those that come with the package.
        seed: First seed of the worlds; of sampled trips and noise.
        out: Folder for the table.
        json: Print one JSON object on stdout, and nothing else there.
    """

    rows: tuple[str, ...] = ("drnav:fusion", "drnav:geometric", "drnav:oracle", "grid:none", "dwa:none")
    groups: tuple[str, ...] = GROUPS
    trips: int = 20
    watched: int = 6
    resolution: float = 0.05
    split: str = "test"
    weights: Path | None = None
    seed: int = 100
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("results") / "closed_loop"
    json: bool = False

    def __post_init__(self) -> None:
        """Check names and ranges."""
        if self.trips < 1 or self.watched < 0 or not self.rows or not self.groups:
            raise ValueError("trips must be >= 1, watched >= 0, and there must be rows and groups.")
        if self.split not in worlds.SPLITS:
            raise ValueError(f'split must be one of {", ".join(worlds.SPLITS)}, got "{self.split}".')
        for group in self.groups:
            range_of(group)
            named = group.rpartition("@")[0]
            if not Path(named).is_file() and (other := [f for f in named.split("+") if f not in worlds.FAMILIES]):
                raise ValueError(f'"{", ".join(other)}" of the group {group} is neither a family of worlds nor a file.')
            for row in self.rows:
                setup_of(self, row, range_of(group))


def range_of(group: str) -> float:
    """The LiDAR's range of a group [m].

    Raises:
        ValueError: If there is none.
    """
    _, _, text = group.rpartition("@")
    try:
        return float(text)
    except ValueError:
        raise ValueError(f'a group is WORLDS@RANGE such as t+l@12, got "{group}".') from None


def setup_of(config: Config, row: str, lidar_range: float) -> Setup:
    """The setup of PLANNER:PREDICTOR."""
    planner, _, predictor = row.partition(":")
    return Setup(
        planner=planner, predictor=predictor or "none", weights=config.weights, lidar_range=lidar_range, seed=config.seed
    )


def trips_of(config: Config, group: str) -> list[Trip]:
    """The trips of a group, the same for all rows."""
    named, _, _ = group.rpartition("@")
    setup = Setup(planner="grid", predictor="none")
    if Path(named).is_file():
        margin = evaluate.plan_margin(evaluate.NavParams())
        scale = None if sources.states_scale(Path(named)) else config.resolution
        source = sources.Source(map=Path(named), resolution=scale, episodes=config.trips, seed=config.seed)
        return evaluate.prepare(sources.load(source, setup.robot_radius, setup.robot_radius + margin), setup)
    families = named.split("+")
    seeds = [(families[k % len(families)], config.seed + k // len(families)) for k in range(config.trips)]
    return evaluate.prepare([worlds.sample(family, seed, config.split) for family, seed in seeds], setup)


def inside(labels: GridMap, path: np.ndarray) -> float:
    """Metres of a driven path `[T, 2]` that lie in dead ends, by where each step ends."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    return float(steps[evaluate.values_at(labels, np.asarray(labels.values), path[1:]) > 0.5].sum())


def alarms(states: Iterable[Any], spec: Any, way: np.ndarray, dead: np.ndarray) -> np.ndarray:
    """(false alarms, cells of the way, alarms, dead-end cells), of the free cells in the window, summed over states.

    Args:
        states: Of one episode (`sim.episode.replay`).
        spec: Of its window.
        way: Cells of the shortest way, x, y `[N, 2]` [m].
        dead: Dead-end cells, likewise.
    """
    counts = np.zeros(4, int)
    for state in states:
        mind = state.policy
        local = belief.local_map(spec, mind.belief)
        free = np.asarray(local.seen & (local.occupancy <= 0))
        p = np.where(free, np.asarray(dead_end.probability(mind.belief.dead_end)), np.nan)
        for k, points in enumerate((way, dead)):
            found = evaluate.values_at(local, p, points, np.nan) if len(points) else np.zeros(0)
            counts[2 * k : 2 * k + 2] += int((found > ALARM).sum()), int(np.isfinite(found).sum())
    return counts


def watched(config: Config, row: str, group: str, trips: list[Trip], labels: list[GridMap]) -> dict[str, Any]:
    """Rates of false alarms and recall over the first trips."""
    setup, counts = setup_of(config, row, range_of(group)), np.zeros(4, int)
    spec = dataclasses.replace(evaluate.equipped(SPEC, setup), chunk_ticks=SPEC.replan_every)
    chosen = trips[: config.watched]
    batch, keys = evaluate.episode_params(chosen, setup), jax.random.split(jax.random.key(setup.seed), len(chosen))
    for k, (trip, label) in enumerate(zip(chosen, labels, strict=False)):
        res, origin = float(label.resolution), np.asarray(label.origin, float)
        centre = lambda cells: origin + (cells[:, ::-1] + 0.5) * res  # noqa: B023, E731
        way = centre(trip_cells(trip.path, origin, res))
        dead = centre(np.argwhere(np.asarray(label.values) > 0.5))
        one = jax.tree.map(lambda a: a[k], batch)  # noqa: B023
        states = episode.replay(spec, evaluate.policy_of(setup.nav), one, keys[k])
        counts += alarms(states, setup.nav.filter, way, dead)
    share = lambda a, b: float(a / b) if b else None  # noqa: E731
    return {
        "trips": len(chosen), "false_alarm": share(counts[0], counts[1]), "recall": share(counts[2], counts[3]),
        "way_cells": int(counts[1]), "dead_cells": int(counts[3]),
    }  # fmt: skip


def summed(ended: Evaluation, labels: list[GridMap]) -> dict[str, Any]:
    """Means of a row in a group, and what each trip gave."""
    deep = []
    for k, trip in zip(ended.kept, ended.trips, strict=True):
        assert trip.scene.start is not None
        deep.append(inside(labels[k], evaluate.path_driven(ended.result, k, trip.scene.start)))
    times = evaluate.times_to_goal(ended)
    return {
        "success_rate": ended.summary["success_rate"], "collisions": sum(r["collision"] for r in ended.records),
        "time_to_goal_s": ended.summary["time_to_goal_s"], "inside_m": float(np.mean(deep)),
        "optimal_s": ended.summary["optimal_s"],
        "trips": {
            trip.scene.name: {"time_s": times[k][0], "success": times[k][1], "inside_m": m}
            for k, trip, m in zip(ended.kept, ended.trips, deep, strict=True)
        },
    }  # fmt: skip


def against(ours: dict[str, Any], theirs: dict[str, Any]) -> dict[str, Any]:
    """Ratio of the times to the goal, of all trips and of those that both solve, and of the metres inside."""
    pairs = list(zip(ours["trips"].values(), theirs["trips"].values(), strict=True))
    both = [(a, b) for a, b in pairs if a["success"] and b["success"]]
    ratio = lambda name, chosen: metrics.paired([(a[name], b[name]) for a, b in chosen])  # noqa: E731
    return {"time": ratio("time_s", pairs), "time_both": ratio("time_s", both), "inside": ratio("inside_m", pairs)}


def driven(config: Config, group: str) -> dict[str, Any]:
    """All rows of a group."""
    trips = trips_of(config, group)
    labels = [evaluate.label_map(trip, Setup().robot_radius) for trip in trips]
    rows: dict[str, Any] = {}
    for row in config.rows:
        said = lambda done, row=row: print(f"\r{group}: {row} {done}/{len(trips)} ", end="", file=sys.stderr)  # noqa: E731
        ended = evaluate.evaluate(trips, setup_of(config, row, range_of(group)), progress=said)
        if ended.interrupted:
            raise KeyboardInterrupt
        rows[row] = summed(ended, labels)
    first = config.rows[0]
    beside = {row: against(rows[first], rows[row]) for row in config.rows[1:]}
    seen = watched(config, first, group, trips, labels) if config.watched else None
    return {"rows": rows, "against": beside, "belief": seen}


def main(config: Config) -> dict[str, Any]:
    """Drive every group; the figures, written under `out` as well after each."""
    config.out.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = {"experiment": "closed_loop", "seed": config.seed, "groups": {}}
    for group in config.groups:
        result["groups"][group] = driven(config, group)
        print(file=sys.stderr)
        report.write(config.out / f"closed_loop-{config.seed}.json", result)
    return result


def table(result: dict[str, Any]) -> str:
    """One line per group and row."""
    text = lambda found: f"{found['ratio']:.2f} [{found['low']:.2f}, {found['high']:.2f}]" if found else "-"  # noqa: E731
    head = f"{'group':24}{'row':18}{'success':>8}{'hit':>5}{'time s':>8}{'inside m':>10}"
    lines = [f"{head}   first row / this: time, inside"]
    for group, found in result["groups"].items():
        for row, r in found["rows"].items():
            beside = found["against"].get(row)
            ratios = f"   {text(beside['time'])}, {text(beside['inside'])}" if beside else ""
            lines.append(
                f"{group[-23:]:24}{row:18}{100 * r['success_rate']:6.0f} %{r['collisions']:5d}{r['time_to_goal_s']:8.1f}"
                f"{r['inside_m']:10.1f}{ratios}"
            )
        seen = found["belief"]
        if seen and seen["false_alarm"] is not None:
            recall = "-" if seen["recall"] is None else f"{100 * seen['recall']:.0f} %"
            lines.append(f"{'':24}false alarms on {100 * seen['false_alarm']:.2f} % of the way's cells, recall {recall}")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(script(Config, main, table, __doc__))
