"""Charge state ratios: maps over the detector, their history during a run, and the field that follows from them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats, Integers
from apt_evap._common.validation import check_array, check_choice, check_count, check_kind, did_you_mean, short_text
from apt_evap.detection.binning import MAX_BINS, count
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits, MassRanges
from apt_evap.emission.post_ionisation import RATIO_PARAMETERS, field_of_ratio
from apt_evap.specimen.isotopes import ISOTOPES, MOST_ELECTRONS

LEAST = 20
"""Fewest ions of both charges for a ratio: 1.5 % of the field where both are equally frequent."""
_PER_BIN = 50  # ions per bin by default: 1 % of the field where both charges are equally frequent
_PER_SECTION = 100  # ions per section of a history by default
_MOST_BINS = 256  # by default, as in `DetectorMap.from_hits`
_MASSES = (0.9, 1.2)  # mass of a simulated ion over that of an isotope, with all errors of its time of flight
_STRANGERS = 0.01  # fraction of the ions that may have other masses


@dataclass(frozen=True, eq=False, repr=False)
class ChargeStateCounts:
    """Numbers of ions of one element with two neighbouring charges, in bins or in sections.

    Parameters
    ----------
    element : str
        Chemical symbol.
    charge : int
        Lower charge n of the two [e].
    lower, upper : ndarray
        Numbers of ions with the charges n and n + 1, int64 of any shape.
    least : int
        Ratios of fewer ions than this are NaN.

    Notes
    -----
    `ratio` is (N(n+1) + 1/2) / (N(n) + 1/2), which is finite without any ion of a charge. Its logarithm has no bias of
    first order in 1/N, and the standard error sqrt(1/(N(n) + 1/2) + 1/(N(n+1) + 1/2)) (Haldane, Ann. Hum. Genet. 20,
    309 (1956); Gart and Zweifel, Biometrika 54, 181 (1967)). With about 30 for dln(ratio)/dlnF, the error of the field
    is 2 / (30 sqrt(N)) of it for N ions of which half have each charge: 1 % for 44 ions.
    """

    element: str
    charge: int
    lower: np.ndarray
    upper: np.ndarray
    least: int

    @property
    def ratio(self) -> Floats:
        """N(n+1) / N(n), NaN where there are too few ions."""
        return self._enough(ratio_of_counts(self.lower, self.upper)[0])

    @property
    def ratio_error(self) -> Floats:
        """Standard error of ln(ratio), NaN where there are too few ions."""
        return self._enough(ratio_of_counts(self.lower, self.upper)[1])

    @property
    def field(self) -> Floats:
        """Field on the scale of Kingham's curves [V/nm], NaN where there are too few ions; see `field_of_counts`."""
        return self._enough(field_of_counts(self.element, self.charge, self.lower, self.upper)[0])

    @property
    def field_error(self) -> Floats:
        """Standard error of the field [V/nm], NaN where there are too few ions."""
        return self._enough(field_of_counts(self.element, self.charge, self.lower, self.upper)[1])

    @property
    def total(self) -> float:
        """Ratio of all ions."""
        return float(ratio_of_counts(self.lower.sum(), self.upper.sum())[0])

    @property
    def ions(self) -> int:
        """Number of ions of both charges."""
        return int(self.lower.sum() + self.upper.sum())

    def _enough(self, values):
        return np.where(self.lower + self.upper >= self.least, values, np.nan)

    def _text(self, of):
        ratios = f"{self.element}{self.charge + 1}+/{self.element}{self.charge}+ = {self.total:.3g}"
        enough = np.count_nonzero(self.lower + self.upper >= self.least)
        return f"<{type(self).__name__}: {ratios}, {self.ions:,} ions, {enough} {of} with at least {self.least}>"


@dataclass(frozen=True, eq=False, repr=False)
class ChargeStateMap(ChargeStateCounts):
    """Charge state ratios in bins of the detector, made by `charge_state_ratio_map`.

    Parameters
    ----------
    element, charge, lower, upper, least
        As for `ChargeStateCounts`; the counts have the shape (ny, nx).
    counts : DetectorMap
        The ions of both charges.
    """

    counts: DetectorMap

    def __repr__(self) -> str:
        ny, nx = self.lower.shape
        return self._text(f"of {nx} x {ny} bins")

    def to_map(self, quantity: str = "ratio") -> DetectorMap:
        """Return ratios or fields as a `DetectorMap` of densities.

        Parameters
        ----------
        quantity : {"ratio", "field"}
            Ratio of the numbers of ions, or field [V/nm].

        Returns
        -------
        DetectorMap
            ``values`` are the ratios or fields; bins with too few ions are outside the mask.

        Raises
        ------
        ValueError
            If the quantity is unknown, or the element has no fit of Kingham's curves.
        """
        values = self._quantity(quantity)
        return replace(
            self.counts,
            values=np.where(np.isfinite(values), values, 0.0),
            mask=self.counts.mask & np.isfinite(values),
            is_counts=False,
        )

    def _quantity(self, name):
        return getattr(self, check_choice(name, "quantity", ("ratio", "field")))


@dataclass(frozen=True, eq=False, repr=False)
class ChargeStateHistory(ChargeStateCounts):
    """Charge state ratios in successive sections of the ions, made by `charge_state_ratio_history`.

    Parameters
    ----------
    element, charge, lower, upper, least
        As for `ChargeStateCounts`; the counts have the shape (k,).
    middles : ndarray
        Middle of each section, in ions from the first, shape (k,).
    """

    middles: np.ndarray

    def __repr__(self) -> str:
        return self._text(f"of {len(self.middles)} sections")


def charge_state_ratio_map(
    hits: Hits,
    element: str,
    charge: int | None = None,
    *,
    ranges: MassRanges | None = None,
    bins: int | None = None,
    extent: tuple[float, float, float, float] | None = None,
    like: DetectorMap | ChargeStateMap | None = None,
    least: int = LEAST,
) -> ChargeStateMap:
    """Map the charge state ratio of an element over the detector: a map of the field at the apex.

    Parameters
    ----------
    hits : Hits
        Ions with x and y: of a run in real units with `PostIonisation`, or measured ions with `ranges`.
    element : str
        Chemical symbol.
    charge : int, optional
        Lower charge n of the two [e]; by default of the two neighbouring charges that are most frequent, by the rarer
        one.
    ranges : Ranges, optional
        Ranges of the mass-to-charge ratio, see `ion_charges`. By default the charges of a run.
    bins : int, optional
        Number of bins along the longer side; by default so many that a bin contains about 50 ions.
    extent : tuple of float, optional
        x_min, x_max, y_min, y_max [mm], as for `DetectorMap.from_hits`.
    like : DetectorMap or ChargeStateMap, optional
        Use edges and mask of this map instead of `bins` and `extent`, for comparison: that of fewer ions.
    least : int
        Fewest ions of both charges in a bin; ratios of fewer are NaN.

    Returns
    -------
    ChargeStateMap
        With ratio, field [V/nm] and their errors in each bin.

    Raises
    ------
    ValueError
        If the charges are not known, if there are no two neighbouring charges or no bin with enough ions, or if an
        argument is outside its range.

    Notes
    -----
    The ratio grows as about the 30th power of the field. The ratio of a bin is that of its ions, so bins should be
    smaller than the changes of the field. Ions of both charges from one site hit different places if they start with a
    lateral energy E, since the path depends on E / (n V). Background is not subtracted, and other ions in a range
    falsify the ratio: 58Ni2+ has the mass-to-charge ratio of 29Si+.
    """
    least = check_count(least, "least", at_least=1)
    charges = ion_charges(hits, element, ranges)
    charges = np.where(hits.detected, charges, 0)
    charge = _check_charge(charges, charge, element)
    pair = (charges == charge) | (charges == charge + 1)
    both = replace(hits[pair], extent=hits.extent)
    if like is not None:
        like = like.counts if isinstance(like, ChargeStateMap) else check_kind(like, "like", DetectorMap, "a map")
        # stripes of quantised coordinates are equal for both charges
        grid = DetectorMap.from_hits(both, like=like, position_step=None)
    else:
        if bins is None:
            bins = min(max(round(np.sqrt(len(both) / _PER_BIN)), 1), _MOST_BINS)
        bins = check_count(bins, "bins", at_least=1, at_most=MAX_BINS)
        grid = DetectorMap.from_hits(both, bins=bins, extent=extent)
    x, y = hits.require("x", "y")
    lower, upper = (
        np.where(grid.mask, count(x[charges == n], y[charges == n], grid.x_edges, grid.y_edges), 0)
        for n in (charge, charge + 1)
    )
    most = int((lower + upper).max())
    if most < least:
        raise ValueError(
            f"no bin contains {least} ions of {element} with the charges {charge} and {charge + 1}, at most {most}: "
            "use fewer bins, or a smaller number for least"
        )
    return ChargeStateMap(element, charge, lower, upper, least, grid)


def charge_state_ratio_history(
    hits: Hits,
    element: str,
    charge: int | None = None,
    *,
    ranges: MassRanges | None = None,
    sections: int | None = None,
    least: int = LEAST,
) -> ChargeStateHistory:
    """Charge state ratio of an element in successive sections of the detected ions.

    Parameters
    ----------
    hits : Hits
        Ions in the order of evaporation: of a run in real units with `PostIonisation`, or measured ions with `ranges`.
    element, charge, ranges
        As for `charge_state_ratio_map`.
    sections : int, optional
        Number of sections k of nearly equal length; by default so many that a section contains about 100 ions of both
        charges.
    least : int
        Fewest ions of both charges in a section; ratios of fewer are NaN.

    Returns
    -------
    ChargeStateCourse
        With ratio, field [V/nm] and their errors in each section.

    Raises
    ------
    ValueError
        If the charges are not known, there are no two neighbouring charges, or an argument is outside its range.
    """
    check_kind(hits, "hits", Hits, "Hits")
    charges = np.where(hits.detected, ion_charges(hits, element, ranges), 0)
    return charge_history(charges, element, charge, sections=sections, least=least)


def charge_history(
    charges: ArrayLike,
    element: str,
    charge: int | None = None,
    *,
    sections: int | None = None,
    least: int = LEAST,
) -> ChargeStateHistory:
    """Charge state ratio in successive sections, from the charge of every ion.

    Parameters
    ----------
    charges : array_like of int
        Charge of each ion [e] in the order of evaporation, shape (n,); 0 for ions that do not count.
    element, charge, sections, least
        As for `charge_state_ratio_history`.

    Returns
    -------
    ChargeStateCourse

    Raises
    ------
    ValueError
        If there are no two neighbouring charges, or an argument is outside its range.
    """
    check_kind(element, "element", str, "a chemical symbol such as 'Ni'")
    least = check_count(least, "least", at_least=1)
    charges = check_array(charges, "charges", ("n",), dtype=np.int64)
    charge = _check_charge(charges, charge, element)
    steps = np.array([charges == charge, charges == charge + 1])
    if sections is None:
        sections = max(int(steps.sum()) // _PER_SECTION, 1)
    sections = min(check_count(sections, "sections", at_least=1), len(charges))
    edges = np.linspace(0, len(charges), sections + 1).astype(int)
    lower, upper = np.add.reduceat(steps, edges[:-1], axis=1, dtype=np.int64)
    return ChargeStateHistory(element, charge, lower, upper, least, (edges[:-1] + edges[1:]) / 2)


def ion_charges(hits: Hits, element: str, ranges: MassRanges | None = None) -> Integers:
    """Charge of every ion of an element, that of the run or of `Ranges.charges`.

    Parameters
    ----------
    hits : Hits
        Ions of one element of a run in real units, with the column "charge_state" in `extra`; of an alloy, such as
        ``hits[run.species == 0]``. Or ions with mass_to_charge, for `ranges`.
    element : str
        Chemical symbol, one of `ISOTOPES`.
    ranges : Ranges, optional
        Ranges of the mass-to-charge ratio.

    Returns
    -------
    ndarray of int64, shape (n,)
        Charge [e]; 0 for an ion in no range of the element.
    """
    check_kind(hits, "hits", Hits, "Hits")
    check_kind(element, "element", str, "a chemical symbol such as 'Ni'")
    if element not in ISOTOPES:
        hint = did_you_mean(element, ISOTOPES)
        raise ValueError(f"element must be a chemical symbol such as 'Ni', got {short_text(element)}{hint}")
    if ranges is not None:
        return check_kind(ranges, "ranges", "charges", "Ranges").charges(hits, element)
    if "charge_state" not in hits.extra:
        raise ValueError(
            f"{hits.source or 'these hits'} have no charges: pass ranges=read_ranges(...) for measured ions, or use "
            "the hits of run.at_evaporation_field(flight_charges=PostIonisation(...))"
        )
    charges = check_array(hits.extra["charge_state"], "charge_state", (len(hits),), dtype=np.int64)
    if hits.mass_to_charge is not None:
        _check_masses(hits.mass_to_charge * charges, element)
    return charges


def ratio_of_counts(lower: ArrayLike, upper: ArrayLike) -> tuple[Floats, Floats]:
    """Charge state ratios from numbers of ions, and standard errors of their logarithms; see `ChargeStateCounts`."""
    lower, upper = np.asarray(lower) + 0.5, np.asarray(upper) + 0.5
    return upper / lower, np.sqrt(1 / lower + 1 / upper)


def field_of_counts(element: str, charge: int, lower: ArrayLike, upper: ArrayLike) -> tuple[Floats, Floats]:
    """Fields [V/nm] on the scale of Kingham's curves from numbers of ions with the charges n = `charge` and n + 1 [e].

    Their standard errors are half the difference of the fields at ln(ratio) plus and minus its error.
    """
    if element not in RATIO_PARAMETERS:
        raise ValueError(
            f"element must be one of {', '.join(RATIO_PARAMETERS)} for a field, got {short_text(element)}: there is no "
            "fit of Kingham's curves for others, only a ratio"
        )
    ratio, error = ratio_of_counts(lower, upper)
    low, field, high = (field_of_ratio(element, charge, ratio * np.exp(step * error)) for step in (-1, 0, 1))
    return field, (high - low) / 2


def _check_masses(masses, element):
    """Raise an error for ions of other elements."""
    isotopes = np.array(ISOTOPES[element])[:, 0]
    known = np.isfinite(masses)
    other = known & ((masses < _MASSES[0] * isotopes.min()) | (masses > _MASSES[1] * isotopes.max()))
    if other.sum() > _STRANGERS * known.sum():
        raise ValueError(
            f"the ions must be of {element}, but {other.sum():,} of {len(masses):,} have another mass, such as "
            f"{masses[other][0]:.1f} Da: select those of one element, such as hits[run.species == 0]"
        )


def _check_charge(charges, charge, element) -> int:
    """Return the lower charge of the pair, after a check that there are ions of both."""
    numbers: Any = np.bincount(charges[(charges > 0) & (charges <= MOST_ELECTRONS)], minlength=3)
    numbers[0] = 0
    if charge is None:
        rarer = np.minimum(numbers[:-1], numbers[1:])
        charge = int(rarer.argmax())
        if not rarer[charge]:
            known = ", ".join(str(n) for n in np.flatnonzero(numbers)) or "none"
            raise ValueError(f"a ratio needs ions of {element} with two neighbouring charges, got charges {known}")
        return charge
    charge = check_count(charge, "charge", at_least=1, at_most=MOST_ELECTRONS)
    if not numbers[charge : charge + 2].sum():
        raise ValueError(f"there are no ions of {element} with the charges {charge} and {charge + 1}")
    return charge
