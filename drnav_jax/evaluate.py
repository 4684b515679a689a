"""Closed-loop evaluation: scenes with trips -> batched episodes -> records. What the commands and experiments share."""

import dataclasses
import functools
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from drnav_jax import metrics, navigator, worlds
from drnav_jax.models import fusion, geometric, oracle, silent, weights
from drnav_jax.navigator import NavParams, NavSpec
from drnav_jax.planning.compositions import planner
from drnav_jax.planning.goal_generator import GeneratorSpec
from drnav_jax.planning.tracker import Critics
from drnav_jax.sim import CameraParams, episode, mjx
from drnav_jax.sim.episode import EpisodeParams, EpisodeSpec
from drnav_jax.sim.lidar import LidarParams
from drnav_jax.sim.mjx import MjxSpec
from drnav_jax.types import GridMap, RigSpec, RobotParams
from drnav_jax.worlds import Scene
from drnav_jax.worlds.truth import TruthSpec, truth

PREDICTORS = ("fusion", "geometric", "oracle", "none")
PHYSICS = ("kinematic", "mjx")
STEP_LENGTH = 0.0125  # [m] that the fastest robot moves in one time step of MJX: how deep it may enter an obstacle
MAX_SPEED = 2.5  # [m/s] from which the DWA's certificate still stops (`TrackerSpec.brake_ticks`)
LABEL_RESOLUTION = 0.1  # [m] labels need no finer grid


@dataclasses.dataclass(frozen=True)
class Setup:
    """One evaluation's robot, sensors and limits; the defaults are the design's.

    Attributes:
        planner: A row of `planning.compositions`.
        predictor: Where dead-end evidence comes from: fusion, geometric, oracle or none.
        weights: File of the fusion network's weights; None = those that come with the package.
        recovery: What the planner does when stuck: drnav, nav2 or none; None = its own.
        risk_weight: Lambda of eq. 7 and of the route's cell cost; None = the planner's default.
        horizon: H [s]; None = the planner's default.
        robot_radius: [m].
        max_speed: [m/s].
        lidar_range: [m].
        goal_tolerance: [m]; None = the world's own, else 0.75.
        time_limit: [s]; None = the world's own, else `limit_factor` times the optimal time, at least 60 s.
        limit_factor: See `time_limit`.
        num_candidates: Candidates of the goal generator, controls and headings together.
        seed: Of sensor noise.
        physics: How the robot moves: kinematic, or mjx (inertia, grip and contact forces).
        mjx_boxes: Boxes that a world may have with mjx, its map's walls merged into rectangles.
    """

    planner: str = "drnav"
    predictor: str = "geometric"
    weights: Path | None = None
    recovery: str | None = None
    risk_weight: float | None = None
    horizon: float | None = None
    robot_radius: float = 0.25
    max_speed: float = 1.0
    lidar_range: float = 12.0
    goal_tolerance: float | None = None
    time_limit: float | None = None
    limit_factor: float = 6.0
    num_candidates: int = 1024
    seed: int = 0
    physics: str = "kinematic"
    mjx_boxes: int = MjxSpec.num_boxes

    def __post_init__(self) -> None:
        """Check ranges."""
        planner(self.planner, self.recovery)
        if self.physics not in PHYSICS:
            raise ValueError(f'There is no physics "{self.physics}": choose from {", ".join(PHYSICS)}.')
        if self.predictor not in PREDICTORS:
            raise ValueError(f'There is no predictor "{self.predictor}": choose from {", ".join(PREDICTORS)}.')
        rules = {
            "robot_radius": (0.05, 0.4, "m"), "max_speed": (0.05, MAX_SPEED, "m/s"), "lidar_range": (1.0, 12.0, "m"),
            "goal_tolerance": (0.05, 10.0, "m"), "time_limit": (1.0, 1e5, "s"), "horizon": (0.5, 4.0, "s"),
            "risk_weight": (0.0, 1e3, ""), "limit_factor": (1.0, 1e3, ""),
        }  # fmt: skip
        for name, (low, high, unit) in rules.items():
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and low <= value <= high):
                raise ValueError(f"{name} must lie within {low}..{high} {unit}".rstrip() + f", got {value}.")
        if self.weights is not None and not self.weights.is_file():
            raise ValueError(f"{self.weights} is no file of weights.")
        if self.num_candidates < 320:
            raise ValueError(f"num_candidates must be >= 320, got {self.num_candidates}.")

    @property
    def evidence(self) -> str:
        """The predictor that is asked: none by planners to which dead ends do not matter."""
        return self.predictor if planner(self.planner).predicts else "none"

    @property
    def nav(self) -> NavSpec:
        """The robot's spec."""
        return spec_of(self.planner, self.evidence, self.num_candidates, self.weights, self.recovery)


def equipped(spec: EpisodeSpec, setup: Setup) -> EpisodeSpec:
    """The spec of episodes with the setup's cameras and physics; a fast robot is simulated in shorter time steps.

    Raises:
        ValueError: If `mjx_boxes` is out of range.
    """
    if setup.evidence == "fusion":
        spec = dataclasses.replace(spec, rig=RigSpec())
    if setup.physics == "kinematic":
        return dataclasses.replace(spec, physics=None)
    steps = math.ceil(spec.dt * max(setup.max_speed, 1.0) / STEP_LENGTH - 1e-9)
    return dataclasses.replace(spec, physics=MjxSpec(timestep=spec.dt / steps, num_boxes=setup.mjx_boxes))


class Trip(NamedTuple):
    """A scene that can be driven, with what is known of it beforehand."""

    scene: Scene
    shortest: float  # [m] at the planning margin
    path: np.ndarray  # [L, 2] corners of the shortest way
    time_limit: float  # [s]
    goal_tolerance: float  # [m]


@functools.cache
def trained(file: Path | None) -> weights.Trained:
    """The weights of a file, or those that come with the package."""
    return weights.load(weights.SHIPPED if file is None else file)


@functools.cache
def spec_of(
    planner_name: str, predictor: str, num_candidates: int, file: Path | None = None, recovery: str | None = None
) -> NavSpec:
    """The robot's spec: 256 headings, the other candidates are controls; `file` holds the fusion network's weights."""
    without = {"geometric": geometric.predict, "oracle": oracle.predict, "none": silent.predict}
    predict = without[predictor] if predictor in without else fusion.predictor(trained(file).spec)
    speeds = 12 if num_candidates < 2048 else 16
    generator = GeneratorSpec(num_speeds=speeds, num_turns=(num_candidates - 256) // speeds, num_headings=256)
    return NavSpec(planner=planner(planner_name, recovery), predictor=predict, generator=generator)


@functools.cache
def policy_of(spec: NavSpec, explained: bool = False) -> episode.Policy:
    """The navigator as the simulator wants it; it logs mode, g*, EDE, P_dead, recoveries and arrival of every tick.

    Args:
        spec: The robot.
        explained: Log what `explain` reads, too: the terms of the choices and of the ten best candidates.
    """

    def init(params: NavParams, pose: jax.Array) -> navigator.NavState:
        return navigator.init(spec, params, pose)

    def step(params: NavParams, state: navigator.NavState, observation: Any, key: Any, replan: bool) -> tuple:
        state, command, info = navigator.step(spec, params, state, observation, key, replan=replan)
        log = {
            "mode": info.mode, "local_goal": info.local_goal.xy, "exposure": info.local_goal.exposure,
            "p_dead": info.p_dead, "recoveries": info.recoveries, "certified": info.track.certified,
            "arrived": info.arrived,
        }  # fmt: skip
        if explained:
            goal = info.local_goal
            chosen, best = (jnp.stack(terms, axis=-1) for terms in (goal.terms, goal.best))
            log["why_goal"] = Critics(chosen=chosen[0], best=best, best_cost=goal.best_score)
            log["why_command"] = info.track.critics
        return state, command, log

    return episode.Policy(init=init, step=step)


def plan_margin(params: NavParams) -> float:
    """The outermost planning margin beyond the radius [m]: what the optimal time is computed with."""
    return float(params.route.closed_margin) + 0.02


def prepare(scenes: list[Scene], setup: Setup) -> list[Trip]:
    """Check that every scene's trip can be driven, and what would be optimal.

    Raises:
        ValueError: If a start or goal is not free, or no way joins them, or the world is too large for the physics;
            says where and what to do.
    """
    physics = equipped(EpisodeSpec(), setup).physics
    if physics is not None:
        mjx.solids_of([scene.world for scene in scenes], physics)
    margin = plan_margin(NavParams())
    trips = []
    for scene in scenes:
        try:
            shortest, path = worlds.check_trip(scene, setup.robot_radius, setup.robot_radius + margin)
        except ValueError:  # narrower than the planner likes, but perhaps not than the robot is
            shortest, path = worlds.check_trip(scene, setup.robot_radius)
        limit = setup.time_limit or scene.time_limit
        limit = limit or max(60.0, setup.limit_factor * shortest / setup.max_speed)
        tolerance = setup.goal_tolerance or scene.goal_tolerance or 0.75
        trips.append(Trip(scene, shortest, path, limit, tolerance))
    return trips


def _float32(values: Any) -> Any:
    """Host values; `Any`, since containers declare their fields for JAX's arrays."""
    return np.asarray(values, np.float32)


def label_map(trip: Trip, radius: float) -> GridMap:
    """Trip-conditioned true labels (`worlds.labels`) as the oracle reads them: 1 = dead end.

    Labels are defined where a robot's centre may be; they are grown by its radius so that they fill their pockets.
    """
    known = truth(trip.scene, TruthSpec(radius=radius, resolution=LABEL_RESOLUTION), trip_path=trip.path)
    values, origin = _float32(known.label), _float32(known.origin)
    return GridMap(values=values, origin=origin, resolution=_float32(known.resolution))


def values_at(grid: Any, values: np.ndarray, xy: np.ndarray, fill: float = 0.0) -> np.ndarray:
    """Values `[N]` of the cells under points (host code).

    Args:
        grid: `GridMap` or `GroundTruth`: whose `origin` and `resolution` count.
        values: `[H, W]` on it.
        xy: `[N, 2]` [m].
        fill: Off the grid.
    """
    j, i = np.floor((np.asarray(xy) - np.asarray(grid.origin)) / float(grid.resolution)).astype(int).T
    h, w = values.shape
    held = (i >= 0) & (i < h) & (j >= 0) & (j < w)
    return np.where(held, values[np.clip(i, 0, h - 1), np.clip(j, 0, w - 1)], fill)


def params_of(setup: Setup) -> NavParams:
    """The navigator's parameters under this setup, before any world is known."""
    params = NavParams()
    robot = RobotParams(radius=setup.robot_radius, v_max=setup.max_speed)
    score, route, critics = params.score, params.route, params.follower.critics
    if setup.risk_weight is not None:
        score = score._replace(risk_weight=setup.risk_weight)
        route = route._replace(risk_weight=setup.risk_weight)
        critics = critics._replace(exposure=critics.exposure._replace(weight=setup.risk_weight))
    if setup.horizon is not None:
        score = score._replace(horizon=setup.horizon)
    occupancy = params.filter.occupancy._replace(max_range=setup.lidar_range)
    rule = geometric.GeometricParams(radius=setup.robot_radius)
    predictor: Any = {"geometric": rule}.get(setup.evidence)
    if setup.evidence == "fusion":
        predictor = fusion.params_of(trained(setup.weights), rule=rule)
    belief = params.filter.dead_end
    if setup.evidence == "oracle":  # its labels are those of the trip
        belief = belief._replace(extent=0.0)
    return params._replace(
        robot=robot, score=score, route=route, predictor=predictor, follower=params.follower._replace(critics=critics),
        filter=params.filter._replace(occupancy=occupancy, dead_end=belief),
    )  # fmt: skip


def _stack(trees: list[Any]) -> Any:
    return jax.tree.map(lambda *a: np.stack([np.asarray(x, np.float32) for x in a]), *trees)


def _pad_maps(maps: list[GridMap]) -> list[GridMap]:
    h, w = (max(m.values.shape[a] for m in maps) for a in (0, 1))
    pad = lambda v: np.pad(v, ((0, h - v.shape[0]), (0, w - v.shape[1])))  # noqa: E731
    return [m._replace(values=pad(m.values)) for m in maps]


def episode_params(trips: list[Trip], setup: Setup, params: NavParams | None = None) -> EpisodeParams:
    """The batch of episodes `[B, ...]`.

    Args:
        trips: What is driven.
        setup: Robot, planner, sensors.
        params: In place of the setup's own, of which they are made (`params_of`).

    Raises:
        ValueError: If `params` hold those of another predictor.
    """
    usual = params_of(setup)
    params = usual if params is None else params
    given, needed = (type(p.predictor).__name__ for p in (params, usual))
    if given != needed:
        raise ValueError(f"params.predictor is {given}, {setup.predictor} needs {needed}: begin with params_of(setup).")
    each = [params._replace(goal_tolerance=t.goal_tolerance) for t in trips]
    if setup.evidence == "oracle":
        labels = _pad_maps([label_map(t, setup.robot_radius) for t in trips])
        each = [p._replace(predictor=oracle.OracleParams(label=m)) for p, m in zip(each, labels, strict=True)]
    spread = lambda tree: _stack([tree] * len(trips))  # noqa: E731
    physics = equipped(EpisodeSpec(), setup).physics
    every = [t.scene.world for t in trips]
    solids = () if physics is None else mjx.solids_of(every, physics)
    return EpisodeParams(
        world=worlds.stack_worlds(every, multiple_of=16),  # similar trips share compiled programs
        start=_float32([t.scene.start for t in trips]), goal=_float32([t.scene.goal for t in trips]),
        time_limit=_float32([t.time_limit for t in trips]), goal_tolerance=_float32([t.goal_tolerance for t in trips]),
        robot=spread(params.robot), policy=_stack(each), faults=spread(episode.FaultParams()), solids=solids,
        lidar=spread(LidarParams(max_range=setup.lidar_range)),
        camera=spread(CameraParams()) if setup.evidence == "fusion" else (),
        motors=() if physics is None else spread(mjx.MjxParams()),
    )  # fmt: skip


class Evaluation(NamedTuple):
    """What a batch of episodes gave."""

    records: list[dict[str, Any]]  # of the finished episodes, in the order of the trips
    summary: dict[str, Any]
    trips: list[Trip]  # the finished ones
    kept: list[int]  # their numbers among all trips
    result: episode.Result
    interrupted: bool
    wall_s: float


def evaluate(
    trips: list[Trip],
    setup: Setup,
    *,
    params: NavParams | None = None,
    progress: Callable[[int], None] | None = None,
    spec: EpisodeSpec = EpisodeSpec(),  # noqa: B008 (immutable)
    explained: bool = False,
) -> Evaluation:
    """Drive every trip once, in one batch.

    Args:
        trips: From `prepare`.
        setup: Robot, planner, predictor.
        params: Overrides the setup's navigator parameters.
        progress: Called with the number of finished episodes.
        spec: Sizes of the simulation; its physics is the setup's.
        explained: Log which terms decided (`policy_of`).

    Raises:
        ValueError: If there is no trip.
        KeyboardInterrupt: If interrupted before any episode was finished.
    """
    if not trips:
        raise ValueError("there is no trip to drive.")
    ticks, robots = (spec.dt, spec.replan_every), (setup.nav.dt, setup.nav.replan_every)
    if ticks != robots:
        raise ValueError(f"the simulation's tick [s] and its ticks per replan, {ticks}, must be the robot's, {robots}.")
    begin = time.perf_counter()
    batch = episode_params(trips, setup, params)
    keys = jax.random.split(jax.random.key(setup.seed), len(trips))
    policy = policy_of(setup.nav, explained)
    result = episode.run(equipped(spec, setup), policy, batch, keys, progress=progress)
    kept = [k for k in range(len(trips)) if result.finished[k]]
    if not kept:
        raise KeyboardInterrupt
    records = [_record(trips[k], result, k, setup.max_speed, spec.dt) for k in kept]
    return Evaluation(
        records=records,
        summary=metrics.summary(records, [trips[k].time_limit for k in kept]),
        trips=[trips[k] for k in kept],
        kept=kept,
        result=result,
        interrupted=len(kept) < len(trips),
        wall_s=time.perf_counter() - begin,
    )


def _record(trip: Trip, result: episode.Result, k: int, v_max: float, dt: float) -> dict[str, Any]:
    state, scene = result.state, trip.scene
    assert scene.start is not None and scene.goal is not None
    ticks = int(result.log.active[k].sum())
    record = metrics.episode(
        world=scene.name,
        success=bool(state.success[k]),
        collision=bool(state.collision[k]),
        time=ticks * dt,
        distance=float(state.distance[k]),
        away=float(state.retreat[k]),
        clearance=float(state.min_clearance[k]),
        recoveries=int(result.log.policy["recoveries"][k, max(ticks - 1, 0)]),
        shortest=trip.shortest,
        straight=math.dist(scene.start[:2], scene.goal),
        v_max=v_max,
        reference_length=scene.reference_length,
    )
    ends = {"start": [round(float(x), 4) for x in scene.start], "goal": [round(float(x), 4) for x in scene.goal]}
    return record | {"time_limit_s": round(trip.time_limit, 3), **ends}


def times_to_goal(evaluation: Evaluation) -> dict[int, tuple[float, bool]]:
    """Number of the trip -> time to the goal [s], a failure counting as its limit, and success."""
    records = evaluation.records
    times = metrics.time_to_goal(records, [trip.time_limit for trip in evaluation.trips])
    return {k: (float(t), r["success"]) for k, t, r in zip(evaluation.kept, times, records, strict=True)}


def path_driven(result: episode.Result, k: int, start: tuple[float, float, float]) -> np.ndarray:
    """The path `[T, 2]` of episode k as it was driven [m]."""
    poses = result.log.pose[k][result.log.active[k]]
    return np.concatenate([np.asarray(start, np.float32)[None, :2], poses[:, :2]])
