"""`drnav run` and `drnav compare`: drive, write, print."""

import dataclasses
import math
import re
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax

from drnav_jax import __version__, evaluate, report, sources
from drnav_jax.cli import explain
from drnav_jax.cli.flags import Compare, Run, Trial
from drnav_jax.cli.terminal import Bar, stdout_kept
from drnav_jax.models import weights
from drnav_jax.planning import planner
from drnav_jax.scripts import INTERRUPTED
from drnav_jax.sim import episode
from drnav_jax.viz import MissingExtra
from drnav_jax.worlds import Scene

PICTURES = 6  # episodes that get a trajectory picture
MAX_FRAMES = 150  # of the film
SPEC = episode.EpisodeSpec(chunk_ticks=10)  # a frame per second; Ctrl-C is heard as often


class Finished(NamedTuple):
    """What came out of all planners that were driven."""

    evaluations: dict[str, evaluate.Evaluation]
    interrupted: bool


def scenes_of(args: Trial) -> list[Scene]:
    """The worlds and trips that the flags name; see `sources.load`."""
    flags = {field.name: getattr(args, field.name) for field in dataclasses.fields(sources.Source)}
    radius = args.robot_radius
    return sources.load(sources.Source(**flags), radius, radius + evaluate.plan_margin(evaluate.NavParams()))


def setups_of(args: Run | Compare) -> dict[str, evaluate.Setup]:
    """The setup of each planner.

    Raises:
        ValueError: If a planner is unknown or named twice, or a number is out of range.
    """
    names = [args.planner] if isinstance(args, Run) else [name.strip() for name in args.planners.split(",")]
    if len(set(names)) < len(names):
        raise ValueError(f"--planners names one twice: {', '.join(names)}.")
    same = ("weights", "recovery", "risk_weight", "horizon", "robot_radius", "max_speed", "lidar_range", "goal_tolerance")
    common: Any = {name: getattr(args, name) for name in (*same, "time_limit", "seed", "physics", "mjx_boxes")}
    common["predictor"] = _predictor(args)
    return {name: evaluate.Setup(planner=name, **common) for name in names}


def _predictor(args: Run | Compare) -> str:
    return "geometric" if lacking(args) else args.predictor


def lacking(args: Run | Compare) -> str:
    """What the fusion network lacks here if it is asked for, or "". A file that was named must be there."""
    if args.predictor != "fusion":
        return ""
    if args.no_cameras:
        return "the robot has no cameras"
    if args.weights is None and not weights.SHIPPED.is_file():
        return "this installation has no weights of the fusion network (train some with drnav train, give --weights)"
    return ""


def folder_of(args: Run | Compare) -> Path:
    """Where to write, made if need be.

    Raises:
        ValueError: If it cannot be.
    """
    source = args.world or str((args.map or args.barn or args.movingai or Path()).resolve().stem)
    out = args.out or Path("results") / f"{_command(args)}-{re.sub(r'[^A-Za-z0-9._-]+', '-', source)}"
    try:
        out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out).close()
    except OSError as error:
        raise ValueError(f"{out}: cannot be written to ({error.strerror}); choose another --out.") from None
    return out


def _command(args: Run | Compare) -> str:
    return "run" if isinstance(args, Run) else "compare"


def drive(trips: list[evaluate.Trip], setups: dict[str, evaluate.Setup], explained: bool = False) -> Finished:
    """Drive every planner; an interrupt keeps the episodes that are finished."""
    evaluations: dict[str, evaluate.Evaluation] = {}
    for name, setup in setups.items():
        bar = Bar(name, len(trips), "episodes")
        try:
            evaluations[name] = evaluate.evaluate(trips, setup, progress=bar, spec=SPEC, explained=explained)
        except KeyboardInterrupt:
            return Finished(evaluations, True)
        finally:
            bar.close()
        if evaluations[name].interrupted:
            return Finished(evaluations, True)
    return Finished(evaluations, False)


def result_of(args: Run | Compare, finished: Finished) -> dict[str, Any]:
    """The JSON object: nothing in it depends on when, or how fast, it was made."""
    flags = dataclasses.asdict(args)
    config = {name: flags[name] for name in sorted(flags) if name not in ("out", "json", "no_pictures", "explain")}
    rule = "6 x the optimal time, at least 60 s"
    if args.time_limit is not None:
        rule = f"{args.time_limit:g} s, as asked for"
    elif args.barn is not None:
        rule = "100 s, as BARN has it"
    head = {
        "command": _command(args), "version": __version__, "config": config, "predictor": _predictor(args),
        "time_limit_rule": rule,
        "optimal_rule": "shortest any-angle path at the robot's radius + planning margin, over the fastest speed",
        "interrupted": finished.interrupted,
    }  # fmt: skip
    each = {name: {"episodes": e.records, "summary": e.summary} for name, e in finished.evaluations.items()}
    if isinstance(args, Run):
        return head | each[args.planner]
    times = {name: evaluate.times_to_goal(e) for name, e in finished.evaluations.items()}
    return head | {"planners": each, "ratios": report.ratios(times)}


def draw(
    out: Path, trips: list[evaluate.Trip], setups: dict[str, evaluate.Setup], finished: Finished, explained: bool
) -> None:
    """Pictures of the first episodes with the belief of the first planner that has one, a film of the first episode."""
    believers = [name for name in finished.evaluations if planner(name).predicts]
    first = (believers or list(finished.evaluations))[0]
    setup, evaluation = setups[first], finished.evaluations[first]
    spec = setup.nav
    keys = jax.random.split(jax.random.key(setup.seed), len(trips))
    params = evaluate.episode_params(trips, setup)  # of all, so that worlds have the shapes that were compiled for
    for number, k in enumerate(evaluation.kept[:PICTURES], 1):
        trip = trips[k]
        assert trip.scene.start is not None
        drives = {}
        for name, e in finished.evaluations.items():
            if k in e.kept:
                path = evaluate.path_driven(e.result, k, trip.scene.start)
                drives[name] = report.Drive(path, e.records[e.kept.index(k)])
        one = jax.tree.map(lambda a, k=k: a[k], params)
        states = episode.replay(evaluate.equipped(SPEC, setup), evaluate.policy_of(spec, explained), one, keys[k])
        path = drives[first].path
        every = math.ceil(len(path) / SPEC.chunk_ticks / MAX_FRAMES) if number == 1 else 0
        believed = report.believe(states, spec.filter, path, SPEC.dt, every)
        file = out / ("trajectory.png" if number == 1 else f"trajectory-{number}.png")
        title = f"{trip.scene.name}: what {first} believed" if believers else f"{trip.scene.name}: what {first} saw"
        report.picture(file, trip.scene, drives, believed, trip.path, trip.goal_tolerance, title)
        if number == 1:
            report.film(out / "belief.gif", trip.scene, believed, trip.goal_tolerance, setup.robot_radius)


def perform(args: Run | Compare) -> int:
    """Drive, write and print; the exit code.

    Raises:
        ValueError: On a user's mistake, before anything is driven.
        OSError: If a file cannot be read or written.
    """
    begin = time.perf_counter()
    setups = setups_of(args)
    for setup in setups.values():
        evaluate.params_of(setup)  # weights that cannot be read are a mistake like any other
    trips = evaluate.prepare(scenes_of(args), next(iter(setups.values())))
    out = folder_of(args)
    lack = lacking(args)
    if lack and any(setup.evidence == "geometric" for setup in setups.values()):
        print(f"drnav: {lack}: the geometric rule predicts dead ends instead of the network.", file=sys.stderr)
    explained = isinstance(args, Run) and args.explain
    with stdout_kept(args.json):
        finished = drive(trips, setups, explained)
    if not finished.evaluations:
        print("drnav: interrupted before any episode was finished; nothing is written.", file=sys.stderr)
        return INTERRUPTED
    for old in [out / "belief.gif", out / "explain.jsonl", *out.glob("trajectory*.png")]:
        old.unlink(missing_ok=True)
    result = result_of(args, finished)
    text = report.write(out / "summary.json", result)
    if args.json:
        print(text, flush=True)
    else:
        summaries = {name: e.summary for name, e in finished.evaluations.items()}
        print(report.table(summaries, result.get("ratios")), flush=True)
    if explained:
        ((name, setup),) = setups.items()
        told = explain.told(finished.evaluations[name], setup.nav, SPEC.dt)
        explain.write(out / "explain.jsonl", told)
        if not args.json:
            print(f"\n{explain.table(told, name)}", flush=True)
    walls = {name: {"episodes": len(e.records), "wall_s": e.wall_s} for name, e in finished.evaluations.items()}
    interrupted = finished.interrupted
    if not (args.no_pictures or interrupted):
        try:
            with stdout_kept(args.json):
                draw(out, trips, setups, finished, explained)
        except MissingExtra as error:
            print(f"drnav: no pictures: {error}", file=sys.stderr)
        except KeyboardInterrupt:
            interrupted = True
    timing = {"planners": walls, "total_s": time.perf_counter() - begin, "backend": jax.default_backend()}
    report.write(out / "timing.json", timing)
    note = "interrupted; what was finished is in" if interrupted else "wrote"
    print(f"drnav: {note} {out}/", file=sys.stderr)
    return INTERRUPTED if interrupted else 0
