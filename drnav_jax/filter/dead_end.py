"""Dead-end belief per cell: Bayesian log-odds filtering (paper §IV-C) and the footprint mean.

    l(c)   = log(p(c) / (1 - p(c)))                                                            (4)
    l_t(c) = clip(l_{t-1}(c) + w(c) (logit p^(c) - l_0), l_min, l_max),  l_0 = logit p_0       (5)
    P(c)   = 1 / (1 + exp(-l_t(c)))                                                            (6)

The weight w is 1 in the paper; here it is `gain` times the confidence of the evidence, and 0 where
the cell is not visible or the evidence is not finite. `gain` < 1 tempers successive frames, which
are not independent. Before (5) the belief may forget: l <- l_0 + (l - l_0) exp(-forgetting dt).

A predictor that reads the accumulated map says in each frame what it has said before, so a lasting doubt of p^ = 0.3 would
add up to certainty. Of such evidence, which repeats a share r of what came before it, only the rest of the belief is kept:

    l <- l_0 + (l - l_0) (1 - r w)                                                            (6a)

With r = 1 the belief tends to p^ itself, by the share w in each frame.

Risk is what lies above the prior, (P - p_0) / (1 - p_0) and never below 0, so cells without
evidence add none. A dead end that holds the goal is none on this trip, and the nearer a cell is to the
goal, the likelier. With d the distance from the goal (on the floors of real buildings the share of the
dead-end cells that are dead ends on a trip, too, grows from none at the goal to most within 1 to 6 m),

    risk on the trip = risk (1 - exp(-(d / extent)^2)),  0 once a known way leads to the goal (6b)

P^foot is the mean of P (or of the risk) over the cells that the robot covers, weighted by the covered
share of each.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drnav_jax.types import Evidence, Scalar

_P_MIN = 1e-4  # p^ is kept in (1e-4, 1 - 1e-4), so that no single frame is certain
WIDEST = 0.35  # [m] radius up to which a footprint is exact to half a cell
_SUBSAMPLES = 4  # per axis and cell, when a polygon is rasterised


class DeadEndParams(NamedTuple):
    """Dynamics of the dead-end belief."""

    prior: Scalar = 0.06  # [] p_0 of eq. 5, base rate of dead-end cells
    l_min: Scalar = -6.0  # [] saturation, open [nat]
    l_max: Scalar = 6.0  # [] saturation, dead end [nat]
    forgetting: Scalar = 0.0  # [] rate of decay toward the prior [1/s]
    gain: Scalar = 1.0  # [] weight of one frame's evidence
    extent: Scalar = 3.0  # [] a dead end so near the goal may well hold it, eq. 6b [m]


def log_odds(probability: Scalar) -> Array:
    """Eq. 4, the inverse of `probability`, which is kept in (1e-4, 1 - 1e-4)."""
    p = jnp.clip(jnp.asarray(probability, jnp.float32), _P_MIN, 1 - _P_MIN)
    return jnp.log(p) - jnp.log1p(-p)


def probability(log_odds: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """P_dead of the belief (eq. 6)."""
    return jax.nn.sigmoid(log_odds)


def prior_log_odds(params: DeadEndParams) -> Float[Array, ""]:
    """l_0 of eq. 5: the belief about a cell without evidence."""
    return log_odds(params.prior)


def risk(params: DeadEndParams, log_odds: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """P_dead above the prior, scaled to 0..1; 0 for cells without evidence."""
    p0 = params.prior
    # At the prior itself sigmoid(logit(p0)) may round to just above p0.
    return jnp.maximum((probability(log_odds) - p0) / (1 - p0) - 1e-6, 0.0)


def on_trip(
    params: DeadEndParams, risk: Float[Array, "*s"], to_goal: Float[Array, "*s"], shown: Bool[Array, ""]
) -> Float[Array, "*s"]:
    """Risk for a robot that is on its way to a goal (eq. 6b).

    Args:
        params: Whose `extent` counts; 0 = the risk is of this trip already.
        risk: Of being in a dead end, whatever the goal.
        to_goal: Distance of each cell from the goal [m].
        shown: Whether a known way leads to the goal: no dead end is in the way then.
    """
    apart = -jnp.expm1(-jnp.square(to_goal / jnp.maximum(params.extent, 1e-6)))
    return jnp.where(shown, 0.0, risk * apart)


@jax.jit
def update(
    params: DeadEndParams,
    log_odds: Float[Array, "H W"],
    evidence: Evidence,
    visible: Bool[Array, "H W"],
    dt: Scalar,
) -> Float[Array, "H W"]:
    """One step of eq. 5.

    Args:
        params: Dynamics of the belief.
        log_odds: l_{t-1} [nat].
        evidence: Predicted probability and confidence per cell of the same window.
        visible: Cells about which this frame can say something; others only forget.
        dt: Time since the last step [s].

    Returns:
        l_t, within [l_min, l_max].
    """
    l_0 = prior_log_odds(params)
    p_hat, confidence = evidence.p_dead, evidence.confidence
    used = visible & jnp.isfinite(p_hat) & jnp.isfinite(confidence) & (confidence > 0)
    weight = params.gain * jnp.where(used, jnp.minimum(confidence, 1.0), 0.0)
    p_hat = jnp.clip(jnp.where(used, p_hat, 0.5), _P_MIN, 1 - _P_MIN)
    gained = weight * (jnp.log(p_hat / (1 - p_hat)) - l_0)
    kept = l_0 + (log_odds - l_0) * jnp.exp(-params.forgetting * dt)
    if evidence.repeats is not None:
        kept = l_0 + (kept - l_0) * (1.0 - jnp.clip(evidence.repeats, 0.0, 1.0) * jnp.minimum(weight, 1.0))
    return jnp.clip(kept + gained, params.l_min, params.l_max)


def disc_kernel(radius: Scalar, resolution: Scalar, half_width: int) -> Float[Array, "n n"]:
    """Share of each cell that a disc centred on the middle cell covers, normalised to sum 1.

    Args:
        radius: Radius of the disc [m]; traced, so a sweep over it compiles once. It saturates
            where the kernel ends.
        resolution: Edge of a cell [m].
        half_width: Static; the kernel is (2 half_width + 1) cells wide.
    """
    k = jnp.arange(-half_width, half_width + 1, dtype=jnp.float32)
    distance = jnp.sqrt(k[:, None] ** 2 + k[None, :] ** 2)
    # Covered share of a cell by how far its centre lies within the rim; the middle one never
    # vanishes, so a point robot reads its own cell.
    cover = jnp.clip(radius / resolution - distance + 0.5, 0.0, 1.0)
    cover = jnp.where(distance == 0, jnp.maximum(cover, 1e-3), cover)
    return cover / jnp.sum(cover)


def polygon_kernel(
    vertices: Float[Array, "V 2"], yaw: Scalar, resolution: Scalar, half_width: int
) -> Float[Array, "n n"]:
    """Share of each cell that a polygon footprint covers, normalised to sum 1.

    Args:
        vertices: Corners in base_link, in order, either sense; may be concave [m].
        yaw: Heading of the robot in odom [rad].
        resolution: Edge of a cell [m].
        half_width: Static; the kernel is (2 half_width + 1) cells wide.
    """
    c, s = jnp.cos(yaw), jnp.sin(yaw)
    vx, vy = c * vertices[:, 0] - s * vertices[:, 1], s * vertices[:, 0] + c * vertices[:, 1]
    n = (2 * half_width + 1) * _SUBSAMPLES
    k = ((jnp.arange(n, dtype=jnp.float32) + 0.5) / _SUBSAMPLES - half_width - 0.5) * resolution
    px, py = k[None, :, None], k[:, None, None]
    ax, ay = vx[None, None, :], vy[None, None, :]
    bx, by = jnp.roll(vx, -1)[None, None, :], jnp.roll(vy, -1)[None, None, :]
    # Even-odd rule: edges that a ray in +x from the sample crosses.
    straddles = (ay > py) != (by > py)
    rise = jnp.where(straddles, by - ay, 1.0)
    crossings = jnp.sum(straddles & (px < ax + (py - ay) * (bx - ax) / rise), axis=-1)
    covered = (crossings % 2).astype(jnp.float32)
    width = 2 * half_width + 1
    cover = covered.reshape(width, _SUBSAMPLES, width, _SUBSAMPLES).mean((1, 3))
    middle = jnp.zeros_like(cover).at[half_width, half_width].set(1e-3)
    cover = jnp.maximum(cover, middle)
    return cover / jnp.sum(cover)


def aggregate(values: Float[Array, "H W"], kernel: Float[Array, "n n"], fill: Scalar = 0.0) -> Float[Array, "H W"]:
    """Mean of the values around each cell, weighted by a footprint kernel that sums to 1.

    `out[i, j] = sum kernel[a, b] values[i + a - r, j + b - r]`; beyond the window stands `fill`.
    """
    h, w = values.shape
    n = kernel.shape[0]
    padded = jnp.pad(values, n // 2, constant_values=jnp.asarray(fill, values.dtype))
    # XLA's convolution is slow on CPU; shifted slices fuse into one pass.
    total = jnp.zeros_like(values)
    for a in range(n):
        for b in range(n):
            total += kernel[a, b] * jax.lax.slice(padded, (a, b), (a + h, b + w))
    return total


def half_width(resolution: float) -> int:
    """Half width [cells] of the kernel that holds a robot of `WIDEST` on cells of this edge [m]."""
    return max(1, round(WIDEST / resolution))


@partial(jax.jit, static_argnames="half_width")
def footprint(
    values: Float[Array, "H W"],
    radius: Scalar,
    resolution: Scalar,
    *,
    half_width: int = 3,
) -> Float[Array, "H W"]:
    """P^foot of a disc robot centred on each cell: the mean over the cells it covers.

    Args:
        values: Probability or risk per cell; outside the window it counts as 0.
        radius: Radius of the robot [m]; up to (half_width + 1/2) cells.
        resolution: Edge of a cell [m].
        half_width: Static half width of the kernel [cells].
    """
    return aggregate(values, disc_kernel(radius, resolution, half_width))
