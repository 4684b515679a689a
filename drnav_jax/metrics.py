"""Figures of merit of episodes (paper, section V-A; Anderson et al. 2018 for SPL; BARN for its score) and of detection.

efficiency = success * straight-line distance / distance driven
SPL        = success * shortest / max(shortest, distance driven)
NPR        = distance moved away from the goal / distance driven
BARN       = success * T_opt / clip(T, 2 T_opt, 8 T_opt),  T_opt = reference length / 2 m/s
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

BARN_SPEED = 2.0  # [m/s] of the BARN protocol


def episode(
    *, world: str, success: bool, collision: bool, time: float, distance: float, away: float, clearance: float,
    recoveries: int, shortest: float, straight: float, v_max: float, reference_length: float | None,
) -> dict[str, Any]:  # fmt: skip
    """The record of one finished episode, as `drnav run --json` prints it.

    Args:
        world: Name of the world.
        success: The goal was reached.
        collision: The footprint met an obstacle.
        time: Until it ended [s].
        distance: Driven [m].
        away: Driven away from the goal [m].
        clearance: Least distance between footprint and obstacles [m].
        recoveries: How often recovery began.
        shortest: Length of the shortest way at the planning margin [m].
        straight: Straight-line distance from start to goal [m].
        v_max: Fastest speed [m/s].
        reference_length: Length of the source's own reference path [m]; adds `barn_score`.
    """
    driven = max(distance, 1e-9)
    record: dict[str, Any] = {
        "world": world,
        "success": bool(success),
        "collision": bool(collision),
        "timeout": bool(not success and not collision),
        "time_s": round(time, 3),
        "optimal_s": round(shortest / v_max, 3),
        "distance_m": round(distance, 3),
        "shortest_m": round(shortest, 3),
        "straight_m": round(straight, 3),
        "efficiency": round(min(straight / driven, 1.0), 4) if success else 0.0,
        "spl": round(shortest / max(shortest, distance), 4) if success else 0.0,
        "mean_speed_mps": round(distance / time, 4) if time > 0 else 0.0,
        "npr": round(away / driven, 4) if distance > 0 else 0.0,
        "min_clearance_m": round(clearance, 4),
        "recoveries": int(recoveries),
    }
    if reference_length is not None:
        optimal = reference_length / BARN_SPEED
        score = optimal / float(np.clip(time, 2 * optimal, 8 * optimal)) if success else 0.0
        record["barn_score"] = round(score, 4)
    return record


def time_to_goal(records: list[dict[str, Any]], limits: list[float]) -> np.ndarray:
    """Time to the goal [s] of each episode; a failure counts as its time limit."""
    return np.asarray([r["time_s"] if r["success"] else limit for r, limit in zip(records, limits, strict=True)])


def summary(records: list[dict[str, Any]], limits: list[float]) -> dict[str, Any]:
    """Rates and means over episodes; `time_to_goal_s` counts a failure as its time limit.

    Raises:
        ValueError: If there are no episodes.
    """
    if not records:
        raise ValueError("a summary needs at least one episode.")
    mean = lambda name: round(float(np.mean([r[name] for r in records])), 4)  # noqa: E731
    out: dict[str, Any] = {"episodes": len(records)}
    for rate in ("success", "collision", "timeout"):
        out[f"{rate}_rate"] = mean(rate)
    out["time_to_goal_s"] = round(float(np.mean(time_to_goal(records, limits))), 3)
    out["time_limit_s"] = round(float(np.mean(limits)), 3)
    names = ("time_s", "optimal_s", "distance_m", "shortest_m", "straight_m", "efficiency", "spl", "mean_speed_mps")
    for name in (*names, "npr", "recoveries"):
        out[name] = mean(name)
    out["min_clearance_m"] = round(min(r["min_clearance_m"] for r in records), 4)
    if all("barn_score" in r for r in records):
        out["barn_score"] = mean("barn_score")
    return out


def ratio_of_means(
    ours: np.ndarray, theirs: np.ndarray, *, seed: int = 0, resamples: int = 2000, level: float = 0.95
) -> tuple[float, float, float]:
    """Mean of paired `ours` over mean of `theirs`, with a bootstrap interval over pairs.

    Args:
        ours: `[N]`.
        theirs: `[N]`, the same trips.
        seed: Of the resampling.
        resamples: Number of bootstrap samples.
        level: Of the interval.

    Returns:
        (ratio, lower, upper); a bound is inf where samples so far out hold nothing but zeros of theirs.

    Raises:
        ValueError: If the samples are not paired or empty, or all of theirs are 0.
    """
    ours, theirs = np.asarray(ours, float), np.asarray(theirs, float)
    if ours.shape != theirs.shape or ours.ndim != 1 or not ours.size:
        raise ValueError(f"paired samples must be [N] with N >= 1, got {ours.shape} and {theirs.shape}.")
    if not theirs.any():
        raise ValueError("a ratio over nothing but zeros is none.")
    draw = np.random.default_rng(seed).integers(0, ours.size, (resamples, ours.size))
    with np.errstate(divide="ignore", invalid="ignore"):  # a sample may hold nothing but zeros of theirs, or of both
        ratios = ours[draw].mean(axis=1) / theirs[draw].mean(axis=1)
        low, high = np.quantile(ratios[~np.isnan(ratios)], [(1 - level) / 2, (1 + level) / 2])
    low, high = (np.inf if np.isnan(bound) else bound for bound in (low, high))  # between inf and inf
    return float(ours.mean() / theirs.mean()), float(low), float(high)


def paired(values: Sequence[tuple[float, float]]) -> dict[str, Any] | None:
    """`ratio_of_means` of (ours, theirs) as a record: ratio, low, high, trips; None of no pair, or if theirs are all 0."""
    ours, theirs = np.asarray(values, float).reshape(-1, 2).T
    if not theirs.any():
        return None
    ratio, low, high = ratio_of_means(ours, theirs)
    return {"ratio": ratio, "low": low, "high": high, "trips": ours.size}


def _pair(scores: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    scores, truth = np.asarray(scores, float).ravel(), np.asarray(truth, bool).ravel()
    if scores.shape != truth.shape:
        raise ValueError(f"scores and truth must have one shape, got {scores.size} and {truth.size} values.")
    return scores, truth


def auroc(scores: np.ndarray, truth: np.ndarray) -> float:
    """Area under the ROC curve: the chance that a true one scores higher than a false one, ties counting half.

    Args:
        scores: Any shape.
        truth: The same shape, bool.

    Returns:
        nan where all are true or all are false.
    """
    scores, truth = _pair(scores, truth)
    positives, negatives = int(truth.sum()), int((~truth).sum())
    if not positives or not negatives:
        return float("nan")
    values, place = np.unique(scores, return_inverse=True)
    yes, no = (np.bincount(place[kind], minlength=values.size).astype(float) for kind in (truth, ~truth))
    below = np.cumsum(no) - no
    return float(np.sum(yes * (below + 0.5 * no)) / (positives * negatives))


def average_precision(scores: np.ndarray, truth: np.ndarray) -> float:
    """Area under the precision-recall curve as a sum over recall steps; nan where nothing is true."""
    scores, truth = _pair(scores, truth)
    if not truth.any():
        return float("nan")
    values, place = np.unique(-scores, return_inverse=True)
    hits = np.cumsum(np.bincount(place, weights=truth, minlength=values.size))
    taken = np.cumsum(np.bincount(place, minlength=values.size))
    gained = np.diff(hits, prepend=0.0) / truth.sum()
    return float(np.sum(gained * hits / taken))


def calibration_error(probability: np.ndarray, truth: np.ndarray, bins: int = 15) -> float:
    """Expected calibration error: |mean probability - share that is true|, over equal bins, weighted by their counts."""
    probability, truth = _pair(probability, truth)
    if not truth.size:
        return float("nan")
    place = np.clip((probability * bins).astype(int), 0, bins - 1)
    gap = np.bincount(place, weights=probability - truth, minlength=bins)
    return float(np.abs(gap).sum() / truth.size)


def f1(said: np.ndarray, truth: np.ndarray) -> float:
    """Harmonic mean of precision and recall; nan where nothing is true and nothing was said."""
    said, truth = np.asarray(said, bool), np.asarray(truth, bool)
    over = int(said.sum()) + int(truth.sum())
    return 2.0 * int((said & truth).sum()) / over if over else float("nan")


def balanced_accuracy(said: np.ndarray, truth: np.ndarray) -> float:
    """Mean of the shares of true and of false ones that were named right; nan where one kind is missing."""
    said, truth = np.asarray(said, bool).ravel(), np.asarray(truth, bool).ravel()
    if truth.all() or not truth.any():
        return float("nan")
    return float((said[truth].mean() + (~said[~truth]).mean()) / 2)
