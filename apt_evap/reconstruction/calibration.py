"""Calibration of a reconstruction: image compression from poles, spacing of lattice planes from distances of ions."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats, Integers
from apt_evap._common.validation import check_array, check_count, check_number, short_text

_CHUNK = 1024  # reference ions at a time
_HARMONIC = 0.5  # the fundamental has at least this fraction of the largest amplitude: harmonics can be as large


@dataclass(frozen=True, eq=False)
class DistributionMap:
    """Spatial distribution map: distances along an axis between ions that are close to each other across it.

    Parameters
    ----------
    edges : ndarray
        Edges of the bins of the distance [nm], shape (n + 1,).
    counts : ndarray
        Pairs in each bin, shape (n,).
    references : int
        Ions whose neighbours were counted; fewer than all if there were too many pairs.
    spacing : float
        Period of the counts, the spacing of the planes [nm].
    amplitude : float
        Fourier amplitude at this period: 1 for perfect planes, about 0 without planes.
    """

    edges: Floats = field(repr=False)
    counts: Integers = field(repr=False)
    references: int
    spacing: float
    amplitude: float

    @property
    def centres(self) -> Floats:
        """Centres of the bins [nm], shape (n,)."""
        return (self.edges[:-1] + self.edges[1:]) / 2

    @property
    def depth_resolution(self) -> float:
        r"""Standard deviation of the ions about their planes [nm].

        From the amplitude A and the spacing d: :math:`A = \exp(-4 \pi^2 \sigma^2 / d^2)`, for normal deviations of
        both ions of a pair. Infinite for an amplitude of 0 or less.
        """
        if self.amplitude <= 0:
            return math.inf
        return self.spacing / (2 * math.pi) * math.sqrt(max(0.0, -math.log(self.amplitude)))


def compression_from_poles(crystal_angles: ArrayLike, observed_angles: ArrayLike) -> float:
    """Image compression from the angles between poles.

    Parameters
    ----------
    crystal_angles : array_like
        Angles between pairs of poles in the crystal [degrees], shape (n,).
    observed_angles : array_like
        Angles between the same poles on the detector, of straight flights [degrees], shape (n,).

    Returns
    -------
    float
        Mean of the ratios of the crystal angle to the observed angle.

    Raises
    ------
    ValueError
        If there is no pair, or an angle is not > 0.

    Examples
    --------
    The (002) and (111) poles of a cubic crystal, 54.7 degrees apart, seen at 35.1 degrees:

    >>> round(ae.reconstruction.compression_from_poles([54.74], [35.1]), 2)
    1.56
    """
    crystal = check_array(crystal_angles, "crystal_angles", ("n",))
    if not len(crystal):
        raise ValueError(f"crystal_angles must contain at least one angle, got {short_text(crystal_angles)}")
    observed = check_array(observed_angles, "observed_angles", (len(crystal),))
    for name, angles in (("crystal_angles", crystal), ("observed_angles", observed)):
        if angles.min() <= 0 or angles.max() > 180:
            wrong = angles[(angles <= 0) | (angles > 180)][0]
            raise ValueError(f"{name} must be > 0 and <= 180 degrees, got {wrong:g}")
    return float((crystal / observed).mean())


def distribution_map(
    positions: ArrayLike,
    axis: int | ArrayLike = 2,
    *,
    lateral: float = 0.5,
    reach: float = 1.0,
    bins: int = 400,
    centre: ArrayLike | None = None,
    radius: float | None = None,
    max_pairs: int = 1_000_000,
    seed: int = 0,
) -> DistributionMap:
    """Spatial distribution map of reconstructed ions along an axis, with the spacing of the lattice planes.

    Parameters
    ----------
    positions : array_like
        Reconstructed positions [nm], shape (n, 3).
    axis : int or array_like
        0, 1 or 2 for x, y or z, or a direction such as a pole, shape (3,).
    lateral : float
        Largest distance of the two ions of a pair across the axis [nm].
    reach : float
        Largest distance along the axis [nm]; several spacings.
    bins : int
        Number of bins from -reach to reach.
    centre : array_like, optional
        Point on the axis of a cylinder [nm], shape (3,); by default the mean of the positions. Only with `radius`.
    radius : float, optional
        Radius of the cylinder along the axis that the ions are taken from [nm]; all ions by default.
    max_pairs : int
        Once this number of pairs is reached, the remaining ions are not taken as references.
    seed : int
        Seed of the random order of the references.

    Returns
    -------
    DistributionMap

    Raises
    ------
    ValueError
        If there are too few ions, or no pair of them is close enough.

    Notes
    -----
    The spacing is the period of the Fourier component with the largest amplitude, after multiplication with a Hann
    window. A component of a longer period is preferred if it has at least half of this amplitude, as planes without
    scatter have harmonics of equal amplitudes. Periods are searched from four bins to reach / 1.5.
    """
    points = check_array(positions, "positions", ("n", 3))
    frame = _frame(axis)
    lateral = check_number(lateral, "lateral", above=0, unit="nm")
    reach = check_number(reach, "reach", above=0, unit="nm")
    bins = check_count(bins, "bins", at_least=16, at_most=1_000_000)
    max_pairs = check_count(max_pairs, "max_pairs", at_least=1)
    seed = check_count(seed, "seed")
    if radius is not None:
        radius = check_number(radius, "radius", above=0, unit="nm")
    if centre is not None:
        centre = check_array(centre, "centre", (3,))
    across, along = points @ frame[:, :2], points @ frame[:, 2]
    if radius is not None and len(points):
        middle = (points.mean(axis=0) if centre is None else centre) @ frame[:, :2]
        near = np.hypot(*(across - middle).T) <= radius
        across, along = across[near], along[near]
    if len(along) < 2:
        raise ValueError(f"positions must have at least 2 ions within the radius, got {len(along)}")
    counts, references = _pair_counts(across, along, lateral, reach, bins, max_pairs, seed)
    if not counts.any():
        raise ValueError(f"no two ions are within {lateral:g} nm across and {reach:g} nm along the axis, got no pair")
    edges = np.linspace(-reach, reach, bins + 1)
    spacing, amplitude = period_of((edges[:-1] + edges[1:]) / 2, counts, reach)
    return DistributionMap(edges, counts, references, spacing, amplitude)


def _frame(axis: Any) -> Floats:
    """Unit vectors as columns; the last one along the axis."""
    if np.ndim(axis) == 0:
        axis = check_count(axis, "axis", at_most=2)
        return np.roll(np.eye(3), axis + 1, axis=1)
    direction = check_array(axis, "axis", (3,))
    length = float(np.linalg.norm(direction))
    if length == 0:
        raise ValueError(f"axis must be a direction, got {short_text(axis)}")
    direction = direction / length
    first = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(direction, first), direction])


def _pair_counts(across, along, lateral, reach, bins, max_pairs, seed):
    """Histogram of the distances along the axis, and the number of reference ions."""
    scaled = np.column_stack([across / lateral, along / reach])  # a pair is within 1 in each coordinate
    tree = scipy.spatial.cKDTree(scaled)
    order = np.random.default_rng(seed).permutation(len(along))
    counts, pairs, done = np.zeros(bins, np.int64), 0, 0
    while done < len(order) and pairs < max_pairs:
        references = order[done : done + _CHUNK]
        done += len(references)
        neighbours = tree.query_ball_point(scaled[references], 1.0, p=np.inf, return_sorted=False)
        first = np.repeat(references, [len(numbers) for numbers in neighbours])
        second = np.concatenate([np.asarray(numbers, np.intp) for numbers in neighbours])
        close = ((across[first] - across[second]) ** 2).sum(axis=1) <= lateral * lateral
        close &= first != second
        counts += np.histogram(along[second[close]] - along[first[close]], bins, (-reach, reach))[0]
        pairs = int(counts.sum())
    return counts, done


def frequencies_of_planes(reach: float, width: float) -> Floats:
    """Frequencies [1/nm] of the periods that are compared, from reach / 1.5 to four bins of this width [nm]."""
    return np.arange(1.5 / reach, 1 / (4 * width), 0.05 / reach)


def period_of(distances: Floats, counts: Any, reach: float, waves: Floats | None = None) -> tuple[float, float]:
    """Period of the counts of equal bins [nm] and its Fourier amplitude, divided by that of the sum.

    The cosines of `frequencies_of_planes` at the distances, if known, are `waves`.
    """
    weights = counts * np.cos(math.pi * distances / (2 * reach)) ** 2
    total = float(weights.sum())
    width = float(distances[1] - distances[0])
    frequencies = frequencies_of_planes(reach, width)

    def amplitude(frequency):
        return float(weights @ np.cos(2 * math.pi * frequency * distances)) / total

    if waves is None:
        amplitudes = np.array([amplitude(frequency) for frequency in frequencies])
    else:
        amplitudes = waves @ weights / total
    peaks = np.flatnonzero((amplitudes[1:-1] >= amplitudes[:-2]) & (amplitudes[1:-1] > amplitudes[2:])) + 1
    if not len(peaks):
        return math.nan, 0.0
    first = peaks[amplitudes[peaks] >= _HARMONIC * amplitudes[peaks].max()][0]
    step = 0.05 / reach
    best = scipy.optimize.minimize_scalar(
        lambda frequency: -amplitude(frequency),
        bounds=(frequencies[first] - step, frequencies[first] + step),
        method="bounded",
        options={"xatol": 1e-6 / reach},
    )
    # bins of finite width reduce the amplitude by a sinc
    return 1 / float(best.x), min(1.0, -float(best.fun) / float(np.sinc(best.x * width)))
