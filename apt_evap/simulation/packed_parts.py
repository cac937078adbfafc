"""The parts of a run in progress, in 0.4 of the memory of the run: their columns are compressed."""

import mmap
import zlib
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from apt_evap.simulation.columns import columns_of, every_column_of, parts_of
from apt_evap.simulation.history import CapHistory, History
from apt_evap.simulation.parts_of_runs import select_rows
from apt_evap.simulation.provenance import joined
from apt_evap.simulation.run import Run

_LEVEL = 1
"""Of deflate. Of 1,224 bytes of responses an ion (6,000 ions, R = 12 a), level 1 leaves 463 in 13 us of processor
time, level 4 leaves 451 in 21 us; 574 in 17 us if bytes are sorted by their places in a number, not by coefficients. Of
the 218 bytes of the other columns (15,000 ions, R = 20 a), level 1 leaves 108 in 4 us."""
_ROWS = 1 << 14  # ions of a packed part: joined ones are unpacked and freed in pieces of these


class _Part(NamedTuple):
    """Columns of some ions, in memory of their own, which goes back to the system when they are freed.

    In the heap, the holes of freed ones stayed: the memory of a run of 36,000 ions was 2.7 instead of 1.8 kB an ion.
    """

    ions: int
    memory: mmap.mmap
    places: dict[str, slice]
    """Of the columns by path."""


class PackedParts:
    """Parts of one run in their sequence, which are joined without a second copy of them.

    Ions take 0.56 kB with responses, and 1.45 kB in a run.
    """

    def __init__(self) -> None:
        self._parts: list[_Part] = []
        self._first: Run | None = None  # of its first part, without ions
        self._caps: list[CapHistory] = []
        self._histories: list[History] = []
        self._provenances: list[dict[str, Any]] = []

    def __len__(self) -> int:
        return sum(part.ions for part in self._parts)

    def add(self, run: Run) -> None:
        """Take the next part of the run."""
        if self._first is None:
            self._first = replace(run, **select_rows(run, slice(0, 0)), history=History.empty(), cap=CapHistory.empty())
        self._caps.append(run.cap)
        self._histories.append(run.history)
        if run.provenance not in self._provenances:
            self._provenances.append(run.provenance)
        columns = columns_of(run, every_column_of(run))
        for start in range(0, len(run), _ROWS):
            rows = slice(start, start + _ROWS)
            packed = {path: _packed(values[rows]) for path, values in columns.items()}
            memory, at, places = mmap.mmap(-1, sum(map(len, packed.values()))), 0, {}
            for path, data in packed.items():
                places[path] = slice(at, at + len(data))
                memory[places[path]] = data
                at += len(data)
            self._parts.append(_Part(min(_ROWS, len(run) - start), memory, places))

    def add_history(self, history: History) -> None:
        """Take further checks of the monitor."""
        self._histories.append(history)

    def run(self, *, last: bool = False) -> Run:
        """The run of all parts; if it is the last one, each part is freed as soon as it is in the run."""
        assert self._first is not None
        columns = columns_of(self._first, every_column_of(self._first))
        every = {path: np.empty((len(self), *values.shape[1:]), values.dtype) for path, values in columns.items()}
        start, parts = 0, self._parts[::-1]
        if last:
            self._parts.clear()
        while parts:
            part = parts.pop()
            for path, values in every.items():
                _unpack(part.memory[part.places[path]], values[start : start + part.ions])
            start += part.ions
            del part
        arguments = parts_of(every, self._first.emissions.nearest_neighbour_distance)
        arguments |= {"history": History.join(self._histories), "cap": CapHistory.join(self._caps)}
        return replace(self._first, **arguments, provenance=joined(self._provenances))


def _packed(values: NDArray[Any]) -> bytes:
    """Bytes of a column, those of one place in one number of all ions side by side, compressed."""
    flat = np.ascontiguousarray(values.reshape(len(values), -1).T)
    return zlib.compress(np.ascontiguousarray(flat.view(np.uint8).reshape(flat.size, -1).T).data, _LEVEL)


def _unpack(packed: bytes, rows: NDArray[Any]) -> None:
    """Write numbers of `_packed` into rows of an array."""
    planes = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(rows.itemsize, -1)
    rows[...] = np.ascontiguousarray(planes.T).view(rows.dtype).reshape(-1, len(rows)).T.reshape(rows.shape)
