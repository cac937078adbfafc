"""Text tables of numbers with a first line of names: columns divided by commas, semicolons, tabs or spaces.

Where commas do not divide the columns, they are decimal commas. Lines may end with LF, CR LF or CR. Lines that begin
with # are comments; one just before the numbers may have the names.
"""

import csv
import re
from collections import Counter
from dataclasses import dataclass, field
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.files import FileError
from apt_evap._common.types import AnyPath, Floats
from apt_evap.io._texts import read_text

_NUMBER = re.compile(r"[-+]?([0-9]+[.,]?[0-9]*|[.,][0-9]+)([eE][-+]?[0-9]+)?|nan|[-+]?inf(inity)?", re.IGNORECASE)

_SAMPLE = 200  # lines that show what divides the columns, and how many there are


def _is_number(cell):
    return cell == "" or _NUMBER.fullmatch(cell) is not None


@dataclass
class Table:
    """Cells of a text table."""

    path: str
    names: list[str]
    """Names of the columns as in the file; empty if it has none."""
    comment: list[str]
    """Words of the comment just before the numbers, as many as there are columns, which may be their names."""
    numbers: list[int]
    """Number of the line of each row."""
    rows: list[list[str]] = field(repr=False)
    """Cells of each row, as many as most rows have."""

    def floats(self, column: int, what: str = "a number") -> Floats:
        """Numbers of a column, NaN for an empty cell; a FileError names the line of a cell that is something else."""
        cells = [row[column] or "nan" for row in self.rows]
        try:
            return np.array(cells, dtype=np.float64)
        except ValueError:
            for number, cell in zip(self.numbers, cells, strict=True):
                if not _is_number(cell):
                    raise FileError(f"{self.path!r}, line {number}: expected {what}, got {cell!r:.60}") from None
            raise

    def texts(self, column: int) -> NDArray[np.str_]:
        """Cells of a column as texts."""
        return np.array([row[column] for row in self.rows])

    def is_numeric(self, column: int) -> bool:
        """Whether the first cell of a column is a number."""
        return _is_number(self.rows[0][column])


def read_table(path: AnyPath, what: str, at_most: int) -> Table:
    """Read a text table of up to `at_most` bytes; `what` is the expected content, for messages."""
    text = read_text(path, what, at_most)
    if "\0" in text:
        raise FileError(f"{str(path)!r} is not a text: it has zero bytes, expected {what}")
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip(" ;,\t")]
    comments = [line.lstrip()[1:] for _, line in lines if line.lstrip().startswith("#")]
    lines = [(number, line) for number, line in lines if not line.lstrip().startswith("#")]
    if not lines:
        raise FileError(f"{str(path)!r} has no numbers, expected {what}")
    divider = _divider([line for _, line in lines[:_SAMPLE]])
    cells = _cells([line for _, line in lines], divider)
    numbers = [number for number, _ in lines]
    if len(cells) != len(numbers):
        first = next(number for number, line in lines if line.count('"') % 2)
        raise FileError(f"{str(path)!r}, line {first}: expected a second quote")
    names: list[str] = []
    comment: list[str] = []
    width = max(Counter(map(len, cells[:_SAMPLE])).items(), key=itemgetter(1))[0]  # that of most lines
    has_names = not any(cell and _is_number(cell) for cell in cells[0])
    if has_names:
        names = cells[0]
    elif comments:
        words = _cells(comments[-1:], divider if divider and divider in comments[-1] else None)[0]
        comment = [word.strip(",;") for word in words[:width]]
    if not cells[has_names:]:
        raise FileError(f"{str(path)!r} has no numbers, expected {what}")
    for number, row in zip(numbers, cells, strict=True):
        if len(row) != width:
            raise FileError(f"{str(path)!r}, line {number}: expected {width} cells, got {len(row)}")
    cells, numbers = cells[has_names:], numbers[has_names:]
    if divider != ",":
        cells = [[cell.replace(",", ".") if _is_number(cell) else cell for cell in row] for row in cells]
    return Table(str(path), names, comment, numbers, cells)


def _divider(lines):
    """What divides the cells of most lines, but in quotes: a semicolon, a tab, a comma, or None for spaces."""
    lines = [re.sub(r'"[^"]*"', '""', line) for line in lines]
    for divider in ";\t,":
        divided = [line for line in lines if divider in line]
        if 2 * len(divided) > len(lines):
            break
    else:
        return None
    # "1,204 -3,377": decimal commas
    decimal = [len(line.split()) > 1 and all(map(_is_number, line.split())) for line in divided]
    return None if divider == "," and 2 * sum(decimal) >= len(divided) else divider


def _cells(lines, divider):
    if divider is None:
        return [line.split() for line in lines]
    return [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=divider)]
