"""Cost layers, and how three of them are packed into one word per cell.

Nav2's inflation (costmap_2d, InflationLayer): with d the distance to the nearest obstacle and r the inscribed radius,

    cost = 254 (d = 0), 253 (d <= r), else floor(252 exp(-k (d - r))) up to the inflation radius, 0 beyond.

Rollouts spend their time in table look-ups, so clearance, risk and value-to-go are quantised into one 32-bit word:

    bits 0-7   clearance, 5 mm steps, saturated at 1.275 m
    bits 8-15  risk P_dead^foot above the prior, steps of 1/255
    bits 16-31 value-to-go above the window's least, 1 cm steps, saturated at 655.35 m
"""

import functools
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drnav_jax import grids
from drnav_jax.types import Scalar

CLEARANCE_STEP = 0.005  # [m]
VALUE_STEP = 0.01  # [m]
MAX_CLEARANCE = 1.0  # [m] beyond this nobody asks how far the next obstacle is


class InflationParams(NamedTuple):
    """Nav2's inflation layer."""

    scaling: Scalar = 3.0  # [] k [1/m]
    radius: Scalar = 0.7  # [] inflation radius [m]


def inflation(distance: Float[Array, "*s"], inscribed: Scalar, params: InflationParams) -> Float[Array, "*s"]:
    """Nav2's cost, 0..254, of standing `distance` [m] from the nearest obstacle (module docstring).

    Args:
        distance: To the nearest obstacle cell; 0 on it [m].
        inscribed: Inscribed radius of the robot [m].
        params: Scaling and radius of the inflation.
    """
    decayed = jnp.floor(252.0 * jnp.exp(-params.scaling * (distance - inscribed)))
    cost = jnp.where(distance > params.radius, 0.0, decayed)
    return jnp.where(distance <= 0, 254.0, jnp.where(distance <= inscribed, 253.0, cost))


@partial(jax.jit, static_argnames="resolution")
def clearance(occupied: Bool[Array, "H W"], resolution: float) -> Float[Array, "H W"]:
    """Distance [m] between the centres of each cell and of the nearest occupied one, at most `MAX_CLEARANCE`.

    The surface itself lies anywhere within that cell: up to 0.7 of a cell nearer. Margins allow for it.
    """
    return grids.distance_transform(occupied, resolution, MAX_CLEARANCE)


def sides(free: Bool[Array, "H W"], by: int) -> tuple[Array, Array]:
    """Through which east and north sides of the coarse cells one gets from free map cell to free map cell.

    A coarse cell is open if any of its map cells is, so that narrow ways stay; but without this test it would also
    join cells between which there is no way.
    """
    h, w = free.shape
    ahead = jnp.pad(free, ((0, 1), (0, 1)))
    across, along = (free & ahead[:h, 1:])[:, by - 1 :: by], (free & ahead[1:, :w])[by - 1 :: by]
    return (
        functools.reduce(jnp.logical_or, [across[k::by] for k in range(by)]),
        functools.reduce(jnp.logical_or, [along[:, k::by] for k in range(by)]),
    )


@jax.jit
def pack_plan(risk: Float[Array, "H W"], value: Float[Array, "H W"]) -> Int[Array, "H W"]:
    """The two layers that change only when one replans, with room for the clearance.

    Args:
        risk: P_dead^foot above the prior, 0..1.
        value: Value-to-go [m], any offset.
    """
    above = jnp.clip(jnp.round((value - jnp.min(value)) / VALUE_STEP), 0, 65535).astype(jnp.uint32)
    share = jnp.round(jnp.clip(risk, 0.0, 1.0) * 255).astype(jnp.uint32)
    return jax.lax.bitcast_convert_type((above << 16) | (share << 8), jnp.int32)


@jax.jit
def pack_clearance(plan: Int[Array, "H W"], clear: Float[Array, "H W"]) -> Int[Array, "H W"]:
    """The word of each cell, from `pack_plan` and the clearance [m]."""
    return plan | jnp.clip(jnp.floor(clear / CLEARANCE_STEP), 0, 255).astype(jnp.int32)


def unpack(word: Int[Array, "*s"]) -> tuple[Array, Array, Array]:
    """Clearance [m], risk [0..1] and value-to-go [m] of packed words."""
    near = (word & 255).astype(jnp.float32) * CLEARANCE_STEP
    risk = ((word >> 8) & 255).astype(jnp.float32) * (1.0 / 255.0)
    value = ((word >> 16) & 65535).astype(jnp.float32) * VALUE_STEP
    return near, risk, value
