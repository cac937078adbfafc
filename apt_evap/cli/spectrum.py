"""`apt-evap spectrum`: the mass spectrum of measured ions, its peaks, and ranges of mass."""

import argparse
from pathlib import Path

from apt_evap.cli._options import add_flight, add_reading, add_speech
from apt_evap.cli._output import tell, tell_json

_BIN = 0.05  # of the picture [Da]: narrower ones would be less than a pixel


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Draw the mass spectrum of measured ions with its background, and name its peaks: of the elements\n"
        "that are given, or of the most probable ones. Flight length and time zero are fitted to the peaks if\n"
        "the file has times of flight and no masses. With --ranges, the ranges of a file are drawn over it."
    )
    parser.epilog = (
        "example:\n"
        "  apt-evap spectrum R5083.epos\n"
        "  apt-evap spectrum R5083.epos --element Cr,CrO,Si --save R5083.rrng\n"
        "  apt-evap spectrum R5083.epos --ranges R5083.rrng\n"
        "  apt-evap spectrum W_tap.raw --element W --distance 305"
    )
    parser.add_argument("file", metavar="FILE", help="measured ions (.epos, .pos, .raw, ...)")
    add_reading(parser)
    parser.add_argument(
        "--element",
        metavar="NAME[,NAME]",
        help="ions to name, such as W or Cr,CrO; default: the most probable of 27 elements and six molecules",
    )
    add_flight(parser)
    parser.add_argument("--save", metavar="FILE.rrng", help="save the ranges of the named peaks")
    parser.add_argument(
        "-o", "--output", metavar="PICTURE.png", help=".png, .pdf or .svg; default: FILE_spectrum.png in this folder"
    )
    parser.add_argument("--force", action="store_true", help="overwrite FILE.rrng, and a picture not made by apt-evap")
    add_speech(parser)


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    from dataclasses import replace

    from apt_evap import plot
    from apt_evap._common.files import FileError, check_path
    from apt_evap.cli._files import file_of, read
    from apt_evap.detection.hits import Hits
    from apt_evap.io.formats import read_ranges
    from apt_evap.io.rrng import write_rrng
    from apt_evap.spectra.mass_spectrum import spectrum
    from apt_evap.workflows.written_pictures import check_output, is_picture, picture_path, save_figure

    picture = picture_path(options.output or f"{Path(options.file).stem}_spectrum.png")
    check_output(picture, is_picture, options.force)
    saved = None if options.save is None else check_path(options.save)
    if saved is not None and saved.suffix.lower() != ".rrng":
        raise ValueError(f"--save must be a file .rrng, got {options.save!r:.80}")
    if saved is not None:
        if saved.exists() and not options.force:
            raise FileError(f"{str(saved)!r} exists: --force overwrites it")
        check_output(saved, lambda path: True, options.force)
    if options.mass is not None or options.species is not None:
        raise ValueError("--mass and --species select peaks, of which a spectrum needs all")
    ranges = None if options.ranges is None else read_ranges(options.ranges)
    hits = read(options)
    if not isinstance(hits, Hits):
        raise ValueError(f"a spectrum needs measured ions, {options.file!r} contains something else")
    if hits.mass_to_charge is None and hits.time_of_flight is not None and options.distance is None:
        raise ValueError(f"--distance is missing: {options.file!r} has no masses, and times of flight need it [mm]")
    elements = None if options.element is None else options.element.split(",")
    # ranges are drawn, no selection of ions; flight length and time zero are fitted
    selection = replace(file_of(options), ranges=None, distance=None).select(hits)
    result = spectrum(selection, elements, distance=options.distance, time_zero=options.time_zero)
    tell(options, f"{result}")
    if result.flight is not None and result.flight.peaks:
        fit = result.flight
        tell(options, f"for other commands: --distance {fit.distance:.2f} --t0 {fit.time_zero:.2f}")
    counts = {} if ranges is None else {name: len(ranges.select(result.hits, name)) for name in ranges.species_names}
    for name, number in counts.items():
        tell(options, f"{name}: {number:,} ions in its ranges")
    if saved is not None:
        write_rrng(saved, result.ranges)
        tell(options, f"wrote {saved}")
    save_figure(picture, plot.spectrum(result, bin_width=_BIN, ranges=ranges).figure)
    tell(options, f"wrote {picture}")
    summary = {"wrote": str(picture), "file": options.file, "ranges": None if saved is None else str(saved)}
    names = ("name", "ions", "background", "fill", "intervals")
    peaks = [{name: getattr(peak, name) for name in names} for peak in result.peaks]
    tell_json(options, summary | {"peaks": peaks} | ({} if ranges is None else {"ions_in_ranges": counts}))
    return 0
