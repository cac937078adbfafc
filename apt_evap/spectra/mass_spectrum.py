"""Mass spectra: which peaks are which ions, their background, and ranges of mass."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_kind, check_number, short_text
from apt_evap.detection.hits import Hits
from apt_evap.specimen.isotopes import ISOTOPES, SPECTRUM_ELEMENTS, mean_mass
from apt_evap.spectra.flight_fit import FlightFit
from apt_evap.spectra.isotope_comb import (
    LARGEST_MISFIT,
    Comb,
    LogSpectrum,
    atoms_of_formula,
    in_intervals,
    isotopes_of,
)
from apt_evap.spectra.mass_ranges import Ranges

FEWEST_OF_ELEMENT = 4000
"""Ions of an element that are enough for a map."""
_MOLECULES = ("H2", "OH", "H2O", "N2", "O2", "CO")  # of the residual gas
_HIGHEST_CHARGES = ((85.0, 2), (170.0, 3), (math.inf, 4))  # mass [Da] below which ions have at most this charge
_EXPECTED = 3  # charge that every expected ion may have
# of the factor on m/n: of a file, of a nominal length, with the first ion of a fit, with a fit
_FILE, _FLIGHT, _BEGUN, _FITTED = 0.01, 0.1, 0.02, 0.006
_BETTER = 1.1  # ions that a rival explains over those of a comb that it displaces
_ALIKE = 0.85  # ions that a rival explains over those of a comb, from which it is named, too
_LEAST = 5e-4  # of all ions: smaller combs have no name
_MOST = 15  # ions with a name
_STEPS = 4  # of the fit of the flight
_STARTS = 3  # ions of a kind that the fit may start with
_WELL_NAMED = 0.97  # part of the ions above the background that are explained: no other start is tried
_PALETTE = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e", "#8c564b", "#e377c2", "#17becf", "#bcbd22")


@dataclass(frozen=True)
class SpectrumPeaks:
    """Peaks of an ion in a spectrum.

    Parameters
    ----------
    name : str
        Ion and charge, such as "W3+".
    formula : str
        Ion without its charge, such as "W".
    charge : int
        Charge state.
    intervals : tuple of tuple of float
        Bounds of its peaks on the scale of m/n [Da].
    ions, background : int
        Ions in the intervals, and those of the background among them.
    fill : float
        Part of the ions about the peaks that the isotopes explain.
    factor : float
        m/n of the peaks over that of the isotopes.
    others : tuple of str
        Names of other ions that explain these peaks as well.
    """

    name: str
    formula: str
    charge: int
    intervals: tuple[tuple[float, float], ...]
    ions: int
    background: int
    fill: float
    factor: float
    others: tuple[str, ...] = ()

    def __str__(self) -> str:
        where = ", ".join(f"{low:.4g} to {high:.4g}" for low, high in self.intervals)
        others = f"; or {', '.join(self.others)}" if self.others else ""
        return (
            f"{self.name}: {self.ions:,} ions at {where} Da, {self.background:,} of them background "
            f"(isotopes explain {self.fill:.0%}{others})"
        )


class Spectrum:
    """Mass spectrum of ions; made by `spectrum`.

    Parameters
    ----------
    hits : Hits
        The ions, with mass_to_charge [Da].
    peaks : tuple of SpectrumPeaks
        Ions with a name, the most frequent first.
    flight : FlightFit or None
        Time zero and flight length of m/n; None if the ions had m/n before.
    refused : str
        Why a requested element has no peaks; "" if all have.
    """

    def __init__(
        self, hits: Hits, counts: LogSpectrum, peaks: tuple[SpectrumPeaks, ...], flight: FlightFit | None, refused: str
    ) -> None:
        self.hits, self.peaks, self.flight, self.refused = hits, peaks, flight, refused
        self._counts = counts

    def __repr__(self) -> str:
        names = ", ".join(peak.name for peak in self.peaks) or "no ion named"
        return f"<Spectrum: {len(self.hits):,} ions, {names}>"

    def __str__(self) -> str:
        lines = [] if self.flight is None else [str(self.flight)]
        lines += [str(peak) for peak in self.peaks]
        lines += [self.refused] if self.refused else []
        if not self.peaks and not self.refused:
            lines.append("no ion named: no peaks of known isotopes above the background")
        if len(unnamed := self.unnamed):
            where = ", ".join(f"{place:.4g}" for place, _ in unnamed[:5])
            lines.append(f"peaks without a name at {where}{', ...' if len(unnamed) > 5 else ''} Da")
        return "\n".join(lines)

    def background(self, edges: Floats) -> Floats:
        """Number of ions of the background between edges of m/n [Da], shape (k + 1,), array of shape (k,)."""
        below = np.concatenate([[0.0], np.cumsum(self._counts.background)])
        return np.diff(np.interp(edges, self._counts.edges, below))

    @cached_property
    def unnamed(self) -> tuple[tuple[float, int], ...]:
        """Place [Da] and number of ions of each peak without a name, the largest first."""
        named = [interval for peak in self.peaks for interval in peak.intervals]
        return self._counts.peaks_without(named)

    @cached_property
    def ranges(self) -> Ranges:
        """Ranges of mass of all peaks.

        Raises
        ------
        ValueError
            If no ion has a name.
        """
        if not self.peaks:
            raise ValueError(f"ranges need peaks, got a spectrum without a name: {self.hits!r}")
        formulas = list(dict.fromkeys(peak.formula for peak in self.peaks))
        rows = sorted((low, high, peak.formula) for peak in self.peaks for low, high in peak.intervals)
        return Ranges(
            tuple(formula for _, _, formula in rows),
            np.array([low for low, _, _ in rows]),
            np.array([high for _, high, _ in rows]),
            colour=tuple(_PALETTE[formulas.index(formula) % len(_PALETTE)] for _, _, formula in rows),
            composition=tuple(atoms_of_formula(formula) for _, _, formula in rows),
            source="spectrum",
        )

    def select(self, formula: str) -> Hits:
        """Ions in the peaks of an element; see `inside`."""
        return self.hits[self.inside(formula)]

    def inside(self, formula: str) -> NDArray[np.bool_]:
        """Whether each ion is in the peaks of an element, with all its charge states, shape (n,).

        Raises
        ------
        ValueError
            If it has no peaks, or too few ions for a map.
        """
        chosen = [peak for peak in self.peaks if peak.formula == formula]
        if not chosen:
            reason = self.refused or f"the spectrum has no peaks of {short_text(formula)}"
            raise ValueError(reason)
        (mass,) = self.hits.require("mass_to_charge")
        inside = in_intervals(mass, [interval for peak in chosen for interval in peak.intervals])
        if (number := int(np.count_nonzero(inside))) < FEWEST_OF_ELEMENT:
            raise ValueError(f"only {number:,} ions are in peaks of {formula}, expected at least {FEWEST_OF_ELEMENT:,}")
        return inside


def spectrum(
    hits: Hits,
    elements: str | Sequence[str] | None = None,
    *,
    distance: float | None = None,
    time_zero: float = 0.0,
) -> Spectrum:
    """Mass spectrum: m/n, the ions of its peaks, and ranges of mass.

    Parameters
    ----------
    hits : Hits
        Ions with mass_to_charge; or with times of flight, voltages and detector coordinates, and then with `distance`.
    elements : str or sequence of str, optional
        Ions that are expected, such as "W" or ["Cr", "CrO"]; by default the most probable ones are named.
    distance : float, optional
        Nominal distance from the apex to the detector [mm], to 5 %. The flight length is fitted to the peaks, and the
        time zero too if they are of ions of different m/n.
    time_zero : float
        Time that is subtracted from the times of flight [ns], at the start of this fit.

    Returns
    -------
    Spectrum

    Raises
    ------
    ValueError
        If there is no m/n and it cannot be computed, or an element is unknown.

    Notes
    -----
    The isotopes of each ion and charge state are a comb. One factor on m/n puts it on the spectrum; the ion is there if
    the comb explains at least 70 % of the ions above the background about it, and no other comb explains 10 % more of
    the same ions. In a measured spectrum of tungsten it explains 90 % for W3+, 68 % for Re3+.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> mass = np.append(rng.choice([62.93, 64.93], 5000, p=[0.69, 0.31]), rng.uniform(1, 100, 5000))
    >>> spectrum = ae.spectrum(ae.Hits(mass_to_charge=mass * rng.normal(1, 5e-4, 10000)), "Cu")
    >>> [peak.name for peak in spectrum.peaks]
    ['Cu+']
    """
    check_kind(hits, "hits", Hits, "Hits")
    formulas = None if elements is None else [elements] if isinstance(elements, str) else list(elements)
    for formula in formulas or ():
        isotopes_of(formula)
    time_zero = check_number(time_zero, "time_zero", unit="ns")
    flight = None
    if hits.mass_to_charge is None:
        missing = [name for name in ("time_of_flight", "voltage", "x", "y") if getattr(hits, name) is None]
        if missing or distance is None:
            lacking = ", ".join(missing) if missing else "distance"
            raise ValueError(f"a spectrum needs mass_to_charge, or times of flight with {lacking}, got {hits!r}")
        flight = FlightFit(check_number(distance, "distance", above=0, unit="mm"), time_zero)
        flight = _fitted(hits, flight, formulas)
        hits = replace(hits, mass_to_charge=flight.masses(hits))
    counts = LogSpectrum(_detected(hits))
    tolerance = _FILE if flight is None else _FITTED if flight.peaks else _FLIGHT
    combs = _combs(counts, formulas, tolerance)
    refused = "" if formulas is None else _refusal(counts, formulas, combs, tolerance)
    return Spectrum(hits, counts, tuple(_peaks(counts, combs)), flight, refused)


def _detected(hits):
    (mass,) = hits.require("mass_to_charge")
    with np.errstate(invalid="ignore"):
        return mass[hits.detected & (mass > 0)]


def _fitted(hits, flight, formulas):
    """Flight length and time zero after some steps of the fit: from the first ions, or from others that explain more.

    A few expected ions may fit the peaks of others: Al2+ and Al+ those of Si2+ and N2+, 4 % beside them. The peaks that
    then have no name of any ion show it.
    """
    flight = flight.sharpened(hits)
    counts = LogSpectrum(_detected(replace(hits, mass_to_charge=flight.masses(hits))))
    best, most = flight, -math.inf
    for start in _starts(counts, formulas):
        fit = _fitted_from(hits, flight, start, formulas)
        part = _named_part(hits, fit, formulas)
        # a nominal length is good to some per cent
        score = part - abs(math.log(fit.distance / flight.distance))
        if score > most:
            best, most = fit, score
        if formulas is None or part > _WELL_NAMED:
            break
    return best


def _starts(counts, formulas):
    """Ions that a fit may start with: expected ones, each without the peaks of those before, then any."""
    for known in (formulas, None):
        rest = counts
        for _ in range(_STARTS):
            start = next(_candidates(rest, known, _FLIGHT), None)
            if start is None:
                break
            yield start[0]
            rest = rest.without(start[0].intervals)
        if formulas is None:
            return


def _fitted_from(hits, flight, comb, formulas):
    """The fit that starts with the peaks of one ion."""
    combs, nominal = [comb], flight.distance
    chosen = [*(formulas or ["H"]), comb.formula]
    for step in range(_STEPS):
        if step:
            counts = LogSpectrum(_detected(replace(hits, mass_to_charge=flight.masses(hits))))
            # the first comb gives the factor of the others
            combs = [comb for comb, _ in _combs(counts, chosen, _FITTED if step > 1 else _BEGUN)]
        if not combs:
            return flight
        better = flight.improved(hits, combs)
        if not abs(better.distance / nominal - 1.0) < _FLIGHT:  # it leads away from the spectrum
            return flight
        flight = better
    return flight


def _named_part(hits, flight, formulas):
    """Part of the ions above the background that ions with a name explain."""
    rest = counts = LogSpectrum(_detected(replace(hits, mass_to_charge=flight.masses(hits))))
    explained = 0.0
    for known in (None,) if formulas is None else (formulas, None):
        for comb, _ in _combs(rest, known, _FITTED):
            rest = rest.without(comb.intervals)
            explained += comb.ions * comb.fill
    above = float((counts.counts - counts.background).sum())
    return explained / above if above > 0 else 0.0


def _combs(counts, formulas, tolerance):
    """Combs of a spectrum that no other one displaces, the largest first, each with the names of its rivals."""
    chosen: list[tuple[Comb, tuple[str, ...]]] = []
    fewest = _LEAST * counts.counts.sum()
    for _ in range(_MOST):
        named = {comb.name for comb, _ in chosen}  # an ion has one comb: another shift of it is another ion
        candidates = _candidates(counts, formulas, tolerance)
        best = next((pair for pair in candidates if pair[0].ions >= fewest and pair[0].name not in named), None)
        if best is None:
            break
        chosen.append(best)
        counts = counts.without(best[0].intervals)
    return chosen


def _candidates(counts, formulas, tolerance):
    """Combs that explain a spectrum and whose ions none explains better, the largest first, with similar ones."""
    bounds = 1.0 - tolerance, 1.0 + tolerance
    combs = [
        comb
        for formula in dict.fromkeys([*SPECTRUM_ELEMENTS, *_MOLECULES, *(formulas or ())])
        for charge in _charges(formula, formula in (formulas or ()))
        if (comb := counts.comb(formula, charge, *bounds)) is not None
        and comb.fill >= 1 - LARGEST_MISFIT
        and comb.intervals
    ]
    scores = {comb: comb.ions * comb.fill for comb in combs}
    for comb in sorted(combs, key=lambda comb: -comb.ions):
        if formulas is not None and comb.formula not in formulas:
            continue
        rivals = [other for other in combs if other is not comb and _shared(comb, other) > 0.5]
        if all(scores[other] <= _BETTER * scores[comb] for other in rivals):
            yield comb, tuple(other.name for other in rivals if scores[other] > _ALIKE * scores[comb])


def _charges(formula, expected):
    """Charge states of an ion that are tried."""
    highest = _EXPECTED if expected else 1
    if formula in ISOTOPES:
        highest = max(highest, next(charge for mass, charge in _HIGHEST_CHARGES if mean_mass(formula) < mass))
    return range(1, highest + 1)


def _shared(comb, other):
    """Part of the width of a comb's peaks that another comb has, too."""
    width = sum(high - low for low, high in comb.intervals)
    both = sum(
        max(0.0, min(high, last) - max(low, first)) for low, high in comb.intervals for first, last in other.intervals
    )
    return both / width


def _peaks(counts, combs):
    """Peaks of combs; where two overlap, the first comb has the ions."""
    taken: list[tuple[float, float]] = []
    for comb, others in combs:
        intervals = []
        for interval in comb.intervals:
            low, high = interval
            for first, last in taken:
                if first < high and low < last:  # overlap: keep the larger part beside it
                    low, high = (low, first) if first - low > high - last else (last, high)
            if high - low > 0.3 * (interval[1] - interval[0]):
                intervals.append((low, high))
        if not intervals:
            continue
        taken += intervals
        ions, below = np.sum([counts.ions(*interval) for interval in intervals], axis=0)
        yield SpectrumPeaks(
            comb.name, comb.formula, comb.charge, tuple(intervals), round(ions), round(below), comb.fill, comb.factor,
            others,
        )  # fmt: skip


def _refusal(counts, formulas, combs, tolerance):
    """Why some of the ions that are expected have no peaks."""
    missing = [formula for formula in formulas if formula not in {comb.formula for comb, _ in combs}]
    reasons = []
    for formula in missing:
        bounds = 1.0 - tolerance, 1.0 + tolerance
        tried = [
            comb for charge in _charges(formula, True) if (comb := counts.comb(formula, charge, *bounds)) is not None
        ]
        if not tried:
            reasons.append(f"no peaks of {formula}: no ions above the background")
            continue
        best = max(tried, key=lambda comb: comb.ions * comb.fill)
        if best.fill < 1 - LARGEST_MISFIT:
            reasons.append(
                f"no peaks of {formula}: the isotopes of {best.name} explain {best.fill:.0%} of the ions about them, "
                f"expected at least {1 - LARGEST_MISFIT:.0%}"
            )
        elif best.ions < _LEAST * counts.counts.sum():
            reasons.append(f"no peaks of {formula}: {best.ions:,.0f} ions of {best.name} are too few to be named")
        else:
            reasons.append(f"no peaks of {formula}: another ion explains the peaks of {best.name} better")
    return "; ".join(reasons)
