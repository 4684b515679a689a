"""The table of planners, and what it refuses."""

import pytest

from drnav_jax.planning import PLANNERS, Composition, planner


def test_the_table_holds_the_planners_of_the_paper_and_their_rivals():
    assert set(PLANNERS) >= {"drnav", "drnav-straight", "dwa", "grid", "grid+ede"}
    full, straight, dwa, grid, priced = (planner(n) for n in ("drnav", "drnav-straight", "dwa", "grid", "grid+ede"))
    assert full == Composition() and full.generates and full.needs_route and full.exposure and full.risk_in_route
    assert straight.progress == "straight" and not straight.needs_route and straight.exposure
    assert not dwa.generates and not dwa.needs_route and dwa.recovery == "none" and not dwa.exposure
    assert grid.needs_route and not grid.risk_in_route and not grid.exposure and not grid.controls
    assert priced.risk_in_route and not priced.exposure
    assert not any(p.follows for p in (full, straight, dwa, grid, priced))


@pytest.mark.parametrize("tracker", ["dwb", "mppi"])
def test_rivals_exist_with_and_without_a_global_planner(tracker):
    bare, nav2 = planner(tracker), planner(f"nav2-{tracker}")
    for rival in (bare, nav2):
        assert rival.follows and rival.tracker == tracker and rival.path_period == 1.0
        assert not rival.generates and not rival.exposure and not rival.risk_in_route
    assert bare.path == "straight" and not bare.needs_route and bare.recovery == "none"
    assert nav2.path == "route" and nav2.needs_route and nav2.recovery == "nav2"


def test_drnav_can_be_tracked_by_mppi():
    ours = planner("drnav-mppi")
    assert ours.follows and ours.generates and ours.exposure and ours.risk_in_route and ours.recovery == "drnav"


def test_an_unknown_planner_is_named_with_its_alternatives():
    with pytest.raises(ValueError, match='no planner "teb": choose from drnav, drnav-straight, drnav-mppi, dwa, dwb'):
        planner("teb")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"progress": "by air"}, 'progress must be "cost_to_go" or "straight", got "by air"'),
        ({"headings": False}, "set headings=True"),
        ({"tracker": "teb"}, 'tracker must be one of dwa, dwb, mppi, got "teb"'),
        ({"recovery": "spin"}, "recovery must be one of drnav, nav2, none"),
        ({"path": "spline"}, "path must be one of straight, route"),
        ({"tracker": "mppi", "progress": "straight"}, "set progress="),
        ({"path_period": -1.0}, "path_period must be >= 0 s"),
    ],
)
def test_a_composition_that_cannot_be_is_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        Composition(**wrong)
