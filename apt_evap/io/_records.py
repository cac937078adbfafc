"""Headerless files with rows of 4-byte words: common functions of .pos, .epos and .raw."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.files import FileError, TruncatedFile, open_for_reading, replace_file
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_choice, check_switch, short_text
from apt_evap.detection.hits import Hits, Outcome
from apt_evap.io._texts import foreign
from apt_evap.warnings import DataWarning, warn

MM = {"mm": 1.0, "cm": 10.0, "m": 1e3, "um": 1e-3}
"""Units of lengths on a detector [mm]."""
_CHUNK = 1 << 14
_SURVEY = 1 << 16
_ORDERS = {"big": ">", "little": "<"}


class Words:
    """The rows of an open file: `n` complete rows; `cut` if the file ends in the middle of a further row."""

    def __init__(self, file: BinaryIO, path: AnyPath, words: int, order: str, n: int, cut: bool) -> None:
        self.n = n
        self.cut = cut
        self._file, self._path, self._words, self._order = file, path, words, order

    def read(
        self, fields: Mapping[str, tuple[int, int, str]], start: int = 0, stop: int | None = None
    ) -> dict[str, NDArray[Any]]:
        """Read columns through a small buffer into arrays of native byte order.

        Parameters
        ----------
        fields : dict
            First word, number of words and type ("f4" or "u4") of each column, by name.
        start, stop : int
            Range of rows; all by default.

        Returns
        -------
        dict of ndarray
            Shape (rows,), or (rows, words) for columns of several words.

        Raises
        ------
        TruncatedFile
            If the file has become shorter since it was opened.
        """
        stop = self.n if stop is None else stop
        n = stop - start
        columns = {name: np.empty((n, count) if count > 1 else n, dtype) for name, (_, count, dtype) in fields.items()}
        buffer = np.empty((min(n, _CHUNK), self._words), self._order + "u4")
        self._file.seek(start * 4 * self._words)
        for at in range(0, n, _CHUNK):
            rows = buffer[: min(_CHUNK, n - at)]
            if fill(self._file, rows) < rows.nbytes:
                raise TruncatedFile(f"{str(self._path)!r} became shorter during reading, expected {stop} ions")
            for name, (first, count, dtype) in fields.items():
                column = columns[name][at : at + len(rows)].reshape(len(rows), count)
                for word in range(count):  # one word at a time is faster than rows of three
                    column[:, word] = rows.view(self._order + dtype)[:, first + word]
        return columns

    def survey(self, fields: dict[str, Any]) -> Iterator[dict[str, NDArray[Any]]]:
        """Read the whole file in blocks that fit into the cache."""
        for start in range(0, self.n, _SURVEY):
            yield self.read(fields, start, min(start + _SURVEY, self.n))

    def blocks(self, fields: dict[str, Any], rows: int, keep: Callable[..., Any], ahead: int = 0) -> Iterator[Any]:
        """Read blocks of at most `rows` ions in complete pulses.

        Parameters
        ----------
        fields : dict
            As for `read`.
        rows : int
            Maximum number of ions in a block.
        keep : callable
            Returns the number of rows in complete pulses for the columns of a block.
        ahead : int
            Number of rows after a block that are also passed to `keep`.

        Yields
        ------
        dict of ndarray
        """
        start = 0
        while start < self.n:
            stop = min(start + rows, self.n)
            block = self.read(fields, start, min(stop + ahead, self.n))
            n = keep(block) if stop < self.n else stop - start
            block = {name: values[:n] for name, values in block.items()}
            yield block
            del block  # frees the memory before the next block is read; the caller does the same
            start += n


@contextmanager
def open_words(
    path: AnyPath,
    row_size: int,
    kind: str,
    *,
    order: str = "big",
    floats: int = 4,
    partial: bool = False,
    byte_order: str | None = None,
    rival: tuple[str, int] | None = None,
) -> Iterator[Words]:
    """Open a headerless file of `row_size` bytes per ion, and check its size and byte order.

    The byte order is that of the format, checked by the values of the first `floats` words of a row, which are float32;
    `byte_order` replaces it. With `partial`, the complete ions of a file that ends in the middle of an ion are read.
    `rival` is name and row size of another format that the file may have.
    """
    check_switch(partial, "partial")
    if byte_order is not None:
        check_choice(byte_order, "byte_order", _ORDERS)
    words = row_size // 4
    with open_for_reading(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size == 0:
            raise FileError(f"{str(path)!r} is empty (0 bytes), expected {row_size} bytes per ion as in {kind}")
        if other := foreign(file.read(64)):
            raise FileError(f"{str(path)!r} is {other}, expected {row_size} bytes per ion as in {kind}")
        file.seek(0)
        n, tail = divmod(size, row_size)
        if tail and not partial:
            raise _wrong_size(path, size, row_size, kind, rival)
        if n == 0:
            raise TruncatedFile(f"{str(path)!r} has {size} bytes, fewer than one ion of {kind} ({row_size} bytes)")
        if byte_order is None:
            rows = np.empty((min(n, _CHUNK), words), "u4")
            if fill(file, rows) < rows.nbytes:
                raise TruncatedFile(f"{str(path)!r} became shorter during reading, expected {size} bytes")
            _check_byte_order(path, rows[:, :floats], order)
        yield Words(file, path, words, _ORDERS[byte_order or order], n, bool(tail))


def fill(file: Any, array: Any) -> int:
    """Read until `array` is full or the file ends; return the number of bytes."""
    target = memoryview(array).cast("B") if array.size else b""
    at = 0
    while at < len(target) and (n := file.readinto(target[at:])):
        at += n
    return at


def check_columns(columns: str | Sequence[str] | None, available: Sequence[str], path: AnyPath) -> tuple[str, ...]:
    """Names of the columns to read, of those that the file has; all by default."""
    if columns is None:
        return tuple(available)
    try:
        chosen = (columns,) if isinstance(columns, str) else tuple(columns)
    except TypeError:
        chosen = ()
    for name in chosen or (columns,):
        if name not in available:
            raise FileError(f"{str(path)!r} has no column {short_text(name)}, available are {', '.join(available)}")
    return chosen


def choose_fields(
    columns: Any, available: Sequence[str], fields: dict[str, Any], path: AnyPath, also: dict[str, Any]
) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Names of the columns to read, and the fields that these need.

    `fields` are all of the format, as for `Words.read`; `also` has names of further fields that a column needs.
    """
    chosen = check_columns(columns, available, path)
    needed = {*chosen, *(other for name in chosen for other in also.get(name, ()))}
    return chosen, {name: field for name, field in fields.items() if name in needed}


def in_mm(columns: dict[str, Any], detector_unit: str) -> dict[str, Any]:
    """Columns whose detector coordinates x and y are converted to mm, dict of ndarray."""
    factor = MM[check_choice(detector_unit, "detector_unit (--unit)", MM)]
    if factor == 1.0:
        return columns
    with np.errstate(over="ignore"):
        return {
            name: v * np.float32(factor) if name in ("x", "y") and v is not None else v for name, v in columns.items()
        }


def check_any(chosen: Any, path: AnyPath) -> None:
    """Raise an error if all requested columns, a dict of name and array or None, are absent."""
    if all(values is None for values in chosen.values()):
        raise FileError(f"{str(path)!r} has no data in {', '.join(chosen)}: absent, or zero for all ions")


def choose(path: AnyPath, hits: Hits, columns: Any) -> Any:
    """Select the ions to write: those that hit the detector and have finite values; warn with the number of others."""
    hit = np.ones(len(hits), bool) if hits.outcome is None else hits.outcome == Outcome.HIT
    finite = finite_rows(columns, len(hits))
    omitted = int(np.count_nonzero(~hit)), int(np.count_nonzero(hit & ~finite))
    tell_omitted(path, len(hits), *omitted)
    return hit & finite if any(omitted) else slice(None)


def finite_rows(columns: Any, n: int) -> Any:
    """Whether all numbers of each ion are finite as they are written, bool (n,)."""
    finite = np.ones(n, bool)
    for _, values, dtype in columns:
        if values is not None and dtype == "f4":
            for start in range(0, n, _SURVEY):
                part = values[start : start + _SURVEY]
                with np.errstate(over="ignore"):
                    good = np.isfinite(part.astype(np.float32, copy=False))
                for column in good.reshape(len(part), -1).T:  # faster than `all` along rows of three
                    finite[start : start + _SURVEY] &= column
    return finite


def tell_omitted(path: AnyPath, n: int, n_missed: int, n_not_finite: int) -> None:
    """Warn of ions that are not written; ValueError if these are all."""
    counts = (n_missed, "did not hit the detector"), (n_not_finite, "have values that are not finite")
    reasons = " and ".join(f"{count:,} {what}" for count, what in counts if count)
    n_omitted = n_missed + n_not_finite
    if n_omitted == n:
        what = f"of {n:,} ions {reasons}" if reasons else "the hits are empty"
        raise ValueError(f"no ion to write to {str(path)!r}: {what}")
    if n_omitted:
        warn(f"{n_omitted:,} of {n:,} ions left out of {str(path)!r}: {reasons}", DataWarning)


def write_words(path: AnyPath, columns: Any, row_size: int, chosen: Any) -> None:
    """Write columns side by side as big-endian 4-byte words, `row_size` bytes per ion, chunk by chunk.

    A column is its first word, values of shape (n,) or (n, words), None for zeros, and a type ("f4" or "u4"). An
    existing file is replaced when the new one is complete.
    """
    with replace_file(path) as file:
        put_words(file, columns, row_size, chosen)


def put_words(file: BinaryIO, columns: Any, row_size: int, chosen: Any) -> int:
    """Write rows to an open file, as `write_words`; return their number."""
    columns_written = [(word, values[chosen], dtype) for word, values, dtype in columns if values is not None]
    n = len(columns_written[0][1])
    for start in range(0, n, _CHUNK):
        rows = np.zeros((min(_CHUNK, n - start), row_size // 4), ">u4")
        for word, values, dtype in columns_written:
            part = values[start : start + len(rows)].reshape(len(rows), -1)
            rows.view(">" + dtype)[:, word : word + part.shape[1]] = part
        file.write(rows.data)
    return n


class BlockWriter:
    """Rows of 4-byte words of the detected ions of a file that is read block by block.

    Parameters
    ----------
    file : file
        Open for writing; emptied first.
    row_size : int
        Bytes per ion.
    columns_of : callable
        Columns as for `write_words` of `Hits`, and a function that returns further ones for a selection of the ions.

    Attributes
    ----------
    detected, written : int
        Numbers of ions.
    highest : dict
        Largest voltage, and pulse voltage, of the written ions; 0 where there is none.
    """

    def __init__(self, file: BinaryIO, row_size: int, columns_of: Callable[[Hits], Any]) -> None:
        file.seek(0)
        file.truncate()
        self._file, self._row_size, self._columns_of = file, row_size, columns_of
        self.detected = self.written = 0
        self.highest = {"voltage": 0.0, "pulse_voltage": 0.0}

    def add(self, hits: Hits) -> None:
        """Write the detected ions of the next block."""
        detected = hits.detected
        if not detected.all():
            hits = hits[detected]
        self.detected += len(hits)
        columns, further = self._columns_of(hits)
        finite = finite_rows(columns, len(hits))
        chosen = slice(None) if finite.all() else finite
        if len(hits):
            self.written += put_words(self._file, [*columns, *further(chosen)], self._row_size, chosen)
        for name in self.highest:
            if (values := getattr(hits, name)) is not None and len(values[chosen]):
                self.highest[name] = max(self.highest[name], float(np.abs(values[chosen]).max()))


def _wrong_size(path, size, row_size, kind, rival):
    n, tail = divmod(size, row_size)
    advice = "partial=True (--partial) reads the complete ions"
    if rival and size % rival[1] == 0:
        # an incomplete copy often ends at a block of the disk, a size that also fits a .pos
        kind_too = rival[0].split()[-1]
        advice += (
            f"; its size fits the {rival[1]} bytes per ion of {rival[0]} (format={kind_too!r} (--format) reads it so)"
        )
    return TruncatedFile(
        f"{str(path)!r} ends in the middle of an ion: {n} complete ions of {row_size} bytes as in {kind} and "
        f"{tail} further bytes; {advice}"
    )


def _check_byte_order(path, words, order):
    """Raise an error if the values of the first rows are more plausible in the other byte order."""
    other = "little" if order == "big" else "big"
    if _absurd(words.view(_ORDERS[order] + "f4")) > _absurd(words.view(_ORDERS[other] + "f4")):
        raise FileError(
            f"{str(path)!r} appears to be {other}-endian (as {order}-endian its first row is "
            f"{words.view(_ORDERS[order] + 'f4')[0].tolist()}), expected {order}-endian; "
            f"byte_order={other!r} (--byte-order) reads it; byte_order={order!r} skips this check"
        )


def _absurd(values):
    """Number of values that are impossible for positions [nm], masses [Da], times [ns] and voltages [V].

    These are very large, denormal, or not finite.
    """
    with np.errstate(invalid="ignore"):
        size = np.abs(values.astype(np.float32))
        return np.count_nonzero(~(size <= 1e6) | ((size > 0) & (size < np.finfo(np.float32).tiny)))
