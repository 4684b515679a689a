"""What stops a robot, seen from above: the solids of a world as plain rows, and those of them that are near."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from drnav_jax import grids
from drnav_jax.worlds.rectangles import wall_boxes
from drnav_jax.worlds.world import FAR, World, blocking

PAD = 32  # arrays of solids grow in steps of this many rows, so that similar batches share a program
BEYOND = 100.0  # [m] from a point: where rows lie that only fill up


class Solids(NamedTuple):
    """What stops a robot in one world, seen from above; rows that fill up lie at `FAR`."""

    boxes: Float[Array, "Nb 5"]  # centre x, y, yaw, half lengths along and across yaw [m, rad]
    posts: Float[Array, "Np 3"]  # centre x, y, radius [m]


def _rows(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Boxes `[N, 5]` and posts `[N, 3]` of one world that stop a robot; a grid's walls are among the boxes."""
    boxes, posts = blocking(world)
    boxes, posts = boxes[boxes[:, 0] < FAR / 2, :5], posts[posts[:, 0] < FAR / 2, :3]
    return np.concatenate([boxes, wall_boxes(world)]), posts


def collect(worlds: list[World], max_boxes: int, max_posts: int) -> Solids:
    """What stops a robot in each world of a batch (host).

    Args:
        worlds: One world each. What blocks counts, drops included, unless a robot passes under it (`world.HEADROOM`).
        max_boxes: How many boxes there may be in a world, a grid's walls included.
        max_posts: How many cylinders.

    Returns:
        Solids `[B, ...]`, NumPy float32, padded to a common number of rows.

    Raises:
        ValueError: If a world has more boxes or cylinders than the model takes; says how many and what to do.
    """
    known = {id(world): _rows(world) for world in worlds}  # trips on one map share their world
    every = [known[id(world)] for world in worlds]
    what = "boxes (a map's walls are merged into rectangles)", "cylinders"
    remedy = "num_boxes (--mjx-boxes on the command line)", "num_posts"
    for which, held in enumerate((max_boxes, max_posts)):
        most = max((len(rows[which]) for rows in every), default=0)
        if most > held:
            raise ValueError(
                f"the world has {most} {what[which]}, and the MJX model takes {held}: "
                f"raise {remedy[which]}, or use kinematic physics (--physics kinematic)."
            )

    def padded(which: int, empty: tuple[float, ...]) -> Any:
        count = max(len(rows[which]) for rows in every)
        count = max(-(-count // PAD) * PAD, PAD)
        out = np.tile(np.asarray(empty, np.float32), (len(every), count, 1))
        for k, rows in enumerate(every):
            out[k, : len(rows[which])] = rows[which]
        return out

    return Solids(boxes=padded(0, (FAR, FAR, 0.0, 1.0, 1.0)), posts=padded(1, (FAR, FAR, 1.0)))


def nearest(solids: Solids, xy: Float[Array, "2"], num_boxes: int, num_posts: int) -> Solids:
    """The `num_boxes` boxes and `num_posts` posts that a point is closest to, relative to that point.

    Closest by their surface. What only fills up lies `BEYOND` the point.
    """

    def closest(rows: Array, distance: Array, count: int) -> Array:
        if rows.shape[0] < count:
            far = jnp.asarray([BEYOND, BEYOND, *[1.0] * (rows.shape[1] - 2)], jnp.float32)
            return jnp.concatenate([rows, jnp.tile(far[None], (count - rows.shape[0], 1))])
        return rows[grids.least(distance, count)[1]]

    shift = xy[None]
    boxes = jnp.concatenate([solids.boxes[:, :2] - shift, solids.boxes[:, 2:]], axis=1)
    posts = jnp.concatenate([solids.posts[:, :2] - shift, solids.posts[:, 2:]], axis=1)
    x, y, yaw, half_x, half_y = boxes.T
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    out_x, out_y = jnp.abs(c * x + s * y) - half_x, jnp.abs(c * y - s * x) - half_y
    # Squared, and below zero inside: which one is closest is all that matters.
    beyond = jnp.maximum(out_x, 0.0) ** 2 + jnp.maximum(out_y, 0.0) ** 2 + jnp.minimum(jnp.maximum(out_x, out_y), 0.0)
    boxes = closest(boxes, beyond, num_boxes)
    posts = closest(posts, jnp.hypot(posts[:, 0], posts[:, 1]) - posts[:, 2], num_posts)

    def moved(rows: Array) -> Array:  # padding comes within reach of float32
        padding = jnp.abs(rows[:, :1]) > FAR / 2
        return jnp.where(padding, jnp.concatenate([jnp.full_like(rows[:, :2], BEYOND), rows[:, 2:]], axis=1), rows)

    return Solids(boxes=moved(boxes), posts=moved(posts))
