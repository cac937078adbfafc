"""Choice of the ions of a spectrum: evidence of all peaks against a cost of every ion and element."""

from collections.abc import Collection, Iterator, Sequence
from functools import lru_cache

import numpy as np

from apt_evap._common.types import Floats
from apt_evap.spectra.candidate_ions import UNUSUAL, atomic_ions, expected_ions, molecular_ions
from apt_evap.spectra.ion_fit import IonFit, Rows
from apt_evap.spectra.ion_names import COMMON, GASES, HIGHEST_CHARGE, Ion, atoms_of_formula, element_of

# costs [chi-squared], chosen on half of the random specimens of the study, see docs/composition.rst
_NEW_GAS, _NEW_COMMON, _NEW_RARE = 10.0, 25.0, 60.0  # of an element
_ION = 8.0  # of an ion
_MOLECULE = 1.5  # of a molecule, for each factor of e by which its atoms are rare
_RAREST = 0.005  # share of the atoms that counts as that of rarer ones
_UNUSUAL = 15.0
"""Of unusual molecules, of three atoms of a metal, of two or more with hydrogen, of a molecule of a metal with three
charges, and of an atomic ion with three or more charges without the one below. Chosen by us."""
_PAIR = 40.0
"""Of two atoms of a metal with two charges, alone, with hydrogen, or as twice another ion: at its m/n. And of a hydride
with three charges."""
_NO_ATOMS = 60.0  # of an element without an atomic ion
_HEAVY_GASES, _NO_GAS = ("C", "N", "O"), 20.0  # cost of one of these without an atomic ion; H is often in hydrides only
_WATER = {"OH", "H2O", "H3O"}  # of the residual gas: they show oxygen as its atomic ions do
UNNAMED = 40.0
"""Cost of a peak without a name: so no name may cost more, and peaks without a name bring no wrong ions."""
_MINOR = 0.02  # of the ions, below which an element has only the simplest molecules
_TRIED = 8  # best ions that are fitted in each step
_FOLLOWING = 4  # steps after an ion that takes the place of others
_LEAST_ISOTOPE, _MOST_ISOTOPE = 0.3, 1.5
"""Ions of a peak over those that an isotope would have, for this isotope. Without these bounds calcite takes 2.2 s."""
_FEWEST, _LEAST = 20.0, 1e-5  # ions of an ion, and over all ions
_SHARED = 0.3  # of the ions of an ion, in the main peak of another that it may replace


def _metals_of(atoms):
    """Elements of an ion that are not those of gases."""
    return {name for name in atoms if name not in (*GASES, "D")}


@lru_cache(8192)
def unusual_cost(ion: Ion) -> float:
    """Cost of an ion that spectra rarely show, by its formula and charge."""
    atoms, metals = ion.atoms, _metals_of(ion.atoms)
    most = max((atoms[name] for name in metals), default=0)
    rest = {*atoms} - metals
    cost = _UNUSUAL * (ion.formula in UNUSUAL or most > 2)
    hydride = bool(metals and rest) and rest <= {"H", "D"}
    if ion.charge > 2 and metals and sum(atoms.values()) > 1:
        cost += _PAIR if hydride else _UNUSUAL
    cost += _UNUSUAL * (most > 1 and hydride)
    twice = rest <= {"H", "D"} or not any(number % 2 for number in atoms.values())
    return cost + _PAIR * (ion.charge == 2 and most == 2 and twice)


class IonChoice:
    """Search for the ions whose chi-squared and costs are lowest.

    Parameters
    ----------
    fit : IonFit
        The peaks.
    allowed : collection of str, optional
        The only elements that are tried; by default all, with costs.
    expected : sequence of str
        Formulas of ions that the user expects; their elements cost nothing.
    """

    def __init__(self, fit: IonFit, allowed: Collection[str] | None = None, expected: Sequence[str] = ()) -> None:
        self.fit, self.allowed = fit, None if allowed is None else set(allowed)
        every = {*HIGHEST_CHARGE, *(name for text in expected for name in atoms_of_formula(text))}
        self.elements = sorted(every if allowed is None else allowed)
        self._place = {name: at for at, name in enumerate(self.elements)}
        self._expected_ions = [ion for ion in expected_ions(expected) if set(ion.atoms) <= set(self.elements)]
        self._gas = np.array([element_of(name) in (*GASES, "D") for name in self.elements], bool)
        new = [_NEW_GAS if element_of(e) in GASES else _NEW_COMMON if e in COMMON else _NEW_RARE for e in self.elements]
        free = {name for text in expected for name in atoms_of_formula(text)}
        self._new = np.where(np.array([name in free for name in self.elements], bool), 0.0, new)
        self._no_atoms = np.where(self._gas, 0.0, _NO_ATOMS)
        self._no_atoms[[at for at, name in enumerate(self.elements) if element_of(name) in _HEAVY_GASES]] = _NO_GAS
        for ion in self._expected_ions:  # the user knows of the molecule
            self._no_atoms[[self._place[name] for name in ion.atoms]] = 0.0
        self.banned: set[str] = set()
        """Elements that are not tried."""
        self.banned_ions: set[Ion] = set()
        self.least = max(_FEWEST, _LEAST * float(fit.contents.ions.sum()))
        self._share = np.zeros(len(self.elements))
        self._known = 0
        self._tried: dict[object, Rows] = {}
        self.atoms = np.zeros((0, len(self.elements)))
        self._charge = self._atomic = self._shown = self._unusual = np.zeros(0)
        self._learn()

    # ---- ions and their costs --------------------------------------------------------------------------------------

    def _learn(self):
        """Number of atoms, charge and element of atomic ions of new columns of the fit."""
        new = self.fit.ions[self._known :]
        if not new:
            return
        atoms = np.zeros((len(new), len(self.elements)))
        atomic, unusual, charge = np.full(len(new), -1), np.zeros(len(new)), np.zeros(len(new), int)
        shown = atomic.copy()  # the element of an atomic ion, and oxygen of water
        for at, ion in enumerate(new):
            if ion is None:
                continue
            counts = ion.atoms
            for name, number in counts.items():
                atoms[at, self._place[name]] = number
            charge[at] = ion.charge
            if sum(counts.values()) == 1:
                atomic[at] = shown[at] = self._place[next(iter(counts))]
            elif ion.formula in _WATER:
                shown[at] = self._place["O"]
            unusual[at] = unusual_cost(ion)
        self.atoms = np.vstack([self.atoms, atoms])
        self._charge = np.concatenate([self._charge, charge]).astype(int)
        self._atomic = np.concatenate([self._atomic, atomic]).astype(int)
        self._shown = np.concatenate([self._shown, shown]).astype(int)
        self._unusual = np.concatenate([self._unusual, unusual])
        self._known = len(self.fit.ions)

    def numbers(self, ions: Sequence[Ion]) -> Rows:
        """Numbers of the columns of ions."""
        numbers = self.fit.numbers(ions)
        self._learn()
        return numbers

    def _ion_costs(self, numbers):
        """Cost of each ion alone."""
        numbers = np.asarray(numbers, int)
        rarity = -np.log(np.clip(self._share, _RAREST, 1.0))
        molecule = (self._atomic[numbers] < 0) * _MOLECULE * (self.atoms[numbers] @ rarity)
        return np.where(numbers < self.fit.number, UNNAMED, _ION + self._unusual[numbers] + molecule)

    def cost(self, chosen: Sequence[int]) -> float:
        """Cost of some ions together."""
        if not len(chosen):
            return 0.0
        numbers = np.asarray(chosen, int)
        present, single = self._present(numbers)
        cost = self._ion_costs(numbers).sum() + self._new[present].sum() + self._no_atoms[present & ~single].sum()
        return float(cost + _UNUSUAL * self._lonely(numbers))

    def _present(self, numbers):
        """Elements of some ions, and those with atomic ions, or oxygen with water."""
        present = self.atoms[numbers].any(0) if len(numbers) else np.zeros(len(self.elements), bool)
        single = np.zeros(len(self.elements), bool)
        shown = self._shown[numbers] if len(numbers) else np.zeros(0, int)
        single[shown[shown >= 0]] = True
        return present, single

    def _lonely(self, numbers):
        """Number of atomic ions with three or more charges without the one below."""
        pairs = {(int(self._atomic[n]), int(self._charge[n])) for n in numbers if self._atomic[n] >= 0}
        return sum(charge >= 3 and (element, charge - 1) not in pairs for element, charge in pairs)

    def added_costs(self, numbers: Rows, chosen: Sequence[int]) -> Floats:
        """By how much the cost of some ions rises with one more."""
        chosen = np.asarray(chosen, int)
        present, single = self._present(chosen)
        atoms, atomic, charge = self.atoms[numbers] > 0, self._atomic[numbers], self._charge[numbers]
        is_atom, shows = atomic >= 0, self._shown[numbers] >= 0
        element = np.maximum(self._shown[numbers], 0)
        cost = self._ion_costs(numbers) + atoms @ np.where(present, 0.0, self._new)
        cost += np.where(shows, 0.0, atoms @ np.where(present, 0.0, self._no_atoms))
        cost -= np.where(shows & present[element] & ~single[element], self._no_atoms[element], 0.0)
        pairs = {(int(self._atomic[n]), int(self._charge[n])) for n in chosen if self._atomic[n] >= 0}
        for at in np.flatnonzero(is_atom):
            key = int(atomic[at])
            if charge[at] >= 3 and (key, int(charge[at]) - 1) not in pairs:
                cost[at] += _UNUSUAL
            if charge[at] >= 2 and (key, int(charge[at]) + 1) in pairs:
                cost[at] -= _UNUSUAL
        return cost

    def learn_shares(self, chosen: Sequence[int], amplitudes: Floats) -> None:
        """Share of the atoms of each element: a molecule of rare atoms is improbable."""
        self._share = np.zeros(len(self.elements))
        if not len(chosen):
            return
        numbers = np.asarray(chosen, int)
        atoms = self.atoms[numbers] * np.asarray(amplitudes)[:, None]
        counted = (self._atomic[numbers] >= 0)[:, None] | self._gas
        self._share = (atoms * counted).sum(0) / max(float(atoms.sum()), 1e-9)

    def candidates(
        self, chosen: Sequence[int], amplitudes: Floats, every: bool = False, also: str | None = None
    ) -> Rows:
        """Numbers of the ions that are tried beside some ions; only these that have peaks, unless every one.

        `also` is an element that is tried here although it is banned.
        """
        banned = self.banned - {also}
        numbers = np.asarray(chosen, int)
        atomic = self._atomic[numbers] if len(numbers) else np.zeros(0, int)
        part = np.asarray(amplitudes) @ (self.atoms[numbers] > 0) / max(float(np.sum(amplitudes)), 1e-9)
        present = {self.elements[at] for at in set(atomic[atomic >= 0].tolist())}
        present |= set(GASES) if self.allowed is None else set(self.elements)
        present -= banned
        minor = {
            self.elements[at]
            for at in range(len(self.elements))
            if self.elements[at] in present and part[at] < _MINOR and self.elements[at] not in GASES
        }
        key = frozenset(present), frozenset(minor), frozenset(banned), frozenset(self.banned_ions)
        if key not in self._tried:
            ions = atomic_ions([name for name in self.elements if name not in banned])
            ions += [*molecular_ions(*key[:2]), *self._expected_ions]
            self._tried[key] = self.numbers([ion for ion in dict.fromkeys(ions) if ion not in self.banned_ions])
        tried = self._tried[key]
        tried = tried[~np.isin(tried, numbers)]
        return tried if every else tried[self.fit.possible(tried)]

    # ---- the search ------------------------------------------------------------------------------------------------

    def value(self, chosen: Sequence[int], part: float = 1.0) -> float:
        """Chi-squared and costs, or a part of these, of some ions, with the shares of their atoms."""
        amplitudes, chi2 = self.fit.solve(chosen)
        self.learn_shares(chosen, amplitudes)
        return chi2 + part * self.cost(chosen)

    def choose(self, most: int = 60, start: Sequence[int] = ()) -> tuple[list[int], Floats, float]:
        """The best ions, their amplitudes, and chi-squared with costs: by steps, removals and exchanges."""
        chosen = list(start)
        self._share = np.zeros(len(self.elements))
        amplitudes, chi2 = self.fit.solve(chosen)
        chosen, amplitudes, value = self._grown(chosen, amplitudes, chi2 + self.cost(chosen), most)
        for _ in range(3):
            self.learn_shares(chosen, amplitudes)
            value = self.fit.solve(chosen)[1] + self.cost(chosen)
            chosen, amplitudes, value, changed = self._exchanged(chosen, amplitudes, value)
            chosen, amplitudes, value = self.pruned(chosen, amplitudes, value)
            for others in () if changed else (self._with_elements, self._with_isotopes):
                if not changed:
                    chosen, amplitudes, value, changed = others(chosen, amplitudes, value)
            if not changed:
                break
        return chosen, amplitudes, value

    def _grown(self, chosen, amplitudes, value, most):
        """With one ion more in each step, while that is better, and without those that it makes superfluous."""
        fit = self.fit
        unnamed = np.flatnonzero(fit.contents.seen)
        for _ in range(most):
            if chosen:
                self.learn_shares(chosen, amplitudes)
                value = fit.solve(chosen)[1] + self.cost(chosen)
            tried = np.concatenate([self.candidates(chosen, amplitudes), unnamed[~np.isin(unnamed, chosen)]])
            gains = fit.gains(tried, chosen, amplitudes) - self.added_costs(tried, chosen)
            best = None
            for at in np.argsort(-gains)[:_TRIED]:
                if gains[at] < -1e-6:
                    break
                more = [*chosen, int(tried[at])]
                trial, chi2 = fit.solve(more)
                total = chi2 + self.cost(more)
                if trial[-1] >= self.least and (best is None or total < best[0]):
                    best = total, more, trial
            if best is None or best[0] > value - 1e-6:
                break
            value, chosen, amplitudes = best
            chosen, amplitudes, value = self.pruned(chosen, amplitudes, value)
        return chosen, amplitudes, value

    def _with_isotopes(self, chosen, amplitudes, value):
        """An atomic ion in place of those in its main peak, if another of its isotopes is a peak without a name."""
        fit, before, best = self.fit, (chosen, amplitudes, value), (value - 1e-6, None)
        tried = self.candidates(chosen, amplitudes)
        tried = tried[self._atomic[tried] >= 0]
        main, ions = fit.main[tried], fit.contents.ions
        for unnamed in [number for number in chosen if number < fit.number]:
            # as many ions as this isotope has, if the main peak is that of the ion, or less if others are there
            ratio = ions[unnamed] * fit.shares[tried, main] / np.maximum(ions[main] * fit.shares[tried, unnamed], 1e-9)
            fits = (main != unnamed) & (ratio > _LEAST_ISOTOPE) & (ratio < _MOST_ISOTOPE)
            for other in tried[fits].tolist():
                start = [*(n for n in chosen if n != unnamed and fit.main[n] != fit.main[other]), other]
                trial, chi2 = fit.solve(start)
                grown = self._grown(*self.pruned(start, trial, chi2 + self.cost(start)), _FOLLOWING)
                if other in grown[0] and grown[2] < best[0]:
                    best = grown[2], grown
        if best[1] is None:
            self.learn_shares(*before[:2])
            return *before, False
        return *best[1], True

    def _with_elements(self, chosen, amplitudes, value):
        """All atomic ions of one more element at once, in place of those of their peaks, while that is better."""
        best = min(self.other_elements(chosen, amplitudes, value - 1e-6), default=None)
        if best is None:
            return chosen, amplitudes, value, False
        _, more, rest = best
        trial, chi2 = self.fit.solve([*rest, *more])
        return *self.pruned([*rest, *more], trial, chi2 + self.cost([*rest, *more])), True

    def _gas_molecules(self, element):
        """Ions of one atom of an element and those of gases."""
        gases = set(GASES) if self.allowed is None else set(GASES) & set(self.elements)
        ions = molecular_ions(frozenset(gases - self.banned | {element}), frozenset())
        ions = [ion for ion in ions if ion.atoms.get(element) == 1 and ion not in self.banned_ions]
        numbers = self.numbers(ions) if ions else np.zeros(0, np.int64)
        return numbers[self.fit.possible(numbers)]

    def other_elements(
        self, chosen: Sequence[int], amplitudes: Floats, limit: float
    ) -> Iterator[tuple[float, list[int], list[int]]]:
        """Absent elements whose atomic ions could be in place of others: chi-squared with costs, their ions, the rest.

        Only those with two or more ions, with the molecules that fit peaks without a name, and chi-squared with costs
        below a limit.
        """
        present, _ = self._present(np.asarray(chosen, int))
        tried = self.candidates(chosen, amplitudes)
        atomic = self._atomic[tried]
        unnamed = [number for number in chosen if number < self.fit.number]
        for at in np.unique(atomic[atomic >= 0]):
            more = tried[atomic == at].tolist()
            if present[at]:
                continue
            if unnamed and set(self.fit.main[more].tolist()) & set(unnamed):
                molecules = self._gas_molecules(self.elements[at])
                more += molecules[np.isin(self.fit.main[molecules], unnamed)].tolist()
            if len(more) < 2:
                continue
            peaks = set(self.fit.main[more].tolist())
            rest = [number for number in chosen if int(self.fit.main[number]) not in peaks]
            if len(rest) == len(chosen):
                continue
            trial, chi2 = self.fit.solve([*rest, *more])
            held = trial[len(rest) :] >= self.least
            if not held.all() and held.sum() > 1:
                more = [number for number, enough in zip(more, held, strict=True) if enough]
                trial, chi2 = self.fit.solve([*rest, *more])
            total = chi2 + self.cost([*rest, *more])
            if total < limit and (trial[len(rest) :] >= self.least).all():
                yield total, more, rest

    def pruned(self, chosen: list[int], amplitudes: Floats, value: float) -> tuple[list[int], Floats, float]:
        """Without ions that cost more than they explain."""
        while len(chosen) > 1:
            losses, best = self.fit.losses(chosen, amplitudes), None
            before = self.cost(chosen)
            for at in np.flatnonzero(losses < 140 + _UNUSUAL):
                rest = chosen[:at] + chosen[at + 1 :]
                if value + losses[at] - before + self.cost(rest) > value + 5:
                    continue
                trial, chi2 = self.fit.solve(rest)
                total = chi2 + self.cost(rest)
                if best is None or total < best[0]:
                    best = total, rest, trial
            if best is None or best[0] >= value - 1e-9:
                break
            value, chosen, amplitudes = best
        return chosen, amplitudes, value

    def _exchanged(self, chosen, amplitudes, value):
        """Exchange single ions against others, while that is better."""
        changed = False
        tried = self.candidates(chosen, amplitudes)
        for number in list(chosen):
            if number not in chosen:
                continue
            best = None
            for total, other, trial, rest in self.replacements(chosen, number, tried, value):
                if total < value - 1e-6 and (best is None or total < best[0]):
                    best = total, [*rest, other], trial
            if best is not None:
                (value, chosen, amplitudes), changed = best, True
        return chosen, amplitudes, value, changed

    def replacements(
        self, chosen: Sequence[int], number: int, tried: Rows, limit: float
    ) -> Iterator[tuple[float, int, Floats, list[int]]]:
        """Ions that could be in place of one, whose chi-squared and costs are perhaps below a limit."""
        fit = self.fit
        rest = [other for other in chosen if other != number]
        tried = tried[~np.isin(tried, chosen)]
        peak = fit.main[number]
        shared = fit.shares[tried, peak] >= _SHARED * fit.largest[tried]
        tried = tried[shared & (fit.largest[tried] > 0)]
        if not len(tried):
            return
        amplitudes, chi2 = fit.solve(rest)
        totals = chi2 - fit.gains(tried, rest, amplitudes) + self.cost(rest) + self.added_costs(tried, rest)
        for at in np.argsort(totals)[:_TRIED]:
            if totals[at] > limit:
                break
            trial, chi2 = fit.solve([*rest, int(tried[at])])
            if trial[-1] >= self.least:
                yield chi2 + self.cost([*rest, int(tried[at])]), int(tried[at]), trial, rest
