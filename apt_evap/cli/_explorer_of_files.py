"""Explorer of the files of `apt-evap explore`, by its options, and the same as text."""

import argparse
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from apt_evap._common.codec import declared, to_python
from apt_evap._common.recorded_warnings import recorded_warnings
from apt_evap.cli._files import file_of, in_real_units, lens_of, read, read_registration
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.explore.controls import values_of
from apt_evap.explore.explorer import Explorer, ExplorerSettings
from apt_evap.explore.measured_ions import MeasuredIons
from apt_evap.fit.measured_map import measured_map
from apt_evap.fit.start_settings import is_start, registration_start_of
from apt_evap.io.measured_file import MeasuredFile
from apt_evap.simulation.config.material_text import read_material
from apt_evap.simulation.config.perturbation_text import read_perturbation
from apt_evap.simulation.config.simulation_file import read_config
from apt_evap.simulation.read_file import read as read_file
from apt_evap.simulation.run import Run, load
from apt_evap.specimen.materials import MATERIALS
from apt_evap.warnings import DataWarning


def with_file(options: argparse.Namespace, path: str | None) -> tuple[Explorer | None, ExplorerSettings | None]:
    """Explorer and view with one more file: a run replaces the run, anything else the measurement; None closes both."""
    changes: dict[str, Any] = {"registration": None, "simulated": None}
    if path is None:
        changes |= {"run": None, "file": None}
    elif _run_in(path) is not None:
        changes["run"] = path
    else:
        changes |= dict.fromkeys((*declared(MeasuredFile), "element"))
        changes |= {"file": path, "time_zero": 0.0, "all_ions": False}
    fresh = argparse.Namespace(**(vars(options) | changes))
    explorer_of_files = explorer_and_view(fresh)
    vars(options).update(vars(fresh))  # only if both files are good
    return explorer_of_files


def _run_in(path):
    """The run of a file, None if it contains something else."""
    if path.endswith(".unfinished"):
        return load(path)
    content = read_file(path) if path.lower().endswith(".h5") else None
    return content if isinstance(content, Run) else None


def explorer_and_view(options: argparse.Namespace) -> tuple[Explorer | None, ExplorerSettings | None]:
    """Explorer of the files of the command, and the view of its options; None without a file.

    Warnings of the files are also notes of the explorer.
    """
    with warnings.catch_warnings(), recorded_warnings() as messages:
        warnings.simplefilter("always", DataWarning)  # also of a file that is opened again
        explorer, view = _explorer_and_view(options)
    if explorer is not None:
        explorer.notes = tuple(dict.fromkeys(map(str, messages)))
    return explorer, view


def _explorer_and_view(options):
    run = None if options.run is None else _run_in(options.run)
    if options.run is not None and run is None:
        if options.file is not None:
            raise ValueError(f"RUN must be a run, {options.run!r} contains something else")
        options.run, options.file = None, options.run
    if run is not None:
        run = in_real_units(run, options)
    measured = None if options.file is None else _measured(options)
    registration = None
    if options.registration is not None:
        if measured is None or run is None:
            raise ValueError("--registration needs RUN and MEASURED")
        registration = read_registration(options.registration)
    perturbation = None if options.perturbation is None else read_perturbation(options.perturbation)
    if perturbation is not None:
        values_of(perturbation)
    if run is None and measured is None:
        return None, None
    explorer = Explorer(
        run,
        measured,
        registration,
        run_code="None" if run is None else _run_code(options),
        run_arguments=[] if run is None else _run_arguments(options),
        file=None if options.file is None else file_of(options),
    )
    if options.element is not None and (name := read_material(options.element, "--element").name) in MATERIALS:
        explorer.crystal = name
    if explorer.is_comparison:
        explorer.search.options = _place(options.run, explorer.measured)
    start = explorer.start
    bins = options.bins or start.bins
    view = ExplorerSettings(
        perturbation=perturbation or _recommended(options.run) or start.perturbation,
        bins=bins,
        smoothing=explorer.smoothing_for(bins) if options.smooth is None else options.smooth,
        flattening=options.flatten or 0.0,
        ions=_ions(options, explorer),
    )
    return explorer, view


def _settings_beside(path):
    """Settings of a run that were made from a measured map and lie beside it; None without them."""
    settings = None if path is None else Path(path).with_suffix(".toml")
    try:
        return settings if settings is not None and settings.is_file() and is_start(settings) else None
    except (ValueError, OSError):
        return None


def _recommended(path):
    """Emission of the settings of a run that were made from a measured map; None without them."""
    try:
        if (settings := _settings_beside(path)) is None:
            return None
        for panel in read_config(settings).maps.panels:
            mechanism, _ = values_of(panel.perturbation)
            if mechanism != "unperturbed":
                return panel.perturbation
    except (ValueError, OSError):  # changed by hand: the run is shown without it
        return None


def _place(path, measured):
    """Where the run lies on the measurement that its settings were made from, for `register`; {} if it is not known."""
    try:
        if (settings := _settings_beside(path)) is not None:
            return registration_start_of(settings, measured_map(measured))
    except (ValueError, OSError, IndexError):  # changed by hand
        pass
    return {}


def _ions(options, explorer):
    """First and last ion of `--simulated` within those of the run, None for all."""
    if options.simulated is None or explorer.run is None:
        return None
    every = explorer.first_and_last
    first, last = (end if bound is None else int(bound) for bound, end in zip(options.simulated, every, strict=True))
    first, last = max(first, every[0]), min(last, every[1])
    if first >= last:
        raise ValueError(f"--simulated selects none of the ions {every[0]} to {every[1]} of {options.run!r}")
    return first, last


def _measured(options):
    """Measured ions with their selection, or the map."""
    content = read(options)
    if isinstance(content, Run):
        raise ValueError(f"MEASURED must be measured ions or a map, {options.file!r} is a run")
    if isinstance(content, DetectorMap):
        return content
    hits = content if content.ion is not None else replace(content, ion=np.arange(len(content)))
    return MeasuredIons(hits, file=file_of(options))


# ---- the same in text ----------------------------------------------------------------------------------------------


def _run_arguments(options):
    """Arguments that name RUN and its units."""
    arguments = [options.run]
    if options.lens is not None:
        arguments.append(f"--lens={options.lens}")
    if options.real_units is not None:
        arguments.append(f"--real-units={options.real_units}")
    return arguments


def _run_code(options):
    """Python expression that reads RUN."""
    arguments = [] if options.lens is None else [to_python(lens_of(options))]
    if options.real_units is not None:
        arguments.append(f"field_reference={options.real_units!r}")
    return f"ae.load({options.run!r})" + (f".at_evaporation_field({', '.join(arguments)})" if arguments else "")
