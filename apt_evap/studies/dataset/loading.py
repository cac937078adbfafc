"""Reading of a data set: examples one by one, or complete tables as arrays, data frames or an xarray Dataset."""

import json
import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.files import FileError, check_path
from apt_evap._common.notebook import as_table
from apt_evap._common.optional_imports import optional_import
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_choice
from apt_evap.detection.dataframe import to_dataframe
from apt_evap.detection.hits import Hits
from apt_evap.detection.instrument import Instrument
from apt_evap.studies.dataset.dataset_examples import Rows
from apt_evap.studies.dataset.dataset_settings import SPLITS, read_instrument
from apt_evap.studies.dataset.fields import TEXT, chosen_tables
from apt_evap.studies.dataset.set_description import check_sha256, read_finished
from apt_evap.studies.dataset.shards import Schema, file_names, read_table

if TYPE_CHECKING:
    import pandas
    import xarray

_JSON = {"elements": list, "phases": list, "emission": dict, "instrument": dict, "settings": dict}
_KEPT = 8  # tables


@dataclass(frozen=True, repr=False)
class Example:
    """An example of a data set: what an instrument records of a run for one emission, and the truth."""

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
        columns |= {name: self.ions[stored] for name, stored in other.items() if stored in self.ions}
        extra = {name: self.ions[name] for name in ("species", "phase", "charge") if name in self.ions}
        half = self.instrument.field_of_view / 2
        return Hits(**columns, extra=extra, source=self.about["name"], extent=(-half, half, -half, half))


class _Files:
    """The files of a data set. Each is read only if its SHA-256 is that of ``dataset.json``.

    The last tables are kept, because examples follow one another. They are given as copies.
    """

    def __init__(self, folder: Path, content: dict[str, Any]) -> None:
        self.folder, self.content = folder, content
        self.suffix = content["dataset"]["format"]
        self.schema: Schema = chosen_tables(tuple(content["dataset"]["fields"]))
        self._shards = {shard["name"]: shard for shard in content["shards"]}
        self._compared: dict[str, tuple[int, ...]] = {}  # state of each file when its SHA-256 was compared
        self._kept: dict[tuple[str, str], Rows] = {}

    def __reduce__(self):  # without what is kept: in another process, files are compared again
        return _Files, (self.folder, self.content)

    def rows(self, name: str, table: str, rows: Any) -> Rows:
        """Rows of a table of a shard: a slice, or the function of its columns that selects them."""
        shard = self._shards[name]
        self._compare(shard, table)
        if self.suffix == "hdf5" and isinstance(rows, slice):
            return read_table(self.folder, name, table, self.schema, self.suffix, rows)
        key = name, table
        if key not in self._kept:
            columns = self._complete(shard, table)
            while len(self._kept) >= _KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[key] = columns
        columns = self._kept[key]
        chosen = rows if isinstance(rows, slice) else rows(columns)
        return {
            column: values[chosen].copy() if isinstance(values, np.ndarray) else values[chosen]
            for column, values in columns.items()
        }

    def table(self, name: str, table: str) -> Rows:
        """Complete table of a shard."""
        self._compare(self._shards[name], table)
        return self._complete(self._shards[name], table)

    def _complete(self, shard, table):
        """Complete table of a shard with as many rows as its description says; they are numbered in it."""
        columns = read_table(self.folder, shard["name"], table, self.schema, self.suffix)
        n = len(next(iter(columns.values())))
        good = n == shard.get(table, n)
        if table == "examples":
            ions = columns["ions"]
            good = good and np.array_equal(columns["first_ion"], np.cumsum(ions) - ions) and ions.sum() == shard["ions"]
        else:
            number = columns["example"].astype(np.int64)
            good = good and np.all(np.diff(number) >= 0) and np.all(number < shard["examples"])
        if not good:
            raise FileError(f"{str(self._path(shard, table))!r} has other rows of {table} than its description says")
        return columns

    def _path(self, shard, table):
        return self.folder / file_names(shard["name"], self.schema, self.suffix)[table]

    def _compare(self, shard, table):
        """Compare the SHA-256 of a file, unless it is unchanged since the last time."""
        path = self._path(shard, table)
        try:
            status = os.stat(path)
        except OSError as error:
            raise FileError(f"cannot read {str(path)!r}: {error.strerror}") from error
        state = status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns
        if self._compared.get(path.name) != state:
            check_sha256(path, shard["files"][path.name], "that of the data set which was opened")
            self._compared[path.name] = state


class DataSet:
    """A data set in a folder: a sequence of its examples, which are read when they are used.

    Parameters
    ----------
    shards : tuple of dict
        The files whose examples it contains, of ``content["shards"]``.
    """

    def __init__(self, folder: Path, content: dict[str, Any], shards: tuple[dict[str, Any], ...]) -> None:
        self.folder, self.content, self.shards = folder, content, shards
        self._files = _Files(folder, content)

    def __repr__(self) -> str:
        return f"<DataSet: {len(self):,} examples of {sum(shard['runs'] for shard in self.shards):,} runs>"

    _repr_html_ = as_table

    def notebook_contents(self) -> dict[str, Any]:
        """Table that a notebook shows: folder, examples, runs, and the fields of each table, dict."""
        fields = {name: [column.name for column in columns] for name, columns in self.schema.items()}
        runs = sum(shard["runs"] for shard in self.shards)
        return {"folder": str(self.folder), "examples": len(self), "runs": runs, "fields": fields}

    @property
    def schema(self) -> Schema:
        """Fields by table, dict."""
        return self._files.schema

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
        read = self._files.rows
        about = {name: values[0] for name, values in read(shard, "examples", lambda _: slice(row, row + 1)).items()}
        about = {name: value.item() if isinstance(value, np.generic) else value for name, value in about.items()}
        about |= {name: self._decoded(shard, name, about[name]) for name in _JSON}
        first = about.pop("first_ion")
        tables = {"ions": read(shard, "ions", slice(first, first + about["ions"]))}
        if not np.array_equal(tables["ions"]["example"], np.full(about["ions"], row)):
            raise FileError(f"{str(self.folder)!r}: the ions of an example of {shard} must be those that it counts")
        for name in self.schema:
            if name not in ("examples", "ions"):
                tables[name] = read(shard, name, lambda columns: columns["example"] == row)
        for columns in tables.values():
            columns.pop("example")
        return Example(about, **tables)

    def _decoded(self, shard, name, text):
        """Content of a text in JSON of an example."""
        with suppress(ValueError, RecursionError):
            if isinstance(content := json.loads(text), _JSON[name]):
                return content
        raise FileError(
            f"{str(self.folder)!r}: {name} of an example of {shard} must be a {_JSON[name].__name__} in JSON"
        )

    def split(self, name: str) -> "DataSet":
        """The examples of one part."""
        check_choice(name, "name", SPLITS)
        part = DataSet(self.folder, self.content, tuple(shard for shard in self.shards if shard["split"] == name))
        part._files = self._files  # and what it has compared
        return part

    def table(self, name: str = "ions") -> dict[str, Any]:
        """Complete table of all examples."""
        fields = self.schema[check_choice(name, "name", tuple(self.schema))]
        parts = [self._files.table(shard["name"], name) for shard in self.shards]
        ions = np.cumsum([0, *(shard["ions"] for shard in self.shards)])
        offsets = {"example": self._firsts, "first_ion": ions}
        columns = {}
        for column in fields:
            values = [part[column.name] for part in parts]
            if column.name in offsets:
                values = [part + start for part, start in zip(values, offsets[column.name], strict=False)]
            dtype = object if column.dtype == TEXT else column.dtype
            columns[column.name] = np.concatenate([np.empty((0, *column.row), dtype), *map(np.asarray, values)]).astype(
                dtype
            )
        return columns

    def frame(self, name: str = "ions") -> "pandas.DataFrame":
        """Complete table as a data frame; needs pandas."""
        columns = {key: values.reshape(len(values), -1) if values.ndim > 2 else values
                   for key, values in self.table(name).items()}  # fmt: skip
        units = {column.name: column.unit for column in self.schema[name] if column.unit}
        return to_dataframe(columns, source=str(self.folder), units=units)

    def to_xarray(self) -> "xarray.Dataset":
        """All tables as one Dataset; needs xarray."""
        xarray: Any = optional_import("xarray", "DataSet.to_xarray")
        variables = {}
        for name, fields in self.schema.items():
            columns = self.table(name)
            for column in fields:
                values = columns[column.name]
                axes = (name, *(f"{column.name}_{axis}" for axis in range(values.ndim - 1)))
                about = {"description": column.text, **({"units": column.unit} if column.unit else {})}
                variables[f"{name}_{column.name}"] = xarray.Variable(axes, values, about)
        return xarray.Dataset(variables, attrs={"title": self.content["title"]})


def load_dataset(path: AnyPath) -> DataSet:
    r"""Open a finished data set.

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
        If it is not a finished data set. `verify_dataset` compares the checksums of all files. When a file is
        read, its checksum is compared.

    Examples
    --------
    >>> from pathlib import Path
    >>> tip, ions = 'material = "Al"\napex_radius = "5 a"\nshank_length = "5 a"', "ions = 60"
    >>> _ = Path("base.toml").write_text(f"[tip]\n{tip}\n[simulation]\n{ions}\n")
    >>> study = 'base = "base.toml"\nsample = 1\n[sweep]\n"tip.axis" = "random"\n'
    >>> _ = Path("study.toml").write_text(f'{study}[dataset]\nemissions = ["RollUp:0.02"]\n')
    >>> _ = ae.studies.make_dataset(ae.studies.plan_dataset("study.toml"), "set")
    >>> data = ae.load_dataset("set")
    >>> data[0].about["material"], data[0].ions["site"].shape[1]
    ('Al', 3)
    """
    folder = check_path(path).absolute()
    content = read_finished(folder)
    return DataSet(folder, content, tuple(content["shards"]))
