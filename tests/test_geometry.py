"""Frames and cells: round trips, interpolation against SciPy, the rolling window."""

import math

import chex
import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from scipy import ndimage

from drnav_jax import geometry
from drnav_jax.types import GridMap, GridSpec
from reference import wrap

SHAPE = (5, 9)
RESOLUTION = 0.25
ORIGIN = np.array([-1.5, -0.75], np.float32)
METRES = 1e-4  # [m] float32 over tens of metres
ROUNDING = 1e-5  # float32, values of order 1

coordinates = st.floats(-40, 40, width=32)
angles = st.floats(-10, 10, width=32)
poses = st.tuples(coordinates, coordinates, angles)


def f32(values):
    return jnp.asarray(values, jnp.float32)


def grid(values, origin=ORIGIN, resolution=RESOLUTION):
    return GridMap(f32(values), f32(origin), resolution)


@given(angles)
def test_wrapping_leaves_the_direction(angle):
    wrapped = float(geometry.wrap_angle(f32(angle)))
    assert -math.pi - ROUNDING <= wrapped <= math.pi + ROUNDING
    assert abs(wrap(wrapped - angle)) < ROUNDING
    if abs(wrap(angle)) < 3:
        assert wrapped == pytest.approx(wrap(angle), abs=ROUNDING)


@given(poses, poses)
def test_poses_compose_like_matrices(a, b):
    def matrix(p):
        c, s = math.cos(p[2]), math.sin(p[2])
        return np.array([[c, -s, p[0]], [s, c, p[1]], [0, 0, 1]])

    got = np.asarray(geometry.compose(f32(a), f32(b)), np.float64)
    np.testing.assert_allclose(matrix(got), matrix(a) @ matrix(b), atol=METRES)
    back = np.asarray(geometry.inverse(f32(a)), np.float64)
    np.testing.assert_allclose(matrix(back), np.linalg.inv(matrix(a)), atol=METRES)


@given(poses, hnp.arrays(np.float32, (4, 2), elements=coordinates))
def test_there_and_back_again(pose, points):
    away = geometry.transform(f32(pose), f32(points))
    np.testing.assert_allclose(geometry.transform(geometry.inverse(f32(pose)), away), points, atol=METRES)
    apart = np.linalg.norm(points[1:] - points[:-1], axis=-1)  # a rigid motion keeps distances
    moved = np.asarray(away)
    np.testing.assert_allclose(np.linalg.norm(moved[1:] - moved[:-1], axis=-1), apart, atol=METRES)


def test_left_is_left():
    ahead = geometry.transform(f32([1, 2, math.pi / 2]), f32([[1, 0], [0, 1]]))
    np.testing.assert_allclose(ahead, [[1, 3], [0, 2]], atol=ROUNDING)


@given(st.integers(-300, 300), st.integers(-300, 300), st.floats(-0.49, 0.49), st.floats(-0.49, 0.49))
def test_cells_round_trip_also_at_negative_coordinates(row, col, across, along):
    cell = jnp.asarray([row, col], jnp.int32)
    centre = geometry.centre_of(cell, f32(ORIGIN), RESOLUTION)
    np.testing.assert_allclose(centre, ORIGIN + (np.array([col, row]) + 0.5) * RESOLUTION, atol=METRES)
    within = centre + f32([along, across]) * RESOLUTION
    chex.assert_trees_all_equal(geometry.cell_of(within, f32(ORIGIN), RESOLUTION), cell)


def test_the_window_ends_where_its_last_cell_ends():
    h, w = SHAPE
    last = ORIGIN + np.array([w, h], np.float32) * RESOLUTION
    points = f32([ORIGIN, ORIGIN - 1e-3, last - 1e-3, last])
    cells = geometry.cell_of(points, f32(ORIGIN), RESOLUTION)
    np.testing.assert_array_equal(cells, [[0, 0], [-1, -1], [h - 1, w - 1], [h, w]])
    np.testing.assert_array_equal(geometry.inside(cells, SHAPE), [True, False, True, False])
    values = grid(np.arange(h * w).reshape(SHAPE))
    for sample in (geometry.sample_nearest, geometry.sample_bilinear):
        np.testing.assert_array_equal(sample(values, points), [0, 0, h * w - 1, h * w - 1])
        np.testing.assert_array_equal(sample(values, points, fill=-7.0), [0, -7, h * w - 1, -7])


def test_centres_are_the_centres_of_cells():
    x, y = geometry.cell_centres(SHAPE, f32(ORIGIN), RESOLUTION)
    assert x.shape == (1, SHAPE[1]) and y.shape == (SHAPE[0], 1)
    for i, j in np.ndindex(SHAPE):
        one = geometry.centre_of(jnp.asarray([i, j], jnp.int32), f32(ORIGIN), RESOLUTION)
        np.testing.assert_allclose([x[0, j], y[i, 0]], one, atol=1e-6)


def test_bilinear_equals_scipy():
    rng = np.random.default_rng(0)
    values = rng.normal(size=SHAPE).astype(np.float32)
    xy = rng.uniform((-1.9, -1.1), (1.2, 0.9), (400, 2)).astype(np.float32)  # also beyond the edge
    cells = (xy[:, ::-1] - ORIGIN[::-1]) / RESOLUTION - 0.5
    want = ndimage.map_coordinates(values.astype(np.float64), cells.T, order=1, mode="nearest")
    got = geometry.sample_bilinear(grid(values), f32(xy))
    np.testing.assert_allclose(got, want, atol=5e-5)  # coordinates in float32, slopes up to 4 per cell
    outside = ((cells < -0.5) | (cells > np.array(SHAPE) - 0.5)).any(axis=1)
    assert 0.2 < outside.mean() < 0.8
    got = geometry.sample_bilinear(grid(values), f32(xy), fill=9.0)
    np.testing.assert_allclose(got, np.where(outside, 9.0, want), atol=5e-5)
    square = geometry.sample_bilinear(grid(values), f32(xy).reshape(20, 20, 2), 9.0)
    chex.assert_trees_all_equal(got.reshape(20, 20), square)


def test_nearest_equals_a_loop():
    rng = np.random.default_rng(1)
    values = rng.integers(0, 99, SHAPE).astype(np.int32)
    xy = rng.uniform((-1.9, -1.1), (1.2, 0.9), (300, 2)).astype(np.float32)
    got = geometry.sample_nearest(GridMap(jnp.asarray(values), f32(ORIGIN), RESOLUTION), f32(xy), fill=-1)
    assert got.dtype == jnp.int32
    for (x, y), value in zip(xy, np.asarray(got), strict=True):
        i, j = math.floor((y - ORIGIN[1]) / RESOLUTION), math.floor((x - ORIGIN[0]) / RESOLUTION)
        assert value == (values[i, j] if 0 <= i < SHAPE[0] and 0 <= j < SHAPE[1] else -1)


@given(*[st.floats(-2, 2, width=32)] * 3, st.floats(0, 1), st.floats(0, 1))
def test_bilinear_reproduces_linear_functions(a, b, c, right, up):
    x, y = geometry.cell_centres(SHAPE, f32(ORIGIN), RESOLUTION)
    span = (np.array(SHAPE[::-1]) - 1) * RESOLUTION
    at = ORIGIN + 0.5 * RESOLUTION + np.array([right, up]) * span
    got = geometry.sample_bilinear(grid(a + b * x + c * y), f32(at))
    assert float(got) == pytest.approx(a + b * at[0] + c * at[1], abs=ROUNDING)


def test_bilinear_slopes_are_the_fields():
    x, y = geometry.cell_centres(SHAPE, f32(ORIGIN), RESOLUTION)
    slope = jax.grad(lambda xy: geometry.sample_bilinear(grid(2 * x - 3 * y), xy))(f32([-0.3, -0.1]))
    np.testing.assert_allclose(slope, [2, -3], atol=1e-4)  # differences of float32 values over 0.25 m
    weights = jax.grad(lambda v: geometry.sample_bilinear(grid(v), f32([-0.3, -0.1])))(jnp.zeros(SHAPE))
    assert float(weights.sum()) == pytest.approx(1.0, abs=ROUNDING) and int((weights != 0).sum()) == 4


@settings(max_examples=60)
@given(st.integers(-12, 12), st.integers(-12, 12))
def test_shift_is_a_roll_that_forgets(down, right):
    values = np.arange(1, 46, dtype=np.float32).reshape(SHAPE)
    got = np.asarray(geometry.shift(f32(values), jnp.asarray([down, right], jnp.int32), -1.0))
    rows, cols = np.indices(SHAPE)
    rolled_in = ~((0 <= rows + down) & (rows + down < SHAPE[0]) & (0 <= cols + right) & (cols + right < SHAPE[1]))
    want = np.where(rolled_in, -1.0, np.roll(values, (-down, -right), (0, 1)))
    np.testing.assert_array_equal(got, want)


def test_shift_keeps_the_type_and_survives_a_leap():
    for values, fill in ((jnp.ones(SHAPE, bool), 0.0), (jnp.ones(SHAPE, jnp.int32), -3)):
        out = geometry.shift(values, jnp.asarray([1, 0], jnp.int32), fill)
        assert out.dtype == values.dtype and int(out[-1, 0]) == fill and int(out[0, 0]) == 1
        far = geometry.shift(values, jnp.asarray([2**30, -(2**30)], jnp.int32), fill)
        assert bool(jnp.all(far == jnp.asarray(fill, values.dtype)))


@given(coordinates, coordinates, coordinates, coordinates)
def test_the_window_keeps_the_robot_in_its_middle(x, y, x2, y2):
    spec = GridSpec(shape=(16, 40), resolution=0.1, stride=8)
    corner = geometry.window_corner(f32([x, y]), spec)
    origin = np.asarray(geometry.window_origin(corner, spec))
    middle = origin + np.array([20, 8]) * 0.1
    assert np.abs(middle - [x, y]).max() <= 0.5 * 8 * 0.1 + METRES
    moved = np.asarray(geometry.window_corner(f32([x2, y2]), spec) - corner)
    assert (moved % 8 == 0).all()
    # A place keeps its cell of the lattice, so what the window remembers there stays there.
    at = np.array([x, y], np.float32)
    first = np.asarray(geometry.cell_of(f32(at), f32(origin), 0.1)) + np.asarray(corner)
    on_border = np.abs(at / 0.1 - np.round(at / 0.1)).min() < 1e-2
    if not on_border:
        np.testing.assert_array_equal(first, np.floor(at[::-1].astype(np.float64) / 0.1))


def test_shift_and_window_agree():
    """What was believed of a place is found at the same place after the window has moved."""
    spec = GridSpec(shape=(16, 24), resolution=0.1, stride=4)
    before, after = (geometry.window_corner(f32(xy), spec) for xy in ([0.1, -0.1], [0.9, -0.55]))
    values = f32(np.arange(16 * 24).reshape(16, 24))
    moved = geometry.shift(values, after - before, -1.0)
    at = f32([0.73, -0.31])
    old = geometry.sample_nearest(GridMap(values, geometry.window_origin(before, spec), 0.1), at)
    new = geometry.sample_nearest(GridMap(moved, geometry.window_origin(after, spec), 0.1), at)
    assert not bool(jnp.all(before == after))
    assert float(old) == float(new) >= 0
