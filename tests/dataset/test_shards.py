import dataclasses
import hashlib
import json
import threading

import numpy as np
import pytest
import safetensors.numpy

from drnav_jax.dataset import shards
from drnav_jax.dataset.behaviours import KINDS
from drnav_jax.dataset.frames import Frame, dtypes
from drnav_jax.dataset.shards import DatasetSpec

WORLDS, EACH = 16, 32  # worlds of a shard, frames of a world
SHARD = WORLDS * EACH  # frames of a shard, as many as `make` makes
SPEC = DatasetSpec(
    num_frames=2 * SHARD + 7, split="train", seed=3, families=("u", "t"), num_worlds=WORLDS, per_world=EACH
)  # fmt: skip
SETTINGS = {"camera": "a"}


def content(folder):
    return {f.name: hashlib.sha256(f.read_bytes()).hexdigest() for f in sorted(folder.iterdir())}


def test_what_is_written_is_what_was_made(tmp_path, make):
    seen = []
    manifest = shards.write(tmp_path, SPEC, SETTINGS, make, progress=lambda done, made: seen.append((done, made)))
    assert manifest == shards.read_manifest(tmp_path) and not list(shards.verify(tmp_path))
    assert [row["frames"] for row in manifest["shards"]] == [SHARD, SHARD, 7]
    assert seen[-1] == (SPEC.num_frames, SPEC.num_frames)
    fields = safetensors.numpy.load_file(tmp_path / "shard-00002.safetensors")
    for name, kind in dtypes().items():
        assert fields[name].dtype == kind
        np.testing.assert_array_equal(fields[name], getattr(make(2), name)[:7])


def test_counts_are_those_of_the_frames(tmp_path, make):
    manifest = shards.write(tmp_path, SPEC, SETTINGS, make)
    every = [make(k) for k in range(3)]
    frames = Frame(*(np.concatenate(parts)[: SPEC.num_frames] for parts in zip(*every, strict=True)))
    assert manifest["frames"] == SPEC.num_frames
    assert manifest["counts"]["cells"] == frames.valid.sum()
    assert manifest["counts"]["dead_end_cells"] == (frames.dead_end & frames.valid).sum()
    assert manifest["counts"]["unseen_cells"] == ((frames.visibility == 2) & frames.valid).sum()
    assert manifest["counts"]["open_paths"] == frames.path.sum()
    assert manifest["families"] == {"u": int((frames.family == 0).sum()), "t": int((frames.family == 1).sum())}
    assert sum(manifest["behaviours"].values()) == SPEC.num_frames


@pytest.mark.parametrize("workers", [1, 3])
def test_neither_interruption_nor_workers_change_a_byte(tmp_path, make, workers):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    shards.write(whole, SPEC, SETTINGS, make)

    def breaks(shard):
        if shard == 1:
            raise RuntimeError("the power fails")
        return make(shard)

    with pytest.raises(RuntimeError, match="power"):
        shards.write(cut, SPEC, SETTINGS, breaks, workers=workers)
    with pytest.raises(ValueError, match="unfinished"):
        shards.read_manifest(cut)
    (cut / ".shard-00001.safetensors.99.part").write_bytes(b"half")  # what a kill leaves behind
    made = []
    shards.write(cut, SPEC, SETTINGS, lambda k: made.append(k) or make(k), workers=workers)
    assert 1 in made and 0 not in made
    assert content(cut) == content(whole)


def test_shards_are_made_side_by_side(tmp_path, make):
    meet = threading.Barrier(2, timeout=20)

    def together(shard):
        if shard < 2:
            meet.wait()  # breaks if the other one is not being made
        return make(shard)

    shards.write(tmp_path, SPEC, SETTINGS, together, workers=2)


def test_a_folder_with_something_else_is_left_alone(tmp_path, make):
    shards.write(tmp_path, SPEC, SETTINGS, make)
    before = content(tmp_path)
    for spec, settings, name in (
        (dataclasses.replace(SPEC, split="val"), SETTINGS, "split"),
        (SPEC, {"camera": "b"}, "camera"),
    ):
        with pytest.raises(ValueError, match=f"differs in {name}.*another --out"):
            shards.write(tmp_path, spec, settings, make)
    assert content(tmp_path) == before
    (tmp_path / "plan.json").write_text("{")
    with pytest.raises(ValueError, match="not JSON"):
        shards.write(tmp_path, SPEC, SETTINGS, make)
    (tmp_path / "plan.json").unlink()
    with pytest.raises(ValueError, match="no plan.json"):
        shards.write(tmp_path, SPEC, SETTINGS, make)


def test_damage_is_found(tmp_path, make):
    shards.write(tmp_path, SPEC, SETTINGS, make)
    file = tmp_path / "shard-00001.safetensors"
    whole = file.read_bytes()
    file.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    assert list(shards.verify(tmp_path)) == [file.name]
    file.write_bytes(whole[:-1])
    with pytest.raises(ValueError, match="another size.*delete it"):
        shards.read_manifest(tmp_path)
    manifest = tmp_path / "manifest.json"
    manifest.write_text(manifest.read_text()[:100])
    with pytest.raises(ValueError, match="damaged"):
        shards.read_manifest(tmp_path)
    with pytest.raises(ValueError, match="no dataset"):
        shards.read_manifest(tmp_path / "nowhere")


@pytest.mark.parametrize("broken", ["count", "nan"])
def test_frames_that_cannot_be_are_refused(tmp_path, make, broken):
    def bad(shard):
        frames = make(shard)
        if broken == "count":
            return frames._replace(seed=frames.seed[:5])
        return frames._replace(depth=np.full_like(frames.depth, np.nan))

    with pytest.raises(ValueError, match="seed has 5" if broken == "count" else "depth is not finite"):
        shards.write(tmp_path, SPEC, SETTINGS, bad, workers=1)
    assert not list(tmp_path.glob("*.safetensors"))


def test_pairs_cover_families_and_behaviours_evenly():
    spec = dataclasses.replace(SPEC, num_frames=10**5, seed=1, families=("u", "t", "l"))
    each = [shards.pairs(spec, k) for k in range(12)]
    assert all(len(part) == WORLDS // 2 for part in each)
    assert all([kind for *_, kind in part] == [k for k in KINDS for _ in range(2)] for part in each)
    names = [family for part in each for family, *_ in part]
    assert {names.count(f) for f in spec.families} == {32}
    assert len({seed for part in each for _, seed, _ in part}) == 96  # no world twice
    assert {(family, kind) for part in each for family, _, kind in part} == {(f, k) for f in spec.families for k in KINDS}
    assert shards.pairs(spec, 5) == each[5]
    other = dataclasses.replace(spec, seed=2)
    assert not {s for *_, s, _ in shards.pairs(other, 0)} & {s for part in each for _, s, _ in part}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"num_frames": 0}, "num_frames"), ({"seed": -1}, "seed within"),
        ({"seed": 2147}, "seed within 0..2146"), ({"ticks": 0}, "ticks"),
        ({"num_worlds": 12}, "multiple of 8"),
        ({"split": "all"}, "train, val, test"), ({"families": ()}, "at least one family"),
    ],
)  # fmt: skip
def test_the_spec_is_checked(wrong, message):
    with pytest.raises(ValueError, match=message):
        DatasetSpec(**({"num_frames": 1, "split": "train", "seed": 0, "families": ("u",)} | wrong))


def test_the_manifest_is_plain_json(tmp_path, make):
    shards.write(tmp_path, dataclasses.replace(SPEC, num_frames=3), SETTINGS, make)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert manifest["spec"]["num_frames"] == 3 and manifest["settings"] == SETTINGS
