import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from drnav_jax.worlds import (
    FAR,
    HEADROOM,
    distance_field,
    from_grid,
    make_world,
    no_field,
    rasterise,
    signed_distance,
    stack_worlds,
)
from drnav_jax.worlds.world import near_distance


def test_distance_field_is_zero_at_the_edge_between_cells():
    occupied = np.zeros((3, 5), bool)
    occupied[:, 3:] = True
    field = distance_field(occupied, 0.2)
    np.testing.assert_allclose(field[1], [0.5, 0.3, 0.1, -0.1, -0.3], atol=1e-6)
    assert field.dtype == np.float32


def test_a_free_grid_is_far_from_everything():
    assert (distance_field(np.zeros((2, 3), bool), 0.1) == FAR).all()


@given(
    yaw=st.floats(-3, 3),
    size=st.tuples(st.floats(0.2, 2), st.floats(0.2, 2)),
    radius=st.floats(0.1, 1.5),
)
def test_signed_distance_agrees_with_points_on_the_surface(yaw, size, radius):
    world = make_world([[0.5, -0.3, yaw, *size, 0, 2]], [[2.5, 1.0, radius, 0, 1]])
    points = np.random.default_rng(0).uniform(-4, 4, (60, 2))
    t = np.linspace(-1, 1, 2001)
    one = np.ones_like(t)
    edges = [np.stack(e, -1) for e in ((t, one), (t, -one), (one, t), (-one, t))]
    local = np.concatenate(edges) * size
    c, s = np.cos(yaw), np.sin(yaw)
    box = local @ np.array([[c, s], [-s, c]]) + [0.5, -0.3]
    disc = radius * np.stack([np.cos(np.pi * t), np.sin(np.pi * t)], -1) + [2.5, 1.0]

    def distance(p, surface):
        return np.linalg.norm(surface - p, axis=1).min()

    def is_inside(p):
        q = np.array([[c, s], [-s, c]]) @ (p - [0.5, -0.3])
        return (np.abs(q) <= size).all(), np.linalg.norm(p - [2.5, 1.0]) <= radius

    signed = []
    for p in points:
        in_box, in_disc = is_inside(p)
        signed.append(
            min(
                distance(p, box) * (-1 if in_box else 1),
                distance(p, disc) * (-1 if in_disc else 1),
            )
        )
    # The surface is sampled every 2 mm.
    np.testing.assert_allclose(signed_distance(world, points), signed, atol=3e-3)


def test_signed_distance_interpolates_a_map():
    occupied = np.zeros((4, 6), bool)
    occupied[:, 4:] = True
    world = from_grid(occupied, (1.0, 2.0), 0.5)
    points = np.array([[1.25, 3.0], [2.0, 3.0], [2.9, 2.6], [3.1, 2.6], [0.0, 0.0]])
    expected = [1.75, 1.0, 0.1, -0.1, 1.75]  # beyond the edge: the value at the edge
    np.testing.assert_allclose(signed_distance(world, points), expected, atol=1e-6)


def test_an_empty_world_is_far_away():
    assert signed_distance(make_world(), np.zeros((2, 2))).tolist() == [FAR, FAR]


def test_rasterise_agrees_with_the_distance_at_cell_centres():
    world = make_world([[1, 2, 0.4, 0.8, 0.3, 0, 2]], [[2.2, 1.1, 0.35, 0, 1]])
    occupied = rasterise(world, (-0.5, 0.2), (30, 40), 0.1)
    y, x = np.mgrid[:30, :40]
    centres = np.stack([-0.5 + (x + 0.5) * 0.1, 0.2 + (y + 0.5) * 0.1], -1).reshape(-1, 2)
    np.testing.assert_array_equal(occupied.ravel(), signed_distance(world, centres) <= 0)


def test_stacked_worlds_meet_nothing_new():
    worlds = [
        make_world([[0, 0, 0, 1, 1, 0, 2]], [[3, 3, 0.5, 0, 1]] * 2),
        make_world([[1, 0, 0, 1, 1, 0, 2]] * 3),
    ]
    batch = stack_worlds(worlds)
    assert batch.boxes.shape == (2, 3, 7) and batch.cylinders.shape == (2, 2, 5)
    points = np.random.default_rng(1).uniform(-5, 5, (50, 2))
    for k, world in enumerate(worlds):
        one = jax.tree.map(lambda a, k=k: a[k], batch)._replace(field=no_field())
        np.testing.assert_allclose(signed_distance(one, points), signed_distance(world, points))


def test_stacked_maps_repeat_their_edge():
    small, large = np.zeros((2, 3), bool), np.ones((4, 5), bool)
    small[0, 0] = large[1, 1] = True
    batch = stack_worlds([from_grid(small, (0.0, 0.0), 0.1), from_grid(large, (1.0, 1.0), 0.2)])
    assert batch.field.values.shape == (2, 4, 5)
    for row in (2, 3):
        np.testing.assert_array_equal(batch.field.values[0, row], batch.field.values[0, 1])
    np.testing.assert_allclose(batch.field.resolution, [0.1, 0.2])


def test_stack_worlds_says_what_does_not_batch():
    with pytest.raises(ValueError, match="at least one"):
        stack_worlds([])
    with pytest.raises(ValueError, match="run them separately"):
        stack_worlds([make_world(), from_grid(np.eye(3, dtype=bool), (0.0, 0.0), 0.1)])


def test_a_lintel_a_robot_passes_under_and_a_low_bar_it_does_not():
    lintel = [[1, 0, 0, 0.5, 0.1, HEADROOM, 2.5]]
    bar = [[1, 0, 0, 0.5, 0.1, HEADROOM - 0.1, 2.5]]
    assert not rasterise(make_world(lintel), (0.0, -1.0), (20, 20), 0.1).any()
    assert signed_distance(make_world(lintel), np.zeros((1, 2))) == FAR
    assert rasterise(make_world(bar), (0.0, -1.0), (20, 20), 0.1).any()
    crown = [[1, 0, 0.5, HEADROOM, 3]]
    assert signed_distance(make_world(cylinders=crown), np.zeros((1, 2))) == FAR


@pytest.mark.parametrize("yaw", [0.0, 0.01, 0.5, np.pi / 2])
@pytest.mark.parametrize("shift", np.linspace(0, 0.1, 5))
def test_a_thin_pane_lets_nobody_through_its_cells(yaw, shift):
    pane = make_world([[shift, shift, yaw, 5.0, 0.01, 0, 2.5]])
    occupied = rasterise(pane, (-2.0, -2.0), (40, 40), 0.1)
    _, parts = ndimage.label(~occupied)  # 4-connected
    assert parts == 2


def test_near_distance_is_the_signed_distance_cut_off():
    boxes = [[3.0, 2.0, 0.4, 1.5, 0.1, 0, 2], [-30.0, 0.0, 0.0, 1.0, 1.0, 0, 2], [1.0, 4.5, 0.0, 40.0, 0.05, 0, 2]]
    walls = np.zeros((12, 9), bool)
    walls[3:5, 2:6] = True
    for field in (None, from_grid(walls, (0.3, 0.2), 0.25).field):
        world = make_world(boxes, [[5.0, 1.0, 0.3, 0, 2]], field)
        origin, shape, r, reach = (-0.7, -1.3), (61, 83), 0.1, 0.8
        x, y = (origin[k] + (np.arange(shape[1 - k]) + 0.5) * r for k in (0, 1))
        points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        full = np.minimum(signed_distance(world, points), reach).reshape(shape)
        np.testing.assert_array_equal(near_distance(world, origin, shape, r, reach), full)
        assert full.min() < -0.05 and (full == reach).any() and (full < reach).any()
