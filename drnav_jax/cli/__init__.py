"""The command line `drnav`. Thin: it reads flags, calls jobs, writes files."""

import sys

from drnav_jax import __version__, bench, report
from drnav_jax.bench import growth
from drnav_jax.cli import data, drive, learn, process
from drnav_jax.cli.flags import Bench, Command, Compare, Dataset, Run, Train, Trial, Worlds, parse
from drnav_jax.cli.terminal import stdout_kept
from drnav_jax.scripts import ended
from drnav_jax.viz import MissingExtra

__all__ = ["Bench", "Command", "Compare", "Dataset", "Run", "Train", "Trial", "Worlds", "main", "parse"]


def _measure(args: Bench) -> int:
    with stdout_kept(args.json):
        result = bench.run(quick=args.quick) if args.scaling is None else growth.measure(quick=args.quick)
    if args.scaling is not None:
        try:
            growth.write(args.scaling, result)
        except MissingExtra as error:
            print(f"drnav: no picture: {error}", file=sys.stderr)
        print(f"drnav: wrote {args.scaling}/", file=sys.stderr)
    table = bench.table if args.scaling is None else report.outline
    print(report.dumps(result) if args.json else table(result))
    return 0


def _perform(args: Command) -> int:
    match args:
        case Run() | Compare():
            return drive.perform(args)
        case Worlds():
            return data.show(args)
        case Dataset():
            return data.gather(args)
        case Train():
            return learn.perform(args)
        case Bench():
            return _measure(args)


def main(argv: list[str] | None = None) -> int:
    """The console script; returns the exit code (0; 2 = the user's mistake; 130 = interrupted)."""
    argv = sys.argv[1:] if argv is None else argv
    if argv == ["--version"]:
        print(f"drnav {__version__}")
        return 0

    def work() -> int:
        args = parse(argv)
        process.prepare()
        process.end_as_interrupted()
        return _perform(args)

    try:
        return ended(work)
    except SystemExit:  # after --help
        return 0
