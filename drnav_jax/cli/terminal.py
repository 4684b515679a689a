"""What the commands say while they work, and where."""

import contextlib
import sys
import time

SILENCE = 30.0  # [s] between two lines where there is no terminal


class Bar:
    """A progress bar on a terminal; elsewhere a line now and then, and one when all is over."""

    def __init__(self, name: str, total: int, what: str) -> None:
        """Show that it has begun."""
        self.name, self.total, self.what, self.stream = name, total, what, sys.stderr
        self.done, self.begin, self.live = 0, time.perf_counter(), sys.stderr.isatty()
        self.said = self.begin
        self._show("compiling")

    def _show(self, note: str) -> None:
        text = f"{self.done}/{self.total} {self.what}, {note}"
        if self.live:
            filled = round(24 * self.done / self.total)
            self.stream.write(f"\r\033[K{self.name:>14} [{'#' * filled}{'.' * (24 - filled)}] {text}")
        elif (now := time.perf_counter()) > self.said + SILENCE:
            self.said = now
            self.stream.write(f"{self.name:>14}  {text}\n")
        self.stream.flush()

    def __call__(self, done: int, made: int | None = None, note: str = "") -> None:
        """Take note of how many are done, how many of these were made since the bar began (None: all), and what to add."""
        self.done, spent = done, time.perf_counter() - self.begin
        rate = (done if made is None else made) / spent
        left = f", {rate:.2f}/s, {(self.total - done) / rate:.0f} s left" if rate > 0 else ""
        self._show(f"{spent:.0f} s{left}" + (f", {note}" if note else ""))

    def close(self) -> None:
        """Leave one line behind."""
        spent = time.perf_counter() - self.begin
        start = "\r\033[K" if self.live else ""
        self.stream.write(f"{start}{self.name:>14}  {self.done}/{self.total} {self.what} in {spent:.1f} s\n")
        self.stream.flush()


def stdout_kept(json: bool) -> contextlib.AbstractContextManager:
    """With --json, what a library prints goes to stderr."""
    return contextlib.redirect_stdout(sys.stderr) if json else contextlib.nullcontext()
