"""Whether the ions of phases leave in bursts, one plane after another, so that no smooth surface describes them."""

from __future__ import annotations

import math

import numpy as np

from apt_evap._common.types import Booleans, Floats

BURST_GATE = 0.85
"""Largest variation of the rate of phases whose fields are found: 0.7 to 0.8 for spheres of 0.8 times the field about
[011], 0.9 to 1.3 about [111] and [001], at most 0.45 about [012]. Chosen on one of each in views of 25 and 30 degrees,
and judged on four that were made after it: eight of eight views are right. Spheres of 0.9, 0.5 to 0.7, are not."""

_WINDOW = 0.4  # of the distance of atoms, 0.1 nm for Al: less than the planes of poles that have terraces, 0.14 to 0.23
_FEWEST_WINDOWS = 10  # in which phases leave, 4 to 7 planes of these poles


def rate_variation(members: Booleans, depths: Floats, atomic_volume: float, after: float) -> float:
    """Standard deviation of the rate at which ions of phases leave, over its mean, without the noise of the counts.

    Parameters
    ----------
    members : ndarray of bool
        Ions of the phases, in sequence, shape (n,).
    depths : ndarray
        Depth of the apex of a cap that keeps its shape after each ion [nm], shape (n,).
    atomic_volume : float
        Volume of an atom [nm^3].
    after : float
        Depth from which ions are counted [nm].

    Returns
    -------
    float
        0 if they leave evenly or for less than a nanometre, 1 if all leave in every second window of a tenth of it.
    """
    width = _WINDOW * atomic_volume ** (1 / 3)
    windows = math.ceil(depths[-1] / width)
    counts = np.bincount(np.minimum((depths / width).astype(np.intp), windows - 1)[members], minlength=windows)
    counts = counts[math.ceil(after / width) :].astype(np.float64)
    sums, changes = counts[1:] + counts[:-1], np.diff(counts)
    squares = float((sums**2).sum())
    if squares == 0 or sums.sum() ** 2 < _FEWEST_WINDOWS * squares:  # the edges of a short phase are not bursts
        return 0.0
    return math.sqrt(2 * max(0.0, float((changes**2 - sums).sum())) / squares)
