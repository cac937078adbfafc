"""Headerless files of 4-byte big-endian words in rows of one length: what .pos and .epos share."""

import os
import warnings

import numpy as np

from apt_evap._files import FileError, TruncatedFile, open_for_reading, replace_file
from apt_evap.hits import Outcome

_CHUNK = 1 << 14
_BYTE_ORDERS = {None: ">", "big": ">", "little": "<"}


def read_words(path, groups, row_size, kind, *, partial=False, byte_order=None, rival=None):
    """Read the columns of a headerless file, chunk by chunk, into native arrays.

    Parameters
    ----------
    path : str or path-like
        The file.
    groups : sequence of (int, int, str)
        First word, number of words and type ("f4" or "u4") of each result.
    row_size : int
        Bytes per ion.
    kind : str
        Name of the format, for messages.
    partial : bool
        Read the whole ions of a file that ends in the middle of one.
    byte_order : {None, "big", "little"}
        None reads big-endian after a check that the file is.
    rival : (str, int), optional
        Name and row size of the format the file may be instead.

    Returns
    -------
    columns : list of ndarray
        Shape (n,), or (n, words) where a group has several words.
    cut : bool
        Whether the end of the file is missing.

    Raises
    ------
    FileError
        If the file is missing, unreadable, empty or in the wrong byte order.
    TruncatedFile
        If the size is no multiple of `row_size` and `partial` is False.
    """
    if byte_order not in _BYTE_ORDERS:
        raise ValueError(f"byte_order must be None, 'big' or 'little', got {byte_order!r}")
    order = _BYTE_ORDERS[byte_order]
    words = row_size // 4
    with open_for_reading(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size == 0:
            raise FileError(f"{str(path)!r} is empty (0 bytes), expected {row_size} bytes per ion as in {kind}")
        n, tail = divmod(size, row_size)
        if tail and not partial:
            raise _wrong_size(path, size, row_size, kind, rival)
        if n == 0:
            raise TruncatedFile(f"{str(path)!r} has {size} bytes, less than one ion of {kind} ({row_size} bytes)")
        columns = [np.empty((n, count) if count > 1 else n, dtype) for _, count, dtype in groups]
        buffer = np.empty((min(n, _CHUNK), words), order + "u4")
        for start in range(0, n, _CHUNK):
            rows = buffer[: min(_CHUNK, n - start)]
            if _fill(file, rows) < rows.nbytes:
                raise TruncatedFile(f"{str(path)!r} became shorter while it was read, expected {size} bytes")
            if start == 0 and byte_order is None:
                _check_byte_order(path, rows[:, :4])
            for column, (first, count, dtype) in zip(columns, groups, strict=True):
                part = rows.view(order + dtype)[:, first : first + count]
                column[start : start + len(rows)] = part if count > 1 else part[:, 0]
    return columns, bool(tail)


def choose(path, hits, columns):
    """Choose the ions to write: those that hit and are finite, with a warning that counts the others.

    Parameters
    ----------
    path : str or path-like
        For the message.
    hits : Hits
        All ions.
    columns : sequence of (int, ndarray or None, str)
        As for `write_words`.

    Returns
    -------
    ndarray or slice
        What selects the ions to write.

    Raises
    ------
    ValueError
        If no ion is left.
    """
    hit = np.ones(len(hits), bool) if hits.outcome is None else hits.outcome == Outcome.HIT
    finite = np.ones(len(hits), bool)
    for _, values, dtype in columns:
        if values is not None and dtype == "f4":
            with np.errstate(over="ignore"):
                good = np.isfinite(values.astype(np.float32, copy=False))
            finite &= good if good.ndim == 1 else good.all(axis=1)
    missed, broken = np.count_nonzero(~hit), np.count_nonzero(hit & ~finite)
    reasons = f"{missed:,} did not hit the detector and {broken:,} have values that are not finite"
    if missed + broken == len(hits):
        raise ValueError(f"nothing to write to {str(path)!r}: of {len(hits):,} ions {reasons}")
    if missed + broken == 0:
        return slice(None)
    warnings.warn(f"{str(path)!r} leaves out {missed + broken:,} of {len(hits):,} ions: {reasons}", stacklevel=4)
    return hit & finite


def write_words(path, columns, row_size, chosen):
    """Write columns side by side as big-endian 4-byte words, chunk by chunk.

    Parameters
    ----------
    path : str or path-like
        The file; an existing one is replaced once the new one is complete.
    columns : sequence of (int, ndarray or None, str)
        First word, values of shape (n,) or (n, words) and type ("f4" or "u4"); None is written as zeros.
    row_size : int
        Bytes per ion.
    chosen : ndarray or slice
        Selects the ions to write.

    Raises
    ------
    FileError
        If the file cannot be written.
    """
    given = [(word, values[chosen], dtype) for word, values, dtype in columns if values is not None]
    n = len(given[0][1])
    with replace_file(path) as file:
        for start in range(0, n, _CHUNK):
            rows = np.zeros((min(_CHUNK, n - start), row_size // 4), ">u4")
            for word, values, dtype in given:
                part = values[start : start + len(rows)].reshape(len(rows), -1)
                rows.view(">" + dtype)[:, word : word + part.shape[1]] = part
            file.write(rows.data)


def _fill(file, rows):
    """Read until `rows` is full or the file ends; return the number of bytes."""
    target = memoryview(rows).cast("B") if rows.size else b""
    done = 0
    while done < len(target) and (got := file.readinto(target[done:])):
        done += got
    return done


def _wrong_size(path, size, row_size, kind, rival):
    n, tail = divmod(size, row_size)
    advice = "partial=True reads the whole ones"
    if rival and size % rival[1] == 0:
        # a copy cut at a block of the disk has a size that fits a .pos, too
        kind_too = rival[0].split()[-1]
        advice += f"; or it is probably {rival[0]}, whose {rival[1]} bytes fit (format={kind_too!r} reads it so)"
    return TruncatedFile(
        f"{str(path)!r} ends in the middle of an ion: {n} whole ions of {row_size} bytes as in {kind} and "
        f"{tail} bytes more; {advice}"
    )


def _check_byte_order(path, words):
    """Complain if x, y, z and m/n of the first rows look saner as little-endian."""
    if _absurd(words.view(">f4")) > _absurd(words.view("<f4")):
        raise FileError(
            f"{str(path)!r} looks little-endian (as big-endian its first row is "
            f"{words.view('>f4')[0].tolist()}), expected big-endian; byte_order='little' reads it, "
            f"byte_order='big' reads it as it stands"
        )


def _absurd(values):
    """Count values that no position [nm] or mass [Da] has: huge, denormal or not finite."""
    with np.errstate(invalid="ignore"):
        size = np.abs(values.astype(np.float32))
        return np.count_nonzero(~(size <= 1e6) | ((size > 0) & (size < np.finfo(np.float32).tiny)))
