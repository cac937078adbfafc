"""The ions that explain all peaks of a spectrum together."""

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from apt_evap._common.types import Floats
from apt_evap.spectra.calibration_anchors import Point, find_anchors
from apt_evap.spectra.candidate_ions import atomic_ions, ions_between
from apt_evap.spectra.ion_choice import IonChoice
from apt_evap.spectra.ion_fit import MISSED, IonFit
from apt_evap.spectra.ion_names import COMMON, GASES, Abundances, Ion, atoms_of_formula, element_of
from apt_evap.spectra.ion_numbers import IonNumbers
from apt_evap.spectra.mass_calibration import MassCalibration
from apt_evap.spectra.peak_contents import Contents, PeakContents
from apt_evap.spectra.peak_scale import HIGHEST, LIGHT, LOWEST

_SHAPE = 0.02  # relative error of a content while ions are chosen: the shape of a peak
_WINDOWS = (0.005, 0.005, 0.004, 0.004)  # relative distance of peaks from their ions, in each round
_MOST_IONS = (14, 24, 60, 60)
_OWN_SHIFT = 5e-4  # of the peaks of an ion of its own, once the others have names
_ALIKE = 30.0
"""Chi-squared and costs by which another name of a peak may be worse: then both are named."""
_FLANK = 14.0  # standard deviations of 1 Da over the charge, below which a hydride may be the tail of its metal
_BEFORE, _BEHIND = 4.0, 8.0  # of an ion, within which another one may be in its flanks
_HYDRIDE = 8.0  # cost of such a hydride in the error
_PRIOR = 0.25
"""Part of the costs of other names that counts against them in the error. It is a convention: the costs are, too, and
coverage does not decide: of 117 and 118 shares of few and of broad ions (seed 404102, all elements tried) 91 and 92 %
are within 1.96 errors with 0, 0.25, 0.5 and 1. With 0, hydrogen would be as likely deuterium."""
_LEAST_GAIN = 1.0  # of chi-squared, of an ion in the peaks of others: a standard error
_POINT_ERROR = 1e-4  # least error of a point of the calibration
_MOST_POINTS = 60
_MANY = 0.01  # of all ions: an element with such an ion is there
_AS_MANY = 0.002  # of all ions: by which other sets of ions may leave more peaks without a name
_SURE_LINES = 6  # seen peaks of the atomic ions of an element, from which no other set is tried
_ONE_LINE = 0.03  # of all ions, from which one line may show an element
_ONE_ISOTOPE = 0.8  # abundance of the isotope of such an element
_KNOWN = 1e-3  # error of the calibration, below which it may
_LINES, _MOSTLY = 3, 0.3  # lines of all ions of an element, and their part of all ions: one of atoms is enough
_ONE_LINE_ALONE = 0.002  # the same of a line that no other ion has, by a calibration without it


@dataclass
class Explanation:
    """Ions of a spectrum, and what they leave."""

    contents: Contents
    calibration: MassCalibration
    fit: IonFit
    chosen: list[int]
    amplitudes: Floats
    covariance: Floats
    others: list[list[int]]
    """Ions that could be in place of each."""
    numbers: IonNumbers
    """Their numbers."""
    sets: list[tuple[list[int], Floats, Floats, float]] = field(default_factory=list)
    """Other sets of ions that explain the peaks about as well, their amplitudes with covariance, and by how much
    chi-squared and a part of their costs are above."""
    either: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Elements that could be in place of an element."""
    perhaps: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Elements with one line only, which are not counted: m/n [Da] and ions."""

    @property
    def ions(self) -> list[Ion]:
        """The ions."""
        return [self.fit.ions[number] for number in self.chosen]  # type: ignore[misc]


class Explainer:
    """Search for the ions of a spectrum.

    Parameters
    ----------
    peaks : PeakContents
        The spectrum.
    abundances : Abundances
        Isotopes.
    expected : sequence of str, optional
        Formulas of ions that are expected; their elements cost nothing.
    only : bool
        Try only the elements of these. By default all elements are tried.
    """

    def __init__(
        self, peaks: PeakContents, abundances: Abundances, expected: Sequence[str] = (), only: bool = False
    ) -> None:
        self.peaks, self.abundances, self.expected = peaks, abundances, expected
        self._free = {name for text in expected for name in atoms_of_formula(text)}
        self.allowed = self._free if only else None
        self.calibration = MassCalibration()
        self._anchors: list[Point] = []
        self._pairs: set[str] = set()  # elements whose line may be of a pair of others
        self._alone: set[str] = set()  # elements of lines that no other ion can have

    def explain(self) -> Explanation:
        """The ions, in four rounds: with each the calibration is better known."""
        contents = self.peaks.fit()
        if self.allowed is not None and not self.allowed:  # nothing is left to name
            fit = IonFit(contents, self.peaks.scale, self.calibration, self.abundances, _SHAPE, _WINDOWS[-1])
            none = np.zeros(0)
            numbers = IonNumbers(self.peaks, fit, self.abundances, self.calibration)
            return Explanation(contents, self.calibration, fit, [], none, np.zeros((0, 0)), [], numbers)
        choice = self._choice(contents, _WINDOWS[0])
        ions = atomic_ions(choice.elements)
        self._anchors = find_anchors(contents, self.peaks.scale, self.abundances, ions)
        self.calibration.learn(self._anchors)
        chosen: list[int] = []
        amplitudes = np.zeros(0)
        banned: set[str] = set()
        banned_ions: set[Ion] = set()
        perhaps: dict[str, tuple[float, float]] = {}
        for number, window in enumerate(_WINDOWS):
            if number == 2:
                banned, perhaps = set(), {}
            if number in (1, 2):
                contents = self.peaks.fit(self._expected_places(contents, choice, chosen, amplitudes, window))
            choice = self._choice(contents, window)
            choice.banned, choice.banned_ions = banned, banned_ions
            while True:
                chosen, amplitudes, _ = choice.choose(_MOST_IONS[number])
                if number < 2:
                    break
                if hydrides := self._hydrides(choice, chosen, amplitudes):
                    banned_ions |= hydrides
                    continue
                chosen, amplitudes = self._with_lone(choice, chosen, amplitudes)
                unsure = self._unsure(choice, chosen, amplitudes)
                if not unsure:
                    break
                banned |= set(unsure)
                perhaps |= unsure
            self._learn(choice, chosen, amplitudes, number)
        sets, either = [], {}
        if self.allowed is None:
            choice, chosen, sets, either = self._other_sets(choice, chosen, amplitudes)
        return self._finished(choice, chosen, sets, either, perhaps)

    def _choice(self, contents, window, shape_error=_SHAPE, own_shift=0.0):
        fit = IonFit(
            contents, self.peaks.scale, self.calibration, self.abundances, shape_error, window, own_shift
        )  # fmt: skip
        return IonChoice(fit, self.allowed, self.expected)

    def _expected_places(self, contents, choice, chosen, amplitudes, window):
        """Places where ions that are probable need a peak and none is seen [Da]."""
        seen, scale = self.peaks.seen_at, self.peaks.scale
        if not len(seen):
            return np.zeros(0)
        old = choice.fit
        sure = self._sure_elements(choice, chosen, amplitudes)
        probable = []
        for number in [*chosen, *choice.candidates(chosen, amplitudes, every=True).tolist()]:
            ion = old.ions[number]
            if ion is None:
                continue
            masses, shares = self.abundances.lines(ion.formula)
            known = ion.formula in sure or number in chosen
            probable.append((masses / ion.charge, shares, known))
        places = [self.calibration.place(masses) for masses, _, _ in probable]
        needed = []
        for place, (_, shares, known) in zip(places, probable, strict=True):
            main = place[int(np.argmax(shares))]
            distance = np.abs(np.log(seen / main))
            near = int(np.argmin(distance))
            if known or distance[near] <= max(window, 2 * float(scale.sigma(seen[near]))):
                needed.append(
                    place[(shares > 0.01 * shares.max()) & (place > 1.02 * LOWEST) & (place < 0.98 * HIGHEST)]
                )
        return self._without_peaks(np.concatenate(needed) if needed else np.zeros(0))

    def _sure_elements(self, choice, chosen, amplitudes):
        """Elements that the user gives, and those with many atomic ions: all their charge states may be in tails."""
        total = max(float(np.sum(amplitudes)), 1e-9)
        found = {
            ion.formula
            for ion, x in ((choice.fit.ions[number], x) for number, x in zip(chosen, amplitudes, strict=True))
            if ion is not None and ion.formula in choice.elements and x > _MANY * total
        }
        return found | (self.allowed or set())

    def _without_peaks(self, places):
        """Those of some places [Da] that no peak and no place before them is near."""
        sigma = self.peaks.scale.sigma(places)
        if len(self.peaks.seen_at):
            reach = np.where(places < LIGHT, 0.015, np.maximum(2.5 * sigma, 1.5e-3))
            free = np.abs(np.log(self.peaks.seen_at / places[:, None])).min(1) >= reach
            places, sigma = places[free], sigma[free]
        logs, left, kept = np.log(places), np.ones(len(places), bool), []
        while left.any():
            first = int(np.argmax(left))
            kept.append(places[first])
            left &= np.abs(logs - logs[first]) >= 2.5 * sigma
        return np.array(kept)

    def _hydrides(self, choice, chosen, amplitudes):
        """Hydrides, nitrides, and pairs with two charges, with more ions than the atoms of the metal: other ions."""
        atomic: dict[str, float] = defaultdict(float)
        once: dict[str, float] = defaultdict(float)  # with one charge: of the m/n of a pair with two
        ions = [(choice.fit.ions[number], x) for number, x in zip(chosen, amplitudes, strict=True)]
        for ion, x in ions:
            if ion is not None and choice.atoms[choice.fit.numbers([ion])[0]].sum() == 1:
                atomic[ion.formula] += x
                once[ion.formula] += x * (ion.charge == 1)
        hydrides = set()
        for ion, x in ions:
            metals = [] if ion is None else [name for name in ion.atoms if name not in (*GASES, "D")]
            if len(metals) != 1 or ion.formula in self.expected:
                continue
            metal, others = metals[0], set(ion.atoms) - {metals[0]}
            pair = ion.atoms[metal] == ion.charge == 2 and others <= {"H", "D"}
            if (pair and x > once[metal]) or (len(others) == 1 and others <= {"H", "N"} and x > atomic[metal]):
                hydrides.add(ion)
        return hydrides

    def _unsure(self, choice, chosen, amplitudes):
        """Elements without two lines of their atomic ions, and place and ions of the largest line."""
        if self.allowed is not None:
            return {}
        fit = choice.fit
        contents, total = fit.contents, fit.explained(chosen, amplitudes)
        lines: dict[str, set[int]] = defaultdict(set)
        largest: dict[str, tuple[float, float]] = {}
        for number, x in zip(chosen, amplitudes, strict=True):
            ion = fit.ions[number]
            if ion is None or choice.atoms[number].sum() > 1:
                continue
            held = fit.shares[number] * x
            clear = contents.seen & (held > 4 * np.sqrt(contents.variance))
            clear &= held > 0.5 * np.maximum(total, contents.ions)
            lines[ion.formula] |= set(np.flatnonzero(clear).tolist())
            peak = int(np.argmax(held))
            if held[peak] > largest.get(ion.formula, (0.0, 0.0))[1]:
                largest[ion.formula] = float(contents.mass[peak]), float(held[peak])
        unsure = {}
        for at in np.flatnonzero(choice.atoms[np.asarray(chosen, int)].any(0)) if chosen else ():
            name = choice.elements[at]
            if name == "H" or len(lines[name]) > 1 or name in self._free:
                continue
            # hydrogen and the gases have molecules, deuterium has one atomic line
            held = self._lines_of(choice, chosen, amplitudes, name)
            if name == "D":  # lines that hydrogen may have say nothing
                tried = choice.candidates(chosen, amplitudes)
                held -= set(fit.main[tried[choice.atoms[tried, at] == 0]].tolist())
            if element_of(name) in (*GASES, "D") and len(held) > (name != "D"):
                continue
            place, ions = largest.get(name, (math.nan, 0.0))
            if ions > 0 and len(held) >= _LINES and contents.ions[sorted(held)].sum() > _MOSTLY * contents.ions.sum():
                continue
            part = ions / max(float(contents.ions.sum()), 1.0)
            alone = self.abundances.lines(name)[1].max() > _ONE_ISOTOPE  # else the other isotopes should be seen
            if ions > 0 and alone and part >= _ONE_LINE and self.calibration.shift(place)[1][0] <= _KNOWN:
                if not self._pair_fits(choice, chosen, amplitudes, at):
                    continue
                self._pairs.add(name)
            if ions > 0 and part >= _ONE_LINE_ALONE and self._only(choice, chosen, amplitudes, name):
                continue
            unsure[name] = place, ions
        return unsure

    def _pair_fits(self, choice, chosen, amplitudes, at):
        """Whether one or two atoms of the other elements that are present fit the line of an element about as well."""
        own = [n for n in chosen if choice.atoms[n, at]]
        if len(own) != 1:
            return False
        absent = ~(choice.atoms[[n for n in chosen if n != own[0]]] > 0).any(0)
        tried = choice.candidates(chosen, amplitudes)
        tried = tried[(choice.atoms[tried].sum(1) <= 2) & ~(choice.atoms[tried][:, absent] > 0).any(1)]
        limit = choice.value(chosen) + _ALIKE
        return any(total < limit for total, *_ in choice.replacements(chosen, own[0], tried, limit))

    def _with_lone(self, choice, chosen, amplitudes):
        """Atomic ions of peaks without a name that no other ion can have."""
        if self.allowed is not None:
            return chosen, amplitudes
        fit, contents = choice.fit, choice.fit.contents
        tried = choice.candidates(chosen, amplitudes)
        tried = [n for n in tried.tolist() if choice.atoms[n].sum() == 1 and fit.ions[n].formula not in GASES]
        for peak in [n for n in chosen if fit.ions[n] is None and contents.ions[n] > _ONE_LINE_ALONE * contents.total]:
            ions = [number for number in tried if fit.main[number] == peak]
            rest = [number for number in chosen if number != peak]
            for number in ions:
                name = fit.ions[number].formula
                trial, chi2 = fit.solve([*rest, number])
                above = chi2 + choice.cost([*rest, number]) - fit.solve(chosen)[1] - choice.cost(chosen)
                if above < _ALIKE and self._only(choice, [*rest, number], trial, name):
                    chosen, amplitudes = [*rest, number], trial
                    self._alone.add(name)
                    break
        return chosen, amplitudes

    def _only(self, choice, chosen, amplitudes, name):
        """Whether no other ion can have the m/n of the line of an element, as the calibration by the others says.

        Other ions are the atomic ones of all elements, and all molecules that the elements present may have.
        """
        fit = choice.fit
        own = [n for n in chosen if fit.ions[n] is not None and choice.atoms[n, choice.elements.index(name)]]
        if len(own) != 1 or name not in COMMON | {*GASES}:
            return False
        masses, shares = self.abundances.lines(fit.ions[own[0]].formula)
        mass = float(masses[np.argmax(shares)]) / fit.ions[own[0]].charge
        shift, error = (float(values[0]) for values in self._without(choice, own).shift(mass))
        place = float(fit.contents.mass[fit.main[own[0]]])
        error = math.hypot(error, float(fit.place_error[fit.main[own[0]]]))
        if error > _KNOWN or abs(place / mass - 1 - shift) > 3 * error:
            return False
        present = {choice.elements[at] for at in np.flatnonzero(choice.atoms[chosen].any(0))} - {name}
        near = place / (1 + shift) * (1 - 3 * error), place / (1 + shift) * (1 + 3 * error)
        tried = np.append(choice.candidates(chosen, amplitudes), choice.numbers(ions_between(*near, present, own=name)))
        rivals = tried[(fit.main[tried] == fit.main[own[0]]) & fit.possible(tried)]
        return set(rivals.tolist()) <= {own[0]}

    def _without(self, choice, columns):
        """The calibration without the points of some ions."""
        ions = [choice.fit.ions[number] for number in columns]
        masses = np.concatenate([self.abundances.lines(ion.formula)[0] / ion.charge for ion in ions])
        calibration = MassCalibration()
        calibration.learn([point for point in self.calibration.points if np.abs(masses - point[0]).min() > 1e-6])
        calibration.scatter = self.calibration.scatter
        return calibration

    def _lines_of(self, choice, chosen, amplitudes, name):
        """Peaks that the ions of an element explain for the most part."""
        fit, lines = choice.fit, set()
        for number, x in zip(chosen, amplitudes, strict=True):
            if choice.atoms[number, choice.elements.index(name)]:
                held = fit.shares[number] * x
                clear = fit.contents.seen & (held > 5 * np.sqrt(fit.contents.variance))
                lines |= set(np.flatnonzero(clear & (held > 0.5 * fit.contents.ions)).tolist())
        return lines

    def _learn(self, choice, chosen, amplitudes, number):
        """Calibration from the peaks that one ion explains."""
        fit, contents = choice.fit, choice.fit.contents
        total, points = fit.explained(chosen, amplitudes), []
        for column, x in zip(chosen, amplitudes, strict=True):
            ion = fit.ions[column]
            if ion is None or (choice.atoms[column].sum() > 2 and number < 2):
                continue
            held = x * fit.shares[column]
            clear = contents.seen & (contents.mass > LIGHT) & (contents.ions > 200)
            masses = self.abundances.lines(ion.formula)[0] / ion.charge
            places = self.calibration.place(masses)
            for peak in np.flatnonzero(clear & (held > 0.85 * np.maximum(total, contents.ions)) & (held > 0)):
                mass = float(masses[np.argmin(np.abs(np.log(places / contents.mass[peak])))])
                weight = min(math.sqrt(contents.ions[peak]), 100.0)
                points.append((weight, mass, float(contents.mass[peak]) / mass - 1))
        noise = max(_POINT_ERROR, 0.08 * self.peaks.scale.width)
        new, used = MassCalibration(), list(self._anchors)
        new.learn(used)
        for weight, mass, shift in sorted(points, reverse=True):
            mean, error = (float(values[0]) for values in new.shift(mass))
            if abs(shift - mean) < 3 * math.hypot(error, noise):
                used.append((mass, shift, max(noise, 3e-3 / max(weight, 1.0))))
                new.learn(used)
            if len(used) > _MOST_POINTS:
                break
        self.calibration = new
        rest = [shift - float(new.shift(mass)[0][0]) for mass, shift, _ in used] or [1e-4]
        new.scatter = float(np.clip(1.48 * np.median(np.abs(rest)), 5e-5, 1e-3))

    def _other_sets(self, choice, chosen, amplitudes):
        """Exchange all ions of an element against the best ions without it, by a calibration without it."""
        sets: list[tuple[list[Ion], str, float]] = []
        either = {}
        names = [choice.elements[at] for at in np.flatnonzero(choice.atoms[chosen].any(0))] if chosen else []
        for name in sorted(set(names) - {"H"}):
            fit, contents, at = choice.fit, choice.fit.contents, choice.elements.index(name)
            own = [number for number in chosen if choice.atoms[number, at]]
            if not own:
                continue
            amplitudes, _ = fit.solve(chosen)
            lines = sum(
                np.count_nonzero(fit.shares[number] * x > 5 * np.sqrt(contents.variance))
                for number, x in zip(chosen, amplitudes, strict=True)
                if choice.atoms[number, at] == choice.atoms[number].sum() == 1
            )
            if lines > _SURE_LINES or name == "D" or name in self._alone:
                continue
            trial, start = self._independent(choice, chosen, own)
            trial.banned = trial.banned | {name}
            others, other_amplitudes, _ = trial.choose(14, [n for n in start if not trial.atoms[n, at]])
            trial.banned = trial.banned - {name}
            # each by the calibration that suits it
            without, before = trial.value(others), min(trial.value(start), choice.value(chosen))
            elements = [set(np.flatnonzero(trial.atoms[numbers].any(0)).tolist()) for numbers in (others, start)]
            new = tuple(trial.elements[number] for number in sorted(elements[0] - elements[1]))
            unnamed = [
                sum(contents.ions[n] for n in numbers if trial.fit.ions[n] is None) for numbers in (others, start)
            ]
            names_enough = unnamed[0] <= unnamed[1] + _AS_MANY * contents.total
            ions = [trial.fit.ions[n] for n in others]
            if without < before and names_enough and not self._unsure(trial, others, other_amplitudes):
                if trial is not choice:
                    self._anchors = [point for point in self._anchors if point in self._without(choice, own).points]
                    self._learn(trial, others, other_amplitudes, 3)
                    banned = choice.banned, choice.banned_ions
                    choice = self._choice(contents, _WINDOWS[-1])
                    choice.banned, choice.banned_ions = banned
                chosen = [n if ion is None else choice.numbers([ion])[0] for n, ion in zip(others, ions, strict=True)]
            elif without < before + _ALIKE and names_enough:
                worse = min(trial.value(start, _PRIOR), choice.value(chosen, _PRIOR))
                worse = trial.value(others, _PRIOR) - worse
                sets.append(([ion for ion in ions if ion is not None], name, worse))
                if new:
                    either[name] = new
        # only sets that exchange an element of the last choice
        kept = [row for row in sets if choice.atoms[chosen][:, choice.elements.index(row[1])].any()]
        names = {choice.elements[at] for at in np.flatnonzero(choice.atoms[chosen].any(0))} if chosen else set()
        either = {name: new for name, new in either.items() if name in names}
        return choice, chosen, [(ions, more) for ions, _, more in kept], either

    def _independent(self, choice, chosen, own):
        """The choice with a calibration without the points of some ions, if it changes, and the ions in it."""
        known, fit = self.calibration, choice.fit
        calibration = self._without(choice, own)
        mass = fit.contents.mass[fit.main[own]]
        (shift, error), (other, other_error) = known.shift(mass), calibration.shift(mass)
        if (np.hypot(other_error - error, shift - other) < 0.5 * fit.place_error[fit.main[own]]).all():
            return choice, chosen
        self.calibration = calibration
        trial = self._choice(fit.contents, _WINDOWS[-1])
        self.calibration = known
        trial.banned, trial.banned_ions = choice.banned, choice.banned_ions
        ions = [fit.ions[number] for number in chosen]
        return trial, [n if ion is None else int(trial.numbers([ion])[0]) for n, ion in zip(chosen, ions, strict=True)]

    def _finished(self, choice, chosen, sets, either, perhaps):
        """Ions with small shifts of their own, contents with the places of these ions only, errors, alternatives."""
        ions = [choice.fit.ions[number] for number in chosen if choice.fit.ions[number] is not None]
        contents = choice.fit.contents
        banned, banned_ions = choice.banned - {"D", *self._pairs}, choice.banned_ions  # to be named beside other ions
        choice = self._choice(contents, _WINDOWS[-1], own_shift=_OWN_SHIFT)
        choice.banned, choice.banned_ions = banned, banned_ions
        chosen = self._with_shifted(choice, choice.numbers(ions).tolist())
        ions = [choice.fit.ions[number] for number in chosen]
        amplitudes, _ = choice.fit.solve(chosen)
        hidden = self._hidden(choice, chosen, amplitudes)
        places = [
            self.calibration.place(masses / ion.charge)[x * shares >= 30]
            for ion, x in zip(ions, amplitudes, strict=True)
            for masses, shares in [self.abundances.lines(ion.formula)]
        ]
        contents = self.peaks.fit(self._without_peaks(np.concatenate(places) if places else np.zeros(0)))
        choice = self._choice(contents, _WINDOWS[-1], own_shift=_OWN_SHIFT)
        choice.banned, choice.banned_ions = banned, banned_ions
        chosen = choice.numbers(ions).tolist()
        amplitudes, chi2 = choice.fit.solve(chosen)
        choice.learn_shares(chosen, amplitudes)
        chosen, amplitudes, value = choice.pruned(chosen, amplitudes, chi2 + choice.cost(chosen))
        kept = [number for number, x in zip(chosen, amplitudes, strict=True) if x > 0]
        numbers = IonNumbers(self.peaks, choice.fit, self.abundances, self.calibration)
        kept = self._with_flanks(choice, kept, numbers)
        amplitudes, chi2 = choice.fit.solve(kept)
        value = chi2 + choice.cost(kept)
        explanation = Explanation(
            contents, self.calibration, choice.fit, kept, *numbers.amounts(kept), [], numbers, [], either, perhaps
        )  # fmt: skip
        self._add_alternatives(choice, explanation, amplitudes, value)
        self._add_flanks(choice, explanation)
        more = self._with_perhaps(choice, kept, amplitudes, perhaps)
        self._add_sets(choice, explanation, [[*kept, *numbers] for numbers in more], value)
        self._add_hidden(choice, explanation, hidden | self._hidden(choice, kept, amplitudes))
        for others, worse in sets:
            names = choice.numbers(others).tolist()
            explanation.sets.append((names, *numbers.amounts(names), worse))
        return explanation

    def _with_flanks(self, choice, kept, numbers):
        """The ions with those in flanks of others that are surely more than tails, and without the others there."""
        numbers.learn(kept, self._groups(choice, kept))
        for other, flank in numbers.flanks.items():
            number = int(choice.numbers([other])[0])
            kept = [at for at in kept if at != number]
            kept += [number] if flank.sure else []
        return kept

    def _groups(self, choice, kept):
        """Ions that may be in the flanks of each ion, with their costs: hydrides of a metal, and hidden atomic ions."""
        fit = choice.fit
        ions, groups = [fit.ions[number] for number in kept], defaultdict(dict)
        mains = [float(fit.contents.mass[fit.main[number]]) for number in kept]
        for ion, mass in zip(ions, mains, strict=True):
            apart = math.log1p(1 / (ion.charge * mass)) / float(self.peaks.scale.sigma(mass))
            metal = ion.formula in choice.elements and ion.formula not in (*GASES, "D")
            if metal and apart < _FLANK and "H" in choice.elements and "H" not in choice.banned:
                hydrides = [Ion(f"{ion.formula}{more}", ion.charge) for more in ("H", "H2")]
                tried = [other for other in hydrides if other in ions or other is hydrides[0]]
                groups[ion] |= {other: self._cost_of(choice, kept, other) for other in tried}
        for other in self._hidden_atoms(choice, ions):
            place = self._main_place(other)
            distance = np.log(place / np.array(mains)) / self.peaks.scale.sigma(place)
            near = np.flatnonzero((distance > -_BEFORE) & (distance < _BEHIND))
            if len(near):
                main = ions[near[int(np.argmax(fit.contents.ions[fit.main[np.array(kept)[near]]]))]]
                groups[main][other] = self._cost_of(choice, kept, other)
        return groups

    def _main_place(self, ion):
        """m/n of the most abundant isotope of an ion as it is measured [Da]."""
        masses, shares = self.abundances.lines(ion.formula)
        return float(self.calibration.place(masses[[int(np.argmax(shares))]] / ion.charge)[0])

    def _hidden_atoms(self, choice, ions):
        """Atomic ions without a name of the elements that are there or given."""
        names = {name for ion in ions for name in ion.atoms} | (self.allowed or set())
        tried = atomic_ions(sorted(names - choice.banned - {"H", "D"}))
        return [ion for ion in tried if ion not in choice.banned_ions and ion not in ions]

    def _cost_of(self, choice, kept, ion):
        """Cost of an ion beside the others."""
        number = int(choice.numbers([ion])[0])
        rest = [at for at in kept if at != number]
        return math.inf if ion in choice.banned_ions else choice.cost([*rest, number]) - choice.cost(rest)

    def _add_flanks(self, choice, explanation):
        """Sets without the hydrides in flanks that are named, and with the others."""
        numbers, kept = explanation.numbers, explanation.chosen
        for other, flank in numbers.flanks.items():
            number, main = choice.numbers([other, flank.main]).tolist()
            if number not in kept:
                found = numbers.with_flank(explanation.amplitudes, explanation.covariance, kept, flank)
                explanation.sets.append(([*kept, number], *found, _PRIOR * _HYDRIDE - flank.gain))
            elif flank.gain < _ALIKE:
                rest = [at for at in kept if at != number]
                explanation.sets.append((rest, *numbers.amounts(rest), flank.gain - _PRIOR * _HYDRIDE))
                explanation.others[kept.index(number)].insert(0, main)

    def _add_alternatives(self, choice, explanation, amplitudes, value):
        """Other names of the peaks, each ion in turn, and the sets of ions with them."""
        fit, kept = choice.fit, explanation.chosen
        tried, sets = choice.candidates(kept, amplitudes), []
        for number in kept:
            others = []
            for total, other, _, rest in choice.replacements(kept, number, tried, value + _ALIKE):
                if total < value + _ALIKE:
                    others.append((total, other))
                    sets.append([*rest, other])
            explanation.others.append([other for _, other in sorted(others)[:3]])
            if choice.atoms[number].sum() > 1 and fit.ions[number] not in explanation.numbers.flanks:
                # its peaks may be isotopes of the others
                sets.append([other for other in kept if other != number])
        for _, more, rest in choice.other_elements(kept, amplitudes, value + _ALIKE):
            sets.append([*rest, *more])
            for number, others in zip(kept, explanation.others, strict=True):
                others += [other for other in more if fit.main[other] == fit.main[number] and other not in others]
        self._add_sets(choice, explanation, sets, value)

    def _add_sets(self, choice, explanation, sets, value):
        """Those of some sets of ions that are about as good as the ones with `value`."""
        fit, kept = choice.fit, explanation.chosen
        chi2, cost = fit.solve(kept)[1], choice.cost(kept)
        for numbers in sets:
            other, other_cost = fit.solve(numbers)[1], choice.cost(numbers)
            if other + other_cost < value + _ALIKE:
                worse = other - chi2 + _PRIOR * (other_cost - cost)
                explanation.sets.append((numbers, *explanation.numbers.amounts(numbers), worse))

    def _hidden(self, choice, chosen, amplitudes):
        """Ions that may be in the peaks of others, by a standard error or more, and how much worse they are.

        Atomic ions of the elements that are there or given, and hydrides of the atomic ions.
        """
        fit, ions = choice.fit, [choice.fit.ions[number] for number in chosen]
        names = {name for ion in ions for name in ion.atoms} | (self.allowed or set())
        tried = atomic_ions(sorted(names - choice.banned))
        if "H" in choice.elements:
            metals = [ion for ion in ions if ion.formula in choice.elements and ion.formula not in (*GASES, "D")]
            tried += [Ion(f"{ion.formula}H", ion.charge) for ion in metals]
        tried = [ion for ion in tried if ion not in choice.banned_ions and ion not in ions]
        numbers = choice.numbers(tried)
        gains = fit.gains(numbers, chosen, amplitudes)
        there = (gains > _LEAST_GAIN) & (fit.missed[numbers] <= MISSED) & (fit.largest[numbers] > 0)
        worse = _PRIOR * choice.added_costs(numbers, chosen) - gains
        return {tried[at]: float(worse[at]) for at in np.flatnonzero(there)}

    def _with_perhaps(self, choice, kept, amplitudes, perhaps):
        """Atomic ions of each element that has too few lines to be counted."""
        for name in sorted(perhaps):
            tried = choice.candidates(kept, amplitudes, also=name)
            more = tried[choice.atoms[tried, choice.elements.index(name)] == choice.atoms[tried].sum(1)].tolist()
            held = choice.fit.solve([*kept, *more])[0][len(kept) :] >= choice.least
            more = [number for number, enough in zip(more, held, strict=True) if enough]
            if more:
                yield more

    def _add_hidden(self, choice, explanation, hidden):
        """Sets with one more ion that may be in the peaks of others."""
        kept = explanation.chosen
        for ion, worse in hidden.items():
            if (number := int(choice.numbers([ion])[0])) not in kept and ion not in explanation.numbers.flanks:
                explanation.sets.append(([*kept, number], *explanation.numbers.amounts_with(kept, number), worse))

    def _with_shifted(self, choice, chosen):
        """Further ions of known elements, whose peaks lie beside the smooth calibration."""
        fit, contents = choice.fit, choice.fit.contents
        amplitudes, chi2 = fit.solve(chosen)
        choice.learn_shares(chosen, amplitudes)
        value = chi2 + choice.cost(chosen)
        sure = choice.atoms[np.asarray(chosen, int)].any(0) if chosen else np.zeros(len(choice.elements), bool)
        for _ in range(6):
            rest = np.where(contents.seen, np.maximum(contents.ions - fit.explained(chosen, amplitudes), 0), 0.0)
            tried = choice.candidates(chosen, amplitudes)
            tried = tried[~(choice.atoms[tried][:, ~sure] > 0).any(1)]
            main = fit.main[tried]
            least = np.maximum(0.5 * contents.ions[main], 1e-4 * contents.ions.sum())
            tried, best = tried[rest[main] >= least], None
            for number in tried.tolist():
                trial, chi2 = fit.solve([*chosen, number])
                total = chi2 + choice.cost([*chosen, number]) + 20
                if total < value and (best is None or total < best[0]):
                    best = total, [*chosen, number], trial
            if best is None:
                break
            value, chosen, amplitudes = best
            value -= 20
        return chosen
