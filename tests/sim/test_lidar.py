"""The LiDAR against native MuJoCo, and what it reports of what it measures."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_rays import MARCH, trace
from scipy import stats

from drnav_jax import sim
from drnav_jax.bench.lidar import lidar_against_mujoco, native_lidar
from drnav_jax.bench.obstacles import random_obstacles
from drnav_jax.sim.lidar import HIT_MARGIN
from drnav_jax.worlds.materials import EXTINCTION, Material
from drnav_jax.worlds.world import Scenery, World, from_grid, make_world, stack_worlds, surfaces

# float32 distances over 30 m, where a ray touches a curved side: measured 2.4e-4 m over 100 worlds.
MAX_ERROR = 1e-3
ROUNDING = 1e-5  # [m] of ranges up to 12 m in float32, reassociated
TINY = sim.LidarSpec(rings=3, azimuths=5)
ORIGIN = np.zeros(3, np.float32)


def world_of(boxes=(), cylinders=(), field=None) -> World:
    return make_world(np.asarray(boxes).reshape(-1, 7), np.asarray(cylinders).reshape(-1, 5), field)


def cast(spec, world, pose=ORIGIN, **params) -> np.ndarray:
    world, pose = jax.tree.map(jnp.asarray, (world, pose))
    return np.asarray(sim.cast(spec, sim.LidarParams(**params), world, pose))


def scan(spec, world, pose=ORIGIN, seed=0, **params) -> tuple[np.ndarray, np.ndarray]:
    world, pose = jax.tree.map(jnp.asarray, (world, pose))
    points, valid = sim.scan(spec, sim.LidarParams(**params), world, pose, jax.random.key(seed))
    return np.asarray(points), np.asarray(valid)


def same(a: np.ndarray, b: np.ndarray, tolerance: float) -> bool:
    """Whether two arrays of ranges agree, hit for hit."""
    hit = np.isfinite(a)
    return bool((hit == np.isfinite(b)).all() and np.allclose(a[hit], b[hit], rtol=0, atol=tolerance))


@pytest.mark.parametrize("seed", range(3))
def test_ranges_are_those_of_native_mujoco(seed):
    result = lidar_against_mujoco(seed, repeats=1)
    assert result["mismatches"] == 0
    assert result["max_error_m"] < MAX_ERROR


def test_ranges_are_those_of_native_mujoco_in_many_worlds():
    results = [lidar_against_mujoco(seed, repeats=1) for seed in range(100, 150)]
    assert sum(r["mismatches"] for r in results) == 0
    assert max(r["max_error_m"] for r in results) < MAX_ERROR


@pytest.mark.parametrize(
    ("boxes", "cylinders"),
    [
        ([[0.3, 0.1, 0.4, 2.0, 1.0, 0.0, 0.9]], []),  # leaves through sides and top
        ([], [[0.2, -0.1, 1.5, 0.0, 0.8]]),
        # In two at once, with something behind the walls and something within them.
        (
            [[0.0, 0.0, 0.1, 3.0, 2.0, -0.2, 2.0], [1.0, 0.5, 0.7, 0.1, 0.1, 0.0, 1.0]],
            [[0.5, 0.0, 1.0, 0.1, 0.7], [6.0, 0.0, 0.5, 0.0, 3.0]],
        ),
        ([[0.0, 0.0, 0.1, 1.0, 2.0, 0.7, 2.0]], [[0.3, 0.0, 1.0, 0.0, 0.3]]),  # below and above it
    ],
)
def test_a_sensor_in_or_over_an_obstacle_sees_what_mujoco_sees(boxes, cylinders):
    spec = sim.LidarSpec(rings=24, azimuths=90, elevation_min=-1.2, elevation_max=1.2)
    pose, world = np.asarray([0.1, 0.05, 0.6], np.float32), world_of(boxes, cylinders)
    native = native_lidar(spec, sim.LidarParams(max_range=100.0), world, pose)()
    assert same(cast(spec, world, pose, max_range=100.0), native, MAX_ERROR)


def test_level_rays_and_rays_along_a_box():
    # Ring 1 is level, beam 2 points straight ahead, parallel to the long sides of the boxes.
    ahead = [5.0, 0.0, 0.0, 1.0, 0.5, 0.0, 1.0]
    beside = [5.0, 3.0, 0.0, 1.0, 0.5, 0.0, 1.0]
    ranges = cast(TINY, world_of([ahead, beside]))
    np.testing.assert_allclose(ranges[1, 2], 4.0, atol=ROUNDING)
    assert np.isinf(ranges[1, [0, 1, 3, 4]]).all()


def test_the_ground_is_met_and_nothing_beyond_the_maximum_range():
    e = TINY.elevations
    ranges = cast(TINY, world_of())
    np.testing.assert_allclose(ranges[0], 0.5 / -np.sin(e[0]), atol=ROUNDING)
    assert np.isinf(ranges[1:]).all()
    assert np.isinf(cast(TINY, world_of(), max_range=1.9)).all()
    wall = world_of([[10.0, 0.0, 0.0, 1.0, 9.0, 0.0, 5.0]])
    assert np.isfinite(cast(TINY, wall, max_range=9.1)[1, 2])
    assert np.isinf(cast(TINY, wall, max_range=8.9)[1, 2])


def test_a_wall_of_a_grid_map_is_met_below_its_height_and_passed_over_above():
    occupied = np.zeros((100, 240), bool)
    occupied[:, 220:222] = True  # at x = 11 m
    spec = sim.LidarSpec(rings=31, azimuths=1)  # one azimuth: straight ahead
    world, pose = from_grid(occupied, (0.0, -2.5), 0.05), np.asarray([1.0, 0.0, 0.0], np.float32)
    ranges = cast(spec, world, pose)[:, 0]
    e = spec.elevations
    z = 0.5 + 10.0 * np.tan(e)
    expected = np.where(z > 2.5, np.inf, np.where(z < 0, 0.5 / np.sin(-e - 1e-12), 10 / np.cos(e)))
    assert (z > 2.5).sum() > 3 and (z < 0).sum() > 3
    assert same(ranges, expected, 2e-5)


def test_padding_is_never_met():
    worlds = [random_obstacles(seed, n) for seed, n in ((0, 3), (1, 12))]
    batch = jax.tree.map(jnp.asarray, stack_worlds(worlds))
    pose = jnp.asarray(ORIGIN)
    params = sim.LidarParams(max_range=1e7)  # would reach the padding
    ranges = jax.vmap(lambda world: sim.cast(TINY, params, world, pose))(batch)
    for k, world in enumerate(worlds):
        assert same(np.asarray(ranges[k]), cast(TINY, world, max_range=1e7), ROUNDING)


def test_points_lie_where_the_rays_meet_ring_by_ring():
    spec = sim.LidarSpec(rings=4, azimuths=7, elevation_min=-0.3, elevation_max=0.2)
    world, pose = random_obstacles(3, 40), np.asarray([0.3, 0.1, 2.0], np.float32)
    points, valid = scan(spec, world, pose, noise_std=0.0, dropout=0.0)
    ranges = cast(spec, world, pose)
    assert points.shape == (28, 3) and valid.shape == (28,) and valid.all()
    assert np.isfinite(ranges).any() and np.isinf(ranges).any()
    for i in range(4):
        for j in range(7):
            e, a = -0.3 + i * 0.5 / 3, -np.pi + (j + 0.5) * 2 * np.pi / 7
            r = min(ranges[i, j], 12.0)
            expected = [r * np.cos(e) * np.cos(a), r * np.cos(e) * np.sin(a), 0.5 + r * np.sin(e)]
            np.testing.assert_allclose(points[i * 7 + j], expected, atol=ROUNDING)


def test_the_world_is_seen_from_the_pose():
    # A post 3 m north of the robot, which looks north: straight ahead in base_link.
    pose = np.asarray([1.0, 2.0, np.pi / 2], np.float32)
    points, _ = scan(TINY, world_of(cylinders=[[1.0, 5.5, 0.5, 0.0, 2.0]]), pose, noise_std=0.0)
    np.testing.assert_allclose(points[1 * 5 + 2], [3.0, 0.0, 0.5], atol=ROUNDING)


def test_noise_has_the_stated_spread_and_dropouts_the_stated_rate():
    spec = sim.LidarSpec(rings=40, azimuths=1000, elevation_min=0.0, elevation_max=0.1)
    around = world_of(cylinders=[[0.0, 0.0, 5.0, 0.0, 9.0]])  # seen from within
    points, valid = scan(spec, around, dropout=0.1)
    exact = cast(spec, around).reshape(-1)
    error = np.linalg.norm(points - [0, 0, 0.5], axis=1)[valid] - exact[valid]
    # 36,000 samples: the standard error is 1e-4 m of the mean, 0.4 % of the spread.
    assert abs(error.mean()) < 4e-4
    assert abs(error.std() / 0.02 - 1) < 0.02
    assert abs(np.mean(np.abs(error) < 0.02) - 0.6827) < 0.01  # a normal, not only its spread
    assert abs(np.mean(~valid) - 0.1) < 0.006
    assert abs(np.corrcoef(error[:-1], error[1:])[0, 1]) < 0.02
    np.testing.assert_allclose(points[~valid], [[0, 0, 0.5]] * np.sum(~valid))


def test_noise_and_dropout_are_apart_and_follow_the_key():
    world = world_of(cylinders=[[0.0, 0.0, 5.0, 0.0, 9.0]])
    spec = sim.LidarSpec(rings=3, azimuths=50, elevation_min=0.0)
    few, valid_few = scan(spec, world, dropout=0.0)
    many, valid_many = scan(spec, world, dropout=0.5)
    assert valid_few.all() and 0 < valid_many.sum() < valid_many.size
    np.testing.assert_array_equal(few[valid_many], many[valid_many])
    np.testing.assert_array_equal(few, scan(spec, world, dropout=0.0)[0])
    assert not np.allclose(few, scan(spec, world, seed=1, dropout=0.0)[0])
    assert not scan(spec, world, dropout=1.0)[1].any()


def test_a_beam_that_meets_nothing_is_told_from_a_far_return():
    spec = sim.LidarSpec(rings=20, azimuths=200, elevation_min=0.01, elevation_max=0.02)
    points, valid = scan(spec, world_of(), dropout=0.0)
    ranges = np.linalg.norm(points - [0, 0, 0.5], axis=1)
    assert valid.all()
    np.testing.assert_allclose(ranges, 12.0, atol=ROUNDING)
    # Walls just short of the maximum: noise must not turn a return into free space.
    points, _ = scan(spec, world_of(cylinders=[[0.0, 0.0, 11.99, 0.0, 9.0]]), dropout=0.0)
    ranges = np.linalg.norm(points - [0, 0, 0.5], axis=1)
    assert ranges.max() <= 12.0 - HIT_MARGIN + ROUNDING and ranges.std() > 0


def mixed_world(seed: int, ceiling: float = np.inf) -> World:
    """Boxes and cylinders of all materials around the origin, with drops that touch and plants that overlap."""
    rng = np.random.default_rng(seed)
    plants = [Material.BUSH, Material.GRASS, Material.GRASS, Material.BUSH]
    materials = [*plants, Material.GLASS, Material.BRICK, Material.STRIPE]
    n, angle = len(materials), rng.uniform(-np.pi, np.pi, len(materials))
    xy = rng.uniform(1.5, 6.0, (n, 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    heights = np.stack([np.zeros(n), rng.uniform(0.3, 1.5, n)], axis=1)
    boxes = np.concatenate([xy, rng.uniform(-3, 3, (n, 1)), rng.uniform(0.1, 1.2, (n, 2)), heights], axis=1)
    drops = [[2.0, -0.5, 0.3, 0.6, 0.5, -0.7, 0.0], [2.6, -0.3, 0.3, 0.5, 0.5, -0.4, 0.0], [-2.5, 0, 0, 1, 2, -2.0, 0.0]]
    drops = drops[:: (-1) ** seed]  # rays go from the first into the second, or the other way round
    posts = [[-1.5, -1.5, 0.5, 0.0, 1.2], [1.0, 2.5, 0.4, 0.2, 0.9]]
    return make_world(
        np.concatenate([boxes, drops]), posts, box_surfaces=surfaces(n + 3, [*materials, *[Material.DROP] * 3]),
        cylinder_surfaces=surfaces(2, [Material.BUSH, Material.CONCRETE]), scenery=Scenery(ceiling=ceiling),
    )  # fmt: skip


STEEP = sim.LidarSpec(rings=10, azimuths=61, elevation_min=-0.7, elevation_max=0.5)
SENSOR = np.asarray([0.0, 0.0, 0.5])


def rays_of(spec: sim.LidarSpec) -> np.ndarray:
    e, a = np.meshgrid(spec.elevations, spec.bearings, indexing="ij")
    return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("veils", [False, True])
def test_ranges_among_all_materials_are_those_of_single_rays(seed, veils):
    world, rays = mixed_world(seed, ceiling=1.8), rays_of(STEEP)
    on_device, pose = jax.tree.map(jnp.asarray, (world, ORIGIN))
    ours = np.asarray(sim.cast(STEEP, sim.LidarParams(), on_device, pose, veils=veils))
    wrong, fell = 0, 0
    for index in np.ndindex(*ours.shape):
        expected, _ = trace(world, SENSOR, rays[index], veils)
        expected = expected if expected < 12.0 else np.inf
        fell += 0.5 + expected * rays[index][2] < -0.01
        wrong += not np.isclose(ours[index], expected, rtol=0, atol=MAX_ERROR + MARCH)
    assert fell > 10
    assert wrong <= 1  # a ray along an edge may fall to either side


def test_plants_return_beams_as_often_and_as_deep_as_their_extinction_says():
    """400 scans, ray by ray, against exp(-k l) of a loop over single rays."""
    world, spec, num = mixed_world(1), STEEP, 400
    on_device, pose = jax.tree.map(jnp.asarray, (world, ORIGIN))
    params = sim.LidarParams(noise_std=0.0, dropout=0.0)
    keys = jax.random.split(jax.random.key(0), num)
    points, valid = jax.lax.map(lambda key: sim.scan(spec, params, on_device, pose, key), keys)
    ranges = np.linalg.norm(np.asarray(points) - SENSOR, axis=-1).reshape(num, spec.rings, spec.azimuths)
    exact = np.minimum(np.asarray(sim.cast(spec, params, on_device, pose)), 12.0)
    assert np.asarray(valid).all()
    off, depths = [], []
    for index in np.ndindex(*exact.shape):
        passed = trace(world, SENSOR, rays_of(spec)[index])[1]
        expected = 1 - np.exp(-sum(EXTINCTION[m] * (leave - enter) for m, enter, leave in passed))
        early = ranges[:, *index] < exact[index] - 1e-3
        if expected == 0:
            assert not early.any()  # glass, or nothing on the way
        elif 0.02 < expected < 0.98:
            off.append((early.mean() - expected) / np.sqrt(expected * (1 - expected) / num))
        if [m for m, _, _ in passed] == [Material.GRASS] and passed[0][2] - passed[0][1] > 0.3:
            # How far into the one plant, as the share of all that return: uniform if exponential.
            k, (_, enter, leave) = EXTINCTION[Material.GRASS], passed[0]
            depths.append(np.expm1(-k * (ranges[early, *index] - enter)) / np.expm1(-k * (leave - enter)))
    assert len(off) > 40 and abs(np.mean(off)) < 0.5 and 0.7 < np.std(off) < 1.4 and np.max(np.abs(off)) < 5
    all_depths = np.concatenate(depths)
    assert len(all_depths) > 1000 and stats.kstest(all_depths, "uniform").pvalue > 1e-3
    # Rays next to each other, and scans one after another, are independent.
    met = ranges < exact[None] - 1e-3
    often = (met.mean(axis=0) > 0.2) & (met.mean(axis=0) < 0.8)
    rate = met[:, often] - met[:, often].mean(axis=0)
    assert abs(np.mean(rate[1:] * rate[:-1])) < 0.01 and abs(np.mean(rate[:, 1:] * rate[:, :-1])) < 0.01


def test_plants_in_one_place_take_their_beams_independently():
    row = [3.0, 0.0, 0.0, 0.1, 9.0, 0.0, 4.0]
    world = make_world([row, row], box_surfaces=surfaces(2, Material.GRASS))
    spec = sim.LidarSpec(rings=20, azimuths=2000, elevation_min=0.0, elevation_max=0.1)
    points, _ = scan(spec, world, noise_std=0.0, dropout=0.0)
    ahead = np.abs(np.tile(spec.bearings, spec.rings)) < 0.1  # 0.2 m in each, but for 1 %
    passed = np.linalg.norm(points[ahead] - SENSOR, axis=-1) > 11.9
    # 1,260 rays: the standard error is 0.013.
    assert abs(passed.mean() - np.exp(-2 * 0.2 * EXTINCTION[Material.GRASS])) < 0.04


def test_beams_pass_glass_and_paint_and_fall_into_a_drop():
    def seen(material, low, high):
        world = make_world([[3.0, 0.0, 0.0, 1.0, 9.0, low, high]], box_surfaces=surfaces(1, material))
        return cast(sim.LidarSpec(rings=2, azimuths=1, elevation_min=-0.2, elevation_max=0.1), world)[:, 0]

    ground = 0.5 / np.sin(0.2)
    np.testing.assert_allclose(seen(Material.GLASS, 0.0, 2.0), [ground, np.inf], rtol=1e-6)
    np.testing.assert_allclose(seen(Material.STRIPE, 0.0, 2.0), [ground, np.inf], rtol=1e-6)
    np.testing.assert_allclose(seen(Material.WALL, 0.0, 2.0), [2 / np.cos(0.2), 2 / np.cos(0.1)], rtol=1e-6)
    np.testing.assert_allclose(seen(Material.DROP, -0.1, 0.0), [0.6 / np.sin(0.2), np.inf], rtol=1e-6)  # its floor
    np.testing.assert_allclose(seen(Material.DROP, -1.0, 0.0), [4 / np.cos(0.2), np.inf], rtol=1e-6)  # its far wall


def test_a_ceiling_is_met_and_one_ring_or_many_do():
    low = make_world(scenery=Scenery(ceiling=2.0))
    for rings in (1, 64):
        spec = sim.LidarSpec(rings=rings, azimuths=4, elevation_min=0.2, elevation_max=0.3)
        expected = 1.5 / np.sin(spec.elevations)
        np.testing.assert_allclose(cast(spec, low), np.repeat(expected[:, None], 4, axis=1), rtol=1e-5)
        assert scan(spec, low)[0].shape == (4 * rings, 3)


def test_vmap_is_a_loop():
    world = jax.tree.map(jnp.asarray, random_obstacles(5, 20))
    poses = jnp.asarray(np.random.default_rng(0).uniform(-3, 3, (4, 3)), jnp.float32)
    keys = jax.random.split(jax.random.key(0), 4)
    params = sim.LidarParams()
    points, valid = jax.vmap(lambda p, k: sim.scan(TINY, params, world, p, k))(poses, keys)
    for k in range(4):
        expected, expected_valid = sim.scan(TINY, params, world, poses[k], keys[k])
        np.testing.assert_allclose(points[k], expected, atol=ROUNDING)
        np.testing.assert_array_equal(valid[k], expected_valid)


def test_a_sweep_compiles_once():
    world = jax.tree.map(jnp.asarray, random_obstacles(5, 20))

    @jax.jit
    @chex.assert_max_traces(n=1)
    def once(params, pose, key):
        return sim.scan(TINY, params, world, pose, key)

    for k in range(3):
        params = sim.LidarParams(max_range=5.0 + k, noise_std=0.01 * k, dropout=0.1 * k)
        once(params, jnp.full(3, float(k)), jax.random.key(k))


@pytest.mark.parametrize(
    "wrong",
    [
        {"rings": 0},
        {"azimuths": 0},
        {"elevation_min": 0.3, "elevation_max": 0.2},
        {"elevation_max": 1.6},
    ],
)
def test_a_spec_that_cannot_be_is_refused(wrong):
    with pytest.raises(ValueError, match="must"):
        sim.LidarSpec(**wrong)
