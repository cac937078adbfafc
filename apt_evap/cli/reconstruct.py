"""`apt-evap reconstruct`: positions of ions in the specimen from their hits."""

import argparse
import math
from pathlib import Path
from typing import Any

from apt_evap.cli._declared_options import add_declared
from apt_evap.cli._options import MATERIAL_HELP, add_reading, add_real_units, add_speech, add_time_zero, numbers_type
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
_ASSUMED = ("compression", "field_factor", "efficiency")
"""Those with a default, which is printed if it is used."""


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
        "  apt-evap reconstruct R5083.epos --element Al --distance 90 --efficiency 0.57 --calibrate\n"
        "  apt-evap reconstruct ni111.h5 --real-units\n"
        "  apt-evap reconstruct R5083.epos --element Al --distance 90 --efficiency 0.57 --shape evolving \\\n"
        "      --ranges R5083.rrng --solutes Mg,Zn\n"
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
        help="side view, top view, depth profile and composition; for an evolving shape both sections and the field "
        "of the surface; --ranges gives the species of measured ions; "
        "default: the name of OUT with .png",
    )
    surface = parser.add_argument_group("surface")
    surface.add_argument(
        "--shape",
        choices=("cap", "evolving"),
        default="cap",
        help="the surface stays a sphere, or follows the ions; default: cap",
    )
    surface.add_argument(
        "--solutes",
        metavar="A,B",
        help="species whose composition changes the field, for an evolving shape",
    )
    surface.add_argument(
        "--labels", metavar="COLUMN", help="a column of the ions with the number of their phase, in place of --solutes"
    )
    surface.add_argument(
        "--twin",
        metavar="RUN.h5",
        help="a run of the matrix alone, in the same orientation, whose mean errors are taken off an evolving shape",
    )
    surface.add_argument(
        "--check",
        nargs="?",
        const=(),
        type=numbers_type,
        metavar="H,K,L",
        help="sizes of the phases that an evolving shape has found, with errors; simulates its specimen along this "
        "crystal direction, and compares the density on the detector: minutes; default: that of a run, else 0,0,1",
    )
    constants = parser.add_argument_group("constants", "The defaults of a run are its own constants.")
    add_declared(constants, "reconstruction.reconstruction_settings", "ReconstructionSettings", _CONSTANTS)
    constants.add_argument("--element", metavar="NAME", help=f"gives atomic volume and field: {MATERIAL_HELP}")
    constants.add_argument("--radius", metavar="R", help="voltage, shank, or a constant radius [nm]; default: voltage")
    constants.add_argument(
        "--calibrate",
        action="store_true",
        help="compression, and radius or field factor, from the poles of the map and the spacing of their planes; "
        "needs --element; starts from radius or field factor, within a factor of 1.4",
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
    from apt_evap.reconstruction.assumed_constants import assumptions
    from apt_evap.reconstruction.evolving import EvolvingReconstruction
    from apt_evap.reconstruction.origins import OriginTable
    from apt_evap.reconstruction.reconstruct import reconstruct
    from apt_evap.workflows.written_pictures import check_output, is_picture, picture_path, save_figure

    output = check_path(options.output or f"{Path(options.file).stem}_reconstructed.pos")
    if output.exists() and not options.force:
        raise FileError(f"{str(output)!r} exists: --force overwrites it")
    picture = output.with_suffix(".png") if options.picture is None else picture_path(options.picture)
    check_output(picture, is_picture, options.force)
    extent = _Extent()
    hits, known, crystal, rolled = _ions(options, output, extent)
    settings = _settings(options, known)
    _check_complete(options, settings, hits)
    if hits.positions is not None and hits.outcome is None:
        extent.add(hits.positions)
    if extent.lengths is not None:
        size = " x ".join(f"{length:.1f}" for length in extent.lengths)
        note(f"the positions in {options.file!r}, {size} nm, are not used: those that are written follow from its hits")
    ranges = read_ranges(options.ranges) if options.ranges is not None else None
    file = file_of(options)
    if options.species is None:  # ranges are then for the picture and the solutes
        file = replace(file, ranges=None)
    if options.check is not None:
        material, axis = _crystal(options, settings, crystal)
    origins = None if options.origins is None else OriginTable.load(options.origins)
    selection = file.select(hits, note)
    surface, calibrated = _surface(options, selection, ranges), None
    if options.calibrate:
        calibrated = _calibrate(options, selection, surface, settings)
        settings |= calibrated.constants
    reconstruction = reconstruct(selection, origins=origins, **surface, **settings)
    figure, done = None, f"no picture of fewer than {FEWEST} ions"
    if options.picture is not None or len(reconstruction) >= FEWEST:
        if isinstance(reconstruction, EvolvingReconstruction) and reconstruction.history is not None:
            title = f"{Path(options.file).name}: {reconstruction.verdict}"
            figure = plot.surface_history(reconstruction, ranges, title=title)[0].figure
        else:
            figure = plot.reconstruction(reconstruction, ranges, title=Path(options.file).name)[0].figure
    write(output, reconstruction.to_hits(options.frame))
    tell(options, f"{reconstruction!r}")
    assumed = assumptions(reconstruction, [name for name in _ASSUMED if name not in settings])
    for one in assumed:
        tell(options, str(one))
    result = {"wrote": str(output), "file": options.file, "ions": len(reconstruction)}
    if figure is not None:
        done = save_figure(picture, figure)
        result["picture"] = str(picture)
    result["settings"] = for_json(reconstruction.settings)
    result["assumed"] = [one._asdict() for one in assumed]
    if calibrated is not None:
        result["calibrated"] = calibrated.to_dict()
    if isinstance(reconstruction, EvolvingReconstruction):
        result["surface"] = _tell_surface(options, reconstruction)
    if options.check is not None:
        result["check"] = _tell_check(
            options, reconstruction, material, axis, not options.check and crystal is None, rolled, calibrated
        )
    if hits.outcome is not None and len(reconstruction) > 2:  # simulated: the true sites are known
        errors = reconstruction.errors()
        result["errors"] = errors.to_dict()
        tell(options, f"RMS errors: {errors.lateral_rms:.3f} nm lateral, {errors.depth_rms:.3f} nm in depth")
    tell(options, f"wrote {len(reconstruction):,} ions to {output}")
    tell(options, done)
    tell_json(options, result)
    return 0


def _check_complete(options, settings, hits):
    """Raise one error that names all constants that are missing, each with a value to start from."""
    from apt_evap.reconstruction.assumed_constants import STARTS

    if hits.x is None or hits.y is None:
        own = "" if hits.positions is None else "; its own positions are what planes, clusters and proxigram take"
        raise ValueError(f"{options.file!r} has no detector coordinates x and y, which positions follow from{own}")
    missing = [] if "distance" in settings else ["distance"]
    named = bool({"atomic_volume", "element"} & set(settings))
    if not named:
        missing.append("element")
    without = settings["radius"] == "voltage" and hits.voltage is None
    if (
        settings["radius"] == "voltage"
        and not without
        and named
        and not {"evaporation_field", "element"} & set(settings)
    ):
        missing.append("evaporation_field")
    if settings["radius"] == "shank":
        missing += [name for name in ("initial_radius", "shank_angle") if name not in settings]
    listed = [(f"--{name.replace('_', '-')}", *STARTS[name]) for name in missing]
    if without:
        shank = f"or shank with --initial-radius {STARTS['initial_radius'][0]} --shank-angle {STARTS['shank_angle'][0]}"
        listed.append(("--radius", "30", f"nm, for it has no voltages; {shank}: from an electron micrograph"))
    if listed:
        main = _main_element(hits) if not named else None
        texts = [f"{name} {main if start == 'NAME' and main else start} ({source})" for name, start, source in listed]
        raise ValueError(f"{options.file!r} lacks constants, start with {', '.join(texts)}")


def _main_element(hits):
    """The main element of the spectrum of ions, None if it shows none."""
    from apt_evap.specimen.materials import MATERIALS
    from apt_evap.spectra.mass_spectrum import spectrum

    try:
        name = None if hits.mass_to_charge is None else spectrum(hits).main_element
    except ValueError:
        return None
    return name if name in MATERIALS else None


class _Extent:
    """Extent of the positions that a file has."""

    def __init__(self) -> None:
        self._low, self._high = [math.inf] * 3, [-math.inf] * 3

    def add(self, positions: Any) -> None:
        """Take the positions of some ions."""
        import numpy as np

        columns = positions.T
        if not (finite := np.isfinite(columns)).all():
            columns = columns[:, finite.all(axis=0)]
        for axis, column in enumerate(columns):  # 0.4 ms of 65,000 ions; along the axis of the rows 10
            self._low[axis] = min(self._low[axis], float(column.min(initial=math.inf)))
            self._high[axis] = max(self._high[axis], float(column.max(initial=-math.inf)))

    @property
    def lengths(self) -> list[float] | None:
        """Lengths of the extent [nm], None without any."""
        lengths = [high - low for low, high in zip(self._low, self._high, strict=True)]
        return lengths if max(lengths) > 0 and all(map(math.isfinite, lengths)) else None


def _surface(options, hits, ranges):
    """Arguments of `reconstruct` for the surface."""
    for name in ("solutes", "labels", "twin"):
        if options.shape == "cap" and getattr(options, name):
            raise ValueError(f"--{name} needs --shape evolving, got --shape cap")
    arguments = {"shape": options.shape, "ranges": ranges}
    if options.twin:
        from apt_evap.simulation.run import load

        arguments["twin"] = load(options.twin)
    if options.solutes:
        arguments["solutes"] = tuple(options.solutes.split(","))
    if options.labels:
        if options.labels not in hits.extra:
            raise ValueError(
                f"--labels must be a column of {options.file!r}, got {options.labels!r}; its own columns are "
                f"{', '.join(sorted(hits.extra)) or 'none'}"
            )
        arguments["labels"] = hits.extra[options.labels]
    return arguments


def _calibrate(options, hits, surface, settings):
    """Constants that the crystal determines, which are told."""
    from apt_evap.fit.crystal_constants import constants_of_crystal

    if "element" not in settings:
        raise ValueError("--calibrate needs --element, got none")
    for name in ("compression", "projection", "lens"):
        if (given := getattr(options, name)) is not None:
            raise ValueError(f"--calibrate finds a compression: --{name} must be left out, got {given}")
    known = {name: value for name, value in surface.items() if name != "twin"}
    found = constants_of_crystal(hits, **known, **settings)
    tell(options, str(found))
    return found


def _tell_surface(options, reconstruction):
    """Say what the surface was followed by and which fields were found; the same as numbers."""
    import numpy as np

    tell(options, reconstruction.verdict)
    for phase in reconstruction.phases:
        where = f", {phase.content:.1%} in {phase.matrix:.1%}" if phase.contrast == phase.contrast else ""
        value = f"{phase.ratio:.3f} ± {phase.error:.3f} of the matrix" if phase.error == phase.error else "not found"
        tell(options, f"evaporation field of {phase.name}{where}: {value}")
    found = {"verdict": reconstruction.verdict, "phases": [vars(phase) for phase in reconstruction.phases]}
    history = reconstruction.history
    if history is not None:
        low, high = np.quantile(history.recession, (0.05, 0.95))
        tell(options, f"recession over that of a cap: {low:.2f} to {high:.2f} in 90 % of the depth")
        found |= {
            "depths": history.depths.tolist(),
            "radii": history.radii.tolist(),
            "recession": history.recession.tolist(),
            "voltage": history.voltage.tolist(),
            "model_voltage": history.model_voltage.tolist(),
        }
    return found


def _crystal(options, settings, crystal):
    """Material and axis of the specimen that is simulated: the options, or those of a run."""
    from apt_evap.specimen.lattice import check_axis
    from apt_evap.specimen.materials import as_material

    material = settings.get("element", None if crystal is None else crystal.material)
    if options.shape == "cap" or material is None:
        got = f"--shape {options.shape}" if options.shape == "cap" else "no --element"
        raise ValueError(f"--check needs --shape evolving and --element, got {got}")
    material = as_material(material)
    axis = options.check or ((0, 0, 1) if crystal is None else crystal.axis)
    try:
        return material, check_axis(material.structure, axis)
    except ValueError as error:
        raise ValueError(f"--check: {error}") from error


def _tell_check(options, reconstruction, material, axis, assumed, rolled=False, calibrated=None):
    """Say whether a simulation of the specimen that was found confirms it; the same as numbers."""
    import numpy as np

    from apt_evap.reconstruction.phase_size import phase_sizes
    from apt_evap.reconstruction.position_errors import CONSTANT_ERRORS, LOCAL_SCATTER, ROLLED_SCATTER
    from apt_evap.reconstruction.specimen_check import check_specimen

    if not any(phase.error == phase.error for phase in reconstruction.phases):
        tell(options, "nothing to check: no evaporation field of a phase was found")
        return None
    scatter = ROLLED_SCATTER if rolled else LOCAL_SCATTER
    errors = dict(CONSTANT_ERRORS)
    if calibrated is not None:
        errors = dict(zip(errors, np.sqrt(np.diag(calibrated.covariance)).tolist(), strict=True))
    sizes = phase_sizes(reconstruction, None if calibrated is None else calibrated.covariance, scatter)
    for size in sizes:
        tell(options, str(size))
    counted = {**errors, "scatter_along": scatter[0], "scatter_across": scatter[1]}
    if sizes:
        constants = ", ".join(f"{name} {100 * error:.2g}%" for name, error in errors.items())
        tell(
            options,
            f"errors of sizes count on {constants}, and on places along the surface that scatter by "
            f"{scatter[0]:.2f} nm, as of ions {'that roll' if rolled else 'at rest'} (Al, R = 12 nm)"
            + ("" if rolled else f": those of ions that roll scatter by {ROLLED_SCATTER[0]:.2f} nm"),
        )
    check = check_specimen(reconstruction, material, axis=axis)
    along = " ".join(f"{part:g}" for part in axis)
    tell(options, f"{check}; simulated along [{along}]{', which is assumed: --check H,K,L' if assumed else ''}")
    found = {"explained": check.explained, "error": check.error, "confirmed": check.is_confirmed, "ions": check.ions}
    found["axis"] = list(axis)
    return found | {"sizes": [size._asdict() for size in sizes], "errors_of_sizes": counted}


def _ions(options, output, extent):
    """Ions of the file, the constants that it determines, the orientation of a run, and whether its ions roll."""
    from apt_evap.cli._files import in_real_units, read
    from apt_evap.detection.hits import Hits
    from apt_evap.maps.crystallography.orientation import Orientation
    from apt_evap.reconstruction.constants import run_constants
    from apt_evap.simulation.config.perturbation_text import read_perturbation
    from apt_evap.simulation.run import Run

    if (content := _ions_of_large_file(options, output, extent)) is None:
        content = read(options)
    if isinstance(content, Run):
        run = in_real_units(content, options)
        perturbation = run.first_perturbation
        if options.perturbation is not None:
            perturbation = read_perturbation(options.perturbation)
        rolled = perturbation != read_perturbation("Unperturbed")
        orientation = Orientation.known(run.settings["tip"])
        return run.hits(perturbation), run_constants(run, _field(options)), orientation, rolled
    if not isinstance(content, Hits):
        raise ValueError(f"reconstruct needs ions or a run, {options.file!r} contains a map")
    for name in ("real_units", "perturbation"):
        if getattr(options, name) is not None:
            raise ValueError(f"--{name.replace('_', '-')} needs a run (.h5), {options.file!r} contains measured ions")
    return content, {}, None, False


def _ions_of_large_file(options, output, extent):
    """Ions of a large file, with the columns that a .pos needs; None for other files, or if more is needed.

    The extent takes their positions.
    """
    from apt_evap.cli._files import blocks_of

    if output.suffix.lower() != ".pos" or options.shape != "cap" or options.labels:
        return None
    needed = ("mass_to_charge", "voltage", "pulse_voltage")
    # the distance is that of the reconstruction, and gives no masses
    blocks = blocks_of(options, ("x", "y"), further=(*needed, "positions"), without=("ranges", "distance"))
    if blocks is None or not blocks.field.ions or (options.distance is not None and needed[0] not in blocks.columns):
        return None
    seen = {"positions": extent.add} if "positions" in blocks.columns else {}
    return blocks.gathered("x", "y", *(name for name in needed if name in blocks.columns), seen=seen)


def _settings(options, known):
    """Settings of `reconstruct` by name: the options, and what else is known of a run."""
    from apt_evap.cli._files import lens_of

    chosen = {name: getattr(options, name) for name in _CONSTANTS if getattr(options, name) is not None}
    chosen["radius"] = _radius("voltage" if options.radius is None else options.radius)
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
    from apt_evap.simulation.config.material_text import read_material

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
