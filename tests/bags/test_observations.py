"""Bags as observations: what arrives where, what is missing, and what the errors say."""

import dataclasses

import numpy as np
import pytest
import small_bag
from small_bag import BEGIN, CLOUD, IMAGE, INFO, ODOM, POINTS, SCAN, TF, drive, photo_of, write

from drnav_jax.bags import BagSpec, ImageSpec, ScanSpec, read

SPEC = BagSpec(image=ImageSpec((12, 20), 1.2), scan=ScanSpec(rings=2, azimuths=3))


def observations(path, spec=SPEC):
    return list(read(path, spec))


@pytest.mark.parametrize("ros", [1, 2])
def test_what_was_recorded_is_observed(tmp_path, ros):
    found = observations(write(tmp_path / ("a.bag" if ros == 1 else "a"), drive(ros=ros), ros))
    assert [round(r.time * 1e9) for r in found] == [BEGIN, BEGIN + 100_000_000, BEGIN + 200_000_000]
    for k, recorded in enumerate(found):
        seen = recorded.observation
        np.testing.assert_allclose(seen.pose, [0.1 * k, 0.5, 0.3], atol=1e-6)
        np.testing.assert_allclose(seen.twist, [1.0, 0.2], atol=1e-6)
        assert seen.point_valid.tolist() == [True] * 3 + [False] * 3  # no NaN among them
        np.testing.assert_allclose(seen.points[:3], CLOUD[[0, 2, 3]] + [0.1, -0.2, 0.5], atol=1e-6)
        assert (recorded.photos[0] == photo_of(k)).all()
        np.testing.assert_allclose(seen.images, np.broadcast_to(photo_of(k)[0, 0] / 255, (1, 12, 20, 3)), atol=1e-6)
        np.testing.assert_allclose(seen.rig.position, [[0.3, 0.0, 0.6]], atol=1e-6)
        np.testing.assert_allclose(seen.rig.rotation[0], [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-6)
        np.testing.assert_allclose(seen.image_age, [0.03], atol=1e-6)  # odometry is the latest
        np.testing.assert_allclose(seen.point_age, 0.02, atol=1e-6)
        wanted = {"images": np.float32, "image_valid": bool, "points": np.float32, "point_valid": bool, "pose": np.float32}
        assert {name: getattr(seen, name).dtype for name in wanted} == wanted


def test_compressed_images_are_the_same(tmp_path):
    raw = drive(1)
    packed = drive(1, image=lambda m, k, ns: m.compressed(ns - 10_000_000, photo_of(k)))
    packed = [(topic + "/compressed" if topic == IMAGE else topic, ns, m) for topic, ns, m in packed]
    one, two = (observations(write(tmp_path / n, held))[0].observation for n, held in (("a", raw), ("b", packed)))
    np.testing.assert_array_equal(one.images, two.images)
    both = observations(write(tmp_path / "c", raw + [m for m in packed if "compressed" in m[0]]))[0]
    assert both.observation.images.shape[0] == 1  # one camera, published twice


def test_gaps_are_masks(tmp_path):
    held = drive(
        3, image=lambda m, k, ns: None if k == 1 else m.image(ns, photo_of(k)),
        odometry=lambda m, k, ns: None if k == 2 else m.odometry(ns, (0.1 * k, 0.0, 0.0), (1.0, 0.0)),
    )  # fmt: skip
    seen = [r.observation for r in observations(write(tmp_path / "a", held), dataclasses.replace(SPEC, tolerance=0.04))]
    assert [bool(s.image_valid[0]) for s in seen] == [True, False, True]
    assert (seen[1].images == 0).all() and seen[1].rig.focal[0, 0] > 0
    assert [bool(np.isnan(s.pose).any()) for s in seen] == [False, False, True] and np.isnan(seen[2].twist).all()
    seen = [r.observation for r in observations(write(tmp_path / "b", held), dataclasses.replace(SPEC, tolerance=0.11))]
    assert all(s.image_valid[0] for s in seen) and np.isfinite(seen[2].pose).all()


def test_robots_without_camera_lidar_or_odometry(tmp_path):
    seen = observations(write(tmp_path / "a", drive(2, without=(IMAGE, INFO, ODOM))))[1].observation
    assert seen.images.shape == (0, 12, 20, 3) and seen.rig.rotation.shape == (0, 3, 3) and not seen.pose.any()
    seen = observations(write(tmp_path / "b", drive(2, without=(POINTS,))))
    assert len(seen) == 2 and not seen[0].observation.point_valid.any() and seen[0].observation.image_valid.all()


def test_a_laser_scan(tmp_path):
    held = [m for m in drive(1) if m[0] != POINTS]
    held.append((SCAN, BEGIN, small_bag.Maker().scan(BEGIN, [2.0, np.inf, np.nan, 0.01, 5.0])))
    seen = observations(write(tmp_path / "a", held))[0].observation
    assert seen.point_valid.sum() == 3
    away = np.hypot(*(seen.points[:3, :2] - np.float32([0.1, -0.2])).T)
    np.testing.assert_allclose(away, [2.0, 20.0, 5.0], atol=1e-5)
    np.testing.assert_allclose(seen.points[:3, 2], 0.5, atol=1e-6)


def test_base_frame_height_and_level_ground(tmp_path):
    rng, slope = np.random.default_rng(0), 0.03
    xy = rng.uniform(-8, 8, (500, 2))
    ground = np.column_stack([xy, slope * xy[:, 0] - 1.05])  # as the LiDAR sees it
    held = drive(1, points=lambda m, k, ns: m.cloud(ns, ground), without=(ODOM,))
    spec = dataclasses.replace(SPEC, base_frame="lidar", base_height=1.0, level=True)
    found = observations(write(tmp_path / "a", held), spec)[0]
    np.testing.assert_allclose(found.cloud[:, 2], 0.0, atol=1e-5)
    assert found.ground.height == pytest.approx(-0.05, abs=1e-5)
    assert found.ground.tilt == pytest.approx(np.arctan(slope), abs=1e-6)
    camera = np.array([0.2, 0.2, 1.1])  # 0.1 m above the LiDAR, and that is 1.05 m above the ground at x = 0
    height = (camera[2] + 0.05 - slope * camera[0]) / np.hypot(1, slope)  # distance from the plane
    np.testing.assert_allclose(found.observation.rig.position[0, 2], height, atol=1e-5)
    np.testing.assert_allclose(found.observation.rig.rotation[0, 2], [0, -1, 0], atol=1e-6)  # drawn level


@pytest.mark.parametrize(
    ("changes", "spec", "said"),
    [
        ({"without": (INFO,)}, SPEC, f"no calibration for {IMAGE}: record {INFO}"),
        ({"without": (TF,)}, SPEC, 'where "camera" sits on "base_link" .tf knows no frames.: record /tf_static'),
        ({"tf": lambda m, k, ns: m.tf(small_bag.MOUNTS[0])}, SPEC, 'where "lidar" sits .* .tf knows base_link, camera'),
        ({"without": (IMAGE, INFO, POINTS)}, SPEC, "neither images nor a point cloud.*/odom"),
        ({"info": lambda m, k, ns: m.info(ns, focal=0.0)}, SPEC, "not calibrated"),
        ({"info": lambda m, k, ns: m.info(ns, d=(0.1,) * 4, model="odd")}, SPEC, 'distortion "odd"'),
        ({"info": lambda m, k, ns: m.info(ns, shape=(20, 30))}, SPEC, "has 40 x 60 pixels, its CameraInfo is for 20 x 30"),
        ({}, dataclasses.replace(SPEC, points="/nothing"), "no topic /nothing for LiDAR; it has .*/points"),
        ({}, dataclasses.replace(SPEC, points=ODOM), "/odom is of type nav_msgs/msg/Odometry.*PointCloud2"),
        ({}, dataclasses.replace(SPEC, images=(POINTS,)), "/points is of type .* no camera"),
        ({}, dataclasses.replace(SPEC, base_frame="camera"), 'moves "base_link", not "camera"'),
    ],
)
def test_errors_say_what_to_do(tmp_path, changes, spec, said):
    path = write(tmp_path / "a", drive(2, **changes))
    with pytest.raises(ValueError, match=said):
        observations(path, spec)


def test_one_of_several_must_be_named(tmp_path):
    held = drive(1)
    held.append(("/other", BEGIN, small_bag.Maker().cloud(BEGIN, [[1.0, 0.0, 0.0]])))
    path = write(tmp_path / "a", held)
    with pytest.raises(ValueError, match="several topics for LiDAR, /other, /points: name one"):
        observations(path)
    assert observations(path, dataclasses.replace(SPEC, points="/other"))[0].observation.point_valid.sum() == 1


def test_no_bag_and_broken_bags(tmp_path):
    with pytest.raises(FileNotFoundError, match="not there"):
        observations(tmp_path / "nothing")
    with pytest.raises(FileNotFoundError, match="metadata.yaml"):
        observations(tmp_path)
    whole = write(tmp_path / "a.bag", drive(8, ros=1), 1).read_bytes()
    for k, content in enumerate((b"", b"no bag at all", whole[: len(whole) // 2], whole[:-40])):
        file = tmp_path / f"{k}.bag"
        file.write_bytes(content)
        with pytest.raises(ValueError, match=r"cannot be read as a rosbag|is broken"):
            observations(file)
    folder = write(tmp_path / "b", drive(8))
    for file in folder.glob("*.db3"):
        held = bytearray(file.read_bytes())
        held[len(held) // 4 : len(held) // 2] = bytes(len(held) // 2 - len(held) // 4)
        file.write_bytes(held)
    with pytest.raises(ValueError, match=r"cannot be read as a rosbag|is broken"):
        observations(folder)


def test_the_tolerance_is_checked():
    with pytest.raises(ValueError, match="tolerance"):
        BagSpec(tolerance=-0.1)


def recordings(shared_data, name):
    """The folder of that name; not all copies of the data hold each."""
    folder = shared_data / "bags" / name
    if not folder.is_dir():
        pytest.skip(f"needs real recordings: {folder} is not there; DRNAV_DATA names the folder that holds bags/.")
    return folder


def test_the_kitti_frames(shared_data):
    path = recordings(shared_data, "kitti_0926")
    spec = BagSpec(base_frame="velodyne", base_height=1.73, level=True, scan=ScanSpec(min_range=2.0))
    found = observations(path, spec)
    assert len(found) == 16
    for recorded in found:
        seen = recorded.observation
        assert recorded.photos[0].shape == (375, 1242, 3) and seen.image_valid.all()
        assert abs(1.73 - recorded.ground.height - 1.73) < 0.05 and recorded.ground.tilt < np.radians(1.5)
        assert 1.6 < seen.rig.position[0, 2] < 1.75  # KITTI's drawing says 1.65 m
        near = np.hypot(*recorded.cloud[:, :2].T) < 15
        assert np.mean(np.abs(recorded.cloud[near, 2]) < 0.1) > 0.2  # there is a road, and it lies at z = 0
        assert seen.points.shape == (2880, 3) and seen.point_valid.sum() > 1200
        covered = (seen.images[0] > 0).any(axis=-1).mean()  # 81 x 29 of 90 x 90 degrees
        assert covered == pytest.approx((1242 / 721.5377 / 2) * (375 / 721.5377 / 2), abs=0.03)


@pytest.mark.parametrize(("name", "metres"), [("radish_fr079", 40), ("radish_intel", 20)])
def test_real_laser_drives(shared_data, name, metres):
    path = recordings(shared_data, name)
    poses = []
    for recorded in read(path, BagSpec(base_height=0.3)):
        seen = recorded.observation
        poses.append(seen.pose)
        assert seen.point_valid.sum() >= 170 and np.isfinite(seen.points).all()
        np.testing.assert_allclose(seen.points[seen.point_valid][:, 2], 0.3, atol=1e-6)
        if len(poses) == 700:
            break
    steps = np.hypot(*np.diff(np.asarray(poses)[:, :2], axis=0).T)
    assert steps.sum() > metres and steps.max() < 1.0


def test_awkward_bags_give_errors_that_say_what(shared_data):
    folder = recordings(shared_data, "fixtures")
    bags = [*folder.rglob("*.bag"), *folder.rglob("*.txt"), *(file.parent for file in folder.rglob("metadata.yaml"))]
    assert len(bags) >= 8
    for bag in bags:
        with pytest.raises(ValueError, match=bag.name):
            observations(bag)
