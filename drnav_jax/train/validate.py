"""How good evidence is on labelled frames: the figures of Table I (host code over batched inference).

Whoever judges - a network, the geometric rule, a language model - gives `Predictions`; `figures` compares them with the
truth, `intervals` says how far another draw of worlds would move them. Probabilities of cells are kept in 1/65535.
"""

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from drnav_jax import metrics
from drnav_jax.filter import dead_end
from drnav_jax.filter.dead_end import DeadEndParams
from drnav_jax.models import calibration, fusion, network
from drnav_jax.models.batch import NEVER, OCCUPIED, Batch, Inputs, Targets
from drnav_jax.models.calibration import Calibration
from drnav_jax.models.network import NetworkSpec
from drnav_jax.types import BevSpec, Evidence
from drnav_jax.worlds.labels import clearance_of
from drnav_jax.worlds.openings import Floor, openings

RAW = Calibration()
NEAR_SEEN = fusion.NEAR  # [m] never-seen cells count this close to seen ones


class Predictions(NamedTuple):
    """What was said of F frames, and what is true; NumPy arrays on axis 0. NaN = no answer."""

    path: np.ndarray  # [F, 3] probability of being open
    flag: np.ndarray  # [F] probability of the dead-end flag
    dead: np.ndarray | None  # [F, h, w] probability of being a dead end, uint16 in 1/65535; None = says nothing of cells
    targets: Any  # `Targets`


@partial(jax.jit, static_argnames="spec")
def _probabilities(spec: NetworkSpec, params: Any, temper: Calibration, inputs: Inputs) -> tuple[Any, Any, Any]:
    out = calibration.calibrated(temper, network.apply(spec, params, inputs))
    dead = jnp.round(jax.nn.sigmoid(out.dead) * 65535).astype(jnp.uint16)
    return jax.nn.sigmoid(out.path), jax.nn.sigmoid(out.flag), dead


def predict(
    spec: NetworkSpec, params: Any, batches: Iterable[Batch], temper: Calibration = RAW,
    change: Callable[[Inputs], Inputs] | None = None,
) -> Predictions:  # fmt: skip
    """Run a network over batches of one size.

    Args:
        spec: Of the network.
        params: Its parameters.
        batches: Frames.
        temper: Temperatures.
        change: What is done to the inputs first, such as a camera that goes missing.
    """
    parts = []
    for batch in batches:
        inputs = batch.inputs if change is None else change(batch.inputs)
        path, flag, dead = jax.device_get(_probabilities(spec, params, temper, inputs))
        parts.append(Predictions(path, flag, dead, jax.tree.map(np.asarray, batch.targets)))
    return joined(parts)


def joined(parts: list[Predictions]) -> Predictions:
    """One after the other."""
    return jax.tree.map(lambda *a: np.concatenate(a), *parts)


def by_rule(batches: Iterable[Batch], bev: BevSpec, radius: float) -> Predictions:
    """What the geometric rule says; of ways, what its verdict on the known map leaves open, unknown counting as free.

    Of a cell it says what the filter makes of one answer (eq. 5 of the paper), so that where it is silent the prior stands.
    """
    parts, pose = [], np.zeros((1, 3))
    belief = DeadEndParams()
    once = jax.vmap(lambda before, said: dead_end.update(belief, before, said, said.confidence > 0, 0.0))
    for batch in batches:
        path, flag = [], []
        x = batch.inputs
        p = np.asarray(x.rule_p).astype(np.float32) / 255
        sure = np.asarray(x.rule_confidence).astype(np.float32) / 255
        blank = jnp.full(p.shape, dead_end.prior_log_odds(belief))
        dead = np.asarray(dead_end.probability(once(blank, Evidence(jnp.asarray(p), jnp.asarray(sure)))))
        closed = (p > 0.1) & (sure > 0)  # the rule knows two answers: see `GeometricParams`
        for verdict, known in zip(closed, np.asarray(x.local_map), strict=True):
            floor = Floor(
                label=verdict, depth=np.zeros(verdict.shape), origin=np.asarray(bev.origin), resolution=bev.resolution,
                standable=clearance_of(known == OCCUPIED, bev.resolution) > radius, outside_is_free=True,
            )
            found = openings(floor, pose)
            path.append(found.open[0])
            flag.append(found.dead_end[0])
        parts.append(Predictions(
            np.asarray(path, np.float32), np.asarray(flag, np.float32), np.round(dead * 65535).astype(np.uint16),
            jax.tree.map(np.asarray, batch.targets),
        ))  # fmt: skip
    return joined(parts)


def only(found: Predictions, frames: np.ndarray) -> Predictions:
    """Of some frames (mask or numbers)."""
    dead = None if found.dead is None else found.dead[frames]
    return Predictions(found.path[frames], found.flag[frames], dead, jax.tree.map(lambda a: a[frames], found.targets))


def near_seen(visibility: np.ndarray, resolution: float) -> np.ndarray:
    """Never-seen cells within `NEAR_SEEN` of seen ones, `[F, h, w]`."""
    found = np.zeros(visibility.shape, bool)
    for k, codes in enumerate(visibility):
        unseen = codes == NEVER
        if not unseen.all():
            found[k] = unseen & (np.asarray(ndimage.distance_transform_edt(unseen)) * resolution <= NEAR_SEEN)
    return found


def evident(targets: Targets, resolution: float) -> np.ndarray:
    """Cells that are judged, `[F, h, w]`: seen ones, and never-seen ones within `NEAR_SEEN` of them."""
    seen = np.asarray(targets.visibility) != NEVER
    return np.asarray(targets.valid) & (seen | near_seen(targets.visibility, resolution))


def _of_ways(found: Predictions) -> dict[str, float]:
    t = found.targets
    asked = np.isfinite(found.path)
    open_, stable = found.path >= 0.5, asked & t.path_stable
    right = open_ == t.path
    flagged = np.isfinite(found.flag)
    share = lambda mask: float(right[mask].mean()) if mask.any() else float("nan")  # noqa: E731
    return {
        "accuracy": share(asked),
        "accuracy_stable": share(stable),
        "balanced_accuracy": metrics.balanced_accuracy(open_[asked], t.path[asked]),
        "dead_end_f1": metrics.f1(found.flag[flagged] >= 0.5, t.dead_end_flag[flagged]),
    }


def figures(found: Predictions, resolution: float = 0.2) -> dict[str, float]:
    """Accuracy of ways, F1 of the flag, AUROC and AP of cells, interior AUROC, calibration errors; nan = undefined.

    Cells are judged where there is evidence (`evident`), the never-seen ones of them alone in `cell_auroc_unseen`;
    `cell_auroc_everywhere` is over all that a label is defined for.

    Args:
        found: From `predict` or `by_rule`.
        resolution: Of the grid [m].
    """
    t = found.targets
    out = _of_ways(found)
    if found.dead is None:
        names = ("cell_auroc", "cell_auroc_unseen", "cell_auroc_everywhere", "cell_ap", "interior_auroc", "ece")
        return out | dict.fromkeys(names, float("nan"))
    dead = found.dead.astype(np.float32) / 65535
    judged = evident(t, resolution)
    unseen, inner = judged & (t.visibility == NEVER), judged & t.interior
    return out | {
        "cell_auroc": metrics.auroc(dead[judged], t.dead_end[judged]),
        "cell_auroc_unseen": metrics.auroc(dead[unseen], t.dead_end[unseen]),
        "cell_auroc_everywhere": metrics.auroc(dead[t.valid], t.dead_end[t.valid]),
        "cell_ap": metrics.average_precision(dead[judged], t.dead_end[judged]),
        "interior_auroc": metrics.auroc(dead[inner], t.dead_end[inner]),
        "ece": metrics.calibration_error(dead[judged], t.dead_end[judged]),
        "ece_path": metrics.calibration_error(found.path, t.path),
    }


def worlds_of(targets: Targets) -> np.ndarray:
    """Number of the world of each frame; twins count as one, since they share all but an end."""
    pairs = np.stack([np.asarray(targets.family), np.asarray(targets.seed)], axis=1)
    return np.unique(pairs, axis=0, return_inverse=True)[1].ravel()


def intervals(
    found: Predictions, names: tuple[str, ...] = ("accuracy", "accuracy_stable", "dead_end_f1", "interior_auroc"),
    *, seed: int = 0, resamples: int = 200, level: float = 0.95, bins: int = 512, resolution: float = 0.2,
) -> dict[str, tuple[float, float]]:  # fmt: skip
    """Bootstrap intervals over worlds, since frames of one world are much alike.

    Args:
        found: From `predict`.
        names: Of `accuracy`, `accuracy_stable`, `dead_end_f1`, `interior_auroc` and `cell_auroc`.
        seed: Of the resampling.
        resamples: Number of bootstrap samples.
        level: Of the intervals.
        bins: Steps of probability that AUROC tells apart.
        resolution: Of the grid [m].
    """
    t, world = found.targets, worlds_of(found.targets)
    count = int(world.max()) + 1
    frames = [np.flatnonzero(world == k) for k in range(count)]
    cells = {}
    if found.dead is not None:
        step = (found.dead.astype(np.int64) * bins) >> 16
        judged = evident(t, resolution)
        for name, mask in (("interior_auroc", t.interior & judged), ("cell_auroc", judged)):
            code = step + bins * t.dead_end
            cells[name] = np.stack([np.bincount(code[f][mask[f]], minlength=2 * bins) for f in frames])
    rng, drawn = np.random.default_rng(seed), {name: [] for name in names}
    slim = t._replace(**{name: t.family for name, values in t._asdict().items() if np.ndim(values) == 3})
    slim = found._replace(dead=None, targets=slim)
    for _ in range(resamples):
        chosen = rng.integers(0, count, count)
        ways = _of_ways(only(slim, np.concatenate([frames[k] for k in chosen])))
        for name in names:
            if name in cells:
                no, yes = cells[name][chosen].sum(axis=0).reshape(2, bins).astype(float)
                below = np.cumsum(no) - no
                over = yes.sum() * no.sum()
                drawn[name].append(float(np.sum(yes * (below + 0.5 * no)) / over) if over else float("nan"))
            else:
                drawn[name].append(ways.get(name, float("nan")))
    ends = [(1 - level) / 2, (1 + level) / 2]
    out = {}
    for name, values in drawn.items():
        low, high = np.nanquantile(values, ends) if np.isfinite(values).any() else (float("nan"),) * 2
        out[name] = (float(low), float(high))
    return out
