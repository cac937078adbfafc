"""Lattice planes at a pole of a reconstruction: their spacing, their normal, and whether there are any."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_count, check_number, check_seed
from apt_evap.reconstruction.calibration import (
    DistributionMap,
    distribution_map,
    frequencies_of_planes,
    period_of,
)

_FEWEST = 50  # ions
_LATERAL = 0.5  # largest distance of two ions across the normal [nm]
_SEARCH_VECTORS = 80_000  # pairs of the search; some 20,000 of them are counted for a normal: an amplitude within 0.01
_MOST_VECTORS = 2_000_000  # pairs for the error of the spacing
_BINS = 200  # of a distance along the normal
_GROUPS = 8  # of ions, left out in turn for the error of the spacing


@dataclass(frozen=True, eq=False)
class LatticePlanes:
    """Lattice planes in a cylinder of reconstructed ions.

    Parameters
    ----------
    distances : DistributionMap
        Distances along the normal, with the spacing and the amplitude.
    normal : ndarray, shape (3,)
        Unit vector for which the planes are sharpest, with z > 0.
    spacing_error : float
        Standard error of the spacing [nm].
    amplitude : float
        Amplitude of the search, which `by_chance` compares with.
    by_chance : ndarray, shape (n,)
        Amplitudes of the same search in the same ions without planes: shifted along z at random, by up to the reach.
    """

    distances: DistributionMap
    normal: Floats
    spacing_error: float
    amplitude: float
    by_chance: Floats = field(repr=False)

    @property
    def found(self) -> bool:
        """Whether the planes are sharper than those that chance makes in all specimens without planes."""
        return bool(self.amplitude > self.by_chance.max(initial=0.0))

    @property
    def spacing(self) -> float:
        """Spacing of the planes [nm]."""
        return self.distances.spacing

    @property
    def tilt(self) -> float:
        """Angle of the normal from z [degrees]."""
        return math.degrees(math.acos(min(1.0, float(self.normal[2]))))

    def __str__(self) -> str:
        sharpest = self.by_chance.max(initial=0.0)
        without = f"1 of {len(self.by_chance) + 1} specimens without planes has more than {sharpest:.3f}"
        chance = f"amplitude {self.amplitude:.3f}; {without}"
        ions = f"of {self.distances.references:,} ions"
        if not self.found:
            return f"no planes: {chance}, {ions}"
        return (
            f"spacing {self.spacing:.4f} ± {self.spacing_error:.4f} nm, {chance}\n"
            f"scatter about the planes {self.distances.depth_resolution:.3f} nm, {ions}\n"
            f"normal ({', '.join(f'{part:.3f}' for part in self.normal)}), {self.tilt:.1f} degrees from z"
        )


def find_planes(
    positions: ArrayLike,
    at: ArrayLike | None = None,
    *,
    radius: float = 1.0,
    widest: float = 10.0,
    reach: float = 1.0,
    seed: int = 0,
    scattered: int = 19,
) -> LatticePlanes:
    """Lattice planes in a cylinder of reconstructed ions: their spacing, and the normal for which they are sharpest.

    Parameters
    ----------
    positions : array_like
        Reconstructed positions [nm], shape (n, 3).
    at : array_like, optional
        x and y of the axis of the cylinder, which is along z [nm], shape (2,); by default the mean of the ions.
    radius : float
        Radius of the cylinder [nm].
    widest : float
        Largest angle of the normal from z [degrees]; 0 for z itself.
    reach : float
        Largest distance of two ions along the normal [nm]; several spacings.
    seed : int
        Seed of the random shifts and of the choice of pairs.
    scattered : int
        Specimens without planes that the amplitude is compared with; of 0 planes are always `found`.

    Returns
    -------
    LatticePlanes

    Raises
    ------
    ValueError
        If there are fewer than 50 ions in the cylinder, or no two of them are close enough.

    Notes
    -----
    Normals about 2 degrees apart are compared with 80,000 pairs of ions, then refined by a simplex. A search always
    finds a sharpest normal. So it is repeated in specimens without planes: the same ions, shifted along z at random. By
    chance one is sharper than 19 of these in 1 of 20 cases. The error of the spacing is that of the jackknife, with an
    eighth of the ions left out in turn.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> ions = rng.random((2000, 3)) * (4, 4, 0) + rng.integers(0, 20, (2000, 1)) * (0, 0, 0.2)
    >>> planes = ae.reconstruction.find_planes(ions)
    >>> planes.found, round(planes.spacing, 3), bool(planes.tilt < 0.5)
    (True, 0.2, True)
    >>> ae.reconstruction.find_planes(rng.random((2000, 3)) * 4).found
    False
    """
    points = check_array(positions, "positions", ("n", 3))
    radius = check_number(radius, "radius", above=0, unit="nm")
    widest = check_number(widest, "widest", at_least=0, at_most=60, unit="degrees")
    reach = check_number(reach, "reach", above=0, unit="nm")
    centre = points[:, :2].mean(axis=0) if at is None else check_array(at, "at", (2,))
    chosen = points[np.hypot(*(points[:, :2] - centre).T) <= radius]
    if len(chosen) < _FEWEST:
        raise ValueError(f"the cylinder must hold at least {_FEWEST} ions, got {len(chosen)}")
    rng = np.random.default_rng(check_seed(seed))
    normal, amplitude = _sharpest(chosen, widest, reach, rng)
    by_chance = np.empty(check_count(scattered, "scattered"))
    for number in range(len(by_chance)):
        shifts = rng.uniform(-reach, reach, len(chosen))
        by_chance[number] = _sharpest(chosen + shifts[:, None] * (0, 0, 1), widest, reach, rng)[1]
    distances = distribution_map(chosen, normal, reach=reach)
    error = _spacing_error(chosen, normal, reach, rng)
    return LatticePlanes(distances, normal, error, amplitude, by_chance)


def _spacing_error(points, normal, reach, rng):
    """Standard error of the spacing by the jackknife [nm]: groups of ions are left out in turn."""
    vectors, first, second = _vectors(points, reach, rng, _MOST_VECTORS)
    group = rng.permutation(len(points)) % _GROUPS
    spacings = []
    for left in range(_GROUPS):
        kept = (group[first] != left) & (group[second] != left)
        middles, counts = _histogram(vectors[kept], normal, reach)
        spacings.append(period_of(middles, counts, reach, _waves(reach))[0] if counts.any() else math.nan)
    return math.sqrt(_GROUPS - 1) * float(np.std(spacings))


def _sharpest(points, widest, reach, rng):
    """Normal with the largest amplitude, and that amplitude."""
    vectors = _vectors(points, reach, rng, _SEARCH_VECTORS)[0]
    waves = _waves(reach)

    def along(tilts):
        x, y = np.tan(np.radians(tilts))
        return np.array([x, y, 1.0]) / math.sqrt(x * x + y * y + 1)

    def blur(tilts):
        if float(np.hypot(*tilts)) > widest:
            return 0.0
        middles, counts = _histogram(vectors, along(tilts), reach)
        return -period_of(middles, counts, reach, waves)[1] if counts.any() else 0.0

    steps = np.linspace(-widest, widest, 2 * math.ceil(widest / 2) + 1) if widest else np.zeros(1)
    start = min(((x, y) for x in steps for y in steps), key=blur)
    best, value = start, blur(start)
    if widest:
        options = {"xatol": 0.05, "fatol": 1e-4, "initial_simplex": np.add(start, [(0, 0), (0.8, 0), (0, 0.8)])}
        refined = scipy.optimize.minimize(blur, start, method="Nelder-Mead", options=options)
        if refined.fun < value:
            best, value = tuple(refined.x), float(refined.fun)
    return along(best), -value


def _vectors(points, reach, rng, most):
    """Vectors between the ions of pairs that are close enough for some normal [nm], and the numbers of these ions."""
    tree = scipy.spatial.cKDTree(points)
    firsts, seconds, n_pairs = [np.empty(0, np.intp)], [np.empty(0, np.intp)], 0
    order = rng.permutation(len(points))
    for begin in range(0, len(points), 64):
        references = order[begin : begin + 64]
        near = tree.query_ball_point(points[references], math.hypot(reach, _LATERAL), return_sorted=False)
        first = np.repeat(references, [len(numbers) for numbers in near])
        second = np.concatenate([np.asarray(numbers, np.intp) for numbers in near])
        firsts.append(first[first != second])
        seconds.append(second[first != second])
        n_pairs += len(firsts[-1])
        if n_pairs >= most:
            break
    first, second = np.concatenate(firsts), np.concatenate(seconds)
    return points[second] - points[first], first, second


def _histogram(vectors, normal, reach):
    """Middles of the bins of the distance along a normal [nm], and the pairs in each."""
    distance = vectors @ normal
    across = (vectors * vectors).sum(axis=1) - distance * distance
    bins = np.abs(distance[across <= _LATERAL * _LATERAL]) * (_BINS / reach)
    counts = np.bincount(bins[bins < _BINS].astype(np.intp), minlength=_BINS)
    return (np.arange(_BINS) + 0.5) * (reach / _BINS), counts


def _waves(reach):
    """Cosines of all frequencies that are compared, at the middles of the bins."""
    middles = (np.arange(_BINS) + 0.5) * (reach / _BINS)
    return np.cos(2 * math.pi * frequencies_of_planes(reach, reach / _BINS)[:, None] * middles)
