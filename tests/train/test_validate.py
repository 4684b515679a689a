"""Figures of a judge against its definitions; who says nothing of cells has none of them."""

import jax
import numpy as np
import pytest
from small_network import SPEC, batch, params_of

from drnav_jax import metrics
from drnav_jax.models.batch import BEFORE, NEVER, NOW
from drnav_jax.models.calibration import Calibration, Temperature
from drnav_jax.train import validate
from drnav_jax.train.validate import Predictions

F = 12
CELLS = ("cell_auroc", "cell_auroc_unseen", "cell_auroc_everywhere", "cell_ap", "interior_auroc", "ece")


def targets(seed=0):
    return jax.tree.map(np.asarray, batch(F, seed).targets)


def judged(seed=0, sure=0.25):
    """Somebody who is right more often than not."""
    t, rng = targets(seed), np.random.default_rng(seed)
    said = lambda truth: np.clip(0.5 + sure * (2.0 * truth - 1) + 0.3 * rng.normal(size=truth.shape), 0, 1)  # noqa: E731
    return Predictions(said(t.path), said(t.dead_end_flag), np.round(said(t.dead_end) * 65535).astype(np.uint16), t)


def test_figures_are_those_of_the_definitions(monkeypatch):
    monkeypatch.setattr(validate, "NEAR_SEEN", 0.5)  # the grid is small
    found = judged()
    t, got = found.targets, validate.figures(judged(), resolution=0.4)
    right = [(found.path[f, k] >= 0.5) == t.path[f, k] for f in range(F) for k in range(3)]
    stable = [t.path_stable[f, k] for f in range(F) for k in range(3)]
    assert got["accuracy"] == pytest.approx(np.mean(right))
    assert got["accuracy_stable"] == pytest.approx(np.mean([r for r, s in zip(right, stable, strict=True) if s]))
    rows, columns = t.valid.shape[1:]
    every, near, inner, unseen = [], [], [], []
    for f in range(F):
        seen = [(i, j) for i in range(rows) for j in range(columns) if t.visibility[f, i, j] != NEVER]
        for i in range(rows):
            for j in range(columns):
                pair = (found.dead[f, i, j] / 65535, bool(t.dead_end[f, i, j]))
                if not t.valid[f, i, j]:
                    continue
                every.append(pair)
                if t.visibility[f, i, j] == NEVER:
                    if min(np.hypot(i - a, j - b) for a, b in seen) * 0.4 > 0.5:
                        continue
                    unseen.append(pair)
                near.append(pair)
                inner += [pair] if t.interior[f, i, j] else []
    of = lambda measure, pairs: measure(*(np.array(x) for x in zip(*pairs, strict=True)))  # noqa: E731
    assert len(every) > len(near) > len(unseen) > 0 < len(inner)
    want = {
        "cell_auroc": of(metrics.auroc, near), "interior_auroc": of(metrics.auroc, inner),
        "cell_auroc_unseen": of(metrics.auroc, unseen), "cell_auroc_everywhere": of(metrics.auroc, every),
        "cell_ap": of(metrics.average_precision, near), "ece": of(metrics.calibration_error, near),
    }  # fmt: skip
    for name, value in want.items():
        assert got[name] == pytest.approx(value, abs=1e-6), name
    assert got["dead_end_f1"] == metrics.f1(found.flag >= 0.5, t.dead_end_flag)
    assert got["balanced_accuracy"] == metrics.balanced_accuracy(found.path >= 0.5, t.path)


def test_never_seen_cells_near_to_seen_ones():
    codes = np.full((3, 5, 30), NEVER, np.uint8)
    codes[0, 2, 0], codes[1] = BEFORE, NOW
    near = validate.near_seen(codes, 0.5)
    assert not near[1].any() and not near[2].any()  # all is seen; nothing is
    assert near[0, 2].tolist() == [False] + [True] * 4 + [False] * 25


def test_the_rule_says_of_a_cell_what_the_filter_makes_of_it():
    """Where it is silent the prior stands; what it calls open lies below that, what it calls shut above."""
    held = batch(1)
    p = np.zeros(held.inputs.rule_p.shape, np.uint8)
    sure = np.zeros_like(p)
    p[0, 0, :3], sure[0, 0, :3] = (64, 8, 8), (255, 51, 255)
    held = held._replace(inputs=held.inputs._replace(rule_p=p, rule_confidence=sure))
    found = validate.by_rule([held], SPEC.bev, 0.25)
    logit = lambda q: np.log(q / (1 - q))  # noqa: E731
    want = [logit(0.06) + c * (logit(q / 255) - logit(0.06)) for q, c in ((64, 1), (8, 0.2), (8, 1))]
    assert found.dead is not None
    np.testing.assert_allclose(logit(found.dead[0, 0, :3] / 65535), want, atol=1e-3)
    rest = found.dead.copy()
    rest[0, 0, :3] = round(0.06 * 65535)
    np.testing.assert_array_equal(rest, round(0.06 * 65535))


def test_who_says_nothing_of_cells():
    got = validate.figures(judged()._replace(dead=None))
    assert all(np.isnan(got[name]) for name in CELLS) and got["accuracy"] == validate.figures(judged())["accuracy"]


def test_frames_without_an_answer_do_not_count():
    found = judged()
    path, flag = found.path.copy(), found.flag.copy()
    path[:4], flag[:4] = np.nan, np.nan
    silent = validate.figures(found._replace(path=path, flag=flag, dead=None))
    asked = validate.figures(validate.only(found, np.arange(4, F))._replace(dead=None))
    for name in ("accuracy", "accuracy_stable", "balanced_accuracy", "dead_end_f1"):
        assert silent[name] == asked[name]


def test_intervals_are_over_worlds_and_hold_the_figure():
    parts = [judged(seed) for seed in range(8)]
    join = lambda *a: np.concatenate(a)  # noqa: E731
    t = jax.tree.map(join, *(p.targets for p in parts))
    t = t._replace(family=np.arange(96) // 4 % 5, seed=np.arange(96) // 4)  # 24 worlds of 4 frames
    found = Predictions(*(join(*(getattr(p, n) for p in parts)) for n in ("path", "flag", "dead")), t)
    names = ("accuracy", "accuracy_stable", "dead_end_f1", "interior_auroc", "cell_auroc")
    got, exact = validate.intervals(found, names), validate.figures(found, 0.4)
    for name in names:
        low, high = got[name]
        assert low < exact[name] < high, name
        assert high - low < (0.6 if name == "dead_end_f1" else 0.2), name  # few frames are dead ends
    # one world only: nothing to draw from, so no width
    one = validate.only(found, np.arange(4))
    low, high = validate.intervals(one, ("accuracy",))["accuracy"]
    assert low == high == validate.figures(one, 0.4)["accuracy"]
    assert validate.worlds_of(t).max() == 23
    twins = t._replace(family=np.zeros(96, int), seed=np.zeros(96, int), closed=np.arange(96) % 2 == 0)
    assert validate.worlds_of(twins).max() == 0, "twins count as one"


@pytest.mark.relaxed  # flax
def test_a_network_is_asked_batch_by_batch():
    params, batches = params_of(), [batch(4, seed=k) for k in range(3)]
    whole = validate.predict(SPEC, params, batches)
    assert whole.path.shape == (12, 3) and whole.flag.shape == (12,) and whole.dead.dtype == np.uint16
    np.testing.assert_array_equal(whole.targets.seed, np.concatenate([b.targets.seed for b in batches]))
    one = validate.predict(SPEC, params, batches[1:2])
    np.testing.assert_array_equal(one.path, whole.path[4:8])
    np.testing.assert_array_equal(one.dead, whole.dead[4:8])
    # in the middle of nowhere p = 1/2 becomes σ(b)
    tempered = validate.predict(SPEC, params, batches, Calibration(path=Temperature(1e6, 1.0)))
    np.testing.assert_allclose(tempered.path, np.full((12, 3), 1 / (1 + np.exp(-1))), rtol=1e-4)
    np.testing.assert_array_equal(tempered.flag, whole.flag)
    blind = lambda x: x._replace(image_valid=np.zeros_like(x.image_valid))  # noqa: E731
    assert np.abs(validate.predict(SPEC, params, batches, change=blind).path - whole.path).max() > 1e-4
