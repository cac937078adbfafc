"""Detector maps of a run by its settings, and which crystal direction is where on a map."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from apt_evap._common.codec import from_plain
from apt_evap.detection.binning import shown_bins
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.emission.perturbations import Perturbation, Unperturbed
from apt_evap.simulation.config.map_panels import MapSettings, Panel
from apt_evap.simulation.run import Run

_FEWEST = 20  # ions of a phase whose place is drawn


def settings_of_maps(run: Run, perturbations: Sequence[Perturbation] = ()) -> MapSettings:
    """Settings of the maps of a run."""
    stored = run.provenance.get("maps", {})
    if perturbations:
        panels = tuple(map(Panel, perturbations))
        stored = {name: value for name, value in stored.items() if name != "panels"}
        return replace(from_plain(stored, MapSettings, what="maps"), panels=panels)
    if "maps" not in run.provenance and run.responses is None:
        known = tuple(perturbation for perturbation in run.perturbations if not isinstance(perturbation, dict))
        return MapSettings(tuple(map(Panel, known or (Unperturbed(),))))
    return from_plain(stored, MapSettings, what="maps")


def run_maps(
    run: Run, settings: MapSettings, choose: Callable[[Hits], Hits] = lambda hits: hits
) -> tuple[list[DetectorMap], list[str]]:
    """Maps of the complete detector, for all ions or a selection, and their titles."""
    from apt_evap.plot.map_figures import default_smoothing  # with Matplotlib

    grid = run.grid(settings.bins or shown_bins(len(run)))
    maps = [choose(run.hits(panel.perturbation)).map(like=grid, position_step=None) for panel in settings.panels]
    sigma = settings.smoothing
    if sigma is None:
        sigma = default_smoothing(grid, None if settings.bins else len(run))
    return [detector_map.smoothed(sigma) for detector_map in maps], [panel.title for panel in settings.panels]


def phase_maps(
    run: Run, maps: Sequence[DetectorMap], settings: MapSettings, choose: Callable[[Hits], Hits] = lambda hits: hits
) -> list[dict[str, DetectorMap]]:
    """Maps of the ions of each further phase of a specimen, by its name, for each of the maps of `run_maps`."""
    phases: list[dict[str, DetectorMap]] = []
    for panel, like in zip(settings.panels if len(run.phase_names) > 1 else (), maps, strict=False):
        hits = choose(run.hits(panel.perturbation))
        parts = {name: hits[hits.extra["phase_name"] == name] for name in run.phase_names[1:]}
        phases.append(
            {
                name: part.map(like=like, position_step=None).smoothed(like.smoothing)
                for name, part in parts.items()
                if np.count_nonzero(part.detected) >= _FEWEST
            }
        )
    return phases


def map_summaries(maps: Any, titles: Sequence[str]) -> list[dict[str, Any]]:
    """Summary of each map of a picture in plain types: title, number of ions if known, bins, and smoothing [mm]."""
    return [
        {
            "title": title,
            "ions": detector_map.ions,
            "bins": list(detector_map.values.shape[::-1]),
            "smoothing": detector_map.smoothing,
        }
        for detector_map, title in zip(maps, titles, strict=True)
    ]
