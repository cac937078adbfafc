"""Files of a data set: the tables of the examples of some runs, as HDF5 or Parquet, with the same bytes each time."""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from apt_evap._common.files import FileError, open_for_reading, replace_file
from apt_evap._common.optional_imports import optional_import
from apt_evap.dataset.examples import Rows, typed
from apt_evap.dataset.fields import TEXT, Field
from apt_evap.storage.checked_hdf5 import label_of, open_hdf5, put_field, write_hdf5

Schema = dict[str, tuple[Field, ...]]
_KIND = "dataset"
_KEY = b"apt_evap key"  # in the metadata of a Parquet file
_ROWS = 1 << 20  # of a group of rows in a Parquet file: fixed, because it determines the bytes


def key_of_shard(content: Any) -> str:
    """Key of a file: the first 32 digits of the SHA-256 of what determines its content, in plain types."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:32]


def file_names(name: str, schema: Schema, suffix: str) -> dict[str, str]:
    """Names of the files of a shard by table; HDF5 has all tables in one file."""
    return {table: f"{name}.h5" if suffix == "hdf5" else f"{name}.{table}.parquet" for table in schema}


def write_shard(folder: Path, name: str, tables: dict[str, Rows], schema: Schema, suffix: str, key: str) -> None:
    """Write the tables of a shard; each file is complete or absent.

    Parameters
    ----------
    folder : Path
        Where.
    name : str
        Name of the shard, such as "train-0000".
    tables : dict
        Columns by table and name.
    schema : dict
        Fields by table.
    suffix : {"hdf5", "parquet"}
        Format.
    key : str
        Of `key_of_shard`.
    """
    names = file_names(name, schema, suffix)
    if suffix == "hdf5":
        with write_hdf5(folder / names["ions"], _KIND, len(tables["examples"]["ions"]), key) as file:
            for table, fields in schema.items():
                for field in fields:
                    values = tables[table][field.name]
                    values = np.array(values, object) if field.dtype == TEXT else values
                    dataset = put_field(file, f"{table}/{field.name}", values, field.unit)
                    dataset.attrs["description"] = field.text
        return
    parquet = optional_import("pyarrow.parquet", "a data set in Parquet")
    for table, fields in schema.items():
        content = _arrow(tables[table], fields).replace_schema_metadata({_KEY: key.encode()})
        with replace_file(folder / names[table]) as file:
            parquet.write_table(content, file, row_group_size=_ROWS, compression="zstd", version="2.6")


def _arrow(columns, fields):
    pyarrow: Any = optional_import("pyarrow", "a data set in Parquet")
    arrays, kinds = [], []
    for field in fields:
        kind = pyarrow.string() if field.dtype == TEXT else pyarrow.from_numpy_dtype(field.dtype)
        values = columns[field.name]
        if field.row:
            array, size = pyarrow.array(np.ascontiguousarray(values).reshape(-1), kind), int(np.prod(field.row))
            array, kind = pyarrow.FixedSizeListArray.from_arrays(array, size), pyarrow.list_(kind, size)
        else:
            array = pyarrow.array(values, kind)
        arrays.append(array)
        about = {"description": field.text, "units": field.unit}
        kinds.append(pyarrow.field(field.name, kind, nullable=False, metadata=about))
    arrays = [array.cast(kind.type) for array, kind in zip(arrays, kinds, strict=True)]
    return pyarrow.Table.from_arrays(arrays, schema=pyarrow.schema(kinds))


def key_in(folder: Path, name: str, schema: Schema, suffix: str) -> str | None:
    """Key of the shard with this name; None if it is missing or incomplete."""
    keys = set()
    for file in set(file_names(name, schema, suffix).values()):
        path = folder / file
        if not path.exists():
            return None
        try:
            if suffix == "hdf5":
                label = label_of(path)
                keys.add(label.note if label is not None and label.kind == _KIND else None)
            else:
                parquet = optional_import("pyarrow.parquet", "a data set in Parquet")
                with open_for_reading(path) as opened:
                    keys.add((parquet.read_schema(opened).metadata or {}).get(_KEY, b"").decode())
        except (ValueError, OSError):
            return None
    return keys.pop() if len(keys) == 1 else None


def read_table(folder: Path, name: str, table: str, schema: Schema, suffix: str, rows: slice = slice(None)) -> Rows:
    """Read rows of a table of a shard.

    Parameters
    ----------
    folder, name, schema, suffix
        As for `write_shard`.
    table : str
        Name of the table.
    rows : slice
        Rows to read.

    Returns
    -------
    dict
        Columns by name.

    Raises
    ------
    FileError
        If a file is missing or damaged.
    """
    path = folder / file_names(name, schema, suffix)[table]
    try:
        if suffix == "hdf5":
            with open_hdf5(path, "a data set") as file:
                return {field.name: _taken(file, f"{table}/{field.name}", field, rows) for field in schema[table]}
        parquet = optional_import("pyarrow.parquet", "a data set in Parquet")
        with open_for_reading(path) as opened:
            content = parquet.read_table(opened)
        return {field.name: _plain(content[field.name], field)[rows] for field in schema[table]}
    except (OSError, KeyError) as error:
        raise FileError(
            f"cannot read {str(path)!r}: {str(error).splitlines()[0] if str(error) else error!r}"
        ) from error


def _taken(file, path, field, rows):
    values = file.read(path, None if field.dtype == TEXT else field.dtype, (None, *field.row), rows)
    return [text.decode() for text in values.tolist()] if field.dtype == TEXT else values


def _plain(column, field):
    if field.dtype == TEXT:
        return column.to_pylist()
    values = column.combine_chunks()
    values = values.flatten() if field.row else values
    return typed(values.to_numpy(zero_copy_only=False), field)
