"""`apt-evap spectrum`: the mass spectrum of measured ions, its peaks, and ranges of mass."""

import argparse
from pathlib import Path

from apt_evap.cli._options import add_speech
from apt_evap.cli._output import tell, tell_json
from apt_evap.cli._spectrum_of_file import add_spectrum, say_losses, spectrum_of

_BIN = 0.05  # of the picture [Da]: narrower ones would be less than a pixel


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Draw the mass spectrum of measured ions with its background, name its peaks, of all elements or of those\n"
        "that are given, and print the composition. Flight length and time zero are fitted to the peaks if the\n"
        "file has times of flight and no masses. With --ranges, the ranges of a file are drawn, and only their\n"
        "ions are counted."
    )
    parser.epilog = (
        "example:\n"
        "  apt-evap spectrum R5083.epos\n"
        "  apt-evap spectrum R5083.epos --element Cr,CrO,Si --save R5083.rrng\n"
        "  apt-evap spectrum R5083.epos --correlation pairs.png\n"
        "  apt-evap spectrum R5083.epos --ranges R5083.rrng\n"
        "  apt-evap spectrum W_tap.raw --element W --distance 305"
    )
    parser.add_argument("file", metavar="FILE", help="measured ions (.epos, .pos, .raw, ...)")
    add_spectrum(parser)
    parser.add_argument("--save", metavar="FILE.rrng", help="save the ranges of the named peaks")
    parser.add_argument(
        "-o", "--output", metavar="PICTURE.png", help=".png, .pdf or .svg; default: FILE_spectrum.png in this folder"
    )
    parser.add_argument(
        "--correlation", metavar="PICTURE.png", help="draw the pairs of ions of one pulse, and print the multiple hits"
    )
    parser.add_argument("--force", action="store_true", help="overwrite FILE.rrng, and a picture not made by apt-evap")
    add_speech(parser)


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    from apt_evap import plot
    from apt_evap._common.files import FileError, check_path
    from apt_evap.io.formats import read_ranges
    from apt_evap.io.rrng import write_rrng
    from apt_evap.workflows.written_pictures import check_output, is_picture, picture_path, save_figure

    picture = picture_path(options.output or f"{Path(options.file).stem}_spectrum.png")
    check_output(picture, is_picture, options.force)
    pairs = None if options.correlation is None else picture_path(options.correlation)
    if pairs is not None:
        check_output(pairs, is_picture, options.force)
    saved = None if options.save is None else check_path(options.save)
    if saved is not None and saved.suffix.lower() != ".rrng":
        raise ValueError(f"--save must be a file .rrng, got {options.save!r:.80}")
    if saved is not None:
        if saved.exists() and not options.force:
            raise FileError(f"{str(saved)!r} exists: --force overwrites it")
        check_output(saved, lambda path: True, options.force)
    ranges = None if options.ranges is None else read_ranges(options.ranges)
    result = spectrum_of(options, ranges, pulses=pairs is not None)
    tell(options, f"{result}")
    say_losses(options, result)
    if result.flight is not None and result.flight.peaks:
        fit = result.flight
        tell(options, f"for other commands: --distance {fit.distance:.2f} --t0 {fit.time_zero:.2f}")
    counts = {} if ranges is None else {name: len(ranges.select(result.hits, name)) for name in ranges.species_names}
    for name, number in counts.items():
        tell(options, f"{name}: {number:,} ions in its ranges")
    if saved is not None:
        write_rrng(saved, result.ranges())
        tell(options, f"wrote {saved}")
    save_figure(picture, plot.spectrum(result, bin_width=_BIN, ranges=ranges).figure)
    tell(options, f"wrote {picture}")
    if pairs is not None:
        correlation = result.hits.correlation()
        tell(options, f"{correlation}")
        save_figure(pairs, plot.correlation(correlation, result).figure)
        tell(options, f"wrote {pairs}")
    summary = {"wrote": str(picture), "file": options.file, "ranges": None if saved is None else str(saved)}
    names = ("name", "formula", "charge", "ions", "error", "intervals", "others")
    ions = [{name: getattr(ion, name) for name in names} for ion in result.ions]
    summary |= {"ions": ions, "unexplained_peaks": [[peak.mass, peak.ions] for peak in result.unexplained]}
    summary |= result.composition.plain()
    tell_json(options, summary | ({} if ranges is None else {"ions_in_ranges": counts}))
    return 0
