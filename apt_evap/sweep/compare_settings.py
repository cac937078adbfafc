"""The table [compare] of a study file: a measured map, and how the runs are compared with it."""

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from apt_evap._common.files import FileError, open_for_reading
from apt_evap._common.validation import check_choice, check_count, short_text
from apt_evap.config.tables import check_keys
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.energy_fit.defaults import MECHANISMS
from apt_evap.energy_fit.grid import EnergyGrid
from apt_evap.io.formats import read

_OPTIONS = (
    "mechanism",
    "means",
    "rsds",
    "rollup_fractions",
    "bins",
    "smoothing",
    "flattening",
    "temperature",
    "replicas",
    "resamples",
    "seed",
)
_READING = ("format", "byte_order", "unit")


@dataclass(frozen=True)
class CompareSettings:
    """Comparison of all finished runs of a sweep with a measured map.

    Parameters
    ----------
    measured : str
        Measured ions (.epos, ...) or a map (.npz).
    options : dict
        Parameters of `fit_tips`.
    reading : dict
        Parameters of `read`: format, byte_order, unit.
    select : dict
        Bounds of columns, as for `Hits.window`.
    """

    measured: str
    options: dict
    reading: dict
    select: dict

    @classmethod
    def of(cls, table: Mapping[str, Any], folder: Path) -> "CompareSettings":
        """Settings from the table [compare]; a relative name of a file is relative to `folder`.

        Raises
        ------
        ValueError
            If a key is unknown, the file does not exist, or a value is wrong.
        """
        check_keys(table, ("measured", "select", *_OPTIONS, *_READING), ("measured",))
        name = table["measured"]
        if not isinstance(name, str) or not (folder / name).is_file():
            raise ValueError(f"[compare] measured must be an existing file, got {short_text(name)}")
        options = {key: table[key] for key in _OPTIONS if key in table}
        check_choice(options.get("mechanism", "roll-up"), "[compare] mechanism", MECHANISMS)
        EnergyGrid(
            options.get("mechanism", "roll-up"),
            **{key: options[key] for key in ("means", "rsds", "rollup_fractions") if key in options},
        )
        if "resamples" in options:
            check_count(options["resamples"], "[compare] resamples")
        reading = {key: table[key] for key in _READING if key in table}
        select = dict(table.get("select", {}))
        for column, bounds in select.items():
            if not isinstance(bounds, list) or len(bounds) != 2:
                raise ValueError(f"[compare] select.{column} must be two bounds, got {short_text(bounds)}")
        return cls(str((folder / name).resolve()), options, reading, select)

    def to_dict(self) -> dict[str, Any]:
        """Return the settings in plain types, dict."""
        return asdict(self)

    def read(self) -> Hits | DetectorMap:
        """Measured ions or map; FileError if the file cannot be read or contains neither."""
        content = read(self.measured, **self.reading)
        if isinstance(content, DetectorMap):
            return content
        if not isinstance(content, Hits):
            raise FileError(f"{self.measured!r} must contain measured ions or a map, got a run")
        return content.window(**{column: tuple(bounds) for column, bounds in self.select.items()})

    def sha256(self) -> str:
        """Hash of the measured file."""
        hashed = hashlib.sha256()
        with open_for_reading(self.measured) as file:
            while block := file.read(1 << 20):
                hashed.update(block)
        return hashed.hexdigest()
