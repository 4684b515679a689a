"""Clouds, laser scans, the LiDAR they are given as, and the ground."""

import math

import numpy as np
import pytest
from small_bag import Maker

from drnav_jax.bags import ScanSpec, scan


def test_clouds_of_any_layout():
    points = np.array([[1, 2, 3], [np.nan, 5, 6], [7, 8, 9], [10, 11, 12], [13, 14, 15], [16, 17, 18]], np.float32)
    make = Maker()
    np.testing.assert_array_equal(scan.points_of(make.cloud(0, points)), points)
    nothing = make.cloud(0, points[:0])
    nothing.height = nothing.width = nothing.row_step = 0  # a cloud that was cleared
    assert scan.points_of(nothing).shape == (0, 3)
    # big-endian doubles after an intensity, two rows of three points, each row padded
    rows = []
    for row in points.reshape(2, 3, 3):
        held = b"".join(b"\x07" + p.astype(">f8").tobytes() + b"\x00" * 3 for p in row)
        rows.append(held + b"\xff" * 5)
    places = (("intensity", 0, 2), ("x", 1, 8), ("y", 9, 8), ("z", 17, 8))
    fields = [make.new("sensor_msgs/msg/PointField", name=n, offset=at, datatype=t, count=1) for n, at, t in places]
    odd = make.new(
        "sensor_msgs/msg/PointCloud2", header=make.header(0, "lidar"), height=2, width=3, fields=fields, is_bigendian=True,
        point_step=28, row_step=28 * 3 + 5, data=np.frombuffer(b"".join(rows), np.uint8), is_dense=False,
    )  # fmt: skip
    np.testing.assert_array_equal(scan.points_of(odd), points)
    odd.data = odd.data[:-40]
    with pytest.raises(ValueError, match="cut off"):
        scan.points_of(odd)
    odd.fields = fields[:2]
    with pytest.raises(ValueError, match="needs x, y and z, this one has intensity, x"):
        scan.points_of(odd)
    assert scan.points_of(make.cloud(0, np.zeros((0, 3)))).shape == (0, 3)


def test_beams_that_met_nothing_and_beams_that_read_nothing():
    found = scan.points_of(Maker().scan(0, [1.0, np.inf, 25.0, np.nan, 0.05, -np.inf, 2.0]))
    away = np.hypot(found[:, 0], found[:, 1])
    np.testing.assert_allclose(away, [1.0, 20.0, 20.0, np.nan, np.nan, np.nan, 2.0], rtol=1e-6)
    np.testing.assert_allclose(np.arctan2(found[6, 1], found[6, 0]), 1.0, atol=1e-6)


def test_each_beam_reads_its_nearest_point():
    spec = ScanSpec(rings=4, azimuths=6, elevation_min=-0.3, elevation_max=0.3, height=0.4, min_range=0.5)
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3)) * [4.0, 4.0, 1.0]
    found = scan.scan_of(spec, np.concatenate([points, [[np.nan, 0, 0], [0.1, 0.1, 0.4]]]))
    wanted = {}
    for p in points:
        away, rise = math.hypot(p[0], p[1]), p[2] - 0.4
        ring = round((math.atan2(rise, away) + 0.3) / 0.2)
        beam = int((math.atan2(p[1], p[0]) + math.pi) / (2 * math.pi) * 6)
        if away < 0.5 or not 0 <= ring < 4:
            continue
        key = (ring, beam)
        if key not in wanted or math.hypot(away, rise) < wanted[key][0]:
            wanted[key] = (math.hypot(away, rise), p)
    assert found.valid.sum() == len(wanted) > 15
    for (ring, beam), (_, p) in wanted.items():
        np.testing.assert_allclose(found.points[ring * 6 + beam], p, rtol=1e-6)


def test_few_points_are_all_kept():
    spec = ScanSpec(rings=2, azimuths=3)
    points = np.array([[1.0, 0, 9.0], [1.0, 0, 0.5], [2.0, 0, 0.5]])  # two on one beam, one far above all beams
    found = scan.scan_of(spec, points)
    assert found.valid.tolist() == [True] * 3 + [False] * 3
    np.testing.assert_array_equal(found.points[:3], points.astype(np.float32))
    assert not scan.scan_of(spec, np.zeros((0, 3))).valid.any()


def test_the_ground_among_walls():
    rng = np.random.default_rng(0)
    a, b, c = 0.05, -0.02, -0.15
    xy = rng.uniform(-12, 12, (3000, 2))
    ground = np.column_stack([xy, a * xy[:, 0] + b * xy[:, 1] + c + rng.normal(size=3000) * 0.02])
    walls = rng.uniform([-12, 5, -0.5], [12, 6, 3], (2000, 3))
    found = scan.level(np.concatenate([ground, walls, [[np.nan] * 3]]))
    assert found.height == pytest.approx(c, abs=5e-3)
    assert found.tilt == pytest.approx(math.atan(math.hypot(a, b)), abs=2e-3)
    level = found.put.of(ground)
    assert abs(level[:, 2].mean()) < 5e-3 and level[:, 2].std() < 0.03
    np.testing.assert_allclose(found.put.rotation @ found.put.rotation.T, np.eye(3), atol=1e-12)
    ahead = found.put.of(np.array([5.0, 0.0, 5 * a + c]))
    assert abs(ahead[1]) < 1e-2  # what lay ahead still does
    assert scan.level(walls[:, [0, 1, 2]] + [0, 0, 2.0]) is None


@pytest.mark.parametrize(
    "changes", [{"rings": 1}, {"azimuths": 0}, {"elevation_min": 0.5}, {"height": 0.0}, {"min_range": -1.0}]
)
def test_settings_are_checked(changes):
    with pytest.raises(ValueError):
        ScanSpec(**changes)
