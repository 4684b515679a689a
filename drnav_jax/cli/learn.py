"""`drnav train`: data sets in, weights out."""

import sys
from typing import Any

from drnav_jax import dataset, report, train
from drnav_jax.cli import process
from drnav_jax.cli.flags import Train
from drnav_jax.cli.terminal import Bar, stdout_kept
from drnav_jax.models import settings
from drnav_jax.models.batch import Batch, batch_of
from drnav_jax.scripts import INTERRUPTED

CHUNK = 64  # validation frames at a time


def _validation(args: Train) -> list[Batch]:
    source = dataset.FrameSource(args.validation)
    count = len(source) // CHUNK * CHUNK
    if not count:
        raise ValueError(f"{args.validation} holds {len(source)} frames: validation needs at least {CHUNK}.")
    return [batch_of(f._asdict()) for f in dataset.batches(args.validation, CHUNK, 0, epochs=1, workers=0)]


def _about(args: Train, endless: dataset.DatasetSpec) -> dict[str, dict[str, Any]]:
    """What the sets are, for the notes beside the weights."""
    folders = {f"train{k or ''}": folder for k, folder in enumerate(args.data)} | {"validation": args.validation}
    told = ("split", "seed", "num_frames", "families", "litter", "charted")
    specs = {name: dataset.read_manifest(folder)["spec"] for name, folder in folders.items()}
    if args.stream:
        specs["train"] = settings.plain(endless) | {"num_frames": "without end"}
    return {name: {key: spec[key] for key in told if key in spec} for name, spec in specs.items()}


def _check_grid(args: Train, spec: train.TrainSpec) -> None:
    """The network's grid must be that of the sets: their maps and labels are cut out already.

    Raises:
        ValueError: If it is not.
    """
    ours = settings.plain(spec.network.bev)
    for folder in (*args.data, args.validation):
        theirs = dataset.read_manifest(folder)["settings"].get("frames", {}).get("bev")
        if theirs != ours:
            raise ValueError(f"{folder} was gathered on the grid {theirs}, the network has {ours} (bev): make them one.")


def perform(args: Train) -> int:
    """Train; the exit code.

    Raises:
        ValueError: On a user's mistake.
        OSError: If a file cannot be read or written.
    """
    if args.stream == bool(args.data):
        raise ValueError("give either --data DIR or --stream.")
    spec = train.read(args.config)
    process.use_every_core()
    validation, endless = _validation(args), dataset.spec_of(1, "train", spec.seed)
    if args.data:
        count = len(dataset.FrameSource(*args.data))  # mistakes come before --out is begun
        if count < spec.batch_size:
            raise ValueError(f"{', '.join(map(str, args.data))} holds {count} frames: a batch has {spec.batch_size}.")
        source = lambda first: dataset.batches(args.data, spec.batch_size, spec.seed, first=first)  # noqa: E731
    else:
        frames = dataset.FrameSpec(bev=spec.network.bev)
        source = lambda first: dataset.stream(spec.batch_size, endless, frames, first=first)  # noqa: E731
    _check_grid(args, spec)
    begun: int | None = None
    bar = Bar("train", spec.steps, "steps")
    try:
        with stdout_kept(args.json):

            def said(step: int, figures: dict[str, float]) -> None:
                nonlocal begun  # a resumed run has made what came since its first report
                begun = step if begun is None else begun
                bar(step, step - begun, note=_note(figures))

            result = train.train(
                spec, source, validation, args.out, resume=args.resume, progress=said, data=_about(args, endless)
            )
    except KeyboardInterrupt:
        print(f"drnav: interrupted; the same command with --resume goes on in {args.out}/", file=sys.stderr)
        return INTERRUPTED
    finally:
        bar.close()
    figures = result.figures | {"step": result.step, "samples_per_s": result.samples_per_s}
    print(report.dumps(figures) if args.json else "\n".join(f"{name:<20} {v:.4g}" for name, v in figures.items()))
    print(f"drnav: wrote {args.out / 'weights.safetensors'}", file=sys.stderr)
    return 0


def _note(figures: dict[str, float]) -> str:
    names = ("loss", "samples_per_s", "accuracy", "interior_auroc")
    return ", ".join(f"{name} {figures[name]:.3g}" for name in names if name in figures)
