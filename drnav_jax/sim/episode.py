"""Closed-loop episodes: world -> sensors -> policy -> physics, batched, in compiled chunks.

An episode is an outer scan over replans and an inner scan over ticks (so `replan` is static), `chunk_ticks` ticks at a
time. A host loop calls chunks until every episode is over and keeps what is finished. Episodes of a batch are worked on
`lanes` at a time (vmapped), one group after another to its end: on a CPU one lane stays in the cache, on an accelerator one
wide group is best. So one program serves batches of any size. The policy comes as functions: nothing here knows a planner.
"""

import dataclasses
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key, PRNGKeyArray

from drnav_jax.sim import contact, kinematic, lidar, mjx
from drnav_jax.sim.camera import render
from drnav_jax.sim.kinematic import FaultParams
from drnav_jax.sim.lidar import LidarParams, LidarSpec
from drnav_jax.sim.mjx import MjxSpec
from drnav_jax.types import NO_CAMERAS, Command, Observation, RigSpec, RobotParams, empty_observation
from drnav_jax.worlds.world import World


@dataclasses.dataclass(frozen=True)
class Policy:
    """The robot's mind as two functions.

    Attributes:
        init: `(params, pose) -> state`.
        step: `(params, state, observation, key, replan) -> (state, Command, log)`; `replan` is a Python bool, `log` a
            pytree of small arrays that is recorded every tick.
    """

    init: Callable[[Any, Array], Any]
    step: Callable[[Any, Any, Observation, PRNGKeyArray, bool], tuple[Any, Command, Any]]


@dataclasses.dataclass(frozen=True)
class EpisodeSpec:
    """Sizes of the simulation.

    Attributes:
        lidar: The beams.
        rig: The cameras; they take images in ticks that replan, which is when a predictor looks at them.
        dt: Tick [s].
        replan_every: Ticks per replan.
        chunk_ticks: Ticks per compiled call; a multiple of `replan_every`.
        lanes: Episodes vmapped together.
        physics: None = `kinematic`; or the sizes of the MJX model.
        max_delay: Longest `FaultParams.delay` [ticks].
    """

    lidar: LidarSpec = LidarSpec()
    rig: RigSpec = NO_CAMERAS
    dt: float = 0.1
    replan_every: int = 5
    chunk_ticks: int = 50
    lanes: int = 1
    physics: MjxSpec | None = None
    max_delay: int = 10

    def __post_init__(self) -> None:
        """Check sizes."""
        if self.dt <= 0:
            raise ValueError(f"dt must be > 0 s, got {self.dt}.")
        if self.replan_every < 1 or self.chunk_ticks % self.replan_every:
            raise ValueError(
                f"chunk_ticks must be a multiple of replan_every >= 1, got {self.chunk_ticks} and {self.replan_every}."
            )
        if self.lanes < 1:
            raise ValueError(f"lanes must be >= 1, got {self.lanes}.")
        if self.max_delay < 0:
            raise ValueError(f"max_delay must be >= 0 ticks, got {self.max_delay}.")
        if self.physics is not None:
            self.physics.steps_in(self.dt)


class EpisodeParams(NamedTuple):
    """What may differ from episode to episode; batched along axis 0."""

    world: World
    start: Array  # [3] x, y, yaw
    goal: Array  # [2] [m]
    time_limit: Array  # [] [s]
    goal_tolerance: Array  # [] [m]
    robot: RobotParams  # the true robot
    policy: Any  # the policy's parameters
    lidar: LidarParams = LidarParams()
    camera: Any = ()  # `CameraParams` if the spec's rig has cameras
    faults: FaultParams = FaultParams()
    motors: Any = ()  # `mjx.MjxParams` if the physics is MJX
    solids: Any = ()  # `solids.Solids` of the world if the physics is MJX


class EpisodeState(NamedTuple):
    """One episode under way."""

    pose: Array  # [3] true pose in the world
    odometry: Array  # [3] pose as the robot believes it
    twist: Array  # [2] of the wheels
    body: Any  # `mjx.Body`, or () with kinematic physics
    pending: Array  # [max_delay, 2] the last commands, newest first
    policy: Any
    key: Array
    tick: Array  # [] int32
    active: Array  # [] bool
    success: Array  # [] bool
    collision: Array  # [] bool
    distance: Array  # [] driven [m]
    retreat: Array  # [] driven away from the goal [m]
    min_clearance: Array  # [] true clearance of the footprint, least so far [m]


class Log(NamedTuple):
    """One tick as recorded; `[T]` in front."""

    pose: Array  # [3] after the tick
    command: Array  # [2]
    active: Array  # [] bool, the episode was under way
    policy: Any  # the policy's own log


def start(spec: EpisodeSpec, policy: Policy, params: EpisodeParams, key: PRNGKeyArray) -> EpisodeState:
    """The episode before its first tick (one episode; the caller vmaps)."""
    zero = jnp.zeros((), jnp.float32)
    pose = jnp.asarray(params.start, jnp.float32)
    return EpisodeState(
        pose=pose, odometry=pose, twist=jnp.zeros(2, jnp.float32), body=() if spec.physics is None else mjx.init(),
        pending=jnp.zeros((spec.max_delay, 2), jnp.float32), policy=policy.init(params.policy, pose), key=key,
        tick=jnp.zeros((), jnp.int32), active=jnp.asarray(True), success=jnp.asarray(False),
        collision=jnp.asarray(False), distance=zero, retreat=zero, min_clearance=jnp.asarray(jnp.inf, jnp.float32),
    )  # fmt: skip


def tick(
    spec: EpisodeSpec, policy: Policy, params: EpisodeParams, state: EpisodeState, replan: bool
) -> tuple[EpisodeState, Log]:
    """Sense, decide, move, judge: once. A finished episode stays as it is."""
    key_scan, key_policy = jax.random.split(jax.random.fold_in(state.key, state.tick))
    points, valid = lidar.scan(spec.lidar, params.lidar, params.world, state.pose, key_scan)
    observation = empty_observation(points.shape[0], spec.rig)._replace(
        points=points, point_valid=valid, pose=state.odometry, twist=state.twist, goal=params.goal
    )
    if spec.rig.mounts and replan:
        key_image = jax.random.fold_in(key_scan, 1)
        images = render(spec.rig, params.camera, params.world, observation.rig, state.pose, key_image)
        observation = observation._replace(images=images, image_valid=jnp.ones(len(spec.rig.mounts), bool))
    mind, command, log = policy.step(params.policy, state.policy, observation, key_policy, replan)
    pending, reached = kinematic.delayed(state.pending, command, spec.dt, params.faults)
    body, grazed = (), jnp.asarray(jnp.inf, jnp.float32)
    if spec.physics is None:
        pose, twist = kinematic.step(params.robot, state.pose, state.twist, reached, spec.dt, params.faults)
    else:
        pose, twist, body = mjx.step(
            spec.physics, params.motors, params.robot, params.solids, state.pose, state.body, reached, spec.dt,
            params.faults,
        )  # fmt: skip
        grazed = jnp.where(body.contact, -body.depth, grazed)  # contact between the instants that are looked at
    odometry = kinematic.odometry(state.odometry, state.pose, pose, params.faults)
    middle = 0.5 * (state.pose[:2] + pose[:2])
    room = jnp.minimum(contact.clearance(params.world, pose[:2]), contact.clearance(params.world, middle))
    room = jnp.minimum(room - params.robot.radius, grazed)
    hit = room < 0
    to_goal = jnp.hypot(pose[0] - params.goal[0], pose[1] - params.goal[1])
    from_goal = jnp.hypot(state.pose[0] - params.goal[0], state.pose[1] - params.goal[1])
    moved = jnp.hypot(pose[0] - state.pose[0], pose[1] - state.pose[1])
    arrived = (to_goal <= params.goal_tolerance) & ~hit
    late = (state.tick + 1).astype(jnp.float32) * spec.dt >= params.time_limit
    going = state.active
    new = EpisodeState(
        pose=pose, odometry=odometry, twist=twist, body=body, pending=pending, policy=mind, key=state.key,
        tick=state.tick + 1,
        active=~(hit | arrived | late), success=arrived, collision=hit, distance=state.distance + moved,
        retreat=state.retreat + jnp.maximum(to_goal - from_goal, 0.0),
        min_clearance=jnp.minimum(state.min_clearance, room),
    )  # fmt: skip
    keep = {name: getattr(state, name) for name in EpisodeState._fields if name not in ("policy", "key")}
    held = jax.tree.map(lambda a, b: jnp.where(going, a, b), {n: getattr(new, n) for n in keep}, keep)
    record = Log(
        pose=held["pose"], command=jnp.stack([command.v, command.omega]), active=going, policy=log
    )
    return new._replace(**held), record


def chunk(
    spec: EpisodeSpec, policy: Policy, params: EpisodeParams, state: EpisodeState
) -> tuple[EpisodeState, Log]:
    """`chunk_ticks` ticks of one episode; the log has `[chunk_ticks]` in front."""

    def period(state: EpisodeState, _: None) -> tuple[EpisodeState, Log]:
        state, first = tick(spec, policy, params, state, True)
        if spec.replan_every == 1:
            return state, jax.tree.map(lambda a: a[None], first)
        plain = lambda s, _: tick(spec, policy, params, s, False)  # noqa: E731
        state, rest = jax.lax.scan(plain, state, None, length=spec.replan_every - 1)
        return state, jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, rest)

    state, log = jax.lax.scan(period, state, None, length=spec.chunk_ticks // spec.replan_every)
    return state, jax.tree.map(lambda a: a.reshape(spec.chunk_ticks, *a.shape[2:]), log)


def _each(one: Callable, *trees: Any) -> Any:
    """`one` for every episode of a group, side by side; an episode that is alone needs no `vmap`."""
    if jax.tree.leaves(trees)[0].shape[0] > 1:
        return jax.vmap(one)(*trees)
    return jax.tree.map(lambda a: a[None], one(*_first(trees)))


@partial(jax.jit, static_argnames=("spec", "policy"))
def _start_group(spec: EpisodeSpec, policy: Policy, params: EpisodeParams, keys: Key[Array, " B"]) -> EpisodeState:
    return _each(lambda p, key: start(spec, policy, p, key), params, keys)


@partial(jax.jit, static_argnames=("spec", "policy"), donate_argnames="state")
def _chunk_group(
    spec: EpisodeSpec, policy: Policy, params: EpisodeParams, state: EpisodeState
) -> tuple[EpisodeState, Log]:
    return _each(lambda p, s: chunk(spec, policy, p, s), params, state)


def _first(tree: Any) -> Any:
    return jax.tree.map(lambda a: a[0], tree)


class Result(NamedTuple):
    """Episodes as far as they got; numpy, `[B]` in front."""

    state: EpisodeState  # without the policy's state
    log: Log  # [B, T]; only ticks where `active` count
    finished: np.ndarray  # [B] bool; False where the run was interrupted


def run(
    spec: EpisodeSpec,
    policy: Policy,
    params: EpisodeParams,
    keys: Key[Array, " B"],
    *,
    workers: int = 2,
    progress: Callable[[int], None] | None = None,
) -> Result:
    """Run a batch of episodes to their ends.

    Args:
        spec: Sizes.
        policy: The robot's mind.
        params: Worlds, trips and parameters, `[B, ...]` leaves.
        keys: One key per episode, `[B]`.
        workers: Threads that share the batch; results do not depend on it.
        progress: Called with the number of finished episodes after every chunk.

    Returns:
        Results of all episodes. After a KeyboardInterrupt: as far as they got, `finished` False for the rest.

    Raises:
        ValueError: If a command is delayed for longer than the spec allows for, or MJX or the cameras lack parameters.
    """
    longest = float(np.max(params.faults.delay)) / spec.dt
    if round(longest) > spec.max_delay:
        raise ValueError(f"faults.delay is {longest:.1f} ticks, EpisodeSpec.max_delay {spec.max_delay}: raise it.")
    if spec.physics is not None and not (params.motors and params.solids):
        raise ValueError("MJX needs EpisodeParams.motors (MjxParams) and .solids (mjx.solids_of).")
    if spec.rig.mounts and not params.camera:
        raise ValueError("cameras need EpisodeParams.camera (CameraParams).")
    count = keys.shape[0]
    lanes = min(spec.lanes, count)
    # the last group is filled up with its last episode again
    groups = [np.minimum(np.arange(k, k + lanes), count - 1) for k in range(0, count, lanes)]
    done, stop, compiling = [0] * len(groups), threading.Event(), threading.Lock()

    def work(which: int) -> tuple[EpisodeState, Log]:
        index, fresh = groups[which], min(lanes, count - which * lanes)
        mine = jax.tree.map(lambda a: jnp.asarray(a[index]), (params, keys))
        with compiling:  # one after the other, or each thread would compile the same programs
            state, logs = _start_group(spec, policy, *mine), []
            begun = None if stop.is_set() else _chunk_group(spec, policy, mine[0], state)
        if begun is None:
            shapes = jax.eval_shape(partial(_chunk_group, spec, policy), mine[0], state)[1]
            logs.append(jax.tree.map(lambda a: np.zeros((a.shape[0], 0, *a.shape[2:]), a.dtype), shapes))
        while begun is not None:
            state, log = begun
            logs.append(jax.device_get(log))
            going = np.asarray(state.active)
            done[which] = int(np.sum(~going[:fresh]))
            if progress is not None:
                progress(sum(done))
            begun = _chunk_group(spec, policy, mine[0], state) if going.any() and not stop.is_set() else None
        state = state._replace(policy=None, key=jax.random.key_data(state.key))
        log = jax.tree.map(lambda *a: np.concatenate(a, axis=1), *logs)
        return jax.tree.map(lambda a: a[:fresh], (jax.device_get(state), log))

    with ThreadPoolExecutor(min(workers, len(groups))) as pool:
        futures = [pool.submit(work, k) for k in range(len(groups))]
        try:
            while not all(f.done() for f in futures):
                threading.Event().wait(0.05)
                if any(f.done() and f.exception() for f in futures):
                    stop.set()
        except KeyboardInterrupt:
            stop.set()
        parts = [f.result() for f in futures]
    return _join(parts)


def _join(parts: list[tuple[EpisodeState, Log]]) -> Result:
    """The groups' episodes one after the other; logs are padded to the longest."""
    longest = max(log.active.shape[1] for _, log in parts)

    def pad(a: np.ndarray) -> np.ndarray:
        return np.pad(a, [(0, 0), (0, longest - a.shape[1])] + [(0, 0)] * (a.ndim - 2))

    state = jax.tree.map(lambda *a: np.concatenate(a), *[s for s, _ in parts])
    log = jax.tree.map(lambda *a: np.concatenate([pad(x) for x in a]), *[log for _, log in parts])
    return Result(state=state, log=log, finished=~state.active)


def replay(
    spec: EpisodeSpec, policy: Policy, params: EpisodeParams, key: PRNGKeyArray
) -> Iterator[EpisodeState]:
    """One episode again, chunk by chunk, with the policy's whole state: for pictures of what it believed."""
    single = jax.tree.map(lambda a: jnp.asarray(a)[None], (params, key))
    state = _start_group(spec, policy, *single)
    yield _first(state)
    while bool(state.active[0]):
        state, _ = _chunk_group(spec, policy, single[0], state)
        yield _first(jax.tree.map(jnp.copy, state))
