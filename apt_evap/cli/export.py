"""`apt-evap export`: write the ions of a run as a file of ions."""

import argparse
from dataclasses import replace
from pathlib import Path

from apt_evap._common.files import FileError, check_path
from apt_evap.cli._files import in_real_units, read, select
from apt_evap.cli._output import tell, tell_json
from apt_evap.config.perturbation_text import read_perturbation
from apt_evap.detection.timing import Timing
from apt_evap.io.formats import write
from apt_evap.simulation.run import Run


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    output = check_path(options.output or f"{Path(options.file).stem}.epos")
    if output.exists() and not options.force:
        raise FileError(f"{str(output)!r} exists: --force overwrites it")
    run = read(options)
    if not isinstance(run, Run):
        raise ValueError(f"export needs a run (.h5), {options.file!r} contains other data")
    run = in_real_units(run, options)
    if options.temperature is not None or options.jitter is not None:
        run = _with_errors(run, options)
    perturbation = run.first_perturbation
    if options.perturbation is not None:
        perturbation = read_perturbation(options.perturbation)
    hits = select(run.hits(perturbation), options)
    detected = hits[hits.detected]
    if not len(detected):
        raise ValueError(f"none of the {len(hits):,} ions of {options.file!r} hit the detector: nothing to write")
    write(output, detected)
    tell(options, f"wrote {len(detected):,} ions to {output}")
    tell_json(options, {"wrote": str(output), "file": options.file, "ions": len(detected)})
    return 0


def _with_errors(run, options):
    """The run with errors of its times."""
    if run.units is None:
        raise ValueError("--temperature and --jitter need a run in real units: add --real-units")
    timing = Timing(jitter=options.jitter or 0.0, temperature=options.temperature)
    return replace(run, units=replace(run.units, timing=timing))
