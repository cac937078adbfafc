"""Clusters of solutes: maximum separation and its parameters, envelope and erosion, distances of neighbours."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.codec import count, number, settings
from apt_evap._common.types import Booleans, Floats, Integers
from apt_evap._common.validation import check_array, check_count, check_seed
from apt_evap.measures.triangle_mesh import ConvexHull

_LEVEL = 0.05  # clusters by chance over clusters, and p-value: the usual 5 %
_SEPARATIONS = np.linspace(0.3, 1.2, 19)  # in Wigner-Seitz radii of the solutes, which percolate at 1.4
_SAMPLE = 20_000  # ions by which a volume is measured: 0.4 % of the whole at most
_LONE = 10.0  # solutes: so many may be linked among few
_SIZES = 1000  # numbers of solutes that N_min is chosen from
_HALVINGS = 5  # of the solutes: one has errors 1.3 times as large where 50 ions count
_ENOUGH = 20_000  # solutes of clusters: of so many, one halving has the same errors as five
_FEWEST = 3  # ions that make a cluster at least: a pair has no shape


@settings
class ClusterSettings:
    """Settings of the maximum separation method and of DBSCAN.

    Examples
    --------
    >>> ae.measures.ClusterSettings(d_max=0.5, n_min=20, envelope=0.5, erosion=0.5)
    ClusterSettings(d_max=0.5, n_min=20, order=1, envelope=0.5, erosion=0.5)
    """

    d_max: float = number("Solutes within this distance belong together.", above=0, unit="nm")
    n_min: int = count("Fewest solutes of a cluster.", default=10, at_least=1)
    order: int = count(
        "Number of solutes within d_max of a core of a cluster: 1 is maximum separation, more are the core points of "
        "DBSCAN (with min_samples = order + 1). Solutes that are not cores join the nearest core within d_max.",
        default=1,
        at_least=1,
    )
    envelope: float | None = number(
        "Ions of all species within this distance of a solute of a cluster join the nearest one; 0 for none. By "
        "default d_max.",
        default=None,
        at_least=0,
        unit="nm",
    )
    erosion: float | None = number(
        "Ions of clusters within this distance of an ion outside all clusters leave them; 0 for none. By default the "
        "envelope, so that the shell of the matrix that joined leaves again.",
        default=None,
        at_least=0,
        unit="nm",
    )


@dataclass(frozen=True, eq=False)
class SeparationChoice:
    """Largest separation and fewest solutes of clusters, chosen against random labels.

    Parameters
    ----------
    d_max : float
        The separation [nm].
    n_min : int
        Fewest solutes, so that clusters by chance are at most 5 % of the clusters.
    p_value : float
        Fraction of the labellings, with the real one, whose largest gain is at least that of the real one.
    separations : ndarray
        Separations that were compared [nm], shape (k,).
    clustered, by_chance : ndarray
        Fraction of the solutes in clusters of at least `fewest` solutes, and its mean over random labels, shape (k,).
    fewest : ndarray of int
        The fewest solutes at each separation, shape (k,).
    """

    d_max: float
    n_min: int
    p_value: float
    separations: Floats = field(repr=False)
    clustered: Floats = field(repr=False)
    by_chance: Floats = field(repr=False)
    fewest: Integers = field(repr=False)

    @property
    def found(self) -> bool:
        """Whether there are more clusters than by chance, at 5 %."""
        return self.p_value <= _LEVEL


@dataclass(frozen=True, eq=False)
class NeighbourDistances:
    """Distances of the k-th nearest solutes of solutes, beside those of random labels.

    Parameters
    ----------
    edges : ndarray
        Edges of the bins of the distance [nm], shape (m + 1,).
    solutes : ndarray of int
        Number of solutes with a distance in each bin, shape (m,).
    random, random_deviations : ndarray
        Mean and standard deviation of these numbers over random labels, shape (m,).
    mean, random_mean, random_mean_deviation : float
        Mean distance, and its mean and standard deviation over random labels [nm].
    p_value : float
        Fraction of the labellings, with the real one, whose mean is at most that of the real one: small if solutes are
        closer together than by chance.
    """

    edges: Floats = field(repr=False)
    solutes: Integers = field(repr=False)
    random: Floats = field(repr=False)
    random_deviations: Floats = field(repr=False)
    mean: float
    random_mean: float
    random_mean_deviation: float
    p_value: float


def label_clusters(positions: ArrayLike, solute: ArrayLike, options: ClusterSettings) -> tuple[Integers, Integers]:
    """Cluster of each solute, and of each ion after envelope and erosion.

    Parameters
    ----------
    positions : array_like
        Positions of all ions [nm], shape (n, 3).
    solute : array_like of bool
        Which ions are solutes, shape (n,).
    options : ClusterSettings
        Separation, fewest solutes, order, envelope and erosion.

    Returns
    -------
    of_solutes, of_ions : ndarray of int64, shape (n,)
        Number of the cluster, from 0 in the order of their number of solutes, the largest first; -1 outside. Equal ones
        are in the order of their first solute.

    Raises
    ------
    ValueError
        If no ion is a solute.

    Notes
    -----
    The steps are those of Vaumousse, Cerezo and Warren, Ultramicroscopy 95, 215 (2003), for cores of any order those of
    Stephenson et al., Microsc. Microanal. 13, 448 (2007). A distance equal to a bound is within it.

    Examples
    --------
    >>> row = np.column_stack([[0.0, 0.3, 0.6, 2.0, 3.0], np.zeros(5), np.zeros(5)])
    >>> ae.measures.label_clusters(row, [True, True, True, True, False], ae.measures.ClusterSettings(0.4, n_min=3))[0]
    array([ 0,  0,  0, -1, -1])
    """
    places, solutes = _checked(positions, solute)
    rows = np.flatnonzero(solutes)
    of_solutes = np.full(len(places), -1)
    of_solutes[rows] = _of_solutes(places[rows], options)
    return of_solutes, _grown(places, of_solutes, *_distances(options))


def _distances(options):
    """Envelope and erosion [nm]."""
    envelope = options.d_max if options.envelope is None else options.envelope
    return envelope, envelope if options.erosion is None else options.erosion


def _grown(places, of_solutes, envelope, erosion):
    """Cluster of each ion after envelope and erosion of clusters of solutes, -1 outside."""
    labels = of_solutes.copy()
    if envelope > 0 and (labels >= 0).any():
        cores, others = np.flatnonzero(labels >= 0), np.flatnonzero(labels < 0)
        labels[others] = _joined(places[cores], labels[cores], places[others], envelope)
    if erosion > 0 and (labels >= 0).any() and (labels < 0).any():
        inside = np.flatnonzero(labels >= 0)
        matrix = scipy.spatial.cKDTree(places[labels < 0])
        bound = np.nextafter(erosion, np.inf)
        labels[inside[matrix.query(places[inside], distance_upper_bound=bound)[0] <= erosion]] = -1
    return labels


def held_out_atoms(
    positions: Floats, solute: Booleans, of_solutes: Integers, atoms: Floats, options: ClusterSettings
) -> Floats:
    """Mean number of atoms of each element in each cluster, where solutes do not count that made the cluster, (k, e).

    Envelope and erosion of a random half of the solutes of the clusters are the region in which the other half counts
    twice: whether an ion in it is a solute of that half or a solvent did not enter into the choice of the region. The
    distances are those of half the solutes, larger by the cube root of 2. `of_solutes` is the number of the cluster of
    each solute, -1 outside, `atoms` has those of each element in each ion, shape (n, e).
    """
    k = int(of_solutes.max(initial=-1)) + 1
    if not k:
        return np.zeros((0, atoms.shape[1]))
    envelope, erosion = (2 ** (1 / 3) * distance for distance in _distances(options))
    tree = scipy.spatial.cKDTree(positions[of_solutes >= 0])
    # no other ions can join, or make one leave
    near = np.flatnonzero(tree.query(positions, distance_upper_bound=(envelope + erosion) * (1 + 1e-9))[0] < np.inf)
    places, members, marked = positions[near], of_solutes[near], solute[near]
    random, total = np.random.default_rng(0), np.zeros((k, atoms.shape[1]))
    halvings = int(np.clip(_ENOUGH // tree.n, 1, _HALVINGS))
    for _ in range(halvings):
        first = random.random(len(near)) < 0.5
        for half in (first, ~first):
            labels = _grown(places, np.where(half, members, -1), envelope, erosion)
            counted = np.flatnonzero((labels >= 0) & ~(marked & half))
            weights = np.where(marked[counted], 2.0, 1.0)
            parts = atoms[near[counted]].T * weights
            total += np.column_stack([np.bincount(labels[counted], part, k) for part in parts])
    return total / (2 * halvings)


def _of_solutes(places, options):
    """Clusters of solutes alone, the largest first, -1 outside."""
    n = len(places)
    pairs = scipy.spatial.cKDTree(places).query_pairs(options.d_max, output_type="ndarray")
    cores = np.bincount(pairs.ravel(), minlength=n) >= options.order
    linked = pairs[cores[pairs[:, 0]] & cores[pairs[:, 1]]]
    label = np.where(cores, _components(linked, n), -1)
    border = np.flatnonzero(~cores)
    if options.order > 1 and cores.any() and len(border):
        label[border] = _joined(places[cores], label[cores], places[border], options.d_max)
    if options.n_min == 1:  # lone solutes are clusters, too
        alone = np.flatnonzero(label < 0)
        label[alone] = n + alone
    found, first, number, sizes = np.unique(label, return_index=True, return_inverse=True, return_counts=True)
    sizes[(found < 0) | (sizes < options.n_min)] = 0
    rank = np.full(len(found), -1)
    order = np.lexsort((first, -sizes))[: np.count_nonzero(sizes)]
    rank[order] = np.arange(len(order))
    return rank[number.ravel()]


def _components(pairs, n):
    """Connected component of each of n points."""
    graph = scipy.sparse.coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    return scipy.sparse.csgraph.connected_components(graph, directed=False)[1].astype(np.int64)


def _joined(cores, labels, others, reach):
    """Label of the nearest core within the reach of other points; -1 without one."""
    distance, nearest = scipy.spatial.cKDTree(cores).query(others, distance_upper_bound=np.nextafter(reach, np.inf))
    return np.append(labels, -1)[np.where(distance <= reach, nearest, len(labels))]


def choose_separation(
    positions: ArrayLike, solute: ArrayLike, trials: int = 19, seed: int = 0, separations: ArrayLike | None = None
) -> SeparationChoice:
    r"""Choose d_max and N_min of the maximum separation method against random labels.

    Parameters
    ----------
    positions, solute
        As for `label_clusters`.
    trials : int
        Number of random labellings of the same positions, at least 19: the smallest p-value is 1 / (trials + 1).
    seed : int
        Seed of the labels.
    separations : array_like, optional
        Separations to compare [nm], increasing; by default 19 from 0.3 to 1.2 Wigner-Seitz radii of the solutes.

    Returns
    -------
    SeparationChoice

    Raises
    ------
    ValueError
        If fewer than 10 ions are solutes, or all are.

    Notes
    -----
    At each separation N_min is the smallest number, at least 3, for which the clusters of random labels are at most 5 %
    of the clusters. The statistic is the largest gain over the separations: the fraction of solutes in such clusters
    over its mean for the other labellings, before random labels percolate. It is computed for each labelling in the
    same way, so that its rank gives an exact p-value, also after the choice.

    A larger separation finds more of the clusters, and more solutes of the matrix join them. The latter are estimated
    by the fraction v of the volume within the separation of a solute of a cluster. The separation is the smallest one
    for which :math:`g - v (1 - g)`, with the gain g, is at its largest value within the standard deviation of g by the
    number of solutes.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> matrix, particle = 10 * rng.random((5000, 3)), 5 + 0.5 * rng.normal(size=(60, 3))
    >>> solute = np.r_[rng.random(5000) < 0.02, np.ones(60, bool)]
    >>> choice = ae.measures.choose_separation(np.r_[matrix, particle], solute)
    >>> print(f"d_max {choice.d_max:.2f} nm, N_min {choice.n_min}, p = {choice.p_value:.2f}")
    d_max 0.77 nm, N_min 5, p = 0.05
    """
    places, solutes = _checked(positions, solute)
    n = int(np.count_nonzero(solutes))
    if n < 10 or n == len(solutes):
        raise ValueError(f"solute must mark at least 10 of the ions and not all of them, got {n:,} of {len(solutes):,}")
    trials = check_count(trials, "trials", at_least=19, at_most=10_000)
    random = np.random.default_rng(check_seed(seed))
    if separations is None:
        steps = _SEPARATIONS * (3 * ConvexHull(places).volume / (4 * math.pi * n)) ** (1 / 3)
    else:
        steps = check_array(separations, "separations", ("k",))
        if not (len(steps) and steps[0] > 0 and (np.diff(steps) > 0).all()):
            raise ValueError(f"separations must be increasing numbers > 0 [nm], got {separations!r:.80}")
    rows = [np.flatnonzero(solutes)] + [
        np.sort(random.choice(len(places), n, replace=False, shuffle=False)) for _ in range(trials)
    ]
    table = np.array([_by_size(places[chosen], steps) for chosen in rows])
    clusters, members = table[:, 0], table[:, 1] / n  # with at least 0, 1, 2, ... solutes, at each separation
    gain, fewest = np.zeros((trials + 1, len(steps))), np.zeros((trials + 1, len(steps)), np.int64)
    for one in range(trials + 1):
        others = np.delete(np.arange(trials + 1), one)
        mean = clusters[others].mean(axis=0)
        allowed = (clusters[one] > 0) & (mean <= _LEVEL * clusters[one])
        # before random labels percolate
        allowed &= (table[others, 2, :, :1].mean(axis=0) <= max(_LEVEL * n, _LONE)) & (np.arange(_SIZES) >= _FEWEST)
        at = fewest[one] = np.where(allowed.any(axis=1), allowed.argmax(axis=1), 0)
        above = members[:, range(len(steps)), at]
        gain[one] = np.where(at > 0, above[one] - above[others].mean(axis=0), 0.0)
    largest = gain.max(axis=1)
    best = _smallest(places, solutes, steps, gain[0], fewest[0], random)
    at = fewest[0]
    return SeparationChoice(
        d_max=float(steps[best]),
        n_min=max(int(at[best]), _FEWEST),
        p_value=float(np.mean(largest >= largest[0])),
        separations=steps,
        clustered=np.where(at > 0, members[0, range(len(steps)), at], 0.0),
        by_chance=np.where(at > 0, members[1:, range(len(steps)), at].mean(axis=0), 0.0),
        fewest=at,
    )


def _smallest(places, solutes, steps, gain, fewest, random):
    """Number of the smallest separation that finds all but what joins by chance, within the error of the counts."""
    sample = places[random.choice(len(places), min(_SAMPLE, len(places)), replace=False, shuffle=False)]
    score = np.full(len(steps), -np.inf)
    for row in np.flatnonzero(gain > 0):
        members = _of_solutes(places[solutes], ClusterSettings(float(steps[row]), int(fewest[row]))) >= 0
        tree = scipy.spatial.cKDTree(places[solutes][members])
        near = tree.query(sample, distance_upper_bound=steps[row])[0] <= steps[row]
        score[row] = gain[row] - near.mean() * (1 - gain[row])
    best = score.max()
    if not best > -np.inf:
        return 0
    return int(np.argmax(score >= best - math.sqrt(max(best * (1 - best), 0.0) / np.count_nonzero(solutes))))


def _by_size(places, separations):
    """Number of clusters of at least 0, 1, 2, ... points, their points, and those of the largest, at each separation.

    The separations are cuts through the minimum spanning forest.
    """
    n = len(places)
    pairs = scipy.spatial.cKDTree(places).query_pairs(separations[-1], output_type="ndarray")
    lengths = np.linalg.norm(places[pairs[:, 0]] - places[pairs[:, 1]], axis=1)
    # a length of zero would be no edge
    graph = scipy.sparse.coo_array((np.maximum(lengths, 1e-300), (pairs[:, 0], pairs[:, 1])), shape=(n, n)).tocsr()
    forest = scipy.sparse.csgraph.minimum_spanning_tree(graph).tocoo()
    edges = np.column_stack([forest.row, forest.col])
    result = np.zeros((3, len(separations), _SIZES))
    for row, separation in enumerate(separations):
        sizes = np.bincount(_components(edges[forest.data <= separation], n))
        capped = np.minimum(sizes, _SIZES - 1)
        for kind, weights in enumerate((None, sizes)):
            result[kind, row] = np.bincount(capped, weights, _SIZES)[::-1].cumsum()[::-1]
        result[2, row] = sizes.max()
    return result


def nearest_neighbours(
    positions: ArrayLike, solute: ArrayLike, order: int = 1, trials: int = 19, seed: int = 0, bins: int = 60
) -> NeighbourDistances:
    """Distribution of the distance of the k-th nearest solute of solutes, beside that of random labels.

    Parameters
    ----------
    positions, solute
        As for `label_clusters`.
    order : int
        k; 1 for the nearest.
    trials : int
        Number of random labellings of the same positions.
    seed : int
        Seed of the labels.
    bins : int
        Number of bins.

    Returns
    -------
    NeighbourDistances

    Raises
    ------
    ValueError
        If there are not more solutes than `order`, or all ions are solutes.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> cloud = 10 * rng.random((5000, 3))
    >>> distances = ae.measures.nearest_neighbours(cloud, rng.random(5000) < 0.1)
    >>> print(f"{distances.mean:.2f} nm, random {distances.random_mean:.2f} nm")
    0.70 nm, random 0.72 nm
    """
    places, solutes = _checked(positions, solute)
    order, n = check_count(order, "order", at_least=1), int(np.count_nonzero(solutes))
    if not order < n < len(places):
        raise ValueError(f"solute must mark more than {order} ions and not all of them, got {n:,} of {len(places):,}")
    trials, bins = check_count(trials, "trials", at_least=2), check_count(bins, "bins", at_least=1, at_most=10_000)
    random = np.random.default_rng(check_seed(seed))
    labellings = [np.flatnonzero(solutes)] + [
        np.sort(random.choice(len(places), n, replace=False, shuffle=False)) for _ in range(trials)
    ]
    # without a search of all neighbours up to the k-th: a column of the result only
    distances = [scipy.spatial.cKDTree(places[rows]).query(places[rows], k=[order + 1])[0][:, 0] for rows in labellings]
    edges = np.linspace(0.0, float(np.quantile(np.concatenate(distances), 0.999)) * (1 + 1e-9) + 1e-12, bins + 1)
    counts = np.array([np.histogram(row, edges)[0] for row in distances])
    means = np.array([row.mean() for row in distances])
    return NeighbourDistances(
        edges, counts[0], counts[1:].mean(axis=0), counts[1:].std(axis=0, ddof=1), float(means[0]),
        float(means[1:].mean()), float(means[1:].std(ddof=1)), float(np.mean(means <= means[0])),
    )  # fmt: skip


def _checked(positions, solute) -> tuple[Floats, Booleans]:
    """Validated positions and solutes, of which there is one at least."""
    places = check_array(positions, "positions", ("n", 3))
    solutes = check_array(solute, "solute", (len(places),), dtype=bool)
    if not solutes.any():
        raise ValueError(f"solute must mark at least one ion, got none of {len(places):,}")
    return places, solutes
