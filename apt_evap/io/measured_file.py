"""How a measurement was read, and which of its ions are used: the words, code and records of all commands."""

import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from apt_evap._common.codec import checked, choice, declared, number, settings, switch, to_plain, vector
from apt_evap._common.files import check_path, sha256_of
from apt_evap._common.kept import digest_of
from apt_evap._common.validation import check_array, check_kind, check_number, check_sequence, did_you_mean, short_text
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.detection.ion_blocks import IonBlocks
from apt_evap.io import formats
from apt_evap.io.distortion_grid import read_grid

if TYPE_CHECKING:
    from apt_evap.spectra.mass_spectrum import Spectrum

_ARRAYS = ("values", "x_edges", "y_edges", "mask")
_OF_IONS = ("voltage_unit", "ions", "mass", "voltage", "circle", "box", "ranges", "species")
"""Options that a map does not have."""
_SELECTING = _OF_IONS[1:]
_FILES = ("undistort", "ranges")
"""Options that are files: their content counts, not their names."""


def _text(value, name):
    return check_kind(value, name, str, "a text")


def _path(value, name):
    return str(check_path(value))


def _bounds(value, name):
    bounds = check_sequence(value, name, "two bounds")
    if len(bounds) != 2:
        raise ValueError(f"{name} must be two bounds (low, high), got {short_text(value)}")
    return tuple(None if bound is None else check_number(bound, name) for bound in bounds)


def _rows(value, name):
    """Bounds of numbers of ions: whole numbers are integers, also from the text of a command."""
    return tuple(int(bound) if bound is not None and bound == int(bound) else bound for bound in _bounds(value, name))


def _circle(value, name):
    radius, centre = check_sequence(value, name, "a radius and a centre")
    return check_number(radius, name, above=0, unit="mm"), tuple(check_array(centre, name, (2,)).tolist())


def _optional(text, kind, check):
    return checked(text, kind, check, default=None)


@settings
class MeasuredFile:
    """A file of measured ions or of a map: how it is read, and which of its ions are used.

    Equality, the words of a command line, the Python code, and the record of what is kept are made from these fields,
    in this order. The order of the selections does not matter, but for the numbers of the ions, which are first.
    """

    path: str = checked("The file.", "str or path-like", _path)
    format: str | None = _optional("Format of the ions, such as .pos.", "str", _text)
    partial: bool | None = switch("Read a truncated file to its last ion.", default=None)
    byte_order: str | None = choice("Of a .pos or .epos.", ("big", "little"), default=None)
    arrays: str | None = _optional("Names in an .npz: values, edges in x and y, mask.", "str", _text)
    unit: str | None = _optional("Unit on the detector.", "str", _text)
    voltage_unit: str | None = choice("Of an .epos.", ("V", "kV"), default=None)
    undistort: str | None = _optional("File of a calibration grid.", "str or path-like", _path)
    exchange_axes: bool | None = switch("Exchange detectorX and detectorY of the grid.", default=None)
    distance: float | None = number(
        "Flight length, from which masses follow if there are none.", default=None, above=0, unit="mm"
    )
    time_zero: float = number("Time that is subtracted from the times of flight.", default=0.0, unit="ns")
    ions: tuple | None = _optional("First ion, and the one after the last.", "tuple", _rows)
    mass: tuple | None = _optional("Bounds of the mass-to-charge ratio [Da].", "tuple", _bounds)
    voltage: tuple | None = _optional("Bounds of the DC voltage [V].", "tuple", _bounds)
    circle: tuple | None = _optional("Radius, and centre on the detector [mm].", "tuple", _circle)
    box: tuple | None = vector("Bounds in x and in y on the detector.", 4, default=None, unit="mm")
    ranges: str | None = _optional("File of ranges of mass.", "str or path-like", _path)
    species: str | None = _optional("Names of species, with commas.", "str", _text)
    peaks: str | None = _optional("Only the ions in the peaks of this element.", "str", _text)

    # ---- reading -----------------------------------------------------------------------------------------------------

    @property
    def name(self) -> str:
        """Name of the file without its folder."""
        return Path(self.path).name

    @property
    def is_map(self) -> bool:
        """Whether the file is a map by its name or the option of the format."""
        return (self.format or Path(self.path).suffix).lower().lstrip(".") == "npz"

    @property
    def selects(self) -> bool:
        """Whether ions are selected, beside those in the peaks of an element."""
        return any(getattr(self, name) is not None for name in _SELECTING)

    def of_run(self) -> "MeasuredFile":
        """The same for a run, whose ions have their masses."""
        return replace(self, peaks=None, distance=None)

    def load(self, read: Callable[..., Any] = formats.read) -> Any:
        """The content of the file, without the distortion, by a function such as `apt_evap.read`."""
        for name in _OF_IONS if self.is_map else ("arrays",):
            if getattr(self, name) is not None:
                what = "ions" if self.is_map else "a map in an .npz file"
                raise ValueError(f"--{_option(name)} is for {what}, got {self.path!r}")
        if self.exchange_axes and self.undistort is None:
            raise ValueError("--exchange-axes needs --undistort, a calibration grid")
        content = read(self.path, **self._reading())
        if self.undistort is None:
            return content
        if not isinstance(content, Hits):
            what = "a map" if isinstance(content, DetectorMap) else "a run"
            raise ValueError(f"--undistort is only for measured ions, {self.path!r} contains {what}")
        self.check_columns(content)
        return self._undistorted(_PACKAGE, content)

    def blocks(
        self,
        columns: tuple[str, ...] | None = None,
        progress: Callable[[int, int], object] = lambda ions, of: None,
        further: tuple[str, ...] = (),
    ) -> IonBlocks | None:
        """Blocks of the ions of a large file, all of which are used; None if it is to be read whole, see `ion_blocks`.

        Parameters
        ----------
        columns : tuple of str, optional
            Columns that are needed; by default all.
        progress : callable, optional
            Receives the number of ions of each block, and of the file.
        further : tuple of str
            Columns that are read if the file has them.
        """
        changed = (self.selects, self.peaks, self.undistort, self.exchange_axes, self.distance)
        if any(change not in (None, False) for change in changed) or self.is_map or not os.path.isfile(self.path):
            return None
        return formats.ion_blocks(self.path, columns, further=further, progress=progress, **self._reading())

    def measured(self, note: Callable[[str], None], read: Callable[..., Any] = formats.read) -> Hits | DetectorMap:
        """The ions that are used, for a map, or the map of the file; notes say which ions are those of `peaks`."""
        content = self.load(read)
        if isinstance(content, DetectorMap):
            return content
        if not isinstance(content, Hits):
            kind = type(content).__name__
            raise ValueError(f"measured must be ions or a map, {short_text(self.path)} contains a {kind}")
        return self.ions_of_map(content, note)

    def ions_of_map(self, hits: Hits, note: Callable[[str], None] | None = None) -> Hits:
        """Selected ions; ValueError if they make no map. For `note` see `select`."""
        self.check_columns(hits)
        selection = self.select(hits, note)
        x, y = (values[selection.detected] for values in selection.require("x", "y"))
        if selection.extent is None and len(x) and np.ptp(x) == np.ptp(y) == 0:
            names = [f"--{_option(name)}" for name in _SELECTING if getattr(self, name) is not None]
            source = f"{' '.join(names)} leaves" if names else f"{self.path!r} has"
            what = "one ion" if len(x) == 1 else f"{len(x):,} ions at one place"
            raise ValueError(f"{source} {what} on the detector: a map needs more")
        return selection

    def check_columns(self, hits: Hits) -> None:
        """Raise a ValueError for ions without detector coordinates."""
        if hits.x is None or hits.y is None:
            names = ", ".join(hits.columns)
            raise ValueError(f"{self.path!r} has no detector coordinates x and y, which a map needs, only {names}")

    def select(self, hits: Hits, note: Callable[[str], None] | None = None) -> Hits:
        """The ions of the file that are used.

        Parameters
        ----------
        hits : Hits
            All ions, with the numbers of the file in `ion`, or as rows.
        note : callable, optional
            Receives which ions are those of `peaks`. If there are no such peaks, all ions are used, which it receives,
            too; without it, this is an error.
        """
        if self.species is None and self.ranges is not None:
            raise ValueError(f"--species is missing: names of species in {self.ranges!r}")
        if self.species is not None and self.ranges is None and "element" not in hits.extra:
            raise ValueError(
                "--species needs --ranges, a file of ranges of mass: only the ions of a run have known elements"
            )
        selection = hits
        for name, step in self._steps(hits.columns):
            try:
                selection = step(_PACKAGE, selection)
            except ValueError as error:
                raise ValueError(f"--{_option(name)}: {error}") from error
        if self.selects and len(selection) == 0:
            raise ValueError(f"the options select none of the {len(hits):,} ions of {self.path!r}")
        if self.peaks is None:
            return selection
        if note is not None and not self._knows_masses(hits.columns):
            if {"time_of_flight", "voltage"} <= set(hits.columns):
                note(f"all ions are used: --distance MM, the flight length, gives m/n, and the ions of {self.peaks}")
            return selection
        return self._in_peaks(selection, note)

    def spectrum(self, read: Callable[..., Any] = formats.read) -> "Spectrum | None":
        """Spectrum of all ions, however their masses are selected; of the ranges, if there are; None without masses."""
        hits = self.load(read)
        if not isinstance(hits, Hits) or not self._knows_masses(hits.columns):
            return None
        ranges = None if self.ranges is None else formats.read_ranges(self.ranges)
        distance = self.distance if self._computes(hits.columns) else None
        every = replace(self, distance=None, mass=None, ranges=None, species=None, peaks=None)
        return _spectrum(every.select(hits), ranges=ranges, distance=distance, time_zero=self.time_zero)

    def _in_peaks(self, hits, note):
        """The ions in the peaks of the element, and which ones they are as a note."""
        made: list[Any] = []

        def kept(*arguments, **options):
            made.append(_spectrum(*arguments, **options))
            return made[0]

        try:
            inside = self._of_peaks(SimpleNamespace(spectrum=kept), hits, self._computes(hits.columns))
        except ValueError as error:
            if note is None or not made:
                raise
            note(f"all ions are used: {error}")
            return hits.with_masses(self.distance, self.time_zero) if self._computes(hits.columns) else hits
        if note is not None:
            (named,) = made
            intervals = "; ".join(
                f"{ion.name} at {', '.join(f'{low:.4g} to {high:.4g}' for low, high in ion.intervals)} Da"
                for ion in named.ions
                if ion.formula == self.peaks and ion.intervals
            )
            change = "--all-ions, --mass or --species change it"
            used, all_ions = (int(np.count_nonzero(ions.detected)) for ions in (inside, hits))  # without strays
            note(f"{used:,} of {all_ions:,} ions are used, those of {intervals}; {change}")
            if named.flight is not None and named.flight.peaks:
                note(f"{named.flight}")
        return inside

    # ---- one form of each step, for ions and for text ----------------------------------------------------------------

    def _reading(self):
        """Keyword arguments of `apt_evap.read`."""
        options = {"format": self.format, "partial": self.partial, "byte_order": self.byte_order}
        options |= {"voltage_unit": self.voltage_unit, "unit" if self.is_map else "detector_unit": self.unit}
        if self.arrays is not None:
            names = self.arrays.split(",")
            if len(names) not in (3, 4):
                expected = "values, edges in x and y, and perhaps a mask"
                raise ValueError(f"--arrays must name {expected}, got {self.arrays!r:.80}")
            options |= dict(zip(_ARRAYS, names, strict=False))
        return {name: value for name, value in options.items() if value is not None}

    def _undistorted(self, ae, hits):
        options = {"exchange": True} if self.exchange_axes else {}
        return hits.undistorted(ae.io.read_grid(self.undistort, **options))

    def _steps(self, columns) -> Iterator[tuple[str, Callable[[Any, Any], Any]]]:
        """Selections but that by peaks, with the names of their options.

        Each takes the package and the ions; both may also be `_Code`.
        """
        if self.ions is not None:  # first: numbers of the ions in the file
            yield "ions", lambda ae, hits: hits.window(ion=self.ions)
        if self.peaks is None and self._computes(columns):  # peaks fit the flight, too
            yield "distance", lambda ae, hits: hits.with_masses(self.distance, self.time_zero)
        if self.mass is not None:
            yield "mass", lambda ae, hits: hits.window(mass_to_charge=self.mass)
        if self.voltage is not None:
            yield "voltage", lambda ae, hits: hits.window(voltage=self.voltage)
        if (circle := self.circle) is not None:
            yield "circle", lambda ae, hits: hits.within_circle(*circle)
        if (box := self.box) is not None:
            yield "box", lambda ae, hits: hits.window(x=box[:2], y=box[2:])
        if self.species is not None:
            yield "species", self._of_species

    def _of_species(self, ae, hits):
        """Ions of these species: by a file of ranges, or by the elements that simulated ions know."""
        names = self.species.split(",")
        if self.ranges is not None:
            return ae.io.read_ranges(self.ranges).select(hits, *names)
        elements = hits.extra["element"]
        known = np.unique(elements).tolist()
        for name in names:
            if name not in known:
                hint = did_you_mean(name, known)
                raise ValueError(f"no ion is of species {name!r:.80}{hint}, only of {', '.join(known)}")
        return hits[np.isin(elements, names)]

    def _of_peaks(self, ae, hits, computes):
        flight = {"distance": self.distance, "time_zero": self.time_zero} if computes else {}
        return ae.spectrum(hits, self.peaks, **flight).select(self.peaks)

    def _computes(self, columns):
        """Whether masses follow from the times of flight."""
        has_times = {"time_of_flight", "voltage", "x", "y"} <= set(columns)
        return self.distance is not None and "mass_to_charge" not in columns and has_times

    def _knows_masses(self, columns):
        return "mass_to_charge" in columns or self._computes(columns)

    # ---- what is made from the fields --------------------------------------------------------------------------------

    def words(self, peaks: str = "element") -> list[str]:
        """Words of a command line that read the same ions: the file and the options; `peaks` is the option for them."""
        words = [path_word(self.path)]
        for name, value in self._chosen():
            option = peaks if name == "peaks" else _option(name)
            words.append(f"--{option}" if value is True else f"--{option}={_word(value)}")
        return words

    def code(self, columns: tuple[str, ...], start: str = "") -> str:
        """Python expression of the same ions, after ``import apt_evap as ae``.

        Parameters
        ----------
        columns : tuple of str
            Columns of the ions of the file, from which masses may follow; empty for a map.
        start : str
            Expression of all ions of the file, by default that of reading it.
        """
        ae = _Code("ae")
        code = _Code(start) if start else ae.read(self.path, **self._reading())
        if self.undistort is not None:
            code = self._undistorted(ae, code)
        for _, step in self._steps(columns):
            code = step(ae, code)
        return repr(code if self.peaks is None else self._of_peaks(ae, code, self._computes(columns)))

    def made_from(self) -> dict[str, Any]:
        """Record of what results are made from, in plain types: the SHA-256 of the files, and all options.

        An option that is not given is None; one that is off is False.
        """
        record: dict[str, Any] = {"FILE": sha256_of(self.path)}
        for name in _FILES:
            path = getattr(self, name)
            record[f"file of --{name}"] = None if path is None else sha256_of(path)
        others = (name for name in declared(MeasuredFile) if name not in ("path", *_FILES, "peaks"))
        record |= {f"--{_option(name)}": to_plain(getattr(self, name)) for name in others}
        return record | {"--all-ions": True if self.peaks is None else f"no, those of {self.peaks}"}

    def digest(self) -> str:
        """SHA-256 of `made_from`."""
        return digest_of(self.made_from())

    def _chosen(self):
        """Names and values of the fields that are not their default, without the file."""
        default = MeasuredFile(self.path)
        for name in declared(MeasuredFile):
            if (value := getattr(self, name)) != getattr(default, name):
                yield name, value


def _spectrum(*arguments, **options):
    """`apt_evap.spectrum`: a map has none, and starts without its modules."""
    from apt_evap.spectra.mass_spectrum import spectrum

    return spectrum(*arguments, **options)


_PACKAGE = SimpleNamespace(io=SimpleNamespace(read_grid=read_grid, read_ranges=formats.read_ranges), spectrum=_spectrum)
"""What the steps need of the package, which does not import itself."""


class _Code:
    """Text of a Python expression, which grows by attributes and calls."""

    def __init__(self, text: str) -> None:
        self._text = text

    def __getattr__(self, name: str) -> "_Code":
        return _Code(f"{self._text}.{name}")

    def __call__(self, *arguments: Any, **options: Any) -> "_Code":
        words = [*map(repr, arguments), *(f"{name}={value!r}" for name, value in options.items())]
        return _Code(f"{self._text}({', '.join(words)})")

    def __repr__(self) -> str:
        return self._text


def path_word(path: str | os.PathLike[str]) -> str:
    """Word of a command line, a path with ./ before a dash, which would make an option of it."""
    return f".{os.sep}{path}" if str(path).startswith("-") else str(path)


def _option(name):
    """Option of a field without its dashes."""
    return "t0" if name == "time_zero" else name.replace("_", "-")


def _word(value):
    """Value of an option."""
    if isinstance(value, tuple):
        return ",".join(map(_word, value))
    return "" if value is None else value if isinstance(value, str) else repr(value)
