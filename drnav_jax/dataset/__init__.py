"""Training frames: gathered in simulated worlds, written as shards, read as shuffled batches."""

from drnav_jax.dataset.frames import STRATUM_BITS, Frame, FrameSpec
from drnav_jax.dataset.job import families_of, outline, page, spec_of, table, write
from drnav_jax.dataset.loader import FrameSource, batches
from drnav_jax.dataset.shards import DatasetSpec, read_manifest, verify
from drnav_jax.dataset.stream import stream

__all__ = [
    "STRATUM_BITS",
    "DatasetSpec",
    "Frame",
    "FrameSource",
    "FrameSpec",
    "batches",
    "families_of",
    "outline",
    "page",
    "read_manifest",
    "spec_of",
    "stream",
    "table",
    "verify",
    "write",
]
