"""A fusion network that compiles in seconds, and frames for it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from drnav_jax.dataset.frames import Frame, dtypes
from drnav_jax.models.batch import Inputs, batch_of
from drnav_jax.models.efficientnet import EncoderSpec
from drnav_jax.models.heads import GridSpec
from drnav_jax.models.network import NetworkSpec, init
from drnav_jax.types import BevSpec, Mount, RigSpec, rig_of

BEV = BevSpec(shape=(8, 16), resolution=0.4, ahead=2.0)
SPEC = NetworkSpec(
    encoder=EncoderSpec(stages=((2, 3, 2, 8, 1),), stem=(4, 4, 8)),
    bev=BEV, grid=GridSpec(widths=(8, 8, 8), blocks=(1, 0, 1), num_heads=2), features=8, image_tokens=2, sectors=4,
    point_widths=(8,), num_heads=2, joint=8, lift_stride=4, lift_width=4, lift_features=3, lift_depths=4,
)  # fmt: skip
RIG = RigSpec((Mount(pitch=0.1), Mount(x=0.0, y=0.1, yaw=1.5, fov=1.4), Mount(x=0.0, y=-0.1, yaw=-1.5, fov=1.3)), (16, 24))
NUM_POINTS = 14
# With the fewest parts, for what a step or a run does around a network: its gradient compiles in a third of the time
LEAST = dataclasses.replace(SPEC, head="tokens", lift=False, attention_layers=0)


def inputs(batch=2, rig=RIG, num_points=NUM_POINTS, bev=BEV, seed=0, share=0.7):
    """Random inputs in which every sensor is there, and a share of the points."""
    rng, n = np.random.default_rng(seed), len(rig.mounts)
    points = rng.normal(size=(batch, num_points, 3)) * [3.0, 3.0, 0.3] + [0.0, 0.0, 0.5]
    cells = (batch, *bev.shape)
    return Inputs(
        images=jnp.asarray(rng.random((batch, n, *rig.shape, 3)), jnp.float32),
        image_valid=jnp.ones((batch, n), bool),
        points=jnp.asarray(points, jnp.float32),
        point_valid=jnp.asarray(rng.random((batch, num_points)) < share),
        rig=jax.tree.map(lambda a: jnp.broadcast_to(a, (batch, *a.shape)), rig_of(rig)),
        local_map=jnp.asarray(rng.integers(0, 3, cells), jnp.uint8),
        rule_p=jnp.asarray(rng.random(cells), jnp.float32),
        rule_confidence=jnp.asarray(rng.random(cells), jnp.float32),
    )


def filled(tree, seed=0):
    """Random values for the shapes of a tree: of order 1 through a layer, and no bias 0 or scale 1 that hides a fault."""
    rng = np.random.default_rng(seed)

    def values(path, leaf):
        name, shape = path[-1].key, leaf.shape
        if name == "scale":
            return jnp.asarray(rng.uniform(0.5, 1.5, shape), jnp.float32)
        if name == "depthwise":
            return jnp.asarray(rng.normal(size=shape) / shape[0], jnp.float32)
        fan = int(np.prod(shape[:-1])) if len(shape) > 1 else 10
        return jnp.asarray(rng.normal(size=shape) / np.sqrt(fan), jnp.float32)

    return jax.tree_util.tree_map_with_path(values, tree)


def params_of(spec=SPEC, seed=0):
    """Random parameters of a network; its own `init` takes far longer to compile."""
    return filled(jax.eval_shape(lambda: init(jax.random.key(0), spec)), seed)


def run(function, *args):
    """The function's value, compiled."""
    return jax.jit(function)(*args)


def frames(count, seed=0, spec=SPEC, rig=RIG, num_points=2 * NUM_POINTS):
    """Stored frames at random, but for rigs, and labels that the known map gives away."""
    rng, n, cells = np.random.default_rng(seed), len(rig.mounts), (count, *spec.bev.shape)
    flags = lambda *shape, share=0.5: rng.random((count, *shape)) < share  # noqa: E731
    known = rng.integers(0, 3, cells)
    dead = (known == 2) ^ (rng.random(cells) < 0.1)
    path = known[:, :3, :].mean(axis=2) > 1
    points = rng.normal(size=(count, num_points, 3)) * [3.0, 3.0, 0.3] + [0.0, 0.0, 0.5]
    fields = {
        "images": rng.integers(0, 256, (count, n, *rig.shape, 3)), "image_valid": np.ones((count, n), bool),
        "points": points, "point_valid": flags(num_points, share=0.9), "local_map": known,
        "rule_p": rng.integers(0, 256, cells), "rule_confidence": rng.integers(0, 256, cells),
        "visibility": rng.integers(0, 3, cells), "dead_end": dead, "inside": flags(*cells[1:], share=0.9),
        "valid": flags(*cells[1:], share=0.8), "depth": rng.uniform(0, 5, cells), "traversable": flags(*cells[1:]),
        "recoverability": rng.random(cells), "interior": flags(*cells[1:], share=0.3), "path": path,
        "path_stable": flags(3, share=0.8), "dead_end_flag": ~path.any(axis=1), "flag_stable": flags(share=0.8),
        "pose": rng.normal(size=(count, 3)), "family": rng.integers(0, 3, count), "seed": rng.integers(0, 9, count),
        "closed": flags(), "behaviour": rng.integers(0, 3, count), "strata": rng.integers(0, 8, count),
        "strata_seen": rng.integers(0, 8, count),
    } | {name: np.broadcast_to(a, (count, *a.shape)) for name, a in rig_of(rig)._asdict().items()}  # fmt: skip
    return Frame(**{name: np.asarray(fields[name], kind) for name, kind in dtypes().items()})


def batch(count, seed=0):
    """Frames as training sees them."""
    return batch_of(frames(count, seed)._asdict())
