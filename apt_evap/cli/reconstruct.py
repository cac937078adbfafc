"""`apt-evap reconstruct`: positions of ions in the specimen from their hits."""

import argparse
from pathlib import Path

from apt_evap.cli._declared_options import add_declared
from apt_evap.cli._options import MATERIAL_HELP, add_reading, add_real_units, add_speech, add_time_zero
from apt_evap.cli._output import tell, tell_json

_CONSTANTS = (
    "protocol",
    "projection",
    "distance",
    "detector_radius",
    "compression",
    "efficiency",
    "atomic_volume",
    "evaporation_field",
    "field_factor",
    "smoothing",
    "initial_radius",
    "shank_angle",
)
"""Fields of `ReconstructionSettings` that are options."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Reconstruct the positions of ions in the specimen from their hits and their sequence, and write\n"
        "them as .pos, .epos, .xyz or .vtp. A run has its own constants; its true sites give the errors."
    )
    parser.epilog = (
        "example:\n"
        "  apt-evap reconstruct R5083.epos --element Si --distance 90 --efficiency 0.57 -o R5083.pos\n"
        "  apt-evap reconstruct R5083.epos --element Si --distance 90 --ranges R5083.rrng\n"
        "  apt-evap reconstruct ni111.h5 --real-units\n"
        "  apt-evap reconstruct R5083.epos --atomic-volume 0.02 --distance 90 --radius shank --initial-radius 30 \\\n"
        "      --shank-angle 5"
    )
    parser.add_argument("file", metavar="FILE", help="measured ions (.epos, ...) or a run (.h5)")
    parser.add_argument("-o", "--output", metavar="OUT", help="default: FILE_reconstructed.pos in this folder")
    parser.add_argument(
        "--frame",
        choices=("depth", "specimen"),
        default="depth",
        help="z is the depth, or goes out of the specimen; default: depth",
    )
    parser.add_argument(
        "--picture",
        metavar="P.png",
        help="side view, top view, depth profile and composition; --ranges gives the species of measured ions; "
        "default: the name of OUT with .png",
    )
    constants = parser.add_argument_group("constants", "The defaults of a run are its own constants.")
    add_declared(constants, "reconstruction.reconstruction_settings", "ReconstructionSettings", _CONSTANTS)
    constants.add_argument("--element", metavar="NAME", help=f"gives atomic volume and field: {MATERIAL_HELP}")
    constants.add_argument(
        "--radius", default="voltage", metavar="R", help="voltage, shank, or a constant radius [nm]; default: voltage"
    )
    constants.add_argument("--origins", metavar="TABLE.npz", help="correct lateral positions by a table of origins")
    add_time_zero(constants)
    parser.add_argument("--peaks", metavar="NAME", help="only the ions in the peaks of this element; default: all ions")
    parser.add_argument("--perturbation", metavar="P", help="of a run, as for map; default: the first one of the run")
    add_real_units(parser)
    add_reading(parser)
    parser.add_argument("--force", action="store_true", help="overwrite an existing file")
    add_speech(parser)


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    from dataclasses import replace

    from apt_evap import plot
    from apt_evap._common.codec import for_json
    from apt_evap._common.files import FileError, check_path
    from apt_evap.cli._files import file_of, note
    from apt_evap.io.formats import read_ranges, write
    from apt_evap.plot.reconstructions import FEWEST
    from apt_evap.reconstruction.origins import OriginTable
    from apt_evap.reconstruction.reconstruct import reconstruct
    from apt_evap.workflows.written_pictures import check_output, is_picture, picture_path, save_figure

    output = check_path(options.output or f"{Path(options.file).stem}_reconstructed.pos")
    if output.exists() and not options.force:
        raise FileError(f"{str(output)!r} exists: --force overwrites it")
    picture = output.with_suffix(".png") if options.picture is None else picture_path(options.picture)
    check_output(picture, is_picture, options.force)
    hits, known = _ions(options)
    settings = _settings(options, known)
    if not {"atomic_volume", "element"} & set(settings):
        raise ValueError("--atomic-volume [nm^3] or --element is missing")
    if "distance" not in settings:
        raise ValueError("--distance is missing: the flight length [mm] is needed for ions that are not from a run")
    if hits.voltage is None and settings["radius"] == "voltage":
        raise ValueError(
            f"{options.file!r} has no voltages: --radius shank, or a radius [nm], needs none, got --radius voltage"
        )
    ranges = read_ranges(options.ranges) if options.ranges is not None else None
    file = file_of(options)
    if options.species is None:  # ranges are then only for the picture
        file = replace(file, ranges=None)
    origins = None if options.origins is None else OriginTable.load(options.origins)
    reconstruction = reconstruct(file.select(hits, note), origins=origins, **settings)
    figure = None
    if options.picture is not None or len(reconstruction) >= FEWEST:
        figure = plot.reconstruction(reconstruction, ranges)[0].figure
    write(output, reconstruction.to_hits(options.frame))
    tell(options, f"{reconstruction!r}")
    result = {"wrote": str(output), "file": options.file, "ions": len(reconstruction)}
    if figure is not None:
        save_figure(picture, figure)
        result["picture"] = str(picture)
    result["settings"] = for_json(reconstruction.settings)
    if hits.outcome is not None and len(reconstruction) > 2:  # simulated: the true sites are known
        errors = reconstruction.errors()
        result["errors"] = errors.to_dict()
        tell(options, f"RMS errors: {errors.lateral_rms:.3f} nm lateral, {errors.depth_rms:.3f} nm in depth")
    tell(options, f"wrote {len(reconstruction):,} ions to {output}")
    tell(options, f"no picture of fewer than {FEWEST} ions" if figure is None else f"wrote {picture}")
    tell_json(options, result)
    return 0


def _ions(options):
    """Ions of the file, and the constants that it determines."""
    from apt_evap.cli._files import in_real_units, read
    from apt_evap.config.perturbation_text import read_perturbation
    from apt_evap.detection.hits import Hits
    from apt_evap.reconstruction.constants import run_constants
    from apt_evap.simulation.run import Run

    content = read(options)
    if isinstance(content, Run):
        run = in_real_units(content, options)
        perturbation = run.first_perturbation
        if options.perturbation is not None:
            perturbation = read_perturbation(options.perturbation)
        return run.hits(perturbation), run_constants(run, _field(options))
    if not isinstance(content, Hits):
        raise ValueError(f"reconstruct needs ions or a run, {options.file!r} contains a map")
    for name in ("real_units", "perturbation"):
        if getattr(options, name) is not None:
            raise ValueError(f"--{name.replace('_', '-')} needs a run (.h5), {options.file!r} contains measured ions")
    return content, {}


def _settings(options, known):
    """Settings of `reconstruct` by name: the options, and what else is known of a run."""
    from apt_evap.cli._files import lens_of

    chosen = {name: getattr(options, name) for name in _CONSTANTS if getattr(options, name) is not None}
    chosen["radius"] = _radius(options.radius)
    if options.lens is not None:
        chosen["lens"] = lens_of(options)
    of_run = dict(known)
    if options.element is not None:
        chosen["element"] = _element(options.element)
        for name in ("atomic_volume", "evaporation_field"):
            of_run.pop(name, None)
    if chosen["radius"] != "voltage":
        for name in ("field_factor", "evaporation_field"):
            of_run.pop(name, None)
    return of_run | chosen


def _field(options):
    """Evaporation field of the options [V/nm], None if they have none."""
    if options.evaporation_field is None and options.element is not None:
        return _element(options.element).evaporation_field
    return options.evaporation_field


def _element(text):
    from apt_evap._common.files import FileError
    from apt_evap.config.material_text import read_material

    try:
        return read_material(text, "--element")
    except FileError:
        raise
    except ValueError as error:
        raise ValueError(f"{error}, or use --atomic-volume [nm^3] and --evaporation-field [V/nm]") from error


def _radius(text):
    """The words voltage or shank, or a radius [nm]."""
    from apt_evap._common.validation import check_number

    if text in ("voltage", "shank"):
        return text
    try:
        radius = float(text)
    except ValueError:
        raise ValueError(f"--radius must be voltage, shank or a number [nm], got {text!r:.80}") from None
    return check_number(radius, "--radius", above=0, unit="nm")
