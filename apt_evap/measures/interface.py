"""Composition about an interface: profiles, width of a step, segregation, interfacial excess, ladder diagram."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.codec import ForJson
from apt_evap._common.types import Booleans, Estimated, Floats, Integers
from apt_evap._common.validation import check_array, check_choice, check_number

_TEN_TO_NINETY = 2.5631031310892007  # 10 to 90 % of an error function in sigma, 2 sqrt(2) erfinv(0.8)
_FEWEST = 10  # ions on each side: the fits have four constants
_SHARPEST = 1e-3  # of the reach: far below the distance of two planes
_TINY = 1e-6  # a fraction of 0 or 1 has no likelihood


@dataclass(frozen=True, eq=False)
class DistanceProfile(ForJson):
    """Fraction of chosen ions as a function of the distance from an interface.

    Parameters
    ----------
    edges : ndarray
        Edges of the bins of the distance [nm], shape (n + 1,).
    ions : ndarray of int
        Number of ions in each bin, shape (n,).
    fraction : ndarray
        Fraction of the chosen ions in each bin, shape (n,); NaN without ions.
    """

    edges: Floats = field(repr=False)
    ions: Integers = field(repr=False)
    fraction: Floats = field(repr=False)

    @property
    def centres(self) -> Floats:
        """Centres of the bins [nm], shape (n,)."""
        return (self.edges[:-1] + self.edges[1:]) / 2

    @property
    def fraction_errors(self) -> Floats:
        """Standard deviation of each fraction by the number of ions, shape (n,)."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(self.fraction * (1 - self.fraction) / self.ions)


@dataclass(frozen=True, eq=False)
class CompositionProfile(ForJson):
    """Composition as a function of a coordinate: a proxigram if this is the distance from an isosurface.

    Parameters
    ----------
    edges : ndarray
        Edges of the steps [nm], shape (n + 1,).
    elements : tuple of str
        Names of the elements, e of them.
    atoms : ndarray
        Number of atoms of each element in each step, shape (n, e).
    coordinates : ndarray
        Coordinate of each ion [nm], shape (m,); NaN for an ion that does not count.
    area : float
        Area of the surface that the coordinate is the distance from, or of the cross section [nm^2]; NaN if not known.
    """

    edges: Floats = field(repr=False)
    elements: tuple[str, ...]
    atoms: Floats = field(repr=False)
    coordinates: Floats = field(repr=False)
    area: float = math.nan
    _in_json = ("edges", "elements", "atoms", "fractions", "fraction_errors", "area")

    @property
    def centres(self) -> Floats:
        """Centres of the steps [nm], shape (n,)."""
        return (self.edges[:-1] + self.edges[1:]) / 2

    @property
    def fractions(self) -> Floats:
        """Fraction of each element in each step, shape (n, e); NaN without atoms."""
        with np.errstate(invalid="ignore"):
            return self.atoms / self.atoms.sum(axis=1, keepdims=True)

    @property
    def fraction_errors(self) -> Floats:
        """Standard deviation of each fraction by the number of atoms, shape (n, e); NaN without atoms."""
        with np.errstate(invalid="ignore"):
            return np.sqrt(self.fractions * (1 - self.fractions) / self.atoms.sum(axis=1, keepdims=True))

    def of(self, element: str) -> DistanceProfile:
        """Profile of one element.

        Parameters
        ----------
        element : str
            Its name.

        Returns
        -------
        DistanceProfile
        """
        column = self.elements.index(check_choice(element, "element", self.elements))
        return DistanceProfile(self.edges, self.atoms.sum(axis=1), self.fractions[:, column])


@dataclass(frozen=True, eq=False)
class InterfaceProfile(DistanceProfile):
    """Step of the composition at an interface, and the error function that fits it.

    Parameters
    ----------
    edges, ions, fraction
        The counts, as in `DistanceProfile`.
    centre, centre_error : float
        Distance at which the fit is halfway, and its standard error [nm].
    sigma, sigma_error : float
        Standard deviation of the error function, and its standard error [nm]; the error is NaN for a step that is
        sharp within the distances of the ions.
    before, after : float
        Fractions far below and far above the centre.
    """

    centre: float
    centre_error: float
    sigma: float
    sigma_error: float
    before: float
    after: float

    @property
    def width(self) -> float:
        """Distance over which the fit goes from 10 to 90 % of its step [nm]."""
        return _TEN_TO_NINETY * self.sigma

    @property
    def width_error(self) -> float:
        """Standard error of `width` [nm]."""
        return _TEN_TO_NINETY * self.sigma_error

    def fitted(self, distances: ArrayLike) -> Floats:
        """The fit at some distances [nm]."""
        return _step((self.centre, self.sigma, self.before, self.after), np.asarray(distances, dtype=float))


@dataclass(frozen=True, eq=False)
class SegregationProfile(DistanceProfile):
    """Peak of the composition at an interface, and the Gaussian that fits it, as in `Segregation`.

    Parameters
    ----------
    edges, ions, fraction
        The counts, as in `DistanceProfile`.
    centre, centre_error : float
        Distance of the peak from the interface, and its standard error [nm].
    width, width_error : float
        Standard deviation of the Gaussian, and its standard error [nm].
    bulk, peak : float
        Fraction far from the interface, and at the peak.
    excess, excess_error : float
        Integral of the fraction above that of the bulk, over the distances within the reach [nm]. Times the number of
        atoms per volume it is the excess of atoms per area.
    """

    centre: float
    centre_error: float
    width: float
    width_error: float
    bulk: float
    peak: float
    excess: float
    excess_error: float

    def fitted(self, distances: ArrayLike) -> Floats:
        """The fit at some distances [nm]."""
        return _peak((self.centre, self.width, self.bulk, self.peak), np.asarray(distances, dtype=float))


def interface_profile(
    distances: ArrayLike, chosen: ArrayLike, reach: float = 1.0, bin_width: float = 0.1
) -> InterfaceProfile:
    r"""Step of the composition at an interface, and its width.

    Parameters
    ----------
    distances : array_like
        Distance of each ion from the interface [nm], shape (n,), such as ``region.distance(positions)``: negative
        inside the region, positive outside.
    chosen : array_like of bool
        Whether each ion counts, such as those of one element or of one phase, shape (n,).
    reach : float
        Ions within this distance of the interface are used [nm].
    bin_width : float
        Width of the bins of the profile [nm]. The fit does not depend on it.

    Returns
    -------
    InterfaceProfile

    Raises
    ------
    ValueError
        If fewer than 10 ions are within the reach on one side of the interface, or all or none of them are chosen.

    Notes
    -----
    The probability that an ion at the distance d counts is :math:`a + (b - a) \, \Phi((d - c) / \sigma)`, with the
    normal distribution :math:`\Phi`. Its constants are those of the largest likelihood of the single ions. Errors are
    those of the inverse of the Fisher information. The width is :math:`2.563 \, \sigma`.
    """
    along, counts = _near(distances, chosen, reach)
    low, high = counts[along < 0].mean(), counts[along >= 0].mean()
    starts = [(0.0, part * reach, low, high) for part in (0.02, 0.1, 0.4)]  # a narrow one is found from a narrow start
    values, covariance = _fit(_step, along, counts, reach, starts)
    errors = np.sqrt(np.diag(covariance))
    centre, sigma, before, after = values
    edges, ions, fraction = _binned(along, counts, reach, bin_width)
    return InterfaceProfile(edges, ions, fraction, centre, float(errors[0]), sigma, float(errors[1]), before, after)


def segregation_profile(
    distances: ArrayLike, chosen: ArrayLike, reach: float = 2.0, bin_width: float = 0.2
) -> SegregationProfile:
    r"""Peak of the composition at an interface, its width and its excess.

    Parameters
    ----------
    distances, chosen, reach, bin_width
        As for `interface_profile`.

    Returns
    -------
    SegregationProfile

    Raises
    ------
    ValueError
        If fewer than 10 ions are within the reach on one side of the interface, or all or none of them are chosen.

    Notes
    -----
    The probability that an ion at the distance d counts is :math:`x_b + (x_p - x_b) \, \exp(-(d - c)^2 / 2 w^2)`. Its
    constants are those of the largest likelihood of the single ions, with errors of the inverse of the Fisher
    information. The excess is :math:`\sum (x - x_b) \, \Delta d` over the bins: it does not depend on the shape of the
    peak, and its error is that of the counts and of the bulk.
    """
    along, counts = _near(distances, chosen, reach)
    mean = counts.mean()
    starts = [(0.0, part * reach, 0.5 * mean, min(2 * mean, 0.99)) for part in (0.1, 0.3)]
    values, covariance = _fit(_peak, along, counts, reach, starts)
    errors = np.sqrt(np.diag(covariance))
    edges, ions, fraction = _binned(along, counts, reach, bin_width)
    centre, width, bulk, peak = values
    full = ions > 0
    steps = np.diff(edges)[full]
    excess = float(((fraction[full] - bulk) * steps).sum())
    variance = (fraction[full] * (1 - fraction[full]) / ions[full] * steps**2).sum() + covariance[2, 2] * (
        steps.sum() ** 2
    )
    return SegregationProfile(
        edges, ions, fraction, centre, float(errors[0]), width, float(errors[1]), bulk, peak, excess,
        math.sqrt(float(variance)),
    )  # fmt: skip


def interfacial_excess(
    distances: ArrayLike,
    chosen: ArrayLike,
    area: float,
    window: float = 1.0,
    reach: float = 3.0,
    efficiency: float = 1.0,
) -> Estimated:
    r"""Interfacial excess of an element, by the Gibbs dividing surface.

    Parameters
    ----------
    distances, chosen
        As for `interface_profile`.
    area : float
        Area of the interface [nm^2].
    window : float
        The interface is within this distance [nm].
    reach : float
        Ions from the window to this distance give the compositions of both sides [nm].
    efficiency : float
        Fraction of the atoms that was detected.

    Returns
    -------
    Estimated
        Excess [atoms / nm^2] and its standard deviation by the number of ions.

    Raises
    ------
    ValueError
        If there are fewer than 10 ions on each side beyond the window.

    Notes
    -----
    :math:`\Gamma = (N_s - x_a N_- - x_b N_+) / (A \eta)`, with the atoms of the element within the window, the atoms
    on both sides of the surface within it, and the fractions beyond it (Krakauer and Seidman, Phys. Rev. B 48, 6724
    (1993)). Its variance is that of the binomial distributions of the three counts.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> distances = 8 * rng.random(40_000) - 4
    >>> chosen = rng.random(40_000) < 0.02 + 0.2 * np.exp(-0.5 * (distances / 0.3) ** 2)
    >>> excess = ae.measures.interfacial_excess(distances, chosen, area=100.0)
    >>> print(f"{excess.value:.1f} +/- {excess.error:.1f} of {0.2 * 0.3 * np.sqrt(2 * np.pi) * 50:.1f} atoms / nm^2")
    7.1 +/- 0.3 of 7.5 atoms / nm^2
    """
    window = check_number(window, "window", above=0, unit="nm")
    reach = check_number(reach, "reach", above=window, unit="nm")
    area = check_number(area, "area", above=0, unit="nm^2")
    efficiency = check_number(efficiency, "efficiency", above=0, at_most=1)
    along = check_array(distances, "distances", ("n",), finite=False)
    counts = check_array(chosen, "chosen", (len(along),), dtype=bool)
    inside = np.abs(along) <= window
    excess = float(np.count_nonzero(counts & inside))
    ions = max(int(np.count_nonzero(inside)), 1)
    variance = excess * (1 - excess / ions)
    for side, beyond in ((along < 0, along < -window), (along >= 0, along > window)):
        far = counts[beyond & (np.abs(along) <= reach)]
        if len(far) < _FEWEST:
            raise ValueError(
                f"distances must have at least {_FEWEST} ions on each side between window = {window:g} and reach = "
                f"{reach:g} nm, got {len(far)}"
            )
        fraction, near = float(far.mean()), int(np.count_nonzero(side & inside))
        excess -= fraction * near
        variance += fraction * (1 - fraction) / len(far) * near**2
    return Estimated(excess / (area * efficiency), math.sqrt(variance) / (area * efficiency))


def ladder_diagram(distances: ArrayLike, chosen: ArrayLike) -> tuple[Floats, Integers]:
    """Ladder diagram: number of chosen ions over the number of all ions, along a coordinate.

    Parameters
    ----------
    distances : array_like
        Coordinate of each ion [nm], shape (n,), such as the distance from an interface. Ions with NaN are left out.
    chosen : array_like of bool
        The ions that count, shape (n,).

    Returns
    -------
    distances : ndarray
        Coordinates in increasing order [nm]; their ranks are the number of all ions.
    counted : ndarray of int
        Number of chosen ions up to each of them: the slope is their fraction, a step is an excess.

    Examples
    --------
    >>> ae.measures.ladder_diagram([0.3, 0.1, 0.2], [True, True, False])
    (array([0.1, 0.2, 0.3]), array([1, 1, 2]))
    """
    along = check_array(distances, "distances", ("n",), finite=False)
    counts = check_array(chosen, "chosen", (len(along),), dtype=bool)
    order = np.argsort(along, kind="stable")[: np.count_nonzero(np.isfinite(along))]
    return along[order], np.cumsum(counts[order])


def _near(distances: ArrayLike, chosen: ArrayLike, reach: float) -> tuple[Floats, Booleans]:
    """Validated distances within the reach, and whether each ion counts."""
    along = check_array(distances, "distances", ("n",))
    counts = check_array(chosen, "chosen", (len(along),), dtype=bool)
    near = np.abs(along) <= check_number(reach, "reach", above=0, unit="nm")
    along, counts = along[near], counts[near]
    below = np.count_nonzero(along < 0)
    if min(below, len(along) - below) < _FEWEST:
        raise ValueError(
            f"distances must have at least {_FEWEST} ions on each side within {reach:g} nm, got {below} and "
            f"{len(along) - below}"
        )
    if counts.all() or not counts.any():
        raise ValueError(
            f"chosen must mark a part of the ions within {reach:g} nm, got {np.count_nonzero(counts)} of {len(along)}"
        )
    return along, counts


def _binned(along, counts, reach, bin_width):
    """Edges, number of ions and fraction of those that count."""
    bin_width = check_number(bin_width, "bin_width", above=0, at_most=2 * reach, unit="nm")
    edges = np.linspace(-reach, reach, max(1, round(2 * reach / bin_width)) + 1)
    ions = np.histogram(along, edges)[0]
    with np.errstate(invalid="ignore"):
        return edges, ions, np.histogram(along[counts], edges)[0] / ions


def _step(constants, distances):
    """Error function between two fractions."""
    centre, sigma, before, after = constants
    return before + (after - before) * scipy.special.ndtr((distances - centre) / sigma)


def _peak(constants, distances):
    """Gaussian on a constant fraction."""
    centre, width, bulk, peak = constants
    return bulk + (peak - bulk) * np.exp(-0.5 * ((distances - centre) / width) ** 2)


def _fit(model, along, counts, reach, starts):
    """Constants by maximum likelihood, and their covariance by the Fisher information; NaN if it has none."""

    def cost(constants):
        probability = np.clip(model(constants, along), _TINY, 1 - _TINY)
        return -np.log(np.where(counts, probability, 1 - probability)).sum()

    bounds = [(-reach, reach), (_SHARPEST * reach, 2 * reach), (0.0, 1.0), (0.0, 1.0)]
    best = min((scipy.optimize.minimize(cost, start, bounds=bounds) for start in starts), key=lambda fit: fit.fun)
    # without gradients: those of a sharp step vanish between two ions
    best = scipy.optimize.minimize(cost, best.x, bounds=bounds, method="Nelder-Mead")
    values = [float(value) for value in best.x]
    derivatives = []
    for number, value in enumerate(values):
        step = 1e-4 * max(abs(value), 1e-2)
        moved = [np.array(values) + sign * step * (np.arange(4) == number) for sign in (1, -1)]
        derivatives.append((model(moved[0], along) - model(moved[1], along)) / (2 * step))
    probability = np.clip(model(values, along), _TINY, 1 - _TINY)
    slopes = np.array(derivatives)
    information = (slopes / (probability * (1 - probability))) @ slopes.T
    free = np.diag(information) > _TINY
    covariance = np.full((4, 4), np.nan)
    covariance[np.ix_(free, free)] = np.linalg.pinv(information[np.ix_(free, free)])
    return values, covariance
