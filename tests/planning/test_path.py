"""Paths: even points, the part ahead, and what happens at the ends."""

import jax.numpy as jnp
import numpy as np
import pytest

from drnav_jax.planning import path as paths

ROUNDING = 1e-5


def f32(values):
    return jnp.asarray(values, jnp.float32)


def points(path):
    return np.stack([path.x, path.y], axis=1)[: int(path.count)].astype(float)


@pytest.mark.parametrize("goal", [(1.0, 2.0), (0.3, -0.2), (0.32, -0.2), (9.0, 9.0)])
def test_a_straight_line_is_even_and_ends_at_the_goal(goal):
    start = np.array([0.3, -0.2])
    path = paths.straight(f32(start), f32(goal), spacing=0.05, num_points=64)
    got = points(path)
    length = np.hypot(*(np.array(goal) - start))
    np.testing.assert_allclose(got[0], start, atol=ROUNDING)
    if length < 63 * 0.05:
        np.testing.assert_allclose(got[-1], goal, atol=ROUNDING)
        assert len(got) == int(np.ceil(length / 0.05 - 1e-3)) + 1
    else:
        assert len(got) == 64
    gaps = np.hypot(*np.diff(got, axis=0).T)
    np.testing.assert_allclose(gaps[:-1], 0.05, atol=ROUNDING)
    assert (gaps[-1:] <= 0.05 + ROUNDING).all()
    np.testing.assert_array_equal(path.x[len(got) :], np.float32(got[-1, 0]))
    np.testing.assert_allclose(paths.end(path), got[-1], atol=ROUNDING)


def walk(corners, s):
    """The point at arc length s of a polyline, by walking."""
    for a, b in zip(corners[:-1], corners[1:], strict=True):
        gap = np.hypot(*(b - a))
        if s <= gap:
            return a + (b - a) * s / gap
        s -= gap
    return corners[-1]


def test_resampling_walks_along_the_polyline():
    rng = np.random.default_rng(0)
    corners = np.cumsum(rng.normal(0, 0.3, (12, 2)), axis=0)
    padded = np.concatenate([corners, np.full((5, 2), 77.0)])
    path = paths.resample(f32(padded), jnp.arange(17) < 12, spacing=0.1, num_points=80)
    total = np.hypot(*np.diff(corners, axis=0).T).sum()
    want = [walk(corners, s) for s in np.arange(int(path.count)) * 0.1]
    want[-1] = corners[-1]
    np.testing.assert_allclose(points(path), want, atol=1e-4)
    assert int(path.count) == int(np.ceil(total / 0.1)) + 1
    short = paths.resample(f32(padded), jnp.arange(17) < 12, spacing=0.1, num_points=10)
    np.testing.assert_allclose(points(short), want[:10], atol=1e-4)
    alone = paths.resample(f32(padded), jnp.arange(17) < 1, spacing=0.1, num_points=10)
    np.testing.assert_allclose(points(alone), corners[:1], atol=ROUNDING)


def test_smoothing_takes_means_and_keeps_the_ends():
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    rough = points(paths.resample(f32(corners), jnp.ones(3, bool), spacing=0.1, num_points=32))
    smooth = points(paths.resample(f32(corners), jnp.ones(3, bool), spacing=0.1, num_points=32, smoothing=3))
    for k in range(len(rough)):
        n = min(k, len(rough) - 1 - k, 3)
        np.testing.assert_allclose(smooth[k], rough[k - n : k + n + 1].mean(axis=0), atol=ROUNDING)
    np.testing.assert_allclose(smooth[[0, -1]], rough[[0, -1]], atol=ROUNDING)


def test_what_lies_ahead_begins_at_the_nearest_point():
    path = paths.straight(f32([0, 0]), f32([3, 0]), spacing=0.05, num_points=64)
    got = points(paths.ahead(path, f32([1.01, 0.4]), 0.5, num_points=32))
    np.testing.assert_allclose(got[:, 0], np.arange(1.0, 1.5001, 0.05), atol=1e-4)
    cut = paths.ahead(path, f32([1.01, 0.4]), 5.0, num_points=8)
    assert int(cut.count) == 8 and float(cut.x[-1]) == pytest.approx(1.35, abs=1e-4)
    last = paths.ahead(path, f32([9.0, 0.0]), 0.5, num_points=8)
    assert int(last.count) == 1 and float(paths.lengths(last)[-1]) == 0.0
    whole = paths.lengths(path)
    assert float(whole[-1]) == pytest.approx(3.0, abs=1e-4) and float(whole[20]) == pytest.approx(1.0, abs=1e-4)
