import numpy as np
import pytest
from scipy import ndimage

from drnav_jax.worlds import (
    FAMILIES,
    HELD_OUT,
    RANGES,
    SPLITS,
    Material,
    check_trip,
    sample,
    shortest_path,
    signed_distance,
    trip_cells,
    twin,
)
from drnav_jax.worlds.families import MANY, MARGIN, RESOLUTION
from drnav_jax.worlds.labels import dead_ends
from drnav_jax.worlds.ranges import TURN
from drnav_jax.worlds.solids import WAY, carved

CLEARANCE = 0.4  # R + the planning margin
CLOSED = [name for name in FAMILIES if twin(name) and not name.endswith("-open")]
SINGLE = [name for name in CLOSED if name not in MANY]  # the others have tests of their own


def seeds(*families):
    splits = (("test", 2), ("train", 1))
    each = [(f, s, k) for f in families for s, n in splits for k in range(n) if s == "test" or FAMILIES[f] not in HELD_OUT]
    return [one for one in each if FAMILIES[one[0]] not in MANY]


@pytest.mark.parametrize(("family", "split", "seed"), seeds(*FAMILIES))
def test_the_trip_can_be_driven(family, split, seed):
    scene = sample(family, seed, split)
    assert scene.name == f"{family}:{seed}" and scene.outside_is_free
    ends = np.array([scene.start[:2], scene.goal])
    assert signed_distance(scene.world, ends).min() >= CLEARANCE
    # All that clutter leaves of a passage is WAY wide; cells cost a bit of that.
    length, _ = shortest_path(scene, scene.start, scene.goal, WAY / 2 - 0.05)
    shortest, _ = shortest_path(scene, scene.start, scene.goal, CLEARANCE)
    assert 10.0 <= shortest <= length + 0.1 and shortest <= 45.0
    low = np.array(scene.origin)
    high = low + np.array(scene.occupied.shape[::-1]) * RESOLUTION
    assert (ends - low >= MARGIN - RESOLUTION).all() and (high - ends >= MARGIN - RESOLUTION).all()


@pytest.mark.parametrize(("family", "split", "seed"), seeds(*SINGLE))
def test_the_twin_leads_through_the_dead_end(family, split, seed):
    closed, opened = sample(family, seed, split), sample(twin(family), seed, split)
    assert (closed.start, closed.goal, closed.origin) == (opened.start, opened.goal, opened.origin)
    assert closed.occupied.shape == opened.occupied.shape
    plug = closed.occupied & ~opened.occupied
    assert plug.any()
    elsewhere = ndimage.distance_transform_edt(~plug)[opened.occupied & ~closed.occupied]
    assert (elsewhere * RESOLUTION < 2.5).all()  # a door that stands open is somewhere else

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


@pytest.mark.parametrize("family", SINGLE)
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
    ranges = [TURN, *(r for name, family in RANGES.items() if name not in HELD_OUT for r in family.values())]
    for train, test in ranges:
        assert test[0] <= train[0] <= train[1] <= test[1] and test[0] < test[1]
    assert np.mean([train != test for train, test in ranges]) > 0.9


def test_two_families_are_held_out_of_training():
    assert len(HELD_OUT) >= 2 and set(HELD_OUT) < set(FAMILIES)
    for family in HELD_OUT:
        for name in (family, twin(family)):
            sample(name, 0)
            for split in ("train", "val"):
                with pytest.raises(ValueError, match=f"'{name}' is held out of training.*only \"test\""):
                    sample(name, 0, split)


def test_worlds_are_turned_and_mirrored():
    headings = [np.subtract(s.goal, s.start[:2]) for s in (sample("corridor", k) for k in range(12))]
    quarters = {int(np.round(np.arctan2(y, x) / (np.pi / 2))) % 4 for x, y in headings}
    assert quarters == {0, 1, 2, 3}


def test_twins():
    assert twin("t") == "t-open" and twin("t-open") == "t"
    assert twin("open") is None and twin("nothing") is None


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="unknown family 'nowhere'; there are open, u,"):
        sample("nowhere", 0)
    with pytest.raises(ValueError, match="unknown split 'dev'"):
        sample("t", 0, "dev")
    with pytest.raises(ValueError, match="seed must be >= 0, got -1"):
        sample("t", -1)
    assert SPLITS == ("train", "val", "test")


def test_a_carved_block_is_full_but_for_its_passages():
    block, free = (0.0, 0.0, 10.0, 6.0), [(-1.0, 2.0, 4.0, 3.0), (3.0, 2.0, 4.0, 7.0), (6.0, 1.0, 8.0, 5.0)]
    boxes = carved(block, free)
    points = np.random.default_rng(0).uniform((0, 0), (10, 6), (2000, 2))
    hollow = np.zeros(len(points), bool)
    for x0, y0, x1, y1 in free:
        hollow |= (points[:, 0] > x0) & (points[:, 0] < x1) & (points[:, 1] > y0) & (points[:, 1] < y1)
    times = sum(
        (np.abs(points[:, 0] - b.row[0]) < b.row[3]) & (np.abs(points[:, 1] - b.row[1]) < b.row[4]) for b in boxes
    )
    np.testing.assert_array_equal(times, np.where(hollow, 0, 1))


def solids(scene):
    """Rows with their materials, as a set."""
    world = scene.world
    pairs = ((world.boxes, world.box_surfaces), (world.cylinders, world.cylinder_surfaces))
    return {
        (*np.round(row, 4).tolist(), int(m), *np.round(colour, 4).tolist())
        for rows, looks in pairs
        for row, m, colour in zip(rows, looks.material, looks.colour, strict=True)
    }


@pytest.mark.parametrize("family", CLOSED)
def test_twins_differ_in_nothing_but_the_way_through(family):
    for seed in range(2):
        closed, opened = sample(family, seed), sample(twin(family), seed)
        for a, b in zip(closed.world.scenery, opened.world.scenery, strict=True):
            np.testing.assert_array_equal(a, b)
        mine, yours = solids(closed), solids(opened)
        assert 0 < len(mine ^ yours) < 0.6 * len(mine | yours)
        assert closed.closed and not opened.closed
        assert (closed.twin, opened.twin) == (opened.name, closed.name)
        assert closed.strata == opened.strata and closed.family == family and opened.family == twin(family)


@pytest.mark.slow
@pytest.mark.parametrize("family", SINGLE)
def test_the_closed_way_is_labelled_a_dead_end_and_the_open_one_is_not(family):
    good = 0
    for seed in range(20):
        closed, opened = sample(family, seed), sample(twin(family), seed)
        _, path = shortest_path(opened, opened.start, opened.goal, CLEARANCE)
        cells = trip_cells(path, opened.origin, RESOLUTION)
        plug = closed.occupied & ~opened.occupied
        before = cells[: int(np.argmax(plug[cells[:, 0], cells[:, 1]])) - 7]
        shut, through = (dead_ends(s.occupied, RESOLUTION).label for s in (closed, opened))
        last = tuple(before[-1])
        good += bool(shut[last]) and not through[last]
    assert good >= 19


def test_what_one_sensor_alone_cannot_tell_occurs_in_both_meanings():
    """Glass, plants, paint and lifts stand in open and in closed twins, and not only where the twins differ."""
    for family, material in (
        ("glass", Material.GLASS), ("trail", Material.BUSH), ("trail", Material.GRASS), ("dock", Material.STRIPE),
        ("dock", Material.DROP), ("lobby", Material.METAL), ("cars", Material.CAR),
    ):  # fmt: skip
        both = 0
        for seed in range(5):
            made = [sample(name, seed).world for name in (family, twin(family))]
            every = [np.append(w.box_surfaces.material, w.cylinder_surfaces.material) for w in made]
            count = [(materials == material).sum() for materials in every]
            both += min(count) > 0
        assert both >= 4, (family, material)


def test_worlds_look_different():
    looks = [sample("t", seed).world for seed in range(12)]
    assert len({int(w.box_surfaces.material[0]) for w in looks}) >= 3
    assert len({int(w.scenery.ground_material) for w in looks}) >= 3
    assert 2 <= sum(np.isfinite(w.scenery.ceiling) for w in looks) <= 10
    assert len({round(float(w.scenery.exposure), 3) for w in looks}) == 12
    for w in looks:
        np.testing.assert_allclose(np.linalg.norm(w.scenery.sun), 1.0, atol=1e-5)
        assert ((w.box_surfaces.colour >= 0) & (w.box_surfaces.colour <= 1)).all()


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_a_hundred_trips_can_be_driven(family):
    for seed in range(100 if FAMILIES[family] not in MANY else 20):
        for split in SPLITS if FAMILIES[family] not in HELD_OUT else ("test",):
            check_trip(sample(family, seed, split), 0.25, 0.33)
