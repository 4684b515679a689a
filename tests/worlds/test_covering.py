import numpy as np
import pytest

from drnav_jax.worlds.covering import cover


def within(points, rects):
    hit = np.zeros(len(points), bool)
    for x0, y0, x1, y1 in rects:
        hit |= (points[:, 0] > x0) & (points[:, 0] < x1) & (points[:, 1] > y0) & (points[:, 1] < y1)
    return hit


@pytest.mark.parametrize("seed", range(8))
def test_boxes_cover_what_is_solid_and_nothing_else(seed):
    rng = np.random.default_rng(seed)

    def rects(n):
        low, size = rng.uniform(0, (9, 5), (n, 2)), rng.uniform(0.2, 4, (n, 2))
        return [tuple(r) for r in np.concatenate([low, low + size], axis=1)]

    solid, free = rects(7), rects(5)
    points = rng.uniform(-1, (14, 10), (3000, 2))
    expected = within(points, solid) & ~within(points, free)
    np.testing.assert_array_equal(within(points, cover(solid, free)), expected)
    assert 0 < expected.mean() < 1


def test_walls_are_few_boxes():
    crossing = [(0.0, 2.0, 9.0, 2.2), (4.0, 0.0, 4.2, 5.0)]
    assert sorted(cover(crossing)) == sorted(crossing)
    # Two collinear walls that meet are one box; a door makes two of it.
    assert cover([(0.0, 0.0, 3.0, 0.2), (3.0, 0.0, 8.0, 0.2)]) == [(0.0, 0.0, 8.0, 0.2)]
    assert len(cover([(0.0, 0.0, 8.0, 0.2)], [(3.0, 0.0, 4.0, 0.2)])) == 2
    # A room with a door in a block: four sides and the one with the door in two parts.
    assert len(cover([(0.0, 0.0, 9.0, 7.0)], [(2.0, 2.0, 6.0, 5.0), (3.0, 0.0, 4.0, 2.0)])) <= 5
    assert cover([], []) == []
