"""`apt-evap reconstruct`: positions of ions in the specimen from their hits."""

import argparse
from pathlib import Path

from apt_evap import plot
from apt_evap._common.codec import for_json
from apt_evap._common.files import FileError, check_path
from apt_evap._common.validation import check_number
from apt_evap.cli._files import (
    check_output,
    in_real_units,
    is_picture,
    lens_of,
    picture_path,
    read,
    save_figure,
    select,
    with_masses,
)
from apt_evap.cli._output import tell, tell_json
from apt_evap.config.perturbation_text import read_perturbation
from apt_evap.detection.hits import Hits
from apt_evap.io.formats import read_ranges
from apt_evap.reconstruction.constants import run_constants
from apt_evap.reconstruction.origins import OriginTable
from apt_evap.reconstruction.reconstruct import reconstruct
from apt_evap.simulation.run import Run
from apt_evap.specimen.lattice import atom_density
from apt_evap.specimen.materials import MATERIALS, material


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    output = check_path(options.output or f"{Path(options.file).stem}_reconstructed.pos")
    if output.exists() and not options.force:
        raise FileError(f"{str(output)!r} exists: --force overwrites it")
    picture = None if options.picture is None else picture_path(options.picture)
    if picture is not None:
        check_output(picture, is_picture, options.force)
    hits, known = _ions(options)
    settings = known | _constants(options)
    if settings["radius"] != "voltage":
        for name in ("field_factor", "evaporation_field"):
            if getattr(options, name) is None:
                settings.pop(name, None)
    if "atomic_volume" not in settings:
        raise ValueError("--atomic-volume [nm^3] or --element is missing")
    if "distance" not in settings:
        raise ValueError("--distance is missing: the flight length [mm] is needed for ions that are not from a run")
    if hits.voltage is None and settings["radius"] == "voltage":
        raise ValueError(
            f"{options.file!r} has no voltages: --radius shank, or a radius [nm], needs none, got --radius voltage"
        )
    # ranges without species are only for the picture
    ranges = read_ranges(options.ranges) if picture is not None and options.ranges is not None else None
    if ranges is not None and options.species is None:
        options.ranges = None
    reconstruction = reconstruct(select(with_masses(hits, options), options), **settings)
    reconstruction.write(output, frame=options.frame)
    tell(options, f"{reconstruction!r}")
    result = {"wrote": str(output), "file": options.file, "ions": len(reconstruction)}
    if picture is not None:
        save_figure(picture, plot.reconstruction(reconstruction, ranges)[0].figure)
        result["picture"] = str(picture)
    result["settings"] = for_json(dict(reconstruction.settings))
    if hits.outcome is not None and len(reconstruction) > 2:  # simulated: the true sites are known
        errors = reconstruction.errors()
        result["errors"] = errors.to_dict()
        tell(options, f"RMS errors: {errors.lateral_rms:.3f} nm lateral, {errors.depth_rms:.3f} nm in depth")
    tell(options, f"wrote {len(reconstruction):,} ions to {output}")
    if picture is not None:
        tell(options, f"wrote {picture}")
    tell_json(options, result)
    return 0


def _ions(options):
    """Ions of the file, and the constants that it determines."""
    content = read(options)
    if isinstance(content, Run):
        run = in_real_units(content, options)
        if run.units is None and options.radius == "voltage":
            raise ValueError(f"{options.file!r} has the voltages of a simulation: add --real-units")
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


_GIVEN = (
    "protocol",
    "projection",
    "distance",
    "compression",
    "efficiency",
    "detector_radius",
    "field_factor",
    "smoothing",
    "initial_radius",
    "shank_angle",
    "evaporation_field",
    "atomic_volume",
)


def _constants(options):
    """Arguments of `reconstruct` that the options set."""
    settings = {name: getattr(options, name) for name in _GIVEN if getattr(options, name) is not None}
    settings["radius"] = _radius(options.radius)
    if options.origins is not None:
        settings["origins"] = OriginTable.load(options.origins)
    if options.lens is not None:
        settings["lens"] = lens_of(options)
    if options.element is not None:
        element = _element(options.element)
        settings.setdefault("atomic_volume", 1 / atom_density(element.structure, element.a, element.c))
        if settings["radius"] == "voltage":
            settings.setdefault("evaporation_field", element.evaporation_field)
    return settings


def _field(options):
    """Evaporation field of the options [V/nm], None if they have none."""
    if options.evaporation_field is None and options.element is not None:
        return _element(options.element).evaporation_field
    return options.evaporation_field


def _element(name):
    try:
        return material(name)
    except ValueError as error:
        raise ValueError(
            f"--element must be one of {', '.join(MATERIALS)}, got {name!r:.80}: for other elements use "
            "--atomic-volume [nm^3] and --evaporation-field [V/nm]"
        ) from error


def _radius(text):
    """The words voltage or shank, or a radius [nm]."""
    if text in ("voltage", "shank"):
        return text
    try:
        radius = float(text)
    except ValueError:
        raise ValueError(f"--radius must be voltage, shank or a number [nm], got {text!r:.80}") from None
    return check_number(radius, "--radius", above=0, unit="nm")
