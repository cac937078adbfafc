"""The .epos format: a .pos with time of flight, voltages, detector and pulses, 44 bytes per ion, big-endian.

Larson et al., Local Electrode Atom Probe Tomography (Springer, 2013), appendix A. Real files contain voltages in V and
detector coordinates in mm, in contrast to the units printed there.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from apt_evap._common.files import replace_file
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_choice
from apt_evap.detection.hits import Hits
from apt_evap.detection.ion_blocks import IonBlocks
from apt_evap.io._pulses import (
    EveryCheck,
    PulseCheck,
    first_from_equal,
    first_from_every,
    pulses_from_first,
    whole_pulses,
)
from apt_evap.io._records import (
    MM,
    BlockWriter,
    check_any,
    choose,
    choose_fields,
    in_mm,
    open_words,
    tell_omitted,
    write_words,
)
from apt_evap.warnings import DataWarning, warn

_ROW = 44
_IN_VOLTS = "voltage_unit='V' (--voltage-unit V) reads them in V"
_FIELDS = {
    "positions": (0, 3, "f4"),
    "mass_to_charge": (3, 1, "f4"),
    "time_of_flight": (4, 1, "f4"),
    "voltage": (5, 1, "f4"),
    "pulse_voltage": (6, 1, "f4"),
    "x": (7, 1, "f4"),
    "y": (8, 1, "f4"),
    "pulses": (9, 1, "u4"),
    "ions": (10, 1, "u4"),
}
WRITTEN = tuple(_FIELDS)[:-1]
_GROUPING = ("pulse_id", "multiplicity")
_UNITS = ("V", "kV")
_LEAST = 100.0  # [V]: instruments have higher voltages, and files in kV lower numbers
_COLUMNS = (*tuple(_FIELDS)[:-1], *_GROUPING)
# further fields needed to find out whether a column is absent, and its unit
_WITH = {"x": ("y",), "y": ("x",), "pulse_voltage": ("voltage",), "pulse_id": ("ions",), "multiplicity": ("ions",)}


def read_epos(
    path: AnyPath,
    *,
    columns: Sequence[str] | None = None,
    partial: bool = False,
    byte_order: str | None = None,
    voltage_unit: str | None = None,
    detector_unit: str = "mm",
) -> Hits:
    """Read an .epos file.

    A column of zeros is treated as absent (None): positions, mass, time of flight, standing voltage, and detector
    coordinates if both are zero. A pulse voltage of zero is read if there is a standing voltage (laser pulsing). The
    column of pulses since the last event is read even if it is zero, and is not used to group ions.

    Returns
    -------
    Hits
        `pulse_id` and `multiplicity` are computed from the last column alone: the number of ions of a pulse for its
        first ion and 0 for the others, or for all of them. If it is inconsistent, they are None, with a warning.
    """
    chosen, fields = choose_fields(columns, _COLUMNS, _FIELDS, path, _WITH)
    survey = _Survey(voltage_unit, detector_unit)
    with _open(path, partial, byte_order) as words:
        block = words.read(fields)
        survey.add(block)
        survey.end(words.cut, path)
        if survey.grouped:
            block["ions"] = survey.first_ions(block["ions"])
        return _hits(block, survey, chosen, path)


def chunk_epos(
    path: AnyPath,
    rows: int,
    *,
    columns: Sequence[str] | None = None,
    partial: bool = False,
    byte_order: str | None = None,
    voltage_unit: str | None = None,
    detector_unit: str = "mm",
) -> Iterator[Hits]:
    """Read an .epos file in `Hits` of at most `rows` ions in complete pulses; otherwise as `read_epos`.

    The file is read twice: only the complete file shows which columns are absent, the unit of the voltages, and
    whether the pulses are consistent. If they are not, chunks have `rows` ions regardless of the pulses.

    Yields
    ------
    Hits
    """
    chosen, _ = choose_fields(columns, _COLUMNS, _FIELDS, path, _WITH)
    blocks = EposBlocks(
        path, chosen, partial=partial, byte_order=byte_order, voltage_unit=voltage_unit, detector_unit=detector_unit,
        pulses=True,
    )  # fmt: skip
    # the last pulse of a truncated file may have fewer rows than ions
    if blocks.largest > rows and not blocks.cut:
        raise blocks.too_few(blocks.largest, rows)
    yield from blocks.blocks(chosen, rows, pulses=True)


class EposBlocks:
    """An .epos file that is read in blocks as often as needed, after one pass over the columns that are needed.

    Parameters
    ----------
    path, columns, partial, byte_order, voltage_unit, detector_unit
        As for `read_epos`; only these columns can be read.
    pulses : bool
        Whether to look at the pulses even if no column needs them.
    watch : callable, optional
        Receives the number of ions, and then x and y [mm] of each block of the first pass.
    progress : callable, optional
        Receives the number of ions of each block of the first pass, and of the file.
    """

    available = _COLUMNS
    """Columns of the format."""

    def __init__(
        self,
        path: AnyPath,
        columns: Sequence[str] | None = None,
        *,
        partial: bool = False,
        byte_order: str | None = None,
        voltage_unit: str | None = None,
        detector_unit: str = "mm",
        pulses: bool = False,
        watch: Callable[[int], Callable[[Any, Any], object]] | None = None,
        progress: Callable[[int, int], object] = lambda ions, of: None,
    ) -> None:
        self._path, self._opening = path, (path, partial, byte_order)
        chosen, fields = choose_fields(columns, _COLUMNS, _FIELDS, path, _WITH)
        if pulses:
            fields = {**fields, "ions": _FIELDS["ions"]}
        self._survey = survey = _Survey(voltage_unit, detector_unit)
        with _open(*self._opening) as words:
            self.n, self.cut = words.n, words.cut
            seen = None if watch is None or not {"x", "y"} <= set(fields) else watch(words.n)
            for block in words.survey(fields):
                survey.add(block)
                if seen is not None:
                    places = in_mm({name: block[name] for name in ("x", "y")}, detector_unit)
                    seen(places["x"], places["y"])
                progress(len(next(iter(block.values()))), self.n)
                del block
            survey.end(words.cut, path)
        self.largest = survey.largest if survey.grouped else 0
        known = survey.present | ({*_GROUPING} if survey.grouped else set())
        self.columns = tuple(name for name in chosen if name in known)

    def too_few(self, largest: int, rows: int) -> ValueError:
        """Error for blocks that are smaller than a pulse."""
        return ValueError(
            f"rows must be >= {largest}, the number of ions in the largest pulse of {str(self._path)!r}, got {rows}"
        )

    def blocks(self, columns: Sequence[str], rows: int, pulses: bool = False) -> Iterator[Hits]:
        """Blocks of at most `rows` ions; of complete pulses if a column needs them, or with `pulses`."""
        survey = self._survey
        chosen, fields = choose_fields(columns, _COLUMNS, _FIELDS, self._path, _WITH)
        grouped = survey.grouped and (pulses or bool({*_GROUPING} & set(chosen)))
        if pulses:
            fields = {**fields, "ions": _FIELDS["ions"]}

        def keep(block):
            if not grouped:
                return rows
            ions = survey.first_ions(block["ions"])
            n = whole_pulses(ions)
            if n == 0:
                raise self.too_few(ions[0], rows)
            return n

        first_pulse = 0
        with _open(*self._opening) as words:
            for block in words.blocks(fields, rows, keep):
                number = 0
                if grouped:
                    block["ions"] = survey.first_ions(block["ions"])
                    number = np.count_nonzero(block["ions"])
                yield _hits(block, survey, chosen, self._path, first_pulse)
                first_pulse += number
                del block


class _Survey:
    """Properties of the complete file: columns of zeros, unit of the voltages, consistency of the pulses."""

    def __init__(self, voltage_unit: str | None, detector_unit: str) -> None:
        self.detector_unit = check_choice(detector_unit, "detector_unit (--unit)", MM)
        if voltage_unit is not None:
            check_choice(voltage_unit, "voltage_unit (--voltage-unit)", _UNITS)
        self._unit = voltage_unit
        self.present = set()
        self.highest = {}
        self._pulses = PulseCheck()
        self._every = EveryCheck()
        self.grouped = self._of_every_ion = False
        self.largest = 0

    @np.errstate(invalid="ignore")
    def add(self, block: Any) -> None:
        """Include the next rows."""
        for name, values in block.items():
            # usually the first rows are sufficient
            if name not in self.present and (values[:64].any() or values.any()):
                self.present.add(name)
            if name in ("voltage", "pulse_voltage"):
                # fmax ignores NaN; some files have negative voltages
                extremes = np.abs([np.fmax.reduce(values), np.fmin.reduce(values)])
                self.highest[name] = np.fmax(self.highest.get(name, np.nan), np.fmax.reduce(extremes))
        if "ions" in block:
            self._pulses.add(block["ions"])
            self._every.add(block["ions"])

    def end(self, cut: bool, path: AnyPath) -> Any:
        """Evaluate the complete file, and warn if the pulses are inconsistent."""
        if self.present & {"x", "y"}:
            self.present |= {"x", "y"}
        decisive = "voltage" if "voltage" in self.present else "pulse_voltage"
        highest = self.highest.get(decisive, np.nan)
        self.kilovolts = self._unit == "kV" or (self._unit is None and bool(highest < _LEAST))
        if self.kilovolts and self._unit is None and decisive in self.present:
            warn(
                f"{str(path)!r}: voltages of at most {highest:.4g} are taken for kV; {_IN_VOLTS}",
                DataWarning,
            )
        if "voltage" in self.present:
            self.present.add("pulse_voltage")
        self.present.add("pulses")
        if self._pulses.rows:
            problem = self._pulses.problem(cut)
            self._of_every_ion = bool(problem) and self._every.holds(cut)
            self.grouped = not problem or self._of_every_ion
            self.largest = (self._every if self._of_every_ion else self._pulses).largest
            if not self.grouped:
                warn(
                    f"{str(path)!r}: pulses unknown, so pulse_id and multiplicity are None: the column of ions per "
                    f"pulse is inconsistent, {problem}",
                    DataWarning,
                )

    def first_ions(self, ions: Any) -> Any:
        """Ions per pulse for the first ion of each pulse and 0 for the others; some files have it for all of them."""
        return first_from_every(ions, cut=True) if self._of_every_ion else ions


def _hits(block, survey, chosen, path, first_pulse=0):
    """Hits of a block of complete pulses."""
    columns = {name: values for name, values in block.items() if name in survey.present}
    columns = in_mm(columns, survey.detector_unit)
    if survey.kilovolts:
        with np.errstate(over="ignore"):
            for name in {"voltage", "pulse_voltage"} & set(columns):
                columns[name] = columns[name] * np.float32(1000)
    if survey.grouped and {*_GROUPING} & set(chosen):
        columns["pulse_id"], columns["multiplicity"] = pulses_from_first(block["ions"], first_pulse)
    requested = {name: columns.get(name) for name in chosen}
    check_any(requested, path)
    return Hits(**requested, source=str(path))


def _open(path, partial, byte_order):
    return open_words(path, _ROW, "an .epos", partial=partial, byte_order=byte_order, rival=("a .pos", 16))


def write_epos(path: AnyPath, hits: Hits) -> None:
    """Write an .epos file.

    Ions that did not hit the detector and ions with a value that is not finite are left out, and a warning gives their
    number. Missing columns are written as zeros. The number of ions per pulse is recomputed for the written ions:
    consecutive ions with the same `pulse_id` are one pulse. Each simulated ion without `pulse_id` is one pulse. The
    format does not contain the unit of the voltages: if all are below 100 V, a warning says that they can be taken for
    kV.
    """
    columns, further = _written(hits)
    chosen = choose(path, hits, columns)
    highest = next(
        (np.abs(v[chosen]).max() for v in (hits.voltage, hits.pulse_voltage) if v is not None and v[chosen].any()),
        np.nan,
    )
    _warn_of_volts(path, highest)
    write_words(path, [*columns, *further(chosen)], _ROW, chosen)


def write_epos_blocks(path: AnyPath, ions: IonBlocks) -> int:
    """Write the detected ions of a large file as `write_epos` does, block by block; return their number."""
    with replace_file(path) as file:
        writer = ions.fed(lambda: BlockWriter(file, _ROW, _written))
        tell_omitted(path, writer.detected, 0, writer.detected - writer.written)
        _warn_of_volts(path, next((volts for volts in writer.highest.values() if volts), np.nan))
    return writer.detected


def _written(hits):
    """Columns to write, and a function that returns that of the ions per pulse, for a selection of the ions."""
    columns = [
        (0, hits.positions, "f4"),
        (3, hits.mass_to_charge, "f4"),
        (4, hits.time_of_flight, "f4"),
        (5, hits.voltage, "f4"),
        (6, hits.pulse_voltage, "f4"),
        (7, hits.x, "f4"),
        (8, hits.y, "f4"),
        (9, hits.pulses, "u4"),
    ]

    def further(chosen):
        ions = np.zeros(len(hits), np.uint32)
        if hits.pulse_id is not None:
            ions[chosen] = first_from_equal(hits.pulse_id[chosen])
        elif hits.outcome is not None or hits.ion is not None:
            ions[:] = 1
        return [(10, ions, "u4")]

    return columns, further


def _warn_of_volts(path, highest):
    """Warn if the largest voltage is that of a file in kV."""
    if highest < _LEAST:
        warn(
            f"{str(path)!r}: voltages of at most {highest:.4g} V can be taken for kV: the format does not contain "
            f"their unit; {_IN_VOLTS}",
            DataWarning,
        )
