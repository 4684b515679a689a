"""The experiment on recovery: which trips it makes, and how it judges them."""

import numpy as np
import pytest

from drnav_jax import evaluate
from drnav_jax.evaluate import Setup
from experiments import recovery
from experiments.recovery import Config


@pytest.fixture(scope="module")
def trip(tmp_path_factory):
    config = Config(trips=1, families=("u",), least=0.8, most=3.0)
    return next(filter(None, (recovery.trapped(config, "u", k, tmp_path_factory.mktemp("truth")) for k in range(20))))


def test_trips_start_in_dead_ends_and_lead_out_of_them(trip):
    x, y, _ = trip.trip.scene.start
    true = trip.true
    assert evaluate.values_at(true, true.label, np.array([[x, y]]))[0] and trip.pocket > 0
    assert 0.8 <= trip.depth <= 3.0
    assert evaluate.values_at(true, np.asarray(true.depth), np.array([[x, y]]))[0] == pytest.approx(trip.depth)
    assert not evaluate.values_at(true, true.label, np.array([trip.trip.scene.goal]))[0]


def test_escape_and_entering_again(trip):
    start, goal = np.array(trip.trip.scene.start[:2]), np.array(trip.trip.scene.goal)
    stays = np.repeat(start[None], 30, axis=0)
    assert recovery.judged(trip, stays, 9.0) == {"escaped": False, "escape_s": 9.0, "entered_again": False}
    leaves = np.concatenate([stays, np.repeat(goal[None], 5, axis=0)])
    seen = recovery.judged(trip, leaves, 9.0)
    assert seen["escaped"] and seen["escape_s"] == pytest.approx(3.0) and not seen["entered_again"]
    inside = (np.asarray(trip.true.pocket) == trip.pocket) & (np.asarray(trip.true.depth) > 1.2 * recovery.DEEP)
    i, j = np.argwhere(inside)[0]
    deep = trip.true.origin + (np.array([j, i]) + 0.5) * trip.true.resolution
    again = recovery.judged(trip, np.concatenate([leaves, deep[None]]), 9.0)
    assert again["escaped"] and again["entered_again"] and again["escape_s"] == pytest.approx(3.0)
    off = recovery.judged(trip, np.concatenate([stays[:4], [[1e4, -1e4]]]), 9.0)  # beyond the map is out, too
    assert off["escaped"] and off["escape_s"] == pytest.approx(0.4)


def test_figures_are_those_of_the_trips_that_both_escape():
    made = lambda *times: [  # noqa: E731
        {"world": f"u:{k}", "escaped": t is not None, "escape_s": t if t else 60.0, "entered_again": t == 5.0,
         "success": t is not None, "collision": False, "time_s": 70.0, "recoveries": 1}
        for k, t in enumerate(times)
    ]  # fmt: skip
    ours, theirs = made(1.0, 2.0, None, 5.0), made(2.0, None, 9.0, 14.0)
    found = recovery.against(ours, theirs)
    assert found["trips"] == 2 and found["ratio"] == pytest.approx(6.0 / 16.0)
    assert found["low"] <= found["ratio"] <= found["high"]
    assert recovery.against(made(None), made(1.0)) is None
    summed = recovery.summed(ours)
    assert summed["escape_rate"] == 0.75 and summed["escape_s"] == pytest.approx(8 / 3)
    assert summed["reentry_rate"] == pytest.approx(1 / 3)
    assert summed["not_escaped"] == ["u:2"] and summed["entered_again"] == ["u:3"]


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"trips": 0}, "trips"), ({"least": 3.0, "most": 2.0}, "least"), ({"families": ("u", "u-open")}, "u-open"),
        ({"rows": ("dwa:nowhere",)}, "nowhere"), ({"rows": ("nobody",)}, "nobody"), ({"ablate": "dwa:x"}, "dwa:x|x"),
    ],
)  # fmt: skip
def test_mistakes_are_named(changes, says):
    with pytest.raises(ValueError, match=says):
        Config(**changes)


def test_rows_name_planner_and_recovery():
    setup = recovery.setup_of(Config(lidar_range=6.0), "dwa:nav2")
    assert isinstance(setup, Setup) and (setup.planner, setup.recovery, setup.lidar_range) == ("dwa", "nav2", 6.0)
    assert setup.nav.planner.recovery == "nav2"
    assert recovery.setup_of(Config(), "drnav").recovery is None


def test_too_few_trips_are_an_error(tmp_path, monkeypatch):
    tried = []
    monkeypatch.setattr(recovery, "trapped", lambda config, family, seed, cache: tried.append((family, seed)))
    with pytest.raises(ValueError, match="0 of 1 trips"):
        recovery.gathered(Config(trips=1, families=("u", "t"), out=tmp_path))
    assert len(tried) == len(set(tried)) == 50 and tried[:3] == [("u", 0), ("t", 0), ("u", 1)]
