"""Fusion of camera and LiDAR tokens (paper, section IV-B).

    (1)  ẑ_img   = z_img   + Attn(Q = n(z_img) W_q,    K, V = n(z_lidar) W_k, n(z_lidar) W_v)          (the paper's eq. 2)
         ẑ_lidar = z_lidar + Attn(Q = n(z_lidar) W'_q, K, V = n(z_img) W'_k,  n(z_img) W'_v)
    (2)  z_fuse  = ẑ + FFN(n(ẑ)),  ẑ = [ẑ_img ‖ ẑ_lidar]                                               (eq. 3)
    (3)  e       = MLP([mean z_fuse of the images ‖ mean of the LiDAR ‖ maximum of all])               integration

n is layer normalisation; ‖ in (2) joins the two lists of tokens. Both directions read the tokens as they came in. Missing
tokens are keys to nobody; where all keys are missing, attention adds nothing.
"""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from drnav_jax.models.layers import Dense, Norm, lecun_normal, masked_mean, masked_softmax


class Attention(nn.Module):
    """Multi-head attention of queries to keys, without residual.

    Attributes:
        num_heads: Divides the channels of the queries.
    """

    num_heads: int

    @nn.compact
    def __call__(
        self, queries: Float[Array, "b q d"], keys: Float[Array, "b k e"], mask: Bool[Array, "b k"]
    ) -> Float[Array, "b q d"]:
        """What the queries find among the keys that the mask holds."""
        (b, q, d), k = queries.shape, keys.shape[1]
        split = lambda x, n: x.reshape(b, n, self.num_heads, d // self.num_heads)  # noqa: E731
        project = lambda name: Dense(d, bias=False, kernel_init=lecun_normal, name=name)  # noqa: E731
        head_q, head_k, head_v = split(project("query")(queries), q), split(project("key")(keys), k), project("value")(keys)
        scores = jnp.einsum("bqhc,bkhc->bhqk", head_q, head_k) * (d // self.num_heads) ** -0.5
        weights = masked_softmax(scores, mask[:, None, None, :])
        found = jnp.einsum("bhqk,bkhc->bqhc", weights, split(head_v, k))
        out = Dense(d, bias=False, kernel_init=lecun_normal, name="out")(found.reshape(b, q, d))
        return out * jnp.any(mask, axis=-1).astype(out.dtype)[:, None, None]


class FeedForward(nn.Module):
    """Two layers on each token, with residual and norm (eq. 2)."""

    factor: int = 2

    @nn.compact
    def __call__(self, x: Float[Array, "b k d"]) -> Float[Array, "b k d"]:
        """Apply it."""
        d = x.shape[-1]
        inner = nn.silu(Dense(self.factor * d, name="inner")(Norm(name="norm")(x)))
        return x + Dense(d, kernel_init=lecun_normal, name="outer")(inner)


class CrossModal(nn.Module):
    """Eqs. 1 and 2, `num_layers` times.

    Attributes:
        num_heads: Of the attention.
        num_layers: How often; 0 leaves only eq. 2: tokens side by side that never meet.
    """

    num_heads: int
    num_layers: int

    @nn.compact
    def __call__(
        self, image: Float[Array, "b n d"], image_mask: Bool[Array, "b n"],
        lidar: Float[Array, "b m d"], lidar_mask: Bool[Array, "b m"],
    ) -> tuple[Float[Array, "b n d"], Float[Array, "b m d"]]:  # fmt: skip
        """Fused tokens, image first."""
        count = image.shape[1]
        for k in range(max(1, self.num_layers)):
            if self.num_layers and count and lidar.shape[1]:
                of_image, of_lidar = Norm(name=f"image_norm{k}")(image), Norm(name=f"lidar_norm{k}")(lidar)
                from_lidar = Attention(self.num_heads, name=f"image_to_lidar{k}")(of_image, of_lidar, lidar_mask)
                from_image = Attention(self.num_heads, name=f"lidar_to_image{k}")(of_lidar, of_image, image_mask)
                image, lidar = image + from_lidar, lidar + from_image
            both = FeedForward(name=f"feed_forward{k}")(jnp.concatenate([image, lidar], axis=1))
            image, lidar = both[:, :count], both[:, count:]
        return image, lidar


class Integration(nn.Module):
    """Eq. 3.

    Attributes:
        features: Channels of e.
    """

    features: int

    @nn.compact
    def __call__(
        self, image: Float[Array, "b n d"], image_mask: Bool[Array, "b n"],
        lidar: Float[Array, "b m d"], lidar_mask: Bool[Array, "b m"],
    ) -> Float[Array, "b f"]:  # fmt: skip
        """The joint embedding; zero stands for what is missing."""
        tokens, mask = jnp.concatenate([image, lidar], axis=1), jnp.concatenate([image_mask, lidar_mask], axis=1)
        highest = jnp.max(jnp.where(mask[..., None], tokens, -jnp.inf), axis=1, initial=-jnp.inf)
        highest = jnp.where(jnp.any(mask, axis=1)[:, None], highest, 0.0)
        joined = [masked_mean(image, image_mask), masked_mean(lidar, lidar_mask), highest]
        inner = nn.silu(Dense(self.features, name="inner")(jnp.concatenate(joined, axis=-1)))
        return nn.silu(Dense(self.features, name="outer")(inner))
