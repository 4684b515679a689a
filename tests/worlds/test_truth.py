"""Ground truth of whole scenes: against the definition's own words, between twins, and kept in a folder."""

import dataclasses
import os
import shutil

import numpy as np
import pytest
import reference_labels as reference

from drnav_jax import worlds
from drnav_jax.worlds import truth as module
from drnav_jax.worlds.families import MANY
from drnav_jax.worlds.labels import LabelSpec, dead_ends
from drnav_jax.worlds.truth import GroundTruth, TruthSpec, interior, truth

HALF = 1e-3  # relative, of float16


def scene_of(occupied, origin=(2.0, -1.0), resolution=0.1, **fields):
    world = worlds.from_grid(occupied, origin, resolution)
    return worlds.Scene("plan", world, occupied, origin, resolution, **fields)


def tube(is_closed=True, by=1):
    """A corridor of 1.8 m along x, open at one end or at both, `by` times as fine as 0.1 m."""
    grid = np.zeros((60, 80), bool)
    grid[20:22, 20:60] = grid[40:42, 20:60] = True
    grid[20:42, 58:60] |= is_closed
    return grid.repeat(by, 0).repeat(by, 1)


def same(a: GroundTruth, b: GroundTruth):
    for name in GroundTruth._fields:
        for x, y in zip(*(v if name == "pockets" else [v] for v in (getattr(a, name), getattr(b, name))), strict=True):
            np.testing.assert_array_equal(x, y, err_msg=name)
            assert np.asarray(x).dtype == np.asarray(y).dtype, name


def test_equals_its_definition():
    occupied = tube()
    made = truth(scene_of(occupied))
    clearance = reference.clearance(occupied, 0.1)
    labels = dead_ends(occupied, 0.1)
    np.testing.assert_array_equal(made.standable, clearance > 0.25)
    np.testing.assert_array_equal(made.traversable, ~occupied)
    np.testing.assert_allclose(made.clearance, clearance, rtol=HALF)
    core = np.argwhere(labels.label)
    for i, j in np.ndindex(occupied.shape):
        away = np.hypot(*(core - (i, j)).T)
        grown = clearance[i, j] <= 0.25 and away.min() * 0.1 <= 0.25
        assert made.label[i, j] == (labels.label[i, j] or grown)
        if grown:  # a value of one of the nearest cells
            nearest = core[away < away.min() + 1e-6]
            assert made.depth[i, j] in labels.depth[tuple(nearest.T)].astype(np.float16)
        elif labels.label[i, j]:
            assert made.depth[i, j] == labels.depth[i, j].astype(np.float16)
    assert (made.pocket > 0).tolist() == made.label.tolist()
    assert (made.depth[~made.label] == 0).all() and np.isinf(made.gap[~made.label]).all()
    assert made.label[22:40, 40:56].all(), "filled up to the walls"
    assert (made.label | ~made.defined)[22:40, 40:58].all(), "and what is left in corners means nothing"
    assert made.defined[22:40, 40:58].mean() > 0.97 and not made.defined[occupied].any()


@pytest.mark.parametrize(("outside_is_free", "trip", "row"), [(True, False, 3), (False, False, 3), (False, True, 27)])
def test_labels_mean_nothing_where_no_robot_gets(outside_is_free, trip, row):
    """Of a plan that a wall divides, the larger part counts, or the one that the trip is in."""
    grid = np.zeros((30, 40), bool)
    grid[[0, -1]] = grid[:, [0, -1]] = grid[18] = True
    grid[0] = not outside_is_free
    path = np.array([[3.0, 1.4], [5.0, 1.4]]) if trip else None
    made = truth(scene_of(grid, outside_is_free=outside_is_free), trip_path=path)
    assert made.defined[row, 20] and not made.defined[30 - row, 20]
    assert made.standable[25, 20] and made.standable[5, 20]


def test_types_are_small():
    made = truth(scene_of(tube()))
    kinds = [bool, np.float16, np.float16, np.uint16, bool, bool, bool, np.float16]
    assert [value.dtype for value in made[:8]] == kinds


def test_mouth_follows_the_kind_of_world():
    """A mouth of 3.2 m is of interest outdoors, and in a building is none."""
    grid = np.zeros((90, 100), bool)
    grid[20:22, 20:80] = grid[54:56, 20:80] = grid[20:56, 78:80] = True
    assert truth(scene_of(grid)).label.any()
    assert not truth(scene_of(grid, outside_is_free=False)).label.any()
    assert truth(scene_of(grid, outside_is_free=False), TruthSpec(mouth=5.0)).label.any()


def test_trip_into_a_pocket():
    scene = scene_of(tube())
    way = np.array([[2.5, 2.1], [7.4, 2.1]])
    assert truth(scene).label[30, 45] and not truth(scene, trip_path=way).label.any()
    with pytest.raises(ValueError, match="off the grid"):
        truth(scene, trip_path=way + 100.0)


def test_finer_grids_are_made_coarser():
    coarse, fine = truth(scene_of(tube())), truth(scene_of(tube(by=2), resolution=0.05))
    assert fine.label.shape == coarse.label.shape and fine.resolution == 0.1
    both = (coarse.label & fine.label).sum() / (coarse.label | fine.label).sum()
    assert both >= 0.9
    kept = truth(scene_of(tube(by=2), resolution=0.05), TruthSpec(resolution=0.05))
    assert kept.label.shape == (120, 160)


@pytest.mark.parametrize("family", sorted(set(worlds.FAMILIES.values()) - {"open"}))
def test_interior_of_twins(family):
    """What differs is the closed twin's dead end: inside it, and nowhere near start or goal."""
    for seed in range(1 if family in MANY else 2):
        closed, opened = (truth(worlds.sample(f, seed)) for f in (family, f"{family}-open"))
        mask = interior(closed, opened)
        assert mask.any() and closed.label[mask].mean() > 0.95
        assert not (mask & ~(closed.traversable & opened.traversable)).any()
        scene = worlds.sample(family, seed)
        for x, y in (scene.start[:2], scene.goal):
            i, j = int((y - closed.origin[1]) / 0.1), int((x - closed.origin[0]) / 0.1)
            assert not mask[i, j]


def test_interior_needs_one_grid():
    closed = truth(scene_of(tube()))
    for other in (scene_of(tube(), origin=(0.0, 0.0)), scene_of(tube()[:50])):
        with pytest.raises(ValueError, match="share a grid"):
            interior(closed, truth(other))


def test_kept_and_read_again(tmp_path, monkeypatch):
    scene = scene_of(tube())
    made = truth(scene, cache=tmp_path / "new")
    (file,) = (tmp_path / "new").iterdir()
    before = file.stat().st_mtime_ns
    monkeypatch.setattr(module, "_make", None)  # not made again
    same(truth(scene, cache=tmp_path / "new"), made)
    same(truth(dataclasses.replace(scene, name="other"), cache=tmp_path / "new"), made)
    assert file.stat().st_mtime_ns == before


def test_whatever_matters_is_in_the_key(tmp_path):
    scene = scene_of(tube())
    other = tube()
    other[0, 0] = True
    calls = [
        (scene, {}),
        (scene_of(other), {}),
        (scene_of(tube(), origin=(2.0, -1.1)), {}),
        (scene_of(tube(), resolution=0.2), {}),
        (scene_of(tube(), outside_is_free=False), {}),
        (scene, {"spec": TruthSpec(radius=0.3)}),
        (scene, {"spec": TruthSpec(room_area=1.0)}),
        (scene, {"trip_path": np.array([[2.5, 2.1], [7.4, 2.1]])}),
    ]
    for k, (world, arguments) in enumerate(calls, start=1):
        truth(world, cache=tmp_path, **arguments)
        assert len(list(tmp_path.iterdir())) == k


def damaged(file, other, how):
    content = bytearray(file.read_bytes())
    match how:
        case "empty":
            file.write_bytes(b"")
        case "cut off":
            file.write_bytes(content[: len(content) // 2])
        case "a bit flipped":
            content[len(content) // 3] ^= 16
            file.write_bytes(content)
        case "no archive":
            file.write_bytes(b"label" * 1000)
        case "of another world":
            shutil.copy(other, file)
        case "an archive of something else":
            with file.open("wb") as stream:
                np.savez(stream, label=np.zeros(3))
        case "sealed for another world, in this one's name":
            with np.load(other) as archive, file.open("wb") as stream:
                np.savez(stream, **{name: archive[name] for name in archive.files})
        case "values changed":
            with np.load(file) as archive:
                fields = {name: archive[name] for name in archive.files}
            fields["label"] = ~fields["label"]
            with file.open("wb") as stream:
                np.savez(stream, **fields)
        case "pickled":
            with file.open("wb") as stream:
                np.savez(stream, seal=np.array([{}], dtype=object))
        case _:
            raise AssertionError(how)


@pytest.mark.parametrize(
    "how",
    [
        "empty",
        "cut off",
        "a bit flipped",
        "no archive",
        "of another world",
        "an archive of something else",
        "sealed for another world, in this one's name",
        "values changed",
        "pickled",
    ],
)
def test_a_damaged_file_is_made_again(tmp_path, how):
    scene = scene_of(tube())
    made = truth(scene, cache=tmp_path / "a")
    truth(scene_of(tube(is_closed=False)), cache=tmp_path / "b")
    (file,), (other,) = (list((tmp_path / name).iterdir()) for name in "ab")
    damaged(file, other, how)
    same(truth(scene, cache=tmp_path / "a"), made)
    assert module._read(file) is not None, "and the file is whole again"
    assert [f.name for f in (tmp_path / "a").iterdir()] == [file.name]


def test_nothing_is_left_of_a_write_that_fails(tmp_path, monkeypatch):
    def full(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OSError, match="no space"):
        truth(scene_of(tube()), cache=tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"radius": 0.0}, "radius must be > 0 m"),
        ({"mouth": 0.4}, "mouth must be"),
        ({"room_area": -1.0}, "room_area must be >= 0"),
        ({"room_area": np.nan}, "room_area"),
        ({"resolution": 0.0}, "resolution must be > 0 m"),
    ],
)
def test_spec_refuses(changes, rule):
    with pytest.raises(ValueError, match=rule):
        TruthSpec(**changes)


def test_labels_are_those_of_the_case_table():
    """The truth is the label's, cell by cell, wherever a robot's centre may be."""
    for seed in range(3):
        scene = worlds.sample("t", seed, "train")
        made = truth(scene)
        label = dead_ends(scene.occupied, 0.1, LabelSpec()).label
        np.testing.assert_array_equal(made.label & made.standable, label)
