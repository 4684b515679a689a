import numpy as np
import pytest
from reference_sites import check_no_way_around, check_trip_and_truth, check_twins, pockets_by_the_way

from drnav_jax.worlds import sample, shortest_path, twin

SEEDS = [("test", k) for k in range(6)] + [("train", k) for k in range(3)] + [("val", 0)]
BOXES = 80
SAVING = 1.5  # [m] two cells less what corners cut


@pytest.mark.parametrize("family", ["maze", "maze-open"])
@pytest.mark.parametrize(("split", "seed"), SEEDS)
def test_the_trip_can_be_driven_and_space_is_open(family, split, seed):
    check_trip_and_truth(sample(family, seed, split), BOXES)


@pytest.mark.parametrize(("split", "seed"), SEEDS[::4])
def test_twins_differ_in_ways_through(split, seed):
    closed, opened = sample("maze", seed, split), sample("maze-open", seed, split)
    check_twins(closed, opened)
    (way, _), (short, path) = (shortest_path(s, s.start, s.goal, 0.33) for s in (closed, opened))
    assert short < way - SAVING and len(path) >= 2


@pytest.mark.parametrize(("split", "seed"), [("test", 1), ("test", 4), ("train", 2)])
def test_dead_ends_lie_along_the_way_and_not_on_it(split, seed):
    length, on, beside = pockets_by_the_way(sample("maze", seed, split))
    assert 18 <= length <= 140 and on == 0 and beside >= 2


@pytest.mark.parametrize("seed", range(3))
def test_nobody_walks_around(seed):
    check_no_way_around(sample("maze", seed))


def test_a_seed_is_a_world():
    one, again = sample("maze", 3), sample("maze", 3)
    np.testing.assert_array_equal(one.world.boxes, again.world.boxes)
    np.testing.assert_array_equal(one.world.box_surfaces.colour, again.world.box_surfaces.colour)
    np.testing.assert_array_equal(one.occupied, again.occupied)
    starts = {sample("maze", seed, split).start for seed, split in ((3, "test"), (4, "test"), (3, "train"), (3, "val"))}
    assert len(starts) == 4
    assert twin("maze") == "maze-open" and twin("maze-open") == "maze"
    assert one.family == "maze" and one.closed and one.twin == "maze-open:3"
