"""Files of a data set: the tables of the examples of some runs, as HDF5 or Parquet, with the same bytes each time."""

from pathlib import Path
from typing import Any

import numpy as np

from apt_evap._common.checked_hdf5 import open_hdf5, put_field, write_hdf5
from apt_evap._common.files import FileError, open_for_reading, replace_file
from apt_evap._common.optional_imports import optional_import
from apt_evap.studies.dataset.dataset_examples import Rows, typed
from apt_evap.studies.dataset.fields import TEXT, Field

Schema = dict[str, tuple[Field, ...]]
_KIND = "dataset"
_ROWS = 1 << 20  # of a group of rows in a Parquet file: fixed, because it determines the bytes


def file_names(name: str, schema: Schema, suffix: str) -> dict[str, str]:
    """Names of the files of a shard by table; HDF5 has all tables in one file."""
    return {table: f"{name}.h5" if suffix == "hdf5" else f"{name}.{table}.parquet" for table in schema}


def write_shard(folder: Path, name: str, tables: dict[str, Rows], schema: Schema, suffix: str) -> None:
    """Write the tables of a shard; each file is complete or absent."""
    names = file_names(name, schema, suffix)
    if suffix == "hdf5":
        with write_hdf5(folder / names["ions"], _KIND, len(tables["examples"]["ions"])) as file:
            for table, fields in schema.items():
                for field in fields:
                    values = tables[table][field.name]
                    values = np.array(values, object) if field.dtype == TEXT else values
                    dataset = put_field(file, f"{table}/{field.name}", values, field.unit)
                    dataset.attrs["description"] = field.text
        return
    parquet = optional_import("pyarrow.parquet", "a data set in Parquet")
    for table, fields in schema.items():
        with replace_file(folder / names[table]) as file:
            parquet.write_table(
                _arrow(tables[table], fields), file, row_group_size=_ROWS, compression="zstd", version="2.6"
            )


def _arrow(columns, fields):
    pyarrow: Any = optional_import("pyarrow", "a data set in Parquet")
    arrays, kinds = [], []
    for field in fields:
        kind, values = _arrow_type(field), columns[field.name]
        if field.row:
            array = pyarrow.array(np.ascontiguousarray(values).reshape(-1), kind.value_type)
            array = pyarrow.FixedSizeListArray.from_arrays(array, kind.list_size)
        else:
            array = pyarrow.array(values, kind)
        arrays.append(array.cast(kind))
        about = {"description": field.text, "units": field.unit}
        kinds.append(pyarrow.field(field.name, kind, nullable=False, metadata=about))
    return pyarrow.Table.from_arrays(arrays, schema=pyarrow.schema(kinds))


def _arrow_type(field):
    pyarrow: Any = optional_import("pyarrow", "a data set in Parquet")
    kind = pyarrow.string() if field.dtype == TEXT else pyarrow.from_numpy_dtype(field.dtype)
    return pyarrow.list_(kind, int(np.prod(field.row))) if field.row else kind


def read_table(folder: Path, name: str, table: str, schema: Schema, suffix: str, rows: slice = slice(None)) -> Rows:
    """Read rows of a table of a shard."""
    path = folder / file_names(name, schema, suffix)[table]
    try:
        columns = (_from_hdf5 if suffix == "hdf5" else _from_parquet)(path, table, schema[table], rows)
        lengths = {len(values) for values in columns.values()}
        if len(lengths) > 1:
            raise ValueError(f"{table} must have columns of one length, got {sorted(lengths)}")
    except FileError:
        raise
    except (OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
        raise FileError(f"cannot read {str(path)!r}: {str(error).partition(chr(10))[0] or repr(error)}") from error
    return columns


def _from_hdf5(path, table, fields, rows):
    with open_hdf5(path, "a data set") as file:
        return {field.name: _taken(file, f"{table}/{field.name}", field, rows) for field in fields}


def _taken(file, path, field, rows):
    """Rows of a dataset within the file, of the type of its field."""
    is_text = field.dtype == TEXT
    values = file.read(path, None if is_text else field.dtype, (None, *field.row), rows)
    if not is_text:
        return values
    if values.dtype.kind != "S":
        raise ValueError(f"{path} must contain texts, got {values.dtype}")
    return [text.decode() for text in values.tolist()]


def _from_parquet(path, table, fields, rows):
    parquet = optional_import("pyarrow.parquet", "a data set in Parquet")
    with open_for_reading(path) as opened:
        content = parquet.read_table(opened)
    for field in fields:
        kind = content.schema.field(field.name).type
        if kind != _arrow_type(field):
            raise ValueError(f"{table}.{field.name} must contain {_arrow_type(field)}, got {kind}")
    return {field.name: _plain(content[field.name], field)[rows] for field in fields}


def _plain(column, field):
    if field.dtype == TEXT:
        return column.to_pylist()
    values = column.combine_chunks()
    values = values.flatten() if field.row else values
    return typed(values.to_numpy(zero_copy_only=False), field)
