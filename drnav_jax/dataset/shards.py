"""A dataset on disk: which worlds make which shard, writing that survives a kill, and the manifest.

    DIR/plan.json               what is being written; made first
    DIR/shard-00000.safetensors fields of `Frame`, `[frames, ...]`; written under another name, then renamed
    DIR/manifest.json           hashes, sizes, counts, the format; made last, so that its presence says "complete"

A shard depends on the plan and its number only. What is found complete is kept, what is missing is made, so an
interrupted run goes on where it was and ends in the same bytes.
"""

import dataclasses
import hashlib
import json
import os
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Executor, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy

from drnav_jax.dataset.behaviours import KINDS
from drnav_jax.dataset.frames import Frame, dtypes
from drnav_jax.worlds import SPLITS

FORMAT = 1  # of the files; raise it when a field changes
APART = 1_000_000  # between the world seeds of one dataset and the next
MAX_SEED = 2146  # so that world seeds fit in 32 bits


@dataclasses.dataclass(frozen=True)
class DatasetSpec:
    """What a dataset holds.

    Attributes:
        num_frames: In all.
        split: Of the worlds.
        seed: Of everything that is drawn.
        families: Closed families; each is paired with its open twin.
        ticks: Ticks of 0.1 s from frame to frame.
        num_worlds: Worlds of a shard: pairs of twins, as many pairs to each behaviour.
        per_world: Frames of a world.
        litter: Share of the pairs that are littered (`worlds.litter`).
        charted: Share that are sensed as occupancy grids, littered too.
    """

    num_frames: int
    split: str
    seed: int
    families: tuple[str, ...]
    ticks: int = 12
    num_worlds: int = 48
    per_world: int = 8
    litter: float = 0.0
    charted: float = 0.0

    def __post_init__(self) -> None:
        """Check ranges."""
        if min(self.num_frames, self.ticks, self.per_world) < 1 or not 0 <= self.seed <= MAX_SEED:
            raise ValueError(
                f"num_frames, ticks and per_world must be >= 1 and seed within 0..{MAX_SEED}, got "
                f"{self.num_frames}, {self.ticks}, {self.per_world} and {self.seed}."
            )
        if min(self.litter, self.charted) < 0 or not self.litter + self.charted <= 1:
            raise ValueError(f"litter and charted are shares of at most 1 together, got {self.litter} and {self.charted}.")
        if self.num_worlds < 1 or self.num_worlds % (2 * len(KINDS)):
            raise ValueError(f"num_worlds must be a multiple of {2 * len(KINDS)}, got {self.num_worlds}.")
        if self.split not in SPLITS:
            raise ValueError(f'split must be one of {", ".join(SPLITS)}, got "{self.split}".')
        if not self.families:
            raise ValueError("families must name at least one family of worlds.")

    @property
    def shard_size(self) -> int:
        """Frames of a whole shard."""
        return self.num_worlds * self.per_world

    @property
    def num_shards(self) -> int:
        """Shards; the last one may be short."""
        return -(-self.num_frames // self.shard_size)

    def frames_of(self, shard: int) -> int:
        """Frames that a shard holds."""
        return min(self.shard_size, self.num_frames - shard * self.shard_size)


def pairs(spec: DatasetSpec, shard: int) -> list[tuple[str, int, str]]:
    """(closed family, world seed, behaviour) of the pairs of a shard, those of one behaviour side by side.

    Families come up equally often: pair n of the dataset takes place n of an order that is shuffled anew each round.
    """
    found = []
    per_shard = spec.num_worlds // 2
    for n in range(shard * per_shard, (shard + 1) * per_shard):
        turn, place = divmod(n, len(spec.families))
        order = np.random.default_rng(np.random.SeedSequence([spec.seed, turn])).permutation(len(spec.families))
        kind = KINDS[(n % per_shard) // (per_shard // len(KINDS))]
        found.append((spec.families[order[place]], spec.seed * APART + n, kind))
    return found


def _name(shard: int) -> str:
    return f"shard-{shard:05d}.safetensors"


def _replace(file: Path, content: bytes) -> None:
    """Write a whole file or nothing."""
    part = file.with_name(f".{file.name}.{os.getpid()}.part")
    with part.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    part.replace(file)


def checked(frames: Frame, count: int) -> dict[str, np.ndarray]:
    """The fields in their storage types.

    Raises:
        ValueError: If a field has another number of frames, or is not finite.
    """
    fields = {}
    for name, kind in dtypes().items():
        values = np.asarray(getattr(frames, name))
        if len(values) != count:
            raise ValueError(f"field {name} has {len(values)} frames, not {count}.")
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise ValueError(f"field {name} is not finite.")
        fields[name] = np.ascontiguousarray(values.astype(kind))
    return fields


def write(
    out: Path,
    spec: DatasetSpec,
    settings: dict[str, Any],
    make: Callable[[int], Frame],
    *,
    workers: int = 2,
    pool: Callable[[int], Executor] = ThreadPoolExecutor,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Write what is missing of a dataset; the manifest.

    Args:
        out: Folder; made if need be.
        spec: What to write.
        settings: What else the content depends on (sensors); JSON values.
        make: Number of a shard -> all of its frames (a short last shard is cut off here).
        workers: Shards made side by side; the content does not depend on it.
        pool: Number of workers -> what they are; processes must be able to pickle `make`.
        progress: Called with frames done and frames made in this run.

    Raises:
        ValueError: If the folder holds another dataset, or `make` returns what cannot be stored.
        OSError: If the folder cannot be written to.
    """
    out.mkdir(parents=True, exist_ok=True)
    plan = {"format": FORMAT, "spec": dataclasses.asdict(spec) | {"families": list(spec.families)}, "settings": settings}
    file = out / "plan.json"
    if file.exists():
        _check_plan(file, plan)
    elif any(out.glob("shard-*.safetensors")):
        raise ValueError(f"{out} holds shards but no plan.json, so what they are is not known: choose another --out.")
    else:
        _replace(file, (json.dumps(plan, indent=1, sort_keys=True) + "\n").encode())
    for stale in out.glob(".*.part"):
        stale.unlink(missing_ok=True)
    missing = [k for k in range(spec.num_shards) if not (out / _name(k)).exists()]
    done = spec.num_frames - sum(spec.frames_of(k) for k in missing)
    made = 0

    def keep(shard: int, frames: Frame) -> None:
        nonlocal made
        count = spec.frames_of(shard)
        fields = checked(Frame(*(np.asarray(a)[:count] for a in frames)), count)
        _replace(out / _name(shard), safetensors.numpy.save(fields))
        made += count

    with pool(workers) as crew:
        waiting = iter(missing)
        running = {crew.submit(make, k): k for _, k in zip(range(workers), waiting, strict=False)}
        try:
            while running:
                for task in wait(running, return_when=FIRST_COMPLETED).done:
                    keep(running[task], task.result())
                    del running[task]
                    running |= {crew.submit(make, k): k for _, k in zip(range(1), waiting, strict=False)}
                if progress is not None:
                    progress(done + made, made)
        except BaseException:
            crew.shutdown(cancel_futures=True)  # what is being made is kept, what waits is not begun
            for task, shard in running.items():
                if not task.cancelled() and task.exception() is None:
                    keep(shard, task.result())
            raise
    manifest = _manifest(out, spec, plan)
    _replace(out / "manifest.json", (json.dumps(manifest, indent=1, sort_keys=True) + "\n").encode())
    return manifest


def _check_plan(file: Path, plan: dict[str, Any]) -> None:
    try:
        held = json.loads(file.read_text())
    except ValueError:
        raise ValueError(f"{file} is not JSON: it was not written by `drnav dataset`; choose another --out.") from None
    if held != plan:
        flat = lambda tree: {k: v for part in ("spec", "settings") for k, v in tree.get(part, {}).items()}  # noqa: E731
        old, new = flat(held), flat(plan)
        other = sorted(k for k in old | new if old.get(k) != new.get(k)) or ["format"]
        raise ValueError(
            f"{file.parent} holds another dataset (it differs in {', '.join(other)}): choose another --out, or give the "
            "same flags to go on with it."
        )


def _manifest(out: Path, spec: DatasetSpec, plan: dict[str, Any]) -> dict[str, Any]:
    """Hashes, sizes and counts of what was written."""
    rows, totals = [], np.zeros(len(_COUNTED), np.int64)
    families = np.zeros(len(spec.families), np.int64)
    behaviours = np.zeros(len(KINDS), np.int64)
    for shard in range(spec.num_shards):
        content = (out / _name(shard)).read_bytes()
        fields = safetensors.numpy.load(content)
        rows.append({
            "file": _name(shard), "frames": len(fields["seed"]), "bytes": len(content),
            "sha256": hashlib.sha256(content).hexdigest(),
        })  # fmt: skip
        totals += [int(count(fields)) for count in _COUNTED.values()]
        families += np.bincount(fields["family"], minlength=len(families))
        behaviours += np.bincount(fields["behaviour"], minlength=len(KINDS))
    return plan | {
        "frames": spec.num_frames,
        "shards": rows,
        "counts": dict(zip(_COUNTED, totals.tolist(), strict=True)),
        "families": dict(zip(spec.families, families.tolist(), strict=True)),
        "behaviours": dict(zip(KINDS, behaviours.tolist(), strict=True)),
    }


_COUNTED: dict[str, Callable[[dict[str, np.ndarray]], Any]] = {
    "cells": lambda f: f["valid"].sum(),
    "dead_end_cells": lambda f: (f["dead_end"] & f["valid"]).sum(),
    "interior_cells": lambda f: (f["interior"] & f["valid"]).sum(),
    "unseen_cells": lambda f: ((f["visibility"] == 2) & f["valid"]).sum(),
    "closed_frames": lambda f: f["closed"].sum(),
    "dead_end_frames": lambda f: f["dead_end_flag"].sum(),
    "open_paths": lambda f: f["path"].sum(),
    "stable_paths": lambda f: f["path_stable"].sum(),
}


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a complete dataset.

    Raises:
        ValueError: If there is none, or the files are not those that it names.
    """
    file = folder / "manifest.json"
    if not file.is_file():
        hint = "it is unfinished: run the same `drnav dataset` again" if (folder / "plan.json").exists() else "no dataset"
        raise ValueError(f"{folder}: there is no manifest.json ({hint}).")
    try:
        manifest = json.loads(file.read_text())
        rows = manifest["shards"]
    except (ValueError, KeyError):
        raise ValueError(f"{file} is damaged: delete it and run the same `drnav dataset` again.") from None
    if manifest["format"] != FORMAT:
        raise ValueError(f"{file} has format {manifest['format']}, this version reads {FORMAT}: write it anew.")
    for row in rows:
        shard = folder / row["file"]
        if not shard.is_file() or shard.stat().st_size != row["bytes"]:
            raise ValueError(f"{shard} is missing or has another size: delete it and run the same `drnav dataset` again.")
    return manifest


def verify(folder: Path) -> Iterable[str]:
    """Names of the shards whose hash is not the manifest's."""
    for row in read_manifest(folder)["shards"]:
        if hashlib.sha256((folder / row["file"]).read_bytes()).hexdigest() != row["sha256"]:
            yield row["file"]
