"""One step of training, on every device there is: forward, backward, clip, AdamW, average.

(1)  g = Σ_devices ∇ L of its part of the batch; all divide by the weights of the whole batch (`losses.total`)
(2)  θ <- AdamW(θ, clip(g)),  θ̄ <- d θ̄ + (1 - d) θ,  d = min(ema, (1 + t) / (10 + t))
"""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array

from drnav_jax.models import losses, network, weights
from drnav_jax.models.batch import Batch
from drnav_jax.train.augment import augment
from drnav_jax.train.spec import TrainSpec

AXIS = "batch"


class TrainState(NamedTuple):
    """What a checkpoint holds."""

    step: Array  # [] int32, steps done
    params: Any
    average: Any  # of the parameters (eq. 2)
    optimiser: Any


def optimiser(spec: TrainSpec) -> optax.GradientTransformation:
    """Eq. 2 without the average."""
    rate = optax.warmup_cosine_decay_schedule(
        0.0, spec.learning_rate, min(spec.warmup, spec.steps - 1), spec.steps, 0.02 * spec.learning_rate
    )
    matrices = lambda params: jax.tree.map(lambda p: p.ndim > 1, params)  # noqa: E731
    return optax.chain(
        optax.clip_by_global_norm(spec.clip),
        optax.adamw(rate, b2=0.99, weight_decay=spec.weight_decay, mask=matrices),
    )


def init(spec: TrainSpec) -> TrainState:
    """Before the first step.

    Raises:
        ValueError: If the weights to start from are damaged, or of another network.
        OSError: If they cannot be read.
    """
    if spec.start_from:
        params = weights.begun(Path(spec.start_from), spec.network, spec.seed)
    else:
        params = network.init(jax.random.key(spec.seed), spec.network)
    average = jax.tree.map(jnp.copy, params)  # a buffer of its own: steps give their state's buffers away
    return TrainState(jnp.zeros((), jnp.int32), params, average, optimiser(spec).init(params))


def mesh_of(devices: list[Any], batch_size: int) -> Mesh:
    """The devices to share a batch, as many as divide it."""
    count = max(n for n in range(1, len(devices) + 1) if batch_size % n == 0)
    return Mesh(devices[:count], (AXIS,))


@functools.cache
def stepper(spec: TrainSpec, mesh: Mesh) -> Callable[[TrainState, Batch], tuple[TrainState, dict[str, Array]]]:
    """(state, batch) -> the state after a step, and what to log; compiled, the batch on axis 0 shared by the devices.

    The same function for the same arguments, so that nothing compiles twice.

    Args:
        spec: The run.
        mesh: From `mesh_of`.
    """
    tools = optimiser(spec)
    part = spec.batch_size // mesh.devices.size

    def slope(params: Any, batch: Batch, step: Array) -> tuple[Any, dict[str, Array]]:
        first = jax.lax.axis_index(AXIS).astype(jnp.int32) * part
        key = jax.random.fold_in(jax.random.key(spec.seed + 1), step)
        seen = augment(spec.augment, batch, key, first)

        def loss(p: Any) -> tuple[Array, dict[str, Array]]:
            terms = losses.sums(spec.loss, network.apply(spec.network, p, seen.inputs), seen.targets, seen.inputs.local_map)
            over = jax.lax.psum({name: weight for name, (_, weight) in terms.items()}, AXIS)
            return losses.total(spec.loss, terms, over)

        (value, each), gradient = jax.value_and_grad(loss, has_aux=True)(params)
        return jax.lax.psum((gradient, {"loss": value} | each), AXIS)

    shared = jax.shard_map(
        slope, mesh=mesh, in_specs=(PartitionSpec(), PartitionSpec(AXIS), PartitionSpec()),
        out_specs=PartitionSpec(), check_vma=False,
    )  # fmt: skip
    everywhere, split = NamedSharding(mesh, PartitionSpec()), NamedSharding(mesh, PartitionSpec(AXIS))

    @functools.partial(jax.jit, in_shardings=(everywhere, split), out_shardings=everywhere, donate_argnums=0)
    def step(state: TrainState, batch: Batch) -> tuple[TrainState, dict[str, Array]]:
        gradient, said = shared(state.params, batch, state.step)
        norm = optax.tree.norm(gradient)
        sound = jnp.isfinite(norm)  # a batch that breaks the arithmetic teaches nothing
        gradient = jax.tree.map(lambda g: jnp.where(sound, g, 0.0), gradient)
        updates, kept = tools.update(gradient, state.optimiser, state.params)
        params = optax.apply_updates(state.params, updates)
        t = state.step.astype(jnp.float32)
        decay = jnp.minimum(spec.ema, (1.0 + t) / (10.0 + t))
        average = jax.tree.map(lambda a, p: decay * a + (1.0 - decay) * p, state.average, params)
        return TrainState(state.step + 1, params, average, kept), said | {"gradient": norm}

    return step
