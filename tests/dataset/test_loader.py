import itertools

import numpy as np
import pytest

from drnav_jax.dataset import loader, shards
from drnav_jax.dataset.frames import Frame
from drnav_jax.dataset.shards import DatasetSpec

WORLDS, EACH = 16, 32  # of a shard
SHARD = WORLDS * EACH  # frames of a shard, as many as `make` makes
COUNT = SHARD + 9


@pytest.fixture(scope="module")
def folder(tmp_path_factory, make):
    out = tmp_path_factory.mktemp("frames")
    shards.write(out, DatasetSpec(COUNT, "train", 0, ("u", "t"), num_worlds=WORLDS, per_world=EACH), {}, make)
    return out


def seeds(stream, num):
    return [batch.seed.tolist() for batch in itertools.islice(stream, num)]


def test_frames_come_by_number(folder, make):
    source = loader.FrameSource(folder)
    assert len(source) == COUNT
    for number in (0, SHARD - 1, SHARD, COUNT - 1):
        frame, shard = source[number], make(number // SHARD)
        for name, value in zip(Frame._fields, frame, strict=True):
            np.testing.assert_array_equal(value, getattr(shard, name)[number % SHARD])


def test_several_sets_are_one(folder, make, tmp_path):
    spec = DatasetSpec(WORLDS, "train", 1, ("u", "t"), num_worlds=WORLDS, per_world=1)
    shards.write(tmp_path, spec, {}, lambda _: cut(make(3)))
    source = loader.FrameSource(folder, tmp_path)
    assert len(source) == COUNT + WORLDS
    assert source[COUNT].seed == make(3).seed[0] and source[COUNT - 1].seed == make(1).seed[COUNT - 1 - SHARD]
    got = seeds(loader.batches([folder, tmp_path], 11, 0, epochs=1, workers=0), 1000)
    assert set(sum(got, [])) & set(make(3).seed[:WORLDS].tolist())


def cut(frames):
    return Frame(*(np.asarray(field)[:WORLDS] for field in frames))


def test_an_epoch_is_every_frame_once(folder):
    got = seeds(loader.batches(folder, 13, 5, epochs=1, workers=0), 1000)
    flat = sum(got, [])
    assert len(got) == COUNT // 13 and len(set(flat)) == len(flat) and set(flat) <= set(range(COUNT))
    assert flat != sorted(flat)


def test_the_seed_is_the_order_and_any_step_is_a_beginning(folder):
    whole = seeds(loader.batches(folder, 40, 7, workers=0), 30)
    assert seeds(loader.batches(folder, 40, 7, workers=0), 30) == whole
    assert seeds(loader.batches(folder, 40, 8, workers=0), 3) != whole[:3]
    assert seeds(loader.batches(folder, 40, 7, first=17, workers=0), 13) == whole[17:]  # in the second epoch
    assert len(set(sum(whole[:13], []))) == 13 * 40 and whole[13:26] != whole[:13]


def test_a_worker_reads_the_same(folder):
    stream = loader.batches(folder, 40, 7, first=3, workers=1)
    assert seeds(stream, 4) == seeds(loader.batches(folder, 40, 7, first=3, workers=0), 4)
    batch = next(stream)
    assert batch.images.dtype == np.uint8 and batch.images.shape == (40, 2, 3, 4, 3)


@pytest.mark.parametrize("size", [0, COUNT + 1])
def test_a_batch_must_fit(folder, size):
    with pytest.raises(ValueError, match=f"within 1..{COUNT}"):
        loader.batches(folder, size, 0)
