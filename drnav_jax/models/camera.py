"""Camera tokens (paper, section IV-A): what the patches of an image say, weighed by what the whole image is.

With patches f_k, their mean g = f̄, and one W_t per token t (the paper has one token per camera)

    (1)  α_k^t = softmax_k(gᵀ W_t f_k / √d)
    (2)  z^t   = Σ_k α_k^t f_k
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from drnav_jax.models.layers import Dense, Norm, lecun_normal
from drnav_jax.types import CameraRig


def rig_features(rig: CameraRig, shape: tuple[int, int]) -> Float[Array, "b n f"]:
    """What tells one mount from another: focal lengths and centre in images, position in metres, and the rotation.

    Args:
        rig: Fields `[B, N, ...]`.
        shape: (rows, columns) of the images that its pixels count in.
    """
    edges = jnp.asarray([shape[1], shape[0]], jnp.float32)[None, None, :]
    turned = rig.rotation.reshape(*rig.rotation.shape[:2], 9)
    parts = (rig.focal / edges, rig.centre / edges - 0.5, rig.position, turned)
    return jnp.concatenate([p.astype(jnp.float32) for p in parts], axis=-1)


class RigEmbedding(nn.Module):
    """The geometry of each camera as a vector."""

    features: int

    @nn.compact
    def __call__(self, rig: CameraRig, shape: tuple[int, int]) -> Float[Array, "b n d"]:
        """Embed a rig whose images have a shape."""
        inner = nn.silu(Dense(2 * self.features, name="inner")(rig_features(rig, shape)))
        return Dense(self.features, kernel_init=lecun_normal, name="outer")(inner)


class PatchAttention(nn.Module):
    """Eqs. 1 and 2.

    Attributes:
        features: d of the tokens.
        num_tokens: Per camera.
    """

    features: int
    num_tokens: int

    @nn.compact
    def __call__(self, maps: Float[Array, "m h w c"]) -> tuple[Float[Array, "m t d"], Float[Array, "m t h w"]]:
        """Tokens of each image, and α over its patches."""
        m, h, w, c = maps.shape
        d, t = self.features, self.num_tokens
        patches = Dense(d, kernel_init=lecun_normal, name="patches")(Norm(name="norm")(maps.reshape(m, h * w, c)))
        query = Dense(t * d, bias=False, kernel_init=lecun_normal, name="query")(jnp.mean(patches, axis=1))
        scores = jnp.einsum("mtd,mkd->mtk", query.reshape(m, t, d), patches) * d**-0.5
        alpha = jax.nn.softmax(scores, axis=-1)
        return jnp.einsum("mtk,mkd->mtd", alpha, patches), alpha.reshape(m, t, h, w)
