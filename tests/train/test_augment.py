"""What training does to frames: mirrors are mirrors, sensors fail as often as asked, and no frame depends on another."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_network import BEV, NUM_POINTS, RIG, batch

from drnav_jax.models.batch import UNKNOWN
from drnav_jax.sim import depth
from drnav_jax.train.augment import EVERY, AugmentParams, augment, mirrored, trimmed
from drnav_jax.types import Mount, RigSpec, rig_of
from drnav_jax.worlds.world import make_world

NOTHING = AugmentParams(**dict.fromkeys(AugmentParams._fields, 0.0))
KEY = jax.random.key(3)

augmented = jax.jit(augment)


def one(tree, k=0):
    return jax.tree.map(lambda a: jnp.asarray(a[k]), tree)


def f32(values):
    return jnp.asarray(values, jnp.float32)


def plain(tree):
    """Arrays on the host; float16 as float32."""
    return jax.tree.map(np.asarray, tree)


def test_mirrored_twice_is_the_frame():
    frame = one(batch(1))
    twice = mirrored(mirrored(frame))
    chex.assert_trees_all_equal(plain(twice), plain(frame))
    once = mirrored(frame)
    for name in ("images", "points", "rig", "local_map"):
        a, b = (jax.tree.leaves(getattr(x.inputs, name)) for x in (once, frame))
        assert any(np.abs(np.float32(p) - np.float32(q)).max() > 0 for p, q in zip(a, b, strict=True)), name


def pixel_of(rig, camera, point):
    """(u, v, depth) of a point in base_link."""
    inside = np.float64(rig.rotation[camera]).T @ (point - np.float64(rig.position[camera]))
    return np.float64(rig.focal[camera]) * inside[:2] / inside[2] + np.float64(rig.centre[camera]), inside[2]


def test_a_point_seen_by_a_rig_is_seen_mirrored_by_the_mirrored_rig():
    """Also by cameras that are pitched, rolled and whose principal point is not in the middle."""
    tilted = Mount(x=0.2, y=0.15, yaw=0.4, pitch=0.2, roll=0.3)
    mounts = (tilted, Mount(y=-0.3, yaw=-1.2, pitch=-0.1), Mount(yaw=2.0, roll=-0.4))
    rig = rig_of(RigSpec(mounts, RIG.shape))
    rig = rig._replace(centre=rig.centre + f32([1.5, -2.0])[None], focal=rig.focal * f32([1.1, 0.9])[None])
    frame = one(batch(1))
    frame = frame._replace(inputs=frame.inputs._replace(rig=rig))
    other = mirrored(frame).inputs.rig
    for n in range(3):  # still right-handed frames
        r = np.float64(other.rotation[n])
        np.testing.assert_allclose(r @ r.T, np.eye(3), atol=1e-6)
        assert np.linalg.det(r) == pytest.approx(1.0, abs=1e-6)
    rng, seen = np.random.default_rng(0), 0
    for _ in range(200):
        point, n = rng.normal(size=3) * [4, 4, 1], int(rng.integers(3))
        (u, v), ahead = pixel_of(rig, n, point)
        if ahead < 0.3:
            continue
        seen += 1
        (mu, mv), far = pixel_of(other, n, point * [1, -1, 1])
        np.testing.assert_allclose([mu, mv, far], [RIG.shape[1] - u, v, ahead], rtol=1e-4, atol=1e-3)  # float32 rigs
    assert seen > 60


def test_the_mirrored_world_from_the_mirrored_rig_is_the_mirrored_image():
    mounts = (Mount(x=0.2, y=0.15, yaw=0.4), Mount(y=-0.3, yaw=-1.2, fov=1.2), Mount(yaw=2.0))
    spec = RigSpec(mounts, RIG.shape)
    boxes = np.array([
        [3.0, 1.0, 0.4, 0.5, 0.8, 0.0, 1.0], [1.0, -2.5, -0.3, 1.0, 0.1, 0.0, 2.0], [-2.0, 2.0, 1.0, 0.3, 0.6, 0.2, 0.9]
    ])  # fmt: skip
    other = boxes * [1, -1, -1, 1, 1, 1, 1]
    pose = f32([0, 0, 0])
    seen = depth(spec, make_world(boxes), rig_of(spec), pose)
    near = jnp.where(jnp.isfinite(seen), seen, 99.0)
    frame = one(batch(1))
    frame = frame._replace(
        inputs=frame.inputs._replace(images=jnp.repeat(near[..., None], 3, axis=-1), rig=rig_of(spec))
    )
    turned = mirrored(frame).inputs
    again = np.asarray(depth(spec, make_world(other), turned.rig, pose))
    again = np.where(np.isfinite(again), again, 99.0)
    assert (again < 4).mean() > 0.1 and np.abs(again - np.asarray(near)).max() > 1  # boxes, and not where they were
    # where a ray grazes an edge, float32 may take what lies behind it
    close = np.isclose(again, np.asarray(turned.images[..., 0]), rtol=1e-3)
    assert close.mean() > 0.995


def test_cells_ways_and_points_change_sides():
    frame = one(batch(1))
    h, w = BEV.shape
    x0, y0 = BEV.origin
    place = lambda i, j: (x0 + (j + 0.5) * BEV.resolution, y0 + (i + 0.5) * BEV.resolution)  # noqa: E731
    cell = (1, 11)
    x, y = place(*cell)
    marked = frame._replace(
        inputs=frame.inputs._replace(
            local_map=jnp.zeros((h, w), jnp.uint8).at[cell].set(2),
            points=frame.inputs.points.at[0].set(jnp.asarray([x, y, 0.7], jnp.float16)),
        ),
        targets=frame.targets._replace(
            dead_end=jnp.zeros((h, w), bool).at[cell].set(True), depth=jnp.zeros((h, w), jnp.float16).at[cell].set(3.0),
            path=jnp.asarray([True, True, False]), path_stable=jnp.asarray([False, False, True]),
        ),
    )  # fmt: skip
    got = mirrored(marked)
    for grid in (got.inputs.local_map, got.targets.dead_end, got.targets.depth):
        found = [tuple(c) for c in np.argwhere(np.asarray(grid))]
        assert len(found) == 1 and place(*found[0]) == pytest.approx((x, -y))
    np.testing.assert_allclose(got.inputs.points[0], [x, -y, 0.7], rtol=1e-3)  # float16
    assert got.targets.path.tolist() == [True, False, True] and got.targets.path_stable.tolist() == [False, True, False]
    for name in ("dead_end_flag", "flag_stable", "family", "seed"):
        assert getattr(got.targets, name) == getattr(frame.targets, name)


def test_nothing_happens_if_nothing_shall():
    frames = batch(5)
    got = augmented(NOTHING, frames, KEY, 0)
    np.testing.assert_allclose(got.inputs.images, frames.inputs.images / 255.0, rtol=1e-6)
    chex.assert_trees_all_equal(plain(got.targets), plain(frames.targets))
    for name in ("image_valid", "local_map", "rule_p", "rule_confidence"):
        np.testing.assert_array_equal(getattr(got.inputs, name), getattr(frames.inputs, name))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-7), got.inputs.rig, frames.inputs.rig)
    assert got.inputs.points.shape == (5, NUM_POINTS, 3) and NUM_POINTS * EVERY == frames.inputs.points.shape[1]
    starts = set()
    for k in range(5):  # every second beam, all from one start
        beams = np.float32(frames.inputs.points[k])
        found = [s for s in range(EVERY) if np.array_equal(got.inputs.points[k], beams[s::EVERY])]
        assert len(found) == 1
        np.testing.assert_array_equal(got.inputs.point_valid[k], frames.inputs.point_valid[k][found[0] :: EVERY])
        starts |= set(found)
    assert starts == {0, 1}


def always(**changes):
    return augmented(NOTHING._replace(**changes), batch(5), KEY, 0)


def test_each_thing_happens_if_it_always_shall():
    frames, clean = batch(5), always()
    turned = jax.vmap(mirrored)(jax.tree.map(jnp.asarray, frames))
    got = always(mirror=1.0)
    chex.assert_trees_all_equal(plain(got.targets), plain(turned.targets))
    np.testing.assert_allclose(got.inputs.images, np.asarray(turned.inputs.images) / 255.0, rtol=1e-6)
    for gone in (always(all_cameras=1.0), always(one_camera=1.0)):
        assert not np.asarray(gone.inputs.image_valid).any()
        np.testing.assert_array_equal(gone.inputs.point_valid, clean.inputs.point_valid)
    blind = always(no_lidar=1.0).inputs
    assert not np.asarray(blind.point_valid).any() and (np.asarray(blind.local_map) == UNKNOWN).all()
    assert not np.asarray(blind.rule_confidence).any() and np.asarray(blind.image_valid).all()
    both = always(no_lidar=1.0, all_cameras=1.0).inputs  # never both: of such a frame nothing can be learned
    np.testing.assert_array_equal(both.point_valid, clean.inputs.point_valid)
    silent = always(no_rule=1.0).inputs
    assert not np.asarray(silent.rule_confidence).any()
    np.testing.assert_array_equal(silent.local_map, clean.inputs.local_map)
    ring = always(one_ring=1.0).inputs
    kept, before = np.asarray(ring.point_valid), np.asarray(clean.inputs.point_valid)
    assert not (kept & ~before).any() and kept.sum() < 0.3 * before.sum()
    black = np.asarray(always(black=1.0, black_share=1.0).inputs.images)
    lit = np.asarray(clean.inputs.images)
    dark = (black == 0).all(axis=-1) & (lit > 0).any(axis=-1)
    assert 0 < dark.mean() < 1
    np.testing.assert_array_equal(black[~dark], lit[~dark])
    bright = np.asarray(always(light=0.3).inputs.images)
    assert bright.min() >= 0 and bright.max() <= 1 and np.abs(bright - lit).mean() > 0.02
    rig = always(shift=0.05, turn=0.02).inputs.rig
    off = np.asarray(rig.position) - np.asarray(clean.inputs.rig.position)
    assert 0.02 < off.std() < 0.1
    by_camera = [np.reshape(x.rotation, (-1, 3, 3)) for x in (rig, clean.inputs.rig)]
    for r, true in zip(*by_camera, strict=True):
        np.testing.assert_allclose(r @ r.T, np.eye(3), atol=0.02)  # small angles: orthonormal to their square
        angle = np.arccos(np.clip((np.trace(r @ true.T) - 1) / 2, -1, 1))
        assert angle < 0.12


def test_shares_are_as_asked():
    """Of 400 frames: within four standard deviations."""
    frames = jax.tree.map(lambda a: np.repeat(a, 400, axis=0), batch(1))
    params = NOTHING._replace(mirror=0.3, one_camera=0.2, no_lidar=0.1, thin=0.5, no_rule=0.25)
    got = augmented(params, frames, KEY, 0).inputs
    close = lambda share, want, count=400: abs(share - want) < 4 * (want * (1 - want) / count) ** 0.5  # noqa: E731
    assert close(np.mean(np.asarray(got.rig.position)[:, 1, 1] < 0), 0.3)  # the left camera stands on the right
    assert close(1 - np.mean(got.image_valid), 0.2, 1200)
    blind = (np.asarray(got.local_map) == UNKNOWN).all(axis=(1, 2))
    assert close(blind.mean(), 0.1 * (1 - 0.2**3))
    assert close(np.mean(np.asarray(got.rule_confidence).max(axis=(1, 2)) == 0), 1 - 0.75 * (1 - 0.1))
    kept = np.asarray(got.point_valid)[~blind].sum(axis=1) / frames.inputs.point_valid[0].sum() * EVERY
    assert 0.25 < np.mean(kept < 0.5) < 0.5 and kept.min() < 0.2  # a half is thinned, evenly in the logarithm down to 3 %


def test_a_frame_depends_on_its_place_alone():
    """Two halves, each told where it begins, make the whole batch: nothing depends on the number of devices."""
    params, frames = AugmentParams(), batch(6)
    whole = augmented(params, frames, KEY, 0)
    halves = [augmented(params, jax.tree.map(lambda a, s=s: a[s : s + 3], frames), KEY, s) for s in (0, 3)]
    joined = jax.tree.map(lambda *a: jnp.concatenate(a), *halves)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(np.float32(a), np.float32(b), atol=1e-6), joined, whole)
    np.testing.assert_array_equal(joined.inputs.point_valid, whole.inputs.point_valid)
    other = augmented(params, frames, jax.random.key(4), 0)
    assert np.abs(np.asarray(other.inputs.images) - np.asarray(whole.inputs.images)).max() > 0
    same = augmented(params, jax.tree.map(lambda a: np.repeat(a[:1], 6, axis=0), frames), KEY, 0)
    images = np.asarray(same.inputs.images)
    assert all(np.abs(images[0] - images[k]).max() > 0 for k in range(1, 6))  # one frame, six fates


def test_only_what_the_loss_needs_travels():
    from drnav_jax.models import losses
    from drnav_jax.models.losses import LossParams
    from drnav_jax.models.network import Outputs

    frames = batch(4)
    slim = trimmed(frames)
    assert slim.inputs is frames.inputs
    for name in ("family", "seed", "closed", "strata", "strata_seen"):
        assert getattr(slim.targets, name).size == 0 and len(getattr(slim.targets, name)) == 4
    cells = jnp.full((4, *BEV.shape), 0.3, jnp.float32)
    out = Outputs(jnp.ones((4, 3)), jnp.ones(4), cells, cells, cells, cells, cells, cells)
    known = jnp.asarray(frames.inputs.local_map)
    a, b = (losses.sums(LossParams(), out, t, known) for t in (slim.targets, frames.targets))
    chex.assert_trees_all_equal(a, b)


def test_an_odd_number_of_points():
    frames = batch(2)
    odd = frames._replace(
        inputs=frames.inputs._replace(points=frames.inputs.points[:, :-1], point_valid=frames.inputs.point_valid[:, :-1])
    )
    assert augmented(NOTHING, odd, KEY, 0).inputs.points.shape == (2, NUM_POINTS - 1, 3)


def test_rigs_of_one_camera():
    spec = dataclasses.replace(RIG, mounts=RIG.mounts[:1])
    frames = batch(2)
    alone = frames._replace(
        inputs=frames.inputs._replace(
            images=frames.inputs.images[:, :1], image_valid=frames.inputs.image_valid[:, :1],
            rig=jax.tree.map(lambda a: np.broadcast_to(a, (2, *a.shape)), rig_of(spec)),
        )
    )  # fmt: skip
    assert augmented(AugmentParams(), alone, KEY, 0).inputs.images.shape == (2, 1, *RIG.shape, 3)
