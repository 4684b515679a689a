"""Which camera shows which way: by where it looks, not by where it stands in the list."""

import itertools
import math

import numpy as np
import pytest

from drnav_jax.models import views
from drnav_jax.types import FRONT_LEFT_RIGHT, Mount, RigSpec, rig_of


def cameras_of(mounts, valid=None):
    rotation = np.asarray(rig_of(RigSpec(mounts=tuple(mounts))).rotation)
    return views.cameras_of(rotation, np.ones(len(mounts), bool) if valid is None else np.array(valid)).tolist()


def looking(*degrees):
    return [Mount(yaw=math.radians(d)) for d in degrees]


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
def test_the_order_of_the_cameras_does_not_matter(order):
    found = cameras_of([FRONT_LEFT_RIGHT[k] for k in order])
    assert found == [order.index(k) for k in range(3)]


def test_a_way_without_a_camera_has_none():
    assert cameras_of(looking(0)) == [0, -1, -1]
    assert cameras_of(looking(180, -90)) == [-1, -1, 1]
    assert cameras_of([]) == [-1, -1, -1]
    assert cameras_of(looking(0, 90, -90), [True, False, True]) == [0, -1, 2]


def test_the_nearest_camera_that_has_an_image_counts():
    assert cameras_of(looking(-30, 10, 80)) == [1, 2, -1]
    assert cameras_of(looking(-30, 10, 80), [True, False, True]) == [0, 2, -1]


def test_within_45_degrees_and_no_more():
    assert cameras_of(looking(44.9)) == [0, -1, -1]
    assert cameras_of(looking(45.1)) == [-1, 0, -1]
    assert cameras_of(looking(45, -45, 135, 225)) == [-1, -1, -1], "half between two ways it shows neither"
    assert cameras_of(looking(44.999, -45.001)) == [-1, -1, -1], "nor where only rounding would tell"


def test_a_camera_may_look_down_or_be_turned_about_its_axis_but_not_at_the_ground():
    assert cameras_of([Mount(yaw=math.pi / 2, pitch=0.4, roll=1.0)]) == [-1, 0, -1]
    assert cameras_of([Mount(pitch=1.3)]) == [-1, -1, -1]


def test_angles_of_the_axes_are_an_oracle():
    """Against the angle between two unit vectors, for random rigs; no camera shows two ways."""
    rng = np.random.default_rng(0)
    ways = np.array([[1, 0, 0], [0, 1, 0], [0, -1, 0]])
    for _ in range(200):
        count = rng.integers(1, 6)
        mounts = [Mount(yaw=y, pitch=p, roll=r) for y, p, r in rng.uniform([-4, -1.5, -3], [4, 1.5, 3], (count, 3))]
        valid = rng.random(count) < 0.8
        want = []
        for way in ways:
            best, angle = -1, math.radians(44.99)  # the rotations' rounding, and the margin of 1e-4 in a cosine
            for k, m in enumerate(mounts):
                axis = [math.cos(m.pitch) * math.cos(m.yaw), math.cos(m.pitch) * math.sin(m.yaw), -math.sin(m.pitch)]
                if valid[k] and math.acos(np.clip(np.dot(axis, way), -1, 1)) < angle:
                    best, angle = k, math.acos(np.clip(np.dot(axis, way), -1, 1))
            want.append(best)
        found = cameras_of(mounts, valid)
        assert found == want
        chosen = [k for k in found if k != views.NO_CAMERA]
        assert len(chosen) == len(set(chosen))


def test_frames_may_share_a_rig_or_have_their_own():
    images = np.zeros((2, 3, 4, 5, 3), np.uint8)
    one, other = rig_of(RigSpec()), rig_of(RigSpec(mounts=FRONT_LEFT_RIGHT[::-1]))
    np.testing.assert_array_equal(views.shown(images, one, None), [[0, 1, 2]] * 2)
    both = one._replace(rotation=np.stack([one.rotation, other.rotation]))
    np.testing.assert_array_equal(views.shown(images, both, None), [[0, 1, 2], [2, 1, 0]])
    there = np.array([[True] * 3, [False, True, True]])
    np.testing.assert_array_equal(views.shown(images, both, there), [[0, 1, 2], [2, 1, -1]])


def test_images_that_do_not_fit_are_refused():
    rig = rig_of(RigSpec())
    with pytest.raises(ValueError, match="uint8"):
        views.shown(np.zeros((1, 3, 4, 5, 3), np.float32), rig, None)
    with pytest.raises(ValueError, match="1 frames of 2 images need a rig"):
        views.shown(np.zeros((1, 2, 4, 5, 3), np.uint8), rig, None)
