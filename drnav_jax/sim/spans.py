"""Where rays from one sensor enter and leave upright solids, and how far they see down into drops.

All rays start at the sensor. A ray is a horizontal direction and a slope, and its running parameter s is such that after
s it lies at

    (x, y) = sensor + s (dx, dy),    z(s) = height + s slope                                   (1)

(LiDAR: (dx, dy) is a unit vector and s the horizontal distance; a level camera: s is the depth along the optical axis).
A solid's footprint covers one interval of s, its height another; a ray is within where the two overlap. So where the
rays are the product of R slopes and A directions, as those of a spinning LiDAR or of a level camera are, a solid costs
R + A intervals for R x A rays.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from drnav_jax.worlds.materials import EXTINCTION, TABLE, Material

# What a ray does with a solid, by material [M].
FLAT = np.array([TABLE[m].flat for m in Material])  # nothing: it is painted on the ground
DROPS = np.array([m == Material.DROP for m in Material])  # falls into it
OPAQUE = np.isinf(EXTINCTION)  # ends at its surface
VEILS = ~(OPAQUE | FLAT | DROPS)  # may pass: glass, leaves
JOINT = 1e-4  # [] share of its distance by which two drops may miss each other and still be one


class Spans(NamedTuple):
    """Where A directions enter and leave the footprints of N solids; inf, or entry > leave, = never."""

    entry: Array  # [N, A]
    leave: Array  # [N, A]
    within: Array  # [N] whether the sensor is in the footprint
    near: Array  # [N] the footprint is at least this far from the sensor [m]
    low: Array  # [N] bottom, relative to the sensor [m]
    high: Array  # [N] top


def box_spans(boxes: Array, height: Array, pose: Array, dx: Array, dy: Array) -> Spans:
    """Spans of boxes `[N, 7]` (rows as in `World`) on rays from x, y of `pose` and `height` along `(dx, dy)` `[A]`."""
    c, s = jnp.cos(boxes[:, 2]), jnp.sin(boxes[:, 2])
    rx, ry = pose[0] - boxes[:, 0], pose[1] - boxes[:, 1]
    entry, leave, within = [], [], []
    for axis_x, axis_y, half in ((c, s, boxes[:, 3]), (-s, c, boxes[:, 4])):
        at = axis_x * rx + axis_y * ry
        along = axis_x[:, None] * dx[None] + axis_y[:, None] * dy[None]
        inverse = 1 / jnp.where(jnp.abs(along) < 1e-9, 1e-9, along)
        a, b = (-half - at)[:, None] * inverse, (half - at)[:, None] * inverse
        entry.append(jnp.minimum(a, b))
        leave.append(jnp.maximum(a, b))
        within.append(jnp.abs(at) < half)
    return Spans(
        entry=jnp.maximum(*entry),
        leave=jnp.minimum(*leave),
        within=within[0] & within[1],
        near=jnp.hypot(rx, ry) - jnp.hypot(boxes[:, 3], boxes[:, 4]),
        low=boxes[:, 5] - height,
        high=boxes[:, 6] - height,
    )


def cylinder_spans(cylinders: Array, height: Array, pose: Array, dx: Array, dy: Array) -> Spans:
    """Spans of cylinders `[N, 5]` on rays along unit vectors `(dx, dy)` `[A]`; a ray that misses has entry = leave."""
    rx, ry, r = cylinders[:, 0] - pose[0], cylinders[:, 1] - pose[1], cylinders[:, 2]
    along = rx[:, None] * dx[None] + ry[:, None] * dy[None]
    aside = jnp.abs(rx[:, None] * dy[None] - ry[:, None] * dx[None])
    # (r - a)(r + a) and not r^2 - a^2: a ray that just touches keeps its digits.
    half = jnp.sqrt(jnp.maximum((r[:, None] - aside) * (r[:, None] + aside), 0.0))
    return Spans(
        entry=along - half,
        leave=along + half,
        within=rx * rx + ry * ry < r * r,
        near=jnp.hypot(rx, ry) - r,
        low=cylinders[:, 3] - height,
        high=cylinders[:, 4] - height,
    )


def each(chosen: Bool[Array, " N"], visit: Callable[[Array, Any], Any], carry: Any, *, group: int = 1) -> Any:
    """`carry = visit(n, carry)` for each n that is chosen, in order: what is not chosen costs nothing.

    One solid at a time, all rays at once: the ranges stay in the first-level cache.

    Args:
        chosen: Which of N solids.
        visit: What is done with one.
        carry: What it is done to.
        group: So many in one turn of the loop, which writes its result once. The last turn is filled up with the first
            solid anew: a visit must change nothing the second time.
    """
    if chosen.shape[0] == 0:
        return carry
    order = jnp.nonzero(chosen, size=chosen.shape[0], fill_value=-1)[0].astype(jnp.int32)
    if group > 1:
        order = jnp.concatenate([order, jnp.full(group - 1, -1, jnp.int32)])
        order = jnp.where(order < 0, order[0], order)
    turns = (jnp.sum(chosen, dtype=jnp.int32) + group - 1) // group

    def turn(k: Array, carry: Any) -> Any:
        for m in range(group):
            carry = visit(order[group * k + m], carry)
        return carry

    return jax.lax.fori_loop(jnp.int32(0), turns, turn, carry)


def down_drops(
    ground: Array,
    drops: Bool[Array, " N"],
    footprint: Callable[[Array], tuple[Array, Array]],
    floor: Callable[[Array], Array],
) -> tuple[Array, Array]:
    """Where rays end that would meet the ground, if drops are open: at a drop's floor or at its far wall.

    Drops that touch are one: a ray goes on from one into the next.

    Args:
        ground: s at which each ray meets the plane z = 0 `[R, A]`; inf = never.
        drops: Which of N solids are drops.
        footprint: `n -> (entry, leave)` of solid n on all rays, broadcasting to `[R, A]`.
        floor: `n -> s` at which the rays that fall reach the bottom of solid n, broadcasting likewise.

    Returns:
        s where each ray ends `[R, A]`, and the drop whose floor or wall it meets there (-1 = the ground).
    """

    def visit(n: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        end, met = carry
        entry, leave = footprint(n)
        last = jnp.minimum(leave, floor(n))
        falls = (entry <= end * (1 + JOINT)) & (end < last)
        return jnp.where(falls, last, end), jnp.where(falls, n, met)

    def again(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        end, met, _ = carry
        further, met = each(drops, visit, (end, met))
        return further, met, jnp.any(further > end)

    start = ground, jnp.full(ground.shape, -1, jnp.int32), jnp.any(drops)
    end, met, _ = jax.lax.while_loop(lambda carry: carry[2], again, start)
    return end, met
