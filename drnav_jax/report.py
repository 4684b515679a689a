"""What a run leaves behind: tables of figures, paired ratios, pictures and a film of what was believed."""

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from drnav_jax import geometry, metrics, viz
from drnav_jax.filter import FilterSpec, belief, dead_end
from drnav_jax.planning import nav2_recovery, recovery
from drnav_jax.sim.episode import EpisodeState
from drnav_jax.types import GridMap
from drnav_jax.worlds import Scene

MODES = {recovery.DRIVE: "drive", recovery.CLEAR: "recover", recovery.RETREAT: "recover", recovery.STOP: "stop"}
COLUMNS = ("planner", "success", "collisions", "time to goal", "/ optimal", "SPL", "recoveries", "min clearance")


class Drive(NamedTuple):
    """One episode of one planner, as it is drawn."""

    path: np.ndarray  # [T, 2] driven [m]
    record: Mapping[str, Any]  # `metrics.episode`


class Believed(NamedTuple):
    """What a replayed episode's robot believed."""

    p_dead: GridMap  # [H, W] the last belief about each cell that the window ever held
    known: np.ndarray  # [H, W] bool, free or occupied as far as the robot saw
    recovery_points: np.ndarray  # [M, 2] in the end [m]
    frames: list[viz.Frame]


def finite(tree: Any) -> Any:
    """The same tree for JSON: numbers that are not finite become null."""
    if isinstance(tree, Mapping):
        return {key: finite(value) for key, value in tree.items()}
    if isinstance(tree, list | tuple):
        return [finite(value) for value in tree]
    if isinstance(tree, Path):
        return str(tree)
    return None if isinstance(tree, float) and not math.isfinite(tree) else tree


def dumps(tree: Any) -> str:
    """JSON text; the same tree gives the same bytes."""
    return json.dumps(finite(tree), indent=2, allow_nan=False)


def write(file: Path, tree: Any) -> str:
    """Write `dumps` of a tree, which is returned; first under another name, so that no file is half written."""
    text, part = dumps(tree), file.with_name(f"{file.name}.part")
    part.write_text(text + "\n")
    part.replace(file)
    return text


def outline(tree: Mapping[str, Any], indent: str = "") -> str:
    """Nested figures as indented lines."""
    lines = []
    for key, value in tree.items():
        if isinstance(value, Mapping):
            lines += [f"{indent}{key}", outline(value, indent + "  ")]
        else:
            lines.append(f"{indent}{key}: {value:,.4g}" if isinstance(value, float) else f"{indent}{key}: {value}")
    return "\n".join(lines)


def ratios(times: Mapping[str, Mapping[int, tuple[float, bool]]]) -> dict[str, Any]:
    """Time to goal of the first planner over that of each other one, on the same trips.

    Args:
        times: Planner -> number of the trip -> (time to goal with a failure at the limit [s], success).

    Returns:
        "FIRST/OTHER" -> {"all": ..., "both_solve": ...}: ratio of the means with its 95 % bootstrap interval and the
        number of trips; None where no trip is shared, or none was solved by both.
    """

    def ratio(pairs: list[tuple[float, float]]) -> dict[str, Any] | None:
        found = metrics.paired(pairs)
        return found and {name: round(value, 4) for name, value in found.items()}

    first, *others = times
    out = {}
    for other in others:
        shared = [k for k in times[first] if k in times[other]]
        solved = [k for k in shared if times[first][k][1] and times[other][k][1]]
        pairs = [[(times[first][k][0], times[other][k][0]) for k in some] for some in (shared, solved)]
        out[f"{first}/{other}"] = {"all": ratio(pairs[0]), "both_solve": ratio(pairs[1])}
    return out


def table(summaries: Mapping[str, Mapping[str, Any]], paired: Mapping[str, Any] | None = None) -> str:
    """Readable text: one row per planner, and one line per ratio of `ratios`."""
    rows: list[tuple[str, ...]] = [COLUMNS]
    for name, s in summaries.items():
        optimal = s["time_to_goal_s"] / s["optimal_s"] if s["optimal_s"] else math.nan
        rows.append((
            name, f"{100 * s['success_rate']:.0f} %", f"{round(s['collision_rate'] * s['episodes'])}",
            f"{s['time_to_goal_s']:.1f} s", f"{optimal:.2f}", f"{s['spl']:.3f}", f"{s['recoveries']:.1f}",
            f"{s['min_clearance_m']:.2f} m",
        ))  # fmt: skip
    if all("barn_score" in s for s in summaries.values()):
        scores = ["BARN score", *(f"{s['barn_score']:.4f}" for s in summaries.values())]
        rows = [(*row, score) for row, score in zip(rows, scores, strict=True)]
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = ["  ".join(c.ljust(w) if k == 0 else c.rjust(w) for k, (c, w) in enumerate(zip(row, widths, strict=True)))
             for row in rows]  # fmt: skip
    lines.insert(1, "-" * len(lines[0]))
    limits = {s["time_limit_s"] for s in summaries.values()}
    count = {s["episodes"] for s in summaries.values()}
    limit = " / ".join(f"{x:.1f} s" for x in sorted(limits))
    many = f"{' / '.join(map(str, sorted(count)))} episode{'s' if max(count) > 1 else ''} each"
    lines += ["", f"{many}; in the time to goal a failure counts as the time limit (mean {limit})."]
    for name, found in (paired or {}).items():
        both = found["both_solve"]
        solved = "no trip was solved by both" if both is None else f"where both arrive {_interval(both)}"
        if found["all"] is not None:
            lines.append(f"time to goal {name.replace('/', ' / ')}: {_interval(found['all'])}; {solved}")
    return "\n".join(lines)


def _interval(found: Mapping[str, Any]) -> str:
    if found["trips"] == 1:
        return f"{found['ratio']:.3f} (1 trip)"
    return f"{found['ratio']:.3f} [{found['low']:.3f}, {found['high']:.3f}] ({found['trips']} trips)"


def outcome(record: Mapping[str, Any]) -> str:
    """How an episode ended, in words."""
    if record["success"]:
        return f"reached in {record['time_s']:.1f} s"
    return f"{'collision after' if record['collision'] else 'not reached in'} {record['time_s']:.1f} s"


def believe(
    states: Iterable[EpisodeState], spec: FilterSpec, path: np.ndarray, dt: float, keep_every: int
) -> Believed:
    """Gather what a robot believed from its states.

    Args:
        states: Of one episode in the order of time (`sim.episode.replay`); the policy's state is a `NavState`.
        spec: Of its window.
        path: As driven `[T, 2]`, one row per tick and the start.
        dt: Tick [s].
        keep_every: Every so many states give a frame; 0 = none.

    Raises:
        ValueError: If there are no states.
    """
    low = np.asarray(geometry.window_corner(jnp.asarray(path.min(axis=0), jnp.float32), spec.grid))
    high = np.asarray(geometry.window_corner(jnp.asarray(path.max(axis=0), jnp.float32), spec.grid))
    shape = tuple(high - low + np.asarray(spec.grid.shape))
    known, p, frames, mind = np.zeros(shape, bool), np.zeros(shape, np.float32), [], None
    for k, state in enumerate(states):
        mind = state.policy
        local = belief.local_map(spec, mind.belief)
        seen, p_dead = np.asarray(local.seen), np.asarray(dead_end.probability(mind.belief.dead_end))
        row, column = np.clip(np.asarray(mind.belief.corner) - low, 0, high - low)
        part = np.s_[row : row + seen.shape[0], column : column + seen.shape[1]]
        known[part] |= seen
        p[part] = np.where(seen, p_dead, p[part])
        if keep_every and (k % keep_every == 0 or not bool(state.active)):
            frames.append(_frame(state, local, seen, p_dead.astype(np.float16), path, dt))
    if mind is None:
        raise ValueError("an episode without states shows no belief.")
    resolution = np.asarray(spec.grid.resolution, np.float32)
    canvas = _grid(p, low[::-1] * resolution, resolution)
    points = np.asarray(mind.points.xy)[np.asarray(mind.points.valid)]
    return Believed(p_dead=canvas, known=known, recovery_points=points, frames=frames)


def _grid(values: Any, origin: Any, resolution: Any) -> GridMap:
    """A grid on the host; `Any`, since containers declare their fields for JAX's arrays."""
    return GridMap(values=values, origin=origin, resolution=resolution)


def _frame(state: EpisodeState, local: Any, seen: np.ndarray, p_dead: np.ndarray, path: np.ndarray, dt: float) -> Any:
    mind, tick = state.policy, int(state.tick)
    occupied = np.asarray(dead_end.probability(local.occupancy), np.float16)
    origin, resolution = np.asarray(local.origin), np.asarray(local.resolution)
    nav2 = None if mind.follower is None else mind.follower.recovery
    return viz.Frame(
        pose=np.asarray(state.pose),
        path=path[: tick + 1],
        occupancy=_grid(np.where(seen, occupied, np.float16(-1)), origin, resolution),
        p_dead=_grid(p_dead, origin, resolution),
        recovery_points=np.asarray(mind.points.xy)[np.asarray(mind.points.valid)],
        local_goal=np.asarray(mind.local_goal),
        mode=MODES[int(mind.recovery.mode if nav2 is None else nav2_recovery.as_drnav(nav2.mode))],
        time=tick * dt,
    )


def picture(
    file: Path, scene: Scene, drives: Mapping[str, Drive], believed: Believed | None, shortest: np.ndarray,
    goal_tolerance: float, title: str,
) -> Path:  # fmt: skip
    """The trajectory picture of one trip: paths of all planners over the belief of one of them."""
    assert scene.start is not None and scene.goal is not None
    return viz.trajectories(
        file,
        occupied=scene.occupied,
        origin=scene.origin,
        resolution=scene.resolution,
        start=scene.start,
        goal=scene.goal,
        goal_tolerance=goal_tolerance,
        paths={name: drive.path for name, drive in drives.items()},
        outcome={name: outcome(drive.record) for name, drive in drives.items()},
        p_dead=None if believed is None else believed.p_dead,
        known=None if believed is None else believed.known,
        recovery_points=None if believed is None else believed.recovery_points,
        shortest=shortest,
        title=title,
    )


def film(file: Path, scene: Scene, believed: Believed, goal_tolerance: float, radius: float) -> Path:
    """The film of one robot's belief."""
    assert scene.goal is not None
    return viz.belief(
        file, believed.frames, goal=scene.goal, goal_tolerance=goal_tolerance, radius=radius,
        true_occupied=scene.occupied, true_origin=scene.origin, true_resolution=scene.resolution,
    )  # fmt: skip
