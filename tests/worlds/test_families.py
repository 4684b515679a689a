import numpy as np
import pytest
from scipy import ndimage

from drnav_jax.worlds import FAMILIES, sample, shortest_path, signed_distance, trip_cells, twin
from drnav_jax.worlds.families import MARGIN, RANGES, RESOLUTION, SPLITS, TURN
from drnav_jax.worlds.layouts import WAY, _carved

CLEARANCE = 0.4  # R + the planning margin
CLOSED = [name for name in FAMILIES if twin(name) and not name.endswith("-open")]


def seeds(*families):
    return [(f, s, k) for f in families for s, n in (("test", 3), ("train", 2), ("val", 1)) for k in range(n)]


@pytest.mark.parametrize(("family", "split", "seed"), seeds(*FAMILIES))
def test_the_trip_can_be_driven(family, split, seed):
    scene = sample(family, seed, split)
    assert scene.name == f"{family}:{seed}" and scene.outside_is_free
    ends = np.array([scene.start[:2], scene.goal])
    assert signed_distance(scene.world, ends).min() >= CLEARANCE
    # All that clutter leaves of a passage is WAY wide; cells cost a bit of that.
    length, _ = shortest_path(scene, scene.start, scene.goal, WAY / 2 - 0.05)
    shortest, _ = shortest_path(scene, scene.start, scene.goal, CLEARANCE)
    assert 10.0 <= shortest <= length + 0.1 and shortest <= 42.0
    low = np.array(scene.origin)
    high = low + np.array(scene.occupied.shape[::-1]) * RESOLUTION
    assert (ends - low >= MARGIN - RESOLUTION).all() and (high - ends >= MARGIN - RESOLUTION).all()


@pytest.mark.parametrize(("family", "split", "seed"), seeds(*CLOSED))
def test_the_twin_leads_through_the_dead_end(family, split, seed):
    closed, opened = sample(family, seed, split), sample(twin(family), seed, split)
    assert (closed.start, closed.goal, closed.origin) == (opened.start, opened.goal, opened.origin)
    assert closed.occupied.shape == opened.occupied.shape
    plug = closed.occupied & ~opened.occupied
    assert not (opened.occupied & ~closed.occupied).any() and plug.any()

    way_round, path_round = shortest_path(closed, closed.start, closed.goal, CLEARANCE)
    way_through, path_through = shortest_path(opened, opened.start, opened.goal, CLEARANCE)
    assert way_through < way_round - 0.05
    cells = trip_cells(path_through, opened.origin, RESOLUTION)
    at_plug = np.flatnonzero(plug[cells[:, 0], cells[:, 1]])
    assert len(at_plug) > 0

    # The place before the plug is reached in the closed world too, and far off the way round.
    row, col = cells[at_plug[0] - 7]
    pocket = np.array(closed.origin) + (np.array([col, row]) + 0.5) * RESOLUTION
    into, _ = shortest_path(closed, closed.start, pocket, 0.35)
    off = ndimage.distance_transform_edt(~cells_of(closed, path_round))[row, col] * RESOLUTION
    assert into > 5.0 and off > 1.0


def cells_of(scene, path):
    mask = np.zeros(scene.occupied.shape, bool)
    cells = trip_cells(path, scene.origin, RESOLUTION)
    mask[cells[:, 0], cells[:, 1]] = True
    return mask


@pytest.mark.parametrize("family", CLOSED)
def test_all_that_is_free_touches_the_edge(family):
    scene = sample(family, 1)
    parts, count = ndimage.label(~scene.occupied)
    edge = np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]])
    sizes = np.bincount(parts.ravel())[1:] * RESOLUTION**2
    cut_off = [k for k in range(1, count + 1) if k not in edge and sizes[k - 1] > 0.3]
    assert cut_off == []


def test_seed_split_and_family_all_count():
    one = sample("t", 3)
    again = sample("t", 3)
    np.testing.assert_array_equal(one.world.boxes, again.world.boxes)
    np.testing.assert_array_equal(one.occupied, again.occupied)
    for other in (sample("t", 4), sample("t", 3, "train"), sample("t", 3, "val")):
        assert one.start != other.start
    # Both use the training ranges, so only the key tells them apart.
    assert sample("t", 3, "train").start != sample("t", 3, "val").start


def test_test_ranges_are_wider():
    for train, test in [TURN, *(r for family in RANGES.values() for r in family.values())]:
        assert test[0] <= train[0] < train[1] <= test[1] and train != test


def test_worlds_are_turned_and_mirrored():
    headings = [np.subtract(s.goal, s.start[:2]) for s in (sample("corridor", k) for k in range(12))]
    quarters = {int(np.round(np.arctan2(y, x) / (np.pi / 2))) % 4 for x, y in headings}
    assert quarters == {0, 1, 2, 3}


def test_twins():
    assert twin("t") == "t-open" and twin("t-open") == "t"
    assert twin("open") is None and twin("nothing") is None


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="unknown family 'maze'; there are open, u,"):
        sample("maze", 0)
    with pytest.raises(ValueError, match="unknown split 'dev'"):
        sample("t", 0, "dev")
    with pytest.raises(ValueError, match="seed must be >= 0, got -1"):
        sample("t", -1)
    assert SPLITS == ("train", "val", "test")


def test_a_carved_block_is_full_but_for_its_passages():
    block, free = (0.0, 0.0, 10.0, 6.0), [(-1.0, 2.0, 4.0, 3.0), (3.0, 2.0, 4.0, 7.0), (6.0, 1.0, 8.0, 5.0)]
    boxes = _carved(block, free)
    points = np.random.default_rng(0).uniform((0, 0), (10, 6), (2000, 2))
    hollow = np.zeros(len(points), bool)
    for x0, y0, x1, y1 in free:
        hollow |= (points[:, 0] > x0) & (points[:, 0] < x1) & (points[:, 1] > y0) & (points[:, 1] < y1)
    times = sum(
        (np.abs(points[:, 0] - b[0]) < b[3]) & (np.abs(points[:, 1] - b[1]) < b[4]) for b in boxes
    )
    np.testing.assert_array_equal(times, np.where(hollow, 0, 1))
