"""Transforms against SciPy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_bag import Maker

from drnav_jax.bags import transforms
from drnav_jax.bags.transforms import Tree


def matrix(t, q):
    m = np.eye(4)
    m[:3, :3], m[:3, 3] = Rotation.from_quat(q).as_matrix(), t
    return m


def test_a_chain_up_and_down_a_tree():
    rng = np.random.default_rng(0)
    turns = [Rotation.random(random_state=k).as_quat() for k in range(3)]
    shifts = rng.normal(size=(3, 3)).tolist()
    tree = Tree()
    tree.add(Maker().tf(("/base", "mast", shifts[0], turns[0]), ("mast", "camera", shifts[1], turns[1])))
    tree.add(Maker().tf(("base", "/lidar", shifts[2], turns[2]), ("base", "mast", shifts[2], turns[2])))  # mast again
    base_mast, mast_camera, base_lidar = (matrix(t, q) for t, q in zip(shifts, turns, strict=True))
    wanted = np.linalg.inv(base_lidar) @ base_mast @ mast_camera
    point = rng.normal(size=3)
    found = tree.between("lidar", "camera")
    np.testing.assert_allclose(found.of(point), (wanted @ [*point, 1.0])[:3], atol=1e-12)
    np.testing.assert_allclose(found.inverse().of(found.of(point)), point, atol=1e-12)
    assert tree.between("lidar", "arm") is None and tree.frames() == ["base", "camera", "lidar", "mast"]


def test_heading_and_rotations_that_are_none():
    for yaw in (-3.0, 0.4, 1.7):
        q = Maker().quaternion(*Rotation.from_euler("xyz", [0.1, -0.2, yaw]).as_quat())
        assert transforms.yaw_of(q) == pytest.approx(yaw)
    for bad in ((0.0, 0.0, 0.0, 0.0), (np.nan, 0.0, 0.0, 1.0)):
        with pytest.raises(ValueError, match="no rotation"):
            transforms.rotation_of(Maker().quaternion(*bad))
