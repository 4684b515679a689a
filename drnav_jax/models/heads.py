"""From tokens and maps to what navigation needs: cells, ways and the dead-end flag (paper, section IV-C).

Two heads for cells. `GridHead` (default) is a small U-net over the bird's-eye grid: the known map, the geometric rule's
verdict and lifted camera features at a half of the grid's resolution; at an eighth of it every cell queries the fused
tokens and all other cells. `TokenHead` is the paper's wording: tokens -> one vector -> grid.

    block(x) = x + ½ C₂ a(C₁ n(x))       C: 3 x 3 convolution, n: layer norm over channels, a: ReLU

Full convolutions, as products of matrices: with depthwise ones in their place it learned the map's corners and ends
several times more slowly. Cells know where they lie by their coordinates.
"""

import dataclasses

import flax.linen as nn
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from drnav_jax.models.cross_attention import Attention, FeedForward
from drnav_jax.models.layers import Dense, Norm, embedding, lecun_normal, small, to_depth, to_space

CELL_OUTPUTS = ("dead", "traversable", "recoverability", "depth")  # channels per cell, in this order


class Conv3(nn.Module):
    """A 3 x 3 convolution with a border of zeros, as one product of matrices.

    Attributes:
        features: Channels out.
    """

    features: int

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h w d"]:
        """Apply it."""
        h, w = x.shape[1:3]
        padded = jnp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
        around = [padded[:, a : a + h, b : b + w] for a in range(3) for b in range(3)]
        return Dense(self.features, name="around")(jnp.concatenate(around, axis=-1))


class Block(nn.Module):
    """The docstring's block."""

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h w c"]:
        """Apply it."""
        c = x.shape[-1]
        y = nn.relu(Conv3(c, name="first")(Norm(name="norm")(x)))
        return x + 0.5 * Conv3(c, name="second")(y)


def coordinates(shape: tuple[int, int]) -> Float[np.ndarray, "h w 3"]:
    """Place of each cell, -1..1 along rows and columns, and its distance from the middle."""
    rows, columns = (np.linspace(-1.0, 1.0, n, dtype=np.float32) for n in shape)
    y, x = np.meshgrid(rows, columns, indexing="ij")
    return np.stack([y, x, np.hypot(y, x)], axis=-1)


@dataclasses.dataclass(frozen=True)
class GridSpec:
    """Size of the grid head.

    Attributes:
        widths: Channels at a half, a quarter and an eighth of the grid's resolution.
        blocks: Blocks at each of them, on the way down; the first two again on the way up.
        num_heads: Of the attention of grid queries; divides the last width.
    """

    widths: tuple[int, int, int] = (24, 48, 64)
    blocks: tuple[int, int, int] = (1, 1, 1)
    num_heads: int = 4

    def __post_init__(self) -> None:
        """Check sizes."""
        if len(self.widths) != 3 or len(self.blocks) != 3 or min(self.widths) < 1 or min(self.blocks) < 0:
            raise ValueError(f"a grid head has three widths >= 1 and blocks >= 0, got {self.widths} and {self.blocks}.")
        if self.widths[2] % self.num_heads:
            raise ValueError(f"the last width {self.widths[2]} must be a multiple of num_heads = {self.num_heads}.")


class GridHead(nn.Module):
    """Cells by a U-net with grid queries.

    Attributes:
        spec: Its size.
    """

    spec: GridSpec

    @nn.compact
    def __call__(
        self, known: Float[Array, "b h w c"], lifted: Float[Array, "b h2 w2 f"] | None,
        tokens: Float[Array, "b k d"], mask: Bool[Array, "b k"], joint: Float[Array, "b e"],
    ) -> tuple[Float[Array, "b h w 4"], Float[Array, "b v"]]:  # fmt: skip
        """Channels per cell (`CELL_OUTPUTS`), and a vector that says what the grid looks like.

        Args:
            known: What is known of each cell.
            lifted: Camera features at half the resolution; None = none.
            tokens: Fused tokens.
            mask: Which of them are there.
            joint: The joint embedding.
        """
        (half, quarter, eighth), (n2, n4, n8) = self.spec.widths, self.spec.blocks
        b = known.shape[0]
        fine = to_depth(known, 2)
        where = coordinates((fine.shape[1], fine.shape[2]))
        place = jnp.broadcast_to(where[None], (b, *where.shape))
        parts = [fine, place] if lifted is None else [fine, place, lifted]
        x = nn.relu(Dense(half, name="enter")(jnp.concatenate(parts, axis=-1)))
        for k in range(n2):
            x = Block(name=f"down2_{k}")(x)
        skip2 = x
        x = Dense(quarter, name="to4")(to_depth(x, 2))
        for k in range(n4):
            x = Block(name=f"down4_{k}")(x)
        skip4 = x
        x = Dense(eighth, name="to8")(to_depth(x, 2))
        rows, columns = x.shape[1:3]
        queries = x.reshape(b, rows * columns, eighth) + self.param("place8", embedding, (1, rows * columns, eighth))
        queries = queries + Dense(eighth, kernel_init=lecun_normal, name="joint")(joint)[:, None, :]
        found = Attention(self.spec.num_heads, name="to_tokens")(
            Norm(name="query_norm")(queries), Norm(name="token_norm")(tokens), mask
        )
        queries = queries + found
        every = jnp.ones(queries.shape[:2], bool)
        normed = Norm(name="self_norm")(queries)
        queries = queries + Attention(self.spec.num_heads, name="to_cells")(normed, normed, every)
        x = FeedForward(name="feed_forward")(queries).reshape(b, rows, columns, eighth)
        for k in range(n8):
            x = Block(name=f"down8_{k}")(x)
        seen = nn.silu(Dense(16, name="look")(Norm(name="look_norm")(x))).reshape(b, -1)
        x = to_space(Dense(4 * quarter, kernel_init=lecun_normal, name="from8")(x), 2)
        x = x + Dense(quarter, kernel_init=lecun_normal, name="skip4")(skip4)
        for k in range(n4):
            x = Block(name=f"up4_{k}")(x)
        x = to_space(Dense(4 * half, kernel_init=lecun_normal, name="from4")(x), 2)
        x = x + Dense(half, kernel_init=lecun_normal, name="skip2")(skip2)
        for k in range(n2):
            x = Block(name=f"up2_{k}")(x)
        x = nn.relu(x)
        return to_space(Dense(4 * len(CELL_OUTPUTS), kernel_init=small, name="leave")(x), 2), seen


class TokenHead(nn.Module):
    """Cells from the joint embedding alone.

    Attributes:
        shape: (h, w) of the grid, multiples of 8.
        width: Channels at an eighth of its resolution; halved at each step up.
    """

    shape: tuple[int, int]
    width: int = 64

    @nn.compact
    def __call__(self, joint: Float[Array, "b e"]) -> Float[Array, "b h w 4"]:
        """Channels per cell (`CELL_OUTPUTS`)."""
        rows, columns = self.shape[0] // 8, self.shape[1] // 8
        x = nn.silu(Dense(256, name="vector")(joint))
        x = Dense(rows * columns * self.width, name="grid")(x).reshape(-1, rows, columns, self.width)
        x = Block(name="block8")(nn.silu(x))
        for k, width in enumerate((self.width // 2, self.width // 4)):
            x = Block(name=f"up{k}")(to_space(Dense(4 * width, name=f"widen{k}")(x), 2))
        return to_space(Dense(4 * len(CELL_OUTPUTS), kernel_init=small, name="leave")(nn.silu(Norm(name="norm")(x))), 2)


class WayHead(nn.Module):
    """Logits of front, left and right being open, and of the dead-end flag."""

    features: int = 96

    @nn.compact
    def __call__(self, seen: Float[Array, "b v"]) -> Float[Array, "b 4"]:
        """Apply it to all that is known of the place."""
        return Dense(4, kernel_init=small, name="out")(nn.silu(Dense(self.features, name="inner")(seen)))
