"""The task by `drnav_jax.planning.mppi`: whole commands, with noise of any kind."""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from drnav_jax.bench.mppi.task import Task, Update
from drnav_jax.planning import mppi, mppi_critics, mppi_rollout
from drnav_jax.planning.dynamics import Motion
from drnav_jax.planning.mppi import MppiParams, MppiSpec
from drnav_jax.planning.mppi_rollout import Limits
from drnav_jax.planning.noise import NoiseSpec
from drnav_jax.types import GridMap


class Scene(NamedTuple):
    """What the cost looks at."""

    goal: Array  # [2] [m]
    words: GridMap  # [H, W] of `mppi_critics.pack`
    weights: Array  # [2] w_o / 254, w_r


def _price(scene: Scene, m: Motion) -> Array:
    cost, risk = mppi_critics.read(scene.words, m.x, m.y)
    away = jnp.sqrt(jnp.square(m.x - scene.goal[0]) + jnp.square(m.y - scene.goal[1]))
    return away + scene.weights[0] * cost + scene.weights[1] * risk * jnp.abs(m.v)


COST = mppi_rollout.running(_price)


class Prepared(NamedTuple):
    """The task on the device."""

    params: MppiParams
    limits: Limits
    scene: Scene
    pose: Array
    twist: Array
    control: Array


def prepare(task: Task) -> Prepared:
    """Put the task where JAX finds it."""
    f32 = lambda a: jnp.asarray(a, jnp.float32)  # noqa: E731
    a, alpha = map(float, task.accelerations)
    std_v, std_w = map(float, task.sigma)
    words = mppi_critics.pack(f32(task.cost), f32(task.risk))
    params = MppiParams(
        temperature=task.temperature, gamma=task.temperature, std_v=std_v, std_w=std_w
    )
    ready = Prepared(
        params=params, limits=Limits(v_min=-jnp.inf, v_max=jnp.inf, w_max=jnp.inf, a_max=a, a_min=-a, alpha_max=alpha),
        scene=Scene(
            goal=f32(task.goal), words=GridMap(words, f32(task.origin), f32(task.resolution)),
            weights=f32([task.cost_weight / 254.0, task.risk_weight * task.dt]),
        ),
        pose=f32(task.pose), twist=f32(task.twist), control=f32(task.control),
    )  # fmt: skip
    return jax.tree.map(jnp.asarray, ready)


def _spec(task: Task, num_samples: int, noise: NoiseSpec) -> MppiSpec:
    return MppiSpec(
        num_samples=num_samples, num_steps=len(task.control), dt=task.dt, noise=noise, smooth=False, clamp=False,
        immediate=True,
    )  # fmt: skip


def update(task: Task, eps: np.ndarray) -> Update:
    """The update with this noise `[T, 2, K]`."""
    ready, spec = prepare(task), _spec(task, eps.shape[2], NoiseSpec())
    held, both, key = jnp.asarray(eps), jnp.ones(2, jnp.float32), jax.random.key(0)
    control, _ = jax.jit(mppi.update, static_argnames=("spec", "cost"))(
        spec, ready.params, ready.limits, COST, ready.scene, ready.control, held, both, ready.pose, ready.twist, key
    )
    priced = jax.jit(mppi_rollout.rollout, static_argnames=("cost", "dt", "immediate"))(
        COST, ready.scene, ready.limits, ready.pose, ready.twist, ready.control, held, jnp.asarray(task.sigma),
        dt=task.dt, immediate=True,
    )  # fmt: skip
    return Update(np.asarray(control), np.asarray(priced.total))


def planner(task: Task, num_samples: int, noise: NoiseSpec) -> tuple[Callable[..., Array], tuple]:
    """A function (ready, state, key) -> the next controls `[T, 2]`, to be compiled, and its first two arguments."""
    ready, spec = prepare(task), _spec(task, num_samples, noise)
    state = mppi.init(spec, ready.params, jax.random.key(0))._replace(control=ready.control)

    def plan(ready: Prepared, state: mppi.MppiState, key: PRNGKeyArray) -> Array:
        after, _, _ = mppi.plan(
            spec, ready.params, ready.limits, COST, ready.scene, state, ready.pose, ready.twist, key
        )
        return after.control

    return plan, (ready, state)


def command(task: Task, num_samples: int, noise: NoiseSpec) -> Callable[[], Array]:
    """A function that gives the next command's controls `[T, 2]`, from the task's, with other noise at each call."""
    plan, given = planner(task, num_samples, noise)
    program, keys = jax.jit(plan), itertools.cycle(jax.random.split(jax.random.key(1), 64))
    return lambda: program(*given, next(keys))
