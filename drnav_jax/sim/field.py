"""First wall along rays over the signed distance field of a grid map.

The wall is where the bilinear interpolation between the cell centres crosses zero. Within the
square of four neighbouring centres the field along a ray is a quadratic

    q(t) = q0 + q1 t + q2 t^2                                                                 (1)

so the crossing is solved there, and thin corners are not stepped over. Where the field is large
the ray skips, in cells,

    step = q0 - SLACK                                                                         (2)

(sphere tracing). Proof that this is safe: q0 exceeds the distance to the nearest occupied centre,
less 1/2, by at most 0.15 (interpolating the distance to one point); the wall reaches at most 0.77
from the nearest occupied centre (a square with three of them); 0.15 + 0.77 - 0.50 = SLACK.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from drnav_jax.geometry import sample_bilinear
from drnav_jax.types import GridMap, Scalar

SLACK = 0.42  # [cells]
NUDGE = 1e-3  # [cells] past a square's edge, so that rounding cannot stop a ray there


def wall_distance(
    field: GridMap,
    origin: Float[Array, "2"],
    dx: Float[Array, " rays"],
    dy: Float[Array, " rays"],
    reach: Scalar,
) -> Float[Array, " rays"]:
    """Distance from `origin` to the first wall along each ray.

    A ray that starts in a wall finds the wall's far side. Beyond the grid's edge nothing is met.

    Args:
        field: Signed distance [m] to the walls, `[H, W]`.
        origin: x, y where all rays start [m].
        dx: x of unit directions.
        dy: y of unit directions.
        reach: Where to stop [m].

    Returns:
        Distances [m]; inf where no wall is met within `reach`.
    """
    h, w = field.values.shape
    flat = field.values.reshape(-1)
    # From here on in cells; (0, 0) is the centre of cell (0, 0).
    x0, y0 = (origin - field.origin) / field.resolution - 0.5
    dx, dy = (jnp.where(jnp.abs(along) < 1e-9, 1e-9, along) for along in (dx, dy))
    start, end = jnp.zeros_like(dx), jnp.full_like(dx, reach / field.resolution)
    for at, along, size in ((x0, dx, w), (y0, dy, h)):
        a, b = (-0.5 - at) / along, (size - 0.5 - at) / along
        start = jnp.maximum(start, jnp.minimum(a, b))
        end = jnp.minimum(end, jnp.maximum(a, b))
    # From within a wall the same search finds the way out.
    in_wall = (sample_bilinear(field, origin) < 0) & (start <= 0)
    scale = jnp.where(in_wall, -1.0, 1.0) / field.resolution

    def square(t: Array) -> tuple[Array, Array]:
        """Column and row of the lower left corner of the square that each ray is in at t."""
        x, y = x0 + t * dx, y0 + t * dy
        # On the line between two squares a ray is in the one that it is about to cross.
        left = jnp.where(dx > 0, jnp.floor(x), jnp.ceil(x) - 1)
        low = jnp.where(dy > 0, jnp.floor(y), jnp.ceil(y) - 1)
        return left, low

    def corners(t: Array) -> Array:
        """Values `[4, rays]` at the corners of that square."""
        col, row = (at.astype(jnp.int32) for at in square(t))
        col0, col1 = jnp.clip(col, 0, w - 1), jnp.clip(col + 1, 0, w - 1)
        row0, row1 = jnp.clip(row, 0, h - 1) * w, jnp.clip(row + 1, 0, h - 1) * w
        # One gather, and not four: over a large operand XLA hands each to its thread pool.
        cells = jnp.stack([row0 + col0, row0 + col1, row1 + col0, row1 + col1])
        return flat.at[cells].get(mode="promise_in_bounds")

    def under_way(t: Array) -> Array:
        return (t >= 0) & (t < end)  # a hit at t is noted as -1 - t

    def advance(t: Array, values: Array) -> Array:
        left, low = square(t)
        ax, ay = x0 + t * dx - left, y0 + t * dy - low
        v00, v01, v10, v11 = values * scale[None, :]
        slope_x, slope_y, twist = v01 - v00, v10 - v00, v11 - v10 - v01 + v00
        q0 = v00 + slope_x * ax + slope_y * ay + twist * ax * ay
        q1 = slope_x * dx + slope_y * dy + twist * (ax * dy + ay * dx)
        q2 = twist * dx * dy
        edge_x = (jnp.where(dx > 0, 1.0, 0.0) - ax) * inverse_x
        edge_y = (jnp.where(dy > 0, 1.0, 0.0) - ay) * inverse_y
        edge = jnp.minimum(edge_x, edge_y) + NUDGE
        # The smallest positive root, in the form that stands q2 = 0; negative where there is none.
        under_root = q1 * q1 - 4 * q0 * q2
        root = 2 * q0 / (jnp.sqrt(jnp.maximum(under_root, 0.0)) - q1)
        root = jnp.where(q0 <= 0, 0.0, jnp.where(under_root < 0, -1.0, root))
        found = (root >= 0) & (root <= edge)
        further = jnp.where(found, -1.0 - (t + root), t + jnp.maximum(edge, q0 - SLACK))
        return jnp.where(under_way(t), further, t)

    def body(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        # Looking up for the next step keeps XLA from fusing the gather into the arithmetic.
        t, values, count = carry
        t = advance(t, values)
        return t, corners(t), count + 1

    inverse_x, inverse_y = 1 / dx, 1 / dy
    limit = 2 * (h + w) + 64  # a ray crosses at most h + w + 2 squares
    t, _, _ = jax.lax.while_loop(
        lambda carry: jnp.any(under_way(carry[0])) & (carry[2] < limit),
        body,
        (start, corners(start), jnp.zeros((), jnp.int32)),
    )
    hit = -1.0 - t
    return jnp.where((t < 0) & (hit <= end), hit, jnp.inf) * field.resolution
