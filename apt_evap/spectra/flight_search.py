"""Search for the flight length of an instrument: which ions a fit may start with, and what they explain."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from apt_evap.detection.hits import Hits
from apt_evap.spectra.flight_fit import FlightFit
from apt_evap.spectra.ion_names import COMMON, GASES, HIGHEST_CHARGE, NOBLE
from apt_evap.spectra.isotope_comb import Comb, LogSpectrum

_MOLECULES = ("H2", "OH", "H2O", "N2", "O2", "CO")  # of the residual gas
_RARE = 0.7  # weight of the ions that a rare element explains
_ELEMENTS = tuple(name for name in HIGHEST_CHARGE if name not in (*NOBLE, "D"))
_EXPECTED = 3  # charge that every expected ion may have
# of the factor on m/n: of a nominal length, with the first ion of a fit, with a fit
_FLIGHT, _BEGUN, _FITTED = 0.1, 0.02, 0.006
_BETTER = 1.1  # ions that a rival explains over those of a comb that it displaces
_ALIKE = 0.85  # ions that a rival explains over those of a comb, from which it is named, too
_LEAST = 5e-4  # of all ions: smaller combs have no name
_MOST = 15  # ions with a name
_STEPS = 4  # of the fit of the flight
_STARTS = 3  # ions of a kind that the fit may start with
_WELL_NAMED = 0.97  # part of the ions above the background that are explained: no other start is tried


def _detected(hits):
    (mass,) = hits.require("mass_to_charge")
    with np.errstate(invalid="ignore"):
        return mass[hits.detected & (mass > 0)]


def fitted_flight(hits: Hits, flight: FlightFit, formulas: Sequence[str] | None) -> FlightFit:
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
        for formula in dict.fromkeys([*_ELEMENTS, *_MOLECULES, *(formulas or ())])
        for charge in _charges(formula, formula in (formulas or ()))
        if (comb := counts.comb(formula, charge, *bounds)) is not None and comb.intervals
    ]
    usual = {*COMMON, *GASES, *_MOLECULES, *(formulas or ())}
    scores = {comb: comb.ions * comb.fill * (1.0 if comb.formula in usual else _RARE) for comb in combs}
    for comb in sorted(combs, key=lambda comb: -scores[comb]):
        if formulas is not None and comb.formula not in formulas:
            continue
        rivals = [other for other in combs if other is not comb and _shared(comb, other) > 0.5]
        if all(scores[other] <= _BETTER * scores[comb] for other in rivals):
            yield comb, tuple(other.name for other in rivals if scores[other] > _ALIKE * scores[comb])


def _charges(formula, expected):
    """Charge states of an ion that are tried."""
    return range(1, max(_EXPECTED if expected else 1, HIGHEST_CHARGE.get(formula, 1)) + 1)


def _shared(comb, other):
    """Part of the width of a comb's peaks that another comb has, too."""
    width = sum(high - low for low, high in comb.intervals)
    both = sum(
        max(0.0, min(high, last) - max(low, first)) for low, high in comb.intervals for first, last in other.intervals
    )
    return both / width
