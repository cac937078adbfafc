"""Arguments of the commands; no numerical module is imported, so that help is fast."""

import argparse
import re
from collections.abc import Callable, Iterable
from math import inf, isfinite
from typing import Any, NoReturn

from apt_evap._version import __version__
from apt_evap.analysis.gas_names import GASES
from apt_evap.cli._output import put
from apt_evap.detection.limits import MAX_BINS
from apt_evap.fit.defaults import MEANS, MECHANISMS, ROLLUP_FRACTIONS, RSDS
from apt_evap.reconstruction.choices import FRAMES, PROJECTIONS, PROTOCOLS

EXIT_CODES = """\
exit codes:
  0    success; names of written files on stdout, warnings on stderr
  1    the reader of the output has closed the pipe
  2    error, explained in one sentence on stderr; no incomplete file remains
  130  interrupted by Ctrl-C; `run` has saved the ions so far
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
  apt-evap index R5083.epos --element Ni             which crystal direction is where on the map
  apt-evap twin R5083.epos --element Ni              all of this: index, simulate, register, fit, report
  apt-evap compare ni111.h5 R5083.epos -o study      fit the emission energies to the measured map
  apt-evap export ni111.h5 --real-units -o ni111.epos
                                                     ions as an instrument would write them
  apt-evap reconstruct R5083.epos --element Si --distance 90 -o R5083.pos
                                                     positions in the specimen from the hits
  apt-evap examples --to FOLDER                      settings files and scripts to start from
  apt-evap sweep plan study.toml                     many simulations, on one machine or a cluster
  apt-evap explore ni111.h5 R5083.epos               both maps in the browser, with sliders for the emission
  apt-evap visible particle.toml                     would this precipitate be found?
  apt-evap dataset study.toml -o set                 a data set with the truth of every ion
  apt-evap COMMAND --help                            all arguments of a command, with examples
"""

_SHAPE: dict[str, Any] = {"formatter_class": argparse.RawDescriptionHelpFormatter, "allow_abbrev": False}


def make_parser() -> argparse.ArgumentParser:
    """Make the parser of the command line.

    Returns
    -------
    argparse.ArgumentParser
        Its errors are ValueErrors. The parsed options contain the name of the command as `command`.
    """
    parser = _Parser(
        prog="apt-evap",
        description="Field evaporation in atom probe tomography: simulate the evaporation of a specimen atom by atom,\n"
        "draw detector maps for any perturbation of the emission, and compare them with measured ions.",
        epilog=f"{_PATH}\n{EXIT_CODES}",
        **_SHAPE,
    )
    parser.add_argument("--version", action="version", version=f"apt-evap {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", dest="command", required=True)
    for add in (
        _add_run,
        _add_map,
        _add_info,
        _add_index,
        _add_start,
        _add_twin,
        _add_compare,
        _add_export,
        _add_reconstruct,
        _add_examples,
        _add_completion,
        _add_sweep,
        _add_explore,
        _add_visible,
        _add_dataset,
    ):
        add(commands)
    return parser


class _Parser(argparse.ArgumentParser):
    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._negative_number_matcher = re.compile(r"-\.?\d")  # a value such as -9.6,4 is not an option

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


class _Options(argparse.Action):
    """Collects pairs of a name and its numbers in a dict."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        name, numbers = values
        setattr(namespace, self.dest, {**(getattr(namespace, self.dest) or {}), name: numbers})


def _did_you_mean(word: str, known: Iterable[str]) -> str:
    from apt_evap._common.validation import did_you_mean  # with numpy, for those who mistype

    return did_you_mean(word, known)


# ---- commands --------------------------------------------------------------------------------------------------------


def _add_run(commands: Any) -> None:
    command = commands.add_parser(
        "run",
        help="run the simulation of a TOML file",
        description="Run the simulation of a TOML file, save the run and draw its detector maps.\n"
        "Ctrl-C or SIGTERM ends the simulation and saves the ions so far. During the simulation checkpoints are\n"
        "stored in RUN.h5.unfinished. After a crash --resume continues from there, with the same bits as an\n"
        "uninterrupted run. The progress bar shows: charges (RMS residual relative to the mean charge); fractions\n"
        "of the last ions that missed, never left the tip, or are flagged (inexact responses). Without a terminal:\n"
        "one line per minute.",
        epilog="example: apt-evap run examples/ni111.toml -o ni.h5 --ions 5000",
        **_SHAPE,
    )
    command.add_argument("config", metavar="CONFIG.toml")
    command.add_argument("-o", "--output", metavar="RUN.h5", help="default: output in the file, or its name with .h5")
    command.add_argument(
        "--ions", type=_integer(1), metavar="N", help="number of atoms to evaporate; default: ions in the file"
    )
    command.add_argument("--threads", type=_integer(1), metavar="N", help="default: all processors")
    command.add_argument("--seed", type=_integer(0), metavar="N", help="default: seed in the file")
    command.add_argument("--map", metavar="MAP.png", help="picture of the maps; default: beside the run")
    command.add_argument("--resume", action="store_true", help="continue an unfinished run, or extend a run")
    command.add_argument(
        "--checkpoint",
        type=_number("min"),
        default=10.0,
        metavar="MINUTES",
        help="time between two checkpoints; default: 10",
    )
    _add_speech(command)
    command.add_argument(
        "--force", action="store_true", help="overwrite unfinished and other runs, and files not made by apt-evap"
    )


def _add_map(commands: Any) -> None:
    command = commands.add_parser(
        "map",
        help="draw detector maps of a run or of measured ions",
        description="Draw detector maps of a run or of measured ions, or a map.",
        epilog="example:\n"
        "  apt-evap map R5083.epos --bins 128\n"
        "  apt-evap map R5083.epos --ranges R5083.rrng --species Si --voltage 4000, --circle 15 -o silicon.png\n"
        "  apt-evap map ni111.h5 --perturbation Unperturbed --perturbation RollUp:0.3,0.1 -o energies.png\n"
        "  apt-evap map ni111.h5 --field-ion Ne -o image.png\n"
        "  apt-evap map ni111.h5 --poles\n"
        "  apt-evap map R5083.epos --poles W --axis 0,1,1 --distance 90\n\n"
        "a perturbation is NAME, NAME:NUMBERS or a TOML table:\n"
        "  Unperturbed              RollUp:0.2 (eV, all ions)    RollUp:0.155,0.155 (mean, standard deviation)\n"
        "  LateralVelocity:0.3,0.1  Combined:0.155,0.155,0.75 (the last number is the roll-up fraction)\n"
        '  \'{name = "RollUp", energy = {name = "Thermal", temperature = 50}}\'',
        **_SHAPE,
    )
    command.add_argument("file", metavar="FILE", help=_FILE_HELP)
    _add_reading(command)
    command.add_argument(
        "-o", "--output", metavar="MAP.png", help=".png, .pdf or .svg; default: FILE_map.png in this folder"
    )
    command.add_argument(
        "--bins", type=_integer(1, MAX_BINS), metavar="N", help="bins along the longer side; default: about sqrt(ions)"
    )
    command.add_argument("--smooth", type=_number("mm"), metavar="MM", help="sigma of a Gaussian; default: one bin")
    command.add_argument(
        "--perturbation",
        action="append",
        metavar="P",
        help="perturbation of the ions of a run; repeat it for maps side by side",
    )
    command.add_argument(
        "--field-ion",
        nargs="?",
        const="Ne",
        choices=GASES,
        metavar="GAS",
        help="field-ion image of the surface at the end of a run, in He, Ne, Ar or H2; default: Ne",
    )
    group = command.add_argument_group("crystal", "Poles and zone lines over the map.")
    group.add_argument(
        "--poles",
        nargs="?",
        const="",
        metavar="NAME",
        help="draw them, of a run or of a crystal such as W; where they are is searched as by apt-evap index",
    )
    group.add_argument(
        "--axis", type=_numbers, metavar="H,K,L", help="pole near the centre of the map, or with --rotation the axis"
    )
    group.add_argument("--rotation", type=float, metavar="DEGREES", help="of the crystal about its axis; no search")
    group.add_argument("--scale", type=_number("mm/rad"), metavar="S", help="scale of the map [mm/rad]")
    group.add_argument("--distance", type=_number("mm"), metavar="MM", help="flight length of the instrument")
    _add_real_units(command)
    command.add_argument("--force", action="store_true", help="overwrite a file not made by apt-evap")
    _add_speech(command)


def _add_info(commands: Any) -> None:
    command = commands.add_parser(
        "info",
        help="summarise a file",
        description="Summarise a run (for an unfinished run, give the folder), a file of ions, a map, or a specimen\n"
        "(LAMMPS, TAPSim, ASE).",
        epilog="example: apt-evap info ni111.h5\n         apt-evap info R5083.epos --json | jq .columns.voltage\n"
        "         apt-evap info precipitate.lmp --types 1=Al,2=Cu",
        **_SHAPE,
    )
    command.add_argument("file", metavar="FILE", help=_FILE_HELP)
    _add_reading(command)
    command.add_argument(
        "--types", type=_types, metavar="1=Al,2=Cu", help="elements of the types of a specimen that have no names"
    )
    command.add_argument("--json", action="store_true", help="as JSON, for programs; units as in the text output")


def _add_index(commands: Any) -> None:
    command = commands.add_parser(
        "index",
        help="which crystal direction is where on a measured map",
        description="Find the orientation of the crystal from a measured map, by a search over all orientations, and\n"
        "draw poles and zone lines over the map. The answer may be that the map does not decide.",
        epilog="example:\n"
        "  apt-evap index R5083.epos --element Ni\n"
        "  apt-evap index R5083.epos --element Al --ranges R5083.rrng --species Al --distance 90\n"
        "  apt-evap index R5083.epos --element W --pole 3.5,-8,0,1,1 --line -20,5,18,9 --line 10,-20,4,22",
        **_SHAPE,
    )
    command.add_argument("file", metavar="FILE", help="measured ions (.epos, ...) or a map (.npz)")
    _add_reading(command)
    _add_indexing(command)
    command.add_argument(
        "-o", "--output", metavar="MAP.png", help=".png, .pdf or .svg; default: FILE_indexed.png in this folder"
    )
    command.add_argument("--force", action="store_true", help="overwrite a file not made by apt-evap")
    _add_speech(command)


def _add_start(commands: Any) -> None:
    command = commands.add_parser(
        "start",
        help="settings file for a simulation of a measured specimen",
        description="Index a measured map, and write a settings file for a simulation of its specimen: axis,\n"
        "rotation, radius, detector and emission, with the origin of every number as a comment.",
        epilog="example:\n"
        "  apt-evap start R5083.epos --element Ni --distance 90 -o specimen.toml\n"
        "  apt-evap run specimen.toml",
        **_SHAPE,
    )
    command.add_argument("file", metavar="FILE", help="measured ions (.epos, ...) or a map (.npz)")
    command.add_argument("-o", "--output", metavar="FILE.toml", help="default: the name of FILE with .toml")
    _add_reading(command)
    _add_indexing(command)
    _add_specimen(command)
    command.add_argument("--force", action="store_true", help="overwrite a file not made by this command")
    _add_speech(command)


def _add_twin(commands: Any) -> None:
    command = commands.add_parser(
        "twin",
        help="from a measured file to a simulation of its specimen, a fit and a report",
        description="Index a measured map, simulate its specimen, register the simulated map on the measured one, fit\n"
        "the emission, and write a report. The same command continues after an interruption.",
        epilog="writes to FOLDER:\n"
        "  specimen.toml, start.json   settings of the simulation, and the indexing\n"
        "  run.h5, run.png             the simulation\n"
        "  registration.json, study/   as of apt-evap compare; study/report.html has it all\n"
        "  answer.txt                  constants of the measurement, what they depend on, and checks\n\n"
        "example:\n"
        "  apt-evap twin R5083.epos --element Ni --distance 90 --minutes 10\n"
        "  apt-evap twin map.npz --element Ni --pole=-9.6,-0.4,1,1,1 --pole 2.4,6.2,1,1,3 --pole=-7.5,-13.5,1,3,1",
        **_SHAPE,
    )
    command.add_argument("file", metavar="FILE", help="measured ions (.epos, ...) or a map (.npz)")
    command.add_argument("-o", "--output", metavar="FOLDER", help="default: FILE_twin in this folder")
    _add_reading(command)
    _add_indexing(command)
    _add_specimen(command).add_argument(
        "--efficiency",
        type=_number("1"),
        default=0.5,
        metavar="ETA",
        help="part of the evaporated atoms that are among the selected ions, for the angle of the shank; default: 0.5",
    )


def _add_specimen(command: Any) -> Any:
    group = command.add_argument_group("specimen")
    group.add_argument(
        "--minutes", type=float, default=10.0, metavar="N", help="time that the simulation may take; default: 10"
    )
    group.add_argument("--field-factor", type=float, metavar="KF", help="for the radius from the voltage; default: 3.3")
    group.add_argument("--lens", metavar="L", help="microscope that gives the field factor, as for apt-evap export")
    group.add_argument("--threads", type=_integer(1), metavar="N", help="default: all processors")
    return group


def _add_indexing(command: Any) -> None:
    group = command.add_argument_group("crystal")
    group.add_argument("--element", metavar="NAME", required=True, help="the crystal, such as Ni")
    group.add_argument("--distance", type=_number("mm"), metavar="MM", help="flight length of the instrument")
    group.add_argument(
        "--scales", type=_numbers, metavar="LOW,HIGH", help="bounds of the scale of the map [mm/rad], if it is known"
    )
    group.add_argument(
        "--pole", type=_mark(2), action="append", metavar="X,Y[,H,K,L]", help="a pole that you see [mm]; repeat it"
    )
    group.add_argument(
        "--line",
        type=_mark(4),
        action="append",
        metavar="X,Y,X,Y[,U,V,W]",
        help="two points of a zone line that you see [mm], and its zone axis if you know it; repeat it",
    )


def _add_compare(commands: Any) -> None:
    command = commands.add_parser(
        "compare",
        help="fit the emission energies of a run to a measured map",
        description="Fit the emission energies of a run to a measured map: the score of both maps for a grid of\n"
        "energies, its maximum and errors, and for comparison the scores without energy and with thermal\n"
        "energies. The score is the concordance of maps folded about a pole, or the structural similarity.",
        epilog="writes to FOLDER:\n"
        "  study.json        results and all settings\n"
        "  scores.csv        score, error, fraction of the resamples and misfit of rings for every energy\n"
        "  scores.png        plot of the scores\n"
        "  maps.png          measured, unperturbed and best map side by side, and an enlarged part\n"
        "  registration.png  overlay of the simulated map on the measured one\n"
        "  report.html       all of this in one file, with both maps on one place: send it around\n\n"
        "example: apt-evap compare ni111.h5 R5083.epos -o R5083_study --mechanism roll-up",
        **_SHAPE,
    )
    command.add_argument("run", metavar="RUN.h5", help="a run with responses")
    command.add_argument("file", metavar="MEASURED", help="measured ions (.epos, ...), a map (.npz), or a run (.h5)")
    command.add_argument("-o", "--output", metavar="FOLDER", help="default: MEASURED_study in this folder")
    command.add_argument("--mechanism", choices=MECHANISMS, help="default: roll-up")
    for name, default, what in (
        ("means", MEANS, "means of the energy [eV]"),
        ("relative_spreads", RSDS, "standard deviations relative to the means"),
        ("rollup-fractions", ROLLUP_FRACTIONS, "roll-up fractions for the mechanism combined"),
    ):
        numbers = ",".join(f"{value:g}" for value in default)
        command.add_argument(f"--{name}", type=_numbers, metavar="N,N,...", help=f"{what}; default: {numbers}")
    command.add_argument(
        "--option",
        dest="options",
        action=_Options,
        type=_option,
        metavar="NAME=N,N,...",
        help="one more axis: a parameter of the perturbation and the numbers to try",
    )
    command.add_argument(
        "--registration",
        metavar="R",
        help="a JSON file (such as study.json) or ROTATION,SCALE,DX,DY[,mirror] in degrees and mm; default: automatic",
    )
    command.add_argument(
        "--objective",
        choices=("similarity", "folded"),
        help="what is compared: the maps place by place (SSIM), or folded about a pole, the default if they show one",
    )
    command.add_argument("--bins", type=_integer(11, MAX_BINS), metavar="N", help="bins along the longer side")
    command.add_argument(
        "--smooth",
        dest="smoothing",
        type=_number("mm"),
        metavar="MM",
        help="sigma of a Gaussian; default: half a bin, for densities one bin",
    )
    command.add_argument(
        "--flatten",
        dest="flattening",
        type=_number("mm"),
        metavar="MM",
        help="sigma of the Gaussian for flattening; 0 for none",
    )
    command.add_argument("--temperature", type=float, metavar="K", help="temperature of the thermal map; default: 50")
    command.add_argument(
        "--plain", dest="allow_noise", action="store_const", const=False, help="SSIM without noise correction"
    )
    command.add_argument("--replicas", type=_integer(1), metavar="N", help="draws per ion; default: 4 to 16")
    command.add_argument("--resamples", type=_integer(0), metavar="N", help="resamples for errors; default: 200")
    command.add_argument("--seed", type=_integer(0), metavar="N", help="seed of the resamples; default: 0")
    command.add_argument(
        "--same-radius",
        action="store_const",
        const=True,
        help="the specimen is known to have the radius of the run, within 5%%: narrower intervals of mean energies",
    )
    command.add_argument("--threads", type=_integer(1), metavar="N", help="default: all processors")
    command.add_argument("--quiet", action="store_true", help="no progress bar, no summary")
    command.add_argument("--force", action="store_true", help="overwrite files not made by apt-evap")
    reading = _add_reading(command)
    reading.add_argument("--perturbation", metavar="P", help="perturbation of the ions of MEASURED if it is a run")


def _add_export(commands: Any) -> None:
    command = commands.add_parser(
        "export",
        help="write ions as .epos, .pos, .nxs, .csv, .tapsim, .xyz or .vtp",
        description="Write the ions that hit the detector, of a run or of a measurement, as a file of ions. The\n"
        "suffix of FILE selects the format. In real units an .epos has the voltages, times of flight, mass-to-charge\n"
        "ratios and pulses that an instrument could have written.",
        epilog="example: apt-evap export ni111.h5 --real-units --perturbation RollUp:0.36,0.36 -o ni111.epos\n"
        "         apt-evap export R5083.epos -o R5083.nxs --elements Si,O",
        **_SHAPE,
    )
    command.add_argument("file", metavar="IONS", help="a run (.h5) or measured ions (.epos, ...)")
    command.add_argument("-o", "--output", metavar="FILE", help="default: the name of IONS with .epos")
    command.add_argument("--elements", metavar="NAME,...", help="of the specimen, for .nxs; default: those of the run")
    command.add_argument("--perturbation", metavar="P", help="as for map; default: the first one of the run")
    _add_real_units(command)
    command.add_argument("--temperature", type=_number("K"), metavar="K", help="adds energy deficits to the times")
    command.add_argument("--jitter", type=_number("ns"), metavar="NS", help="error of the times; default: none")
    _add_reading(command)
    command.add_argument("--force", action="store_true", help="overwrite an existing file")
    _add_speech(command)


def _add_reconstruct(commands: Any) -> None:
    command = commands.add_parser(
        "reconstruct",
        help="reconstruct the positions of ions from their hits",
        description="Reconstruct the positions of ions in the specimen from their hits and their sequence, and write\n"
        "them as .pos, .epos, .xyz or .vtp. A run has its own constants; its true sites give the errors.",
        epilog="example:\n"
        "  apt-evap reconstruct R5083.epos --element Si --distance 90 --efficiency 0.57 -o R5083.pos\n"
        "  apt-evap reconstruct R5083.epos --element Si --distance 90 --ranges R5083.rrng --picture R5083.png\n"
        "  apt-evap reconstruct ni111.h5 --real-units\n"
        "  apt-evap reconstruct R5083.epos --atomic-volume 0.02 --distance 90 --radius shank --initial-radius 30 \\\n"
        "      --shank-angle 5",
        **_SHAPE,
    )
    command.add_argument("file", metavar="FILE", help="measured ions (.epos, ...) or a run (.h5)")
    command.add_argument("-o", "--output", metavar="OUT", help="default: FILE_reconstructed.pos in this folder")
    command.add_argument(
        "--frame", choices=FRAMES, default="depth", help="z is the depth, or goes out of the specimen; default: depth"
    )
    command.add_argument(
        "--picture",
        metavar="P.png",
        help="draw side view, top view, depth profile and composition; --ranges gives the species of measured ions",
    )
    constants = command.add_argument_group("constants", "The defaults of a run are its own constants.")
    constants.add_argument("--protocol", choices=PROTOCOLS, default="cap", help="depth increment; default: cap")
    constants.add_argument(
        "--projection", choices=PROJECTIONS, help="angle on the cap; default: bas, of a run compressed"
    )
    constants.add_argument("--distance", type=float, metavar="MM", help="flight length; default: that of the run")
    constants.add_argument(
        "--detector-radius",
        type=float,
        metavar="MM",
        help="default: that of the outermost ion, of a run half its width",
    )
    constants.add_argument(
        "--compression", type=float, metavar="XI", help="image compression; default: 1.5, of a run its own"
    )
    constants.add_argument("--efficiency", type=float, default=1.0, metavar="ETA", help="of the detector; default: 1")
    constants.add_argument("--element", metavar="NAME", help="material that gives the atomic volume and the field")
    constants.add_argument("--atomic-volume", type=float, metavar="NM3", help="default: that of the element")
    constants.add_argument(
        "--radius", default="voltage", metavar="R", help="voltage, shank, or a constant radius [nm]; default: voltage"
    )
    constants.add_argument("--field-factor", type=float, metavar="KF", help="default: 3.3, of a run its own")
    constants.add_argument("--evaporation-field", type=float, metavar="F", help="[V/nm]; default: that of the element")
    constants.add_argument(
        "--smoothing", type=_integer(1), default=1, metavar="N", help="ions in the mean of the voltage; default: 1"
    )
    constants.add_argument("--origins", metavar="TABLE.npz", help="correct lateral positions by a table of origins")
    constants.add_argument("--initial-radius", type=float, metavar="NM", help="for --radius shank")
    constants.add_argument("--shank-angle", type=float, metavar="DEGREES", help="for --radius shank; half the opening")
    command.add_argument("--perturbation", metavar="P", help="of a run, as for map; default: the first one of the run")
    _add_real_units(command)
    _add_reading(command)
    command.add_argument("--force", action="store_true", help="overwrite an existing file")
    _add_speech(command)


def _add_examples(commands: Any) -> None:
    command = commands.add_parser(
        "examples",
        help="list the examples, or copy them",
        description="List the examples of the package: settings files and Python scripts. With --to, copy them.",
        epilog="example: apt-evap examples --to apt_examples && apt-evap run apt_examples/ni111.toml",
        **_SHAPE,
    )
    command.add_argument("--to", metavar="FOLDER", help="copy the examples to this folder")
    command.add_argument("--force", action="store_true", help="overwrite files that differ from the examples")
    _add_speech(command)


def _add_completion(commands: Any) -> None:
    command = commands.add_parser(
        "completion",
        help="print a script for completion in a shell",
        description="Print a script that lets a shell complete commands, options and file names. It needs shtab:\n"
        "pip install 'apt_evap[completion]'. The script itself needs nothing.",
        epilog="examples:\n"
        "  apt-evap completion bash > ~/.local/share/bash-completion/completions/apt-evap\n"
        "  apt-evap completion zsh > ~/.zfunc/_apt-evap    # a folder in fpath, before compinit",
        **_SHAPE,
    )
    command.add_argument("shell", choices=("bash", "zsh", "fish", "tcsh"), help="name of the shell")


def _add_sweep(commands: Any) -> None:
    command = commands.add_parser(
        "sweep",
        help="run many simulations of one study file, on one machine or a cluster",
        description="Run all points of a study file: all combinations of some settings, and single points. Every\n"
        "point has a folder of its own, and can be run by any process that sees it.",
        epilog="example:\n"
        "  apt-evap sweep plan study.toml                          folders, memory and hours; runs nothing\n"
        "  apt-evap sweep work study.toml --workers 4              on this machine\n"
        "  apt-evap sweep submit study.toml --scheduler slurm      on a cluster\n"
        "  apt-evap sweep status study.toml\n"
        "  apt-evap sweep collect study.toml                       tables, maps, a report, fit to a measured map",
        **_SHAPE,
    )
    actions = command.add_subparsers(title="actions", metavar="ACTION", dest="action", required=True)

    def add(name, text, **options):
        action = actions.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.", **options, **_SHAPE)
        action.add_argument("study", metavar="STUDY.toml", help="study file, or the folder of its sweep")
        return action

    _add_speech(add("plan", "make the folder of a sweep, and foresee memory and hours; nothing is run"))
    work = add("work", "work on the points that are open")
    where = work.add_mutually_exclusive_group()
    where.add_argument("--workers", type=_integer(1), default=1, metavar="N", help="processes; default: 1")
    where.add_argument("--point", action="append", metavar="KEY", help="only this point, by its key or number")
    where.add_argument("--scheduler", choices=("dask",), help="let the workers of a Dask cluster work")
    work.add_argument("--address", metavar="TCP", help="address of the scheduler of Dask")
    work.add_argument("--retry", action="store_true", help="also try failed points again")
    _add_speech(work)
    submit = add("submit", "submit the open points to a batch system, as job arrays")
    submit.add_argument("--scheduler", choices=("slurm", "pbs"), default="slurm", help="default: slurm")
    submit.add_argument("--dry-run", action="store_true", help="only print the scripts")
    submit.add_argument("--template", metavar="JOB.sh", help="script with placeholders such as @KEYS@ and @COMMAND@")
    submit.add_argument("--submit-command", metavar="COMMAND", help="default: sbatch --parsable, or qsub")
    submit.add_argument(
        "--option", action="append", metavar="OPTION", help="of the batch system, such as --option=--partition=short"
    )
    submit.add_argument("--at-once", type=_integer(1), metavar="N", help="tasks of an array that run at once (slurm)")
    submit.add_argument("--largest-array", type=_integer(1), metavar="N", help="default: as the system allows, or 1000")
    _add_speech(submit)
    add("status", "show the states of all points").add_argument("--json", action="store_true", help="as JSON")
    gather = add("collect", "collect the finished points: table, maps, report, and the fit to a measured map")
    gather.add_argument("--maps", metavar="MAPS.h5", help="default: maps.h5 in the folder of the sweep")
    gather.add_argument("--bins", type=_integer(1, MAX_BINS), metavar="N", help="default: bins in [maps], or 128")
    gather.add_argument("--no-compare", action="store_true", help="without the comparison of [compare]")
    _add_speech(gather)


def _add_explore(commands: Any) -> None:
    command = commands.add_parser(
        "explore",
        help="maps in the browser: of a run, with sliders for the emission, of a measurement, or of both",
        description="Show the map of a run in the browser, with sliders for the emission, a measured map, or both.\n"
        "Files can also be opened on the page. Needs the extra of the package: pip install 'apt_evap[explore]'. The\n"
        "page is served to this machine only, under an address that is printed. Ctrl-C ends the explorer. On it,\n"
        "buttons copy a command or Python lines that give the same maps.",
        epilog="example:\n"
        "  apt-evap explore\n"
        "  apt-evap explore W_tap.raw\n"
        "  apt-evap explore ni111.h5\n"
        "  apt-evap explore ni111.h5 R5083.epos --mass 27,29 --registration R5083_study/study.json",
        **_SHAPE,
    )
    command.add_argument("run", metavar="RUN.h5", nargs="?", help="a run with responses")
    command.add_argument("file", metavar="MEASURED", nargs="?", help="measured ions (.epos, ...) or a map (.npz)")
    command.add_argument(
        "--registration",
        metavar="R",
        help="a JSON file (such as study.json) or ROTATION,SCALE,DX,DY[,mirror] in degrees and mm; default: search",
    )
    command.add_argument("--perturbation", metavar="P", help="at the start, as for map; default: RollUp:0.155,0.155")
    command.add_argument("--bins", type=_integer(11, MAX_BINS), metavar="N", help="bins along the longer side")
    command.add_argument("--smooth", type=_number("mm"), metavar="MM", help="sigma of a Gaussian; default: one bin")
    command.add_argument("--flatten", type=_number("mm"), metavar="MM", help="sigma for flattening; default: none")
    command.add_argument("--simulated", type=_bounds, metavar="FIRST,LAST", help="ions of the run; default: all")
    command.add_argument("--port", type=_integer(0, 65535), default=0, metavar="N", help="default: a free one")
    command.add_argument("--no-browser", dest="browser", action="store_false", help="only print the address")
    command.add_argument(
        "--allow-origin",
        type=_origin,
        action="append",
        default=[],
        metavar="HOST:PORT",
        help="address under which the browser sees the page, if it is another one, as behind a proxy; repeatable",
    )
    _add_real_units(command)
    _add_reading(command)


def _add_visible(commands: Any) -> None:
    command = commands.add_parser(
        "visible",
        help="would a feature of a specimen be found, and how wrong would it come out?",
        description="Simulate a feature of a specimen, such as a precipitate, emulate many twins of it, and apply an\n"
        "analysis to them: the probability that it finds the feature, the number of ions that this needs,\n"
        "bias and scatter of size and composition. The Python file of the analysis is run.",
        epilog="example: apt-evap visible particle.toml --json",
        **_SHAPE,
    )
    command.add_argument("config", metavar="FILE.toml", help="settings of a simulation, with a table [visibility]")
    command.add_argument("--threads", type=_integer(1), metavar="N", help="default: all processors")
    _add_speech(command)


def _add_dataset(commands: Any) -> None:
    command = commands.add_parser(
        "dataset",
        help="make a data set with the truth of every ion, or verify one",
        description="Run the simulations of a study file, record their ions as an instrument would, and write them\n"
        "with the truth: for machine learning and statistics. Time and size are foretold. The command can be killed\n"
        "and started again at any time; equal studies give equal bytes. For the folder of a data set, verify it.",
        epilog="example:\n"
        "  apt-evap dataset study.toml --plan              runs, examples, hours, size; runs nothing\n"
        "  apt-evap dataset study.toml -o set --workers 2  make the set, or finish it\n"
        "  apt-evap dataset set                            verify its checksums",
        **_SHAPE,
    )
    command.add_argument("study", metavar="STUDY.toml", help="study file with a table [dataset], or a data set")
    command.add_argument("-o", "--output", metavar="FOLDER", help="default: name of the study with _set")
    command.add_argument("--plan", action="store_true", help="only foretell time and size")
    command.add_argument("--workers", type=_integer(1), default=1, metavar="N", help="processes; default: 1")
    command.add_argument(
        "--without-failed", action="store_true", help="leave out runs that have failed, instead of an error"
    )
    _add_speech(command)


# ---- arguments of several commands -----------------------------------------------------------------------------------

_FILE_HELP = "a run (.h5), measured ions (.epos, ...) or a map (.npz)"


def _add_reading(parser: argparse.ArgumentParser) -> Any:
    """Add options for reading a file and selecting ions; return the first group."""
    group = parser.add_argument_group("reading of files")
    group.add_argument("--format", metavar="SUFFIX", help="read ions in this format, such as .pos")
    group.add_argument("--partial", action="store_true", default=None, help="read a truncated file to its last ion")
    group.add_argument("--byte-order", choices=("big", "little"), help="byte order of .pos and .epos files")
    group.add_argument("--arrays", metavar="V,X,Y[,MASK]", help="names in an .npz: values, edges in x and y, mask")
    group.add_argument("--unit", metavar="UNIT", help="unit of the edges in an .npz: mm, cm, m or um")
    group.add_argument(
        "--undistort", metavar="GRID.csv", help="calibration grid of the instrument, such as a reflectron"
    )
    selection = parser.add_argument_group("selection of ions", "LOW <= value < HIGH; LOW or HIGH may be omitted: 27,")
    selection.add_argument("--mass", type=_bounds, metavar="LOW,HIGH", help="mass-to-charge ratio [Da]")
    selection.add_argument("--voltage", type=_bounds, metavar="LOW,HIGH", help="DC voltage [V]")
    selection.add_argument(
        "--ions", type=_bounds, metavar="FIRST,LAST", help="in the order of the file, from 0; LAST is not included"
    )
    selection.add_argument("--circle", type=_circle, metavar="R[,X,Y]", help="radius and centre on the detector [mm]")
    selection.add_argument("--box", type=_box, metavar="X0,X1,Y0,Y1", help="rectangle on the detector [mm]")
    selection.add_argument("--ranges", metavar="FILE.rrng", help="or .rng, .env: ranges of mass, for --species")
    selection.add_argument(
        "--species", metavar="NAME[,NAME]", help="ions of these names, such as Si: in --ranges, or of a run"
    )
    return group


def _types(text: str) -> list[tuple[str, str]]:
    pairs = [(part.partition("=")[0], part.partition("=")[2]) for part in text.split(",")]
    if not all(key and name for key, name in pairs):
        raise argparse.ArgumentTypeError(f"must be types with their elements, such as 1=Al,2=Cu, got {text!r:.80}")
    return pairs


def _add_real_units(command: argparse.ArgumentParser) -> None:
    """Add the option for real units."""
    command.add_argument(
        "--real-units",
        nargs="?",
        const="cap",
        choices=("cap", "site"),
        metavar="REFERENCE",
        help="true V, eV and ns: the evaporation field is reached by the mean of the cap (cap, the default) or by the "
        "evaporating atom (site)",
    )
    command.add_argument(
        "--lens",
        metavar="L",
        help="microscope around the specimen: local-electrode or plane-electrode, with changed fields of "
        "LocalElectrode such as local-electrode:shank_angle=7,distance=60e3 [degrees, nm]; for a run in real units",
    )


def _add_speech(command: argparse.ArgumentParser) -> None:
    """Add options for the messages of a command: text, JSON or none."""
    speech = command.add_mutually_exclusive_group()
    speech.add_argument("--quiet", action="store_true", help="only warnings and errors")
    speech.add_argument("--json", action="store_true", help="one line of JSON that names the written files")


# ---- types of arguments ----------------------------------------------------------------------------------------------


def _integer(least: int, largest: int | None = None) -> Callable[[str], int]:
    """Integer within bounds."""

    def integer(text):
        try:
            number = int(text)
        except ValueError:
            number = least - 1
        if number < least or (largest is not None and number > largest):
            bounds = f">= {least}" if largest is None else f"from {least} to {largest}"
            raise argparse.ArgumentTypeError(f"must be an integer {bounds}, got {text!r:.80}")
        return number

    return integer


def _number(unit: str) -> Callable[[str], float]:
    """Finite number >= 0."""

    def number(text):
        try:
            value = float(text)
        except ValueError:
            value = -1.0
        if not 0 <= value < inf:
            raise argparse.ArgumentTypeError(f"must be a number [{unit}] >= 0, got {text!r:.80}")
        return value

    return number


def _numbers(text: str) -> tuple[float, ...]:
    """Numbers separated by commas."""
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be numbers separated by commas, got {text!r:.80}") from None


def _origin(text):
    """Host and port of an address; a browser leaves the usual port of the protocol out, and Bokeh then takes 80."""
    match = re.fullmatch(r"([A-Za-z0-9._-]+)(:\d{1,5})?", text)
    if match is None or int((match[2] or ":80")[1:]) > 65535:
        raise argparse.ArgumentTypeError(f"must be HOST or HOST:PORT, such as hub.example.org, got {text!r:.80}")
    return text.lower()


def _mark(n: int) -> Callable[[str], tuple[Any, ...]]:
    """`n` coordinates, and perhaps three or four indices after them."""

    def mark(text):
        numbers = _numbers(text)
        indices = numbers[n:]
        if len(numbers) < n or len(indices) not in (0, 3, 4) or any(each != round(each) for each in indices):
            raise argparse.ArgumentTypeError(f"must be {n} coordinates [mm], perhaps with indices, got {text!r:.80}")
        return (*numbers[:n], tuple(int(each) for each in indices)) if indices else numbers

    return mark


def _option(text: str) -> tuple[str, tuple[float, ...]]:
    """Name of an option and its numbers."""
    name, equals, numbers = text.partition("=")
    if not (name and equals):
        raise argparse.ArgumentTypeError(f"must be NAME=N,N,..., got {text!r:.80}")
    return name, _numbers(numbers)


def _bounds(text: str) -> tuple[float | None, float | None]:
    """Two bounds, None for an omitted one."""
    try:
        low, high = (float(part) if part.strip() else None for part in text.split(","))
        ordered = low is None or high is None or low <= high
        if not ordered or not all(bound is None or isfinite(bound) for bound in (low, high)):
            raise ValueError
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be two increasing numbers, such as 27,29.5, got {text!r:.80}") from None
    return low, high


def _circle(text: str) -> tuple[float, tuple[float, ...]]:
    """Radius and centre of a circle."""
    try:
        radius, *centre = (float(part) for part in text.split(","))
        if radius <= 0 or len(centre) not in (0, 2) or not all(map(isfinite, (radius, *centre))):
            raise ValueError
    except ValueError:
        expected = "a radius, or R,X,Y, such as 15,0,-2 [mm]"
        raise argparse.ArgumentTypeError(f"must be {expected}, got {text!r:.80}") from None
    return radius, tuple(centre) or (0.0, 0.0)


def _box(text: str) -> tuple[float, ...]:
    """Bounds of a rectangle in x and in y."""
    try:
        left, right, lower, upper = (float(part) for part in text.split(","))
        if not (left < right and lower < upper and all(map(isfinite, (left, right, lower, upper)))):
            raise ValueError
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be X0,X1,Y0,Y1, such as -5,5,0,8 [mm], got {text!r:.80}") from None
    return left, right, lower, upper
