import numpy as np
import pytest

from drnav_jax.worlds import WALL_HEIGHT, sample

# Start, goal, occupied cells, boxes and cylinders before families had materials: figures measured then still hold.
BEFORE = {
    ("open", "test", 0): ((1.867, 2.61, -1.655), (-3.418, -16.248), 290, 4, 2),
    ("u", "train", 3): ((-1.909, 2.212, 2.955), (-23.079, 4.72), 627, 6, 2),
    ("u-open", "test", 1): ((-0.62, -3.719, 0.151), (24.072, -1.59), 647, 5, 1),
    ("corridor", "val", 2): ((-2.156, 2.887, 1.66), (-1.415, 14.488), 3329, 10, 0),
    ("t", "test", 1): ((3.022, 1.002, 2.955), (-16.283, 4.753), 30867, 11, 4),
    ("l-open", "train", 4): ((3.537, 3.868, 1.359), (1.81, 22.134), 23310, 12, 2),
}


@pytest.mark.parametrize(("family", "split", "seed"), BEFORE)
def test_the_first_families_are_where_they_were(family, split, seed):
    scene = sample(family, seed, split)
    start, goal, occupied, boxes, cylinders = BEFORE[family, split, seed]
    np.testing.assert_allclose([*scene.start, *scene.goal], [*start, *goal], atol=1e-3)
    assert (len(scene.world.boxes), len(scene.world.cylinders)) == (boxes, cylinders)
    # Another machine's rounding may move the centre of a cell across an outline.
    assert abs(int(scene.occupied.sum()) - occupied) <= 2
    assert set(scene.world.boxes[:, 5]) == {0.0} and scene.world.boxes[:, 6].max() <= WALL_HEIGHT
