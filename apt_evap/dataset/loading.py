"""Reading of a data set: examples one by one, or complete tables as arrays, data frames or an xarray Dataset."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.files import check_path
from apt_evap._common.optional_imports import optional_import
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_choice
from apt_evap.dataset.examples import Rows
from apt_evap.dataset.fields import TEXT, chosen_tables
from apt_evap.dataset.making import read_about
from apt_evap.dataset.settings import SPLITS, read_instrument
from apt_evap.dataset.shards import Schema, read_table
from apt_evap.detection.dataframe import to_dataframe
from apt_evap.detection.hits import Hits
from apt_evap.detection.instrument import Instrument

if TYPE_CHECKING:
    import pandas
    import xarray

_JSON = ("elements", "phases", "emission", "instrument", "settings")


@dataclass(frozen=True, repr=False)
class Example:
    """An example of a data set: what an instrument records of a run for one emission, and the truth.

    Parameters
    ----------
    about : dict
        Its row of the table of the examples; texts in JSON are decoded.
    ions : dict of str to ndarray
        Columns of the ions by name.
    poles, zone_lines, cap : dict of str to ndarray
        Columns of these tables by name; empty if the data set does not have them.
    """

    about: dict[str, Any]
    ions: dict[str, NDArray[Any]]
    poles: dict[str, NDArray[Any]] = field(default_factory=dict)
    zone_lines: dict[str, NDArray[Any]] = field(default_factory=dict)
    cap: dict[str, NDArray[Any]] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"<Example: {self.about['name']}, {self.about['ions']:,} ions, {', '.join(self.ions)}>"

    @property
    def instrument(self) -> Instrument:
        """The instrument."""
        return read_instrument(self.about["instrument"])

    @property
    def hits(self) -> Hits:
        """The ions as `Hits`: for maps, reconstructions and files."""
        known = ("x", "y", "time_of_flight", "mass_to_charge", "voltage", "pulse_voltage", "multiplicity")
        columns: dict[Any, Any] = {name: self.ions[name] for name in known if name in self.ions}
        other = {"pulse_id": "pulse", "positions": "site", "ion": "number"}
        columns |= {name: self.ions[own] for name, own in other.items() if own in self.ions}
        extra = {name: self.ions[name] for name in ("species", "phase", "charge") if name in self.ions}
        half = self.about["instrument"]["field_of_view"] / 2
        return Hits(**columns, extra=extra, source=self.about["name"], extent=(-half, half, -half, half))


class DataSet:
    """A data set in a folder: a sequence of its examples, which are read when they are used.

    Parameters
    ----------
    folder : Path
        The folder.
    content : dict
        Content of ``dataset.json``.
    shards : tuple of dict
        The files whose examples it contains, of ``content["shards"]``.
    """

    def __init__(self, folder: Path, content: dict[str, Any], shards: tuple[dict[str, Any], ...]) -> None:
        self.folder, self.content, self.shards = folder, content, shards

    def __repr__(self) -> str:
        return f"<DataSet: {len(self):,} examples of {sum(shard['runs'] for shard in self.shards):,} runs>"

    @property
    def schema(self) -> Schema:
        """Fields by table, dict."""
        return chosen_tables(tuple(self.content["dataset"]["fields"]))

    @cached_property
    def _firsts(self) -> NDArray[Any]:
        """Index of the first example of each file, and of the end, shape (files + 1,)."""
        return np.cumsum([0, *(shard["examples"] for shard in self.shards)])

    def __len__(self) -> int:
        return int(self._firsts[-1])

    def __iter__(self) -> Iterator[Example]:
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> Example:
        index = range(len(self))[index]  # IndexError outside
        number = int(np.searchsorted(self._firsts, index, side="right")) - 1
        shard, row = self.shards[number]["name"], index - int(self._firsts[number])
        about = {name: values[row] for name, values in self._read(shard, "examples").items()}
        about = {name: value.item() if isinstance(value, np.generic) else value for name, value in about.items()}
        about |= {name: json.loads(about[name]) for name in _JSON}
        first = about.pop("first_ion")
        rows = slice(first, first + about["ions"])
        if self.content["dataset"]["format"] == "hdf5":
            ions = read_table(self.folder, shard, "ions", self.schema, "hdf5", rows)
        else:
            ions = {name: values[rows] for name, values in self._read(shard, "ions").items()}
        tables = {"ions": ions}
        for name in self.schema:
            if name not in ("examples", "ions"):
                columns = self._read(shard, name)
                own = columns["example"] == row
                tables[name] = {each: values[own] for each, values in columns.items()}
        for columns in tables.values():
            columns.pop("example")
        return Example(about, **tables)

    def _read(self, shard, table):
        return dict(_cached(self.folder, shard, table, self.content["dataset"]["format"], tuple(self.schema.items())))

    def split(self, name: str) -> "DataSet":
        """The examples of one part.

        Parameters
        ----------
        name : {"train", "validation", "test"}
            The part. No specimen is in two of them.

        Returns
        -------
        DataSet
        """
        check_choice(name, "name", SPLITS)
        return DataSet(self.folder, self.content, tuple(each for each in self.shards if each["split"] == name))

    def table(self, name: str = "ions") -> dict[str, Any]:
        """Complete table of all examples.

        Parameters
        ----------
        name : str
            "examples", "ions", "poles", "zone_lines" or "cap".

        Returns
        -------
        dict
            Columns by name: arrays; texts are arrays of objects. ``example`` is the index of the example in this data
            set, and ``first_ion`` that of its first ion.
        """
        fields = self.schema[check_choice(name, "name", tuple(self.schema))]
        parts = [
            read_table(self.folder, shard["name"], name, self.schema, self.content["dataset"]["format"])
            for shard in self.shards
        ]
        ions = np.cumsum([0, *(shard["ions"] for shard in self.shards)])
        offsets = {"example": self._firsts, "first_ion": ions}
        columns = {}
        for each in fields:
            values = [part[each.name] for part in parts]
            if each.name in offsets:
                values = [part + start for part, start in zip(values, offsets[each.name], strict=False)]
            dtype = object if each.dtype == TEXT else each.dtype
            columns[each.name] = np.concatenate([np.empty((0, *each.row), dtype), *map(np.asarray, values)]).astype(
                dtype
            )
        return columns

    def frame(self, name: str = "ions") -> "pandas.DataFrame":
        """Complete table as a data frame; needs pandas.

        Parameters
        ----------
        name : str
            As for `table`.

        Returns
        -------
        pandas.DataFrame
            Columns with several values per row become name_0, name_1, ...; units in ``attrs``.
        """
        columns = {key: values.reshape(len(values), -1) if values.ndim > 2 else values
                   for key, values in self.table(name).items()}  # fmt: skip
        units = {each.name: each.unit for each in self.schema[name] if each.unit}
        return to_dataframe(columns, source=str(self.folder), units=units)

    def to_xarray(self) -> "xarray.Dataset":
        """All tables as one Dataset; needs xarray.

        Returns
        -------
        xarray.Dataset
            Variables by name of table and column, such as ``ions_x``, along ``ions``, ``examples``, ``poles``, ...
        """
        xarray: Any = optional_import("xarray", "DataSet.to_xarray")
        variables = {}
        for name, fields in self.schema.items():
            columns = self.table(name)
            for each in fields:
                values = columns[each.name]
                axes = (name, *(f"{each.name}_{axis}" for axis in range(values.ndim - 1)))
                about = {"description": each.text, **({"units": each.unit} if each.unit else {})}
                variables[f"{name}_{each.name}"] = xarray.Variable(axes, values, about)
        return xarray.Dataset(variables, attrs={"title": self.content["title"]})


@lru_cache(maxsize=8)
def _cached(folder: Path, shard: str, table: str, suffix: str, schema: Any) -> Rows:
    """A table of a file; the last ones are kept, because examples follow one another."""
    return read_table(folder, shard, table, dict(schema), suffix)


def load(path: AnyPath) -> DataSet:
    """Open a finished data set.

    Parameters
    ----------
    path : str or path-like
        Its folder.

    Returns
    -------
    DataSet

    Raises
    ------
    FileError
        If it is not a data set. `verify` compares the checksums.
    """
    folder = check_path(path)
    content = read_about(folder)
    return DataSet(folder, content, tuple(content["shards"]))
