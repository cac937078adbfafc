"""Progress of a run: a bar in a terminal, otherwise lines."""

import contextlib
import sys
import time
from collections.abc import Callable
from typing import Any

from apt_evap._common.progress import progress_bar

SECONDS_BETWEEN_LINES = 60.0
_BAR = "{percentage:3.0f}%|{bar:20}| {n_fmt} of {total_fmt} ions, {remaining} left"


def run_progress(quiet: bool) -> Any:
    """Progress of a run, as an argument of `simulate`."""
    if quiet:
        return False
    return ProgressBar() if sys.stderr.isatty() else ProgressLines()


class ProgressBar(contextlib.AbstractContextManager):
    """Progress of a run in a terminal: a bar of a fixed width, which fits into 80 columns with its numbers."""

    def __init__(self) -> None:
        self.bar: Any = None

    def __exit__(self, *error: object) -> None:
        if self.bar is not None:
            self.bar.close()

    def __call__(self, ions: int, n_ions: int) -> None:
        if self.bar is None:
            self.bar = progress_bar(total=n_ions, initial=ions, bar_format=_BAR, unit=" ions", mininterval=0.5)
        self.bar.update(ions - self.bar.n)


class ProgressLines:
    """Progress of a run on stderr: one line per minute, after the first minute."""

    def __init__(self) -> None:
        self._began = self._printed = self._first = 0.0

    def __call__(self, ions: int, n_ions: int) -> None:
        now = time.monotonic()
        if not self._began:
            self._began, self._printed, self._first = now, now, ions
        elif now - self._printed >= SECONDS_BETWEEN_LINES and ions > self._first:
            self._printed = now
            rate = (ions - self._first) / (now - self._began)
            remaining, speed = _duration((n_ions - ions) / rate), f"{rate:,.0f}" if rate >= 10 else f"{rate:.2g}"
            line = f"{ions:,} of {n_ions:,} ions ({ions / n_ions:.0%}), {speed} ions/s, {remaining} left"
            print(line, file=sys.stderr, flush=True)


def reading_progress(passes: int, quiet: bool) -> Callable[[int, int], None]:
    """Progress of reading a file a number of times: takes the ions of each block, and those of the file."""
    shown = None if quiet else ProgressBar() if sys.stderr.isatty() else ProgressLines()
    done = 0

    def told(ions, of):
        nonlocal done
        done += ions
        # looking for strays and quantised coordinates may need further passes
        at = min(done // passes, of)
        if shown is not None:
            shown(at, of)
            if at == of and isinstance(shown, ProgressBar):
                shown.bar.close()

    return told


def _duration(seconds):
    """Text of a time in a suitable unit."""
    for unit, length in (("h", 3600), ("min", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.0f} s"
