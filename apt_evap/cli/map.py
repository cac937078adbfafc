"""`apt-evap map`: draw detector maps of a run or of measured ions, with the poles of the crystal."""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from apt_evap._common.codec import from_plain
from apt_evap.analysis.apex import image_compression
from apt_evap.analysis.ion_image import GASES, field_ion_image
from apt_evap.cli._files import (
    check_output,
    in_real_units,
    ions_of_map,
    is_picture,
    picture_path,
    read,
    save_picture,
    select,
    selects,
    with_masses,
)
from apt_evap.cli._options import (
    FILE_HELP,
    add_reading,
    add_real_units,
    add_speech,
    integer_type,
    number_type,
    numbers_type,
)
from apt_evap.cli._output import say, tell, tell_json
from apt_evap.config.map_panels import MapSettings, Panel
from apt_evap.config.perturbation_text import read_perturbation
from apt_evap.detection.binning import MAX_BINS, shown_bins
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.detection.projection import Projection
from apt_evap.emission.perturbations import Unperturbed
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.maps.indexing.index_map import index
from apt_evap.maps.indexing.orientation_search import disc_of
from apt_evap.plot.map_figures import binned, default_smoothing, specimen_title
from apt_evap.simulation.run import Run
from apt_evap.simulation.surface import surface_after

_IMAGE_BINS = 512  # along a side of a field-ion image: a spot at R = 7 nm is 3 bins wide


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = "Draw detector maps of a run or of measured ions, or a map."
    parser.epilog = (
        "example:\n"
        "  apt-evap map R5083.epos --bins 128\n"
        "  apt-evap map R5083.epos --ranges R5083.rrng --species Si --voltage 4000, --circle 15 -o silicon.png\n"
        "  apt-evap map ni111.h5 --perturbation Unperturbed --perturbation RollUp:0.3,0.1 -o energies.png\n"
        "  apt-evap map ni111.h5 --field-ion Ne -o image.png\n"
        "  apt-evap map ni111.h5 --poles\n"
        "  apt-evap map R5083.epos --poles W --axis 0,1,1 --distance 90\n\n"
        "a perturbation is NAME, NAME:NUMBERS or a TOML table:\n"
        "  Unperturbed              RollUp:0.2 (eV, all ions)    RollUp:0.155,0.155 (mean, standard deviation)\n"
        "  LateralVelocity:0.3,0.1  Combined:0.155,0.155,0.75 (the last number is the roll-up fraction)\n"
        '  \'{name = "RollUp", energy = {name = "Thermal", temperature = 50}}\''
    )
    parser.add_argument("file", metavar="FILE", help=FILE_HELP)
    add_reading(parser)
    parser.add_argument(
        "-o", "--output", metavar="MAP.png", help=".png, .pdf or .svg; default: FILE_map.png in this folder"
    )
    parser.add_argument(
        "--bins",
        type=integer_type(1, MAX_BINS),
        metavar="N",
        help="bins along the longer side; default: about sqrt(ions)",
    )
    parser.add_argument("--smooth", type=number_type("mm"), metavar="MM", help="sigma of a Gaussian; default: one bin")
    parser.add_argument(
        "--perturbation",
        action="append",
        metavar="P",
        help="perturbation of the ions of a run; repeat it for maps side by side",
    )
    parser.add_argument(
        "--field-ion",
        nargs="?",
        const="Ne",
        choices=GASES,
        metavar="GAS",
        help="field-ion image of the surface at the end of a run, in He, Ne, Ar or H2; default: Ne",
    )
    group = parser.add_argument_group("crystal", "Poles and zone lines over the map.")
    group.add_argument(
        "--poles",
        nargs="?",
        const="",
        metavar="NAME",
        help="draw them, of a run or of a crystal such as W; where they are is searched as by apt-evap index",
    )
    group.add_argument(
        "--axis",
        type=numbers_type,
        metavar="H,K,L",
        help="pole near the centre of the map, or with --rotation the axis",
    )
    group.add_argument("--rotation", type=float, metavar="DEGREES", help="of the crystal about its axis; no search")
    group.add_argument("--scale", type=number_type("mm/rad"), metavar="S", help="scale of the map [mm/rad]")
    group.add_argument("--distance", type=number_type("mm"), metavar="MM", help="flight length of the instrument")
    add_real_units(parser)
    parser.add_argument("--force", action="store_true", help="overwrite a file not made by apt-evap")
    add_speech(parser)


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    picture = picture_path(options.output or f"{Path(options.file).stem}_map.png")
    check_output(picture, is_picture, options.force)
    content = read(options)
    title = crystal = None
    if options.field_ion is not None:
        maps, titles = _field_ion_map(content, options)
    elif isinstance(content, Run):
        content = in_real_units(content, options)
        maps, titles = run_maps(content, _map_settings(content, options), lambda hits: select(hits, options))
        titles = [f"{each}{_species(options)}" for each in titles]
    elif options.perturbation or options.real_units or options.lens:
        what = "a map" if isinstance(content, DetectorMap) else "measured ions"
        name = "--perturbation" if options.perturbation else "--real-units" if options.real_units else "--lens"
        raise ValueError(f"{name} needs a run (.h5), {options.file!r} contains {what}")
    elif isinstance(content, DetectorMap):
        if options.bins is not None:
            raise ValueError(f"--bins is only for ions, {options.file!r} is a map: its bins are {_bins_of(content)}")
        sigma = options.smooth if options.smooth is not None else default_smoothing(content) if content.is_counts else 0
        maps, titles = [content.smoothed(sigma)], [Path(options.file).name]
    else:
        selection = ions_of_map(with_masses(content, options), options)
        part = f", {len(selection):,} of {len(content):,} ions" if selects(options) else ""
        maps = [binned(selection, options.bins, options.smooth)]
        titles = [f"{Path(options.file).name}{_species(options)}{part}"]
        content = selection
    if isinstance(content, Run):
        title = specimen_title(content)
    if options.poles is not None:
        title, crystal = _crystal(content, options, title)
    elif options.axis or options.rotation is not None or options.scale is not None:
        raise ValueError("--axis, --rotation and --scale are for --poles")
    save_picture(picture, maps, titles, title, crystal)
    tell(options, f"wrote {picture}")
    tell_json(options, {"wrote": str(picture), "file": options.file, "maps": summaries(maps, titles)})
    return 0


def _crystal(content, options, title):
    """Title of the picture, and the orientation of the crystal and its projection: of a run, as given, or indexed."""
    axis, rotation, scale = options.axis, options.rotation, options.scale
    if isinstance(content, Run):
        if options.poles or axis or rotation is not None:
            raise ValueError(f"--poles of a run needs no element, axis or rotation: {options.file!r} has its own")
        projection = image_compression(content).projection if scale is None else Projection(scale)
        return title, (Orientation.from_settings(content.settings["tip"]), projection)
    if not options.poles:
        raise ValueError("--poles needs the crystal of a measured map, such as --poles W")
    counts = content if isinstance(content, DetectorMap) else content.map(bins=128)
    centre = disc_of(counts).centre
    if rotation is not None:
        if not axis or scale is None:
            raise ValueError("--rotation needs --axis and --scale [mm/rad]; without it, it is searched")
        orientation, projection = Orientation(options.poles, axis, rotation), Projection(scale, centre)
        how = "as given"
    else:
        if any(each != round(each) for each in axis or ()):
            raise ValueError(f"--axis without --rotation must be the indices of a pole, got {options.axis}")
        found = index(
            counts,
            options.poles,
            scales=None if scale is None else (scale, scale),
            distance=options.distance if scale is None else None,
            poles=[(*centre, tuple(int(each) for each in axis))] if axis else (),
        )
        tell(options, f"{found}")
        if not found.decided:
            say("warning", f"the map does not decide, the poles are those of the first candidate: {found.reason}")
        orientation, projection, how = found.best.orientation, found.best.projection, found.verdict
    along = " ".join(f"{each:.2f}" for each in orientation.axis)
    return f"{orientation.material.name}, axis [{along}], {projection.scale:.1f} mm/rad, {how}", (
        orientation,
        projection,
    )


def _field_ion_map(content, options):
    """Field-ion image of the surface at the end of a run, and its title."""
    if not isinstance(content, Run):
        raise ValueError(f"--field-ion needs a run (.h5), got {options.file!r}")
    for name in ("perturbation", "real_units", "lens"):
        if getattr(options, name) is not None:
            raise ValueError(f"--field-ion and --{name.replace('_', '-')} exclude each other")
    if selects(options):
        raise ValueError("--field-ion shows a surface: it excludes a selection of ions")
    image = field_ion_image(surface_after(content), options.field_ion, detector=content.detector)
    tell(options, f"{image!r}")
    map = image.map(options.bins or _IMAGE_BINS)
    return [map if options.smooth is None else map.smoothed(options.smooth)], [f"field-ion image, {options.field_ion}"]


def _species(options):
    """Selected species as part of a title."""
    return "" if options.species is None else f", {options.species.replace(',', ' and ')}"


def summaries(maps: Any, titles: Sequence[str]) -> list[dict[str, Any]]:
    """Summary of each map of a picture in plain types: title, number of ions if known, bins, and smoothing [mm]."""
    return [
        {"title": title, "ions": each.ions, "bins": list(each.values.shape[::-1]), "smoothing": each.smoothing}
        for each, title in zip(maps, titles, strict=True)
    ]


def _map_settings(run, options):
    """Settings of the maps of a run: from the options, else those of the run, else the defaults."""
    stored = run.provenance.get("maps", {})
    if options.perturbation:
        stored = {name: value for name, value in stored.items() if name != "panels"}
    try:
        settings = from_plain(stored, MapSettings, what="maps")
    except ValueError as error:  # of a class of the user's own
        raise ValueError(f"the maps of {options.file!r} are not drawn again: {error}; use --perturbation") from error
    if options.perturbation:
        panels = tuple(Panel(read_perturbation(text)) for text in options.perturbation)
        settings = replace(settings, panels=panels)
    elif "maps" not in run.provenance and run.responses is None:
        perturbations = tuple(perturbation for perturbation in run.perturbations if not isinstance(perturbation, dict))
        settings = MapSettings(tuple(map(Panel, perturbations or (Unperturbed(),))))
    if options.bins is not None:
        # the smoothing of the settings is for other bins
        settings = replace(settings, bins=options.bins, smoothing=None)
    if options.smooth is not None:
        settings = replace(settings, smoothing=options.smooth)
    settings.check_detector(run.detector)
    return settings


def run_maps(
    run: Run, settings: MapSettings, choose: Callable[[Hits], Hits] = lambda hits: hits
) -> tuple[list[DetectorMap], list[str]]:
    """Maps of the complete detector, for all ions or a selection, and their titles."""
    grid = run.grid(settings.bins or shown_bins(len(run)))
    maps = [choose(run.hits(panel.perturbation)).map(like=grid, position_step=None) for panel in settings.panels]
    sigma = settings.smoothing
    if sigma is None:
        sigma = default_smoothing(grid, None if settings.bins else len(run))
    return [each.smoothed(sigma) for each in maps], [panel.title for panel in settings.panels]


def _bins_of(detector_map):
    return " x ".join(map(str, detector_map.values.shape[::-1]))
