"""Frame labels cell by cell against the world's, and the visibility class."""

import math
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drnav_jax import worlds
from drnav_jax.types import BevSpec
from drnav_jax.worlds.frames import BEFORE, NEVER, NOW, FrameLabels, frames, visibility
from drnav_jax.worlds.openings import openings
from drnav_jax.worlds.truth import interior, truth

BEV = BevSpec(shape=(10, 14), resolution=0.5, ahead=1.5)
HALF = 2e-3  # of float16, in values of 1 m and less


def under(bev, pose, i, j, dx=0.0, dy=0.0):
    """World x, y of the centre of a cell of the bird's-eye grid, moved by dx, dy in base_link."""
    x = bev.ahead - bev.shape[1] * bev.resolution / 2 + (j + 0.5) * bev.resolution + dx
    y = -bev.shape[0] * bev.resolution / 2 + (i + 0.5) * bev.resolution + dy
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return pose[0] + c * x - s * y, pose[1] + s * x + c * y


def cell_at(made, x, y):
    cell = int(math.floor((y - made.origin[1]) / 0.1)), int(math.floor((x - made.origin[0]) / 0.1))
    return cell if all(0 <= c < n for c, n in zip(cell, made.label.shape, strict=True)) else None


def twins(family="t", seed=1):
    return [truth(worlds.sample(name, seed, "train")) for name in (family, f"{family}-open")]


def poses_in(made, num, seed=0):
    rng = np.random.default_rng(seed)
    cells = np.argwhere(made.standable)[:, ::-1]
    xy = (cells[rng.integers(len(cells), size=num)] + 0.37) * 0.1 + made.origin
    return np.concatenate([xy, rng.uniform(-4, 4, (num, 1))], axis=1)


def test_equals_brute_force():
    closed, opened = twins()
    mask = interior(closed, opened)
    poses = poses_in(closed, 12)
    poses[0] = *closed.origin, 0.7  # looks beyond the world
    got = frames(closed, poses, BEV, interior=mask)
    seen = np.zeros(4, int)
    for k, pose in enumerate(poses):
        for i, j in np.ndindex(BEV.shape):
            cell = cell_at(closed, *under(BEV, pose, i, j))
            here = {name: getattr(got, name)[k, i, j] for name in FrameLabels._fields[:7]}
            if cell is None:
                assert not any(here.values())
                continue
            corners = [
                cell_at(closed, *under(BEV, pose, i, j, dx, dy)) for dx in (-0.125, 0.125) for dy in (-0.125, 0.125)
            ]
            free = all(closed.traversable[c] for c in corners if c is not None)
            assert here["inside"] and here["traversable"] == free
            assert here["mask"] == (free and closed.defined[cell])
            assert here["label"] == closed.label[cell] and here["interior"] == mask[cell]
            assert here["depth"] == closed.depth[cell]
            back = math.exp(-float(closed.depth[cell]) / 4) if free else 0.0
            assert here["recoverability"] == pytest.approx(back, abs=HALF)
            seen += [here["label"], here["interior"], not free, here["mask"]]
    assert (seen > 20).all(), seen
    ways = openings(closed, poses)
    for name, value in zip(("path", "path_stable", "dead_end", "dead_end_stable"), ways, strict=True):
        np.testing.assert_array_equal(getattr(got, name), value)


def test_types_and_sizes():
    made, _ = twins("u")
    got = frames(made, poses_in(made, 150))  # more than are handled at a time
    for name, value in got._asdict().items():
        assert value.dtype == (np.float16 if name in ("depth", "recoverability") else np.uint8), name
        assert value.shape == (150,) + ((64, 64) if value.ndim == 3 else (3,) * (value.ndim - 1)), name
    assert not got.interior.any() and set(np.unique(got.mask)) == {0, 1}
    assert [len(value) for value in frames(made, np.zeros((0, 3)))] == [0] * len(got)


def test_batches_do_not_mix():
    made, _ = twins("l")
    poses = poses_in(made, 140)
    together = frames(made, poses, BEV)
    for k in (0, 3, 4, 127, 128, 139):
        for name, alone in frames(made, poses[k : k + 1], BEV)._asdict().items():
            np.testing.assert_array_equal(alone[0], getattr(together, name)[k], err_msg=name)


def test_thin_walls_stop_a_robot():
    """A wall of one cell shows, though most centres of the coarser grid miss it."""
    grid = np.zeros((100, 100), bool)
    grid[:, 60] = True
    scene = worlds.Scene("wall", worlds.from_grid(grid, (0.0, 0.0), 0.1), grid, (0.0, 0.0), 0.1)
    for x in (2.0, 2.04, 2.1, 2.13):
        free = frames(truth(scene), np.array([[x, 5.0, 0.0]]), BevSpec(shape=(8, 48))).traversable[0]
        assert (free == 0).any(axis=1).all()


def test_a_frame_turns_with_its_robot():
    """The mouth of a tube that lies ahead is ahead in the frame, whatever the heading in the world."""
    closed, _ = twins("u")
    x, y = closed.pockets.gate[0]
    for yaw in (0.0, 1.0, -2.5):
        pose = np.array([[x - 2 * math.cos(yaw), y - 2 * math.sin(yaw), yaw]])
        got = frames(closed, pose)
        cell = cell_at(closed, *under(BevSpec(), pose[0], 32, 32 + round((2.0 - 3.2) / 0.2)))
        assert got.depth[0, 32, 26] == closed.depth[cell] and got.label[0, 32, 26] == closed.label[cell]


def test_no_way_out_is_not_recoverable():
    made, _ = twins("u")
    lost = made._replace(depth=np.zeros_like(made.depth))
    pose = np.array([[*made.pockets.gate[0], 0.0]])
    before, after = frames(made, pose), frames(lost, pose)
    pocket = (before.label == 1) & (before.traversable == 1)
    assert pocket.any() and (before.recoverability[pocket] > 0).all()
    assert (after.recoverability[pocket] == 0).all()


def test_input_is_refused():
    made, _ = twins("u")
    with pytest.raises(ValueError, match="finite"):
        frames(made, np.array([[0.0, np.nan, 0.0]]))
    with pytest.raises(ValueError, match="truth's grid"):
        frames(made, np.zeros((1, 3)), interior=np.zeros((3, 4), bool))


def windows(rng):
    seen = rng.random((40, 30)) < 0.6
    return seen & (rng.random((40, 30)) < 0.5), seen


def test_visibility_equals_brute_force():
    rng = np.random.default_rng(0)
    now, seen = windows(rng)
    origin, pose = np.array([-1.0, 2.0], np.float32), np.array([0.3, 3.1, 0.8], np.float32)
    got = np.asarray(visibility(jnp.asarray(now), jnp.asarray(seen), jnp.asarray(origin), 0.2, jnp.asarray(pose), BEV))
    assert got.dtype == np.uint8 and set(np.unique(got)) == {NEVER, BEFORE, NOW}
    for i, j in np.ndindex(BEV.shape):
        x, y = under(BEV, pose.astype(float), i, j)
        cell = math.floor((y - 2.0) / 0.2), math.floor((x + 1.0) / 0.2)
        want = NEVER
        if all(0 <= c < n for c, n in zip(cell, seen.shape, strict=True)):
            want = NOW if now[cell] else BEFORE if seen[cell] else NEVER
        assert got[i, j] == want


def test_visibility_is_traced_once():
    chex.clear_trace_counter()
    rng = np.random.default_rng(1)
    run = partial(jax.jit(chex.assert_max_traces(visibility, n=1), static_argnames="bev"), bev=BEV)
    for _ in range(2):
        now, seen = windows(rng)
        pose = jnp.asarray(rng.normal(size=3), jnp.float32)
        run(jnp.asarray(now), jnp.asarray(seen), jnp.zeros(2, jnp.float32), jnp.float32(0.2), pose)
