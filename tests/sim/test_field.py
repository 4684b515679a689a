"""Rays over a distance field against brute-force marching."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from drnav_jax.sim.field import SLACK, wall_distance
from drnav_jax.worlds.world import distance_field, from_grid

STEP = 1e-3  # [m] of the oracle; it interpolates the crossing, so its error is far below
TOLERANCE = 1e-3  # [m]
GRAZE = 3e-5  # [m] of the field just before a hit that the oracle stepped over
RAYS = 48


def value_at(values, origin, resolution, points):
    """Bilinear interpolation between cell centres `[...]`, NaN outside the grid; float64 NumPy."""
    h, w = values.shape
    f = (points - origin) / resolution - 0.5
    x, y = np.clip(f[..., 0], 0, w - 1), np.clip(f[..., 1], 0, h - 1)
    c, r = np.minimum(x.astype(int), w - 2), np.minimum(y.astype(int), h - 2)
    ax, ay = x - c, y - r
    low = values[r, c] * (1 - ax) + values[r, c + 1] * ax
    high = values[r + 1, c] * (1 - ax) + values[r + 1, c + 1] * ax
    out = (f[..., 0] < -0.5) | (f[..., 0] > w - 0.5) | (f[..., 1] < -0.5) | (f[..., 1] > h - 0.5)
    return np.where(out, np.nan, low * (1 - ay) + high * ay)


def march(values, origin, resolution, start, directions, reach):
    """First crossing along each ray by small steps; from within a wall, the way out."""
    s = np.arange(0, reach, STEP)
    found = np.full(len(directions), np.inf)
    for k, d in enumerate(directions):
        q = value_at(values, origin, resolution, start + s[:, None] * d)
        q = -q if q[0] < 0 else q
        hit = q <= 0
        if hit.any():
            i = int(hit.argmax())
            first = i == 0 or np.isnan(q[i - 1])
            found[k] = s[i] if first else s[i - 1] + STEP * q[i - 1] / (q[i - 1] - q[i])
    return found


def compare(occupied, resolution, starts, yaws, reach=12.0, origin=(1.5, -3.0)):
    """All rays from all starts; a ray may only be shorter than the oracle's where it grazes."""
    field = jax.tree.map(jnp.asarray, from_grid(occupied, origin, resolution).field)
    values = np.asarray(field.values, float)
    cast = jax.jit(wall_distance)
    for start, yaw in zip(np.asarray(starts, np.float32), yaws, strict=True):
        a = yaw + np.arange(RAYS) * 2 * np.pi / RAYS
        d = np.stack([np.cos(a), np.sin(a)], axis=1).astype(np.float32)
        ours = cast(field, jnp.asarray(start), jnp.asarray(d[:, 0]), jnp.asarray(d[:, 1]), reach)
        ours = np.asarray(ours, float)
        start, d = start.astype(float), d.astype(float)
        oracle = march(values, np.asarray(origin), resolution, start, d, reach)
        within = value_at(values, np.asarray(origin), resolution, start) < 0
        for t, expected, ray in zip(ours, oracle, d, strict=True):
            if t == expected or abs(t - expected) < TOLERANCE:
                continue
            assert t < expected, (start, ray, t, expected)
            there = value_at(values, np.asarray(origin), resolution, start + (t - 1e-5) * ray)
            assert (-there if within else there) < GRAZE, (start, ray, t, expected)


@pytest.mark.parametrize("density", [0.002, 0.03, 0.3, 0.6])
def test_random_grids(density):
    rng = np.random.default_rng(int(1000 * density))
    occupied = rng.random((90, 130)) < density
    starts = rng.uniform((0.5, -4.0), (15.5, 7.0), (10, 2))  # in walls and beyond the edge too
    compare(occupied, 0.1, starts, rng.uniform(-np.pi, np.pi, 10))


def test_rays_along_the_lattice():
    # From centres, corners and edges of cells, exactly along rows and columns.
    rng = np.random.default_rng(1)
    occupied = rng.random((40, 60)) < 0.1
    starts = np.asarray([1.5, -3.0]) + rng.integers(4, 76, (24, 2)) * 0.05
    compare(occupied, 0.1, starts, np.zeros(24), origin=(1.5, -3.0))


def test_grazing_rays_in_a_long_corridor():
    occupied = np.ones((20, 400), bool)
    occupied[8:12] = False
    starts = np.asarray([[1.6, -2.5], [5.0, -2.45], [20.0, -2.589]])
    compare(occupied, 0.05, starts, [0.0, 1e-3, -2e-4], reach=30.0)


def test_free_grids_and_full_ones():
    for occupied in (np.zeros((5, 9), bool), np.ones((5, 9), bool)):
        field = jax.tree.map(jnp.asarray, from_grid(occupied, (0.0, 0.0), 0.1).field)
        ahead = jnp.asarray([1.0, -1.0]), jnp.zeros(2)
        for x, expected in ((0.42, np.inf), (-1.0, 1.0 if occupied.all() else np.inf)):
            found = wall_distance(field, jnp.asarray([x, 0.2]), *ahead, 12.0)
            np.testing.assert_allclose(found, [expected, np.inf], atol=TOLERANCE)


def test_the_skip_is_safe():
    """The proof in the module: no zero of the field within `value - SLACK` cells of any point."""
    rng = np.random.default_rng(2)
    for density in (0.02, 0.1, 0.4):
        values = distance_field(rng.random((30, 30)) < density, 1.0).astype(float)
        points = rng.uniform(0, 30, (300, 2))
        q = np.abs(value_at(values, np.zeros(2), 1.0, points))
        a = rng.uniform(-np.pi, np.pi, (300, 200))
        away = np.maximum(q - SLACK, 0)[:, None] * np.sqrt(rng.uniform(0, 1, a.shape))
        around = points[:, None] + away[..., None] * np.stack([np.cos(a), np.sin(a)], axis=-1)
        sign = np.sign(value_at(values, np.zeros(2), 1.0, points))
        there = value_at(values, np.zeros(2), 1.0, around)
        assert not (there * sign[:, None] < 0).any()


@pytest.mark.parametrize(
    ("name", "resolution"),
    [
        ("nav2/depot.pgm", 0.05),
        ("aws_warehouse/map.pgm", 0.05),
        ("willow/willow-2010-02-18-0.10.pgm", 0.1),
    ],
)
def test_real_maps(shared_data, name, resolution):
    occupied = np.flipud(np.asarray(Image.open(shared_data / "maps" / name).convert("L")) < 90)
    rng = np.random.default_rng(0)
    free = np.argwhere(distance_field(occupied, resolution) > 0.25)[:, ::-1]
    cells = free[rng.integers(len(free), size=12)] + rng.random((12, 2))
    starts = np.asarray([1.5, -3.0]) + cells * resolution
    compare(occupied, resolution, starts, rng.uniform(-np.pi, np.pi, 12))
