"""Maps that `apt-evap map` draws, by its options."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from apt_evap.cli._files import blocks_of, file_of, in_real_units, note, read
from apt_evap.cli._output import say, tell
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.projection import Projection
from apt_evap.plot.map_figures import binned, binned_blocks, default_smoothing, specimen_title
from apt_evap.simulation.config.perturbation_text import read_perturbation
from apt_evap.simulation.run import Run
from apt_evap.workflows.maps_of_run import phase_maps, run_maps, settings_of_maps

_IMAGE_BINS = 512  # along a side of a field-ion image: a spot at R = 7 nm is 3 bins wide


def maps_of_file(
    options: argparse.Namespace,
) -> tuple[list[DetectorMap], list[str], str | None, Any, list[dict[str, DetectorMap]]]:
    """Maps of the file of a command, their titles, title and crystal of their picture, and maps of phases of a run."""
    if (ready := _map_of_large_file(options)) is not None:
        return [ready], [Path(options.file).name], None, None, []
    content = read(options)
    title = crystal = None
    phases: list[dict[str, DetectorMap]] = []
    if options.field_ion is not None:
        maps, titles = _field_ion_map(content, options)
    elif isinstance(content, Run):
        content = in_real_units(content, options)
        settings, choose = _map_settings(content, options), file_of(options).of_run().select
        maps, titles = run_maps(content, settings, choose)
        phases = phase_maps(content, maps, settings, choose)
        titles = [f"{name}{_species(options)}" for name in titles]
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
        selection = file_of(options).ions_of_map(content, note)
        part = ""
        if len(selection) < len(content):
            chosen, every = (int(np.count_nonzero(ions.detected)) for ions in (selection, content))  # without strays
            part = f", {chosen:,} of {every:,} ions"
        maps = [binned(selection, options.bins, options.smooth)]
        titles = [f"{Path(options.file).name}{_species(options)}{part}"]
        content = selection
    if isinstance(content, Run):
        title = specimen_title(content)
    if options.poles is not None:
        title, crystal = _crystal(content, options, title)
    elif options.axis or options.rotation is not None or options.scale is not None:
        raise ValueError("--axis, --rotation and --scale are for --poles")
    return maps, titles, title, crystal, phases


def _map_of_large_file(options):
    """Map of all ions of a large file, read block by block; None where more is asked for, or the ions make no map."""
    others = (options.field_ion, options.perturbation, options.real_units, options.lens, options.poles, options.axis)
    if any(others) or options.poles is not None or options.rotation is not None or options.scale is not None:
        return None
    blocks = blocks_of(options, ("x", "y"))
    if blocks is None or not blocks.field.ions or max(blocks.field.size) == 0:
        return None
    return binned_blocks(blocks, options.bins, options.smooth)


def _crystal(content, options, title):
    """Title of the picture, and the orientation of the crystal and its projection: of a run, as given, or indexed."""
    from apt_evap.maps.crystallography.orientation import Orientation
    from apt_evap.maps.indexing.index_map import index
    from apt_evap.maps.indexing.orientation_search import disc_of
    from apt_evap.simulation.apex import image_compression
    from apt_evap.simulation.config.material_text import read_material

    axis, rotation, scale = options.axis, options.rotation, options.scale
    if isinstance(content, Run):
        if options.poles or axis or rotation is not None:
            raise ValueError(f"--poles of a run needs no element, axis or rotation: {options.file!r} has its own")
        projection = image_compression(content).projection if scale is None else Projection(scale)
        return title, (Orientation.from_settings(content.settings["tip"]), projection)
    if not options.poles:
        raise ValueError("--poles needs the crystal of a measured map, such as --poles W")
    material = read_material(options.poles, "--poles")
    counts = content if isinstance(content, DetectorMap) else content.map(bins=128)
    centre = disc_of(counts).centre
    if rotation is not None:
        if not axis or scale is None:
            raise ValueError("--rotation needs --axis and --scale [mm/rad]; without it, it is searched")
        orientation, projection = Orientation(material, axis, rotation), Projection(scale, centre)
        how = "as given"
    else:
        if any(component != round(component) for component in axis or ()):
            raise ValueError(f"--axis without --rotation must be the indices of a pole, got {options.axis}")
        indexing = index(
            counts,
            material,
            scales=None if scale is None else (scale, scale),
            distance=options.distance if scale is None else None,
            poles=[(*centre, tuple(map(int, axis)))] if axis else (),
        )
        tell(options, f"{indexing}")
        if not indexing.decided:
            say("warning", f"the map does not decide, the poles are those of the first candidate: {indexing.reason}")
        orientation, projection, how = indexing.best.orientation, indexing.best.projection, indexing.verdict
    along = " ".join(f"{component:.2f}" for component in orientation.axis)
    return f"{orientation.material.name}, axis [{along}], {projection.scale:.1f} mm/rad, {how}", (
        orientation,
        projection,
    )


def _field_ion_map(content, options):
    """Field-ion image of the surface at the end of a run, and its title."""
    from apt_evap.simulation.ion_image import field_ion_image
    from apt_evap.simulation.surface import surface_after

    if not isinstance(content, Run):
        raise ValueError(f"--field-ion needs a run (.h5), got {options.file!r}")
    for name in ("perturbation", "real_units", "lens"):
        if getattr(options, name) is not None:
            raise ValueError(f"--field-ion and --{name.replace('_', '-')} exclude each other")
    if file_of(options).selects:
        raise ValueError("--field-ion shows a surface: it excludes a selection of ions")
    image = field_ion_image(surface_after(content), options.field_ion, detector=content.detector)
    tell(options, f"{image!r}")
    map = image.map(options.bins or _IMAGE_BINS)
    return [map if options.smooth is None else map.smoothed(options.smooth)], [f"field-ion image, {options.field_ion}"]


def _species(options):
    """Selected species as part of a title."""
    return "" if options.species is None else f", {options.species.replace(',', ' and ')}"


def _map_settings(run, options):
    """Settings of the maps of a run: from the options, else those of the run, else the defaults."""
    perturbations = [read_perturbation(text) for text in options.perturbation or ()]
    try:
        settings = settings_of_maps(run, perturbations)
    except ValueError as error:  # of a class of the user's own
        raise ValueError(f"the maps of {options.file!r} are not drawn again: {error}; use --perturbation") from error
    if options.bins is not None:
        # the smoothing of the settings is for other bins
        settings = replace(settings, bins=options.bins, smoothing=None)
    if options.smooth is not None:
        settings = replace(settings, smoothing=options.smooth)
    settings.check_detector(run.detector)
    return settings


def _bins_of(detector_map):
    return " x ".join(map(str, detector_map.values.shape[::-1]))
