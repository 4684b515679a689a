"""Cameras against `mujoco.Renderer`, against one ray at a time in plain NumPy, and what their images show."""

import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_rays import MARCH, trace

from drnav_jax import sim
from drnav_jax.bench import camera as native_camera
from drnav_jax.bench.obstacles import random_obstacles
from drnav_jax.sim.camera import KNEE
from drnav_jax.sim.sight import NEAR
from drnav_jax.types import FRONT_LEFT_RIGHT, Mount, RigSpec, rig_of
from drnav_jax.worlds.materials import Material
from drnav_jax.worlds.world import FAR, WALL_HEIGHT, Scenery, from_grid, make_world, surfaces

TILTED = (Mount(pitch=0.35), Mount(yaw=2.0, pitch=0.3, roll=0.2), Mount(yaw=-1.5, pitch=-0.25, roll=-0.5, z=1.2))
ROUNDING = 2e-4  # [] of a depth in float32: the ray, the hit and the difference of two of them
ORIGIN = np.zeros(3, np.float32)
NUM = 12  # boxes of a test's world, so that all are one program
SMALL, LARGE = (RigSpec((Mount(),), shape=shape) for shape in ((24, 32), (96, 96)))
QUIET = sim.CameraParams(noise_std=0.0, exposure_jitter=0.0, white_jitter=0.0, vignette=0.0)


def world_of(*solids, posts=(), **scenery):
    """Boxes (row, material, colour) and cylinders; filled up with rows that are never met."""
    rows = [*solids, *[([FAR, FAR, 0, 0, 0, 0, 0], Material.WALL, (0.5,) * 3)] * (NUM - len(solids))]
    posts = [*posts, *[([FAR, FAR, 0, 0, 0], Material.WALL, (0.5,) * 3)] * (2 - len(posts))]
    (boxes, *of_boxes), (cylinders, *of_posts) = (zip(*kind, strict=True) for kind in (rows, posts))
    world = make_world(
        boxes, cylinders, box_surfaces=surfaces(NUM, *of_boxes), cylinder_surfaces=surfaces(2, *of_posts),
        scenery=Scenery(**scenery),
    )  # fmt: skip
    return jax.tree.map(jnp.asarray, world)


def block(x, y, half_x, half_y, high=2.0, material=Material.WALL, colour=(0.7, 0.7, 0.7), low=0.0, yaw=0.0):
    return [x, y, yaw, half_x, half_y, low, high], material, colour


def image(world, spec=SMALL, params=QUIET, pose=ORIGIN, seed=0, rig=None, **how):
    rig = rig_of(spec) if rig is None else rig
    return np.asarray(sim.render(spec, params, world, rig, jnp.asarray(pose), jax.random.key(seed), **how))


def depth(world, spec=SMALL, pose=ORIGIN, **how):
    return np.asarray(sim.depth(spec, world, rig_of(spec), jnp.asarray(pose), **how))


@pytest.mark.parametrize("mounts", [FRONT_LEFT_RIGHT, TILTED])
@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.long) for k in (1, 2))])
def test_depth_is_that_of_mujocos_renderer(mounts, seed):
    spec, poses = RigSpec(mounts, shape=(72, 96)), np.array([[0.0, 0.0, 0.3], [0.2, -0.1, 2.0]], np.float32)
    world, ground = (random_obstacles(seed, n, extent=12.0) for n in (60, 0))
    try:
        native = native_camera.native_views(spec, world, rig_of(spec), poses)
    except RuntimeError as error:
        pytest.skip(str(error))
    ours, bare = (np.concatenate([depth(w, spec, pose) for pose in poses]) for w in (world, ground))
    solid = ours != bare
    both, either = solid & native.solid, solid | native.solid
    assert both.mean() > 0.1
    assert both.sum() / either.sum() > 0.998  # asked for: 0.98; measured 0.9998
    error = np.abs(ours - native.depth)
    assert np.median(error[both]) < 1e-4  # [m] asked for: 1 cm; measured 2e-5
    assert np.percentile(error[both], 99) < 2e-3  # cylinders have 256 sides there
    near = ~either & (bare < 30)
    assert near.any() and error[near].max() < 1e-3


def test_without_opengl_one_is_told_what_to_install(monkeypatch):
    monkeypatch.setattr(native_camera, "GL", ("none-such",))
    world = random_obstacles(0, 2)
    with pytest.raises(RuntimeError, match="install libegl1 or libosmesa6 .none-such: .*none-such"):
        native_camera.native_views(SMALL, world, rig_of(SMALL), np.zeros((1, 3), np.float32))


# One ray at a time, in float64. What the rays of all pixels are is `rays_of` below, from the mounts' own definition.


def rays_of(spec, pose):
    """Origin `[3]` and direction (depth 1) `[h, w, 3]` of each camera, from the mounts' angles."""
    h, w = spec.shape
    for m in spec.mounts:
        f = w / 2 / math.tan(m.fov / 2)
        local = np.empty((h, w, 3))
        for i in range(h):
            for j in range(w):
                right, down = (j + 0.5 - w / 2) / f, (i + 0.5 - h / 2) / f
                y, z = -right, -down
                y, z = math.cos(m.roll) * y - math.sin(m.roll) * z, math.sin(m.roll) * y + math.cos(m.roll) * z
                x, z = math.cos(m.pitch) + math.sin(m.pitch) * z, -math.sin(m.pitch) + math.cos(m.pitch) * z
                a = m.yaw + float(pose[2])
                local[i, j] = math.cos(a) * x - math.sin(a) * y, math.sin(a) * x + math.cos(a) * y, z
        c, s = math.cos(pose[2]), math.sin(pose[2])
        yield np.array([pose[0] + c * m.x - s * m.y, pose[1] + s * m.x + c * m.y, m.z]), local


MIXED = world_of(
    block(4.0, 1.5, 0.3, 0.8, yaw=0.4), block(3.0, -0.5, 0.02, 0.9, material=Material.GLASS),
    block(2.5, 2.0, 0.5, 0.4, 0.7, Material.BUSH), block(0.5, -2.0, 1.0, 1.0, 0.8, Material.GRASS),
    block(2.6, 0.0, 0.4, 1.0, 0.0, Material.DROP, low=-0.8), block(3.4, -0.3, 0.4, 1.0, 0.0, Material.DROP, low=-0.5),
    block(1.6, 0.0, 0.3, 1.5, 0.01, Material.STRIPE), block(0.0, 3.0, 2.0, 0.1, 1.0, Material.CAR, low=0.3),
    block(7.0, 0.0, 0.2, 6.0),
    posts=[([-1, -4, 0.8, 0.2, 1.6], Material.BRICK, (0.6, 0.3, 0.2)), ([1.2, 0.9, 0.3, 0, 0.6], Material.BUSH, (0, 0, 0))],
    ceiling=2.7,
)  # fmt: skip


@pytest.mark.parametrize("veils", [False, True])
@pytest.mark.parametrize("mounts", [FRONT_LEFT_RIGHT, TILTED])
def test_depth_is_that_of_single_rays(mounts, veils):
    spec, pose = RigSpec(mounts, shape=(18, 23)), np.array([0.3, -0.2, 0.25], np.float32)
    ours, wrong, fell = depth(MIXED, spec, pose, veils=veils), 0, 0
    for image, (p, rays) in zip(ours, rays_of(spec, pose), strict=True):
        for index in np.ndindex(spec.shape):
            expected, _ = trace(MIXED, p, rays[index], veils, NEAR)
            below = (p + expected * rays[index])[2] < -1e-3
            fell += below
            # An edge that passes through a pixel's middle may fall to either side.
            wrong += abs(image[index] - expected) > ROUNDING * (1 + expected) + below * MARCH
    assert fell > 5 and wrong <= 2


def test_a_map_s_walls_are_met_and_passed_over():
    occupied = np.zeros((80, 120), bool)
    occupied[:, 100] = occupied[0] = True
    world = jax.tree.map(jnp.asarray, from_grid(occupied, (-1.0, -4.0), 0.1))
    for mounts in (SMALL.mounts, (Mount(pitch=1e-4),)):
        seen = depth(world, RigSpec(mounts, shape=(24, 32)), ORIGIN)[0]
        wall = 9.0 - 0.1  # from the camera's mount
        np.testing.assert_allclose(seen[11:13, 16], wall, atol=0.01)
        over = np.flatnonzero(np.isinf(seen[:, 16]))
        # the row whose ray reaches the wall above its top: (i + 1/2 - 12) / 16 < -(WALL_HEIGHT - 0.5) / wall
        assert over.max() == math.floor(12 - 16 * (WALL_HEIGHT - 0.5) / wall - 0.5)
        np.testing.assert_allclose(seen[-1, 16], 0.5 * 16 / 11.5, rtol=1e-3)


@pytest.mark.long
def test_a_level_rig_is_a_tilted_one_without_tilt():
    for veils in (False, True):
        a, b = (depth(MIXED, level=level, veils=veils) for level in (True, False))
        assert np.isclose(a, b, rtol=ROUNDING).mean() > 0.998
    a, b = (image(MIXED, level=level) for level in (True, False))
    assert np.mean(np.abs(a - b) > 0.02) < 0.01  # pixels on an edge


def test_images_are_numbers_between_black_and_white_and_follow_the_key():
    spec = RigSpec(FRONT_LEFT_RIGHT, shape=(24, 32))
    a = image(MIXED, spec, sim.CameraParams(noise_std=0.05))
    assert a.shape == (3, 24, 32, 3) and a.dtype == np.float32 and a.min() >= 0 and a.max() <= 1
    np.testing.assert_array_equal(a, image(MIXED, spec, sim.CameraParams(noise_std=0.05)))
    assert np.abs(a - image(MIXED, spec, sim.CameraParams(noise_std=0.05), seed=1)).mean() > 0.01
    assert image(MIXED, RigSpec((), shape=(24, 32))).shape == (0, 24, 32, 3)


@pytest.mark.long
def test_the_sensor_has_the_stated_noise_gain_and_blur():
    world = world_of(sky_colour=(0.5, 0.5, 0.5), exposure=0.8)
    plain = image(world, LARGE)[0, :48]  # the sky
    noisy = image(world, LARGE, QUIET._replace(noise_std=0.02))[0, :48] - plain
    # 13,824 samples: the standard error of the spread is 0.7 %; the noise at this light is 0.02 (0.5 + light)
    assert abs(np.std(noisy / (0.5 + plain)) / 0.02 - 1) < 0.03 and abs(noisy.mean()) < 1e-3
    assert abs(np.corrcoef(noisy[..., 0].ravel(), noisy[..., 1].ravel())[0, 1]) < 0.05
    np.testing.assert_allclose(plain[0, 48], 0.4, atol=0.01)
    gains = [image(world, LARGE, QUIET._replace(exposure_jitter=0.1), seed=k)[0, 0, 48, 0] / 0.4 for k in range(40)]
    assert 0.06 < np.std(gains) < 0.14
    dim = image(world, LARGE, QUIET._replace(vignette=0.5))[0, :48] / plain
    np.testing.assert_allclose([dim[0, 0, 0], dim[47, 48, 0]], [0.5, 1.0], atol=0.01)
    edge = world_of(block(2.0, 4.0, 0.1, 4.0, 9.0, colour=(0.0, 0.0, 0.0)), exposure=0.5)  # below the knee
    sharp, soft = (image(edge, params=QUIET._replace(blur=b))[0, 4, :, 2] for b in (0.0, 0.25))
    expected = 0.5 * sharp[1:-1] + 0.25 * (sharp[2:] + sharp[:-2])
    np.testing.assert_allclose(soft[1:-1], expected, atol=2e-3)  # the blur along columns
    assert np.abs(np.diff(soft)).max() < 0.6 * np.abs(np.diff(sharp)).max()


def test_what_a_pane_shows_is_what_lies_behind_it():
    red = block(5.0, 0.0, 0.1, 9.0, 9.0, colour=(0.9, 0.1, 0.1))
    pane = block(2.0, 0.0, 0.02, 1.0, 1.2, Material.GLASS, (0.7, 0.9, 0.8))
    clear, glazed = image(world_of(red))[0], image(world_of(red, pane))[0]
    through = clear[8:14, 12:20], glazed[8:14, 12:20]
    assert np.abs(through[0] - through[1]).mean() > 0.03  # tint and sheen are seen
    assert (through[1][..., 0] > 1.5 * through[1][..., 1]).all()  # and the red behind
    frame = np.abs(clear - glazed).max(axis=-1) > 0.02
    assert frame.any() and not frame[:, :3].any() and not frame[:, -3:].any()


@pytest.mark.long
def test_plants_have_ragged_edges_and_grass_lets_light_through():
    back = block(6.0, 0.0, 0.1, 9.0, 9.0, colour=(0.9, 0.1, 0.9))
    shares = {}
    for material in (Material.BUSH, Material.GRASS):
        plant = block(3.0, 0.0, 0.6, 1.5, 0.9, material, (0.2, 0.5, 0.1))
        world = world_of(back, plant)
        a = image(world, LARGE)[0]
        within = depth(world, LARGE, veils=True)[0] < 4
        seen = (a[..., 2] > a[..., 1]) & within  # of the back wall
        middle = np.zeros_like(within)
        middle[45:56, 30:66] = True
        shares[material] = seen[middle & within].mean()
        tops = [np.flatnonzero(within[:, j] & ~seen[:, j]).min() for j in range(30, 66)]
        assert np.std(tops) > 0.5 and seen[within].mean() > 0.01
    assert shares[Material.BUSH] < 0.02 < 0.05 < 1 - shares[Material.GRASS]


def test_stripes_lie_on_the_ground_and_a_drop_is_darker_than_the_floor():
    stripe = block(1.5, 0.0, 0.5, 2.0, 0.0, Material.STRIPE, (0.95, 0.8, 0.1))
    drop = block(3.5, 0.0, 1.5, 9.0, 0.0, Material.DROP, (0.5, 0.5, 0.5), low=-1.5)
    bare, striped, open_ = (image(world_of(*solids), LARGE)[0] for solids in ((), (stripe,), (drop,)))
    yellow = striped[..., 0] - striped[..., 2] > 0.3
    assert 0.3 < yellow[61:70, 20:76].mean() < 0.7 and not yellow[:58].any() and not yellow[75:].any()
    changed = np.abs(bare - open_).max(axis=-1) > 0.02
    assert changed[54:58, 10:86].mean() > 0.9 and not changed[64:].any() and not changed[:52].any()
    assert open_[changed].mean() < 0.7 * bare[changed].mean()


def test_fog_hides_what_is_far_and_walls_have_their_colour():
    wall = block(4.0, 0.0, 0.1, 9.0, 9.0, colour=(0.2, 0.3, 0.8))
    clear, thick = (image(world_of(wall, fog=fog))[0] for fog in (0.0, 5.0))
    assert (clear[4:10, :, 2] > 2 * clear[4:10, :, 0]).all()
    sky = np.asarray(Scenery().sky_colour)
    air = 0.5 * sky + 0.45
    bent = np.where(air < KNEE, air, KNEE + (1 - KNEE) * (1 - np.exp(-(air - KNEE) / (1 - KNEE))))
    np.testing.assert_allclose(thick[4:10], np.broadcast_to(bent, (6, 32, 3)), atol=0.02)


@pytest.mark.parametrize("material", [m for m in Material if m not in (Material.DROP,)])
def test_each_material_has_a_texture_of_its_own(material):
    ground = dict(ground_material=int(Material.CONCRETE), ground_colour=(0.0, 0.0, 0.0))
    solid = block(2.0, 0.0, 0.3, 1.4, 2.2, material, (0.6, 0.5, 0.4))
    a = image(world_of(solid, **ground), LARGE)[0]
    reference = image(world_of(block(2.0, 0.0, 0.3, 1.4, 2.2, Material.WALL, (0.6, 0.5, 0.4)), **ground), LARGE)[0]
    if material == Material.WALL:
        assert 0 < np.std(a[20:60, 30:66, 0]) < 0.05
    else:
        assert np.abs(a - reference).mean() > 0.005
    other = image(world_of(solid, texture_seed=5, **ground), LARGE)[0]
    assert material == Material.CAR or not np.array_equal(a, other)  # paint has no grain


def test_vmap_is_a_loop():
    keys, poses = jax.random.split(jax.random.key(0), 3), jnp.asarray([[0, 0, 0], [0.5, 0, 1], [0, 0.2, 3]], jnp.float32)
    rig = rig_of(SMALL)
    several = jax.vmap(lambda pose, key: sim.render(SMALL, sim.CameraParams(), MIXED, rig, pose, key))(poses, keys)
    for k in range(3):
        one = sim.render(SMALL, sim.CameraParams(), MIXED, rig, poses[k], keys[k])
        assert np.mean(np.abs(several[k] - one) > 1e-3) < 0.002  # rounding moves a pixel over an edge


def test_a_sweep_of_rigs_and_sensors_compiles_once():
    @jax.jit
    @chex.assert_max_traces(n=1)
    def once(params, rig, pose, key):
        return sim.render(SMALL, params, MIXED, rig, pose, key)

    rig = rig_of(SMALL)
    for k in range(3):
        moved = rig._replace(position=rig.position + 0.01 * k, focal=rig.focal * (1 + 0.01 * k))
        once(sim.CameraParams(noise_std=0.01 * k, blur=0.1 * k), moved, jnp.full(3, 0.1 * k), jax.random.key(k))
