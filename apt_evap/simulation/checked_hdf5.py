"""HDF5 files with checksums of all bytes, compared before HDF5 reads any of them.

HDF5 trusts its own indices: one wrong bit there may turn a column into zeros, displace it, or crash the process. The
checksums are appended to the HDF5 file, where HDF5 and other programs ignore them::

    HDF5 file | begin, size and CRC-32 of each block of rows | SHA-256 of all other bytes, sizes, signature

The SHA-256 covers all bytes that HDF5 interprets, and the CRC-32s of the rows. For the rows, CRC-32 is used because it
is fast: measured for a file of 87 MB, whose arrays are written in 0.16 s and read in 0.08 s, CRC-32 takes 0.05 s and
SHA-256 0.09 s. Files of earlier versions have only the fletcher32 checksums of HDF5. They are read after the place of
each dataset in the file has been checked.
"""

import hashlib
import io
import math
import os
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, BinaryIO

import h5py
import numpy as np
from numpy.typing import DTypeLike, NDArray

from apt_evap._common.files import FileError, check_path, open_for_reading, replace_file
from apt_evap._common.types import AnyPath

_BLOCK = np.dtype([("begin", "<u8"), ("size", "<u8"), ("crc", "<u4")])
_TAIL = struct.Struct("<32sQQ16s")  # SHA-256, size of the HDF5 file, number of blocks, signature
_SIGNATURE = b"apt_evap sums 1\n"
_NAME, _TEXT = "checksums", b"apt_evap: checksums of all bytes follow the HDF5 file"
_BEGINNING = 1 << 16  # bytes that contain the first attribute
_STEP = 1 << 18  # bytes read at a time
_FOREIGN = "data outside the file are not read"


# ---- writing -------------------------------------------------------------------------------------------------------


class _Sink(io.RawIOBase):
    """A file for HDF5, which crashes if writing fails: the first error is stored, to be raised after closing."""

    def __init__(self, file: BinaryIO) -> None:
        self._file: Any = file
        self._place, self._end = 0, 0
        self.error: OSError | None = None

    def _do(self, method, *arguments):
        if self.error is None:
            try:
                getattr(self._file, method)(*arguments)
            except OSError as error:
                self.error = error

    def seek(self, offset: int, whence: int = 0) -> int:
        self._place = offset + (0, self._place, self._end)[whence]
        self._do("seek", self._place)
        return self._place

    def tell(self) -> int:
        return self._place

    def write(self, data: Any) -> int:
        self._do("write", data)
        self._place += len(data)
        self._end = max(self._end, self._place)
        return len(data)

    def readinto(self, buffer: Any) -> int:
        """Read what was written, which HDF5 needs for texts of variable length; zeros after an error."""
        view = memoryview(buffer).cast("B")
        view[:] = bytes(len(view))
        try:
            if self.error is None:
                self._file.flush()
                self._file.readinto(view)
        except OSError as error:
            self.error = error
        self._place += len(view)
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        self._do("truncate", size)
        self._end = self._place if size is None else size
        return self._end

    def flush(self) -> None:
        self._do("flush")


@contextmanager
def write_checked(path: AnyPath, rows: int) -> Iterator[h5py.File]:
    """Write an HDF5 file with checksums, which is either complete or absent.

    Parameters
    ----------
    path : str or path-like
        The file to write or overwrite.
    rows : int
        Rows of a dataset with a common checksum. Any damage to them loses all of them.

    Yields
    ------
    h5py.File

    Raises
    ------
    FileError
        If it cannot be written.
    """
    with replace_file(path) as target:
        sink = _Sink(target)
        blocks = np.empty(0, _BLOCK)
        try:
            with h5py.File(sink, "w") as file:
                file.attrs[_NAME] = np.bytes_(_TEXT)
                yield file
                blocks = _blocks_of(file, rows)
        finally:
            if sink.error is not None:
                raise sink.error
        _append_sums(target, blocks)


def _append_sums(file, blocks):
    """Append the checksums of an HDF5 file, given the blocks of its rows."""
    size = file.seek(0, os.SEEK_END)
    outside, blocks["crc"] = _sums(file, size, blocks)
    table, sizes = blocks.tobytes(), _sizes(size, len(blocks))
    outside.update(table + sizes)
    file.seek(size)
    file.write(table + outside.digest() + sizes)


def _sizes(size, n):
    """The bytes after the SHA-256 at the end of a file."""
    return _TAIL.pack(b"", size, n, _SIGNATURE)[hashlib.sha256().digest_size :]


def _blocks_of(file, rows):
    """Blocks of at most `rows` rows of all datasets, in the order of the file."""
    blocks = []

    def note(name, item):
        if isinstance(item, h5py.Dataset) and item.shape and item.id.get_offset() is not None:
            begin, width = item.id.get_offset(), item.nbytes // len(item)
            for row in range(0, len(item), rows):
                blocks.append((begin + row * width, min(rows, len(item) - row) * width, 0))

    file.visititems(note)
    return np.array(sorted(blocks), _BLOCK)


def _sums(file, size, blocks, with_data=True):
    """SHA-256 (not digested yet) of the bytes outside of the blocks, and the CRC-32 of each block."""
    outside, crcs, place = hashlib.sha256(), [], 0
    buffer = memoryview(bytearray(_STEP))

    def pieces(begin, end):
        file.seek(begin)
        while begin < end:
            n = file.readinto(buffer[: min(_STEP, end - begin)])
            if not n:
                raise OSError(None, "the file became shorter while it was read")
            yield buffer[:n]
            begin += n

    for begin, length in zip(blocks["begin"].tolist(), blocks["size"].tolist(), strict=True):
        for piece in pieces(place, begin):
            outside.update(piece)
        place, crc = begin + length, 0
        if with_data:
            for piece in pieces(begin, place):
                crc = zlib.crc32(piece, crc)
        crcs.append(crc)
    for piece in pieces(place, size):
        outside.update(piece)
    return outside, np.array(crcs, "<u4")


# ---- reading -------------------------------------------------------------------------------------------------------


@contextmanager
def open_checked(path: AnyPath, *, with_data: bool = True, partial: bool = False) -> "Iterator[CheckedFile]":
    """Compare the checksums of an HDF5 file and open it; files of earlier versions have no checksums.

    Parameters
    ----------
    path : str or path-like
        The file.
    with_data : bool
        Whether to compare also the checksums of the rows; otherwise only that of the bytes that HDF5 interprets.
    partial : bool
        Whether to accept a file with damaged rows.

    Yields
    ------
    CheckedFile

    Raises
    ------
    FileError
        If the file is missing, unreadable, damaged or not HDF5.
    """
    name = str(check_path(path))
    with open_for_reading(path) as file:
        size = os.fstat(file.fileno()).st_size
        damaged = _compare(file, size, name, with_data)
        if damaged is not None and len(damaged) and not partial:
            raise DamagedRows(f"{name!r} is damaged: its checksum does not match")
    try:
        opened = h5py.File(name, "r", locking=False)
    except (OSError, RuntimeError, ValueError) as error:
        raise FileError(f"cannot read {name!r} as HDF5: {first_line(error)}") from error
    with opened:
        if damaged is None and _NAME in opened.attrs:
            raise _without_checksums(name)
        yield CheckedFile(opened, size, damaged)


def first_line(error: Exception) -> str:
    """First line of an error message of HDF5, without its stack."""
    return (str(error) or type(error).__name__).splitlines()[0]


class DamagedRows(FileError):
    """Error for a file in which only rows of datasets are damaged."""


def has_checksums(path: AnyPath) -> bool:
    """Whether a file ends like those of `write_checked`; FileError if it cannot be read."""
    with open_for_reading(path) as file:
        return _tail(file, os.fstat(file.fileno()).st_size) is not None


def _tail(file, size):
    """Digest, size of the HDF5 file and number of blocks; None if there are no checksums."""
    if size < _TAIL.size:
        return None
    file.seek(size - _TAIL.size)
    *numbers, signature = _TAIL.unpack(file.read(_TAIL.size))
    return numbers if signature == _SIGNATURE else None


def _compare(file, size, name, with_data):
    """Begin and end of the blocks whose checksums do not match, (k, 2); None for a file without checksums."""
    tail = _tail(file, size)
    if tail is None:
        file.seek(0)
        if _TEXT in file.read(_BEGINNING):
            raise _without_checksums(name)
        return None
    digest, inner, n = tail
    wrong = FileError(f"{name!r} is damaged: its checksum does not match")
    if inner + n * _BLOCK.itemsize + _TAIL.size != size:
        raise wrong
    file.seek(inner)
    table = file.read(n * _BLOCK.itemsize)
    blocks = np.frombuffer(table, _BLOCK)
    begins, ends = blocks["begin"], blocks["begin"] + blocks["size"]
    if n and not ((begins <= ends).all() and (ends[:-1] <= begins[1:]).all() and ends[-1] <= inner):
        raise wrong
    outside, crcs = _sums(file, inner, blocks, with_data)
    outside.update(table + _sizes(inner, n))
    if outside.digest() != digest:
        raise wrong
    bad = crcs != blocks["crc"] if with_data else np.zeros(n, bool)
    return np.stack([begins[bad], ends[bad]], axis=1).astype(np.int64)


def _without_checksums(name):
    return FileError(f"{name!r} is damaged, or was changed by another program: its checksum is missing")


class CheckedFile:
    """An open HDF5 file. Only datasets with a valid place in the file are read.

    Parameters
    ----------
    file : h5py.File
        Open for reading.
    size : int
        Size of the file [bytes].
    damaged : ndarray of int64, shape (k, 2), or None
        Begin and end of the damaged rows; None for a file without checksums.
    """

    def __init__(self, file: h5py.File, size: int, damaged: NDArray[np.int64] | None) -> None:
        self._file, self._size, self._damaged = file, size, damaged

    @property
    def name(self) -> str:
        """Name of the file."""
        return self._file.filename

    @property
    def is_damaged(self) -> bool:
        """Whether checksums of rows do not match."""
        return self._damaged is not None and len(self._damaged) > 0

    def __contains__(self, path: str) -> bool:
        group, _, name = path.rpartition("/")
        return (not group or group in self) and name in self._item(group)

    def attributes(self, path: str = "") -> Any:
        """Attributes of a group or dataset, mapping."""
        return self._item(path).attrs

    def text(self, name: str, path: str = "") -> str:
        """Text attribute of a group or dataset; KeyError if it is missing, ValueError if it is not a text."""
        value = self.attributes(path)[name]
        if isinstance(value, bytes):
            value = value.decode()
        if not isinstance(value, str):
            raise ValueError(f"attribute {name!r} must be a text, got {value!r:.60}")
        return value

    def dataset(self, path: str, dtype: DTypeLike | None, shape: tuple[int | None, ...] | None) -> h5py.Dataset:
        """Check the type, the shape and the place of a dataset, and return it.

        Parameters
        ----------
        path : str
            Name of the dataset, with the names of its groups.
        dtype : dtype or None
            Expected type; None for any.
        shape : tuple or None
            Expected shape; None stands for any length, or for any shape.

        Returns
        -------
        h5py.Dataset

        Raises
        ------
        KeyError, ValueError
            If it is missing or not as expected.
        """
        item = self._item(path)
        if not isinstance(item, h5py.Dataset):
            raise ValueError(f"{path} is not a dataset")
        if dtype is not None and item.dtype.newbyteorder("=") != np.dtype(dtype):
            raise ValueError(f"{path} must contain {np.dtype(dtype)}, got {item.dtype}")
        shape = (None,) * len(item.shape or ()) if shape is None else shape
        fits = item.shape is not None and len(item.shape) == len(shape)
        if not fits or any(a != b for a, b in zip(item.shape, shape, strict=True) if b is not None):
            expected = ", ".join("any" if length is None else str(length) for length in shape)
            raise ValueError(f"{path} must have shape ({expected}), got {item.shape}")
        if math.prod(item.shape) * item.dtype.itemsize > self._size:  # nothing is compressed
            raise ValueError(f"{path} has shape {item.shape}, more than the {self._size} bytes of the file")
        if item.size:
            self._check_place(item, path)
        return item

    def rows(self, dataset: h5py.Dataset, begin: int = 0, end: int | None = None) -> NDArray[Any]:
        """Read rows of a dataset; OSError if they are damaged."""
        end = len(dataset) if end is None else end
        offset = dataset.id.get_offset()
        if self._damaged is not None and offset is not None and begin < end:
            width = dataset.nbytes // len(dataset)
            first, last = offset + begin * width, offset + end * width
            if ((self._damaged[:, 0] < last) & (self._damaged[:, 1] > first)).any():
                raise OSError(f"rows {begin} to {end} of {dataset.name} are damaged")
        return dataset[begin:end]

    def read(self, path: str, dtype: DTypeLike, shape: tuple[int | None, ...]) -> NDArray[Any]:
        """Read a complete dataset: `dataset` and `rows`."""
        return self.rows(self.dataset(path, dtype, shape))

    def _item(self, path):
        item = self._file
        for part in filter(None, path.split("/")):
            if not isinstance(item, h5py.Group):
                raise KeyError(f"{item.name} is not a group")
            link = item.get(part, getlink=True)
            if link is None:
                raise KeyError(f"{path} is missing")
            if not isinstance(link, h5py.HardLink):
                raise ValueError(f"{path} is a link: {_FOREIGN}")
            item = item[part]
        return item

    def _check_place(self, dataset, path):
        """Check that a dataset lies completely in this file, in a layout that this package writes."""
        plist = dataset.id.get_create_plist()
        layout = plist.get_layout()
        if plist.get_external_count() or layout == h5py.h5d.VIRTUAL:
            raise ValueError(f"{path} is in another file: {_FOREIGN}")
        if layout == h5py.h5d.CONTIGUOUS:
            begin = dataset.id.get_offset()
            complete = begin is not None and begin + dataset.nbytes <= self._size
        elif layout == h5py.h5d.CHUNKED:
            complete = self._has_all_chunks(dataset, plist)
        else:
            complete = layout == h5py.h5d.COMPACT
        if not complete:
            raise ValueError(f"{path} is incomplete")

    def _has_all_chunks(self, dataset, plist):
        filters = [plist.get_filter(k)[0] for k in range(plist.get_nfilters())]
        if filters not in ([], [h5py.h5z.FILTER_FLETCHER32]):
            raise ValueError(f"{dataset.name} is compressed or filtered: h5repack -f NONE writes a copy that is not")
        chunks = dataset.chunks
        size = math.prod(chunks) * dataset.dtype.itemsize + 4 * len(filters)
        if size > self._size:
            return False
        counts = [-(-n // length) for n, length in zip(dataset.shape, chunks, strict=True)]
        if dataset.id.get_num_chunks() != math.prod(counts):
            return False
        expected = {
            tuple(int(step) * length for step, length in zip(index, chunks, strict=True))
            for index in np.ndindex(*counts)
        }
        for k in range(len(expected)):
            chunk = dataset.id.get_chunk_info(k)
            inside = chunk.size == size and chunk.byte_offset + chunk.size <= self._size
            if not inside or chunk.filter_mask or chunk.chunk_offset not in expected:
                return False
            expected.discard(chunk.chunk_offset)
        return True
