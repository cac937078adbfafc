"""`apt-evap export`: write the ions of a run or of a measurement as a file of ions."""

import argparse
from pathlib import Path

from apt_evap.cli._options import add_reading, add_real_units, add_speech, integer_type, number_type
from apt_evap.cli._output import tell, tell_json


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Write the ions that hit the detector, of a run or of a measurement, as a file of ions. The\n"
        "suffix of FILE selects the format, .h5 that of PyCCAPT. In real units an .epos has the voltages,\n"
        "times of flight, mass-to-charge ratios and pulses that an instrument could have written."
    )
    parser.epilog = (
        "example: apt-evap export ni111.h5 --real-units --perturbation RollUp:0.36,0.36 -o ni111.epos\n"
        "         apt-evap export R5083.epos -o R5083.nxs --elements Si,O"
    )
    parser.add_argument("file", metavar="IONS", help="a run (.h5) or measured ions (.epos, ...)")
    parser.add_argument("-o", "--output", metavar="FILE", help="default: the name of IONS with .epos")
    parser.add_argument(
        "--decimals", type=integer_type(0, 17), metavar="N", help="of numbers in a .csv; default: exact"
    )
    parser.add_argument("--separator", choices=("comma", "semicolon", "tab"), help="of columns in a .csv")
    parser.add_argument("--elements", metavar="NAME,...", help="of the specimen, for .nxs; default: those of the run")
    parser.add_argument("--perturbation", metavar="P", help="as for map; default: the first one of the run")
    add_real_units(parser)
    parser.add_argument("--temperature", type=number_type("K"), metavar="K", help="adds energy deficits to the times")
    parser.add_argument("--jitter", type=number_type("ns"), metavar="NS", help="error of the times; default: none")
    add_reading(parser)
    parser.add_argument("--force", action="store_true", help="overwrite an existing file")
    add_speech(parser)


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    from apt_evap._common.files import FileError, check_path
    from apt_evap.cli._files import file_of, read
    from apt_evap.io.formats import left_out, write

    output = check_path(options.output or f"{Path(options.file).stem}.epos")
    if output.exists() and not options.force:
        raise FileError(f"{str(output)!r} exists: --force overwrites it")
    if (written := _written_in_blocks(output, options)) is not None:
        _tell(options, output, *written, measured=True)
        return 0
    content = read(options)
    if output.exists() and output.samefile(check_path(options.file)):
        raise FileError(f"{str(output)!r} is the file that is read: -o needs another name")
    hits = file_of(options).select(_ions(content, options))
    detected = hits[hits.detected]
    if not len(detected):
        raise ValueError(f"none of the {len(hits):,} ions of {options.file!r} hit the detector: nothing to write")
    write(output, detected, **_writing(output, content, options))
    lost, zeros = left_out(output, detected)
    _tell(options, output, len(detected), lost, zeros, measured=detected.outcome is None)
    return 0


def _tell(options, output, ions, lost, zeros, *, measured):
    """Say what was written."""
    without = f", without {', '.join(lost)}" if lost and not measured else ""  # measured: see the warning
    without += f", with zeros for {', '.join(zeros)}" if zeros else ""
    tell(options, f"wrote {ions:,} ions to {output}{without}")
    counts = {"ions": ions, "left_out": list(lost), "zeros": list(zeros)}
    tell_json(options, {"wrote": str(output), "file": options.file} | counts)


def _written_in_blocks(output, options):
    """Number of ions and columns left out and of zeros, of a large file that is written block by block; else None."""
    from apt_evap.cli._files import blocks_of
    from apt_evap.io.formats import write_blocks, writes_blocks

    of_run = ("real_units", "lens", "perturbation", "temperature", "jitter", "decimals", "separator", "elements")
    if not writes_blocks(output) or any(getattr(options, name) is not None for name in of_run):
        return None
    if not Path(options.file).is_file() or (output.exists() and output.samefile(options.file)):
        return None
    blocks = blocks_of(options)
    if blocks is None or (blocks.field is not None and not blocks.field.ions):
        return None
    if output.suffix.lower() == ".pos" and "positions" not in blocks.columns:
        return None
    return write_blocks(output, blocks)


def _ions(content, options):
    """Ions of a run for the options, or measured ones."""
    from apt_evap.cli._files import in_real_units
    from apt_evap.detection.hits import Hits
    from apt_evap.simulation.config.perturbation_text import read_perturbation
    from apt_evap.simulation.run import Run

    if isinstance(content, Run):
        run = in_real_units(content, options)
        if options.temperature is not None or options.jitter is not None:
            run = _with_errors(run, options)
        perturbation = run.first_perturbation
        if options.perturbation is not None:
            perturbation = read_perturbation(options.perturbation)
        return run.hits(perturbation)
    if not isinstance(content, Hits):
        raise ValueError(f"export needs a run or ions, {options.file!r} contains a map")
    for name in ("real_units", "lens", "perturbation", "temperature", "jitter"):
        if getattr(options, name) is not None:
            raise ValueError(f"--{name.replace('_', '-')} needs a run (.h5), {options.file!r} contains measured ions")
    return content


def _writing(output, content, options):
    """Options of the writer: an .nxs has the elements of the specimen, a .csv a form of its numbers."""
    from apt_evap.simulation.run import Run

    form = {name: getattr(options, name) for name in ("decimals", "separator") if getattr(options, name) is not None}
    for name in form:
        if output.suffix.lower() != ".csv":
            raise ValueError(f"--{name} is for a .csv file, got {str(output)!r}")
    if output.suffix.lower() != ".nxs":
        if options.elements is not None:
            raise ValueError(f"--elements is for an .nxs file, got {str(output)!r}")
        return form
    if options.elements is not None:
        return {"elements": options.elements.split(",")}
    if not isinstance(content, Run):
        raise ValueError(f"--elements is missing, such as Si,O: NXapm requires the elements for {str(output)!r}")
    return {"elements": content.elements}


def _with_errors(run, options):
    """The run with errors of its times."""
    from dataclasses import replace

    from apt_evap.detection.timing import Timing

    units = run.require_real_units("--temperature or --jitter")
    timing = Timing(jitter=options.jitter or 0.0, temperature=options.temperature)
    return replace(run, units=replace(units, timing=timing))
