"""The command line: `apt-evap run`, `apt-evap map` and `apt-evap info`."""

import argparse
import contextlib
import json
import os
import sys
import tempfile
import time
import warnings
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np

from apt_evap import plot
from apt_evap._arrays import check_number
from apt_evap._files import FileError, check_path, replace_file
from apt_evap._version import __version__
from apt_evap.config import MOST_BINS, MapSettings, Panel, read_config, read_maps, read_perturbation, title_of
from apt_evap.info import UNITS, describe
from apt_evap.io import read
from apt_evap.perturbation import Unperturbed
from apt_evap.run import Run

_MARK = f"apt_evap {__version__}"
_MARK_KEYS = {".png": "Software", ".pdf": "Creator", ".svg": "Creator"}
_INTERRUPTED = 130  # 128 + SIGINT, as shells count


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
        warnings.showwarning = lambda message, *_, **__: _say("warning", message)
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
            return _INTERRUPTED
        except BrokenPipeError:
            # whoever read the output has left; what is still buffered must not complain at exit
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 1
        except MemoryError as error:
            _say("error", str(error) or "not enough memory")
        except (ValueError, OSError) as error:
            _say("error", error)
        return 2


def _say(kind, message):
    print(f"apt-evap: {kind}: {' '.join(str(message).split())}", file=sys.stderr)


class _Parser(argparse.ArgumentParser):
    def error(self, message):
        raise ValueError(f"{message} (see {self.prog} --help)")


def _parser():
    shape = {"formatter_class": argparse.RawDescriptionHelpFormatter, "allow_abbrev": False}
    parser = _Parser(
        prog="apt-evap",
        description="Field evaporation in atom probe tomography.",
        epilog="example: apt-evap run examples/ni111.toml",
        **shape,
    )
    parser.add_argument("--version", action="version", version=f"apt-evap {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    command = commands.add_parser(
        "run",
        help="simulate what a TOML file describes",
        description="Simulate what a TOML file describes, save the run and draw its detector maps.\n"
        "Ctrl-C ends the simulation and saves what is done.",
        epilog="example: apt-evap run examples/ni111.toml -o ni.h5 --ions 5000",
        **shape,
    )
    command.add_argument("config", metavar="CONFIG.toml")
    command.add_argument("-o", "--output", metavar="RUN.h5", help="default: output of the file, or its name with .h5")
    command.add_argument("--ions", type=_whole(1), metavar="N", help="atoms to evaporate, instead of those of the file")
    command.add_argument("--threads", type=_whole(1), metavar="N", help="default: all processors")
    command.add_argument("--seed", type=_whole(0), metavar="N", help="instead of that of the file")
    command.add_argument("--map", metavar="MAP.png", help="picture of the maps; default: beside the run")
    command.add_argument("--quiet", action="store_true", help="no progress bar, no summary")
    command.add_argument("--force", action="store_true", help="overwrite files that apt-evap did not make")
    command.set_defaults(command=_run)

    reading = argparse.ArgumentParser(add_help=False)
    reading.add_argument("file", metavar="FILE", help="a run (.h5) or measured ions (.epos, ...)")
    group = reading.add_argument_group("reading of files")
    group.add_argument("--format", metavar="SUFFIX", help="read FILE as this format, such as .pos")
    group.add_argument("--partial", action="store_true", default=None, help="read the whole ions of a truncated file")
    group.add_argument("--byte-order", choices=("big", "little"), help="of .pos and .epos files")

    command = commands.add_parser(
        "map",
        parents=[reading],
        help="draw detector maps of a run or of measured ions",
        description="Draw detector maps of a run or of measured ions.",
        epilog="a perturbation is NAME, NAME:NUMBERS or a TOML table:\n"
        "  Unperturbed              RollUp:0.2 (eV, all ions)    RollUp:0.155,0.155 (mean, standard deviation)\n"
        "  LateralVelocity:0.3,0.1  Combined:0.155,0.155,0.75 (the last number is the share of the roll-up)\n"
        '  \'{name = "RollUp", energy = {name = "Thermal", temperature = 50}}\'\n\n'
        "example: apt-evap map ni111.h5 --perturbation Unperturbed --perturbation RollUp:0.3,0.1 -o energies.png",
        **shape,
    )
    command.add_argument("-o", "--output", metavar="MAP.png", help=".png, .pdf or .svg; default: FILE_map.png, here")
    command.add_argument(
        "--bins", type=_whole(1, MOST_BINS), metavar="N", help="along the longer side; default: about sqrt(ions)"
    )
    command.add_argument("--smooth", type=_smoothing, metavar="MM", help="sigma of a Gaussian; default: one bin")
    command.add_argument(
        "--perturbation", action="append", metavar="P", help="of the ions of a run; repeat it for maps side by side"
    )
    command.add_argument("--force", action="store_true", help="overwrite a file that apt-evap did not make")
    command.set_defaults(command=_map)

    command = commands.add_parser(
        "info",
        parents=[reading],
        help="say what is in a file",
        description="Say what is in a run or in a file of measured ions.",
        epilog="example: apt-evap info ni111.h5 --json",
        **shape,
    )
    command.add_argument("--json", action="store_true", help="as JSON")
    command.set_defaults(command=_info)
    return parser


def _whole(least, most=None):
    def whole(text):
        try:
            number = int(text)
        except ValueError:
            number = least - 1
        if number < least or (most is not None and number > most):
            bounds = f"of at least {least}" if most is None else f"from {least} to {most}"
            raise argparse.ArgumentTypeError(f"must be a whole number {bounds}, got {text!r}")
        return number

    return whole


def _smoothing(text):
    try:
        return check_number(float(text), "it", at_least=0, unit="mm")
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a number [mm] of at least 0, got {text!r}") from None


# ---- run -------------------------------------------------------------------------------------------------------------


def _run(options):
    config = read_config(options.config)
    output = check_path(options.output or config.output or f"{config.path.stem}.h5")
    if output.suffix.lower() != ".h5":
        raise FileError(f"a run is saved in an HDF5 file whose name ends in .h5, got {str(output)!r}")
    picture = _picture(options.map or output.with_suffix(".png"))
    # before the hours of computing, not after
    _check_output(output, _is_run, options.force)
    _check_output(picture, _is_picture, options.force)

    def tell(line):
        if not options.quiet:
            print(line, flush=True)

    simulation = config.simulation(seed=options.seed, n_threads=options.threads)
    tell(f"{str(simulation.tip).strip('<>')}; {len(simulation.emitter):,} atoms on the surface")
    began = time.perf_counter()
    provenance = {"config": config.path.name, "maps": config.maps.to_dict()}
    try:
        run = simulation.run(
            options.ions or config.n_ions,
            config.emissions,
            responses=config.responses,
            progress=False if options.quiet else None,
        )
    except Exception as error:
        if run := getattr(error, "run", None):
            replace(run, provenance=run.provenance | provenance).save(output)
            _say("note", f"the {len(run):,} ions done so far are in {str(output)!r}")
        raise
    seconds = time.perf_counter() - began
    run = replace(run, provenance=run.provenance | provenance)
    run.save(output)
    tell(f"{len(run):,} ions in {seconds:.1f} s, {len(run) / seconds:,.0f} ions/s")
    for panel in config.maps.panels:
        hit, missed, never_left = run.hits(panel.perturbation).counts.values()
        tell(f"{panel.title}: {hit:,} hit the detector, {missed:,} missed it, {never_left:,} never left the tip")
    if run.responses is not None:
        tell(f"responses: {run.marked.sum():,} ions marked as inexact")
    if run.ended:
        _say("note", f"the run ended before its time: {run.ended}; the {len(run):,} ions so far are kept")
    tell(f"wrote {output}")
    try:
        _save_picture(picture, *_run_maps(run, config.maps))
    except ValueError as error:
        raise ValueError(f"no maps are drawn, the run is in {str(output)!r}: {error}") from error
    tell(f"wrote {picture}")
    return _INTERRUPTED if run.ended == "interrupted" else 0


# ---- map -------------------------------------------------------------------------------------------------------------


def _map(options):
    picture = _picture(options.output or f"{Path(options.file).stem}_map.png")
    _check_output(picture, _is_picture, options.force)
    held = _read(options)
    if isinstance(held, Run):
        maps = _run_maps(held, _map_settings(held, options))
    elif options.perturbation:
        raise ValueError(f"--perturbation needs a run (.h5), {options.file!r} holds measured ions")
    elif held.x is None or held.y is None:
        raise ValueError(
            f"{options.file!r} has no detector coordinates x and y, which a map needs, only {', '.join(held.columns)}"
        )
    else:
        drawn = held.map(options.bins or _bins_for(np.count_nonzero(held.detected)))
        maps = [_smoothed(drawn, options.smooth)], [Path(options.file).name]
    _save_picture(picture, *maps)
    print(f"wrote {picture}")
    return 0


def _map_settings(run, options):
    """Settings of the maps of a run: those given, else those it was made with, else the usual ones."""
    settings = read_maps(run.provenance.get("maps", {}))
    if options.perturbation:
        chosen = [read_perturbation(text) for text in options.perturbation]
        panels = tuple(Panel(title_of(perturbation), perturbation) for perturbation in chosen)
        settings = replace(settings, panels=panels)
    elif "maps" not in run.provenance and run.responses is None:
        flown = tuple(perturbation for perturbation in run.perturbations if not isinstance(perturbation, dict))
        settings = MapSettings(tuple(Panel(title_of(each), each) for each in flown or (Unperturbed(),)))
    if options.bins is not None:
        # what was a good smoothing for other bins is not for these
        settings = replace(settings, bins=options.bins, smoothing=None)
    return settings if options.smooth is None else replace(settings, smoothing=options.smooth)


def _run_maps(run, settings):
    """Maps of the whole detector, and their titles."""
    half = run.detector.width / 2
    bins = settings.bins or _bins_for(len(run))
    maps = [
        run.hits(panel.perturbation).map(
            bins,
            extent=(-half, half, -half, half),
            quantum=None,
            mask=np.broadcast_to(True, (bins, bins)),  # the whole detector is simulated, no outline is to be found
        )
        for panel in settings.panels
    ]
    return [_smoothed(each, settings.smoothing) for each in maps], [panel.title for panel in settings.panels]


def _bins_for(ions):
    """Bins along a side: the power of 2 from 32 to 256 that is closest to one ion per bin."""
    return int(2 ** np.clip(np.rint(np.log2(max(ions, 1)) / 2), 5, 8))


def _smoothed(drawn, sigma):
    return drawn.smoothed(max(drawn.bin_size) if sigma is None else sigma)


# ---- info ------------------------------------------------------------------------------------------------------------


def _info(options):
    held = _read(options)
    told = {"file": options.file} | describe(held)
    if options.json:
        print(json.dumps(told, indent=2, allow_nan=False))
    else:
        print("\n".join(_lines(told)))
    return 0


def _lines(told, indent=0):
    labels = {key: f"{key.replace('_', ' ')} [{UNITS[key]}]" if key in UNITS else key.replace("_", " ") for key in told}
    width = max(map(len, labels.values()), default=0)
    for key, value in told.items():
        if isinstance(value, dict) and value:
            yield f"{'':{indent}}{labels[key]}"
            yield from _lines(value, indent + 2)
        else:
            yield f"{'':{indent}}{labels[key]:{width}}  {_text(value)}"


def _text(value):
    if isinstance(value, list | dict):
        return "   ".join(_text(item) for item in value) or "none"
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    return "none" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


# ---- files -----------------------------------------------------------------------------------------------------------


def _read(options):
    wanted = {"partial": options.partial, "byte_order": options.byte_order}
    try:
        return read(
            options.file, format=options.format, **{key: value for key, value in wanted.items() if value is not None}
        )
    except FileError as error:
        # the readers speak of arguments of Python
        message = str(error).replace("partial=True", "--partial").replace("byte_order=", "--byte-order ")
        raise FileError(message.replace("format=", "--format ")) from error


def _picture(path):
    path = check_path(path)
    if path.suffix.lower() not in _MARK_KEYS:
        raise FileError(f"a picture is a {', '.join(_MARK_KEYS)} file, got {str(path)!r}")
    return path


def _save_picture(path, maps, titles):
    figure = plot.detector_maps(maps, titles, limits=plot.common_limits(maps))[0].figure
    suffix = path.suffix.lower()
    with replace_file(path) as file:
        figure.savefig(file, format=suffix[1:], dpi=200, metadata={_MARK_KEYS[suffix]: _MARK})


def _check_output(path, is_ours, force):
    """Make sure that a file can be written, and that nobody else's is overwritten."""
    target = Path(os.path.realpath(path))
    try:
        if target.is_dir():
            raise IsADirectoryError(None, "Is a directory")
        with tempfile.TemporaryFile(dir=target.parent):
            pass
        if target.exists() and not force and not is_ours(target):
            raise FileError(f"{str(path)!r} exists and was not made by apt-evap: --force overwrites it")
    except OSError as error:
        raise FileError(f"cannot write {str(path)!r}: {error.strerror or error}") from error


def _is_run(path):
    with contextlib.suppress(OSError, RuntimeError), h5py.File(path, "r") as file:
        return str(file.attrs.get("format", "")).startswith("apt_evap run")
    return False


def _is_picture(path):
    return b"apt_evap" in path.read_bytes()
