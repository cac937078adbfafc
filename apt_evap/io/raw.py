"""The .raw format of the atom probes of Stuttgart: voltages, detector, time of flight and pulse, 32 bytes per ion.

Little-endian, no header: base, pulse and reflectron voltage [V], detector x, y [mm], time of flight [ns], all
float32, then an epoch (int32) and the number of the pulse (uint32).
"""

from collections.abc import Iterator, Sequence

import numpy as np

from apt_evap._common.types import AnyPath
from apt_evap.detection.hits import Hits
from apt_evap.io._pulses import are_grouped, first_from_equal, pulses_from_first
from apt_evap.io._records import check_any, choose_fields, in_mm, open_words

_ROW = 32
_FIELDS = {
    "voltage": (0, 1, "f4"),
    "pulse_voltage": (1, 1, "f4"),
    "reflectron_voltage": (2, 1, "f4"),
    "x": (3, 1, "f4"),
    "y": (4, 1, "f4"),
    "time_of_flight": (5, 1, "f4"),
    "epoch": (6, 1, "i4"),
    "pulse_number": (7, 1, "u4"),
}
_EXTRA = ("reflectron_voltage", "epoch", "pulse_number")
_COLUMNS = (*_FIELDS, "pulse_id", "multiplicity")
_WITH = {"pulse_id": ("pulse_number",), "multiplicity": ("pulse_number",)}


def read_raw(
    path: AnyPath,
    *,
    columns: Sequence[str] | None = None,
    partial: bool = False,
    byte_order: str | None = None,
    detector_unit: str = "mm",
) -> Hits:
    """Read a Stuttgart .raw file.

    Consecutive ions with the same pulse number belong to one pulse; the number may wrap around. If it is zero for all
    ions, they are not grouped.

    Returns
    -------
    Hits
        With voltage, pulse_voltage [V], x, y [mm], time_of_flight [ns], pulse_id and multiplicity;
        ``extra`` contains "reflectron_voltage" [V], "epoch" and "pulse_number".
    """
    chosen, fields = choose_fields(columns, _COLUMNS, _FIELDS, path, _WITH)
    with _open(path, partial, byte_order) as words:
        block = words.read(fields)
        grouped = "pulse_number" in block and are_grouped([block["pulse_number"]], path)
        return _hits(in_mm(block, detector_unit), grouped, chosen, path)


def chunk_raw(
    path: AnyPath,
    rows: int,
    *,
    columns: Sequence[str] | None = None,
    partial: bool = False,
    byte_order: str | None = None,
    detector_unit: str = "mm",
) -> Iterator[Hits]:
    """Read a .raw file in `Hits` of at most `rows` ions in complete pulses; otherwise as `read_raw`.

    Yields
    ------
    Hits
    """
    chosen, fields = choose_fields(columns, _COLUMNS, _FIELDS, path, _WITH)
    fields = {**fields, "pulse_number": _FIELDS["pulse_number"]}
    number = {"pulse_number": _FIELDS["pulse_number"]}
    with _open(path, partial, byte_order) as words:
        grouped = are_grouped((block["pulse_number"] for block in words.survey(number)), path)

        def keep(block):
            numbers = block["pulse_number"]
            borders = np.flatnonzero(numbers[1:] != numbers[:-1]) if grouped else [rows - 1]
            if len(borders) == 0:
                raise ValueError(
                    f"rows must be >= the number of ions in the largest pulse of {str(path)!r}, more than {rows} in "
                    f"pulse {numbers[0]}, got {rows}"
                )
            return int(borders[-1]) + 1

        first_pulse = 0
        for block in words.blocks(fields, rows, keep, ahead=1):  # one more row, to see whether the last pulse ends
            yield _hits(in_mm(block, detector_unit), grouped, chosen, path, first_pulse)
            first_pulse += np.count_nonzero(first_from_equal(block["pulse_number"]))
            del block


def _hits(block, grouped, chosen, path, first_pulse=0):
    columns = dict(block)
    if grouped and {"pulse_id", "multiplicity"} & set(chosen):
        ions = first_from_equal(block["pulse_number"])
        columns["pulse_id"], columns["multiplicity"] = pulses_from_first(ions, first_pulse)
    requested = {name: columns.get(name) for name in chosen}
    check_any(requested, path)
    extra = {name: requested.pop(name) for name in _EXTRA if name in requested}
    units = {"reflectron_voltage": "V"} if "reflectron_voltage" in extra else {}
    return Hits(**requested, extra=extra, units=units, source=str(path))


def _open(path, partial, byte_order):
    return open_words(path, _ROW, "a .raw", order="little", floats=6, partial=partial, byte_order=byte_order)
