"""Files of the commands: reading by the options, and selection of ions."""

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from apt_evap._common.codec import from_plain
from apt_evap._common.files import FileError, read_small_file, sha256_of
from apt_evap._common.validation import did_you_mean
from apt_evap.cli._output import say
from apt_evap.config.lens_text import read_lens
from apt_evap.config.material_text import read_material
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.detection.microscope.local_electrode import LocalElectrode
from apt_evap.io.distortion_grid import read_grid
from apt_evap.io.formats import read_ranges
from apt_evap.maps.registration.register import Registration
from apt_evap.simulation.read_file import read as read_file
from apt_evap.simulation.run import Run, load
from apt_evap.specimen.isotopes import ISOTOPES
from apt_evap.spectra.mass_spectrum import spectrum
from apt_evap.workflows.compare_maps import MAX_STUDY
from apt_evap.workflows.measured_source import MeasuredSource
from apt_evap.workflows.twin_of_map import path_word


def read(options: argparse.Namespace) -> Hits | Run | DetectorMap:
    """Read the FILE of a command, and remove its distortion if the options have a calibration grid."""
    content = _read(options)
    if options.undistort is None:
        return content
    if not isinstance(content, Hits):
        what = "a run" if isinstance(content, Run) else "a map"
        raise ValueError(f"--undistort is only for measured ions, {options.file!r} contains {what}")
    check_columns(content, options)
    return content.undistorted(read_grid(options.undistort))


def _read(options):
    parameters = {name: getattr(options, name) for name in ("partial", "byte_order", "voltage_unit")}
    if options.arrays is not None:
        names = options.arrays.split(",")
        if len(names) not in (3, 4):
            expected = "values, edges in x and y, and perhaps a mask"
            raise ValueError(f"--arrays must name {expected}, got {options.arrays!r:.80}")
        parameters |= dict(zip(("values", "x_edges", "y_edges", "mask"), names, strict=False))
    path = Path(options.file)
    is_map = (options.format or path.suffix).lower().lstrip(".") == "npz"
    parameters["unit" if is_map else "detector_unit"] = options.unit
    for name in (*_SELECTING, "voltage_unit") if is_map else ("arrays",):
        if getattr(options, name) is not None:
            what = "ions" if is_map else "a map in an .npz file"
            raise ValueError(f"--{name.replace('_', '-')} is for {what}, got {options.file!r}")
    if path.suffix == ".unfinished":
        return load(path)
    try:
        parameters = {key: value for key, value in parameters.items() if value is not None}
        return read_file(options.file, format=options.format, **parameters)
    except FileError as error:
        unfinished = Path(f"{path}.unfinished")
        if unfinished.exists() and not path.exists():
            raise FileError(f"{error}; an unfinished run is in {str(unfinished)!r}") from error
        raise


def in_real_units(run: Run, options: argparse.Namespace) -> Run:
    """The run, in real units with one of --real-units and --lens; a run that already is keeps its own."""
    lens, reference = lens_of(options), options.real_units
    if lens is None and reference in (None, run.observation.operating.field_reference):
        return run
    return run.at_evaporation_field(lens, **({} if reference is None else {"field_reference": reference}))


def lens_of(options: argparse.Namespace) -> LocalElectrode | None:
    """The lens of the options."""
    return None if options.lens is None else read_lens(options.lens)


_SELECTING = ("ions", "mass", "voltage", "circle", "box", "ranges", "species")


def selects(options: argparse.Namespace) -> bool:
    """Whether the options select ions."""
    return any(getattr(options, name) is not None for name in _SELECTING)


def select(hits: Hits, options: argparse.Namespace) -> Hits:
    """Select ions by the options; ValueError if a column is missing, or no ion remains."""
    if options.species is None and options.ranges is not None:
        raise ValueError(f"--species is missing: names of species in {options.ranges!r}")
    if options.species is not None and options.ranges is None and "element" not in hits.extra:
        raise ValueError(
            "--species needs --ranges, a file of ranges of mass: only the ions of a run have known elements"
        )
    steps: dict[str, Callable[[Hits, Any], Hits]] = {
        "ions": lambda hits, bounds: hits.window(ion=bounds),  # first: numbers of the ions in the file
        "mass": lambda hits, bounds: hits.window(mass_to_charge=bounds),
        "voltage": lambda hits, bounds: hits.window(voltage=bounds),
        "circle": lambda hits, circle: hits.within_circle(*circle),
        "box": lambda hits, box: hits.window(x=box[:2], y=box[2:]),
        "species": lambda hits, names: _of_species(hits, names.split(","), options.ranges),
    }
    selection = hits
    for name, step in steps.items():
        if (value := getattr(options, name)) is not None:
            try:
                selection = step(selection, value)
            except ValueError as error:
                raise ValueError(f"--{name}: {error}") from error
    if selects(options) and len(selection) == 0:
        raise ValueError(f"the options select none of the {len(hits):,} ions of {options.file!r}")
    return selection


def _of_species(hits, names, ranges):
    """Ions of these species: by a file of ranges, or by the elements that simulated ions know."""
    if ranges is not None:
        return read_ranges(ranges).select(hits, *names)
    elements = hits.extra["element"]
    known = np.unique(elements).tolist()
    for name in names:
        if name not in known:
            hint = did_you_mean(name, known)
            raise ValueError(f"no ion is of species {name!r:.80}{hint}, only of {', '.join(known)}")
    return hits[np.isin(elements, names)]


def with_masses(hits: Hits, options: argparse.Namespace) -> Hits:
    """The ions with mass-to-charge ratios from their times of flight, if they have none and the distance is given."""
    columns = (hits.time_of_flight, hits.voltage, hits.x, hits.y)
    if hits.mass_to_charge is not None or options.distance is None or any(column is None for column in columns):
        return hits
    return hits.with_masses(options.distance, options.time_zero)


def of_element(hits: Hits, options: argparse.Namespace, computed: bool) -> Hits:
    """The ions in the peaks of the crystal, unless the options select masses or all ions; which ones is printed.

    Parameters
    ----------
    hits : Hits
        Ions that the options select.
    computed : bool
        Whether their m/n follows from the times of flight, so that its scale is not known.
    """
    chosen = options.all_ions or options.mass is not None or options.species is not None
    element = read_material(options.element, "--element").name
    if chosen or hits.mass_to_charge is None or element not in ISOTOPES:
        return hits
    source = replace(hits, mass_to_charge=None) if computed else hits
    flight = {"distance": options.distance, "time_zero": options.time_zero} if computed else {}
    named = spectrum(source, element, **flight)
    try:
        inside = named.inside(element)
    except ValueError as error:
        say("note", f"all ions are used: {error}")
        return hits
    peaks = "; ".join(
        f"{ion.name} at {', '.join(f'{low:.4g} to {high:.4g}' for low, high in ion.intervals)} Da"
        for ion in named.ions
        if ion.formula == element and ion.intervals
    )
    number = int(np.count_nonzero(inside))
    say(
        "note",
        f"{number:,} of {len(hits):,} ions are used, those of {peaks}; --all-ions, --mass or --species change it",
    )
    if named.flight is not None and named.flight.peaks:
        say("note", f"{named.flight}")
    return hits[inside]


def check_columns(hits: Hits, options: argparse.Namespace) -> None:
    """Raise a ValueError for ions without detector coordinates."""
    if hits.x is None or hits.y is None:
        names = ", ".join(hits.columns)
        raise ValueError(f"{options.file!r} has no detector coordinates x and y, which a map needs, only {names}")


def check_places(selection: Hits, options: argparse.Namespace) -> None:
    """Raise a ValueError if all ions are at one place on the detector: their map has no size."""
    x, y = (values[selection.detected] for values in selection.require("x", "y"))
    if selection.extent is None and len(x) and np.ptp(x) == np.ptp(y) == 0:
        names = [f"--{name}" for name in _SELECTING if getattr(options, name) is not None]
        source = f"{' '.join(names)} leaves" if names else f"{options.file!r} has"
        what = "one ion" if len(x) == 1 else f"{len(x):,} ions at one place"
        raise ValueError(f"{source} {what} on the detector: a map needs more")


def ions_of_map(hits: Hits, options: argparse.Namespace) -> Hits:
    """Ions that the options select; ValueError if they make no map."""
    check_columns(hits, options)
    selection = select(hits, options)
    check_places(selection, options)
    return selection


def read_registration(text: str) -> Registration:
    """Registration from a file (of a registration or a study), or from numbers."""
    parts = text.split(",")
    try:
        mirror = parts[4:] == ["mirror"]
        rotation, scale, *shift = (float(part) for part in (parts[:4] if mirror else parts))
    except ValueError:
        numbers = None
    else:
        numbers = (rotation, scale, tuple(shift), mirror) if len(shift) == 2 else None
    if numbers is not None:
        return Registration(*numbers)
    if Path(text).suffix.lower() != ".json":
        raise ValueError(f"--registration must be a .json file or ROTATION,SCALE,DX,DY[,mirror], got {text!r:.80}")
    written = read_small_file(text, MAX_STUDY, "a registration or a study")
    try:
        content = json.loads(written)
        registration = dict(content.get("registration", content))
        registration.pop("doubtful", None)  # follows from the others
        return from_plain(registration, Registration, what="registration")
    except (ValueError, TypeError, AttributeError, KeyError, RecursionError) as error:
        raise FileError(f"{text!r} does not contain a registration: {error}") from error


def measured_of(options: argparse.Namespace) -> Hits | DetectorMap:
    """The measured ions that the options select, or the measured map."""
    content = read(options)
    if isinstance(content, Run):
        raise ValueError(f"a measured file is needed, {options.file!r} contains a run, whose orientation is known")
    if isinstance(content, DetectorMap):
        return content
    selection = ions_of_map(with_masses(content, options), options)
    return of_element(selection, options, content.mass_to_charge is None)


_READING = ("format", "partial", "byte_order", "arrays", "unit", "voltage_unit")
_MASSES = ("all_ions", "time_zero")


def measured_source(options: argparse.Namespace) -> MeasuredSource:
    """The measured ions or the map, with what they are made from and the words that select the same ions."""
    paths = {"FILE": options.file, "file of --undistort": options.undistort}
    words = []
    for name in ("ions", "mass", "voltage"):
        if (bounds := getattr(options, name)) is not None:
            words += [f"--{name}", ",".join("" if bound is None else f"{bound:.10g}" for bound in bounds)]
    words += [f"--t0={options.time_zero!r}"] if options.time_zero else []
    words += ["--ranges", path_word(Path(options.ranges))] if options.ranges is not None else []
    words += [f"--species={options.species}"] if options.species is not None else []
    return MeasuredSource(
        partial(measured_of, options),
        Path(options.file),
        lambda: {name: None if path is None else sha256_of(path) for name, path in paths.items()},
        # what is not given is None, as for a twin made in Python
        {name: getattr(options, name) or None for name in (*_READING, *_SELECTING, *_MASSES) if name != "ranges"},
        tuple(words),
    )
