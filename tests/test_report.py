import json

import numpy as np
import pytest

from drnav_jax import report
from drnav_jax.filter import FilterSpec


def test_json_has_no_numbers_that_json_does_not_have():
    text = report.dumps({"a": float("inf"), "b": [1.5, float("nan")], "c": {"d": None}, "e": True})
    assert json.loads(text) == {"a": None, "b": [1.5, None], "c": {"d": None}, "e": True}


def test_ratios_pair_the_trips_that_both_drove():
    times = {
        "ours": {0: (10.0, True), 1: (20.0, True), 2: (30.0, True)},
        "theirs": {0: (20.0, True), 2: (90.0, False), 3: (5.0, True)},
        "none": {},
    }
    found = report.ratios(times)
    assert set(found) == {"ours/theirs", "ours/none"}
    assert found["ours/theirs"]["all"]["ratio"] == pytest.approx(40 / 110, abs=1e-4)
    assert found["ours/theirs"]["all"]["trips"] == 2
    assert found["ours/theirs"]["both_solve"] == {"ratio": 0.5, "low": 0.5, "high": 0.5, "trips": 1}
    assert found["ours/none"] == {"all": None, "both_solve": None}
    assert report.ratios({"alone": {0: (1.0, True)}}) == {}


def test_table_says_what_counts():
    summary = {
        "episodes": 4, "success_rate": 0.75, "collision_rate": 0.25, "time_to_goal_s": 30.0, "optimal_s": 20.0,
        "time_limit_s": 120.0, "spl": 0.5, "recoveries": 1.25, "min_clearance_m": 0.1,
    }  # fmt: skip
    ratio = {"ratio": 0.5, "low": 0.4, "high": 0.6, "trips": 4}
    text = report.table({"a": summary, "b": summary}, {"a/b": {"all": ratio, "both_solve": None}})
    lines = text.splitlines()
    assert lines[2].split() == ["a", "75", "%", "1", "30.0", "s", "1.50", "0.500", "1.2", "0.10", "m"]
    assert len(set(map(len, lines[:4]))) == 1
    assert lines[-1] == "time to goal a / b: 0.500 [0.400, 0.600] (4 trips); no trip was solved by both"
    assert "BARN" not in text
    assert "BARN score" in report.table({"a": summary | {"barn_score": 0.4}})


def test_outcomes_in_words():
    record = {"success": True, "collision": False, "time_s": 12.34}
    assert report.outcome(record) == "reached in 12.3 s"
    assert report.outcome(record | {"success": False}) == "not reached in 12.3 s"
    assert report.outcome(record | {"success": False, "collision": True}) == "collision after 12.3 s"


def test_a_belief_needs_states():
    with pytest.raises(ValueError, match="without states"):
        report.believe([], FilterSpec(), np.zeros((1, 2)), 0.1, 1)
