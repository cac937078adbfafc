"""The parser of the command line. The help of all commands imports no numerical module, so that it is fast."""

import argparse
import re
import textwrap
from collections.abc import Iterable
from importlib import import_module
from typing import Any, NoReturn

from apt_evap._common.version import __version__
from apt_evap.cli._options import SHAPE
from apt_evap.cli._output import put

EXIT_CODES = """\
exit codes:
  0    success; names of written files on stdout, warnings on stderr
  1    the reader of the output has closed the pipe
  2    error, explained in one sentence on stderr; no incomplete file remains
  130  interrupted by Ctrl-C; what is kept, and the command that goes on, are on stderr
  143  the same by SIGTERM, as sent by batch systems
"""
"""Meaning of the exit codes, for the help."""

_PATH = """\
from a simulation to its map, and to the emission energies of a measured map:
  apt-evap run examples/ni111.toml                   simulate; write ni111.h5 and its maps ni111.png
  apt-evap info ni111.h5                             contents of the run: specimen, ions, outcomes
  apt-evap map ni111.h5 --perturbation RollUp:0.3 -o rolled.png
                                                     map of the same ions, with roll-up at 0.3 eV; takes about 1 s
  apt-evap info R5083.epos --json | jq .ions         also for measured files; --json for programs
  apt-evap map R5083.epos --bins 128                 map of measured ions
  apt-evap spectrum R5083.epos --save R5083.rrng     mass spectrum: peaks, background, ranges
  apt-evap composition R5083.epos                    at.% with errors, and what no ion explains
  apt-evap index R5083.epos --element Ni             which crystal direction is where on the map
  apt-evap twin R5083.epos --element Ni              all of this: index, simulate, register, fit, report
  apt-evap paper                                     figures 2 to 7 of the paper, and what agrees with it
  apt-evap compare ni111.h5 R5083.epos -o study      fit the emission energies to the measured map
  apt-evap export ni111.h5 --real-units -o ni111.epos
                                                     ions as an instrument would write them
  apt-evap reconstruct R5083.epos --element Si --distance 90 -o R5083.pos
                                                     positions in the specimen from the hits
  apt-evap clusters R5083.pos --solute Cu --ranges R5083.rrng
                                                     clusters, tested against random labels
  apt-evap run precipitate                           an example by its name; `apt-evap examples` lists all
  apt-evap sweep plan study.toml                     many simulations, on one machine or a cluster
  apt-evap explore ni111.h5 R5083.epos               both maps in the browser, with sliders for the emission
  apt-evap visible visible                           would this precipitate be found?
  apt-evap dataset study.toml -o set                 a data set with the truth of every ion
  apt-evap COMMAND --help                            all arguments of a command, with examples
"""

COMMANDS = {
    "run": "run the simulation of a TOML file",
    "map": "draw detector maps of a run or of measured ions",
    "info": "summarise a file",
    "spectrum": "draw and name the peaks of the mass spectrum of measured ions",
    "composition": "composition of measured ions with its errors, and what is unexplained",
    "planes": "spacing and orientation of lattice planes in reconstructed ions",
    "index": "which crystal direction is where on a measured map",
    "start": "settings file for a simulation of a measured specimen",
    "twin": "from a measured file to a simulation of its specimen, a fit and a report",
    "paper": "figures 2 to 7 of the paper of the model, of twins or of a measured map",
    "compare": "fit the emission energies of a run to a measured map",
    "export": "write ions as .epos, .pos, .nxs, .csv, .tapsim, .xyz or .vtp",
    "reconstruct": "reconstruct the positions of ions from their hits",
    "clusters": "clusters of a solute: sizes, compositions, number density",
    "proxigram": "composition as a function of the distance from an isosurface",
    "examples": "list the examples, or copy them",
    "completion": "print a script for completion in a shell",
    "sweep": "run many simulations of one study file, on one machine or a cluster",
    "explore": "maps in the browser: of a run, with sliders for the emission, of a measurement, or of both",
    "visible": "would a feature of a specimen be found, and how wrong would it come out?",
    "dataset": "make a data set with the truth of every ion, or verify one",
}
"""Names of the commands, each with one line of help. The module of a command has its arguments."""


def make_parser(command: str | None = None) -> argparse.ArgumentParser:
    """Make the parser of the command line."""
    parser = _Parser(
        prog="apt-evap",
        description="Field evaporation in atom probe tomography: simulate the evaporation of a specimen atom by atom,\n"
        "draw detector maps for any perturbation of the emission, and compare them with measured ions.",
        epilog=f"{_PATH}\n{EXIT_CODES}",
        **SHAPE,
    )
    parser.add_argument("--version", action="version", version=f"apt-evap {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", dest="command", required=True)
    for name, text in COMMANDS.items():
        added = commands.add_parser(name, help=text, **SHAPE)
        if command in (None, name):
            import_module(f"apt_evap.cli.{name}").arguments(added)
    return parser


class _Parser(argparse.ArgumentParser):
    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.common: list[tuple[Any, tuple[argparse.Action, ...]]] = []  # groups with options that are named alone
        self._negative_number_matcher = re.compile(r"-\.?\d")  # a value such as -9.6,4 is not an option

    def format_help(self) -> str:
        kept = [(group, group.description, actions, [each.help for each in actions]) for group, actions in self.common]
        try:
            for group, _, actions, _ in kept:
                names = ", ".join(action.option_strings[0] for action in actions)
                group.description = textwrap.fill(f"see apt-evap info --help: {names}", 100)
                for action in actions:
                    action.help = argparse.SUPPRESS
            return super().format_help()
        finally:
            for group, description, actions, texts in kept:
                group.description = description
                for action, text in zip(actions, texts, strict=True):
                    action.help = text

    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message} (see {self.prog} --help)")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        # checked in the parser of the command, so that the message names its help
        options, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return options, unknown

    def _print_message(self, message: str, file: Any = None) -> None:
        put(message.removesuffix("\n"))  # argparse ignores write errors, such as a full disk

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            hint = _did_you_mean(value, action.choices)
            known = ", ".join(map(str, action.choices))
            raise argparse.ArgumentError(action, f"invalid choice: {value!r:.80}{hint} (choose from {known})")


def _did_you_mean(word: str, known: Iterable[str]) -> str:
    from apt_evap._common.validation import did_you_mean  # with numpy, for those who mistype

    return did_you_mean(word, known)
