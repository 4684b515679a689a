"""Table I: who sees dead ends?

    python experiments/table1_detection.py --split test --json

Frames of worlds that nobody was trained on are gathered once (`--out`/frames-...), then judged by the fusion network, by
networks that lack a sensor or a part, by the geometric rule, by CLIP and by a vision-language model. Ways are OPEN or
BLOCKED for front, left and right; cells carry a probability of being a dead end. Intervals are bootstrapped over worlds.

Rows `image_only`, `lidar_only`, `no_attention`, `no_lift` and `tokens` are networks of their own, trained with
`drnav train --config experiments/ablations/ROW.yaml` and read from `--ablations`/ROW.safetensors. `clip` needs open_clip
and its weights on this machine, `vlm` an OpenAI-compatible endpoint (`--vlm-url`): `http://localhost:8000/v1` is a server
here, the paper's GPT and Gemini rows are `https://api.openai.com/v1` and Google's address in `models.vlm`.
"""

import dataclasses
import math
import re
import sys
import time
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np
import tyro

from drnav_jax import dataset, report, viz, worlds
from drnav_jax.bench.network import latency
from drnav_jax.models import clip, network, views, vlm, weights
from drnav_jax.models.batch import NOW, Batch, batch_of
from drnav_jax.scripts import script
from drnav_jax.sim.lidar import LidarSpec
from drnav_jax.train import faults, validate
from drnav_jax.train.validate import Predictions
from drnav_jax.types import BevSpec

COLUMNS = (
    "accuracy", "accuracy_stable", "balanced_accuracy", "dead_end_f1", "cell_auroc", "cell_auroc_unseen", "cell_ap",
    "interior_auroc", "ece", "latency_ms", "throughput_hz", "parameters",
)  # fmt: skip
MORE = ("ece_path", "cell_auroc_everywhere", "frames", "note")
ABLATIONS = ("image_only", "lidar_only", "no_attention", "no_lift", "tokens")
POORER = {  # LiDARs whose frames are gathered anew
    "10 % of the points": dataset.FrameSpec(lost=0.9),
    "one ring": dataset.FrameSpec(lidar=LidarSpec(rings=1, elevation_min=0.0, elevation_max=0.0)),
}
AS_BEFORE = {  # titles of rows of the table beside them
    "all sensors": "drnav", "network without cameras": "lidar_only", "geometric rule": "geometric",
}  # fmt: skip
CHUNK = 60  # frames per call
REPEATS = 50  # of the timed call
HERE = Path(__file__).resolve().parent


@dataclasses.dataclass(frozen=True)
class Config:
    """What is judged, and where results go.

    Attributes:
        split: Of the worlds: test has sizes and two families that training never had, val only other seeds.
        frames: How many.
        seed: Of the worlds.
        weights: Of the fusion network; None = those that come with the package.
        ablations: Folder of the other networks' weights.
        out: Folder for frames, table and picture.
        clip_model: Name in open_clip.
        clip_weights: A file of weights, or a tag of open_clip whose file is in its cache.
        vlm_url: Endpoint of the vision-language model; empty = it is not asked.
        vlm_model: Its name there.
        vlm_key: Environment variable that holds the key; empty = none is needed.
        vlm_frames: So many frames, evenly spread, are put to it.
        loss_frames: So many are judged again with sensors that fail; 0 = none.
        pictured: Frames in the picture.
        json: Print one JSON object on stdout, and nothing else there.
    """

    split: Literal["test", "val"] = "test"
    frames: int = 3840
    seed: int = 100
    weights: Path | None = None
    ablations: Path = HERE / "ablations"
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("results") / "table1"
    clip_model: str = clip.ClipSpec.model
    clip_weights: str = clip.ClipSpec.weights
    vlm_url: str = ""
    vlm_model: str = vlm.VlmSpec.model
    vlm_key: str = vlm.VlmSpec.key_variable
    vlm_frames: int = 120
    loss_frames: int = 960
    pictured: int = 8
    json: bool = False

    def __post_init__(self) -> None:
        """Check numbers of frames."""
        if self.frames < CHUNK or self.frames % CHUNK:
            raise ValueError(f"--frames must be a multiple of {CHUNK}, got {self.frames}.")
        if not 0 <= self.loss_frames <= self.frames or self.loss_frames % CHUNK:
            raise ValueError(f"--loss-frames must be a multiple of {CHUNK} and <= --frames, got {self.loss_frames}.")
        if not (1 <= self.vlm_frames and 1 <= self.pictured):
            raise ValueError("--vlm-frames and --pictured must be >= 1.")
        if self.weights is not None and not self.weights.is_file():
            raise ValueError(f"{self.weights} is no file of weights.")


def gathered(
    config: Config, count: int, sensors: dataset.FrameSpec, name: str = ""
) -> tuple[list[Batch], tuple[str, ...]]:
    """The first frames, gathered unless they are there already, and the families' names."""
    folder = config.out / f"frames-{config.split}-{config.seed}-{count}{name and '-'}{name}"
    spec = dataset.spec_of(count, config.split, config.seed)
    begun = time.perf_counter()

    def said(done: int, _: int) -> None:
        print(f"table1: {done}/{count} frames {name}, {time.perf_counter() - begun:.0f} s", file=sys.stderr)

    dataset.write(folder, spec, sensors, progress=said)
    source = dataset.FrameSource(folder)  # in its order: the first frames of a larger set are those of a smaller one
    whole = lambda first: jax.tree.map(lambda *a: np.stack(a), *[source[k] for k in range(first, first + CHUNK)])  # noqa: E731
    return [batch_of(whole(first)._asdict()) for first in range(0, count, CHUNK)], spec.families


def row(found: Predictions, extra: dict[str, Any]) -> dict[str, Any]:
    """One row of the table, with intervals."""
    values = validate.figures(found) | extra
    return {name: _number(values[name]) for name in (*COLUMNS, *MORE) if name in values} | {
        "intervals": {name: [_number(a), _number(b)] for name, (a, b) in validate.intervals(found).items()}
    }


def _number(value: Any) -> Any:
    """JSON has no NaN: what is undefined is null."""
    return None if value is None or (isinstance(value, float) and not math.isfinite(value)) else value


def of_network(file: Path, batches: list[Batch]) -> tuple[Predictions, dict[str, Any]] | None:
    """What the network of a file says, its speed and size; None where there is no such file."""
    if not file.is_file():
        return None
    trained = weights.load(file)
    found = validate.predict(trained.spec, trained.params, batches, trained.calibration)
    ms = latency(trained, REPEATS, batches[0].inputs.points.shape[1])["median"]
    return found, {"latency_ms": ms, "throughput_hz": 1e3 / ms, "parameters": network.count(trained.params)}


def frame(batches: list[Batch], number: int) -> Batch:
    """One of the frames, without batch axis."""
    return jax.tree.map(lambda a: np.asarray(a)[number % CHUNK], batches[number // CHUNK])


def _of_images(judged: views.Judgement | vlm.Answer, targets: Any) -> Predictions:
    return Predictions(np.asarray(judged.path), np.asarray(judged.dead_end), None, targets)


def of_clip(config: Config, batches: list[Batch]) -> tuple[Predictions, dict[str, Any]] | str:
    """What CLIP says; or why it says nothing."""
    spec = clip.ClipSpec(model=config.clip_model, weights=config.clip_weights)
    try:
        encode = clip.load(spec)
    except ValueError as error:
        return str(error)
    towards, parts, begun = clip.prompt_weights(spec, encode), [], time.perf_counter()
    for batch in batches:
        x = batch.inputs
        judged = clip.judge(encode, towards, np.asarray(x.images), x.rig, np.asarray(x.image_valid))
        parts.append(_of_images(judged, jax.tree.map(np.asarray, batch.targets)))
    ms = 1e3 * (time.perf_counter() - begun) / (CHUNK * len(batches))
    return validate.joined(parts), {"latency_ms": ms, "throughput_hz": 1e3 / ms}


def of_vlm(config: Config, batches: list[Batch]) -> tuple[Predictions, dict[str, Any]] | str:
    """What a vision-language model says of some of the frames; or why it says nothing."""
    if not config.vlm_url:
        return "not asked: give --vlm-url"
    spec = vlm.VlmSpec(base_url=config.vlm_url, model=config.vlm_model, key_variable=config.vlm_key)
    index = np.unique(np.linspace(0, config.frames - 1, config.vlm_frames).astype(int))
    x, targets = jax.tree.map(lambda *a: np.stack(a), *[frame(batches, k) for k in index])
    answer = vlm.ask_all(spec, x.images, x.rig, x.image_valid)
    silent = sorted({problem for problem in answer.problem if problem})
    if all(answer.problem):
        return f"no answers: {silent[0]}"
    ms = 1e3 * float(np.nanmedian(answer.seconds))
    extra: dict[str, Any] = {"latency_ms": ms, "throughput_hz": 1e3 / ms, "frames": len(index)}
    if silent:
        extra["note"] = f"{sum(map(bool, answer.problem))} of {len(index)} frames without an answer, such as: {silent[0]}"
    return _of_images(answer, targets), extra


def by_family(found: Predictions, families: tuple[str, ...], wanted: tuple[str, ...]) -> dict[str, Any]:
    """Figures of each family."""
    out = {}
    for name in wanted:
        of_it = np.asarray(found.targets.family) == families.index(name)
        if of_it.any():
            part = validate.only(found, of_it)
            out[name] = {k: _number(v) for k, v in validate.figures(part).items()} | {"frames": int(of_it.sum())}
    return out


def by_stratum(found: Predictions) -> dict[str, Any]:
    """Interior AUROC where something is in view that one sensor alone cannot judge."""
    out = {}
    for name, bit in dataset.STRATUM_BITS.items():
        seen = (np.asarray(found.targets.strata_seen) & bit) > 0
        if seen.any():
            value = validate.figures(validate.only(found, seen))["interior_auroc"]
            out[name] = {"interior_auroc": _number(value), "frames": int(seen.sum())}
    return out


def pictured(
    config: Config, found: Predictions, batches: list[Batch], families: tuple[str, ...]
) -> list[dict[str, Any]]:
    """Rows for a picture like the paper's Fig. 3: frames with dead ends in view, of as many families as there are."""
    t = found.targets
    in_view = (t.dead_end & t.valid & (t.visibility == NOW)).sum(axis=(1, 2)) >= 60  # cells: 2.4 m^2
    order = np.random.default_rng(config.seed).permutation(np.flatnonzero(in_view))
    turn = [int(np.sum(t.family[order[:k]] == t.family[n])) for k, n in enumerate(order)]  # its family's how-many-th
    chosen = order[np.argsort(turn, kind="stable")][: config.pictured]
    assert found.dead is not None
    rows = []
    for k in sorted(chosen, key=lambda k: t.family[k]):
        x, true = frame(batches, k)
        fields = ("dead_end", "valid", "visibility", "inside", "interior", "path")
        ended = "closed" if true.closed else "open"
        rows.append({name: getattr(true, name) for name in fields} | {
            "title": f"{families[true.family]}:{true.seed} ({ended})", "images": x.images, "local_map": x.local_map,
            "p_dead": found.dead[k] / 65535, "p_open": found.path[k], "p_flag": found.flag[k],
        })  # fmt: skip
    return rows


def with_losses(config: Config, batches: list[Batch], judged: dict[str, Predictions]) -> dict[str, Any]:
    """Accuracy on the first frames when sensors fail, next to the rule and the network that knows LiDAR only."""
    usual = batches[: config.loss_frames // CHUNK]
    trained = weights.load(config.weights or weights.SHIPPED)
    ask = lambda frames, change=None: validate.predict(  # noqa: E731
        trained.spec, trained.params, frames, trained.calibration, change
    )
    before = {title: judged[name] for title, name in AS_BEFORE.items() if name in judged}
    found = {title: validate.only(values, np.arange(config.loss_frames)) for title, values in before.items()}
    found |= {name: ask(usual, change) for name, change in faults.cases(config.seed).items()}
    for name, sensors in POORER.items():
        frames, _ = gathered(config, config.loss_frames, sensors, re.sub(r"\W+", "-", name))
        found[name] = ask(frames)
    columns = ("accuracy", "accuracy_stable", "dead_end_f1", "cell_auroc")
    said = {name: validate.figures(values) for name, values in found.items()}
    finite = {name: bool(np.isfinite(p.path).all() and np.isfinite(p.flag).all()) for name, p in found.items()}
    return {name: {c: _number(v[c]) for c in columns} | {"finite": finite[name]} for name, v in said.items()}


def main(config: Config) -> dict[str, Any]:
    """Judge and write the table."""
    config.out.mkdir(parents=True, exist_ok=True)
    batches, families = gathered(config, config.frames, dataset.FrameSpec())
    files = {"drnav": config.weights or weights.SHIPPED}
    files |= {name: config.ablations / f"{name}.safetensors" for name in ABLATIONS}
    rows, strata, judged, per_family = {}, {}, {}, {}
    for name, file in files.items():
        said = of_network(file, batches)
        if said is None:
            rows[name] = {"note": "weights not available"}
            continue
        rows[name], strata[name] = row(*said), by_stratum(said[0])
        per_family[name], judged[name] = by_family(said[0], families, families), said[0]
    for name, judge in (("clip", of_clip), ("vlm", of_vlm)):
        said = judge(config, batches)
        rows[name] = {"note": said} if isinstance(said, str) else row(*said)
    begun = time.perf_counter()
    judged["geometric"] = rule = validate.by_rule(batches, BevSpec(), 0.25)
    ms = 1e3 * (time.perf_counter() - begun) / len(rule.path)
    rows["geometric"] = row(rule, {"parameters": 0})
    rows["geometric"]["note"] = f"judging the ways on the rule's map took {ms:.1f} ms per frame on the host"
    per_family["geometric"], strata["geometric"] = by_family(rule, families, families), by_stratum(rule)
    held = tuple(name for name in families if name in worlds.HELD_OUT)
    known = tuple(name for name in families if name not in held)
    pick = lambda names: {  # noqa: E731
        who: {name: values[name] for name in names if name in values} for who, values in per_family.items()
    }
    result = {
        "experiment": "table1_detection", "split": config.split, "seed": config.seed, "frames": config.frames,
        "rows": rows, "strata": strata, "families": pick(known), "unseen_families": pick(held),
    }  # fmt: skip
    ours = judged.get("drnav")
    if ours is not None and config.loss_frames:
        result["sensor_loss"] = with_losses(config, batches, judged)
    named = f"table1-{config.split}-{config.seed}"
    report.write(config.out / f"{named}.json", result)
    if ours is not None:
        file = viz.samples(config.out / f"{named}.png", pictured(config, ours, batches, families))
        print(f"table1: wrote {file}", file=sys.stderr)
    else:
        print("table1: there are no weights of the fusion network; train some with `drnav train`.", file=sys.stderr)
    return result


def table(result: dict[str, Any]) -> str:
    """The rows as text."""
    lines = [f"{'':14}" + "".join(f"{name[:12]:>13}" for name in COLUMNS)]
    for name, values in result["rows"].items():
        cells = [values.get(column) for column in COLUMNS]
        shown = (f"{v:>13,}" if isinstance(v, int) else f"{'-':>13}" if v is None else f"{v:>13.3f}" for v in cells)
        lines.append(f"{name:14}" + "".join(shown) + (f"  {values['note']}" if "note" in values else ""))
    for name, values in result.get("sensor_loss", {}).items():
        lines.append(f"  {name:26}" + "  ".join(f"{k} {v:.3f}" for k, v in values.items() if isinstance(v, float)))
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(script(Config, main, table, __doc__))
