"""How good a network is on labelled frames: the figures of Table I (host code over batched inference).

Probabilities are kept in 1/65535, one array per head, so that tens of thousands of frames fit in memory.
"""

from collections.abc import Iterable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from drnav_jax import metrics
from drnav_jax.models import calibration, network
from drnav_jax.models.batch import NEVER, Batch
from drnav_jax.models.calibration import Calibration
from drnav_jax.models.network import NetworkSpec

RAW = Calibration()
NEAR_SEEN = 2.0  # [m] never-seen cells count this close to seen ones; what lies farther off nobody can know


class Predictions(NamedTuple):
    """What was said of F frames, and what is true; NumPy arrays on axis 0."""

    path: np.ndarray  # [F, 3] probability of being open
    flag: np.ndarray  # [F] probability of the dead-end flag
    dead: np.ndarray  # [F, h, w] probability of being a dead end, uint16 in 1/65535
    targets: Any  # `Targets`


@partial(jax.jit, static_argnames="spec")
def _probabilities(spec: NetworkSpec, params: Any, temper: Calibration, inputs: Any) -> tuple[Any, Any, Any]:
    out = calibration.calibrated(temper, network.apply(spec, params, inputs))
    dead = jnp.round(jax.nn.sigmoid(out.dead) * 65535).astype(jnp.uint16)
    return jax.nn.sigmoid(out.path), jax.nn.sigmoid(out.flag), dead


def predict(
    spec: NetworkSpec, params: Any, batches: Iterable[Batch], temper: Calibration = RAW
) -> Predictions:
    """Run a network over batches of one size."""
    parts, targets = [], []
    for batch in batches:
        parts.append(jax.device_get(_probabilities(spec, params, temper, batch.inputs)))
        targets.append(jax.tree.map(np.asarray, batch.targets))
    path, flag, dead = (np.concatenate(p) for p in zip(*parts, strict=True))
    return Predictions(path, flag, dead, jax.tree.map(lambda *a: np.concatenate(a), *targets))


def near_seen(visibility: np.ndarray, resolution: float) -> np.ndarray:
    """Never-seen cells within `NEAR_SEEN` of seen ones, `[F, h, w]`."""
    found = np.zeros(visibility.shape, bool)
    for k, codes in enumerate(visibility):
        unseen = codes == NEVER
        if unseen.all():
            continue
        found[k] = unseen & (np.asarray(ndimage.distance_transform_edt(unseen)) * resolution <= NEAR_SEEN)
    return found


def figures(found: Predictions, resolution: float = 0.2) -> dict[str, float]:
    """Accuracy of ways, F1 of the flag, AUROC and AP of cells, interior AUROC, calibration error.

    Args:
        found: From `predict`.
        resolution: Of the grid [m].
    """
    t = found.targets
    open_ = found.path >= 0.5
    right = open_ == t.path
    out = {
        "accuracy": float(right.mean()),
        "accuracy_stable": float(right[t.path_stable].mean()) if t.path_stable.any() else float("nan"),
        "balanced_accuracy": metrics.balanced_accuracy(open_, t.path),
        "dead_end_f1": metrics.f1(found.flag >= 0.5, t.dead_end_flag),
    }
    dead = found.dead.astype(np.float32) / 65535
    inner, unseen = t.interior & t.valid, near_seen(t.visibility, resolution) & t.valid
    out |= {
        "cell_auroc": metrics.auroc(dead[t.valid], t.dead_end[t.valid]),
        "cell_auroc_unseen": metrics.auroc(dead[unseen], t.dead_end[unseen]),
        "cell_ap": metrics.average_precision(dead[t.valid], t.dead_end[t.valid]),
        "interior_auroc": metrics.auroc(dead[inner], t.dead_end[inner]),
        "ece": metrics.calibration_error(dead[t.valid], t.dead_end[t.valid]),
        "ece_path": metrics.calibration_error(found.path, t.path),
    }
    return out
