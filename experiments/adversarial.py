"""What breaks a planner: no way, ways that are barely wide enough, goals that cannot be, and a body that does not obey.

    python experiments/adversarial.py --planners drnav,grid --json

Each case is a small world with a trip, a fault of the body, or both; the robot has five minutes. It shall not collide,
command nothing that is not a number or beyond what it can do, and not go on for ever: at the end it is at the goal, or it
stands still and says so (mode "stop", or that it has arrived, for the last `STILL` seconds). A robot whose odometry drifts
arrives where it takes the goal to be: off by no more than the drift of its way. A command is beyond the limits if it is
outside the robot's speeds, or farther from those that it meets when it acts than accelerations allow for within a tick.
"""

import dataclasses
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
import tyro

from drnav_jax import evaluate, report
from drnav_jax.evaluate import Setup, Trip
from drnav_jax.planning import recovery
from drnav_jax.scripts import script
from drnav_jax.sim import FaultParams, episode
from drnav_jax.sim.episode import EpisodeSpec
from drnav_jax.types import RobotParams
from drnav_jax.worlds import Scene, World, make_world

RADIUS = 0.25  # [m]
STILL = 5.0  # [s]
TOLERANCE = 0.75  # [m]
SPEC = EpisodeSpec(chunk_ticks=10)


class Case(NamedTuple):
    """One trip."""

    world: World
    start: tuple[float, float, float]
    goal: tuple[float, float]
    arrives: bool | None  # whether the robot must arrive, must not, or may do either
    faults: FaultParams = FaultParams()


def wall(ax: float, ay: float, bx: float, by: float, thick: float = 0.2) -> list[float]:
    """A wall between two points [m], as a row of `World.boxes`."""
    length, yaw = math.hypot(bx - ax, by - ay), math.atan2(by - ay, bx - ax)
    return [(ax + bx) / 2, (ay + by) / 2, yaw, length / 2, thick / 2, 0.0, 2.0]


def room(left: float, low: float, right: float, high: float) -> list[list[float]]:
    """Four walls."""
    corners = [(left, low), (right, low), (right, high), (left, high)]
    return [wall(*a, *b) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]


def clutter(seed: int, low: tuple[float, float], high: tuple[float, float], keep: list[tuple[float, float]]) -> list:
    """Pillars 2 m apart or so, none within 1.2 m of the points to keep free; rows of `World.cylinders`."""
    rng = np.random.default_rng(seed)
    rows = []
    for x in np.arange(low[0], high[0], 2.0):
        for y in np.arange(low[1], high[1], 2.0):
            px, py = x + rng.uniform(-0.4, 0.4), y + rng.uniform(-0.4, 0.4)
            if min(math.hypot(px - a, py - b) for a, b in keep) > 1.2:
                rows.append([px, py, rng.uniform(0.1, 0.35), 0.0, 2.0])
    return rows


def _gap(width: float) -> Case:
    """Two halves of a room, and a gap of that width between them."""
    parts = [wall(4.0, -3.0, 4.0, -width / 2), wall(4.0, width / 2, 4.0, 3.0)]
    return Case(make_world(room(-2.0, -3.0, 10.0, 3.0) + parts), (0.0, 0.6, 0.0), (8.0, -0.5), None)


def _pocket() -> Case:
    """The goal at the end of a pocket that opens away from the robot."""
    parts = [wall(5.0, -1.5, 5.0, 1.5), wall(5.0, 1.5, 9.0, 1.5), wall(5.0, -1.5, 9.0, -1.5)]
    return Case(make_world(parts), (0.0, 0.0, 0.0), (6.0, 0.0), True)


def _course(faults: FaultParams) -> Case:
    """A slalom: pillars, a wall across the way, a doorway of 1.2 m, a corner."""
    boxes = [wall(3.0, -4.0, 3.0, 1.5), wall(6.5, -0.6, 6.5, -5.0), wall(6.5, 0.6, 6.5, 5.0), wall(9.0, 1.2, 12.0, 1.2)]
    pillars = [[1.5, 0.3, 0.2, 0.0, 2.0], [4.8, 1.2, 0.25, 0.0, 2.0], [8.4, -0.3, 0.2, 0.0, 2.0]]
    return Case(make_world(boxes, pillars), (0.0, 0.0, 0.0), (11.0, 2.6), True, faults)


def _block(inside: bool) -> Case:
    """The goal in the middle of a block of 2.4 m, in a room or in the open."""
    block = [[6.0, 0.0, 0.3, 1.2, 1.2, 0.0, 2.0]]
    around = room(-2.0, -4.0, 10.0, 4.0) if inside else []
    return Case(make_world(block + around), (0.0, 0.0, 0.0), (6.0, 0.0), False)


def _far() -> Case:
    """60 m through pillars: the window moves all the way, along both of its axes."""
    start, goal = (0.0, 0.0), (45.0, 40.0)
    pillars = [p for p in clutter(3, (1.0, 1.0), (45.0, 41.0), [start, goal]) if abs(40 * p[0] - 45 * p[1]) < 500]
    return Case(make_world((), pillars), (*start, 0.3), goal, True)


CASES: dict[str, Callable[[], Case]] = {
    "walled in": lambda: Case(make_world(room(-1.2, -1.2, 1.2, 1.2)), (0.0, 0.0, 0.0), (8.0, 0.0), False),
    "tight": lambda: Case(make_world(room(-0.45, -0.45, 0.45, 0.45)), (0.0, 0.0, 0.0), (8.0, 0.0), False),
    "goal behind": lambda: Case(make_world([wall(1.0, -1.0, 1.0, 1.0)]), (0.0, 0.0, 0.0), (-6.0, 0.0), True),
    "goal in a pocket": _pocket,
    "goal in a block indoors": lambda: _block(True),
    "goal in a block outdoors": lambda: _block(False),
    "gap of 2R + 0.1 m": lambda: _gap(2 * RADIUS + 0.1),
    "gap of 2R - 0.1 m": lambda: _gap(2 * RADIUS - 0.1)._replace(arrives=False),
    "window moves": _far,
    "wall longer than the window": lambda: Case(
        make_world([wall(3.0, -18.0, 3.0, 16.0)]), (0.0, 0.0, 0.0), (8.0, 0.0), True
    ),
    "no fault": lambda: _course(FaultParams()),
    "delay of 0.3 s": lambda: _course(FaultParams(delay=0.3)),
    "slip of 20 %": lambda: _course(FaultParams(slip_v=0.2, slip_omega=0.2)),
    "drift of 2 %": lambda: _course(FaultParams(drift_distance=0.02)),
    "all faults": lambda: _course(
        FaultParams(slip_v=0.2, slip_omega=0.2, drift_distance=0.02, delay=0.3)
    ),
}


@dataclasses.dataclass(frozen=True)
class Config:
    """What is driven, and where results go.

    Attributes:
        planners: Some of `planning.PLANNERS`, by comma.
        cases: Some of the cases, by comma; empty = all.
        minutes: Simulated time per case.
        predictor: Of dead ends.
        seed: Of sensor noise.
        out: Folder for the table.
        json: Print one JSON object on stdout, and nothing else there.
    """

    planners: str = "drnav"
    cases: str = ""
    minutes: float = 5.0
    predictor: str = "geometric"
    seed: int = 0
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("results") / "adversarial"
    json: bool = False

    def __post_init__(self) -> None:
        """Check names and ranges."""
        unknown = [name for name in self.named if name not in CASES]
        if unknown:
            raise ValueError(f'There is no case "{unknown[0]}": choose from {", ".join(CASES)}.')
        if self.minutes * 60 < 2 * STILL:
            raise ValueError(f"minutes must be >= {2 * STILL / 60:.2f}, got {self.minutes}.")
        if self.predictor == "oracle":
            raise ValueError("these cases have no labels for an oracle: choose fusion, geometric or none.")
        for name in self.planners.split(","):
            Setup(planner=name, predictor=self.predictor)

    @property
    def named(self) -> list[str]:
        """The cases."""
        return [name.strip() for name in self.cases.split(",")] if self.cases else list(CASES)


def trip_of(name: str, case: Case, limit: float) -> Trip:
    """The case as a trip, though its goal may not be reachable."""
    nothing = np.zeros((2, 2), bool)
    scene = Scene(name, case.world, nothing, (0.0, 0.0), 0.1, start=case.start, goal=case.goal)
    return Trip(scene, math.nan, np.zeros((0, 2)), limit, TOLERANCE)


def motors(commands: np.ndarray, robot: RobotParams, dt: float) -> np.ndarray:
    """Speeds `[T, 2]` that each of the commands meets when it acts, however late that is, as `sim.kinematic` has it."""
    low, high = np.array([robot.v_min, -robot.w_max]), np.array([robot.v_max, robot.w_max])
    rate = np.array([robot.a_max, robot.alpha_max]) * dt
    speeds = [np.zeros(2)]
    for wanted in commands:
        speeds.append(np.clip(np.clip(wanted, low, high), speeds[-1] - rate, speeds[-1] + rate))
    return np.array(speeds[:-1])


def beyond(commands: np.ndarray, robot: RobotParams, dt: float, tiny: float = 1e-4) -> int:
    """How many commands are not numbers, or beyond the limits (module docstring)."""
    low, high = np.array([robot.v_min, -robot.w_max]), np.array([robot.v_max, robot.w_max])
    rate = np.array([robot.a_max, robot.alpha_max]) * dt
    finite = np.asarray(np.isfinite(commands).all(axis=1))
    known = np.where(finite[:, None], commands, 0.0)
    far = np.abs(known - motors(known, robot, dt)) > rate + tiny
    wrong = ~finite | (known < low - tiny).any(axis=1) | (known > high + tiny).any(axis=1) | far.any(axis=1)
    return int(wrong.sum())


def judged(case: Case, result: episode.Result, k: int) -> dict[str, Any]:
    """What became of one case."""
    ticks, dt, state = int(result.log.active[k].sum()), SPEC.dt, result.state
    log = jax.tree.map(lambda a: a[k, :ticks], result.log)
    success, collision = bool(state.success[k]), bool(state.collision[k])
    numbers = all(np.isfinite(a).all() for a in jax.tree.leaves(log) if a.dtype == np.float32)
    last = round(STILL / dt)
    arrived = log.policy["arrived"][-last:].all()
    stands = np.abs(log.command[-last:]).max() < 1e-3 and (arrived or (log.policy["mode"][-last:] == recovery.STOP).all())
    modes = np.bincount(log.policy["mode"], minlength=len(recovery.MODES)) * dt
    wrong = beyond(log.command.astype(float), RobotParams(radius=RADIUS), dt)
    return {
        "success": success, "collision": collision, "stopped": bool(stands and not success and not collision),
        "says_arrived": bool(arrived), "off_m": round(math.dist(case.goal, log.pose[-1, :2]), 2),
        "finite": bool(numbers), "beyond_limits": wrong, "time_s": round(ticks * dt, 1),
        "distance_m": round(float(state.distance[k]), 2), "min_clearance_m": round(float(state.min_clearance[k]), 3),
        "recoveries": int(log.policy["recoveries"][-1]),
        "modes_s": {name: round(float(s), 1) for name, s in zip(recovery.MODES, modes, strict=True)},
    }  # fmt: skip


def verdict(case: Case, found: dict[str, Any]) -> str:
    """Whether that is as it shall be, else what is wrong."""
    if found["collision"]:
        return "collision"
    if not found["finite"] or found["beyond_limits"]:
        return "broken command"
    if not (found["success"] or found["stopped"]):
        return "livelock"
    drifted = float(case.faults.drift_distance) * found["distance_m"]
    arrived = found["success"] or (found["says_arrived"] and found["off_m"] <= TOLERANCE + drifted)
    if case.arrives is not None and arrived != case.arrives:
        return "gave up" if case.arrives else "impossible"
    return "ok"


def driven(config: Config, planner: str) -> dict[str, dict[str, Any]]:
    """One record per case, all in one batch."""
    setup = Setup(planner=planner, predictor=config.predictor, robot_radius=RADIUS, seed=config.seed)
    cases = {name: CASES[name]() for name in config.named}
    trips = [trip_of(name, case, config.minutes * 60.0) for name, case in cases.items()]
    batch = evaluate.episode_params(trips, setup)
    faults: Any = jax.tree.map(lambda *a: np.asarray(a, np.float32), *[case.faults for case in cases.values()])
    keys = jax.random.split(jax.random.key(setup.seed), len(trips))
    progress = lambda done: print(f"\radversarial: {planner} {done}/{len(trips)} ", end="", file=sys.stderr)  # noqa: E731
    spec = evaluate.equipped(SPEC, setup)
    result = episode.run(spec, evaluate.policy_of(setup.nav), batch._replace(faults=faults), keys, progress=progress)
    if not result.finished.all():
        raise KeyboardInterrupt
    records = {}
    for k, (name, case) in enumerate(cases.items()):
        found = judged(case, result, k)
        records[name] = {"verdict": verdict(case, found)} | found
    return records


def main(config: Config) -> dict[str, Any]:
    """Drive every planner; the figures, written under `out` as well."""
    rows = {planner: driven(config, planner) for planner in config.planners.split(",")}
    print(file=sys.stderr)
    head = {"experiment": "adversarial", "seed": config.seed, "minutes": config.minutes, "predictor": config.predictor}
    result = head | {"planners": rows}
    config.out.mkdir(parents=True, exist_ok=True)
    report.write(config.out / f"adversarial-{config.seed}.json", result)
    return result


def table(result: dict[str, Any]) -> str:
    """One line per planner and case."""
    lines = [f"{'planner':15}{'case':30}{'verdict':16}{'ended':9}{'time s':>8}{'driven m':>10}{'clear m':>9}{'recov.':>7}"]
    for planner, records in result["planners"].items():
        for name, r in records.items():
            ended = "arrived" if r["success"] else "hit" if r["collision"] else "stopped" if r["stopped"] else "drives"
            lines.append(
                f"{planner:15}{name:30}{r['verdict']:16}{ended:9}{r['time_s']:8.1f}{r['distance_m']:10.1f}"
                f"{r['min_clearance_m']:9.3f}{r['recoveries']:7d}"
            )
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(script(Config, main, table, __doc__))
