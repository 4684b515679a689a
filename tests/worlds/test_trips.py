import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drnav_jax.types import GridMap
from drnav_jax.worlds import (
    Scene,
    check_trip,
    from_grid,
    make_world,
    rasterise,
    sample_trips,
    shortest_path,
    signed_distance,
    trip_cells,
)

ACCURACY = 0.01  # what shortest_path promises


def grid_of(occupied, resolution=0.1):
    return GridMap(values=occupied, origin=np.zeros(2), resolution=resolution)


def scene_of(occupied, resolution=0.1, **fields):
    return Scene(
        name="plan",
        world=from_grid(occupied, (0.0, 0.0), resolution),
        occupied=occupied,
        origin=(0.0, 0.0),
        resolution=resolution,
        outside_is_free=False,
        **fields,
    )


def around(start, goal, left, right, top, c):
    """Length of the way over a wall [left, right] x (-inf, top] at clearance c."""
    length = right - left
    for end, corner in ((start, left - start[0]), (goal, goal[0] - right)):
        far = math.hypot(corner, top - end[1])
        up = math.atan2(top - end[1], corner) + math.asin(c / far)  # of the tangent
        length += math.sqrt(far * far - c * c) + c * up
    return length


@pytest.mark.parametrize("clearance", [0.25, 0.4, 0.8])
@pytest.mark.parametrize(
    ("start", "goal"), [((5.0, 2.0), (18.0, 2.0)), ((9.0, 3.0), (14.0, 3.0)), ((2.0, 11.0), (20.03, 6.06))]
)
def test_path_around_a_wall_is_the_taut_string(start, goal, clearance):
    occupied = np.zeros((160, 230), bool)
    occupied[:120, 100:130] = True
    length, path = shortest_path(grid_of(occupied), start, goal, clearance)
    exact = around(start, goal, 10.0, 13.0, 12.0, clearance)
    assert exact * (1 - 2e-3) <= length <= exact * (1 + ACCURACY)
    assert path[0].tolist() == list(start) and path[-1].tolist() == list(goal)
    assert length == pytest.approx(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def test_path_around_a_cylinder_keeps_the_exact_clearance():
    world = make_world(cylinders=[[5, 5, 1, 0, 2]])
    occupied = rasterise(world, (0.0, 0.0), (100, 100), 0.1)
    scene = Scene("pillar", world, occupied, (0.0, 0.0), 0.1)
    length, path = shortest_path(scene, (1.0, 5.0), (9.0, 5.0), 0.4)
    r = 1.4
    exact = 2 * math.sqrt(16 - r * r) + r * (math.pi - 2 * math.acos(r / 4))
    assert exact * (1 - 2e-3) <= length <= exact * (1 + ACCURACY)
    dense = np.concatenate([np.linspace(a, b, 50) for a, b in zip(path[:-1], path[1:], strict=True)])
    # A chord of the field's interpolation may cut 5 mm off a circle of this size.
    assert signed_distance(world, dense).min() >= 0.4 - 5e-3


@given(st.floats(0, 2 * math.pi))
def test_path_in_the_open_is_straight(angle):
    start = np.array([6.0, 6.0])
    goal = start + 4.5 * np.array([math.cos(angle), math.sin(angle)])
    length, path = shortest_path(OPEN, start, goal, 0.3)
    assert length == pytest.approx(4.5) and len(path) == 2


OPEN = grid_of(np.zeros((120, 120), bool))


def test_a_gap_opens_at_its_width():
    occupied = np.zeros((60, 80), bool)
    occupied[:, 40] = True
    occupied[25:33, 40] = False  # 0.8 m
    grid, ends = grid_of(occupied), ((1.0, 3.0), (7.0, 3.0))
    assert shortest_path(grid, *ends, 0.34) is not None
    assert shortest_path(grid, *ends, 0.41) is None


def test_no_path_out_of_walls_or_off_the_grid():
    occupied = np.zeros((50, 50), bool)
    occupied[20:30, 20:30] = True
    grid = grid_of(occupied)
    assert shortest_path(grid, (2.5, 2.5), (1.0, 1.0), 0.2) is None
    assert shortest_path(grid, (1.0, 1.0), (9.0, 1.0), 0.2) is None


def test_fine_maps_are_searched_coarsely_at_the_same_clearance():
    occupied = np.zeros((600, 1000), bool)  # 0.02 m
    occupied[:400, 480:520] = True
    length, _ = shortest_path(grid_of(occupied, 0.02), (2.0, 2.0), (18.0, 2.0), 0.4)
    exact = around((2.0, 2.0), (18.0, 2.0), 9.6, 10.4, 8.0, 0.4)
    assert exact * (1 - 2e-3) <= length <= exact * (1 + ACCURACY)


def test_corners_are_not_cut_on_coarse_maps():
    occupied = np.eye(12, dtype=bool)  # a diagonal wall that only corners hold together
    assert shortest_path(grid_of(occupied, 1.0), (8.5, 2.5), (2.5, 8.5), 0.3) is None


def test_bad_arguments_are_named():
    with pytest.raises(ValueError, match="clearance_radius"):
        shortest_path(OPEN, (1.0, 1.0), (2.0, 2.0), -0.1)
    with pytest.raises(ValueError, match="bool"):
        shortest_path(grid_of(np.zeros((5, 5))), (0.1, 0.1), (0.2, 0.2), 0.0)


def test_a_map_that_was_written_to_is_searched_anew():
    occupied = np.zeros((50, 50), bool)
    grid, ends = grid_of(occupied), ((1.0, 1.0), (4.0, 1.0))
    assert shortest_path(grid, *ends, 0.2)[0] == pytest.approx(3.0)
    occupied[:, 25] = True
    assert shortest_path(grid, *ends, 0.2) is None


def rooms():
    """Two rooms with a door; the right one is the smaller."""
    occupied = np.zeros((80, 140), bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    occupied[:, 90] = True
    occupied[20:32, 90] = False
    return occupied


def test_trips_are_free_far_apart_and_reproducible():
    scene = scene_of(rooms(), reference_length=3.0)
    trips = sample_trips(scene, 12, seed=3, clearance_radius=0.35, min_length=6.0)
    assert [t.name for t in trips] == [f"plan#{k}" for k in range(12)]
    for trip in trips:
        length, path = check_trip(trip, 0.25, 0.35)
        assert length >= 6.0 and trip.reference_length is None
        ends = np.array([trip.start[:2], trip.goal])
        assert signed_distance(trip.world, ends).min() >= 0.35 - 1e-6
        assert np.allclose(path[[0, -1]], ends)
    again = sample_trips(scene, 12, seed=3, clearance_radius=0.35, min_length=6.0)
    assert [t.start for t in again] == [t.start for t in trips]
    other = sample_trips(scene, 12, seed=4, clearance_radius=0.35, min_length=6.0)
    assert [t.start for t in other] != [t.start for t in trips]


def test_trips_that_do_not_exist_are_refused():
    scene = scene_of(rooms())
    with pytest.raises(ValueError, match="found 0 of 2 trips"):
        sample_trips(scene, 2, 0, 0.3, min_length=60.0)
    with pytest.raises(ValueError, match="lower the clearance"):
        sample_trips(scene, 2, 0, 30.0)
    with pytest.raises(ValueError, match="seed must be >= 0"):
        sample_trips(scene, 2, -1, 0.3)
    with pytest.raises(ValueError, match="min_length"):
        sample_trips(scene, 2, 0, 0.3, min_length=math.nan)


def test_check_trip_says_where_and_what_to_do():
    occupied = rooms()
    scene = scene_of(occupied)

    def trip(start, goal):
        return dataclasses.replace(scene, start=(*start, 0.0), goal=goal)

    with pytest.raises(ValueError, match="sample_trips"):
        check_trip(scene, 0.25)
    with pytest.raises(ValueError, match=r"start \(9\.05, 5\.00\) is in an obstacle.*nearest place"):
        check_trip(trip((9.05, 5.0), (2.0, 2.0)), 0.25)
    with pytest.raises(ValueError, match=r"goal \(0\.25, 5\.00\) is 0\.15 m from an obstacle"):
        check_trip(trip((3.0, 5.0), (0.25, 5.0)), 0.25)
    with pytest.raises(ValueError, match=r"goal \(20\.00, 5\.00\) is off the map"):
        check_trip(trip((3.0, 5.0), (20.0, 5.0)), 0.25)
    with pytest.raises(ValueError, match="finite"):
        check_trip(trip((math.nan, 5.0), (2.0, 2.0)), 0.25)
    occupied[:, 90] = True
    with pytest.raises(ValueError, match=r"no way from \(3\.00, 5\.00\) to \(11\.00, 5\.00\)"):
        check_trip(
            dataclasses.replace(scene_of(occupied), start=(3.0, 5.0, 0.0), goal=(11.0, 5.0)), 0.25
        )


@given(st.lists(st.tuples(st.floats(0, 6), st.floats(0, 4)), min_size=1, max_size=5))
def test_trip_cells_are_all_that_dense_samples_meet(corners):
    path = np.array(corners)
    cells = trip_cells(path, (0.0, 0.0), 0.5)
    steps = [np.linspace(a, b, 400) for a, b in zip(path[:-1], path[1:], strict=True)]
    dense = np.concatenate([path, *steps])
    # Samples that lie on a grid line to rounding belong to either side.
    inner = np.abs(dense / 0.5 - np.rint(dense / 0.5)).min(axis=1) > 1e-9
    met = {tuple(c) for c in np.floor(dense[inner] / 0.5).astype(int)[:, ::-1]}
    found = {tuple(c) for c in cells}
    assert met <= found
    assert len(found) == len(cells)
    steps = np.abs(np.diff(cells, axis=0)).max(axis=1) if len(path) == 2 else np.zeros(1)
    assert steps.max(initial=0) <= 1  # one segment: each cell touches the one before


def test_trip_cells_of_a_known_line():
    cells = trip_cells(np.array([[1.05, 2.05], [1.37, 2.15]]), (1.0, 2.0), 0.1)
    assert cells.tolist() == [[0, 0], [0, 1], [0, 2], [1, 2], [1, 3]]
    assert cells.dtype == np.int64


@pytest.mark.parametrize(("name", "clearance"), [("willow", 0.35), ("nav2", 0.4)])
def test_trips_on_a_real_map(shared_data, name, clearance):
    from drnav_jax.worlds import load_map_server

    file = sorted((shared_data / "maps" / name).glob("*.yaml"))[0]
    for trip in sample_trips(load_map_server(file), 3, 0, clearance, min_length=12.0):
        assert check_trip(trip, 0.25, clearance)[0] >= 12.0
