"""Mass spectra: the ions that explain their peaks together, the composition, and ranges of mass."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_kind, check_number, short_text
from apt_evap.detection.hits import Hits
from apt_evap.specimen.lattice import atom_density
from apt_evap.specimen.materials import MATERIALS
from apt_evap.spectra.candidate_ions import atomic_ions, molecular_ions
from apt_evap.spectra.composition import MOST_UNEXPLAINED, Amounts, Composition
from apt_evap.spectra.dead_time import FEWEST_OF_ISOTOPES, DeadTimeLoss, isotope_losses, losses_of
from apt_evap.spectra.explanation import Explainer, Explanation
from apt_evap.spectra.flight_fit import FlightFit
from apt_evap.spectra.flight_search import fitted_flight
from apt_evap.spectra.ion_names import GASES, HIGHEST_CHARGE, Abundances, Ion, atoms_of_formula, formula_of_atoms
from apt_evap.spectra.ion_profiles import IonProfiles
from apt_evap.spectra.isotope_comb import in_intervals
from apt_evap.spectra.mass_calibration import MassCalibration
from apt_evap.spectra.mass_ranges import Ranges
from apt_evap.spectra.peak_contents import PeakContents
from apt_evap.spectra.peak_scale import HIGHEST, LOWEST
from apt_evap.spectra.ranged_ions import RangedIons, RangeMisfit
from apt_evap.warnings import DataWarning, warn

FEWEST_OF_ELEMENT = 4000
"""Ions of an element that are enough for a map."""
FEWEST_OF_COMPOSITION = 200
"""Ions of a spectrum that are enough for a composition."""
_CLEAR, _UNLIKE, _FEWEST = 5.0, 0.3, 30.0  # unexplained ions: in errors of counting, part of the peak, and number
_NEAR = 2.0  # errors of the calibration within which an ion may have a peak
_FREQUENT = 0.1  # abundance over the largest of an isotope that makes a peak
_CLEAN = 0.98  # part of a peak that one ion has, to measure its isotopes there
_FEW_HEAVY = 1e-3  # part of the ions that is above the spectrum without a word
_SHOWN = 8  # unexplained peaks in a text
_CLEAR_OF_BACKGROUND, _FEW_IN_PEAKS = 3.0, 0.2  # errors and part of some ions, below which these are in no peak
_PALETTE = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e", "#8c564b", "#e377c2", "#17becf", "#bcbd22")


@dataclass(frozen=True)
class SpectrumIon:
    """An ion of a spectrum.

    Parameters
    ----------
    name : str
        Such as "C₂⁺", two atoms with one charge, or "C²⁺", one atom with two.
    formula : str
        Atoms, such as "C2".
    charge : int
        Charge state.
    ions, error : float
        Number of ions above the background, with its standard error.
    intervals : tuple of tuple of float
        Bounds of the peaks that are its own [Da]; none where other ions have more ions in all its peaks.
    others : tuple of str
        Names of other ions that explain its peaks about as well.
    """

    name: str
    formula: str
    charge: int
    ions: float
    error: float
    intervals: tuple[tuple[float, float], ...]
    others: tuple[str, ...] = ()

    def __str__(self) -> str:
        where = ", ".join(f"{low:.4g} to {high:.4g}" for low, high in self.intervals)
        others = f", or {', '.join(self.others)}" if self.others else ""
        return f"{self.name}{others}: {self.ions:,.0f} ± {self.error:,.0f} ions" + (f" at {where} Da" if where else "")


@dataclass(frozen=True)
class UnexplainedPeak:
    """A peak that the ions of a spectrum do not explain.

    Parameters
    ----------
    mass : float
        m/n [Da].
    ions : float
        Ions above the background without an explanation; below zero if its ions should have more.
    perhaps : str
        An ion of this m/n that has no other evidence; "" if there is none.
    """

    mass: float
    ions: float
    perhaps: str = ""

    def __str__(self) -> str:
        ions = f"{self.ions:,.0f} ions" if self.ions > 0 else f"{-self.ions:,.0f} ions are missing"
        return f"{self.mass:.5g} Da ({ions}{f', perhaps {self.perhaps}' if self.perhaps else ''})"


class Spectrum:
    """Mass spectrum of ions; made by `spectrum`.

    Parameters
    ----------
    hits : Hits
        The ions, with mass_to_charge [Da].
    peaks : PeakContents
        Their peaks.
    source : object
        What explains the peaks: the ions of elements, or those of ranges.
    abundances : Abundances
        Isotopes.
    flight : FlightFit or None
        Time zero and flight length of m/n; None if the ions had m/n before.
    refused : str
        Why a requested element has no peaks; "" if all have.

    Attributes
    ----------
    ions : tuple of SpectrumIon
        Ions with a name, the most frequent first.
    unexplained : tuple of UnexplainedPeak
        Peaks that these ions do not explain, the largest first.
    unexplained_part : float
        Their part of the ions in all peaks.
    misfits : tuple of RangeMisfit
        Of ranges that a file gives: those that their ions do not explain, the largest first.
    calibration : MassCalibration
        Relative error of m/n, with its own uncertainty.
    """

    def __init__(
        self,
        hits: Hits,
        peaks: PeakContents,
        source: "_Named | _Ranged",
        abundances: Abundances,
        flight: FlightFit | None,
        refused: str,
    ) -> None:
        self.hits, self.flight, self.refused = hits, flight, refused
        self.ions, self.unexplained, self.unexplained_part = source.named, source.unexplained, source.unexplained_part
        self.misfits: tuple[RangeMisfit, ...] = source.misfits
        self.calibration: MassCalibration = source.calibration
        self._peaks, self._source, self._abundances = peaks, source, abundances

    def __repr__(self) -> str:
        names = ", ".join(ion.name for ion in self.ions) or "no ion named"
        return f"<Spectrum: {len(self.hits):,} ions, {self.unexplained_part:.1%} unexplained, {names}>"

    def __str__(self) -> str:
        where = ", ".join(map(str, self.unexplained[:_SHOWN])) + (", ..." if len(self.unexplained) > _SHOWN else "")
        ranged, first = self.ranged, f"unexplained: {self.unexplained_part:.1%} of the ions in "
        lines = [first + ("ranges" if ranged else f"peaks, at {where}" if where else "peaks")]
        if number := self.composition.without_mass:
            lines.append(f"{number:,} of {len(self.hits):,} ions have no mass-to-charge ratio: they are not counted")
        lines += [f"range {misfit}" for misfit in self.misfits]
        lines += [f"peaks in no range at {where}"] if ranged and where else []
        lines += [] if self.flight is None else [str(self.flight)]
        lines += [str(ion) for ion in self.ions]
        lines += [f"{element} or {' and '.join(others)}: the peaks do not decide" for element, others in self.either]
        lines += [self.refused] if self.refused else []
        if not self.ions and not self.refused:
            lines.append("no ion named: no peaks of known isotopes above the background")
        return "\n".join([*lines, *str(self.composition).splitlines()[1:]])

    @property
    def main_element(self) -> str | None:
        """Formula of more than half of the named ions, None without one."""
        ions: dict[str, float] = {}
        for ion in self.ions:
            ions[ion.formula] = ions.get(ion.formula, 0) + ion.ions
        most = max(ions, key=lambda formula: ions[formula], default=None)
        return most if most is not None and ions[most] > 0.5 * math.fsum(ions.values()) else None

    @property
    def ranged(self) -> bool:
        """Whether the ions are those of ranges."""
        return isinstance(self._source, _Ranged)

    @property
    def either(self) -> tuple[tuple[str, tuple[str, ...]], ...]:
        """Elements of which the data cannot tell whether others are there in their place."""
        return self._source.either

    @cached_property
    def _inside(self):
        """Which ions are counted, bool (n,)."""
        return _inside(self.hits)

    @cached_property
    def composition(self) -> Composition:
        """Composition in at.%, without one where more than 10 % of the ions in peaks are unexplained."""
        ions, refused = int(np.count_nonzero(self._inside)), ""
        if ions < FEWEST_OF_COMPOSITION:
            refused = f"{ions:,} ions are too few, expected at least {FEWEST_OF_COMPOSITION}"
        return self._composition(self._source.amounts, self.unexplained_part, self.hits, refused)

    def composition_of(self, selection: Hits | NDArray[np.bool_]) -> Composition:
        """Composition of a part of the ions, with the ions, the shapes and the places of the whole spectrum.

        Parameters
        ----------
        selection : Hits or array_like of bool
            Ions with mass_to_charge, such as those of a region; or which ions of `hits`, shape (n,).

        Raises
        ------
        ValueError
            If the shape is wrong, or there is no m/n.
        """
        if not isinstance(selection, Hits):
            selection = self.hits[check_array(selection, "selection", (len(self.hits),), dtype=bool)]
        mass, refused = _detected(selection), ""
        if not self.ions:
            return self._composition(self._source.amounts, self.unexplained_part, selection)
        ions, covariance, unexplained = self._source.amounts_of(mass)
        total, error = ions.sum(), math.sqrt(max(float(covariance.sum()), 0.0))
        if total < min(_CLEAR_OF_BACKGROUND * error, _FEW_IN_PEAKS * len(mass)):
            refused = f"the {len(mass):,} ions are in no peak of an ion with a name"
        amounts = Amounts(self._source.amounts.atoms, ions, covariance)
        return self._composition(amounts, unexplained, selection, refused)

    def _composition(self, amounts, unexplained, hits, refused=""):
        if not refused and self.ranged and self.unexplained_part > MOST_UNEXPLAINED:
            refused = (
                f"{self.unexplained_part:.1%} of the ions in ranges are not those that the ranges name, more than "
                f"{MOST_UNEXPLAINED:.0%}; without ranges the isotopes name the peaks"
            )
        return amounts.composition(unexplained, refused, _without_mass(hits))

    def candidates(self, mass: float) -> tuple[str, ...]:
        """Names of the ions that may have a peak at some m/n [Da], those that the spectrum names first.

        Raises
        ------
        ValueError
            If the m/n is not above zero.
        """
        mass = check_number(mass, "mass", above=0, unit="Da")
        named = [Ion(ion.formula, ion.charge) for ion in self.ions]
        present = {name for ion in named for name in ion.atoms}
        tried = [*named, *atomic_ions([*HIGHEST_CHARGE]), *molecular_ions(frozenset(present | {*GASES}), frozenset())]
        reach = _NEAR * float(self.calibration.shift(mass)[1][0]) + 2 * float(self._peaks.scale.sigma(mass))
        near = {}
        for ion in dict.fromkeys(tried):
            masses, shares = self._abundances.lines(ion.formula)
            places = self.calibration.place(masses[shares > _FREQUENT * shares.max()] / ion.charge)
            distance = float(np.abs(np.log(places / mass)).min())
            if distance < reach:
                near[ion.name] = ion not in named, ion.charge > 2, distance
        return tuple(sorted(near, key=lambda name: near[name])[:_SHOWN])

    def dissociations(self) -> list[tuple[str, tuple[float, float, float]]]:
        """Names and m/n [Da] of the ions that may break into two others, with those of these two."""
        lines = []
        known = {(ion.formula, ion.charge): ion for ion in self.ions}
        for parent in self.ions:
            for first in self.ions:
                rest = dict(atoms_of_formula(parent.formula))
                for name, number in atoms_of_formula(first.formula).items():
                    rest[name] = rest.get(name, 0) - number
                if min(rest.values()) < 0 or not any(rest.values()):
                    continue
                formula = formula_of_atoms({name: number for name, number in rest.items() if number})
                second = known.get((formula, parent.charge - first.charge))
                if second is None or (first.formula, first.charge) > (second.formula, second.charge):
                    continue
                ions = (parent, first, second)
                name = f"{parent.name} → {first.name} + {second.name}"
                lines.append((name, tuple(self._mass_of(ion) for ion in ions)))
        return lines  # type: ignore[return-value]

    def _mass_of(self, ion):
        """m/n of the most abundant isotope of an ion [Da]."""
        masses, shares = self._abundances.lines(ion.formula)
        return float(masses[int(np.argmax(shares))]) / ion.charge

    def losses(self, alone: NDArray[np.bool_] | None = None) -> DeadTimeLoss:
        """Losses by dead time: isotopes of single ions against those of pulses with several.

        Parameters
        ----------
        alone : ndarray of bool, optional
            Whether each ion is the only one of its pulse, shape (n,); by default from `pulse_id`.

        Raises
        ------
        ValueError
            If the ions have no pulses, or the ions are those of ranges.
        """
        if not isinstance(self._source, _Named):
            raise ValueError("losses need the ions of a spectrum, got those of ranges")
        if alone is None:
            (pulse,) = self.hits.require("pulse_id")
            _, place, number = np.unique(pulse, return_inverse=True, return_counts=True)
            alone = number[place] == 1
        (mass,) = self.hits.require("mass_to_charge")
        return self._source.losses(mass[self._inside & alone], mass[self._inside & ~alone], self.composition)

    def dead_time_note(self, alone: NDArray[np.bool_] | None = None) -> str:
        """Sentence about losses by dead time that move the composition by more than its error, str.

        "" without such losses, and where they cannot be measured: without a composition, without pulses, and with
        ranges.

        Parameters
        ----------
        alone : ndarray of bool, optional
            As for `losses`.
        """
        if self.ranged or self.composition.refused or (alone is None and self.hits.pulse_id is None):
            return ""
        losses = self.losses(alone)
        return f"{losses}" if losses.matters else ""

    def background(self, edges: Floats) -> Floats:
        """Number of ions of the background between edges of m/n [Da], shape (k + 1,), array of shape (k,)."""
        below = np.pad(np.cumsum(self._source.background), (1, 0))
        places = self._peaks.scale.bins(np.clip(edges, LOWEST, HIGHEST)) + 0.5
        return np.diff(np.interp(places, np.arange(len(below)), below))

    def ranges(self) -> Ranges:
        """Ranges of mass of all peaks: as wide that lost ions and ions of others are fewest in sum.

        Raises
        ------
        ValueError
            If no ion has a name.
        """
        rows = sorted((low, high, ion.formula) for ion in self.ions for low, high in ion.intervals)
        if not rows:
            raise ValueError(f"ranges need peaks, got a spectrum without a name: {self.hits!r}")
        formulas = list(dict.fromkeys(ion.formula for ion in self.ions))
        return Ranges(
            tuple(formula for _, _, formula in rows),
            np.array([low for low, _, _ in rows]),
            np.array([high for _, high, _ in rows]),
            volume=np.array([_volume(formula) for _, _, formula in rows]),
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
        wanted = formula_of_atoms(atoms_of_formula(formula))
        intervals = [interval for ion in self.ions if ion.formula == wanted for interval in ion.intervals]
        if not intervals:
            reason = self.refused or f"the spectrum has no peaks of {short_text(formula)}"
            raise ValueError(reason)
        (mass,) = self.hits.require("mass_to_charge")
        inside = in_intervals(mass, intervals)
        if (number := int(np.count_nonzero(inside))) < FEWEST_OF_ELEMENT:
            raise ValueError(f"only {number:,} ions are in peaks of {formula}, expected at least {FEWEST_OF_ELEMENT:,}")
        return inside


class _Named:
    """What a spectrum reports of the ions that explain it."""

    misfits: tuple[RangeMisfit, ...] = ()

    def __init__(self, peaks: PeakContents, explanation: Explanation) -> None:
        fit, chosen = explanation.fit, np.asarray(explanation.chosen, int)
        contents, ions = explanation.contents, explanation.ions
        self.calibration, self.background = explanation.calibration, contents.background
        self.profiles = IonProfiles(peaks, contents, fit.shares[chosen], explanation.amplitudes)
        self._counted = explanation.numbers.profiles(explanation.chosen)
        errors = np.sqrt(np.maximum(np.diag(explanation.covariance), 0)).tolist() if len(ions) else []
        intervals = self.profiles.intervals()
        named = [
            SpectrumIon(
                ion.name, ion.formula, ion.charge, number, error, tuple(bounds), tuple(_names(fit.ions, others))
            )
            for ion, number, error, bounds, others in zip(
                ions, explanation.amplitudes.tolist(), errors, intervals, explanation.others, strict=True
            )
        ]
        self.named = tuple(sorted(named, key=lambda ion: -ion.ions))
        self._peaks, self._formulas = peaks, [ion.name for ion in ions]
        self.amounts = Amounts(
            [ion.atoms for ion in ions],
            explanation.amplitudes,
            explanation.covariance,
            [
                ([fit.ions[n].atoms for n in numbers], x, covariance, worse)  # type: ignore[union-attr]
                for numbers, x, covariance, worse in explanation.sets
            ],
        )
        model = fit.explained(explanation.chosen, explanation.amplitudes)
        rest = contents.ions - model  # below zero where the ions should have more
        mine = fit.shares[chosen[[ion in explanation.numbers.named_in_flanks for ion in ions]]].sum(0) > 0
        if mine.any():  # the tails by which the contents are known are not those of the ions
            rest[mine] = self._counted.left_over(explanation.amplitudes, contents.mass)[mine]
        large = np.abs(rest) > np.maximum(_UNLIKE * np.maximum(contents.ions, model), _FEWEST)
        large &= (np.abs(rest) > _CLEAR * np.sqrt(contents.variance)) & (contents.seen | (rest < 0))
        self.unexplained = tuple(
            UnexplainedPeak(float(contents.mass[at]), float(rest[at]), _perhaps(explanation, float(contents.mass[at])))
            for at in sorted(np.flatnonzero(large), key=lambda at: -abs(rest[at]))
        )
        self._more = np.flatnonzero(large & (rest > 0))
        self._more_ions = rest[self._more]
        self._missing_part = float(-rest[large & (rest < 0)].sum() / max(float(explanation.amplitudes.sum()), 1.0))
        # ions that are there and ions that are missing may be more than all
        self.unexplained_part = min(float(np.abs(rest[large]).sum() / max(contents.total, 1.0)), 1.0)
        self.either = tuple(explanation.either.items())

    def amounts_of(self, mass: Floats) -> tuple[Floats, Floats, float]:
        """Numbers of ions and their covariance among some ions [Da], and the part of these without an explanation."""
        ions, covariance = self._counted.amounts(mass)
        unexplained = self._missing_part * float(ions.sum())
        if len(self._more):
            counted = self._counted
            row = np.zeros((len(self._more), counted.shares.shape[1]))
            row[np.arange(len(self._more)), self._more] = 1
            shares, start = np.vstack([counted.shares, row]), np.append(counted.ions, self._more_ions)
            every = IonProfiles(self._peaks, counted.contents, shares, start).amounts(mass)[0]
            unexplained += float(every[len(ions) :].sum())
        return ions, covariance, min(unexplained / max(float(ions.sum()) + unexplained, 1.0), 1.0)

    def losses(self, single: Floats, multiple: Floats, before: Composition) -> DeadTimeLoss:
        """Losses among the ions of pulses with several [Da], from those of pulses with one."""
        profiles = self.profiles
        used = np.flatnonzero(profiles.shares.sum(0) > 0)
        contents = profiles.contents
        alone = IonProfiles(self._peaks, contents, np.eye(len(contents.mass))[used], contents.ions[used])
        (first, first_errors), (second, second_errors) = (alone.amounts(mass) for mass in (single, multiple))
        errors = np.maximum(np.diag(first_errors), 0), np.maximum(np.diag(second_errors), 0)
        parts = (profiles.shares * profiles.ions[:, None])[:, used]
        lost, missing = {}, {}
        for name, part in zip(self._formulas, parts, strict=True):
            clean = np.flatnonzero(part > _CLEAN * np.maximum(parts.sum(0), 1e-9))
            if len(clean) < 2:
                continue
            major = int(clean[np.argmax(part[clean])])
            minor = clean[clean != major]
            if min(first[minor].sum(), second[minor].sum()) < FEWEST_OF_ISOTOPES:
                continue
            lost[name] = isotope_losses(major, minor, first, second, errors)
            missing[name] = second[major] * lost[name][0] / max(1 - lost[name][0], 0.1)
        return losses_of(self.amounts, self._formulas, lost, missing, before)


class _Ranged:
    """What a spectrum reports of the ions of ranges."""

    either: tuple[tuple[str, tuple[str, ...]], ...] = ()

    def __init__(self, peaks: PeakContents, ranges: Ranges, abundances: Abundances, mass: Floats) -> None:
        contents = peaks.fit()
        self._ranged = RangedIons(peaks, contents, ranges, abundances)
        self.calibration, self.background = self._ranged.calibration, contents.background
        ions, covariance = self._ranged.amounts(mass)
        errors = np.sqrt(np.maximum(np.diag(covariance), 0)).tolist()
        named = []
        for ion, rows, number, error in zip(self._ranged.ions, self._ranged.rows, ions.tolist(), errors, strict=True):
            bounds = tuple((float(ranges.low[row]), float(ranges.high[row])) for row in rows)
            named.append(SpectrumIon(ion.name, ion.formula, ion.charge, number, error, bounds))
        self.named = tuple(sorted(named, key=lambda ion: -ion.ions))
        misfits, self.unexplained_part = self._ranged.misfits(mass, ions)
        self.misfits = tuple(misfits)
        outside = sorted(self._ranged.outside(), key=lambda peak: -peak[1])
        self.unexplained = tuple(UnexplainedPeak(place, number) for place, number in outside)
        self.amounts = Amounts([ion.atoms for ion in self._ranged.ions], ions, covariance)

    def amounts_of(self, mass: Floats) -> tuple[Floats, Floats, float]:
        """Numbers of ions and their covariance among some ions [Da], and the part in ranges that is wrong."""
        ions, covariance = self._ranged.amounts(mass)
        return ions, covariance, self._ranged.misfits(mass, ions)[1]


def _volume(formula):
    """Volume of the atoms of an ion in their crystals [nm^3]; NaN where one is not known."""
    parts = [
        (number, MATERIALS[name]) if name in MATERIALS else (math.nan, None)
        for name, number in atoms_of_formula(formula).items()
    ]
    return sum(number / (atom_density(m.structure, m.a, m.c) if m else 1.0) for number, m in parts)


def _names(ions: Sequence[Ion | None], numbers):
    return [ion.name for ion in (ions[number] for number in numbers) if ion is not None]


def _perhaps(explanation, mass):
    near = [e for e, (place, _) in explanation.perhaps.items() if abs(math.log(place / mass)) < 1e-3]
    return near[0] if near else ""


def spectrum(
    hits: Hits,
    elements: str | Sequence[str] | None = None,
    ranges: Ranges | None = None,
    isotopes: Mapping[str, Mapping[int, float]] | None = None,
    *,
    distance: float | None = None,
    time_zero: float = 0.0,
) -> Spectrum:
    """Mass spectrum: m/n, the ions that explain its peaks, the composition, and ranges of mass.

    Parameters
    ----------
    hits : Hits
        Ions with mass_to_charge; or with times of flight, voltages and detector coordinates, and then with `distance`.
    elements : str or sequence of str, optional
        Elements and ions that are expected, such as "W" or ["Cr", "CrO"]: only ions of these elements are named. By
        default all elements are tried, rare ones with more evidence. "D" is deuterium, "57Fe" an isotope.
    ranges : Ranges, optional
        Ranges of a file: only their ions are counted, and ranges that their ions do not explain are reported.
    isotopes : mapping, optional
        Abundances of an enriched element by mass number, such as {"Si": {28: 0.5, 30: 0.5}}.
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
        If there is no m/n and it cannot be computed, an element or isotope is unknown, abundances do not sum to one, or
        the ranges contain no isotopes of their ions.

    Warns
    -----
    DataWarning
        If some m/n are not above zero.

    Notes
    -----
    All peaks have one shape, and lie on a smooth background; their contents are fitted by likelihood. Ions are chosen
    by the contents and places of all peaks together, against a cost of every element and ion. See
    :doc:`/composition`.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> mass = np.append(rng.choice([62.93, 64.93], 5000, p=[0.69, 0.31]), rng.uniform(1, 100, 5000))
    >>> spectrum = ae.spectrum(ae.Hits(mass_to_charge=mass * rng.normal(1, 5e-4, 10000)), "Cu")
    >>> [ion.name for ion in spectrum.ions]
    ['Cu⁺']
    """
    check_kind(hits, "hits", Hits, "Hits")
    formulas = None if elements is None else [elements] if isinstance(elements, str) else list(elements)
    formulas = None if formulas is None else [formula_of_atoms(atoms_of_formula(formula)) for formula in formulas]
    abundances = Abundances(isotopes)
    if ranges is not None and formulas is not None:
        raise ValueError("a spectrum has elements or ranges, got both: ranges name their ions")
    time_zero = check_number(time_zero, "time_zero", unit="ns")
    flight = None
    if hits.mass_to_charge is None:
        missing = [name for name in ("time_of_flight", "voltage", "x", "y") if getattr(hits, name) is None]
        if missing or distance is None:
            lacking = ", ".join(missing) if missing else "distance"
            raise ValueError(f"a spectrum needs mass_to_charge, or times of flight with {lacking}, got {hits!r}")
        flight = FlightFit(check_number(distance, "distance", above=0, unit="mm"), time_zero)
        flight = replace(fitted_flight(hits, flight, formulas), nominal=distance)
        hits = replace(hits, mass_to_charge=flight.masses(hits))
    else:
        _warn_of_masses(hits)
    mass = _detected(hits)
    peaks = PeakContents(mass)
    if ranges is not None:
        return Spectrum(hits, peaks, _Ranged(peaks, ranges, abundances, mass), abundances, flight, "")
    if formulas is None:
        return Spectrum(hits, peaks, _Named(peaks, Explainer(peaks, abundances).explain()), abundances, flight, "")
    explanation = Explainer(peaks, abundances, formulas, only=True).explain()
    source = _Named(peaks, explanation)
    displaced: dict[str, str] = {}
    if source.unexplained_part > MOST_UNEXPLAINED:
        displaced = _displaced(source, Explainer(peaks, abundances, formulas).explain())
        if displaced:
            rest = [formula for formula in formulas if not set(atoms_of_formula(formula)) & set(displaced)]
            source = _Named(peaks, Explainer(peaks, abundances, rest, only=True).explain())
    return Spectrum(hits, peaks, source, abundances, flight, _refusal(source, explanation, formulas, displaced))


def _detected(hits):
    """m/n of the detected ions between `LOWEST` and `HIGHEST` [Da]."""
    return hits.require("mass_to_charge")[0][_inside(hits)]


def _inside(hits):
    """Which ions are detected with m/n between `LOWEST` and `HIGHEST`, bool (n,)."""
    (mass,) = hits.require("mass_to_charge")
    with np.errstate(invalid="ignore"):
        return hits.detected & (mass > LOWEST) & (mass < HIGHEST)


def _without_mass(hits):
    """Number of detected ions whose m/n is not a number."""
    (mass,) = hits.require("mass_to_charge")
    return int(np.count_nonzero(hits.detected & ~np.isfinite(mass)))


def _warn_of_masses(hits):
    (mass,) = hits.require("mass_to_charge")
    with np.errstate(invalid="ignore"):
        detected = hits.detected
        wrong, heavy = mass[detected & (mass < 0)], np.count_nonzero(detected & (mass >= HIGHEST))
    if len(wrong):
        warn(
            f"mass_to_charge must be > 0 [Da], got {len(wrong):,} of {len(mass):,} ions down to {wrong.min():.4g}: "
            "these are left out",
            DataWarning,
        )
    if heavy > _FEW_HEAVY * len(mass):
        warn(f"{heavy:,} of {len(mass):,} ions are above {HIGHEST:g} Da: these are left out", DataWarning)


def _displaced(source, rival):
    """Elements that other elements displace where all are tried, with the sentence that says so.

    A few expected elements may fit some peaks of others: Re3+ two of the four of W3+.
    """
    present = {name for ion in rival.ions for name in ion.atoms}
    lost = {name for ion in source.named for name in atoms_of_formula(ion.formula)} - present
    sentences = {}
    for name in sorted(lost):
        ions = [ion for ion in source.named if name in atoms_of_formula(ion.formula)]
        places = [interval for ion in ions for interval in ion.intervals]
        others = [
            ion.name
            for ion, number in zip(rival.ions, rival.chosen, strict=True)
            if in_intervals(rival.contents.mass[[rival.fit.main[number]]], places).any()
        ]
        by = f"{', '.join(others)} fits" if others else "others fit"
        sentences[name] = f"no peaks of {name}: {by} those of {', '.join(ion.name for ion in ions)} better"
    return sentences


def _refusal(source, explanation, formulas, displaced):
    """Why some of the ions that are expected have no peaks."""
    named = {ion.formula for ion in source.named}
    reasons = []
    for formula in formulas:
        if formula in named:
            continue
        if lost := sorted(set(atoms_of_formula(formula)) & set(displaced)):
            reasons.append(displaced[lost[0]])
            continue
        fit = explanation.fit
        tried = [at for at, ion in enumerate(fit.ions) if ion is not None and ion.formula == formula]
        tried = [at for at in tried if fit.possible(np.array([at]))[0]]
        if not tried:
            reasons.append(f"no peaks of {formula}: no peaks above the background where its isotopes should be")
            continue
        ions = [fit.contents.ions[fit.main[at]] / fit.largest[at] for at in tried]
        best = tried[int(np.argmax(ions))]
        if max(ions) < 5e-4 * fit.contents.ions.sum():
            reasons.append(f"no peaks of {formula}: {max(ions):,.0f} ions of {fit.ions[best].name} are too few")
        else:
            reasons.append(
                f"no peaks of {formula}: the isotopes of {fit.ions[best].name} do not fit, or others fit better"
            )
    return "; ".join(reasons)
