"""What can be said on the command line, and how mistakes are answered."""

import contextlib
import dataclasses
import io
import re
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import tyro

from drnav_jax import evaluate, sources
from drnav_jax.planning import PLANNERS

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
        world: Seeded family of worlds: open, u, corridor, t, t-both, l, lobby, room, glass, dock, cars, trail, field,
            maze, office, site, or an open twin such as u-open. With --episodes N the worlds of SEED to SEED+N-1.
        map: map_server yaml; or, with --resolution, an image of a floor plan: light = free, a light outside is filled.
        barn: BARN .world file, or a folder of them; brings its own start, goal, tolerance and time limit.
        movingai: Moving AI .map file. Trips of FILE.scen if it is there, else sampled ones.
        resolution: Edge of a pixel or Moving AI cell [m].
        start: Where the robot starts [m, m, rad].
        goal: Where it shall go [m, m].
        episodes: Worlds of a family; sampled trips on a map; repeats, with other sensor noise, of a given trip.
        predictor: Where dead-end evidence comes from.
        weights: Of the fusion network, from `drnav train`.
        recovery: What planners do when stuck; nav2: clear, spin, wait and back up in turn.
        no_cameras: The robot has a LiDAR only; the geometric rule stands in for the network.
        risk_weight: Lambda of eq. 1 and 7; 0 = dead ends do not matter.
        horizon: H, how far ahead the goal generator rolls its candidates out [s]; the other planners have none.
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
    predictor: Literal["fusion", "geometric", "oracle", "none"] = "fusion"
    weights: Annotated[Path | None, _flag("FILE", "default: those that come with drnav")] = None
    no_cameras: bool = False
    recovery: Annotated[
        Literal["drnav", "nav2", "none"] | None, _flag("drnav|nav2|none", "default: each planner's own")
    ] = None
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
    """Drive one planner.

    Attributes:
        explain: Which critic decided? Print the costs behind the choices, term by term, and write those of every tick,
            also of the ten best candidates, to explain.jsonl.
    """

    planner: Annotated[str, tyro.conf.arg(metavar="NAME", help=f"One of {PLANNER_NAMES}.")] = "drnav"
    explain: bool = False


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
        scaling: Measure instead how times and memory grow over candidates, steps, robots and maps; folder for the table and
            the plot.
        json: Print one JSON object on stdout, and nothing else there.
    """

    quick: bool = False
    scaling: Annotated[Path | None, _flag("DIR", "")] = None
    json: bool = False


@dataclasses.dataclass(frozen=True)
class Worlds:
    """Draw a world - dead ends, cameras, LiDAR -, or a sheet of all families.

    Attributes:
        world: Seeded family of worlds.
        gallery: A contact sheet of every family, closed and open.
        seed: Of the sensors' noise; with --gallery of the worlds.
        split: Which worlds a family's seeds mean.
        robot_radius: Footprint radius that dead ends are meant for [m].
        out: Folder for the picture.
    """

    world: Annotated[str | None, _flag("FAMILY:SEED", "")] = None
    gallery: bool = False
    seed: Annotated[int, _flag("N")] = 0
    split: Literal["train", "val", "test"] = "test"
    robot_radius: Annotated[float, _flag("M")] = evaluate.Setup.robot_radius
    out: Annotated[Path | None, _flag("DIR", "default: results/worlds")] = None


@dataclasses.dataclass(frozen=True)
class Dataset:
    """Gather training frames: cameras, LiDAR, known map and truth, in worlds by the hundred.

    Attributes:
        frames: How many.
        split: Of the worlds; families that are held out of training are in test only.
        seed: Of all that is drawn.
        families: Closed families, each gathered with its open twin.
        litter: Share of the worlds in which legs of chairs and tables, posts and rough walls are added.
        charted: Share that are sensed as occupancy grids are, as every map is.
        out: Folder for the shards; the same command goes on where it was interrupted.
        workers: Shards made side by side.
        json: Print the manifest's counts as one JSON object on stdout, and nothing else there.
    """

    out: Annotated[Path, _flag("DIR")]
    frames: Annotated[int, _flag("N")] = 20_000
    split: Literal["train", "val", "test"] = "train"
    seed: Annotated[int, _flag("N")] = 0
    families: Annotated[str | None, _flag("A,B,...", "default: all of the split")] = None
    litter: Annotated[float, _flag("SHARE")] = 0.0
    charted: Annotated[float, _flag("SHARE")] = 0.0
    workers: Annotated[int, _flag("N")] = 2
    json: bool = False


@dataclasses.dataclass(frozen=True)
class Train:
    """Train the fusion network.

    Attributes:
        out: Folder for checkpoints, logs and weights.
        data: Folders of training sets (`drnav dataset`), drawn from as one.
        stream: Gather frames while training, in worlds without end.
        validation: Folder of a validation set (`drnav dataset --split val`).
        config: YAML or JSON file of settings (`train.TrainSpec`), such as `steps: 6000`.
        resume: Go on from the last checkpoint in --out.
        json: Print the figures as one JSON object on stdout, and nothing else there.
    """

    out: Annotated[Path, _flag("DIR")]
    validation: Annotated[Path, _flag("DIR")]
    data: Annotated[tuple[Path, ...], _flag("DIR", "")] = ()
    stream: bool = False
    config: Annotated[Path | None, _flag("FILE", "")] = None
    resume: bool = False
    json: bool = False


Command: TypeAlias = Run | Compare | Worlds | Dataset | Train | Bench
_COMMANDS = (
    Annotated[Run, tyro.conf.subcommand("run")]
    | Annotated[Compare, tyro.conf.subcommand("compare")]
    | Annotated[Worlds, tyro.conf.subcommand("worlds")]
    | Annotated[Dataset, tyro.conf.subcommand("dataset")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
)


def parse(argv: list[str]) -> Command:
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
                _COMMANDS,  # pyright: ignore[reportArgumentType] # a union of annotated types
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
