"""The .pos format: position and mass-to-charge ratio of every ion, 16 bytes each, big-endian, no header.

Larson et al., Local Electrode Atom Probe Tomography (Springer, 2013), appendix A.
"""

from collections.abc import Iterator, Sequence

from apt_evap._common.files import replace_file
from apt_evap._common.types import AnyPath
from apt_evap.detection.hits import Hits
from apt_evap.detection.ion_blocks import IonBlocks
from apt_evap.io._records import BlockWriter, check_columns, choose, open_words, tell_omitted, write_words

_ROW = 16
_FIELDS = {"positions": (0, 3, "f4"), "mass_to_charge": (3, 1, "f4")}
WRITTEN = tuple(_FIELDS)


def read_pos(
    path: AnyPath, *, columns: Sequence[str] | None = None, partial: bool = False, byte_order: str | None = None
) -> Hits:
    """Read a .pos file.

    Returns
    -------
    Hits
        With positions [nm] and mass_to_charge [Da].
    """
    fields = _chosen(columns, path)
    with _open(path, partial, byte_order) as words:
        return Hits(**words.read(fields), source=str(path))


def chunk_pos(
    path: AnyPath,
    rows: int,
    *,
    columns: Sequence[str] | None = None,
    partial: bool = False,
    byte_order: str | None = None,
) -> Iterator[Hits]:
    """Read a .pos file in `Hits` of at most `rows` ions; otherwise as `read_pos`.

    Yields
    ------
    Hits
    """
    blocks = PosBlocks(path, columns, partial=partial, byte_order=byte_order)
    yield from blocks.blocks(blocks.columns, rows)


class PosBlocks:
    """A .pos file that is read in blocks as often as needed; the arguments are those of `read_pos`."""

    available = WRITTEN
    """Columns of the format."""
    largest = 0
    """Ions of the largest pulse; the format has no pulses."""

    def __init__(
        self,
        path: AnyPath,
        columns: Sequence[str] | None = None,
        *,
        partial: bool = False,
        byte_order: str | None = None,
        watch: object = None,
        progress: object = None,
    ) -> None:
        self._path, self._opening = path, (path, partial, byte_order)
        self.columns = tuple(_chosen(columns, path))
        with _open(*self._opening) as words:
            self.n = words.n

    def blocks(self, columns: Sequence[str], rows: int) -> Iterator[Hits]:
        """Blocks of at most `rows` ions."""
        fields = _chosen(columns, self._path)
        with _open(*self._opening) as words:
            for start in range(0, words.n, rows):
                yield Hits(**words.read(fields, start, min(start + rows, words.n)), source=str(self._path))


def write_pos(path: AnyPath, hits: Hits) -> None:
    """Write a .pos file.

    Ions that did not hit the detector and ions whose position or mass is not finite are left out, and a warning gives
    their number.
    """
    columns, _ = _written(hits)
    write_words(path, columns, _ROW, choose(path, hits, columns))


def write_pos_blocks(path: AnyPath, ions: IonBlocks) -> int:
    """Write the detected ions of a large file as `write_pos` does, block by block; return their number."""
    with replace_file(path) as file:
        writer = ions.fed(lambda: BlockWriter(file, _ROW, _written))
        tell_omitted(path, writer.detected, 0, writer.detected - writer.written)
    return writer.detected


def _written(hits):
    """Columns to write, and no further ones."""
    (positions,) = hits.require("positions")
    return [(0, positions, "f4"), (3, hits.mass_to_charge, "f4")], lambda chosen: []


def _open(path, partial, byte_order):
    return open_words(path, _ROW, "a .pos", partial=partial, byte_order=byte_order, rival=("an .epos", 44))


def _chosen(columns, path):
    return {name: _FIELDS[name] for name in check_columns(columns, tuple(_FIELDS), path)}
