"""The whole job of `drnav dataset`: what to gather, writing it, and what to show of it."""

import dataclasses
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing import connection
from pathlib import Path
from typing import Any

import numpy as np

from drnav_jax import viz, worlds
from drnav_jax.dataset import gather, shards
from drnav_jax.dataset.behaviours import KINDS
from drnav_jax.dataset.frames import FrameSpec
from drnav_jax.dataset.loader import FrameSource
from drnav_jax.dataset.shards import DatasetSpec

PAGE = 14  # frames on the page of samples


def families_of(split: str) -> tuple[str, ...]:
    """Closed families of a split: those held out of training are in `test` only."""
    closed = (name for name, base in worlds.FAMILIES.items() if name == base)
    return tuple(name for name in closed if split == "test" or name not in worlds.HELD_OUT)


def spec_of(
    num_frames: int, split: str, seed: int, families: tuple[str, ...] | None = None, litter: float = 0.0,
    charted: float = 0.0,
) -> DatasetSpec:  # fmt: skip
    """What to gather.

    Args:
        num_frames: In all.
        split: Of the worlds.
        seed: Of all that is drawn.
        families: Closed families; None = all of the split.
        litter: Share of the worlds that are littered.
        charted: Share that are sensed as occupancy grids.

    Raises:
        ValueError: If a family is none of the split's, or a number is out of range.
    """
    known = families_of(split) if split in worlds.SPLITS else ()
    spec = DatasetSpec(num_frames, split, seed, known if families is None else families, litter=litter, charted=charted)
    for name in spec.families:
        if name not in known:
            raise ValueError(f'"{name}" is no closed family of the split {split}: choose from {", ".join(known)}.')
    return spec


def write(
    out: Path,
    data: DatasetSpec,
    spec: FrameSpec = FrameSpec(),  # noqa: B008 (immutable)
    *,
    workers: int = 2,
    prepare: Callable[[], Any] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Gather what is missing of a dataset; its manifest (`shards.write`).

    More than one worker are processes, which import the calling script anew (call this under `if __name__ == "__main__"`)
    and begin with `prepare`.
    """
    if workers < 1:
        raise ValueError(f"workers must be >= 1, got {workers}.")
    settings = {"frames": _plain(dataclasses.asdict(spec))}
    make = partial(gather.shard, data, spec)
    return shards.write(out, data, settings, make, workers=workers, pool=partial(_pool, prepare), progress=progress)


def _pool(prepare: Callable[[], Any] | None, workers: int) -> Executor:
    """Processes, since half of the work is Python's: threads would wait for each other."""
    if workers == 1:
        return ThreadPoolExecutor(1)
    spawn = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(workers, mp_context=spawn, initializer=_begin, initargs=(prepare,))


def _begin(prepare: Callable[[], Any] | None) -> None:
    """A worker: Ctrl-C is heard by the process that it works for, and it does not outlive that one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow, daemon=True).start()
    if prepare is not None:
        prepare()


def _follow() -> None:
    """End with the process that this one works for, however that one ends."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    connection.wait([parent.sentinel])
    os._exit(1)


def _plain(tree: Any) -> Any:
    """As JSON gives it back: tuples are lists there."""
    if isinstance(tree, dict):
        return {name: _plain(value) for name, value in tree.items()}
    return [_plain(value) for value in tree] if isinstance(tree, list | tuple) else tree


def outline(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """What is worth printing of a manifest: counts, shares, families, size."""
    counts, frames = manifest["counts"], manifest["frames"]
    return {
        "frames": frames,
        "shards": len(manifest["shards"]),
        "bytes": sum(row["bytes"] for row in manifest["shards"]),
        "shares": {
            "dead_end_cells": counts["dead_end_cells"] / max(counts["cells"], 1),
            "interior_cells": counts["interior_cells"] / max(counts["cells"], 1),
            "unseen_cells": counts["unseen_cells"] / max(counts["cells"], 1),
            "closed_frames": counts["closed_frames"] / frames,
            "dead_end_frames": counts["dead_end_frames"] / frames,
            "open_paths": counts["open_paths"] / (3 * frames),
            "stable_paths": counts["stable_paths"] / (3 * frames),
        },
        "families": manifest["families"],
        "behaviours": manifest["behaviours"],
    }


def table(manifest: Mapping[str, Any]) -> str:
    """Readable text of `outline`."""
    found = outline(manifest)
    rows = [("frames", f"{found['frames']:,} in {found['shards']} shards, {found['bytes'] / 1e6:,.0f} MB")]
    rows += [(name.replace("_", " "), f"{100 * share:.1f} %") for name, share in found["shares"].items()]
    rows += [(f"family {name}", f"{count:,}") for name, count in found["families"].items()]
    rows += [(f"behaviour {name}", f"{count:,}") for name, count in found["behaviours"].items()]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {text:>12}" for name, text in rows)


def page(folder: Path, seed: int = 0) -> Path | None:
    """A page of random frames of a dataset, `samples.png` in its folder; None without the `viz` extra."""
    source = FrameSource(folder)
    names = shards.read_manifest(folder)["spec"]["families"]
    chosen = np.sort(np.random.default_rng(seed).permutation(len(source))[:PAGE])
    rows = []
    for number in chosen:
        frame = source[int(number)]
        variant = "" if frame.closed or worlds.twin(names[frame.family]) is None else "-open"
        title = f"{names[frame.family]}{variant}:{frame.seed}, {KINDS[frame.behaviour]}"
        rows.append(frame._asdict() | {"title": title + (", dead end" if frame.dead_end_flag else "")})
    try:
        return viz.samples(folder / "samples.png", rows)
    except viz.MissingExtra:
        return None
