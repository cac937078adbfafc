"""`apt-evap map`: draw detector maps of a run or of measured ions."""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from apt_evap._common.codec import from_plain
from apt_evap.analysis.ion_image import field_ion_image
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
)
from apt_evap.cli._output import tell, tell_json
from apt_evap.config.map_panels import MapSettings, Panel
from apt_evap.config.perturbation_text import read_perturbation
from apt_evap.detection.binning import bins_for
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.emission.perturbations import Unperturbed
from apt_evap.simulation.run import Run
from apt_evap.simulation.surface import surface_after

_IMAGE_BINS = 512  # along a side of a field-ion image: a spot at R = 7 nm is 3 bins wide


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    picture = picture_path(options.output or f"{Path(options.file).stem}_map.png")
    check_output(picture, is_picture, options.force)
    content = read(options)
    if options.field_ion is not None:
        maps = _field_ion_map(content, options)
    elif isinstance(content, Run):
        content = in_real_units(content, options)
        drawn, titles = run_maps(content, _map_settings(content, options), lambda hits: select(hits, options))
        maps = drawn, [f"{title}{_species(options)}" for title in titles]
    elif options.perturbation or options.real_units or options.lens:
        what = "a map" if isinstance(content, DetectorMap) else "measured ions"
        name = "--perturbation" if options.perturbation else "--real-units" if options.real_units else "--lens"
        raise ValueError(f"{name} needs a run (.h5), {options.file!r} contains {what}")
    elif isinstance(content, DetectorMap):
        if options.bins is not None:
            raise ValueError(f"--bins is only for ions, {options.file!r} is a map: its bins are {_bins_of(content)}")
        sigma = 0.0 if options.smooth is None and not content.is_counts else options.smooth
        maps = [_smooth(content, sigma)], [Path(options.file).name]
    else:
        selection = ions_of_map(content, options)
        map = selection.map(options.bins or bins_for(int(selection.detected.sum())))
        part = f", {len(selection):,} of {len(content):,} ions" if selects(options) else ""
        maps = [_smooth(map, options.smooth)], [f"{Path(options.file).name}{_species(options)}{part}"]
    save_picture(picture, *maps)
    tell(options, f"wrote {picture}")
    tell_json(options, {"wrote": str(picture), "file": options.file, "maps": summaries(*maps)})
    return 0


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
    settings = from_plain(run.provenance.get("maps", {}), MapSettings, what="maps")
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
    grid = run.grid(settings.bins or bins_for(len(run)))
    maps = [choose(run.hits(panel.perturbation)).map(like=grid, position_step=None) for panel in settings.panels]
    return [_smooth(each, settings.smoothing) for each in maps], [panel.title for panel in settings.panels]


def _bins_of(detector_map):
    return " x ".join(map(str, detector_map.values.shape[::-1]))


def _smooth(detector_map, sigma):
    return detector_map.smoothed(max(detector_map.bin_size) if sigma is None else sigma)
