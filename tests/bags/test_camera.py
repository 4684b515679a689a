"""Images redrawn as another camera's, against a scene whose colour is known in every direction."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from small_bag import Maker, photo_of

from drnav_jax.bags import ImageSpec, camera
from drnav_jax.bags.transforms import Rigid

SHAPE = (90, 140)
LOOKS = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # optical frame in base_link, level and ahead


def colour(direction):
    """Smooth in the direction (base_link)."""
    x, y, z = direction / np.linalg.norm(direction)
    return np.array([0.5 + 0.4 * math.sin(3 * y), 0.5 + 0.4 * math.sin(4 * z), 0.5 + 0.3 * x * y])


def bent(model, d, x, y):
    """Where a lens puts a ray, from its definition in OpenCV's manual."""
    r = math.hypot(x, y)
    if model == "equidistant":
        t = math.atan(r)
        s = t * (1 + d[0] * t**2 + d[1] * t**4 + d[2] * t**6 + d[3] * t**8) / r if r else 1.0
        return x * s, y * s
    k1, k2, p1, p2, k3 = d[:5]
    s = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6
    if model == "rational_polynomial":
        s /= 1 + d[5] * r**2 + d[6] * r**4 + d[7] * r**6
    return x * s + 2 * p1 * x * y + p2 * (r * r + 2 * x * x), y * s + p1 * (r * r + 2 * y * y) + 2 * p2 * x * y


def photographed(info, rotation, model, d):
    """The scene as a real camera takes it: for each pixel the ray that its lens puts there, by fixed-point iteration."""
    f, cx, cy = info.k[0], info.k[2], info.k[5]
    photo = np.zeros((*SHAPE, 3))
    for i in range(SHAPE[0]):
        for j in range(SHAPE[1]):
            u, v = (j - cx) / f, (i - cy) / f
            if model == "equidistant":
                r = math.hypot(u, v)
                top = max(1e-9, r)
                slope = brentq(lambda s, top=top: bent(model, d, s, 0)[0] - top, 0, 50) if r else 0.0
                x, y = (u / top * slope, v / top * slope)
            else:
                x, y = u, v
                for _ in range(30):
                    gx, gy = bent(model, d, x, y)
                    x, y = x + u - gx, y + v - gy
            photo[i, j] = colour(rotation @ [x, y, 1.0])
    return np.round(photo * 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("model", "d"),
    [
        ("plumb_bob", (0.0,) * 5),
        ("plumb_bob", (-0.1, 0.02, 0.003, -0.002, 0.001)),
        ("rational_polynomial", (0.1, 0.01, 0.002, 0.001, 0.0, 0.2, 0.01, 0.0)),
        ("equidistant", (-0.02, 0.01, 0.0, 0.0)),
    ],
)
def test_the_scene_stays_where_it_is(model, d):
    info = Maker().info(0, SHAPE, focal=100.0, d=d, model=model)
    rotation = Rotation.from_euler("ZYX", [0.5, 0.1, 0.05]).as_matrix() @ LOOKS  # turned left, down, and rolled
    photo = photographed(info, rotation, model, d)
    put = Rigid(rotation, np.array([1.0, 2.0, 3.0]))
    view = camera.redrawn(ImageSpec((24, 32), 1.5), camera.lens_of(info, False), put, photo)
    # level, and where the real camera looks along the ground
    along = rotation[:, 2]
    np.testing.assert_allclose(view.rotation[:, 2], [*(along[:2] / np.hypot(*along[:2])), 0], atol=1e-6)
    np.testing.assert_allclose(view.rotation[:, 1], [0, 0, -1], atol=1e-6)
    np.testing.assert_allclose(view.position, [1, 2, 3])
    compared = 0
    for i in range(24):
        for j in range(32):
            ray = view.rotation @ [*(([j + 0.5, i + 0.5] - view.centre) / view.focal), 1.0]
            x, y, z = rotation.T @ ray
            u, v = np.array(bent(model, d, x / z, y / z)) * 100.0 + [info.k[2], info.k[5]] if z > 0.1 else (-99.0, -99.0)
            if 6 < u < SHAPE[1] - 7 and 6 < v < SHAPE[0] - 7:
                np.testing.assert_allclose(view.image[i, j], colour(ray), atol=0.02)  # a pixel's width of the scene
                assert view.seen[i, j]
                compared += 1
            elif not (-1 < u < SHAPE[1] and -1 < v < SHAPE[0]):
                assert not view.seen[i, j] and not view.image[i, j].any()
    assert compared > 150


def test_far_rays_are_not_folded_back():
    lens = camera.lens_of(Maker().info(0, SHAPE, focal=60.0, d=(-0.3, 0.0, 0.0, 0.0, 0.0)), False)
    slopes = np.linspace(0, 3, 300)
    turning = 1 / math.sqrt(0.9)  # of r (1 - 0.3 r^2)
    at, seen = camera.pixels_of(lens, np.stack([slopes, 0 * slopes, 1 + 0 * slopes], axis=-1))
    assert seen[slopes < 0.99 * turning].all() and not seen[slopes > 1.01 * turning].any()
    assert (np.diff(at[seen, 0]) > 0).all()
    assert not camera.pixels_of(lens, np.array([[0.0, 0.0, -1.0]]))[1].any()  # behind


def test_fine_detail_does_not_alias():
    rows, columns = np.indices(SHAPE)
    photo = np.repeat((255 * ((rows + columns) % 2)).astype(np.uint8)[..., None], 3, axis=-1)
    view = camera.redrawn(
        ImageSpec((8, 8), 1.0), camera.lens_of(Maker().info(0, SHAPE, focal=100.0), False), Rigid(LOOKS, np.zeros(3)), photo
    )
    inner = view.image[3:5, 2:6]
    assert view.seen[3:5, 2:6].all() and np.abs(inner - 0.5).max() < 0.02


def test_encodings():
    rng = np.random.default_rng(0)
    photo, make = rng.integers(0, 256, (5, 7, 3)).astype(np.uint8), Maker()
    message = make.image(0, photo)
    np.testing.assert_array_equal(camera.decoded(message), photo)
    np.testing.assert_array_equal(camera.decoded(make.compressed(0, photo)), photo)
    message.encoding, message.step = "bgra8", 4 * 7 + 3  # rows end in padding
    rows = np.concatenate([photo[..., ::-1], np.full((5, 7, 1), 9, np.uint8)], axis=-1).reshape(5, -1)
    message.data = np.concatenate([rows, np.full((5, 3), 77, np.uint8)], axis=1).ravel()
    np.testing.assert_array_equal(camera.decoded(message), photo)
    message.encoding, message.step, message.data = "mono8", 7, photo[..., 0].ravel()
    np.testing.assert_array_equal(camera.decoded(message), np.repeat(photo[..., :1], 3, axis=-1))
    message.data = message.data[:-3]
    with pytest.raises(ValueError, match="cut off"):
        camera.decoded(message)
    message.encoding = "16UC1"
    with pytest.raises(ValueError, match='encoding "16UC1"'):
        camera.decoded(message)
    packed = make.compressed(0, photo)
    packed.data = packed.data[:20]
    with pytest.raises(ValueError, match="damaged"):
        camera.decoded(packed)


def test_rectified_images_use_their_own_matrix():
    info = Maker().info(0, SHAPE, focal=50.0, d=(0.1,) * 5)
    info.p[0] = info.p[5] = 44.0
    raw, rectified = camera.lens_of(info, False), camera.lens_of(info, True)
    assert raw.focal.tolist() == [50.0, 50.0] and raw.distortion.size == 5
    assert rectified.focal.tolist() == [44.0, 44.0] and rectified.distortion.size == 0
    assert rectified.centre.tolist() == [SHAPE[1] / 2, SHAPE[0] / 2]  # from the corner of the first pixel


def test_settings_are_checked():
    for bad in ({"shape": (0, 4)}, {"fov": 0.0}, {"fov": math.pi}):
        with pytest.raises(ValueError):
            ImageSpec(**bad)
    lens = camera.lens_of(Maker().info(0, SHAPE), False)
    with pytest.raises(ValueError, match="40 x 60"):
        camera.redrawn(ImageSpec(), lens, Rigid(LOOKS, np.zeros(3)), photo_of(0))
