"""LiDAR tokens (paper, section IV-A): a PointNet whose points are weighed by learned attention, one token per sector.

With h_i the features of point i, u their maximum over the scan, and S_m the points of sector m of the azimuth

    (1)  β_i = softmax over i ∈ S_m of φ([h_i; u])
    (2)  z_m = Σ_{i ∈ S_m} β_i h_i

φ is bounded, so that a softmax needs no maximum of its own, and has several heads, each for its share of the channels. A
missing point has no weight anywhere, so neither the order of the points nor padding matters. A sector also knows its share
of all weights, not their sum: half of the points say the same.
"""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drnav_jax.models.layers import Dense, Norm, embedding, lecun_normal

_BOUND = 8.0  # of φ: weights within a sector differ by at most exp(16)
_NEAR = 0.3  # [m] where the inverse of the range levels off
_FAR = 30.0  # [m] farther points are taken for this far


def point_features(points: Float[Array, "b p 3"]) -> Float[Array, "b p 7"]:
    """Position in units of 6 m, height [m], direction, range and inverse range."""
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    distance = jnp.sqrt(jnp.square(x) + jnp.square(y) + 1e-6)
    inside = jnp.minimum(1.0, _FAR / distance)
    x, y, r = x * inside, y * inside, distance * inside
    height, away = jnp.clip(z, -5.0, 5.0), r + 1e-3
    return jnp.stack([x / 6, y / 6, height, x / away, y / away, r / 6, 1 / (r + _NEAR)], axis=-1)


def sector_of(points: Float[Array, "b p 3"], count: int) -> Float[Array, "b p m"]:
    """One-hot sector of each point; the first begins straight behind and they go counter-clockwise."""
    turn = (jnp.arctan2(points[..., 1], points[..., 0]) + jnp.pi) * (count / (2 * jnp.pi))
    number = jnp.clip(turn.astype(jnp.int32), 0, count - 1)
    return (number[..., None] == jnp.arange(count, dtype=jnp.int32)[None, None, :]).astype(jnp.float32)


class PointNet(nn.Module):
    """Eqs. 1 and 2.

    Attributes:
        widths: Channels of the layers per point; the last is that of h.
        features: d of the tokens.
        num_sectors: M.
        num_heads: Of φ; divides the last width.
    """

    widths: tuple[int, ...]
    features: int
    num_sectors: int
    num_heads: int

    @nn.compact
    def __call__(
        self, points: Float[Array, "b p 3"], valid: Bool[Array, "b p"]
    ) -> tuple[Float[Array, "b m d"], Bool[Array, "b m"], Float[Array, "b p"]]:
        """Tokens, which of them have points, and β (summing to 1 in each sector that has points)."""
        b, p, _ = points.shape
        points = jnp.where(valid[..., None], points.astype(jnp.float32), 0.0)
        h = point_features(points)
        for number, width in enumerate(self.widths):
            h = nn.relu(Dense(width, name=f"point{number}")(h))
        u = jnp.max(jnp.where(valid[..., None], h, 0.0), axis=1, initial=0.0)  # h >= 0
        inner = Dense(16, name="score_point")(h) + Dense(16, bias=False, name="score_scan")(u)[:, None, :]
        scores = Dense(self.num_heads, kernel_init=lecun_normal, name="score")(nn.relu(inner))
        weights = jnp.exp(_BOUND * jnp.tanh(scores / _BOUND)) * valid[..., None].astype(jnp.float32)
        sectors = sector_of(points, self.num_sectors)
        heads, share = self.num_heads, h.shape[-1] // self.num_heads
        total = jnp.einsum("bpm,bph->bmh", sectors, weights)
        weighed = (h.reshape(b, p, heads, share) * weights[..., None]).reshape(b, p, heads * share)
        summed = jnp.einsum("bpm,bpd->bmd", sectors, weighed).reshape(b, self.num_sectors, heads, share)
        filled = total > 0
        z = jnp.where(filled[..., None], summed / jnp.where(filled, total, 1.0)[..., None], 0.0)
        part = total * (self.num_sectors / jnp.maximum(jnp.sum(total, axis=1, keepdims=True), 1e-9))
        z = jnp.concatenate([z.reshape(b, self.num_sectors, -1), jnp.log1p(part)], axis=-1)
        z = jnp.concatenate([z, jnp.broadcast_to(u[:, None, :], (b, self.num_sectors, u.shape[-1]))], axis=-1)
        place = self.param("place", embedding, (self.num_sectors, self.features))
        token = Norm(name="norm")(Dense(self.features, name="token")(z)) + place[None]
        share_of = weights / jnp.maximum(jnp.einsum("bpm,bmh->bph", sectors, total), 1e-9)
        return token, filled[..., 0], jnp.mean(share_of, axis=-1)
