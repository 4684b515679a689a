"""A recorded drive, at whose places the parts are timed, and the planner's whole tick on it."""

import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from drnav_jax import evaluate, navigator, worlds
from drnav_jax.evaluate import Setup
from drnav_jax.navigator import NavParams, NavSpec, NavState
from drnav_jax.sim import LidarParams, LidarSpec, kinematic, scan
from drnav_jax.types import Observation, empty_observation

FAMILY = "t"  # whose world is driven: corridors, a fork, a dead end
STRIDE = 20  # ticks between two places at which candidates are scored


class Drive(NamedTuple):
    """A recorded drive: what the robot was, what it sensed at each tick, and what it knew then, now and again."""

    spec: NavSpec
    params: NavParams
    begin: NavState
    observations: list[Observation]
    stops: list[tuple[Observation, NavState]]  # every `STRIDE` ticks


def record(num_ticks: int, num_candidates: int = 4096, seed: int = 0) -> Drive:
    """Drive through a world of `FAMILY` in closed loop and keep what was sensed.

    Args:
        num_ticks: Ticks to drive; it ends sooner if the robot arrives.
        num_candidates: Candidates of the goal generator.
        seed: Of the world and of the sensor's noise.
    """
    scene = worlds.sample(FAMILY, seed)
    assert scene.start is not None and scene.goal is not None
    setup = Setup(num_candidates=num_candidates, seed=seed)
    spec = setup.nav
    params = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), evaluate.params_of(setup))
    lidar, beams = LidarParams(max_range=setup.lidar_range), LidarSpec()
    pose, twist = jnp.asarray(scene.start, jnp.float32), jnp.zeros(2, jnp.float32)
    goal = jnp.asarray(scene.goal, jnp.float32)
    keys = jax.random.split(jax.random.key(seed), num_ticks)
    state = begin = navigator.init(spec, params, pose)
    observations, stops = [], []
    for k in range(num_ticks):
        points, valid = scan(beams, lidar, scene.world, pose, keys[k])
        seen = empty_observation(points.shape[0])._replace(
            points=points, point_valid=valid, pose=pose, twist=twist, goal=goal
        )
        observations.append(seen)
        state, command, info = navigator.step(spec, params, state, seen, keys[k], replan=k % spec.replan_every == 0)
        if k % STRIDE == STRIDE - 1:
            stops.append((seen, state))
        if info.arrived:
            break
        pose, twist = kinematic.step(params.robot, pose, twist, command, spec.dt)
    return Drive(spec, params, begin, observations, stops)


def tick_times(drive: Drive, warm_up: int = 20) -> dict[str, float]:
    """Times [ms] of `navigator.step` on a recorded drive, ticks that replan included; the state is carried along.

    Args:
        drive: From `record`.
        warm_up: First ticks that do not count.
    """
    state, key, every = drive.begin, jax.random.key(0), drive.spec.replan_every
    spent = []
    for k, seen in enumerate(drive.observations):
        begin = time.perf_counter()
        state, command, _ = navigator.step(drive.spec, drive.params, state, seen, key, replan=k % every == 0)
        jax.block_until_ready((state, command))
        spent.append(1e3 * (time.perf_counter() - begin))
    counted, replans = np.asarray(spent[warm_up:]), np.arange(warm_up, len(spent)) % every == 0
    return {
        "median": float(np.median(counted)),
        "p95": float(np.percentile(counted, 95)),
        "max": float(np.max(counted)),
        "replan_median": float(np.median(counted[replans])),
        "replan_p95": float(np.percentile(counted[replans], 95)),
        "ticks": len(counted),
    }
