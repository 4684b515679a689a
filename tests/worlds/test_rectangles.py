"""Rectangles: their union is the grid, nothing more and nothing less, and they are few."""

import hypothesis
import hypothesis.extra.numpy as hnp
import numpy as np
import pytest

from drnav_jax.worlds import distance_field, from_grid, load_map_server, make_world
from drnav_jax.worlds.rectangles import rectangles, wall_boxes


def union(found, shape):
    out = np.zeros(shape, bool)
    for i0, j0, i1, j1 in found:
        assert 0 <= i0 <= i1 < shape[0] and 0 <= j0 <= j1 < shape[1]
        out[i0 : i1 + 1, j0 : j1 + 1] = True
    return out


@hypothesis.settings(max_examples=200)
@hypothesis.given(hnp.arrays(bool, hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=12)))
def test_the_union_is_the_grid(occupied):
    found = rectangles(occupied)
    np.testing.assert_array_equal(union(found, occupied.shape), occupied)
    assert len(found) <= occupied.sum()


@pytest.mark.parametrize(
    ("rows", "least"),
    [
        (["....", "....", "...."], 0),
        (["####", "####"], 1),
        ([".#.", "###", ".#."], 2),  # a cross: its bars overlap
        (["#####", "#...#", "#...#", "#####"], 4),  # a room
        (["#..", "##.", "###"], 3),  # a staircase
        (["##.##", "##.##", ".....", "##.##"], 4),
        (["...#", "..#.", ".#..", "#..."], 4),  # corners only
    ],
)
def test_simple_shapes_take_as_few_as_can_be(rows, least):
    occupied = np.array([[c == "#" for c in row] for row in rows])
    assert len(rectangles(occupied)) == least


def test_a_real_map_becomes_few_boxes(shared_data):
    scene = load_map_server(shared_data / "maps" / "aws_warehouse" / "map.yaml")
    occupied = np.asarray(scene.world.field.values) <= 0
    found = rectangles(occupied)
    np.testing.assert_array_equal(union(found, occupied.shape), occupied)
    assert len(found) < 0.05 * occupied.sum()


def test_boxes_lie_where_the_cells_are():
    occupied = np.zeros((5, 7), bool)
    occupied[1:3, 2:6] = True
    world = from_grid(occupied, (-1.0, 2.0), 0.5)
    np.testing.assert_allclose(wall_boxes(world), [[1.0, 3.0, 0.0, 1.0, 0.5]], atol=1e-6)
    assert wall_boxes(make_world()).shape == (0, 5)
    assert wall_boxes(from_grid(np.zeros((3, 4), bool), (0.0, 0.0), 0.1)).shape == (0, 5)
    assert (distance_field(occupied, 0.5) <= 0).sum() == occupied.sum()  # what `wall_boxes` reads
