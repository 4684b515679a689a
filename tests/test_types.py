"""What the containers refuse, and what an empty observation is."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drnav_jax.types import FRONT_LEFT_RIGHT, BevSpec, GridSpec, Mount, RigSpec, empty_observation, rig_of, sane


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ({"resolution": 0.0}, "resolution must be > 0 m, got 0.0"),
        ({"resolution": -0.1}, "resolution must be > 0 m"),
        ({"stride": 0}, "stride must be >= 1 cell, got 0"),
        ({"shape": (63, 64)}, "even numbers of cells"),
        ({"shape": (64, 6)}, "cells >= 8"),
    ],
)
def test_a_grid_that_cannot_be_is_refused(field, message):
    with pytest.raises(ValueError, match=message):
        GridSpec(**field)


def test_specs_are_keys():
    assert hash(GridSpec(shape=(8, 10))) == hash(GridSpec(shape=(8, 10)))
    assert GridSpec(shape=(8, 10)) != GridSpec(shape=(10, 8))


def test_an_empty_observation_is_all_masks():
    seen = empty_observation(5, RigSpec(FRONT_LEFT_RIGHT[:2], shape=(3, 4)))
    assert seen.points.shape == (5, 3) and seen.images.shape == (2, 3, 4, 3)
    assert not bool(jnp.any(seen.point_valid)) and not bool(jnp.any(seen.image_valid))
    assert all(a.dtype in (jnp.float32, bool) for a in jax.tree.leaves(seen))
    assert empty_observation(0).points.shape == (0, 3)
    with pytest.raises(ValueError, match="num_points must be >= 0"):
        empty_observation(-1)


def test_what_is_too_old_is_missing():
    seen = empty_observation(2, RigSpec())
    seen = seen._replace(image_valid=jnp.ones(3, bool), point_valid=jnp.ones(2, bool))
    for ages, point_age, want in (([0, 0.5, 0.6], 0.5, [1, 1, 0]), ([0, jnp.nan, jnp.inf], 0.51, [1, 0, 0])):
        aged = seen._replace(image_age=jnp.asarray(ages, jnp.float32), point_age=jnp.float32(point_age))
        kept, healthy = sane(aged, seen.pose, seen.twist, 0.5)
        assert bool(healthy) and kept.image_valid.tolist() == [bool(w) for w in want]
        assert kept.point_valid.tolist() == [point_age <= 0.5] * 2
    kept, _ = sane(seen._replace(image_age=jnp.zeros(0, jnp.float32)), seen.pose, seen.twist, 0.5)
    assert kept.image_valid.tolist() == [True] * 3, "without ages they are fresh"


def test_a_rig_looks_where_its_mounts_say():
    down = Mount(x=0.2, y=-0.1, z=0.6, yaw=0.3, pitch=0.4, fov=math.radians(60))
    rig = rig_of(RigSpec((*FRONT_LEFT_RIGHT, down, Mount(roll=0.2)), shape=(30, 40)))
    view, right, below = (np.asarray(rig.rotation[:, :, k]) for k in (2, 0, 1))
    np.testing.assert_allclose(view[:3], [[1, 0, 0], [0, 1, 0], [0, -1, 0]], atol=1e-6)
    np.testing.assert_allclose(right[0], [0, -1, 0], atol=1e-6)
    np.testing.assert_allclose(below[:3], [[0, 0, -1]] * 3, atol=1e-6)
    expected = [math.cos(0.4) * math.cos(0.3), math.cos(0.4) * math.sin(0.3), -math.sin(0.4)]
    np.testing.assert_allclose(view[3], expected, atol=1e-6)
    np.testing.assert_allclose(rig.position[3], [0.2, -0.1, 0.6])
    assert right[4][2] < 0  # rolled to the right
    np.testing.assert_allclose(rig.focal[:, 0], [20, 20, 20, 20 / math.tan(math.radians(30)), 20], rtol=1e-6)
    np.testing.assert_allclose(rig.centre[0], [20, 15])
    eye = np.einsum("nij,nik->njk", rig.rotation, rig.rotation)
    np.testing.assert_allclose(eye, np.broadcast_to(np.eye(3), eye.shape), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(np.asarray(rig.rotation)), 1.0, atol=1e-6)


def test_the_birds_eye_grid_lies_ahead():
    assert BevSpec(shape=(4, 6), resolution=0.5, ahead=1.0).origin == (-0.5, -1.0)
    with pytest.raises(ValueError, match="resolution > 0 m"):
        BevSpec(resolution=0.0)


@pytest.mark.parametrize(("field", "message"), [({"fov": 3.2}, "fov must lie in"), ({"z": 0.0}, "z must be > 0 m")])
def test_a_camera_that_cannot_be_is_refused(field, message):
    with pytest.raises(ValueError, match=message):
        Mount(**field)
