import numpy as np
import pytest
from reference_sites import check_no_way_around, check_trip_and_truth, check_twins, pockets_by_the_way

from drnav_jax.worlds import Material, sample, shortest_path, twin

SEEDS = [("test", k) for k in range(6)] + [("train", k) for k in range(3)] + [("val", 0)]
BOXES = 260
SAVING = 1.0  # [m] less than from centre to centre: cells are crossed aslant


@pytest.mark.parametrize("family", ["site", "site-open"])
@pytest.mark.parametrize(("split", "seed"), SEEDS)
def test_the_trip_can_be_driven_and_space_is_open(family, split, seed):
    check_trip_and_truth(sample(family, seed, split), BOXES)


@pytest.mark.parametrize(("split", "seed"), SEEDS[::4])
def test_twins_differ_in_ways_through(split, seed):
    closed, opened = sample("site", seed, split), sample("site-open", seed, split)
    check_twins(closed, opened)
    (way, _), (short, path) = (shortest_path(s, s.start, s.goal, 0.33) for s in (closed, opened))
    assert short < way - SAVING and len(path) >= 2


@pytest.mark.parametrize(("split", "seed"), [("test", 1), ("test", 4), ("train", 2)])
def test_dead_ends_lie_along_the_way_and_not_on_it(split, seed):
    length, on, beside = pockets_by_the_way(sample("site", seed, split))
    assert 40 <= length <= 150 and on == 0 and beside >= 3


@pytest.mark.parametrize("seed", range(3))
def test_nobody_walks_around(seed):
    check_no_way_around(sample("site", seed))


def test_a_seed_is_a_world():
    one, again = sample("site", 3), sample("site", 3)
    np.testing.assert_array_equal(one.world.boxes, again.world.boxes)
    np.testing.assert_array_equal(one.world.box_surfaces.colour, again.world.box_surfaces.colour)
    np.testing.assert_array_equal(one.occupied, again.occupied)
    starts = {sample("site", seed, split).start for seed, split in ((3, "test"), (4, "test"), (3, "train"), (3, "val"))}
    assert len(starts) == 4
    assert twin("site") == "site-open" and twin("site-open") == "site"
    assert one.family == "site" and one.closed and one.twin == "site-open:3"


def test_what_one_sensor_cannot_judge_occurs_whether_ways_are_open_or_not():
    for family in ("site", "site-open"):
        found = {m for k in range(10) for m in sample(family, k, "train").world.box_surfaces.material.tolist()}
        assert {Material.GLASS, Material.BUSH, Material.GRASS, Material.DROP, Material.STRIPE, Material.CAR} <= found
