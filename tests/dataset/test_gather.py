"""A whole small shard, from worlds to labels, and what must hold between its fields."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy
from scipy import ndimage

from drnav_jax import dataset, worlds
from drnav_jax.dataset import collect, gather, shards
from drnav_jax.dataset.frames import STRATUM_BITS, FrameSpec, dtypes
from drnav_jax.dataset.shards import DatasetSpec
from drnav_jax.models import bev
from drnav_jax.sim.lidar import LidarSpec
from drnav_jax.types import FRONT_LEFT_RIGHT, BevSpec, RigSpec
from drnav_jax.worlds.frames import NEVER, NOW

pytestmark = pytest.mark.long
SPEC = FrameSpec(rig=RigSpec(FRONT_LEFT_RIGHT[:2], (12, 16)), lidar=LidarSpec(4, 180), bev=BevSpec((24, 32)))
DATA = DatasetSpec(48, "train", 0, ("u", "t"), ticks=5, num_worlds=8, per_world=6)


@pytest.fixture(scope="module")
def frames():
    return gather.shard(DATA, SPEC, 0)


def test_fields_have_the_shapes_and_types_of_storage(frames):
    count, (h, w) = DATA.shard_size, SPEC.bev.shape
    for name, kind in dtypes().items():
        values = getattr(frames, name)
        assert values.dtype == kind and len(values) == count
    assert frames.images.shape == (count, 2, 12, 16, 3) and frames.points.shape == (count, 720, 3)
    assert frames.dead_end.shape == (count, h, w) and frames.path.shape == (count, 3)
    assert 20 < frames.images.mean() < 235 and frames.images.std() > 10


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A dataset of one shard that is not whole, and its manifest."""
    folder = tmp_path_factory.mktemp("frames")
    return folder, dataset.write(folder, dataclasses.replace(DATA, num_frames=44), SPEC, workers=1)


def test_a_shard_is_its_number(frames, written):
    again = safetensors.numpy.load_file(written[0] / "shard-00000.safetensors")
    for name, value in again.items():
        np.testing.assert_array_equal(value, getattr(frames, name)[:44])
    mine, next_ones = ({seed for _, seed, _ in shards.pairs(DATA, number)} for number in (0, 1))
    assert set(frames.seed.tolist()) == mine and not mine & next_ones


def test_what_is_sensed_is_traced_without_promotion():
    """Shards are made in threads, where strictness does not reach."""
    world = worlds.sample("u", 0, "train").world
    sensors = gather._sensors(SPEC, np.random.default_rng(0))
    seen = jax.eval_shape(
        lambda poses, key: collect.sense(SPEC, 5, world, sensors, poses, key), jnp.zeros((15, 3)), jax.random.key(0)
    )
    assert seen["images"].shape == (3, 2, 12, 16, 3) and seen["local_map"].shape == (3, 24, 32)


def test_worlds_come_as_twins_and_every_behaviour_drives(frames):
    part = frames.closed.reshape(-1, DATA.per_world)
    assert part[::2].all() and not part[1::2].any()
    seeds = frames.seed.reshape(-1, 2 * DATA.per_world)
    assert (seeds == seeds[:, :1]).all() and len(np.unique(seeds[:, 0])) == 4
    assert np.bincount(frames.behaviour).tolist() == [2 * DATA.per_world] * 4


def test_the_interior_is_dead_in_the_closed_twin_only(frames):
    assert frames.interior.any()
    assert not (frames.interior & ~frames.valid)[frames.closed].any()
    assert frames.dead_end[frames.closed[:, None, None] & frames.interior].all()
    assert not frames.dead_end[~frames.closed[:, None, None] & frames.interior].any()


def test_robots_stay_out_of_walls(frames):
    for family, seed, closed, pose in zip(frames.family, frames.seed, frames.closed, frames.pose, strict=True):
        name = DATA.families[family]
        scene = worlds.sample(name if closed else worlds.twin(name), int(seed), DATA.split)
        assert worlds.signed_distance(scene.world, pose[None, :2])[0] > 0.25 - 0.03


def test_the_known_map_is_true(frames):
    known, inside = frames.local_map, frames.inside
    free = (known == bev.FREE) & inside
    assert np.mean(frames.traversable[free]) > 0.98
    box = np.ones((1, 3, 3), bool)
    wall = ndimage.binary_dilation(~frames.traversable & inside, box)
    occupied = (known == bev.OCCUPIED) & inside
    assert occupied.any() and np.mean(wall[occupied]) > 0.95
    assert (known[frames.visibility == NEVER] == bev.UNKNOWN).mean() > 0.9
    assert (known[frames.visibility == NOW] != bev.UNKNOWN).all()
    assert not frames.rule_confidence[frames.visibility == NEVER].any()


def test_labels_fit_together(frames):
    assert not (frames.valid & ~frames.inside).any() and not (frames.valid & ~frames.traversable).any()
    assert (frames.depth[frames.valid & ~frames.dead_end] == 0).all()
    assert (frames.recoverability[frames.valid & ~frames.dead_end] == 1).all()
    deep = frames.valid & frames.dead_end & (frames.depth > 0.5)
    assert deep.any() and (frames.recoverability[deep] < 0.9).all()
    np.testing.assert_array_equal(frames.dead_end_flag, ~frames.path.any(axis=1))


def test_strata_are_bits():
    assert STRATUM_BITS == {"drop": 1, "glass": 2, "vegetation": 4}


def test_the_job_names_what_is_wrong(tmp_path):
    with pytest.raises(ValueError, match='"u-open" is no closed family of the split train: choose from .*u'):
        dataset.spec_of(10, "train", 0, ("u-open",))
    with pytest.raises(ValueError, match="split must be one of"):
        dataset.spec_of(10, "all", 0)
    with pytest.raises(ValueError, match="workers must be >= 1"):
        dataset.write(tmp_path, dataset.spec_of(10, "val", 0), workers=0)
    held = set(dataset.families_of("test")) - set(dataset.families_of("train"))
    assert held == set(worlds.HELD_OUT) and len(held) >= 2


def test_the_job_writes_a_dataset_and_its_page(written):
    folder, manifest = written
    assert manifest["frames"] == 44 and [row["frames"] for row in manifest["shards"]] == [44]
    found = dataset.outline(manifest)
    assert sum(found["families"].values()) == 44 and 0 < found["shares"]["dead_end_cells"] < 0.5
    assert "dead end cells" in dataset.table(manifest)
    file = dataset.page(folder)
    assert file is not None and file.stat().st_size > 20_000
