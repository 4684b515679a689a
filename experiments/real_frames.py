"""What does the network say of frames that were really recorded?

    python experiments/real_frames.py --data DIR --out DIR

`--data` is a rosbag with one or more cameras, a LiDAR and their calibration; the defaults fit 16 frames of the KITTI drive
2011_09_26 (one camera, 1.65 m high, 81 x 29 degrees; a 64-ring LiDAR 1.73 m high; no odometry). Each frame stands for
itself: its map is made from its own scan. The camera's image is redrawn as one the network knows (96x96, 90 degrees, level;
black where the real one sees nothing), the cloud as that of a LiDAR with 16 rings half a metre above the ground, which is
found in the cloud.

Nobody has labelled these frames. The figures say how much is called a dead end, with the camera and without it; whether
what LiDAR holds to be free is called traversable, and what it holds to be occupied is not; and how long an answer takes.
"""

import dataclasses
import math
import sys
import time
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from scipy.special import expit

from drnav_jax import bags, report, viz
from drnav_jax.filter import FilterParams, FilterSpec, belief
from drnav_jax.models import bev, fusion, weights
from drnav_jax.models.batch import FREE, OCCUPIED
from drnav_jax.models.fusion import FusionParams
from drnav_jax.models.network import NetworkSpec
from drnav_jax.scripts import script
from drnav_jax.types import LocalMap, Observation

WAYS = ("front", "left", "right")


@dataclasses.dataclass(frozen=True)
class Config:
    """What is judged, and where results go.

    Attributes:
        data: The bag: a folder with metadata.yaml, or a `.bag` file.
        out: Folder for pictures and figures.
        weights: Of the network; None = those that come with the package.
        images: Topics of the cameras; none named = all there are.
        points: Topic of the LiDAR, if there are several.
        base_frame: The frame that stands for base_link.
        base_height: Its origin above the ground, about [m]: the ground is looked for there.
        level: Find the ground in each cloud; without (a 2-D LiDAR's scans have none) it lies `base_height` below.
        body: Points nearer than this are the vehicle itself [m].
        shape: (h, w) of the images that the network is given [pixels].
        fov: Their horizontal field of view [degrees].
        frames: At most so many, evenly spread; 0 = all.
        columns: Of the contact sheet.
        repeats: Answers per frame that are timed.
        note: Line at the foot of the sheet, such as whose recording it is.
        json: Print one JSON object on stdout, and nothing else there.
    """

    data: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("results") / "real_frames"
    weights: Path | None = None
    images: tuple[str, ...] = ()
    points: str | None = None
    base_frame: str = "velodyne"
    base_height: float = 1.73
    level: bool = True
    body: float = 2.0
    shape: tuple[int, int] = (96, 96)
    fov: float = 90.0
    frames: int = 16
    columns: int = 4
    repeats: int = 10
    note: str = ""
    json: bool = False

    def __post_init__(self) -> None:
        """Check counts."""
        if self.frames < 0 or min(self.columns, self.repeats) < 1:
            raise ValueError(
                f"--frames must be >= 0, --columns and --repeats >= 1, got {self.frames}, {self.columns} and "
                f"{self.repeats}."
            )


class Said(NamedTuple):
    """The network's answer to one frame, on the grid of the robot."""

    path: Any  # [3] calibrated logits
    flag: Any  # [] calibrated logit
    p_dead: Any  # [h, w]
    traversable: Any  # [h, w] probability
    known: Any  # [h, w] classes of `models.bev`
    judged: Any  # [h, w] bool, cells for which there is evidence
    rule: Any  # [h, w] bool, the geometric rule sees a dead end


@partial(jax.jit, static_argnames="held")
def mapped(held: FilterSpec, seen: Observation) -> LocalMap:
    """The map of one scan."""
    params = FilterParams()
    blank = belief.init(held, params, seen.pose[:2])
    return belief.local_map(held, belief.observe(held, params, blank, seen.pose, seen.points, seen.point_valid)[0])


@partial(jax.jit, static_argnames="spec")
def asked(spec: NetworkSpec, params: FusionParams, seen: Observation, local: LocalMap) -> Said:
    """The network's answer."""
    out = fusion.answer(spec, params, seen, local)
    read = fusion.inputs_of(spec, params, seen, local)
    known = bev.classes(spec.bev, local, seen.pose)
    return Said(
        path=out.path, flag=out.flag, p_dead=jax.nn.sigmoid(out.dead), traversable=jax.nn.sigmoid(out.traversable),
        known=known, judged=fusion.trust(spec, params, seen, known) > 0,
        rule=(read.rule_p[0] > 0.1) & (read.rule_confidence[0] > 0),  # the rule knows two answers: `GeometricParams`
    )  # fmt: skip


def spec_of(config: Config) -> bags.BagSpec:
    """How the bag is read."""
    return bags.BagSpec(
        images=config.images or None, points=config.points, odometry="",  # each frame stands for itself
        base_frame=config.base_frame, base_height=config.base_height, level=config.level,
        image=bags.ImageSpec(config.shape, math.radians(config.fov)), scan=bags.ScanSpec(min_range=config.body),
    )  # fmt: skip


def chosen(config: Config) -> list[bags.Recorded]:
    """The frames."""
    if not config.frames:
        return list(bags.read(config.data, spec_of(config)))
    count = sum(1 for _ in bags.read(config.data, spec_of(config)))  # one at a time: a bag may be larger than the memory
    wanted = set(np.linspace(0, count - 1, min(config.frames, count)).round().astype(int).tolist())
    return [frame for k, frame in enumerate(bags.read(config.data, spec_of(config))) if k in wanted]


def _share(mask: np.ndarray, among: np.ndarray) -> float:
    return float(mask[among].mean()) if among.any() else math.nan


def figures(said: Said, blind: Said) -> dict[str, Any]:
    """Figures of one frame.

    Args:
        said: The network's answer, on the host.
        blind: Its answer without cameras.
    """
    judged = np.asarray(said.judged)
    free, taken = np.asarray(said.known) == FREE, np.asarray(said.known) == OCCUPIED
    return {
        "path_logits": dict(zip(WAYS, np.asarray(said.path, float).tolist(), strict=True)),
        "p_open": dict(zip(WAYS, expit(said.path).tolist(), strict=True)),
        "p_open_without_camera": dict(zip(WAYS, expit(blind.path).tolist(), strict=True)),
        "p_dead_end": float(expit(said.flag)),
        "dead_end": bool(said.flag > 0),
        "share_judged": float(judged.mean()),
        "share_dead": _share(said.p_dead > 0.5, judged),
        "share_dead_without_camera": _share(blind.p_dead > 0.5, judged),
        "share_dead_by_rule": _share(np.asarray(said.rule), judged),
        "free_said_traversable": _share(said.traversable > 0.5, free),
        "occupied_said_not_traversable": _share(said.traversable <= 0.5, taken),
        "finite": all(bool(np.isfinite(a).all()) for a in (said.path, said.flag, said.p_dead, said.traversable)),
    }


def timed(spec: NetworkSpec, params: FusionParams, seen: Observation, repeats: int) -> list[float]:
    """Times from an observation to the network's answer, its map included [ms]."""
    spent = []
    for _ in range(repeats):
        begun = time.perf_counter()
        jax.block_until_ready(asked(spec, params, seen, mapped(FilterSpec(), seen)))
        spent.append(1e3 * (time.perf_counter() - begun))
    return spent


def picture(frame: bags.Recorded, said: Said, number: int, since: float) -> viz.Predicted:
    """What is drawn of a frame."""
    seen = frame.observation
    return viz.Predicted(
        title=f"{number + 1}   {frame.time - since:.1f} s", photos=[p for p in frame.photos if p is not None],
        cloud=frame.cloud, points=np.asarray(seen.points)[np.asarray(seen.point_valid)],
        local_map=np.asarray(said.known), judged=np.asarray(said.judged), p_dead=np.asarray(said.p_dead),
        traversable=np.asarray(said.traversable), p_open=expit(said.path), p_flag=float(expit(said.flag)),
    )  # fmt: skip


def summary(rows: list[dict[str, Any]], spent: list[float]) -> dict[str, Any]:
    """Over all frames."""
    names = [name for name in rows[0] if name.startswith(("share", "free", "occupied"))]
    known = {name: [row[name] for row in rows if math.isfinite(row[name])] for name in names}
    mean = {name: float(np.mean(values)) if values else math.nan for name, values in known.items()}
    return mean | {
        "frames": len(rows), "dead_end_frames": sum(row["dead_end"] for row in rows),
        "open_frames": {way: sum(row["p_open"][way] >= 0.5 for row in rows) for way in WAYS},
        "finite": all(row["finite"] for row in rows),
        "latency_ms": {"median": float(np.median(spent)), "p95": float(np.percentile(spent, 95)), "max": max(spent)},
    }  # fmt: skip


def main(config: Config) -> dict[str, Any]:
    """Judge, draw and write."""
    trained = weights.load(config.weights or weights.SHIPPED)
    spec, params = trained.spec, fusion.params_of(trained)
    recorded = chosen(config)
    if not recorded:
        raise ValueError(f"{config.data} holds no frame: is its LiDAR's topic empty?")
    rows, drawn, spent = [], [], []
    for k, frame in enumerate(recorded):
        seen = jax.tree.map(jnp.asarray, frame.observation)
        local = mapped(FilterSpec(), seen)
        said = jax.device_get(asked(spec, params, seen, local))
        blind = jax.device_get(asked(spec, params, seen._replace(image_valid=jnp.zeros_like(seen.image_valid)), local))
        times = timed(spec, params, seen, config.repeats)
        spent += times
        ground = frame.ground
        rows.append({
            "time": frame.time, **figures(said, blind), "points": int(np.sum(frame.observation.point_valid)),
            "lidar_height": None if ground is None else config.base_height - ground.height,
            "ground_tilt_deg": None if ground is None else math.degrees(ground.tilt), "latency_ms": float(np.median(times)),
        })  # fmt: skip
        drawn.append(picture(frame, said, k, recorded[0].time))
    draw = partial(viz.predictions, origin=spec.bev.origin, resolution=spec.bev.resolution, note=config.note)
    for k, frame in enumerate(drawn):
        draw(config.out / f"frame{k + 1:02d}.png", [frame])
    draw(config.out / "frames.png", drawn, columns=config.columns)
    result = {
        "experiment": "real_frames", "data": config.data.name, "weights_sha256": trained.sha256,
        "image": {"shape": list(config.shape), "fov_deg": config.fov}, "summary": summary(rows, spent), "frames": rows,
    }  # fmt: skip
    report.write(config.out / "frames.json", result)
    return result


if __name__ == "__main__":
    sys.exit(script(Config, main, lambda done: report.outline(done["summary"]), __doc__))
