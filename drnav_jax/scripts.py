"""How a program ends: with a result on stdout, or with one line about what was wrong."""

import sys
from collections.abc import Callable
from typing import Any

import tyro

from drnav_jax import report

INTERRUPTED = 130  # exit code, as shells have it


def ended(work: Callable[[], int]) -> int:
    """The exit code of `work`. A user's mistake (2) and an interrupt (130) are one line on stderr, and no traceback."""
    try:
        return work()
    except KeyboardInterrupt:
        print("drnav: interrupted.", file=sys.stderr)
        return INTERRUPTED
    except (ValueError, OSError, ImportError) as error:  # what is not installed is an ImportError that says so
        print(f"drnav: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2


def script(
    config: type, main: Callable[[Any], dict[str, Any]], table: Callable[[dict[str, Any]], str], about: str | None
) -> int:
    """Run an experiment as a script: flags are the fields of `config`, the result is printed; the exit code."""

    def work() -> int:
        asked = tyro.cli(config, description=about, config=(tyro.conf.FlagCreatePairsOff,))
        result = main(asked)
        print(report.dumps(result) if asked.json else table(result))
        return 0

    return ended(work)
