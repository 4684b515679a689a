"""Frames without end: batch s is the same wherever one begins. Gathering itself is `test_gather`'s."""

import threading

import numpy as np
import pytest

from drnav_jax.dataset import gather
from drnav_jax.dataset.frames import Frame, FrameSpec
from drnav_jax.dataset.shards import DatasetSpec
from drnav_jax.dataset.stream import TOGETHER, stream

DATA = DatasetSpec(num_frames=1, split="train", seed=5, families=("t",), num_worlds=24, per_world=1)
SIZE, PER_BATCH = 24, 10
PER_ROUND = TOGETHER * SIZE // PER_BATCH  # batches; what is left over of a round is not used


@pytest.fixture
def asked(monkeypatch):
    """Numbers of the shards that were gathered; a frame is known by (shard, row)."""
    numbers = []

    def shard(data, spec, number):
        assert (data.families, data.seed, data.num_worlds) == (DATA.families, DATA.seed, DATA.num_worlds)
        numbers.append((number, threading.current_thread() is threading.main_thread()))
        rows = np.arange(SIZE, dtype=np.int32)
        fields = dict.fromkeys(Frame._fields, np.zeros(SIZE, np.uint8))
        return Frame(**fields | {"seed": np.full(SIZE, number, np.int32), "family": rows})

    monkeypatch.setattr(gather, "shard", shard)
    return numbers


def taken(count, **how):
    frames = stream(PER_BATCH, DATA, FrameSpec(), **how)
    found = []
    for _ in range(count):
        batch = next(frames)
        assert all(len(field) == PER_BATCH for field in batch)
        found.append(list(zip(batch.seed.tolist(), batch.family.tolist(), strict=True)))
    frames.close()
    return found


@pytest.mark.parametrize("first", [1, PER_ROUND - 1, PER_ROUND, PER_ROUND + 1, 2 * PER_ROUND])
def test_a_batch_is_the_same_wherever_one_begins(asked, first):
    whole = taken(2 * PER_ROUND + 3)
    assert taken(2 * PER_ROUND + 3 - first, first=first) == whole[first:]


def test_no_frame_comes_twice_and_frames_are_shuffled_over_shards(asked):
    batches = taken(2 * PER_ROUND)
    frames = [frame for batch in batches for frame in batch]
    assert len(set(frames)) == len(frames)
    for number in range(2):
        round_ = batches[number * PER_ROUND : (number + 1) * PER_ROUND]
        shards = {shard for batch in round_ for shard, _ in batch}
        assert shards == set(range(number * TOGETHER, (number + 1) * TOGETHER))
        assert all(len({shard for shard, _ in batch}) > 1 for batch in round_)
    orders = [[row for _, row in batches[k * PER_ROUND]] for k in range(2)]
    assert orders[0] != orders[1], "each round is shuffled anew"


def test_it_begins_with_the_round_it_needs_and_reads_one_ahead(asked):
    taken(1, first=3 * PER_ROUND)
    numbers = [number for number, _ in asked]
    assert numbers[:TOGETHER] == list(range(3 * TOGETHER, 4 * TOGETHER))
    assert set(numbers) <= set(range(3 * TOGETHER, 5 * TOGETHER))
    assert not any(main for _, main in asked), "a thread gathers"


def test_who_leaves_waits_for_no_more_than_the_shard_at_hand(monkeypatch):
    numbers, begun, go = [], threading.Event(), threading.Event()

    def shard(data, spec, number):
        numbers.append(number)
        if number >= TOGETHER:
            begun.set()
            assert go.wait(30)
        return Frame(**dict.fromkeys(Frame._fields, np.zeros(SIZE, np.uint8)))

    monkeypatch.setattr(gather, "shard", shard)
    frames = stream(PER_BATCH, DATA, FrameSpec())
    next(frames)
    assert begun.wait(30)
    threading.Timer(0.2, go.set).start()
    frames.close()
    assert numbers == list(range(TOGETHER + 1))


@pytest.mark.parametrize("size", [0, -1, TOGETHER * SIZE + 1])
def test_a_batch_that_no_round_can_hold(asked, size):
    with pytest.raises(ValueError, match=f"batch_size must lie within 1..{TOGETHER * SIZE}"):
        stream(size, DATA)
    assert not asked


def test_what_breaks_a_worker_reaches_the_reader(monkeypatch):
    def broken(*_):
        raise OSError("no space left")

    monkeypatch.setattr(gather, "shard", broken)
    with pytest.raises(OSError, match="no space left"):
        next(stream(PER_BATCH, DATA))
