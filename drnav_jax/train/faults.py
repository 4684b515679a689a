"""Sensors that fail, to measure what each loss costs: changes of a batch's `Inputs` for `validate.predict`.

What a scan with fewer points would have left in the known map cannot be made up afterwards: for those gather frames with
such a LiDAR, which drives and labels do not depend on.
"""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp

from drnav_jax.models.batch import Inputs, shares
from drnav_jax.train.augment import turned

SHIFT, TURN = 0.05, math.radians(2.0)  # [m], [rad] by which cameras are mounted wrong
BLACK = 0.2  # share of pixels


def without_camera(number: int) -> Callable[[Inputs], Inputs]:
    """One camera is gone."""
    return lambda x: x._replace(image_valid=jnp.asarray(x.image_valid).at[:, number].set(False))


def without_cameras(x: Inputs) -> Inputs:
    """All are."""
    return x._replace(image_valid=jnp.zeros_like(jnp.asarray(x.image_valid)))


def black_pixels(seed: int, share: float = BLACK) -> Callable[[Inputs], Inputs]:
    """A share of all pixels is black."""

    def change(x: Inputs) -> Inputs:
        images = shares(jnp.asarray(x.images))
        lit = jax.random.uniform(jax.random.key(seed), images.shape[:-1], jnp.float32) >= share
        return x._replace(images=images * lit[..., None].astype(jnp.float32))

    return change


def mounted_wrong(seed: int, shift: float = SHIFT, turn: float = TURN) -> Callable[[Inputs], Inputs]:
    """Every camera of every frame sits `shift` [m] and looks `turn` [rad] off from what is believed, in any direction."""

    def change(x: Inputs) -> Inputs:
        shape = jnp.asarray(x.rig.position).shape
        a, b = jax.random.normal(jax.random.key(seed), (2, *shape), jnp.float32)
        unit = lambda v: v / jnp.linalg.norm(v, axis=-1, keepdims=True)  # noqa: E731
        rig = jax.tree.map(jnp.asarray, x.rig)
        return x._replace(rig=jax.vmap(turned)(rig, shift * unit(a), turn * unit(b)))

    return change


def cases(seed: int) -> dict[str, Callable[[Inputs], Inputs]]:
    """What is done to frames of the usual sensors, by name."""
    return {
        "no front camera": without_camera(0), "no left camera": without_camera(1), "no right camera": without_camera(2),
        "no camera": without_cameras, "20 % of pixels black": black_pixels(seed),
        "cameras 5 cm, 2 deg off": mounted_wrong(seed),
    }  # fmt: skip
