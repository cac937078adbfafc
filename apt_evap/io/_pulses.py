"""Pulses of the ions: checks of the conventions of the formats, and conversion to pulse_id and multiplicity."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.types import AnyPath, Integers
from apt_evap.warnings import DataWarning, warn

_BLOCK = 1 << 15  # rows that fit into the cache


class PulseCheck:
    """Check, block by block, that a column has n for the first ion of each pulse and 0 for the other n - 1."""

    def __init__(self) -> None:
        self.rows = 0
        self.largest = 0
        self._first = self._last = None
        self._announced = 0
        self._wrong = 0
        self._example = ""

    def add(self, ions: NDArray[np.integer]) -> None:
        """Check the next rows of the column."""
        for start in range(0, len(ions), _BLOCK):
            self._add_block(ions[start : start + _BLOCK])

    def _add_block(self, ions):
        complete = self._last is None or self.rows - self._last == self._announced
        if complete and ions[0] and _consistent(ions):
            last = len(ions) - 1 - int((ions[::-1] != 0).argmax())
            self._first = self.rows if self._last is None else self._first
            self._last, self._announced = self.rows + last, int(ions[last])
            self.largest = max(self.largest, int(ions.max()))
        else:
            self._add_pulses(ions)
        self.rows += len(ions)

    def _add_pulses(self, ions):
        """Compare every pulse; ten times slower than `_consistent`, but finds the wrong pulse."""
        first = np.flatnonzero(ions)
        if len(first) == 0:
            return
        announced = ions[first]
        self.largest = max(self.largest, int(announced.max()))
        if self._last is None:
            self._first = self.rows + int(first[0])
        else:
            self._compare(self.rows + int(first[0]) - self._last)
        sizes = np.diff(first)
        wrong = np.flatnonzero(sizes != announced[:-1])
        if len(wrong):
            at = wrong[0]
            self._note(self.rows + int(first[at]), int(announced[at]), int(sizes[at]), len(wrong))
        self._last, self._announced = self.rows + int(first[-1]), int(announced[-1])

    def problem(self, cut: bool) -> str:
        """Return the problem of the whole column, or ""; `cut` if the end of the file is missing."""
        if self._last is None:
            return "it is zero for all ions"
        # if a file is truncated in its last pulse, the size of this pulse is still known
        if not (cut and self._announced > self.rows - self._last):
            self._compare(self.rows - self._last)
        if self._first:
            return f"its first {self._first} rows belong to a pulse whose first ion is missing"
        return self._example + (f" ({self._wrong} such pulses)" if self._wrong > 1 else "")

    def _compare(self, size):
        if size != self._announced:
            self._note(self._last, self._announced, size, 1)

    def _note(self, row, announced, size, count):
        if not self._wrong:
            self._example = (
                f"row {row} gives {announced} ions for its pulse but the next pulse begins {size} rows later"
            )
        self._wrong += count


def _consistent(ions):
    """Whether rows that begin with a pulse have n for first ions and 0 for others; the last pulse may be incomplete."""
    several = np.flatnonzero(ions > 1)
    zeros = np.flatnonzero(ions == 0)
    followers = ions[several].astype(np.int64) - 1
    if len(several) and followers[-1] >= len(ions) - several[-1]:
        followers[-1] = len(ions) - 1 - several[-1]
    if len(several) and (followers.min() < 0 or followers.max() >= len(ions)):
        return False
    if (ions.dtype.kind == "i" and ions.min() < 0) or followers.sum() != len(zeros):
        return False
    # only pulses with several ions are needed to compute the places of the zeros, and these are few
    before = np.cumsum(followers) - followers
    return np.array_equal(np.repeat(several + 1 - before, followers) + np.arange(len(zeros)), zeros)


def pulses_from_first(ions: NDArray[np.uint32], first_pulse: int = 0) -> tuple[Integers, NDArray[np.uint32]]:
    """Pulse and multiplicity of every ion from n for the first ion of each pulse and 0 for the other n - 1.

    The column must be consistent and begin with a pulse; the end of its last pulse may be missing. It is overwritten
    with the multiplicity.
    """
    begins = ions != 0
    begins[0] = False
    pulse_id = np.cumsum(begins, dtype=np.int64)
    if first_pulse:
        pulse_id += first_pulse
    several = ions[ions > 1]
    followers = np.flatnonzero(ions == 0)
    counts = several.astype(np.int64) - 1
    counts[-1:] -= counts.sum() - len(followers)  # missing ions of the last pulse
    ions[followers] = np.repeat(several, counts)
    return pulse_id, ions


def first_from_equal(numbers: NDArray[np.integer]) -> NDArray[np.uint32]:
    """Return n for the first of n consecutive equal numbers and 0 for the others."""
    ions = np.zeros(len(numbers), np.uint32)
    if len(numbers):
        first = np.flatnonzero(np.concatenate([[True], numbers[1:] != numbers[:-1]]))
        ions[first] = np.diff(first, append=len(numbers))
    return ions


def are_grouped(blocks: Iterable[NDArray[np.integer]], path: AnyPath) -> bool:
    """Whether consecutive ions with the same number are a pulse; a warning if the numbers are all zero or decrease.

    A decrease by 2^31 or more is that of a counter of 32 bits that wraps around.
    """
    has_numbers, n_decreases, last = False, 0, None
    for numbers in blocks:
        has_numbers = has_numbers or bool(numbers.any())
        before = numbers[:-1] if last is None else np.concatenate([last, numbers[:-1]])
        after = numbers[-len(before) :] if len(before) else numbers[:0]
        falls = np.flatnonzero(after < before)
        n_decreases += np.count_nonzero(before[falls] - after[falls] < 1 << 31)
        last = numbers[-1:]
    if not has_numbers:
        problem = "pulses unknown, so pulse_id and multiplicity are None: the pulse number is zero for all ions"
    elif n_decreases:
        problem = (
            "pulses uncertain, so only consecutive ions with the same pulse number are grouped: the number decreases "
            f"at {n_decreases} rows"
        )
    else:
        return True
    warn(f"{str(path)!r}: {problem}", DataWarning)
    return has_numbers


class EveryCheck:
    """Check, block by block, that a column has n for every ion of a pulse of n ions."""

    def __init__(self) -> None:
        self.largest = 0
        self._good = True
        self._rest = np.empty(0, np.uint32)  # rows of the last pulse, if it is not complete

    def add(self, ions: NDArray[np.integer]) -> None:
        """Check the next rows of the column."""
        for start in range(0, len(ions), _BLOCK):
            self._good = self._good and self._add_block(ions[start : start + _BLOCK])

    def _add_block(self, ions):
        low, high = int(ions.min()), int(ions.max())
        self.largest = max(self.largest, high)
        if low == high == 1:
            return not len(self._rest)
        rows = np.concatenate([self._rest, ions])
        if low < 1 or first_from_every(rows, cut=True) is None:
            return False
        others = np.flatnonzero(rows != rows[-1])
        last = rows[others[-1] + 1 :] if len(others) else rows
        self._rest = last[len(last) - len(last) % int(rows[-1]) :].copy()
        return True

    def holds(self, cut: bool) -> bool:
        """Whether it is so in the whole column; `cut` if the end of the file is missing."""
        return self._good and (cut or not len(self._rest))


def first_from_every(multiplicity: NDArray[np.integer], *, cut: bool = False) -> NDArray[np.uint32] | None:
    """Convert n for every ion of a pulse to n for the first and 0 for the others; None if this is not possible.

    With `cut`, the last pulse may have fewer rows.
    """
    multiplicity = multiplicity.astype(np.int64)
    runs = first_from_equal(multiplicity)
    first = np.flatnonzero(runs)
    sizes = multiplicity[first]
    incomplete = runs[first] % sizes if (sizes > 0).all() else np.ones(1)
    if (incomplete[:-1] if cut and len(sizes) else incomplete).any() or not (sizes > 0).all():
        return None
    within = np.arange(len(runs)) - np.repeat(first, runs[first])
    return np.where(within % multiplicity == 0, multiplicity, 0).astype(np.uint32)


def ions_per_pulse(numbers: NDArray[Any]) -> tuple[NDArray[np.uint32] | None, str]:
    """Ions per pulse for the first ion of each pulse and 0 for the others, from numbers for the first or for all ions.

    None if the numbers are inconsistent; the second result says why.
    """
    if numbers.dtype.kind not in "iu":
        return None, f"it has values of type {numbers.dtype}"
    check = PulseCheck()
    check.add(numbers)
    problem = check.problem(False)
    if not problem and numbers.min() >= 0:
        return numbers.astype(np.uint32), ""
    return first_from_every(numbers), problem


def whole_pulses(ions: NDArray[np.integer]) -> int:
    """Number of rows in complete pulses, for rows that begin with a pulse (n for its first ion, 0 for the others)."""
    last = int(np.flatnonzero(ions)[-1])
    return len(ions) if len(ions) - last >= ions[last] else last
