"""`apt-evap completion`: script that lets a shell complete commands, options and file names."""

import argparse
import re
from typing import Any

from apt_evap._common.optional_imports import optional_import
from apt_evap.cli._output import put
from apt_evap.cli.parser import make_parser

_FOLDERS = ("FOLDER", "DIR")
_FILES = re.compile(r"(MEASURED|OUT|R|(\w*\.)?FILE(\.\w+)?|[A-Z]+\.\w+)")


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Print a script that lets a shell complete commands, options and file names. It needs shtab:\n"
        "pip install 'apt_evap[completion]'. The script itself needs nothing."
    )
    parser.epilog = (
        "examples:\n"
        "  apt-evap completion bash > ~/.local/share/bash-completion/completions/apt-evap\n"
        "  apt-evap completion zsh > ~/.zfunc/_apt-evap    # a folder in fpath, before compinit"
    )
    parser.add_argument("shell", choices=("bash", "zsh", "fish", "tcsh"), help="name of the shell")


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    try:
        shtab = optional_import("shtab", "apt-evap completion")
    except ImportError as error:
        raise ValueError(f"{str(error).rpartition(':')[0]}: pip install 'apt_evap[completion]'") from error
    parser = make_parser()
    _mark_files(parser, shtab)
    put(shtab.complete(parser, shell=options.shell))
    return 0


def _mark_files(parser: argparse.ArgumentParser, shtab: Any) -> None:
    """Mark arguments that are files or folders, by their names in the help."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                _mark_files(command, shtab)
        elif action.metavar in _FOLDERS:
            action.complete = shtab.DIRECTORY  # type: ignore[attr-defined]  # an attribute for shtab
        elif isinstance(action.metavar, str) and _FILES.fullmatch(action.metavar):
            action.complete = shtab.FILE  # type: ignore[attr-defined]
