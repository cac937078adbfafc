"""The command line: `apt-evap` with one module for each command."""

import argparse
import os
import sys
import warnings

from apt_evap._version import __version__
from apt_evap.cli import compare, info, map, run
from apt_evap.cli._options import INTERRUPTED, SHAPE, say

COMMANDS = (run, map, info, compare)


def main(arguments=None):
    """Run the command line.

    Parameters
    ----------
    arguments : sequence of str, optional
        Arguments after the name of the program; those of the process by default.

    Returns
    -------
    int
        Exit code: 0 for success, 2 for an error that one sentence on stderr explains, 130 after Ctrl-C.
    """
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: say("warning", message)
        try:
            try:
                options = _parser().parse_args(arguments)
            except SystemExit as stop:  # --help and --version
                return stop.code or 0
            code = options.command(options)
            sys.stdout.flush()
            return code
        except KeyboardInterrupt:
            print("apt-evap: interrupted", file=sys.stderr)
            return INTERRUPTED
        except BrokenPipeError:
            # whoever read the output has left; what is still buffered must not complain at exit
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 1
        except MemoryError as error:
            say("error", str(error) or "not enough memory")
        except (ValueError, OSError) as error:
            say("error", error)
        return 2


class _Parser(argparse.ArgumentParser):
    def error(self, message):
        raise ValueError(f"{message} (see {self.prog} --help)")


def _parser():
    parser = _Parser(
        prog="apt-evap",
        description="Field evaporation in atom probe tomography.",
        epilog="example: apt-evap run examples/ni111.toml",
        **SHAPE,
    )
    parser.add_argument("--version", action="version", version=f"apt-evap {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for command in COMMANDS:
        command.add_parser(commands)
    return parser
