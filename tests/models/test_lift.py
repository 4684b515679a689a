"""Camera features on the bird's-eye grid: geometry by loops over cells, and what is painted lands where it should."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_network import filled

from drnav_jax.models import lift
from drnav_jax.models.lift import Lift, read, row_weights, taps
from drnav_jax.types import BevSpec, Mount, RigSpec, rig_of

BEV = BevSpec(shape=(24, 32), resolution=0.5, ahead=1.0)
PIXELS, COLUMNS, DEPTHS = (40, 60), 12, 9
LEVEL = RigSpec((Mount(), Mount(x=-0.2, y=0.1, yaw=1.7, fov=1.3), Mount(y=-0.1, z=0.8, yaw=-1.4, fov=1.2)), PIXELS)
TILTED = RigSpec(
    (Mount(pitch=0.25, roll=0.2), Mount(y=0.1, yaw=2.0, pitch=-0.15, fov=1.1), Mount(y=-0.2, yaw=-1.9, roll=-0.3)), PIXELS
)
RIGS = pytest.mark.parametrize("rig", [LEVEL, TILTED], ids=["level", "tilted"])
NEAREST, FARTHEST = 0.5, 12.0  # [m] of the depths

_taps = jax.jit(lambda rig, usable: taps(BEV, 2, rig, usable, PIXELS[1], COLUMNS, DEPTHS))


def arrays(rig, batch=1):
    return jax.tree.map(lambda a: jnp.broadcast_to(a, (batch, *a.shape)), rig_of(rig))


def usable(*there):
    return jnp.asarray([there], bool)


def places():
    """base_link x, y of the cells that come out, 2 x 2 of the grid's, row by row."""
    h, w = BEV.shape
    x0, y0 = BEV.ahead - w * BEV.resolution / 2, -h * BEV.resolution / 2
    return [(x0 + (j + 0.5) * 1.0, y0 + (i + 0.5) * 1.0) for i in range(h // 2) for j in range(w // 2)]


def view(mount, x, y):
    """(pixel column, cosine to the optical axis as seen from above, distance) of a cell, at half the camera's height."""
    dx, dy, dz = x - mount.x, y - mount.y, -0.5 * mount.z
    turn = lambda a, b, t: (math.cos(t) * a + math.sin(t) * b, -math.sin(t) * a + math.cos(t) * b)  # noqa: E731
    forward, left = turn(dx, dy, mount.yaw)
    up, forward = turn(dz, forward, mount.pitch)  # pitch looks down: what is ahead and below comes to the axis
    left, up = turn(left, up, mount.roll)
    focal = 0.5 * PIXELS[1] / math.tan(mount.fov / 2)
    distance = math.hypot(dx, dy)
    u = 0.5 * PIXELS[1] - focal * left / forward if forward > 1e-3 else math.inf
    return u, forward / distance, distance


def expected(table, rig, there=(True, True, True)):
    """Eq. 3 by a loop: the camera that sees a cell least far off its axis, bilinear in column and log distance.

    Also how many cells lie so close to a decision (image's edge, two cameras alike) that float32 may take the other.
    """
    out, seen, close = np.zeros((len(places()), table.shape[-1])), np.zeros(len(places()), bool), []
    for k, (x, y) in enumerate(places()):
        best = []
        for n, mount in enumerate(rig.mounts):
            u, facing, distance = view(mount, x, y)
            if there[n] and facing > 0.05 and 0 <= u <= PIXELS[1]:
                best.append((facing, n, u, distance))
            close += [k] if there[n] and (abs(u) < 1e-3 or abs(u - PIXELS[1]) < 1e-3 or abs(facing - 0.05) < 1e-4) else []
        best.sort(reverse=True)
        close += [k] if len(best) > 1 and best[0][0] - best[1][0] < 1e-5 else []
        if not best:
            continue
        _, n, u, distance = best[0]
        seen[k] = True
        column = np.clip(u * COLUMNS / PIXELS[1] - 0.5, 0, COLUMNS - 1)
        depth = np.clip(np.log(distance / NEAREST) / np.log(FARTHEST / NEAREST) * (DEPTHS - 1), 0, DEPTHS - 1)
        for j in range(COLUMNS):
            for t in range(DEPTHS):
                weight = max(0.0, 1 - abs(column - j)) * max(0.0, 1 - abs(depth - t))
                out[k] += weight * table[n, j, t]
    return out, seen, close


@RIGS
def test_cells_read_what_a_loop_reads(rig):
    table = np.random.default_rng(0).normal(size=(3, COLUMNS, DEPTHS, 2))
    at = _taps(arrays(rig), usable(True, True, True))
    got = read(jnp.asarray(table.reshape(1, -1, 2), jnp.float32), at)[0]
    want, seen, close = expected(table, rig)
    assert not close and 0.5 < seen.mean() < 1
    np.testing.assert_array_equal(at.seen[0], seen)
    # columns and log distances in float32: 1e-5 of up to 12 cells, between values that differ by 4
    np.testing.assert_allclose(got, want, atol=1e-3)
    assert not np.asarray(got)[~seen].any()


def test_every_frame_has_its_own_rig():
    rig = jax.tree.map(lambda a, b: jnp.stack([a, b]), rig_of(LEVEL), rig_of(TILTED))
    table = np.random.default_rng(1).normal(size=(2, 3, COLUMNS, DEPTHS, 2)).astype(np.float32)
    at = _taps(rig, jnp.ones((2, 3), bool))
    got = read(jnp.asarray(table.reshape(2, -1, 2)), at)
    for k, each in enumerate((LEVEL, TILTED)):
        np.testing.assert_allclose(got[k], expected(table[k], each)[0], atol=1e-3)


def test_a_missing_camera_sees_nothing_and_another_may_take_its_place():
    table = np.random.default_rng(2).normal(size=(3, COLUMNS, DEPTHS, 2))
    at = _taps(arrays(LEVEL), usable(False, True, True))
    want, seen, _ = expected(table, LEVEL, (False, True, True))
    np.testing.assert_array_equal(at.seen[0], seen)
    np.testing.assert_allclose(read(jnp.asarray(table.reshape(1, -1, 2), jnp.float32), at)[0], want, atol=1e-3)
    assert seen.sum() < expected(table, LEVEL)[1].sum()
    none = _taps(arrays(LEVEL), usable(False, False, False))
    assert not np.asarray(none.seen).any() and not np.asarray(none.weight).any()


@RIGS
@pytest.mark.parametrize(("camera", "column", "depth"), [(0, 6, 6), (1, 4, 5), (2, 8, 6)])
def test_what_is_painted_on_a_column_and_a_depth_lands_on_its_bearing_and_range(rig, camera, column, depth):
    table = np.zeros((1, 3, COLUMNS, DEPTHS, 1), np.float32)
    table[0, camera, column, depth] = 1.0
    got = np.asarray(read(jnp.asarray(table.reshape(1, -1, 1)), _taps(arrays(rig), usable(True, True, True))))[0, :, 0]
    mount, step = rig.mounts[camera], (FARTHEST / NEAREST) ** (1 / (DEPTHS - 1))
    range_ = NEAREST * step**depth
    focal = 0.5 * PIXELS[1] / math.tan(mount.fov / 2)
    bearing_of = lambda c: mount.yaw - math.atan(((c + 0.5) * PIXELS[1] / COLUMNS - 0.5 * PIXELS[1]) / focal)  # noqa: E731
    painted = np.flatnonzero(got)
    assert painted.size
    for k in painted:
        x, y = places()[k]
        distance, bearing = math.hypot(x - mount.x, y - mount.y), math.atan2(y - mount.y, x - mount.x)
        assert range_ / step < distance < range_ * step
        if rig is LEVEL:  # on a column that leans, the bearing depends on the distance
            assert bearing_of(column + 1) < bearing < bearing_of(column - 1)
    if rig is LEVEL:  # nothing that lies there is left out
        inside = [
            k for k, (x, y) in enumerate(places())
            if abs(math.log(math.hypot(x - mount.x, y - mount.y) / range_)) < 0.9 * math.log(step)
            and bearing_of(column + 0.9) < math.atan2(y - mount.y, x - mount.x) < bearing_of(column - 0.9)
        ]  # fmt: skip
        assert inside and set(inside) <= set(painted)


@RIGS
def test_rows_come_to_slopes_as_in_a_loop(rig):
    rows, columns, slopes = 10, 12, 8
    got = np.asarray(row_weights(arrays(rig), PIXELS, (rows, columns), slopes))[0]
    step = 2.0 / slopes
    for n, mount in enumerate(rig.mounts):
        rotation, focal = np.asarray(rig_of(rig).rotation[n], np.float64), 0.5 * PIXELS[1] / math.tan(mount.fov / 2)
        for j in range(columns):
            want = np.zeros((slopes, rows))
            for r in range(rows):
                across = ((j + 0.5) * PIXELS[1] / columns - 0.5 * PIXELS[1]) / focal
                down = ((r + 0.5) * PIXELS[0] / rows - 0.5 * PIXELS[0]) / focal
                x, y, z = rotation @ [across, down, 1.0]
                slope = z / math.hypot(x, y)
                for e in range(slopes):
                    want[e, r] = max(0.0, 1 - abs(slope - (1.0 - (e + 0.5) * step)) / step)
            want /= want.sum(axis=1, keepdims=True) + 0.1
            np.testing.assert_allclose(got[n, j], want, atol=1e-4)  # slopes in float32, divided by a step of 1/4


def test_a_level_stripe_stays_level_though_the_camera_is_tilted():
    """Features that stand for a slope arrive at that slope, in every column, whatever the mount."""
    for rig in (LEVEL, TILTED):
        rows, columns = 60, 12
        weights = np.asarray(row_weights(arrays(rig), PIXELS, (rows, columns)), np.float64)[0]
        for n, mount in enumerate(rig.mounts):
            rotation, focal = np.asarray(rig_of(rig).rotation[n], np.float64), 0.5 * PIXELS[1] / math.tan(mount.fov / 2)
            for j in range(columns):
                across = ((j + 0.5) * PIXELS[1] / columns - 0.5 * PIXELS[1]) / focal
                down = ((np.arange(rows) + 0.5) * PIXELS[0] / rows - 0.5 * PIXELS[0]) / focal
                ray = rotation @ np.stack([np.full(rows, across), down, np.ones(rows)])
                slope = ray[2] / np.hypot(ray[0], ray[1])
                found, weight = weights[n, j] @ slope, weights[n, j].sum(axis=1)
                wanted = 1.0 - (np.arange(lift.SLOPES) + 0.5) * 2 / lift.SLOPES
                well = (weight > 0.9) & (wanted < slope.max() - 0.13) & (wanted > slope.min() + 0.13)
                assert well.sum() >= 4
                np.testing.assert_allclose(found[well] / weight[well], wanted[well], atol=0.03)  # a quarter of a bin


@pytest.mark.relaxed  # flax
def test_the_module_is_eq_1_to_3():
    rng = np.random.default_rng(3)
    rows, channels, features = 10, 4, 3
    maps = rng.normal(size=(1, 3, rows, COLUMNS, channels)).astype(np.float32)
    camera = rng.normal(size=(1, 3, 5)).astype(np.float32)
    net, there = Lift(BEV, 2, DEPTHS, 6, features), usable(True, False, True)
    args = (maps, camera, arrays(TILTED), there)
    params = filled(jax.eval_shape(lambda *a: net.init(jax.random.key(0), *a, PIXELS), *args)["params"])
    got = jax.jit(lambda p, *a: net.apply({"params": p}, *a, PIXELS))(params, *args)
    assert got.shape == (1, 12, 16, features + 1)
    weights = np.asarray(row_weights(arrays(TILTED), PIXELS, (rows, COLUMNS)), np.float64)[0]
    table = np.zeros((3, COLUMNS, DEPTHS, features))
    p = jax.tree.map(np.float64, params)
    for n in range(3):
        for j in range(COLUMNS):
            level = (weights[n, j] @ maps[0, n, :, j]).reshape(-1)
            inner = level @ p["column"]["kernel"] + p["column"]["bias"] + camera[0, n] @ p["camera"]["kernel"]
            spread = np.maximum(inner, 0) @ p["depths"]["kernel"] + p["depths"]["bias"]
            table[n, j] = spread.reshape(DEPTHS, features)
    want, seen, close = expected(table, TILTED, (True, False, True))
    assert not close
    flat = np.asarray(got).reshape(-1, features + 1)
    np.testing.assert_array_equal(flat[:, -1], seen)
    np.testing.assert_allclose(flat[:, :-1], want, atol=1e-2 * np.abs(table).max())  # as above, on larger numbers
    assert not flat[~seen].any()


def test_one_column_and_many():
    """Images so small that a feature map has a single column: everything reads that one."""
    one = taps(BEV, 2, arrays(LEVEL), usable(True, True, True), PIXELS[1], 1, DEPTHS)
    table = jnp.broadcast_to(jnp.asarray([1.0, 2.0, 3.0], jnp.float32)[None, :, None, None], (1, 3, DEPTHS, 1))
    got = np.asarray(read(table.reshape(1, -1, 1), one))[0, :, 0]
    seen = np.asarray(one.seen)[0]
    assert set(np.round(got[seen], 5)) == {1.0, 2.0, 3.0} and not got[~seen].any()
