"""The course of the voltage: its average over a depth, without jumps and restarts that are the instrument's."""

from __future__ import annotations

import numpy as np
import scipy

from apt_evap._common.types import Floats, Integers

JUMP = 0.012
"""Least relative change of the voltage at once, beyond that just before and after it, that is the instrument's. A phase
of 1.15 times the field changes it by 0.002 within the same depth, but steadily."""

_FINE = 30  # blocks of the depth over which the voltage is averaged
_NOISE = 6.0  # standard deviations of the differences
_LEVEL = 6  # blocks whose median is a level
_CALM = 0.005  # relative change within as many blocks, from which a restart is over
_RECOVERED = 0.5  # of a fall, from which it is a restart
_GAP = 2 * _FINE  # blocks between the beginning of a restart and its end


def without_jumps(voltages: Floats, width: float) -> tuple[Floats, int]:
    """Factor of each voltage that takes out jumps and restarts, and their number; voltages are means of `width` ions.

    The specimen changes the voltage within a tenth of a nanometre and more of depth, as it evaporates; an instrument at
    once. After a jump all voltages are scaled to the level before. A restart begins lower and recovers: there the
    voltage is interpolated.
    """
    means, starts = block_means(voltages, max(1, int(width / _FINE)))
    logarithms = np.log(means)
    jumps = np.zeros(len(means), bool)
    noise = 0.0
    if len(means) > 4 * _LEVEL:
        steps = logarithms[2:] - logarithms[:-2]  # around each block, which may hold part of a jump
        steps -= scipy.ndimage.median_filter(steps, 2 * _LEVEL + 1, mode="nearest")
        noise = 1.4826 * float(np.median(np.abs(steps)))
        jumps[1:-1] = np.abs(steps) > max(JUMP, _NOISE * noise)
    found = [int(block) for block in np.flatnonzero(jumps)]
    clean, events, after, last = logarithms.copy(), 0, 0, len(means) - _LEVEL
    for block in found:
        first = max(block - 1, 0)  # the block before may be part of it
        if block < after or first < _LEVEL or block > last - 1:
            continue
        end = block + 1
        before = clean[first - 1] - clean[first - _LEVEL]
        while end < min(last, block + _GAP) and (
            jumps[end : end + _LEVEL].any()
            or abs(clean[end + _LEVEL - 1] - clean[end] - before) > max(_CALM, 3 * noise)
        ):
            end += 1
        level = float(np.median(clean[first - _LEVEL : first]))
        change = float(np.median(clean[end : end + _LEVEL])) - level
        lowest = float(clean[first:end].min()) - level
        if lowest > -JUMP or change - lowest < -_RECOVERED * lowest:  # it stays
            clean[end:] -= change
            change = 0.0
        clean[first:end] = level + change * np.linspace(0, 1, end - first)
        events, after = events + 1, end
    factors = np.exp(clean - logarithms)
    if not events:
        return np.ones(len(voltages)), 0
    blocks = np.searchsorted(starts, np.arange(len(voltages)), side="right") - 1
    return factors[blocks], events


def smoothed(voltages: Floats, width: float) -> Floats:
    """Voltages averaged by a Gaussian of a width in ions, shape (n,)."""
    # of means of blocks, an eighth as wide: a Gaussian over 10,000 ions at each of a million takes a minute
    size = max(1, int(width / 8))
    means, starts = block_means(voltages, size)
    sizes = np.diff(np.append(starts, len(voltages)))
    means = scipy.ndimage.gaussian_filter1d(means, max(width / size, 1.0), mode="nearest")
    return np.asarray(np.interp(np.arange(len(voltages)), starts + (sizes - 1) / 2, means))


def block_means(values: Floats, size: int) -> tuple[Floats, Integers]:
    """Means of blocks of the sequence, and the number of their first values."""
    starts = np.arange(0, len(values), size)
    return np.add.reduceat(values, starts) / np.diff(np.append(starts, len(values))), starts
