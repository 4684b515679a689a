"""The closed-loop experiment: which trips it makes, and how it judges drives and beliefs."""

from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from drnav_jax import evaluate
from drnav_jax.filter import FilterParams, FilterSpec, belief, dead_end
from drnav_jax.types import GridMap, GridSpec
from experiments import closed_loop
from experiments.closed_loop import Config

SPEC = FilterSpec(grid=GridSpec(shape=(24, 32), resolution=0.5), num_bearings=8, local_cells=8)


def grid(values, origin=(0.0, 0.0), resolution=1.0):
    return GridMap(np.asarray(values, np.float32), np.asarray(origin, np.float32), np.float32(resolution))


def test_values_are_those_of_the_cells_under_points():
    values = np.arange(6.0).reshape(2, 3)
    where = grid(values, (10.0, -4.0), 2.0)
    points = np.array([[10.1, -3.9], [15.9, -0.1], [12.0, -2.0], [9.9, -3.0], [16.1, -3.0], [11.0, 0.1]])
    np.testing.assert_array_equal(evaluate.values_at(where, values, points, -1.0), [0, 5, 4, -1, -1, -1])


def test_metres_inside_are_those_of_the_steps_that_end_there():
    labels = grid([[0, 0, 1, 1], [0, 0, 1, 0]])
    path = np.array([[0.5, 0.5], [1.5, 0.5], [2.5, 0.5], [3.5, 0.5], [3.5, 1.5], [9.0, 9.0]])
    assert closed_loop.inside(labels, path) == pytest.approx(2.0)
    assert closed_loop.inside(grid(np.zeros((2, 4))), path) == 0.0


def test_alarms_are_counted_on_cells_that_are_known_to_be_free():
    held = belief.init(SPEC, FilterParams(), jnp.zeros(2, jnp.float32))
    low = np.asarray(belief.local_map(SPEC, held).origin)
    at = lambda *cells: low + 0.5 * (np.array(cells)[:, ::-1] + 0.5)  # noqa: E731
    seen = held.seen.at[4, 3:9].set(True)
    occupancy = held.occupancy.at[4, 3:8].set(-1.0).at[4, 8].set(2.0)
    certain = dead_end.log_odds(0.9)
    held = held._replace(seen=seen, occupancy=occupancy, dead_end=held.dead_end.at[4, 5:9].set(certain))
    state = SimpleNamespace(policy=SimpleNamespace(belief=held))
    way = at((4, 3), (4, 4), (4, 5), (4, 8), (20, 20))  # free, free, alarm, occupied, unseen
    dead = at((4, 6), (4, 7), (4, 4), (9, 9))
    beyond = np.array([[500.0, 500.0]])
    counts = closed_loop.alarms([state, state], SPEC, np.concatenate([way, beyond]), dead)
    assert counts.tolist() == [2, 6, 4, 6]
    assert closed_loop.alarms([state], SPEC, way, np.zeros((0, 2))).tolist() == [1, 3, 0, 0]


def test_ratios_are_of_the_means_and_of_the_trips_that_both_solve():
    made = lambda *rows: {"trips": {f"t:{k}": dict(zip(("time_s", "success", "inside_m"), r, strict=True))  # noqa: E731
                                    for k, r in enumerate(rows)}}  # fmt: skip
    ours = made((20.0, True, 1.0), (60.0, False, 0.0), (30.0, True, 0.0))
    theirs = made((40.0, True, 2.0), (30.0, True, 2.0), (30.0, True, 0.0))
    found = closed_loop.against(ours, theirs)
    assert found["time"]["ratio"] == pytest.approx(1.1) and found["time"]["trips"] == 3
    assert found["time_both"]["ratio"] == pytest.approx(5 / 7) and found["time_both"]["trips"] == 2
    assert found["inside"]["ratio"] == pytest.approx(0.25)
    assert closed_loop.against(theirs, made(*[(9.0, False, 0.0)] * 3)) | {"time": 0} == {
        "time": 0, "time_both": None, "inside": None,
    }  # fmt: skip


def test_groups_are_families_in_turn():
    trips = closed_loop.trips_of(Config(trips=3), "u+t@6")
    assert [trip.scene.name.split(":")[0] for trip in trips] == ["u", "t", "u"]
    assert closed_loop.range_of("u+t@6") == 6.0 and len({trip.scene.name for trip in trips}) == 3


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"trips": 0}, "trips must"), ({"groups": ("t+l",)}, "WORLDS@RANGE"), ({"groups": ("t@50",)}, "lidar_range"),
        ({"rows": ("drnav:magic",)}, "no predictor"), ({"rows": ("fly:none",)}, "no planner"), ({"rows": ()}, "rows"),
        ({"groups": ("t+tt@6",)}, '"tt" of the group'), ({"groups": ("../maps/none.yaml@12",)}, "neither a family"),
        ({"split": "all"}, "split must be one of"), ({"weights": Path("none.safetensors")}, "no file of weights"),
    ],
)  # fmt: skip
def test_bad_settings_are_refused(changes, says):
    with pytest.raises(ValueError, match=says):
        Config(**changes)
