"""What training does to frames, so that the network bears sensors that fail, other mounts and other light.

Mirrored at the robot's x axis, with M = diag(1, -1, 1) in `base_link` and D = diag(-1, 1, 1) in the optical frame,

    (1)  p -> M p,  R -> M R D,  cx -> columns - cx,  image columns and grid rows reversed, left and right exchanged

so a mirrored rig stays a right-handed one. Every frame draws for itself, from the key of its step and its place in the
batch: neither the number of devices nor an interruption changes anything.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray

from drnav_jax.models.batch import UNKNOWN, Batch, Inputs, Targets, shares
from drnav_jax.types import CameraRig, Scalar

EVERY = 2  # of the points only every so many-th is read


class AugmentParams(NamedTuple):
    """How often each thing happens (shares of frames), and how much."""

    mirror: Scalar = 0.5  # []
    one_camera: Scalar = 0.12  # [] of cameras: each goes missing by itself
    all_cameras: Scalar = 0.1  # []
    no_lidar: Scalar = 0.06  # [] neither points nor the map made of them
    thin: Scalar = 0.25  # [] only a share of the points, 3 to 100 %
    one_ring: Scalar = 0.08  # [] points of one height only
    black: Scalar = 0.15  # [] some pixels are black
    black_share: Scalar = 0.25  # [] at most so many of them
    no_rule: Scalar = 0.1  # [] the geometric rule is silent
    light: Scalar = 0.15  # [] standard deviation of the gain of the images
    shift: Scalar = 0.03  # [] standard deviation of what is wrong with a camera's position [m]
    turn: Scalar = 0.015  # [] and with its rotation [rad]


def mirrored(batch: Batch) -> Batch:
    """Eq. 1 on one frame (fields without batch axis)."""
    x, y = batch.inputs, batch.targets
    m = jnp.asarray([1.0, -1.0, 1.0], jnp.float32)
    d = jnp.asarray([-1.0, 1.0, 1.0], jnp.float32)
    columns = x.images.shape[-2]
    across = jnp.asarray([-1.0, 1.0], jnp.float32)
    rig = CameraRig(
        focal=x.rig.focal,
        centre=x.rig.centre * across[None] + jnp.asarray([columns, 0.0], jnp.float32)[None],
        position=x.rig.position * m[None],
        rotation=x.rig.rotation * m[None, :, None] * d[None, None, :],
    )
    flip = lambda a: jnp.flip(a, axis=0)  # noqa: E731
    swap = jnp.asarray([0, 2, 1])
    cells = ("visibility", "dead_end", "inside", "valid", "depth", "traversable", "recoverability", "interior")
    return Batch(
        inputs=x._replace(
            images=jnp.flip(x.images, axis=-2), points=x.points * m[None].astype(x.points.dtype), rig=rig,
            local_map=flip(x.local_map), rule_p=flip(x.rule_p), rule_confidence=flip(x.rule_confidence),
        ),
        targets=y._replace(
            **{name: flip(getattr(y, name)) for name in cells},
            path=y.path[swap], path_stable=y.path_stable[swap],
        ),
    )  # fmt: skip


def turned(rig: CameraRig, shift: Array, angles: Array) -> CameraRig:
    """A rig as it is believed to be: `shift` [N, 3] and small rotation `angles` [N, 3] off."""
    a, b, c = angles[:, 0], angles[:, 1], angles[:, 2]
    one = jnp.ones_like(a)
    small = jnp.stack([one, -c, b, c, one, -a, -b, a, one], axis=-1).reshape(-1, 3, 3)
    return rig._replace(position=rig.position + shift, rotation=jnp.einsum("nij,njk->nik", small, rig.rotation))


def _sensors(params: AugmentParams, x: Inputs, key: PRNGKeyArray) -> Inputs:
    keys = iter(jax.random.split(key, 20))
    chance = lambda share, shape=(): jax.random.uniform(next(keys), shape, jnp.float32) < share  # noqa: E731
    normal = lambda shape: jax.random.normal(next(keys), shape, jnp.float32)  # noqa: E731
    cameras = x.images.shape[0]
    # light, black pixels
    gain = jnp.exp(params.light * normal((cameras, 1, 1, 3)) * 0.5 + params.light * normal((cameras, 1, 1, 1)))
    share = params.black_share * jax.random.uniform(next(keys), (), jnp.float32)
    share = jnp.where(chance(params.black), share, 0.0)
    lit = ~chance(share, x.images.shape[:3])
    images = jnp.clip(shares(x.images) * gain, 0.0, 1.0) * lit[..., None].astype(jnp.float32)
    rig = turned(x.rig, params.shift * normal((cameras, 3)), params.turn * normal((cameras, 3)))
    # whole sensors
    usable = x.image_valid & ~chance(params.one_camera, (cameras,)) & ~chance(params.all_cameras)
    blind = chance(params.no_lidar) & jnp.any(usable)
    kept = jnp.exp(jnp.log(0.03) * jax.random.uniform(next(keys), (), jnp.float32))
    kept = jnp.where(chance(params.thin), kept, 1.0)
    # every second beam, which halves the cost of the scan
    count = x.points.shape[0] // EVERY
    start = jax.random.randint(next(keys), (), 0, EVERY, jnp.int32)
    half = lambda a: a[: count * EVERY].reshape(count, EVERY, *a.shape[1:])[:, start]  # noqa: E731
    x = x._replace(points=half(x.points), point_valid=half(x.point_valid))
    valid = x.point_valid & chance(kept, x.point_valid.shape) & ~blind
    points = x.points.astype(jnp.float32)
    flat = jnp.hypot(points[:, 0], points[:, 1])
    slope = (points[:, 2] - 0.5) / jnp.maximum(flat, 0.1)  # of the beams, from about the LiDAR's height
    ring = jnp.abs(slope - 0.03 * normal(())) < 0.015
    valid = valid & (ring | ~chance(params.one_ring))
    silent = chance(params.no_rule) | blind
    return x._replace(
        images=images, image_valid=usable, points=points, point_valid=valid, rig=rig,
        local_map=jnp.where(blind, UNKNOWN, x.local_map).astype(jnp.uint8),
        rule_confidence=jnp.where(silent, 0, x.rule_confidence).astype(x.rule_confidence.dtype),
    )  # fmt: skip


def augment(params: AugmentParams, batch: Batch, key: PRNGKeyArray, first: Array) -> Batch:
    """A batch as training sees it.

    Args:
        params: How often, how much.
        batch: B frames.
        key: Of the step.
        first: Place of the first of them in the whole batch, of which a device may hold a part.
    """

    def one(frame: Batch, number: Array) -> Batch:
        k_mirror, k_rest = jax.random.split(jax.random.fold_in(key, number))
        turned = jax.random.uniform(k_mirror, (), jnp.float32) < params.mirror
        frame = jax.tree.map(lambda a, b: jnp.where(turned, a, b), mirrored(frame), frame)
        return frame._replace(inputs=_sensors(params, frame.inputs, k_rest))

    count = batch.inputs.points.shape[0]
    return jax.vmap(one)(batch, first + jnp.arange(count, dtype=jnp.int32))


def trimmed(batch: Batch) -> Batch:
    """Only what the loss needs: the rest of `Targets` as empty arrays, so that it need not travel to the device."""
    unused = ("family", "seed", "closed", "strata", "strata_seen")
    none = jnp.zeros((batch.targets.path.shape[0], 0), jnp.uint8)
    targets: Targets = batch.targets._replace(**dict.fromkeys(unused, none))
    return batch._replace(targets=targets)
