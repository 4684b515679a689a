"""The fusion network: cameras, LiDAR and the known map -> dead ends, ways, traversability and recoverability.

    images -> EfficientNet -> α -> camera tokens  ┐ cross-attention, FFN, integration -> joint embedding -> ways, flag
    points -> PointNet     -> β -> sector tokens  ┘                        │ fused tokens
    images -> EfficientNet -> lift by the rig ─────> bird's-eye grid <─────┘ queries -> cells
    known map, geometric rule ─────────────────────>

A missing camera or scan is a mask. Parameters are a plain pytree: `init` makes them, `apply` uses them. The batch is an
explicit axis here, since one product of matrices over all pixels of all frames is what a CPU does best.
"""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray

from drnav_jax.models.batch import FREE, OCCUPIED, Inputs, shares
from drnav_jax.models.camera import PatchAttention, RigEmbedding
from drnav_jax.models.cross_attention import CrossModal, Integration
from drnav_jax.models.efficientnet import EfficientNet, EncoderSpec
from drnav_jax.models.heads import GridHead, GridSpec, TokenHead, WayHead
from drnav_jax.models.layers import Dense, Norm
from drnav_jax.models.lift import Lift
from drnav_jax.models.pointnet import PointNet
from drnav_jax.types import BevSpec, RigSpec, rig_of

SENSORS = ("both", "image", "lidar")
HEADS = ("grid", "tokens")


@dataclasses.dataclass(frozen=True)
class NetworkSpec:
    """What the network is composed of.

    Attributes:
        encoder: Of the images.
        bev: The grid that cells are predicted on.
        grid: Size of the grid head.
        features: d, channels of the tokens.
        image_tokens: Per camera.
        sectors: M, LiDAR tokens.
        point_widths: Channels of the PointNet's layers.
        num_heads: Of all attention between tokens; divides d and the last point width.
        attention_layers: Of cross-attention; 0 = camera and LiDAR tokens never meet (an ablation).
        joint: Channels of the joint embedding.
        lift: Camera features are lifted to the grid.
        lift_stride: Pixels per feature of the maps that are lifted; coarser ones are added to them.
        lift_width: Channels of these maps.
        lift_features: Channels that arrive on the grid.
        lift_depths: Depths that a column is spread over.
        head: "grid", or "tokens" (an ablation: the paper's wording).
        sensors: "both", or only "image" (no cloud, no map) or "lidar" (ablations).
        rule: The geometric rule's verdict is an input.
    """

    encoder: EncoderSpec = EncoderSpec()
    bev: BevSpec = BevSpec()
    grid: GridSpec = GridSpec()
    features: int = 64
    image_tokens: int = 4
    sectors: int = 16
    point_widths: tuple[int, ...] = (32, 64)
    num_heads: int = 4
    attention_layers: int = 1
    joint: int = 128
    lift: bool = True
    lift_stride: int = 6
    lift_width: int = 24
    lift_features: int = 16
    lift_depths: int = 14
    head: str = "grid"
    sensors: str = "both"
    rule: bool = True

    def __post_init__(self) -> None:
        """Check that the parts fit together."""
        if self.head not in HEADS or self.sensors not in SENSORS:
            raise ValueError(f"head must be one of {HEADS} and sensors of {SENSORS}, got {self.head} and {self.sensors}.")
        counts = ("features", "image_tokens", "sectors", "num_heads", "joint", "lift_width", "lift_features")
        low = [name for name in counts if getattr(self, name) < 1]
        if low or not self.point_widths or min(self.point_widths) < 1:
            raise ValueError(f"{', '.join(low) or 'point_widths'} must be >= 1.")
        if self.features % self.num_heads or self.point_widths[-1] % self.num_heads:
            raise ValueError(
                f"features = {self.features} and the last of point_widths = {self.point_widths} must be multiples of "
                f"num_heads = {self.num_heads}."
            )
        if any(n % 8 for n in self.bev.shape):
            raise ValueError(f"the grid's edges must be multiples of 8 cells, got {self.bev.shape}.")
        if self.attention_layers < 0 or self.lift_depths < 2:
            raise ValueError("attention_layers must be >= 0 and lift_depths >= 2.")
        if self.lift and self.lift_stride not in self.encoder.strides:
            raise ValueError(f"lift_stride must be one of the encoder's {self.encoder.strides}, got {self.lift_stride}.")

    @property
    def sees(self) -> bool:
        """Cameras are used."""
        return self.sensors != "lidar"

    @property
    def scans(self) -> bool:
        """LiDAR, and the map made from it, are used."""
        return self.sensors != "image"

    @property
    def lifts(self) -> bool:
        """Camera features reach the grid by geometry."""
        return self.lift and self.sees and self.head == "grid"


class Outputs(NamedTuple):
    """What the network says of B frames; logits are not calibrated (`models.calibration`)."""

    path: Array  # [B, 3] logits: front, left, right is open
    flag: Array  # [B] logit: no path is open
    dead: Array  # [B, h, w] logits: the cell is a dead end
    traversable: Array  # [B, h, w] logits
    recoverability: Array  # [B, h, w] logits of a share
    depth: Array  # [B, h, w] log(1 + depth beyond the mouth [m])
    alpha: Array  # [B, N, rows, columns] weight of each patch within its image, mean over its tokens
    beta: Array  # [B, P] weight of each point within its sector


class _Network(nn.Module):
    spec: NetworkSpec

    def _see(self, inputs: Inputs) -> tuple[Array, Array, Array, Array | None]:
        """Camera tokens, their mask, α, and lifted features."""
        spec = self.spec
        b, n, rows, columns = inputs.images.shape[:4]
        usable = inputs.image_valid
        images = jnp.where(usable[:, :, None, None, None], shares(inputs.images), 0.0)
        rig = jax.tree.map(lambda a: jnp.where(usable.reshape(b, n, *[1] * (a.ndim - 2)), a, 1.0), inputs.rig)
        maps = EfficientNet(spec.encoder, name="encoder")(images.reshape(b * n, rows, columns, 3))
        strides = spec.encoder.strides
        tokens, alpha = PatchAttention(spec.features, spec.image_tokens, name="patches")(maps[strides[-1]])
        camera = RigEmbedding(spec.features, name="rig")(rig, (rows, columns))
        tokens = tokens.reshape(b, n, spec.image_tokens, spec.features) + camera[:, :, None, :]
        place = self.param("image_place", nn.initializers.normal(0.1, jnp.float32), (spec.image_tokens, spec.features))
        tokens = (tokens + place[None, None]).reshape(b, n * spec.image_tokens, spec.features)
        mask = jnp.repeat(usable, spec.image_tokens, axis=1)
        alpha = jnp.mean(alpha, axis=1).reshape(b, n, *alpha.shape[2:])
        alpha = alpha * usable[:, :, None, None].astype(jnp.float32)
        lifted = None
        if spec.lifts:
            seen = _pyramid(self.spec, maps)
            seen = seen.reshape(b, n, *seen.shape[1:])
            lift = Lift(spec.bev, 2, spec.lift_depths, spec.features, spec.lift_features, name="lift")
            lifted = lift(seen, camera, rig, usable, (rows, columns))
        return tokens, mask, alpha, lifted

    def _scan(self, inputs: Inputs) -> tuple[Array, Array, Array]:
        spec = self.spec
        net = PointNet(spec.point_widths, spec.features, spec.sectors, spec.num_heads, name="points")
        return net(inputs.points, inputs.point_valid)

    def _known(self, inputs: Inputs) -> Array:
        """What is known of each cell, as channels."""
        free, taken = inputs.local_map == FREE, inputs.local_map == OCCUPIED
        channels = [free.astype(jnp.float32), taken.astype(jnp.float32)]
        if self.spec.rule:
            sure = shares(inputs.rule_confidence)
            channels += [sure * shares(inputs.rule_p), sure]
        known = jnp.stack(channels, axis=-1)
        return known if self.spec.scans else jnp.zeros_like(known)

    @nn.compact
    def __call__(self, inputs: Inputs) -> Outputs:
        spec, d = self.spec, self.spec.features
        b, n = inputs.images.shape[:2]
        image, image_mask = jnp.zeros((b, 0, d), jnp.float32), jnp.zeros((b, 0), bool)
        lidar, lidar_mask, lifted = image, image_mask, None
        alpha, beta = jnp.zeros((b, n, 1, 1), jnp.float32), jnp.zeros(inputs.points.shape[:2], jnp.float32)
        if spec.sees and n:
            image, image_mask, alpha, lifted = self._see(inputs)
        elif spec.lifts:  # no camera sees any cell
            lifted = jnp.zeros((b, spec.bev.shape[0] // 2, spec.bev.shape[1] // 2, spec.lift_features + 1), jnp.float32)
        if spec.scans:
            lidar, lidar_mask, beta = self._scan(inputs)
        fusion = CrossModal(spec.num_heads, spec.attention_layers, name="fusion")
        image, lidar = fusion(image, image_mask, lidar, lidar_mask)
        joint = Integration(spec.joint, name="integration")(image, image_mask, lidar, lidar_mask)
        if spec.head == "grid":
            tokens, mask = jnp.concatenate([image, lidar], axis=1), jnp.concatenate([image_mask, lidar_mask], axis=1)
            cells, seen = GridHead(spec.grid, name="cells")(self._known(inputs), lifted, tokens, mask, joint)
            ways = WayHead(name="ways")(jnp.concatenate([seen, joint], axis=-1))
        else:
            cells = TokenHead(spec.bev.shape, name="cells")(joint)
            ways = WayHead(name="ways")(joint)
        dead, traversable, recoverability, depth = (cells[..., k] for k in range(4))
        return Outputs(
            path=ways[:, :3], flag=ways[:, 3], dead=dead, traversable=traversable, recoverability=recoverability,
            depth=depth, alpha=alpha, beta=beta,
        )  # fmt: skip


def _pyramid(spec: NetworkSpec, maps: dict[int, Array]) -> Array:
    """Maps of `lift_stride`, with what coarser ones know added to each pixel; called inside a module."""
    fine = maps[spec.lift_stride]
    total = None
    for stride in spec.encoder.strides:
        if stride < spec.lift_stride:
            continue
        part = Dense(spec.lift_width, name=f"pyramid{stride}")(Norm(name=f"pyramid_norm{stride}")(maps[stride]))
        by = stride // spec.lift_stride
        part = jnp.repeat(jnp.repeat(part, by, axis=1), by, axis=2)[:, : fine.shape[1], : fine.shape[2]]
        total = part if total is None else total + part
    assert total is not None
    return nn.silu(total)


def example(spec: NetworkSpec, rig: RigSpec, num_points: int, batch: int = 1) -> Inputs:
    """Inputs of the right shapes in which every sensor is missing."""
    n = len(rig.mounts)
    cells = jnp.zeros((batch, *spec.bev.shape), jnp.uint8)
    return Inputs(
        images=jnp.zeros((batch, n, *rig.shape, 3), jnp.uint8),
        image_valid=jnp.zeros((batch, n), bool),
        points=jnp.zeros((batch, num_points, 3), jnp.float32),
        point_valid=jnp.zeros((batch, num_points), bool),
        rig=jax.tree.map(lambda a: jnp.broadcast_to(a, (batch, *a.shape)), rig_of(rig)),
        local_map=cells,
        rule_p=cells,
        rule_confidence=cells,
    )


@partial(jax.jit, static_argnames="spec")
def init(key: PRNGKeyArray, spec: NetworkSpec) -> Any:
    """Parameters as a pytree of float32 arrays; they do not depend on image size, number of cameras or of points.

    Args:
        key: Randomness.
        spec: What to make them for.
    """
    inputs = jax.eval_shape(partial(example, spec, RigSpec(), 8))
    return _Network(spec).lazy_init(key, inputs)["params"]


def apply(spec: NetworkSpec, params: Any, inputs: Inputs) -> Outputs:
    """What the network says of a batch.

    Args:
        spec: What the parameters are for (static).
        params: From `init` or training.
        inputs: B frames; missing sensors are masked, values of masked ones do not matter.
    """
    return _Network(spec).apply({"params": params}, inputs)  # pyright: ignore[reportReturnType]


@partial(jax.jit, static_argnames="spec")
def infer(spec: NetworkSpec, params: Any, inputs: Inputs) -> Outputs:
    """`apply`, compiled."""
    return apply(spec, params, inputs)


def count(params: Any) -> int:
    """Number of parameters."""
    return sum(int(leaf.size) for leaf in jax.tree.leaves(params))
