"""The entry point of `apt-evap`: what signals, warnings and errors do, exit codes."""

import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from apt_evap._common.wording import options_of_a_shell
from apt_evap.cli._output import (
    INTERRUPTED,
    TERMINATED,
    discard_stdout,
    flush,
    open_missing_streams,
    say,
)

_OPTIONS = {
    "partial": "--partial",
    "resume": "--resume",
    "overwrite": "--force",
    "byte_order": "--byte-order",
    "format": "--format",
    "n_threads": "--threads",
    "n_ions": "--ions",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    arguments : sequence of str, optional
        Arguments after the name of the program; those of the process by default.

    Returns
    -------
    int
        Exit code, as `apt_evap.cli.parser.EXIT_CODES` says.
    """
    open_missing_streams()
    with warnings.catch_warnings(), options_of_a_shell(_OPTIONS), _terminated_like_interrupted() as terminated:
        warnings.showwarning = lambda message, *_, **__: say("warning", message)
        try:
            code = _execute(arguments)
            flush()
            return TERMINATED if terminated and code == INTERRUPTED else code
        except KeyboardInterrupt:
            print("apt-evap: interrupted", file=sys.stderr)
            return TERMINATED if terminated else INTERRUPTED
        except BrokenPipeError:  # whoever read the output has left
            discard_stdout()
            return 1
        except MemoryError as error:
            say("error", str(error) or "not enough memory")
        except (ValueError, OSError) as error:
            say("error", error)
        except RuntimeError as error:
            from apt_evap.simulation.ending import RunInterrupted  # help must not wait for it

            if not isinstance(error, RunInterrupted):
                raise
            say("error", error)
        return 2


def _execute(arguments):
    """Run a command. Its module, and what that computes with, is imported here, where Ctrl-C is minded."""
    parser = import_module("apt_evap.cli.parser").make_parser()
    try:
        options = parser.parse_args(arguments)
    except SystemExit as stop:  # --help and --version
        return stop.code or 0
    return import_module(f"apt_evap.cli.{options.command}").execute(options)


@contextmanager
def _terminated_like_interrupted() -> Iterator[list[int]]:
    """Let SIGTERM do what Ctrl-C does; yields a list that holds the signal once it has come."""
    came: list[int] = []
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
        yield came
        return

    def note(number: int, frame: Any) -> None:
        came.append(number)
        like = signal.getsignal(signal.SIGINT)
        (like if callable(like) else signal.default_int_handler)(signal.SIGINT, frame)

    signal.signal(signal.SIGTERM, note)
    try:
        yield came
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
