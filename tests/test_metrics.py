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
    with np.errstate(all="raise"):  # half of the samples hold none of theirs
        one = metrics.ratio_of_means(np.ones(20), np.eye(20)[0])
    assert one[0] == 20 and 0 < one[1] < 20 and one[2] == np.inf
    for wrong in (np.ones(3), np.ones((40, 1))):
        with pytest.raises(ValueError, match="paired"):
            metrics.ratio_of_means(wrong, theirs)
    with pytest.raises(ValueError, match="paired"):
        metrics.ratio_of_means(np.ones(0), np.ones(0))


def scored(seed, ties=True, count=60):
    """Scores and truths; with ties between and within both kinds."""
    rng = np.random.default_rng(seed)
    truth = rng.random(count) < 0.3
    scores = np.clip(rng.normal(size=count) * 0.3 + 0.2 * truth + 0.4, 0, 1)
    return (np.round(scores, 1) if ties else scores), truth


@pytest.mark.parametrize("ties", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_auroc_is_the_share_of_pairs_in_the_right_order(seed, ties):
    scores, truth = scored(seed, ties)
    pairs = [(a > b) + 0.5 * (a == b) for a in scores[truth] for b in scores[~truth]]
    assert metrics.auroc(scores, truth) == pytest.approx(np.mean(pairs), abs=1e-12)
    assert metrics.auroc(scores.reshape(6, 10), truth.reshape(6, 10)) == metrics.auroc(scores, truth)
    assert metrics.auroc(-scores, truth) == pytest.approx(1 - np.mean(pairs), abs=1e-12)


@pytest.mark.parametrize("ties", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_average_precision_sums_over_thresholds(seed, ties):
    """Taken at each distinct score: precision there, times the recall gained since the one above."""
    scores, truth = scored(seed, ties)
    area, before = 0.0, 0.0
    for threshold in sorted(set(scores), reverse=True):
        said = scores >= threshold
        precision, recall = (said & truth).sum() / said.sum(), (said & truth).sum() / truth.sum()
        area, before = area + precision * (recall - before), recall
    assert metrics.average_precision(scores, truth) == pytest.approx(area, abs=1e-12)
    order = np.random.default_rng(9).permutation(len(scores))
    assert metrics.average_precision(scores[order], truth[order]) == pytest.approx(area, abs=1e-12)


@pytest.mark.parametrize("bins", [1, 7, 15])
def test_calibration_error_is_that_of_a_loop_over_bins(bins):
    rng = np.random.default_rng(0)
    p = np.concatenate([rng.random(200), [0.0, 1.0, 1.0, 0.5]])
    truth = np.concatenate([rng.random(200) < p[:200] ** 2, [False, True, False, True]])
    total = 0.0
    for k in range(bins):
        low, high = k / bins, (k + 1) / bins
        inside = (p >= low) & ((p < high) | (k == bins - 1))  # 1 belongs to the last
        if inside.any():
            total += inside.sum() * abs(p[inside].mean() - truth[inside].mean())
    assert metrics.calibration_error(p, truth, bins) == pytest.approx(total / len(p), abs=1e-12)


def test_a_calibrated_judge_has_no_error_and_a_sure_and_wrong_one_has_the_largest():
    p = np.repeat([0.25, 0.75], 400)
    truth = np.concatenate([np.arange(400) < 100, np.arange(400) < 300])
    assert metrics.calibration_error(p, truth) == pytest.approx(0.0, abs=1e-12)
    assert metrics.calibration_error(1.0 - truth, truth) == 1.0


@pytest.mark.parametrize("seed", range(3))
def test_f1_and_balanced_accuracy_from_counts(seed):
    rng = np.random.default_rng(seed)
    said, truth = rng.random((5, 8)) < 0.4, rng.random((5, 8)) < 0.3
    table = {(a, b): 0 for a in (0, 1) for b in (0, 1)}
    for a, b in zip(said.ravel(), truth.ravel(), strict=True):
        table[int(a), int(b)] += 1
    precision, recall = table[1, 1] / (table[1, 1] + table[1, 0]), table[1, 1] / (table[1, 1] + table[0, 1])
    assert metrics.f1(said, truth) == pytest.approx(2 * precision * recall / (precision + recall))
    specificity = table[0, 0] / (table[0, 0] + table[1, 0])
    assert metrics.balanced_accuracy(said, truth) == pytest.approx((recall + specificity) / 2)


@pytest.mark.parametrize("truth", [np.ones(4, bool), np.zeros(4, bool), np.zeros(0, bool)])
def test_one_kind_alone_has_no_auroc_and_no_balanced_accuracy(truth):
    scores = np.linspace(0, 1, truth.size)
    assert np.isnan(metrics.auroc(scores, truth)) and np.isnan(metrics.balanced_accuracy(scores > 0.5, truth))


def test_other_degenerate_inputs():
    none, all_ = np.zeros(4, bool), np.ones(4, bool)
    scores = np.array([0.1, 0.4, 0.4, 0.9])
    assert np.isnan(metrics.average_precision(scores, none)) and metrics.average_precision(scores, all_) == 1.0
    assert np.isnan(metrics.f1(none, none)) and metrics.f1(none, all_) == 0.0 and metrics.f1(all_, all_) == 1.0
    assert np.isnan(metrics.calibration_error(np.zeros(0), np.zeros(0, bool)))
    flat = np.full(4, 0.5)  # who says the same of all
    assert metrics.auroc(flat, scores > 0.3) == 0.5 and metrics.average_precision(flat, scores > 0.3) == 0.75
    for measure in (metrics.auroc, metrics.average_precision, metrics.calibration_error):
        with pytest.raises(ValueError, match="one shape"):
            measure(scores, np.zeros(3, bool))
