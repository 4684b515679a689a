"""The command line `drnav`: `run`, `compare` and `bench`. Thin: it reads flags, calls jobs, writes files."""

import contextlib
import dataclasses
import io
import math
import os
import re
import sys
import time
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import jax
import tyro

from drnav_jax import __version__, bench, evaluate, report, sources
from drnav_jax.planning import PLANNERS, planner
from drnav_jax.sim import episode
from drnav_jax.viz import MissingExtra
from drnav_jax.worlds import Scene

PICTURES = 6  # episodes that get a trajectory picture
MAX_FRAMES = 150  # of the film
SPEC = episode.EpisodeSpec(chunk_ticks=10)  # a frame per second; Ctrl-C is heard as often
INTERRUPTED = 130  # exit code, as shells have it
PLANNER_NAMES = ", ".join(PLANNERS)


def _flag(metavar: str, default: str | None = None) -> Any:
    """How a flag is shown; `default` stands in for a None that would say nothing."""
    if default is None:
        return tyro.conf.arg(metavar=metavar)
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"({default})" if default else "")


@dataclasses.dataclass(frozen=True)
class Trial:
    """What is driven, where and with what.

    Attributes:
        world: Seeded family of worlds: open, u, corridor, t, l, or an open twin such as u-open. With --episodes N the
            worlds of SEED to SEED+N-1.
        map: map_server yaml; or, with --resolution, an image of a floor plan: light = free, a light outside is filled.
        barn: BARN .world file, or a folder of them; brings its own start, goal, tolerance and time limit.
        movingai: Moving AI .map file. Trips of FILE.scen if it is there, else sampled ones.
        resolution: Edge of a pixel or Moving AI cell [m].
        start: Where the robot starts [m, m, rad].
        goal: Where it shall go [m, m].
        episodes: Worlds of a family; sampled trips on a map; repeats, with other sensor noise, of a given trip.
        predictor: Where dead-end evidence comes from.
        risk_weight: Lambda of eq. 1 and 7; 0 = dead ends do not matter.
        horizon: H, how far ahead candidates are rolled out [s].
        seed: Of sensor noise and of sampled trips.
        split: Which worlds a family's seeds mean.
        physics: How the robot moves; mjx: with inertia, grip and contact forces.
        mjx_boxes: Boxes that a world may have with mjx, a map's walls merged into rectangles.
        time_limit: Time allowed per episode [s].
        robot_radius: Footprint radius [m].
        max_speed: Fastest speed [m/s].
        lidar_range: Farthest a beam reaches [m].
        goal_tolerance: Distance to the goal that counts as arrived [m].
        out: Folder for summary.json, timing.json and pictures.
        no_pictures: Write no pictures and no film.
        json: Print one JSON object on stdout, and nothing else there.
    """

    world: Annotated[str | None, _flag("FAMILY:SEED", "")] = None
    map: Annotated[Path | None, _flag("FILE", "")] = None
    barn: Annotated[Path | None, _flag("FILE_OR_DIR", "")] = None
    movingai: Annotated[Path | None, _flag("FILE", "")] = None
    resolution: Annotated[float | None, _flag("M", f"Moving AI: default {sources.CELL:g}")] = None
    start: Annotated[str | None, _flag("X,Y,YAW", "default: the world's own, or sampled")] = None
    goal: Annotated[str | None, _flag("X,Y", "default: the world's own, or sampled")] = None
    episodes: Annotated[int, _flag("N")] = 1
    predictor: Literal["geometric", "oracle", "none"] = "geometric"
    risk_weight: Annotated[float | None, _flag("F", "default: the planner's")] = None
    horizon: Annotated[float | None, _flag("S", "default: the planner's, 4 s")] = None
    seed: Annotated[int, _flag("N")] = 0
    split: Literal["train", "val", "test"] = "test"
    physics: Literal["kinematic", "mjx"] = "kinematic"
    mjx_boxes: Annotated[int, _flag("N")] = evaluate.Setup.mjx_boxes
    time_limit: Annotated[float | None, _flag("S", "default: BARN 100; else 6 x optimal time, at least 60")] = None
    robot_radius: Annotated[float, _flag("M")] = evaluate.Setup.robot_radius
    max_speed: Annotated[float, _flag("M/S")] = evaluate.Setup.max_speed
    lidar_range: Annotated[float, _flag("M")] = evaluate.Setup.lidar_range
    goal_tolerance: Annotated[float | None, _flag("M", "default: BARN 1.0; else 0.75")] = None
    out: Annotated[Path | None, _flag("DIR", "default: results/COMMAND-SOURCE")] = None
    no_pictures: bool = False
    json: bool = False


@dataclasses.dataclass(frozen=True)
class Run(Trial):
    """Drive one planner."""

    planner: Annotated[str, tyro.conf.arg(metavar="NAME", help=f"One of {PLANNER_NAMES}.")] = "drnav"


@dataclasses.dataclass(frozen=True)
class Compare(Trial):
    """Drive several planners on identical worlds, trips and seeds."""

    planners: Annotated[
        str, tyro.conf.arg(metavar="A,B,...", help=f"Some of {PLANNER_NAMES}; ratios are first to others.")
    ] = "drnav,dwa"


@dataclasses.dataclass(frozen=True)
class Bench:
    """Measure how long the parts take on this machine.

    Attributes:
        quick: Fewer repeats: a minute, rougher figures.
        json: Print one JSON object on stdout, and nothing else there.
    """

    quick: bool = False
    json: bool = False


Command = (
    Annotated[Run, tyro.conf.subcommand("run")]
    | Annotated[Compare, tyro.conf.subcommand("compare")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
)


class Finished(NamedTuple):
    """What came out of all planners that were driven."""

    evaluations: dict[str, evaluate.Evaluation]
    interrupted: bool


def parse(argv: list[str]) -> Run | Compare | Bench:
    """Flags -> a command.

    Raises:
        ValueError: On a mistake, in one line.
        SystemExit: After printing the help.
    """
    joined: list[str] = []
    for word in argv:  # "-2,3,1.57" is a value, though it looks like a flag
        if joined and joined[-1] in ("--start", "--goal") and not word.startswith("--"):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(
                Command,  # pyright: ignore[reportArgumentType] # a union of annotated types
                prog="drnav",
                description="Drive robots that do not get trapped in dead ends.",
                args=joined,
                config=(tyro.conf.FlagCreatePairsOff,),
            )
    except SystemExit as stop:
        if not stop.code:
            raise
        raise ValueError(_one_line(said.getvalue())) from None


def _one_line(box: str) -> str:
    """The gist of tyro's framed message: its first paragraph, and the flags it suggests."""
    lines = [line.strip(" │") for line in box.splitlines() if not line.startswith(("╭", "╰"))]
    paragraphs = [" ".join(part.split("\n")).strip() for part in re.split(r"\n[─-]+\n", "\n".join(lines))]
    first = paragraphs[0 if box.startswith("╭") or len(paragraphs) == 1 else 1].rstrip(".")  # plain boxes: the title
    if "Perhaps you meant" in box:
        flags = [line.split()[0] for line in lines if re.match("--[a-z]", line)]
        first += f"; perhaps you meant {' or '.join(dict.fromkeys(flags))}"
    where = re.search(r"drnav[ a-z]* --help", box)
    return f"{first}; see {where[0] if where else 'drnav --help'}"


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
    same = ("predictor", "risk_weight", "horizon", "robot_radius", "max_speed", "lidar_range", "goal_tolerance")
    common: Any = {name: getattr(args, name) for name in (*same, "time_limit", "seed", "physics", "mjx_boxes")}
    return {name: evaluate.Setup(planner=name, **common) for name in names}


def folder_of(args: Run | Compare) -> Path:
    """Where to write, made if need be.

    Raises:
        ValueError: If it cannot be.
    """
    source = args.world or str((args.map or args.barn or args.movingai or Path()).resolve().stem)
    out = args.out or Path("results") / f"{_command(args)}-{re.sub(r'[^A-Za-z0-9._-]+', '-', source)}"
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "summary.json").open("a").close()
    except OSError as error:
        raise ValueError(f"{out}: cannot be written to ({error.strerror}); choose another --out.") from None
    return out


def _command(args: Run | Compare) -> str:
    return "run" if isinstance(args, Run) else "compare"


class Bar:
    """A progress bar on a terminal; one line when all is over elsewhere."""

    def __init__(self, name: str, total: int) -> None:
        """Show that it has begun."""
        self.name, self.total, self.stream = name, total, sys.stderr
        self.done, self.begin, self.live = 0, time.perf_counter(), sys.stderr.isatty()
        self._show("compiling")

    def _show(self, note: str) -> None:
        if self.live:
            filled = round(24 * self.done / self.total)
            bar = "#" * filled + "." * (24 - filled)
            self.stream.write(f"\r\033[K{self.name:>14} [{bar}] {self.done}/{self.total} episodes, {note}")
            self.stream.flush()

    def __call__(self, done: int) -> None:
        """Take note of how many episodes are finished."""
        self.done, spent = done, time.perf_counter() - self.begin
        self._show(f"{spent:.0f} s" + (f", {done / spent:.2f}/s" if done else ""))

    def close(self) -> None:
        """Leave one line behind."""
        spent = time.perf_counter() - self.begin
        start = "\r\033[K" if self.live else ""
        self.stream.write(f"{start}{self.name:>14}  {self.done}/{self.total} episodes in {spent:.1f} s\n")
        self.stream.flush()


def drive(trips: list[evaluate.Trip], setups: dict[str, evaluate.Setup]) -> Finished:
    """Drive every planner; an interrupt keeps the episodes that are finished."""
    evaluations: dict[str, evaluate.Evaluation] = {}
    for name, setup in setups.items():
        bar = Bar(name, len(trips))
        try:
            evaluations[name] = evaluate.evaluate(trips, setup, progress=bar, spec=SPEC)
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
    config = {name: flags[name] for name in sorted(flags) if name not in ("out", "json", "no_pictures")}
    rule = "6 x the optimal time, at least 60 s"
    if args.time_limit is not None:
        rule = f"{args.time_limit:g} s, as asked for"
    elif args.barn is not None:
        rule = "100 s, as BARN has it"
    head = {
        "command": _command(args), "version": __version__, "config": config, "time_limit_rule": rule,
        "optimal_rule": "shortest any-angle path at the robot's radius + planning margin, over the fastest speed",
        "interrupted": finished.interrupted,
    }  # fmt: skip
    each = {name: {"episodes": e.records, "summary": e.summary} for name, e in finished.evaluations.items()}
    if isinstance(args, Run):
        return head | each[args.planner]
    times = {name: evaluate.times_to_goal(e) for name, e in finished.evaluations.items()}
    return head | {"planners": each, "ratios": report.ratios(times)}


def draw(out: Path, trips: list[evaluate.Trip], setups: dict[str, evaluate.Setup], finished: Finished) -> None:
    """Pictures of the first episodes with the belief of the first planner that has one, a film of the first episode."""
    believers = [name for name in finished.evaluations if planner(name).risk_in_route or planner(name).exposure]
    first = (believers or list(finished.evaluations))[0]
    setup, evaluation = setups[first], finished.evaluations[first]
    spec = evaluate.spec_of(setup.planner, setup.predictor, setup.num_candidates)
    keys = jax.random.split(jax.random.key(setup.seed), len(trips))
    for number, k in enumerate(evaluation.kept[:PICTURES], 1):
        trip = trips[k]
        assert trip.scene.start is not None
        drives = {}
        for name, e in finished.evaluations.items():
            if k in e.kept:
                path = evaluate.path_driven(e.result, k, trip.scene.start)
                drives[name] = report.Drive(path, e.records[e.kept.index(k)])
        batch = jax.tree.map(lambda a: a[0], evaluate.episode_params([trip], setup))
        states = episode.replay(evaluate.with_physics(SPEC, setup), evaluate.policy_of(spec), batch, keys[k])
        path = drives[first].path
        every = math.ceil(len(path) / SPEC.chunk_ticks / MAX_FRAMES) if number == 1 else 0
        believed = report.believe(states, spec.filter, path, SPEC.dt, every)
        file = out / ("trajectory.png" if number == 1 else f"trajectory-{number}.png")
        title = f"{trip.scene.name}: what {first} believed" if believers else f"{trip.scene.name}: what {first} saw"
        report.picture(file, trip.scene, drives, believed, trip.path, trip.goal_tolerance, title)
        if number == 1:
            report.film(out / "belief.gif", trip.scene, believed, trip.goal_tolerance, setup.robot_radius)


def _stdout_kept(json: bool) -> contextlib.AbstractContextManager:
    """With --json, what a library prints goes to stderr."""
    return contextlib.redirect_stdout(sys.stderr) if json else contextlib.nullcontext()


def perform(args: Run | Compare) -> int:
    """Drive, write and print; the exit code.

    Raises:
        ValueError: On a user's mistake, before anything is driven.
        OSError: If a file cannot be read or written.
    """
    begin = time.perf_counter()
    setups = setups_of(args)
    trips = evaluate.prepare(scenes_of(args), next(iter(setups.values())))
    out = folder_of(args)
    with _stdout_kept(args.json):
        finished = drive(trips, setups)
    if not finished.evaluations:
        print("drnav: interrupted before any episode was finished; nothing is written.", file=sys.stderr)
        return INTERRUPTED
    for old in [out / "belief.gif", *out.glob("trajectory*.png")]:
        old.unlink(missing_ok=True)
    result = result_of(args, finished)
    text = report.dumps(result)
    (out / "summary.json").write_text(text + "\n")
    if args.json:
        print(text, flush=True)
    else:
        summaries = {name: e.summary for name, e in finished.evaluations.items()}
        print(report.table(summaries, result.get("ratios")), flush=True)
    walls = {name: {"episodes": len(e.records), "wall_s": e.wall_s} for name, e in finished.evaluations.items()}
    interrupted = finished.interrupted
    if not (args.no_pictures or interrupted):
        try:
            with _stdout_kept(args.json):
                draw(out, trips, setups, finished)
        except MissingExtra as error:
            print(f"drnav: no pictures: {error}", file=sys.stderr)
        except KeyboardInterrupt:
            interrupted = True
    timing = {"planners": walls, "total_s": time.perf_counter() - begin, "backend": jax.default_backend()}
    (out / "timing.json").write_text(report.dumps(timing) + "\n")
    note = "interrupted; what was finished is in" if interrupted else "wrote"
    print(f"drnav: {note} {out}/", file=sys.stderr)
    return INTERRUPTED if interrupted else 0


def _measure(args: Bench) -> int:
    with _stdout_kept(args.json):
        result = bench.run(quick=args.quick)
    print(report.dumps(result) if args.json else report.outline(result))
    return 0


def _cache_programs() -> None:
    """Keep compiled programs for the next command, unless somebody has already said where."""
    if jax.config.values["jax_compilation_cache_dir"] is not None:
        return
    root = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(root) / "drnav_jax"
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def main(argv: list[str] | None = None) -> int:
    """The console script; returns the exit code (0; 2 = the user's mistake; 130 = interrupted)."""
    argv = sys.argv[1:] if argv is None else argv
    if argv == ["--version"]:
        print(f"drnav {__version__}")
        return 0
    try:
        args = parse(argv)
        _cache_programs()
        return _measure(args) if isinstance(args, Bench) else perform(args)
    except SystemExit:
        return 0
    except KeyboardInterrupt:
        print("drnav: interrupted.", file=sys.stderr)
        return INTERRUPTED
    except (ValueError, OSError) as error:
        print(f"drnav: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
