"""A large file of measured ions, read block by block, as often as an answer needs it.

Its memory does not depend on the number of ions. What only the complete file shows (columns of zeros, the unit of the
voltages, consistent pulses, the extent of the detector coordinates) is found in a first pass over the columns that are
needed. Strays are looked for in the pass after it, together with the answer; only if there may be some, the coordinates
of all ions are read at once, and the answer is made again without them.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.types import Booleans, Floats
from apt_evap.detection.hits import Hits
from apt_evap.detection.strays import StrayCheck, keep_strays, strays_of

ROWS = 1 << 16
"""Ions of a block: its columns stay in the cache."""
SAMPLE = 100_000
"""Ions among which the quantisation of coordinates is looked for, as in `find_quantisation`."""
_PLACES = ("x", "y")

C = TypeVar("C", bound="Consumer")


class Consumer(Protocol):
    """What answers are made with: it takes all blocks in their order."""

    def add(self, hits: Hits) -> None:
        """Take the next block."""
        ...


class BlockReader(Protocol):
    """A file of a format that can be read in blocks more than once."""

    available: tuple[str, ...]
    n: int
    largest: int
    columns: tuple[str, ...]

    def blocks(self, columns: tuple[str, ...], rows: int) -> Iterator[Hits]:
        """Blocks with these columns, of complete pulses if they have numbers of pulses."""
        ...


class Field:
    """Extent and sample of the coordinates of the ions that are detected.

    Attributes
    ----------
    ions : int
        Ions with finite coordinates.
    low, high : list of float32 or float64
        Smallest and largest x and y [mm].
    sample : list of ndarray or None
        Coordinates of every nth ion in x and y; None if some coordinates are not finite.
    """

    def __init__(self, n: int) -> None:
        self.ions, self._rows = 0, 0
        self._step = max(1, n // SAMPLE)
        self.low: list[Any] = [np.inf, np.inf]
        self.high: list[Any] = [-np.inf, -np.inf]
        self._samples: list[list[NDArray[Any]]] | None = [[], []]

    def add(self, x: Floats, y: Floats) -> None:
        """Take the next ions."""
        if not len(x):
            return
        extremes = [(values.min(), values.max()) for values in (x, y)]
        if np.isfinite(extremes).all():
            if self._samples is not None:
                first = -self._rows % self._step
                for values, kept in zip((x, y), self._samples, strict=True):
                    kept.append(values[first :: self._step].copy())
        else:
            self._samples = None
            finite = np.isfinite(x) & np.isfinite(y)
            x, y = x[finite], y[finite]
            extremes = [(values.min(), values.max()) for values in (x, y)] if len(x) else []
        self._rows += len(x)
        self.ions += len(x)
        for axis, (low, high) in enumerate(extremes):
            self.low[axis], self.high[axis] = min(low, self.low[axis]), max(high, self.high[axis])

    @property
    def sample(self) -> list[NDArray[Any]] | None:
        """Coordinates of every nth ion in x and y; None if some coordinates are not finite."""
        return None if self._samples is None else [np.concatenate(values) for values in self._samples]

    @property
    def size(self) -> tuple[float, float]:
        """Extent in x and y [mm]."""
        width, height = (float(high) - float(low) for low, high in zip(self.low, self.high, strict=True))
        return width, height


class IonBlocks:
    """Measured ions of a large file; `fed` reads them.

    Parameters
    ----------
    reader : BlockReader
        The file.
    field : Field or None
        Coordinates of its ions, of the first pass; None if it has none.
    source : str
        Name of the file.
    warn_of_size : callable
        Takes the extent of all ions in x and y, and a function that returns that of the detected ones.
    """

    def __init__(
        self, reader: BlockReader, field: Field | None, source: str, warn_of_size: Callable[..., object]
    ) -> None:
        self._reader, self._warn_of_size = reader, warn_of_size
        self.source, self.field = source, field
        self._strays: Booleans | None = None
        self._settled = field is None
        self.progress: Callable[[int, int], object] = lambda ions, of: None

    def __len__(self) -> int:
        return self._reader.n

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns of the file, of those that were asked for."""
        return tuple(name for name in Hits.__dataclass_fields__ if name in self._reader.columns)

    @property
    def whole(self) -> bool:
        """Whether all ions are detected."""
        return self._strays is None and (self.field is None or self.field.ions == len(self))

    @property
    def sample(self) -> list[NDArray[Any]]:
        """Coordinates x and y of every nth of the detected ions."""
        assert self.field is not None
        if self.field.sample is None:  # of those with finite coordinates
            finite = Field(self.field.ions)
            for hits in self._told(_PLACES):
                rows = np.isfinite(hits.x) & np.isfinite(hits.y)
                finite.add(hits.x[rows], hits.y[rows])
            self.field = finite
        assert self.field.sample is not None
        return self.field.sample

    def fed(self, make: Callable[[], C], *columns: str) -> C:
        """A consumer that has taken all blocks.

        Parameters
        ----------
        make : callable
            Returns a new consumer. It is called again if the first pass finds strays.
        *columns : str
            Columns of the blocks, which know their strays; by default all.
        """
        consumer = make()
        names = columns or self.columns
        if self._settled:
            for hits in self._known(names):
                consumer.add(hits)
            return consumer
        assert self.field is not None
        check = StrayCheck(self.field.ions, self.field.low, self.field.high)
        for hits in self._told(tuple(dict.fromkeys((*names, *_PLACES)))):
            assert hits.x is not None and hits.y is not None
            keep_strays(hits.x, hits.y, None)
            check.add(hits.x, hits.y)
            consumer.add(hits)
        self._settled, size = True, self.field.size
        if not check.none():
            self._find_strays()
        self._warn_of_size(size, lambda: self.field.size)
        return consumer if self._strays is None else self.fed(make, *columns)

    def gathered(
        self,
        *names: str,
        seen: Mapping[str, Callable[[NDArray[Any]], object]] | None = None,
        **made: tuple[str, Callable[[NDArray[Any]], NDArray[Any]]],
    ) -> Hits:
        """Columns of all ions, and their coordinates if some are not detected, because of which they are needed.

        `made` are further columns, by name: the column that they are made of, and a function of it in a block. `seen`
        are functions of blocks of columns that are not kept; if there are strays, they are called twice.
        """
        seen = seen or {}

        def gathering():  # again once strays are found
            return _Gathered(len(self), names if self.whole else (*names, *_PLACES), made, seen)

        gathered = self.fed(gathering, *names, *seen, *(column for column, _ in made.values()))
        columns: dict[str, Any] = gathered.columns
        extra = {name: columns.pop(name) for name in made}
        hits = Hits(**columns, extra=extra, source=self.source)
        if hits.x is not None and hits.y is not None:
            keep_strays(hits.x, hits.y, self._strays)
        return hits

    def _told(self, names):
        """Blocks, whose ions are told to the progress."""
        for hits in self._reader.blocks(names, ROWS):
            yield hits
            self.progress(len(hits), len(self))

    def _known(self, names):
        """Blocks with their strays."""
        if self.field is not None:
            names = tuple(dict.fromkeys((*names, *_PLACES)))
        start = 0
        for hits in self._told(names):
            if self.field is not None:
                part = None if self._strays is None else self._strays[start : start + len(hits)]
                keep_strays(hits.x, hits.y, part)
            start += len(hits)
            yield hits

    def _find_strays(self):
        """Find the strays by the coordinates of all ions, and the field of the others."""
        parts = [(hits.x, hits.y) for hits in self._told(_PLACES)]
        x, y = (np.concatenate(values) for values in zip(*parts, strict=True))
        del parts
        self._strays = strays_of(x, y, self.source)
        if self._strays is not None:
            inside = np.isfinite(x) & np.isfinite(y) & ~self._strays
            self.field = Field(int(np.count_nonzero(inside)))
            self.field.add(x[inside], y[inside])


class _Gathered:
    """Columns of all ions."""

    def __init__(
        self,
        ions: int,
        names: tuple[str, ...],
        made: Mapping[str, tuple[str, Callable[..., Any]]],
        seen: Mapping[str, Callable[..., object]],
    ) -> None:
        self._ions, self._names, self._made, self._seen, self._at = ions, dict.fromkeys(names), made, seen, 0
        self.columns: dict[str, NDArray[Any]] = {}

    def add(self, hits: Hits) -> None:
        """Take the next block."""
        values_of = {name: getattr(hits, name) for name in self._names}
        values_of |= {name: function(getattr(hits, column)) for name, (column, function) in self._made.items()}
        for name, values in values_of.items():
            if name not in self.columns:
                self.columns[name] = np.empty((self._ions, *values.shape[1:]), values.dtype)
            self.columns[name][self._at : self._at + len(hits)] = values
        for column, function in self._seen.items():
            function(getattr(hits, column))
        self._at += len(hits)
