"""The experiment on recorded frames: one command gives figures and pictures, from any weights."""

import dataclasses
import json

import numpy as np
import pytest
import small_bag
from PIL import Image
from small_network import SPEC, params_of

from drnav_jax import report
from drnav_jax.models import weights
from drnav_jax.models.calibration import Calibration
from experiments import real_frames
from experiments.real_frames import Config, Said

pytestmark = pytest.mark.relaxed  # flax


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    file = tmp_path_factory.mktemp("weights") / "small.safetensors"
    weights.save(file, SPEC, params_of(), Calibration(), {})
    return file


def street(count):
    """A LiDAR 1 m above a street between two walls that ends 6 m ahead."""
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-8, 6, 4000), rng.uniform(-2, 2, 4000), np.full(4000, -1.0)])
    side = np.column_stack([rng.uniform(-8, 6, 4000), rng.choice([-2.0, 2.0], 4000), rng.uniform(-1, 1, 4000)])
    end = np.column_stack([np.full(1500, 6.0), rng.uniform(-2, 2, 1500), rng.uniform(-1, 1, 1500)])
    cloud = np.concatenate([ground, side, end])
    return small_bag.drive(count, points=lambda m, k, ns: m.cloud(ns, cloud), without=(small_bag.ODOM,))


@pytest.mark.long
def test_one_command_gives_figures_and_pictures(tmp_path, trained):
    bag = small_bag.write(tmp_path / "bag", street(3))
    config = Config(
        data=bag, out=tmp_path / "out", weights=trained, base_frame="lidar", base_height=0.9, body=0.5, shape=(16, 24),
        frames=2, columns=2, repeats=2,
    )  # fmt: skip
    result = real_frames.main(config)
    assert json.loads((tmp_path / "out" / "frames.json").read_text()) == json.loads(report.dumps(result))
    assert result["weights_sha256"] == weights.load(trained).sha256 and result["summary"]["finite"]
    assert [row["time"] for row in result["frames"]] == [100.0, 100.2]  # the first and the last
    for row in result["frames"]:
        assert row["lidar_height"] == pytest.approx(1.0, abs=0.01) and row["ground_tilt_deg"] < 0.1
        assert 0.2 < row["share_judged"] <= 1 and 0 <= row["share_dead"] <= 1 and row["latency_ms"] > 0
        assert row["p_open"] != row["p_open_without_camera"]
        assert set(row["path_logits"]) == {"front", "left", "right"}
    sizes = {}
    for name in ("frames.png", "frame01.png", "frame02.png"):
        with Image.open(tmp_path / "out" / name) as picture:
            sizes[name] = picture.size
    assert sizes["frames.png"][0] > 1.5 * sizes["frame01.png"][0] > 400


def test_figures_count_what_they_say():
    known = np.array([[0, 1, 1, 2], [1, 2, 2, 0]])
    said = Said(
        path=np.array([0.0, 5.0, -5.0]), flag=np.array(-1.0), known=known, judged=known == 1, rule=known > 0,
        p_dead=np.array([[0.9, 0.9, 0.1, 0.9], [0.7, 0.9, 0.9, 0.9]]),
        traversable=np.array([[0.0, 0.9, 0.2, 0.1], [0.8, 0.1, 0.6, 0.0]]),
    )  # fmt: skip
    found = real_frames.figures(said, said._replace(p_dead=np.zeros((2, 4)), path=np.full(3, np.nan)))
    assert found["share_dead"] == pytest.approx(2 / 3) and found["share_dead_without_camera"] == 0
    assert found["share_judged"] == pytest.approx(3 / 8) and found["share_dead_by_rule"] == 1
    assert found["free_said_traversable"] == pytest.approx(2 / 3)
    assert found["occupied_said_not_traversable"] == pytest.approx(2 / 3)
    assert found["p_open"]["front"] == 0.5 and not found["dead_end"] and found["finite"]


def test_the_bag_is_read_as_the_flags_say(tmp_path):
    """Frames of a robot with odometry, of a LiDAR whose ground is not looked for; a topic that is named, and not there."""
    bag = small_bag.write(tmp_path / "bag", small_bag.drive(2))
    config = Config(data=bag, base_frame="lidar", base_height=0.9, body=0.5, shape=(16, 24), level=False)
    found = real_frames.chosen(config)
    assert len(found) == 2 and all(frame.ground is None for frame in found)
    np.testing.assert_array_equal([frame.observation.pose for frame in found], np.zeros((2, 3)))
    with pytest.raises(ValueError, match="has no topic /nowhere for LiDAR"):
        real_frames.chosen(dataclasses.replace(config, points="/nowhere"))
    with pytest.raises(ValueError, match="has no topic /nowhere for camera"):
        real_frames.chosen(dataclasses.replace(config, images=("/nowhere",)))


def test_counts_are_checked():
    with pytest.raises(ValueError, match="--frames"):
        Config(data=".", frames=-1)
