"""Frames without end, gathered while somebody trains on them.

Shards of an endless dataset are gathered one after another, a few at a time, and their frames shuffled together. What
batch s holds is a function of the seed and of s.
"""

import dataclasses
import threading
from collections.abc import Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor

import numpy as np

from drnav_jax.dataset import gather
from drnav_jax.dataset.frames import Frame, FrameSpec
from drnav_jax.dataset.shards import DatasetSpec

TOGETHER = 4  # shards whose frames are shuffled together


def stream(
    batch_size: int, data: DatasetSpec, spec: FrameSpec = FrameSpec(), *, first: int = 0  # noqa: B008 (immutable)
) -> Iterator[Frame]:
    """Batches `[B, ...]` for ever, gathered by a thread that is one round ahead.

    Args:
        batch_size: B.
        data: Worlds; its `num_frames` does not matter.
        spec: Sensors and grid.
        first: Number of the first batch: the stream goes on as if the ones before had been taken.

    Raises:
        ValueError: If a round holds less than one batch.
    """
    if not 1 <= batch_size <= TOGETHER * data.shard_size:
        raise ValueError(f"batch_size must lie within 1..{TOGETHER * data.shard_size}, got {batch_size}.")
    per_round = TOGETHER * data.shard_size // batch_size
    endless = dataclasses.replace(data, num_frames=max(data.num_frames, data.shard_size))

    def made(number: int, left: threading.Event) -> Frame:
        parts = []
        for k in range(TOGETHER):
            if left.is_set():  # nobody reads what would be made
                raise CancelledError
            parts.append(gather.shard(endless, spec, number * TOGETHER + k))
        return Frame(*(np.concatenate(field) for field in zip(*parts, strict=True)))

    def batches() -> Iterator[Frame]:
        number, skip = divmod(first, per_round)
        left = threading.Event()
        with ThreadPoolExecutor(1) as pool:
            try:
                ahead = pool.submit(made, number, left)
                while True:
                    frames, ahead = ahead.result(), pool.submit(made, number + 1, left)
                    rng = np.random.default_rng(np.random.SeedSequence([data.seed, number]))
                    order = rng.permutation(TOGETHER * data.shard_size)
                    for k in range(skip, per_round):
                        chosen = order[k * batch_size : (k + 1) * batch_size]
                        yield Frame(*(np.asarray(field)[chosen] for field in frames))
                    number, skip = number + 1, 0
            finally:
                left.set()  # the shard that is being made is waited for, no other

    return batches()
