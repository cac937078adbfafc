"""The entry point of `apt-evap`: the parser, what signals and errors do, exit codes."""

import argparse
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn

from apt_evap._common.validation import did_you_mean
from apt_evap._version import __version__
from apt_evap.cli import compare, info, map, run
from apt_evap.cli._options import INTERRUPTED, SHAPE, TERMINATED, say
from apt_evap.simulation.ending import RunInterrupted

COMMANDS = (run, map, info, compare)

EXIT_CODES = """\
exit codes:
  0    done; what was written is said on stdout, warnings on stderr
  1    whoever read the output has left (a closed pipe)
  2    an error, explained in one sentence on stderr; nothing half-written is left behind
  130  interrupted by Ctrl-C; `run` has saved the ions done so far
  143  the same by SIGTERM, as batch systems send it
"""
"""What the exit codes mean, for the help."""

_PATH = """\
from nothing to a map, and to the energies behind a measured one (the first line writes what the others read):
  apt-evap run examples/ni111.toml                   simulate; writes ni111.h5 and maps of it, ni111.png
  apt-evap info ni111.h5                             what the run holds: specimen, ions, outcomes
  apt-evap map ni111.h5 --perturbation RollUp:0.3 -o rolled.png
                                                     the same ions, all rolled up with 0.3 eV, in a second
  apt-evap info R5083.epos --json | jq .ions         measured files too; --json for programs
  apt-evap map R5083.epos --bins 128                 a measured map beside them
  apt-evap compare ni111.h5 R5083.epos -o study      the energies for which the run looks most like the measured map
  apt-evap COMMAND --help                            everything a command takes, with examples
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    arguments : sequence of str, optional
        Arguments after the name of the program; those of the process by default.

    Returns
    -------
    int
        Exit code, as `EXIT_CODES` says.
    """
    with warnings.catch_warnings(), _terminated_like_interrupted() as terminated:
        warnings.showwarning = lambda message, *_, **__: say("warning", message)
        try:
            try:
                options = _parser().parse_args(arguments)
            except SystemExit as stop:  # --help and --version
                return stop.code or 0  # type: ignore[return-value]
            code = options.command(options)
            sys.stdout.flush()
            return TERMINATED if terminated and code == INTERRUPTED else code
        except KeyboardInterrupt:
            print("apt-evap: interrupted", file=sys.stderr)
            return TERMINATED if terminated else INTERRUPTED
        except BrokenPipeError:
            # whoever read the output has left; what is still buffered must not complain at exit
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 1
        except MemoryError as error:
            say("error", str(error) or "not enough memory")
        except (ValueError, OSError, RunInterrupted) as error:
            say("error", error)
        return 2


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


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        if found := re.search(r"invalid choice: '(.+?)' \(choose from (.+)\)", message):
            hint = did_you_mean(found[1], re.findall(r"[\w-]+", found[2]))
            message = message.replace(" (choose", f"{hint} (choose")
        raise ValueError(f"{message} (see {self.prog} --help)")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        # a command's own parser would leave it to the one above to say so, with the wrong help
        options, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return options, unknown


def _parser():
    parser = _Parser(
        prog="apt-evap",
        description="Field evaporation in atom probe tomography: simulate a specimen that evaporates atom by atom,\n"
        "and draw where its ions land under any perturbation of their emission, beside measured ions.",
        epilog=f"{_PATH}\n{EXIT_CODES}",
        **SHAPE,
    )
    parser.add_argument("--version", action="version", version=f"apt-evap {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for command in COMMANDS:
        command.add_parser(commands)
    return parser
