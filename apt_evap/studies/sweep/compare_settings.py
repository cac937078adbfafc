"""The table [compare] of a study file: a measured map, and how the runs are compared with it."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from apt_evap._common.codec import declared, from_plain, to_plain
from apt_evap._common.files import FileError, check_path
from apt_evap._common.validation import check_number, short_text
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.fit.fit_settings import FitSettings
from apt_evap.fit.grid import EnergyGrid
from apt_evap.simulation.config.tables import check_keys, check_table
from apt_evap.simulation.read_file import read

_READING = ("format", "byte_order", "unit")


@dataclass(frozen=True)
class CompareSettings:
    """Comparison of all finished runs of a sweep with a measured map."""

    measured: str
    grid: EnergyGrid
    settings: FitSettings
    reading: dict
    select: dict

    @classmethod
    def of(cls, table: Mapping[str, Any], folder: Path) -> "CompareSettings":
        """Settings from the table [compare]; a relative name of a file is relative to `folder`.

        Its keys are measured, select, those of `EnergyGrid` and `FitSettings`, and format, byte_order and unit.
        """
        kinds = {"grid": EnergyGrid, "settings": FitSettings}
        known = [name for kind in kinds.values() for name in declared(kind)]
        check_keys(table, ("measured", "select", *known, *_READING), ("measured",))
        name = table["measured"]
        if not isinstance(name, str) or not name:
            raise ValueError(f"[compare] measured must be a file name, got {short_text(name)}")
        table = {"objective": "similarity"} | dict(table)  # specimens of a sweep may differ in their poles
        parts = {
            part: from_plain({key: table[key] for key in declared(kind) if key in table}, kind, what="[compare]")
            for part, kind in kinds.items()
        }
        reading = {key: table[key] for key in _READING if key in table}
        for key, value in reading.items():
            if not isinstance(value, str):
                raise ValueError(f"[compare] {key} must be a text, got {short_text(value)}")
        check_table(table.get("select", {}), "[compare] select")
        select = dict(table.get("select", {}))
        for column, bounds in select.items():
            if not isinstance(bounds, list) or len(bounds) != 2:
                raise ValueError(f"[compare] select.{column} must be two bounds, got {short_text(bounds)}")
            for bound in bounds:
                check_number(bound, f"[compare] select.{column}")
        return cls(str(check_path(folder / name).resolve()), reading=reading, select=select, **parts)

    def to_table(self) -> dict[str, Any]:
        """Return the table, dict."""
        table = to_plain(self.grid, short=True) | to_plain(self.settings, short=True)
        del table["name"]
        return {"measured": self.measured, "select": self.select, **table, **self.reading}

    def read(self) -> Hits | DetectorMap:
        """Measured ions or map; FileError if the file cannot be read or contains neither."""
        content = read(self.measured, **self.reading)
        if isinstance(content, DetectorMap):
            return content
        if not isinstance(content, Hits):
            raise FileError(f"{self.measured!r} must contain measured ions or a map, got a run")
        return content.window(**{column: tuple(bounds) for column, bounds in self.select.items()})
