"""HDF5 files in which every byte that is read has a checksum, so that damage is an error and never other values.

In the format of HDF5 1.10, headers, attributes and indices have checksums. Arrays are in chunks with the filter
deflate, mostly of level 0, which does not compress: its Adler-32 is compared whenever a chunk is read. Texts have a
fixed length. Those of variable length are in a heap without checksums; only NeXus needs some, which are never read.

The checksum of the filter fletcher32 does not suffice: that of zeros is zero, and a hole in a file passes for data.
"""

import io
import json
import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from importlib import import_module
from typing import Any, BinaryIO, NamedTuple

import h5py
import numpy as np
from numpy.typing import DTypeLike, NDArray

from apt_evap._common.files import FileError, check_path, open_for_reading, replace_file
from apt_evap._common.types import AnyPath

_PROGRAM = "apt_evap "
_FORMATS = {"run": 2}  # numbers of the formats of kinds of content that are not 1
_CHUNK = 1 << 20  # bytes; HDF5 keeps chunks up to this size while rows of them are read
_LEVEL = 1  # of deflate; of runs, level 6 saves 5 % more and takes three times as long
_DEFLATED = 1032  # largest ratio of deflate: 258 bytes in 2 bits (zlib.net/zlib_tech.html)
_PLUGINS = {32000: "lzf", 32001: "blosc", 32004: "lz4", 32008: "bitshuffle", 32015: "zstd", 32026: "blosc2"}
_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_FOREIGN = "data outside the file are not read"
_READ_ERRORS = (KeyError, IndexError, RuntimeError, TypeError, ValueError, AttributeError, OverflowError)


class Label(NamedTuple):
    """Label of the content of a file, in its first header."""

    kind: str
    """Kind of content, such as "run"; of another version of it "run of format 1"."""
    rows: int
    """Number of rows."""
    note: str
    """Note of the writer, such as the key of the settings."""


# ---- writing -------------------------------------------------------------------------------------------------------


class _Sink:
    """A file for HDF5, which cannot close a file if writing fails: the first error is kept and raised afterwards."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self.error = file, None

    def _do(self, method, *arguments):
        if self.error is None:
            try:
                return getattr(self._file, method)(*arguments)
            except OSError as error:
                self.error = error
        return 0

    def __getattr__(self, method):
        return partial(self._do, method)


@contextmanager
def write_hdf5(path: AnyPath, kind: str, rows: int, note: str = "") -> Iterator[h5py.File]:
    """Write an HDF5 file with checksums, which is either complete or absent."""
    with replace_file(path) as target:
        sink = _Sink(target)
        try:
            label = f"{_PROGRAM}{kind} {_FORMATS.get(kind, 1)}"
            with h5py.File(sink, "w", libver=("v110", "v110")) as file:
                for name, text in (("format", label), ("note", note)):
                    file.attrs.create(name, text.encode(), dtype=h5py.string_dtype("utf-8", max(1, len(text.encode()))))
                file.attrs["rows"] = rows
                yield file
        finally:
            if sink.error is not None:
                raise sink.error


def put_field(group: Any, name: str, values: Any, units: str | None = None, *, compress: bool = False) -> Any:
    """Write numbers or texts as a dataset, with their unit."""
    values = np.asarray(values)
    if values.ndim and values.dtype.kind in "OU":
        values = np.char.encode(values.astype(str), "utf-8")
        values = values.astype(h5py.string_dtype("utf-8", max(1, values.dtype.itemsize)))
    if values.size and values.ndim:
        row = (1,) * (values.ndim - 1) if compress else values.shape[1:]
        number = -(-len(values) * math.prod(row) * values.itemsize // _CHUNK)
        options = {"shuffle": True, "compression_opts": _LEVEL} if compress else {"compression_opts": 0}
        chunks = (-(-len(values) // number), *row)
        dataset = group.create_dataset(name, data=values, chunks=chunks, compression="gzip", **options)
    else:
        dataset = group.create_dataset(name, data=values if values.dtype.kind != "U" else str(values))
    if units:
        dataset.attrs["units"] = units
    return dataset


def put_text(group: Any, name: str, text: str) -> None:
    """Write a text as a dataset of one row."""
    put_field(group, name, [text])


# ---- reading -------------------------------------------------------------------------------------------------------


@contextmanager
def open_hdf5(path: AnyPath, what: str = "HDF5") -> "Iterator[CheckedFile]":
    """Open an HDF5 file, also one of another program, which may have no checksums."""
    name = str(check_path(path))
    with open_for_reading(path) as raw, io.BufferedReader(raw) as file:  # type: ignore[type-var]
        size = file.seek(0, io.SEEK_END)
        file.seek(0)
        if file.read(len(_SIGNATURE)) != _SIGNATURE:
            raise FileError(f"cannot read {name!r} as {what}: it is not an HDF5 file")
        with _damage(name):
            opened = h5py.File(file, "r")
        with opened:
            try:
                yield CheckedFile(opened, name, size)
            except FileError:
                raise
            except _READ_ERRORS as error:
                raise FileError(f"cannot read {name!r} as {what}: {_first_line(error)}") from error


@contextmanager
def _damage(name):
    """Turn any error of HDF5 into one sentence."""
    try:
        yield
    except Exception as error:
        raise FileError(f"{name!r} is damaged: {_first_line(error)}") from error


def _first_line(error):
    return (str(error.args[0] if error.args else "") or type(error).__name__).splitlines()[0]


def label_of(path: AnyPath) -> Label | None:
    """Kind, rows and note of a file of `write_hdf5`; None for an HDF5 file of another program."""
    with open_hdf5(path) as file:
        return file.label


def _filter_exists(number):
    """Whether HDF5 can decompress: lzf is in h5py, the others in hdf5plugin, if that is installed."""
    if not h5py.h5z.filter_avail(number):
        with suppress(ImportError):
            import_module("hdf5plugin")
    return h5py.h5z.filter_avail(number)


class CheckedFile:
    """An open HDF5 file, of which nothing is read that lies outside of it or is larger than it.

    Parameters
    ----------
    size : int
        Its size [bytes].
    """

    def __init__(self, file: h5py.File, name: str, size: int) -> None:
        self._file, self.name, self._size = file, name, size
        self._listed: dict[str, set[str]] = {}  # names in the groups that were asked for

    @property
    def label(self) -> Label | None:
        """Kind, rows and note of the content; None for a file of another program."""
        kind, rows, note = (self.attribute(name) for name in ("format", "rows", "note"))
        if not (isinstance(kind, bytes) and isinstance(rows, np.integer) and isinstance(note, bytes)):
            return None
        kind, _, number = kind.decode(errors="replace").removeprefix(_PROGRAM).rpartition(" ")
        if number != str(_FORMATS.get(kind, 1)):
            kind = f"{kind} of format {number}"
        return Label(kind, int(rows), note.decode(errors="replace"))

    def __contains__(self, path: str) -> bool:
        group, _, name = path.rpartition("/")
        return (not group or group in self) and name in self._names(self._item(group))

    def attribute(self, name: str, path: str = "") -> Any:
        """Attribute of a group or dataset; None if it is missing."""
        item = self._item(path)
        with _damage(self.name):
            return item.attrs[name] if name in item.attrs else None

    def text(self, path: str) -> str:
        """Text of a dataset of `put_text`; KeyError or ValueError if it is missing or something else."""
        values = self.read(path, None, (1,))
        if values.dtype.kind != "S":
            raise ValueError(f"{path} must be a text, got {values.dtype}")
        return values[0].decode()

    def json(self, path: str) -> Any:
        """Content of a text in JSON; otherwise as `text`."""
        return json.loads(self.text(path))

    def read(
        self,
        path: str,
        dtype: DTypeLike | None,
        shape: tuple[int | None, ...] | None,
        rows: slice = slice(None),
        *,
        compressed: bool = False,
    ) -> NDArray[Any]:
        """Check the type, the shape and the place of a dataset, and read it."""
        item = self._item(path)
        if not isinstance(item, h5py.Dataset):
            raise ValueError(f"{path} is not a dataset")
        with _damage(self.name):
            stored, dimensions, plist = item.dtype, item.shape, item.id.get_create_plist()
            chunks, layout, external = item.chunks or (), plist.get_layout(), plist.get_external_count()
            filters = {number: values for number, _, values, _ in map(plist.get_filter, range(plist.get_nfilters()))}
            n_bytes = item.id.get_storage_size()
        if dtype is not None and stored.newbyteorder("=") != np.dtype(dtype):
            raise ValueError(f"{path} must contain {np.dtype(dtype)}, got {stored}")
        if stored.hasobject:
            raise ValueError(f"{path} must contain numbers or texts of fixed length, got {stored}")
        expected = (None,) * len(dimensions or ()) if shape is None else shape
        fits = dimensions is not None and len(dimensions) == len(expected)
        if not fits or any(a != b for a, b in zip(dimensions, expected, strict=True) if b is not None):
            lengths = ", ".join("any" if length is None else str(length) for length in expected)
            raise ValueError(f"{path} must have shape ({lengths}), got {dimensions}")
        if external or layout == h5py.h5d.VIRTUAL:
            raise ValueError(f"{path} is in another file: {_FOREIGN}")
        level = filters.pop(h5py.h5z.FILTER_DEFLATE, (0,))[0]
        if compressed:
            filters.pop(h5py.h5z.FILTER_SHUFFLE, None)
        largest = _DEFLATED if compressed and (level or filters.keys() & {*_PLUGINS}) else 1
        if max(math.prod(dimensions), math.prod(chunks)) * stored.itemsize > self._size * largest:
            raise ValueError(f"{path} has shape {dimensions}, more than a file of {self._size} bytes can contain")
        others = filters.keys() - {h5py.h5z.FILTER_FLETCHER32}
        if compressed and others <= {*_PLUGINS}:
            missing = [_PLUGINS[number] for number in others if not _filter_exists(number)]
            if missing:
                raise ValueError(
                    f"{path} is compressed by {missing[0]}: install hdf5plugin to read it (pip install apt-evap[hdf5])"
                )
            others = set()
        if (level and not compressed) or others:
            raise ValueError(f"{path} is compressed or filtered: h5repack -f NONE writes a copy that is not")
        if n_bytes * largest < math.prod(dimensions) * stored.itemsize:
            raise ValueError(f"{path} is incomplete")
        with _damage(self.name):
            return item[rows] if dimensions else item[()]

    def _names(self, item):
        """Names in a group; HDF5 takes a name that it cannot look up for one that is missing."""
        with _damage(self.name):
            if item.name not in self._listed:
                self._listed[item.name] = set(item) if isinstance(item, h5py.Group) else set()
            return self._listed[item.name]

    def _item(self, path):
        item = self._file
        for part in filter(None, path.split("/")):
            if part not in self._names(item):
                raise KeyError(f"{path} is missing")
            with _damage(self.name):
                link = item.get(part, getlink=True)
            if not isinstance(link, h5py.HardLink):
                raise ValueError(f"{path} is a link: {_FOREIGN}")
            with _damage(self.name):
                item = item[part]
        return item
