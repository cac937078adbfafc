"""`apt-evap reconstruct`: positions of ions in the specimen from their hits."""

import argparse
from pathlib import Path

from apt_evap._common.files import FileError, check_path
from apt_evap._common.validation import check_number
from apt_evap.cli._files import in_real_units, read, select
from apt_evap.cli._output import tell, tell_json
from apt_evap.config.perturbation_text import read_perturbation
from apt_evap.detection.hits import Hits
from apt_evap.reconstruction.origins import OriginTable
from apt_evap.reconstruction.reconstruct import reconstruct
from apt_evap.simulation.run import Run
from apt_evap.specimen.lattice import atom_density
from apt_evap.specimen.materials import material


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    output = check_path(options.output or f"{Path(options.file).stem}_reconstructed.pos")
    if output.exists() and not options.force:
        raise FileError(f"{str(output)!r} exists: --force overwrites it")
    hits, distance = _ions(options)
    settings = _constants(options)
    if distance is None:
        raise ValueError("--distance is missing: the flight length [mm] is needed for ions that are not from a run")
    if hits.voltage is None and settings["radius"] == "voltage":
        raise ValueError(
            f"{options.file!r} has no voltages: --radius shank, or a radius [nm], needs none, got --radius voltage"
        )
    reconstruction = reconstruct(select(hits, options), distance=distance, **settings)
    reconstruction.write(output, frame=options.frame)
    tell(options, f"{reconstruction!r}")
    result = {"wrote": str(output), "file": options.file, "ions": len(reconstruction)}
    result["settings"] = dict(reconstruction.settings)
    if hits.outcome is not None and len(reconstruction) > 2:  # simulated: the true sites are known
        errors = reconstruction.errors()
        result["errors"] = errors.to_dict()
        tell(options, f"RMS errors: {errors.lateral_rms:.3f} nm lateral, {errors.depth_rms:.3f} nm in depth")
    tell(options, f"wrote {len(reconstruction):,} ions to {output}")
    tell_json(options, result)
    return 0


def _ions(options):
    """Ions of the file, and the flight length of the options or of a run."""
    content = read(options)
    if isinstance(content, Run):
        run = in_real_units(content, options)
        if run.units is None and options.radius == "voltage":
            raise ValueError(f"{options.file!r} has the voltages of a simulation: add --real-units")
        perturbation = run.first_perturbation
        if options.perturbation is not None:
            perturbation = read_perturbation(options.perturbation)
        distance = run.detector.distance if options.distance is None else options.distance
        return run.hits(perturbation), distance
    if not isinstance(content, Hits):
        raise ValueError(f"reconstruct needs ions or a run, {options.file!r} contains a map")
    for name in ("real_units", "perturbation"):
        if getattr(options, name) is not None:
            raise ValueError(f"--{name.replace('_', '-')} needs a run (.h5), {options.file!r} contains measured ions")
    return content, options.distance


def _constants(options):
    """Arguments of `reconstruct` from the options."""
    names = ("protocol", "projection", "compression", "efficiency", "detector_radius", "field_factor", "smoothing")
    settings = {name: getattr(options, name) for name in names}
    settings |= {name: getattr(options, name) for name in ("initial_radius", "shank_angle", "evaporation_field")}
    settings["radius"] = _radius(options.radius)
    settings["origins"] = None if options.origins is None else OriginTable.load(options.origins)
    settings["atomic_volume"] = options.atomic_volume
    if options.element is not None:
        element = material(options.element)
        if options.atomic_volume is None:
            settings["atomic_volume"] = 1 / atom_density(element.structure, element.a, element.c)
        if options.evaporation_field is None and settings["radius"] == "voltage":
            settings["evaporation_field"] = element.evaporation_field
    if settings["atomic_volume"] is None:
        raise ValueError("--atomic-volume [nm^3] or --element is missing")
    return settings


def _radius(text):
    """The words voltage or shank, or a radius [nm]."""
    if text in ("voltage", "shank"):
        return text
    try:
        radius = float(text)
    except ValueError:
        raise ValueError(f"--radius must be voltage, shank or a number [nm], got {text!r}") from None
    return check_number(radius, "--radius", above=0, unit="nm")
