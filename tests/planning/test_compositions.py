"""The table of planners, and what it refuses."""

import pytest

from drnav_jax.planning import PLANNERS, Composition, planner


def test_the_table_holds_the_planners_of_the_paper_and_their_rivals():
    assert set(PLANNERS) >= {"drnav", "drnav-straight", "dwa", "grid", "grid+ede"}
    full, straight, dwa, grid, priced = (planner(n) for n in ("drnav", "drnav-straight", "dwa", "grid", "grid+ede"))
    assert full == Composition() and full.generates and full.needs_route and full.exposure and full.risk_in_route
    assert straight.progress == "straight" and not straight.needs_route and straight.exposure
    assert not dwa.generates and not dwa.needs_route and not dwa.recovery and not dwa.exposure
    assert grid.needs_route and not grid.risk_in_route and not grid.exposure and not grid.controls
    assert priced.risk_in_route and not priced.exposure


def test_an_unknown_planner_is_named_with_its_alternatives():
    with pytest.raises(ValueError, match='no planner "dwb": choose from drnav, drnav-straight, dwa'):
        planner("dwb")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"progress": "by air"}, 'progress must be "cost_to_go" or "straight", got "by air"'),
        ({"headings": False}, "set headings=True"),
    ],
)
def test_a_composition_that_cannot_be_is_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        Composition(**wrong)
