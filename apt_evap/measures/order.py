"""Order: radial distribution functions, and Warren-Cowley parameters beside those of random labels."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats, Integers
from apt_evap._common.validation import check_array, check_count, check_number, check_seed
from apt_evap.measures.triangle_mesh import ConvexHull


@dataclass(frozen=True, eq=False)
class RadialDistribution:
    """Density of one species about another one over its mean, by the distance.

    Parameters
    ----------
    edges : ndarray
        Edges of the shells [nm], shape (k + 1,).
    pairs : ndarray of int
        Number of pairs, shape (k,).
    g : ndarray
        Their density over the mean density, shape (k,).
    random : ndarray
        The same for random labels of the same positions, shape (k,): that of all ions about all ions.
    centres : int
        Number of ions about which was counted.
    """

    edges: Floats = field(repr=False)
    pairs: Integers = field(repr=False)
    g: Floats = field(repr=False)
    random: Floats = field(repr=False)
    centres: int

    @property
    def errors(self) -> Floats:
        """Standard deviation of g by the number of pairs, shape (k,); NaN without pairs."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.g / np.sqrt(self.pairs)


@dataclass(frozen=True, eq=False)
class ShortRangeOrder:
    """Species of the neighbours of each species, beside those of random labels.

    Parameters
    ----------
    shell : tuple of float
        Neighbours are at distances above the first and up to the second number [nm].
    pairs : ndarray of int
        Number of neighbours of species j of all ions of species i, shape (k, k).
    fractions : ndarray
        Fraction of each species among all ions, shape (k,).
    parameters : ndarray
        Warren-Cowley parameters, shape (k, k); NaN for a species without neighbours.
    random, random_deviations : ndarray
        Their means and standard deviations for random labels of the same positions, shape (k, k).
    """

    shell: tuple[float, float]
    pairs: Integers = field(repr=False)
    fractions: Floats = field(repr=False)
    parameters: Floats
    random: Floats = field(repr=False)
    random_deviations: Floats = field(repr=False)

    @property
    def neighbours(self) -> Floats:
        """Fraction of species j among the neighbours of species i, shape (k, k): the table of nearest neighbours."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.pairs / self.pairs.sum(axis=1, keepdims=True)


def radial_distribution(
    positions: ArrayLike,
    about: ArrayLike,
    of: ArrayLike,
    reach: float = 2.0,
    step: float = 0.02,
    centres: int = 5_000,
    seed: int = 0,
) -> RadialDistribution:
    """Partial radial distribution function g(r).

    Parameters
    ----------
    positions : array_like
        Positions of all ions [nm], shape (n, 3).
    about, of : array_like of bool
        The ions about which is counted, and those that are counted, shape (n,).
    reach : float
        Largest distance [nm]. Only ions that are deeper than this in the convex hull of all ions are centres, so that
        no shell leaves it.
    step : float
        Thickness of the shells [nm].
    centres : int
        Most centres; of more, some are drawn.
    seed : int
        Seed of this draw.

    Returns
    -------
    RadialDistribution

    Raises
    ------
    ValueError
        If no ion is deep enough, or none is counted.

    Notes
    -----
    The mean density is that of the counted ions within the convex hull. A concave cloud has a smaller density there.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> cloud, every = 10 * rng.random((5000, 3)), np.ones(5000, bool)
    >>> print(ae.measures.radial_distribution(cloud, every, every, step=0.5).g.round(1))
    [1. 1. 1. 1.]
    """
    places = check_array(positions, "positions", ("n", 3))
    first, second = (
        check_array(mask, name, (len(places),), dtype=bool) for mask, name in ((about, "about"), (of, "of"))
    )
    reach = check_number(reach, "reach", above=0, unit="nm")
    step = check_number(step, "step", above=0, at_most=reach, unit="nm")
    most = check_count(centres, "centres", at_least=1)
    random = np.random.default_rng(check_seed(seed))
    hull = ConvexHull(places)
    inner = hull.deeper(places, reach)
    if not second.any() or not (inner & first).any():
        raise ValueError(
            f"about must mark ions deeper than reach = {reach:g} nm in the hull of the ions, and `of` some ion, got "
            f"{np.count_nonzero(inner & first):,} and {np.count_nonzero(second):,}"
        )
    edges = np.append(np.arange(0.0, reach - 1e-9 * step, step), reach)
    everything = np.ones(len(places), bool)
    counted = []
    for centre, other in ((first, second), (everything, everything)):
        rows = np.flatnonzero(inner & centre)
        rows = rows if len(rows) <= most else np.sort(random.choice(rows, most, replace=False))
        tree = scipy.spatial.cKDTree(places[rows])
        below = tree.count_neighbors(scipy.spatial.cKDTree(places[other]), edges)
        below = below - np.count_nonzero(other[rows])  # an ion is no neighbour of its own
        below[0] = 0
        pairs = np.diff(below)
        expected = len(rows) * np.count_nonzero(other) / hull.volume * 4 / 3 * np.pi * np.diff(edges**3)
        counted.append((pairs, pairs / expected, len(rows)))
    return RadialDistribution(edges, counted[0][0], counted[0][1], counted[1][1], counted[0][2])


def short_range_order(
    positions: ArrayLike, species: ArrayLike, shell: float | tuple[float, float], trials: int = 20, seed: int = 0
) -> ShortRangeOrder:
    r"""Warren-Cowley parameters of all pairs of species in a shell of neighbours.

    Parameters
    ----------
    positions : array_like
        Positions [nm], shape (n, 3).
    species : array_like of int
        Species of each ion, from 0, shape (n,); ions below 0 are left out.
    shell : float or tuple of float
        Largest distance of neighbours, or smallest and largest [nm].
    trials : int
        Number of permutations of the labels.
    seed : int
        Seed of the permutations.

    Returns
    -------
    ShortRangeOrder

    Raises
    ------
    ValueError
        If there are fewer than two species, or no neighbours in the shell.

    Notes
    -----
    :math:`\alpha_{ij} = 1 - p_{ij} / x_j`, with the fraction :math:`p_{ij}` of j among the neighbours of i, and the
    fraction :math:`x_j` among all ions (J. M. Cowley, Phys. Rev. 77, 669 (1950)). It is 0 for a random alloy. For
    :math:`i = j` it is negative if like ions are neighbours, and 1 if they never are.

    Examples
    --------
    >>> chain = np.column_stack([0.25 * np.arange(100), np.zeros(100), np.zeros(100)])
    >>> ae.measures.short_range_order(chain, np.arange(100) % 2, 0.3).parameters
    array([[ 1., -1.],
           [-1.,  1.]])
    """
    places = check_array(positions, "positions", ("n", 3))
    labels = check_array(species, "species", (len(places),), dtype=np.int64)
    places, labels = places[labels >= 0], labels[labels >= 0]
    low, high = (0.0, shell) if np.ndim(shell) == 0 else check_array(shell, "shell", (2,)).tolist()  # type: ignore[arg-type]
    check_number(low, "shell", at_least=0, unit="nm")
    high = check_number(high, "the second of shell", above=low, unit="nm")
    trials = check_count(trials, "trials", at_least=2)
    if len(np.unique(labels)) < 2:
        raise ValueError(f"species must be at least two of known ions, got {len(np.unique(labels))} of {len(places):,}")
    random = np.random.default_rng(check_seed(seed))
    pairs = neighbour_pairs(places, high, low)
    if not len(pairs):
        raise ValueError(f"shell must hold neighbours, got none of {len(places):,} ions from {low:g} to {high:g} nm")
    k = int(labels.max()) + 1
    fractions = np.bincount(labels, minlength=k) / len(labels)
    if k * k <= 256:
        labels = labels.astype(np.uint8)  # the neighbours of an ion are anywhere in memory: 10 million fit in a cache
    pairs = np.ascontiguousarray(pairs.T)
    counts = _counted(pairs, labels, k)
    shuffled = np.array([_parameters(_counted(pairs, random.permutation(labels), k), fractions) for _ in range(trials)])
    return ShortRangeOrder(
        (low, high), counts, fractions, _parameters(counts, fractions), shuffled.mean(axis=0),
        shuffled.std(axis=0, ddof=1),
    )  # fmt: skip


def neighbour_pairs(positions: Floats, high: float, low: float = 0.0) -> Integers:
    """Rows of neighbours, each pair once, shape (m, 2)."""
    pairs = scipy.spatial.cKDTree(positions).query_pairs(high, output_type="ndarray")
    if low > 0:
        pairs = pairs[np.linalg.norm(positions[pairs[:, 0]] - positions[pairs[:, 1]], axis=1) > low]
    return pairs


def _counted(pairs, labels, k):
    """Number of ordered pairs of shape (2, m) by species, shape (k, k)."""
    numbers = np.bincount(labels[pairs[0]] * labels.dtype.type(k) + labels[pairs[1]], minlength=k * k).reshape(k, k)
    return numbers + numbers.T


def _parameters(counts, fractions):
    """1 - p / x."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return 1 - counts / counts.sum(axis=1, keepdims=True) / fractions
