import numpy as np
import pytest

from drnav_jax import metrics

TRIP = {
    "world": "w", "success": True, "collision": False, "time": 20.0, "distance": 12.0, "away": 3.0,
    "clearance": 0.123, "recoveries": 2, "shortest": 10.0, "straight": 8.0, "v_max": 2.0, "reference_length": None,
}  # fmt: skip


def record(**changes):
    return metrics.episode(**(TRIP | changes))


def test_an_episode_by_hand():
    assert record() == {
        "world": "w", "success": True, "collision": False, "timeout": False, "time_s": 20.0, "optimal_s": 5.0,
        "distance_m": 12.0, "shortest_m": 10.0, "straight_m": 8.0, "efficiency": 0.6667, "spl": 0.8333,
        "mean_speed_mps": 0.6, "npr": 0.25, "min_clearance_m": 0.123, "recoveries": 2,
    }  # fmt: skip


def test_a_failure_has_no_spl_and_a_shorter_way_no_more_than_one():
    assert record(success=False)["spl"] == 0.0
    assert record(success=False)["timeout"] and not record(success=False, collision=True)["timeout"]
    assert record(distance=9.0)["spl"] == 1.0  # it may stop `goal_tolerance` before the goal


def test_standing_still_divides_by_nothing():
    still = record(distance=0.0, away=0.0, time=0.0, success=False)
    assert (still["npr"], still["mean_speed_mps"]) == (0.0, 0.0)
    assert all(np.isfinite(v) for v in still.values() if isinstance(v, float))


@pytest.mark.parametrize(("time", "score"), [(1.0, 0.5), (10.0, 0.5), (20.0, 0.25), (40.0, 0.125), (90.0, 0.125)])
def test_barn_score(time, score):
    assert record(time=time, reference_length=10.0)["barn_score"] == score  # T_opt = 5 s: within 10 .. 40 s
    assert record(time=time, reference_length=10.0, success=False)["barn_score"] == 0.0


def test_summary_counts_a_failure_as_its_limit():
    records = [record(), record(time=70.0, success=False), record(time=3.0, success=False, collision=True)]
    found = metrics.summary(records, [60.0, 70.0, 110.0])
    assert found["time_to_goal_s"] == pytest.approx((20 + 70 + 110) / 3, abs=1e-3)
    assert found["time_limit_s"] == 80.0
    assert found["time_s"] == 31.0
    rates = [found[f"{name}_rate"] for name in ("success", "collision", "timeout")]
    assert rates == [0.3333, 0.3333, 0.3333]
    assert found["episodes"] == 3 and "barn_score" not in found
    assert metrics.summary([record(reference_length=10.0)], [60.0])["barn_score"] == 0.25
    with pytest.raises(ValueError, match="at least one"):
        metrics.summary([], [])


def test_ratio_of_means_is_paired():
    theirs = np.random.default_rng(0).uniform(10, 200, 40)
    ratio, low, high = metrics.ratio_of_means(0.5 * theirs, theirs)
    assert (ratio, low, high) == pytest.approx((0.5, 0.5, 0.5))  # unpaired, the interval would be wide
    ours = 0.5 * theirs * np.random.default_rng(1).uniform(0.8, 1.2, 40)
    ratio, low, high = metrics.ratio_of_means(ours, theirs)
    assert ratio == pytest.approx(ours.mean() / theirs.mean()) and low < ratio < high < 0.6
    assert metrics.ratio_of_means(ours, theirs) == (ratio, low, high)  # seeded
    for wrong in (np.ones(3), np.ones((40, 1))):
        with pytest.raises(ValueError, match="paired"):
            metrics.ratio_of_means(wrong, theirs)
    with pytest.raises(ValueError, match="paired"):
        metrics.ratio_of_means(np.ones(0), np.ones(0))
