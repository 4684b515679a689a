"""Shuffled batches of a dataset, read ahead by a worker (grain).

The order is a function of the seed: batch s of the stream is the same whether one begins at batch 0 or at s, which is how
training resumes. Frames are read straight out of the shards, which are never loaded whole.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import safetensors

from drnav_jax.dataset.frames import Frame
from drnav_jax.dataset.shards import read_manifest


class FrameSource:
    """Frames of datasets by number; opens a shard when it is first asked for one of its frames, in each process."""

    def __init__(self, *folders: Path) -> None:
        """Read the manifests.

        Raises:
            ValueError: If a dataset is not complete.
        """
        rows = [(folder / row["file"], row["frames"]) for folder in folders for row in read_manifest(folder)["shards"]]
        self.files = [file for file, _ in rows]
        self.ends = np.cumsum([count for _, count in rows])
        self._open: dict[int, Any] = {}

    def __len__(self) -> int:
        """Number of frames."""
        return int(self.ends[-1])

    def __getitem__(self, index: int) -> Frame:
        """Frame `index`, arrays without a batch axis."""
        number = int(index)
        shard = int(np.searchsorted(self.ends, number, side="right"))
        row = number - (int(self.ends[shard - 1]) if shard else 0)
        if shard not in self._open:
            self._open[shard] = safetensors.safe_open(self.files[shard], framework="numpy")
        held = self._open[shard]
        return Frame(*(np.asarray(held.get_slice(name)[row : row + 1])[0] for name in Frame._fields))

    def __getstate__(self) -> dict[str, Any]:
        """Without the open files, which do not travel to another process."""
        return self.__dict__ | {"_open": {}}


def batches(
    folders: Path | Sequence[Path], batch_size: int, seed: int, *, first: int = 0, epochs: int | None = None,
    workers: int = 1,
) -> Iterator[Frame]:  # fmt: skip
    """Shuffled batches `[B, ...]`, for ever or for some epochs.

    Args:
        folders: A complete dataset, or several as one.
        batch_size: B; what is left over at the end of an epoch goes into the next one.
        seed: Of the order.
        first: Number of the first batch: the stream goes on as if the ones before had been taken.
        epochs: How often every frame comes; None = without end.
        workers: Processes that read ahead; 0 reads in this one.

    Raises:
        ValueError: If a dataset is not complete, or all hold less than one batch.
    """
    import grain  # training only
    from absl import flags

    source = FrameSource(folders) if isinstance(folders, Path) else FrameSource(*folders)
    if not 1 <= batch_size <= len(source):
        raise ValueError(f"batch_size must lie within 1..{len(source)}, the frames of the dataset, got {batch_size}.")
    stream = grain.MapDataset.source(source).seed(seed).shuffle().repeat(epochs).batch(batch_size, drop_remainder=True)
    stream = stream[first:]
    reading = stream.to_iter_dataset(grain.ReadOptions(num_threads=0 if workers else 1, prefetch_buffer_size=1))
    if workers:
        if not flags.FLAGS.is_parsed():  # grain reads absl's flags, which only absl's own `main` parses
            flags.FLAGS.mark_as_parsed()
        reading = reading.mp_prefetch(grain.MultiprocessingOptions(num_workers=workers, per_worker_buffer_size=2))
    return iter(reading)
