"""The whole job of `drnav train`: data -> steps -> validation -> weights.

Batch s of the data, the augmentation of step s and everything else is a function of the Spec and of s, so a run that was
killed and resumed ends with the same weights, bit for bit, on the same machine with as many devices.
"""

import contextlib
import json
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from drnav_jax.models import calibration, settings, weights
from drnav_jax.models.batch import Batch, batch_of
from drnav_jax.models.calibration import Calibration, Temperature
from drnav_jax.train import validate
from drnav_jax.train.augment import trimmed
from drnav_jax.train.checkpoints import Checkpoints
from drnav_jax.train.spec import TrainSpec
from drnav_jax.train.step import AXIS, init, mesh_of, stepper

SCORED = ("accuracy", "cell_auroc", "interior_auroc", "dead_end_f1")  # whose mean chooses the best checkpoint
LOG_EVERY = 25  # steps

Source = Callable[[int], Iterator[Any]]  # number of the first batch -> frames, batch after batch


class Result(NamedTuple):
    """What a run ended with."""

    params: Any  # the averaged parameters of the best checkpoint
    calibration: Calibration
    figures: dict[str, float]  # of them, on the validation frames
    step: int
    samples_per_s: float


class _Log:
    """JSON lines, and the same for TensorBoard; what lies beyond the step that a run goes on from is dropped."""

    def __init__(self, folder: Path, first: int) -> None:
        from tensorboardX import SummaryWriter  # the `train` extra

        file = folder / "log.jsonl"
        kept = []
        if file.exists():
            for line in file.read_text().splitlines():
                with contextlib.suppress(ValueError):
                    kept += [line] if json.loads(line)["step"] <= first else []
        file.write_text("".join(f"{line}\n" for line in kept))
        self._stream = file.open("a")
        self._board = SummaryWriter(str(folder / "tensorboard"), purge_step=first or None)

    def __call__(self, step: int, kind: str, values: dict[str, float]) -> None:
        finite = {name: float(v) for name, v in values.items() if np.isfinite(v)}
        self._stream.write(json.dumps({"step": step, "kind": kind} | finite) + "\n")
        self._stream.flush()
        for name, value in finite.items():
            self._board.add_scalar(f"{kind}/{name}", value, step)

    def close(self) -> None:
        self._stream.close()
        self._board.close()


def _begin(folder: Path, spec: TrainSpec, data: dict[str, Any] | None, resume: bool) -> None:
    """The folder of the run, with its settings and what its frames are beside it."""
    folder.mkdir(parents=True, exist_ok=True)
    begun = (folder / "spec.json").exists()
    if begun and not resume:
        raise ValueError(f"{folder} holds a run already: give --resume to go on with it, or another --out.")
    if resume and not begun:
        raise ValueError(f"{folder} holds no run to resume.")
    texts = {"spec": json.dumps(settings.plain(spec), indent=1, sort_keys=True) + "\n"}
    if data is not None:
        texts["data"] = json.dumps(data, indent=1, sort_keys=True) + "\n"
    for name, text in texts.items():
        file, now = folder / f"{name}.json", json.loads(text)
        was = json.loads(file.read_text()) if file.exists() else now
        other = sorted(k for k in was | now if was.get(k) != now.get(k))
        if other:
            what = "" if name == "spec" else " data"
            raise ValueError(f"{folder} was begun with another {', '.join(other)}{what}: give the same, or another --out.")
    for name, text in texts.items():
        (folder / f"{name}.json").write_text(text)


def train(
    spec: TrainSpec, source: Source, validation: Iterable[Batch], out: Path, *, resume: bool = False,
    devices: list[Any] | None = None, progress: Callable[[int, dict[str, float]], None] | None = None,
    data: dict[str, Any] | None = None,
) -> Result:  # fmt: skip
    """Train until `spec.steps` are done.

    Args:
        spec: The run.
        source: Frames by the number of their first batch.
        validation: Batches of one size, gone through many times.
        out: Folder of checkpoints and logs.
        resume: Go on from the last checkpoint in `out`.
        devices: To share batches; None = all.
        progress: Called with the steps done and the latest figures.
        data: What the frames are, in JSON values; kept with the weights.

    Raises:
        ValueError: If `out` holds another run, there is nothing to resume, or nothing to start from.
        OSError: If the weights to start from cannot be read.
    """
    state = init(spec)
    _begin(out, spec, data, resume)
    mesh = mesh_of(jax.devices() if devices is None else devices, spec.batch_size)
    kept = Checkpoints(out, spec.keep)
    if resume and kept.latest is not None:
        state = kept.load(state)
    state = jax.device_put(state, NamedSharding(mesh, PartitionSpec()))
    step, log, take = int(state.step), _Log(out, int(state.step)), stepper(spec, mesh)
    split, begun, first = NamedSharding(mesh, PartitionSpec(AXIS)), time.perf_counter(), step
    frames, latest = source(step), {}
    try:
        while step < spec.steps:
            batch = trimmed(batch_of(next(frames)._asdict()))
            state, said = take(state, jax.device_put(batch, split))
            step += 1
            if step == first + 1:
                jax.block_until_ready(state)
                begun = time.perf_counter()  # without compilation
            if step % LOG_EVERY == 0 or step == spec.steps:
                rate = (step - first - 1) * spec.batch_size / max(time.perf_counter() - begun, 1e-9)
                latest = {name: float(v) for name, v in said.items()} | {"samples_per_s": rate}
                log(step, "train", latest)
                if progress is not None:
                    progress(step, latest)
            if step % spec.validate_every == 0 or step == spec.steps:
                paused = time.perf_counter()
                found = validate.predict(spec.network, jax.device_get(state.average), validation)
                figures = validate.figures(found, spec.network.bev.resolution)
                log(step, "validation", figures)
                kept.offer(state, float(np.nanmean([figures[name] for name in SCORED])))
                if progress is not None:
                    progress(step, latest | figures)
                begun += time.perf_counter() - paused
            if step % spec.save_every == 0 or step == spec.steps:
                kept.save(state)
        best = kept.load(state, best=True)
        temper = fitted(spec, best.average, validation)
        found = validate.predict(spec.network, best.average, validation, temper)
        result = Result(
            params=best.average, calibration=temper, figures=validate.figures(found, spec.network.bev.resolution),
            step=int(best.step), samples_per_s=latest.get("samples_per_s", 0.0),
        )  # fmt: skip
        about = {"figures": result.figures, "step": result.step, "data": data or {}, "run": _plain(spec)}
        weights.save(out / "weights.safetensors", spec.network, best.average, temper, about)
        return result
    finally:
        getattr(frames, "close", lambda: None)()  # the processes that read ahead
        kept.close()
        log.close()


def _plain(spec: TrainSpec) -> dict[str, Any]:
    """The settings of a run, without the network, which weights tell by themselves."""
    return {name: value for name, value in settings.plain(spec).items() if name != "network"}


def fitted(spec: TrainSpec, params: Any, validation: Iterable[Batch]) -> Calibration:
    """Temperatures from the validation frames; a head keeps its raw logits where they are all of one kind."""
    raw = validate.predict(spec.network, params, validation)
    t = raw.targets
    assert raw.dead is not None
    logit = lambda p: np.log(np.clip(p, 1e-6, 1 - 1e-6)) - np.log1p(-np.clip(p, 1e-6, 1 - 1e-6))  # noqa: E731
    dead = raw.dead.astype(np.float32) / 65535

    def fit(p: np.ndarray, truth: np.ndarray) -> Temperature:  # frames of one kind only: as it is
        return calibration.fit(logit(p), truth) if truth.any() and not truth.all() else Temperature()

    return Calibration(
        path=fit(raw.path, t.path), flag=fit(raw.flag, t.dead_end_flag), dead=fit(dead[t.valid], t.dead_end[t.valid])
    )
