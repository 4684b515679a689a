"""What the network is trained towards (pure functions of outputs and targets).

With the mask m and the weight w of a cell, z the logit, y the truth, and sums over all cells of all frames

    (1)  w(c)   = m(c) w_v(visibility) [1 + w_i interior(c)]            where the twin's label differs is the real question
    (2)  L_dead = Σ w (1 - p_y)^γ BCE(z, y) / Σ w                       γ = 0: cross-entropy, which stays calibrated
    (3)  L_path = Σ s BCE(z, y) / Σ s,  s = 1 if the label is stable, else `unstable`;  L_flag likewise
    (4)  L_trav over all cells inside the world, where the map is wrong all the more: w_h on what it holds to be free and is
         not (a pane), w_g on what it holds to be occupied and is not (tall grass); such cells are few, and the rest can be
         read off the map. L_rec over the valid cells; L_depth = |log(1 + d̂) - log(1 + d)| (Huber) over the dead ends
    (5)  L = L_dead + Σ weight · L_other

Losses come as sums and weights, so that devices which share a batch can add both before they divide.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, UInt8

from drnav_jax.models.batch import BEFORE, NEVER, Targets
from drnav_jax.models.bev import FREE, OCCUPIED
from drnav_jax.models.network import Outputs
from drnav_jax.types import Scalar

TERMS = ("dead", "path", "flag", "traversable", "recoverability", "depth")


class LossParams(NamedTuple):
    """Weights of the loss."""

    before: Scalar = 1.0  # [] w_v of cells seen earlier (1 for those seen now)
    never: Scalar = 0.4  # [] w_v of cells never seen: of most of them nobody can know
    interior: Scalar = 4.0  # [] w_i of eq. 1
    gamma: Scalar = 0.0  # [] γ of eq. 2
    unstable: Scalar = 0.4  # [] weight of path and flag labels that a step aside changes
    path: Scalar = 0.5  # [] weights of eq. 5
    flag: Scalar = 0.25  # []
    traversable: Scalar = 0.3  # []
    recoverability: Scalar = 0.1  # []
    depth: Scalar = 0.1  # []
    hidden: Scalar = 30.0  # [] w_h of eq. 4
    veiled: Scalar = 5.0  # [] w_g of eq. 4


def _weighed(values: Array, weights: Array) -> tuple[Array, Array]:
    return jnp.sum(values * weights), jnp.sum(weights)


def _focal(logits: Array, truth: Array, gamma: Scalar) -> Array:
    """Eq. 2 per cell."""
    cross = optax.sigmoid_binary_cross_entropy(logits, truth)
    wrong = jax.nn.sigmoid(jnp.where(truth > 0.5, -logits, logits))  # 1 - p_y
    return cross * jnp.power(jnp.maximum(wrong, 1e-6), gamma)


def sums(
    params: LossParams, outputs: Outputs, targets: Targets, local_map: UInt8[Array, "B h w"]
) -> dict[str, tuple[Float[Array, ""], Float[Array, ""]]]:
    """(weighted sum, sum of weights) of every term of `TERMS`.

    Args:
        params: Weights.
        outputs: Of B frames.
        targets: Of the same.
        local_map: What the network knew of them, classes of `models.bev`.
    """
    real = lambda a: jnp.asarray(a, jnp.float32)  # noqa: E731
    valid, dead = real(targets.valid), real(targets.dead_end)
    seen = jnp.where(targets.visibility == BEFORE, params.before, 1.0)
    seen = jnp.where(targets.visibility == NEVER, params.never, seen)
    weight = valid * seen * (1.0 + params.interior * real(targets.interior))
    stable = lambda a: jnp.where(a, 1.0, params.unstable)  # noqa: E731
    depth = jnp.log1p(jnp.maximum(real(targets.depth), 0.0))
    wrong = jnp.where((local_map == FREE) & ~targets.traversable, params.hidden, 1.0)
    wrong = jnp.where((local_map == OCCUPIED) & targets.traversable, params.veiled, wrong)
    bce = optax.sigmoid_binary_cross_entropy
    return {
        "dead": _weighed(_focal(outputs.dead, dead, params.gamma), weight),
        "path": _weighed(bce(outputs.path, real(targets.path)), stable(targets.path_stable)),
        "flag": _weighed(bce(outputs.flag, real(targets.dead_end_flag)), stable(targets.flag_stable)),
        "traversable": _weighed(bce(outputs.traversable, real(targets.traversable)), real(targets.inside) * wrong),
        "recoverability": _weighed(bce(outputs.recoverability, real(targets.recoverability)), valid),
        "depth": _weighed(optax.losses.huber_loss(outputs.depth, depth, delta=0.5), valid * dead),
    }


def total(
    params: LossParams, terms: dict[str, tuple[Array, Array]], weights: dict[str, Array] | None = None
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Eq. 5, and its terms.

    Args:
        params: Weights of the terms.
        terms: From `sums`.
        weights: Sums of weights to divide by, if others than those of `terms` (of all devices together).
    """
    over = {name: weight for name, (_, weight) in terms.items()} if weights is None else weights
    each = {name: terms[name][0] / jnp.maximum(jax.lax.stop_gradient(over[name]), 1e-6) for name in TERMS}
    share = {"dead": 1.0} | {name: getattr(params, name) for name in TERMS[1:]}
    return jnp.asarray(sum(share[name] * each[name] for name in TERMS), jnp.float32), each
