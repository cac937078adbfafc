"""Mass spectrum of the ions of a file, by the options of a command."""

import argparse
from typing import Any

from apt_evap.cli._options import add_flight, add_reading

_ALONE = "alone"  # column of the ions of a large file: whether an ion is the only one of its pulse


def add_spectrum(parser: argparse.ArgumentParser) -> None:
    """Add the options of a spectrum."""
    add_reading(parser)
    parser.add_argument(
        "--element",
        metavar="NAME[,NAME]",
        help="elements and ions that are expected, such as W or Cr,CrO; default: all elements are tried",
    )
    parser.add_argument(
        "--isotope",
        action="append",
        metavar="NAME=A:SHARE[,A:SHARE]",
        help="abundances of an enriched element, such as Si=28:0.5,30:0.5; may be repeated",
    )
    add_flight(parser)


def abundances_of(texts: list[str] | None) -> dict[str, dict[int, float]] | None:
    """Abundances by element and mass number of texts such as Si=28:0.5,30:0.5."""
    enriched: dict[str, dict[int, float]] = {}
    for text in texts or ():
        element, equal, shares = text.partition("=")
        try:
            pairs = [part.split(":") for part in shares.split(",")]
            enriched[element] = {int(number): float(share) for number, share in pairs}
        except ValueError:
            equal = ""
        if not equal:
            raise ValueError(f"--isotope must be NAME=A:SHARE[,A:SHARE] such as Si=28:0.5,30:0.5, got {text!r:.80}")
    return enriched or None


def spectrum_of(options: argparse.Namespace, ranges: Any = None, *, pulses: bool = False) -> Any:
    """The spectrum of the ions of FILE that the options select, of all or only of the ions of ranges.

    Ions of a large file have only their masses, and which of them are alone in their pulse, unless all pulses are
    needed.
    """
    from dataclasses import replace

    from apt_evap.cli._files import file_of, read
    from apt_evap.detection.detector_map import DetectorMap
    from apt_evap.detection.hits import Hits
    from apt_evap.spectra.mass_spectrum import spectrum

    if options.mass is not None or options.species is not None:
        raise ValueError("--mass and --species select peaks, of which a spectrum needs all")
    large = None if pulses else _masses_of_large_file(options)
    hits = read(options) if large is None else large
    if not isinstance(hits, Hits):
        found = "a map" if isinstance(hits, DetectorMap) else "a run: apt-evap export --real-units makes ions of it"
        raise ValueError(f"a spectrum needs measured ions, {options.file!r} contains {found}")
    if hits.mass_to_charge is None and hits.time_of_flight is not None and options.distance is None:
        raise ValueError(f"--distance is missing: {options.file!r} has no masses, and times of flight need it [mm]")
    if ranges is not None and options.element is not None:
        raise ValueError("--element and --ranges name the ions: expected one of them, got both")
    elements = None if options.element is None else options.element.split(",")
    flight = {"distance": options.distance, "time_zero": options.time_zero}
    # ranges are not for a selection of ions; flight length and time zero are fitted
    chosen = replace(file_of(options), ranges=None, distance=None)
    ions = chosen.select(hits)
    if ions.mass_to_charge is not None and not (ions.detected & (ions.mass_to_charge > 0)).any():
        raise ValueError(f"a spectrum needs detected ions with a mass-to-charge ratio above 0, got none of {ions!r}")
    return spectrum(ions, elements, ranges, abundances_of(options.isotope), **flight)


def say_losses(options: argparse.Namespace, result: Any) -> None:
    """Say whether losses by dead time move the composition by more than its error."""
    from apt_evap.cli._output import say

    if result.ranged or result.composition.refused:
        return
    if text := result.dead_time_note(result.hits.extra.get(_ALONE)):
        say("note", text)


def _masses_of_large_file(options):
    """Masses of all ions of a large file, 4 bytes each, and which are alone in their pulse; None for another file.

    Also without masses of detected ions. Pulses are not needed for ranges.
    """
    from apt_evap.cli._files import blocks_of

    further = ("x", "y") if options.ranges is not None else ("x", "y", "pulse_id")
    blocks = blocks_of(options, ("mass_to_charge",), further=further, without=("ranges",))
    if blocks is None:
        return None
    hits = blocks.gathered("mass_to_charge", **({_ALONE: ("pulse_id", _alone)} if "pulse_id" in blocks.columns else {}))
    return hits if (hits.detected & (hits.mass_to_charge > 0)).any() else None


def _alone(pulse):
    """Whether each ion of complete pulses is the only one of its pulse."""
    import numpy as np

    same = np.concatenate([[False], pulse[1:] == pulse[:-1], [False]])
    return ~(same[1:] | same[:-1])
