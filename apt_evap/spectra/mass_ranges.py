"""Ranges of the mass-to-charge ratio, which assign species to measured ions."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.types import Integers
from apt_evap._common.validation import (
    check_array,
    check_choice,
    check_kind,
    check_name,
    check_sequence,
    did_you_mean,
    short_text,
)
from apt_evap.detection.hits import Hits
from apt_evap.specimen.isotopes import MOST_ELECTRONS
from apt_evap.specimen.nuclides import ISOTOPES
from apt_evap.warnings import DataWarning, warn

_MANY = 1 / 3  # of the ions outside every range; measured: 7 % of an oxide on silicon with its own ranges

_CLOSE = 0.02  # an ion whose isotopes are this far outside its range is another one; peaks have tails of 1 %


@dataclass(frozen=True, eq=False, repr=False)
class Ranges:
    """Ranges of the mass-to-charge ratio, low <= m/n < high, with the species of each range.

    If ranges overlap, the first one is used, with a warning. A range that repeats an earlier one of the same name is
    ignored.

    Parameters
    ----------
    names : sequence of str
        Species of each range, such as "CrO"; several ranges may have the same species.
    low, high : array_like
        Bounds of each range [Da], shape (n,).
    volume : array_like, optional
        Volume of the ion in a reconstruction [nm^3], shape (n,); NaN if not known.
    colour : sequence of str, optional
        Colour of each range, such as "#FF0000"; "" if it has none.
    composition : sequence of dict, optional
        Number of atoms of each element in the ion of each range.
    source : str
        File name.

    Raises
    ------
    ValueError
        If there is no range, a range is empty, or lengths differ.
    """

    names: tuple
    low: np.ndarray
    high: np.ndarray
    volume: np.ndarray | None = None
    colour: tuple | None = None
    composition: tuple | None = None
    source: str = ""

    def __post_init__(self):
        check_kind(self.source, "source", str, "text")
        names = check_sequence(self.names, "names", "names of species")
        for name in names:
            check_name(name, "names of species")
        n = len(names)
        if n == 0:
            raise ValueError(f"{self.source or 'Ranges'} must have at least one range, got none")
        low, high = (check_array(getattr(self, name), name, (n,)) for name in ("low", "high"))
        volume = np.full(n, np.nan) if self.volume is None else check_array(self.volume, "volume", (n,), finite=False)
        colour = ("",) * n if self.colour is None else check_sequence(self.colour, "colour", "colours")
        for text in colour:
            if text != "":
                check_name(text, "colour")
        composition = ({},) * n
        if self.composition is not None:
            composition = check_sequence(self.composition, "composition", "mappings of an element to its atoms")
            for atoms in composition:
                check_kind(atoms, "composition", Mapping, "mappings of an element to its atoms")
                for element in atoms:
                    check_name(element, "elements of a composition")
            composition = tuple(dict(atoms) for atoms in composition)
        for name, values in (("colour", colour), ("composition", composition)):
            if len(values) != n:
                raise ValueError(f"{name} must have one entry for each of the {n} ranges, got {len(values)}")
        for name, lower, upper in zip(names, low, high, strict=True):
            if not lower < upper:
                raise ValueError(f"low must be < high [Da], got {lower:g} to {upper:g} for {name!r}")
        first = {}
        for i, key in enumerate(zip(names, low, high, strict=True)):
            first.setdefault(key, i)
        rows = list(first.values())
        for name, values in (("low", low), ("high", high), ("volume", volume)):
            object.__setattr__(self, name, values[rows])
        for name, values in (("names", names), ("colour", colour), ("composition", composition)):
            object.__setattr__(self, name, tuple(values[i] for i in rows))
        self._warn_of_overlap()

    def __len__(self) -> int:
        return len(self.names)

    @property
    def _name(self):
        return f"the ranges of {self.source!r}" if self.source else "these ranges"

    def __repr__(self) -> str:
        source = f" from {self.source!r}" if self.source else ""
        return f"<Ranges: {len(self)} of {', '.join(self.species_names)}{source}>"

    @property
    def species_names(self) -> tuple[str, ...]:
        """Names of the species, each once, in the order of the ranges, tuple of str."""
        return tuple(dict.fromkeys(self.names))

    def index(self, hits: Hits) -> Integers:
        """Range of every ion.

        Parameters
        ----------
        hits : Hits
            Ions with mass_to_charge.

        Returns
        -------
        ndarray of int64, shape (n,)
            Index into the ranges; -1 for an ion in no range.
        """
        (mass,) = check_kind(hits, "hits", Hits, "Hits").require("mass_to_charge")
        # between two neighbouring bounds one range applies, the first in the file; NaN is sorted after the last bound
        edges = np.unique(np.concatenate([self.low, self.high]))
        owner = np.full(len(edges) + 1, -1)
        first, stop = np.searchsorted(edges, self.low), np.searchsorted(edges, self.high)
        for i in reversed(range(len(self))):
            owner[first[i] : stop[i]] = i
        return owner[np.searchsorted(edges, mass, side="right") - 1]

    def species(self, hits: Hits) -> Integers:
        """Species of every ion.

        Parameters
        ----------
        hits : Hits
            Ions with mass_to_charge.

        Returns
        -------
        ndarray of int64, shape (n,)
            Index into `species_names`; -1 for an ion in no range.
        """
        number = {name: i for i, name in enumerate(self.species_names)}
        return np.array([number[name] for name in self.names] + [-1])[self.index(hits)]

    def labels(self, hits: Hits, outside: str = "X") -> NDArray[np.str_]:
        """Name of the species of every ion, `outside` for an ion in no range, array of str of shape (n,).

        Warns
        -----
        DataWarning
            If more than a third of the ions are outside every range.
        """
        names = np.array([*self.species_names, check_kind(outside, "outside", str, "text")])
        species = self.species(hits)
        self._warn_of_others(species)
        return names[species]

    def charges(self, hits: Hits, element: str) -> Integers:
        """Charge of every ion of an element.

        Ranges do not state charges. That of a range is the mass of the element over its centre, rounded: 58.7 Da over
        29.3 Da is Ni2+. Only ranges of single atoms count: their composition is one atom of the element, or, if they
        have none, their name is the element, with or without a charge, such as "Ni", "Ni++" or "Ni2+".

        Parameters
        ----------
        hits : Hits
            Ions with mass_to_charge.
        element : str
            Chemical symbol.

        Returns
        -------
        ndarray of int64, shape (n,)
            Charge [e]; 0 for an ion in no range of single atoms of the element.

        Raises
        ------
        ValueError
            If no range is of single atoms of the element, or one has none of its isotopes.
        """
        return np.array([*self._charges(element), 0])[self.index(hits)]

    def count_atoms(self, hits: Hits) -> dict[str, int]:
        """Number of atoms of each element; a molecular ion such as CrO2 counts with all its atoms.

        Parameters
        ----------
        hits : Hits
            Ions with mass_to_charge.

        Returns
        -------
        dict of str to int
            By element, in the order of the ranges. Ions in no range, or in a range without a composition, are not
            counted.
        """
        ions = np.bincount(self.index(hits) + 1, minlength=len(self) + 1)[1:]
        assert self.composition is not None
        atoms: dict[str, int] = {}
        for n, composition in zip(ions.tolist(), self.composition, strict=True):
            for element, number in composition.items():
                atoms[element] = atoms.get(element, 0) + n * number
        return atoms

    def select(self, hits: Hits, *names: str) -> Hits:
        """Select the ions of one or more species.

        Parameters
        ----------
        hits : Hits
            Ions with mass_to_charge.
        *names : str
            Names of species.

        Returns
        -------
        Hits
            With unchanged pulse_id and multiplicity.

        Raises
        ------
        ValueError
            If a species is unknown.

        Warns
        -----
        DataWarning
            If more than a third of the ions are outside every range.
        """
        known = self.species_names
        for name in names or (None,):
            if name not in known:
                hint = did_you_mean(name, known)
                raise ValueError(f"{self._name} have no species {short_text(name)}{hint}, only {', '.join(known)}")
        species = self.species(hits)
        self._warn_of_others(species)
        return hits[np.isin(species, [known.index(name) for name in names])]

    def _charges(self, element):
        """Charge of the ions of each range; 0 for other ions than single atoms of the element."""
        check_choice(element, "element", ISOTOPES)
        masses = np.array(ISOTOPES[element])[:, 0]
        name = re.compile(re.escape(element) + r"(\+*|\^?[1-9]\+)")
        charges = []
        for i, (low, high, atoms) in enumerate(zip(self.low, self.high, self.composition, strict=True)):
            single = atoms == {element: 1} if atoms else name.fullmatch(self.names[i].replace(" ", ""))
            charge = _nearest_charge(masses, (low + high) / 2) if single else 0
            if single and not (
                low < (1 + _CLOSE) * masses.max() / charge and high > (1 - _CLOSE) * masses.min() / charge
            ):
                raise ValueError(
                    f"{self.source or 'ranges'}: {low:g} to {high:g} Da is not a range of {element}, whose isotopes "
                    f"have {masses.min():.1f} to {masses.max():.1f} Da over the charge"
                )
            charges.append(charge)
        if not any(charges):
            raise ValueError(
                f"{self.source or 'ranges'} have no range of single atoms of {element}, only of "
                f"{', '.join(self.species_names)}"
            )
        return charges

    def _warn_of_others(self, species):
        outside = int(np.count_nonzero(species < 0))
        if outside > _MANY * len(species):
            warn(
                f"{outside:,} of {len(species):,} ions ({outside / len(species):.0%}) are outside every range of "
                f"{self.source or 'these ranges'}: do the ranges belong to these ions?",
                DataWarning,
            )

    def _warn_of_overlap(self):
        order = np.argsort(self.low, kind="stable")
        reach = np.maximum.accumulate(self.high[order])
        pairs = np.flatnonzero(self.low[order][1:] < reach[:-1])
        if len(pairs):
            at = pairs[0]
            owner = order[: at + 1][self.high[order][: at + 1] == reach[at]][0]
            first, second = sorted((int(owner), int(order[at + 1])))
            warn(
                f"{self.source or 'Ranges'}: {len(pairs)} ranges overlap another one, the first in the file is used: "
                f"{self._text(first)} over {self._text(second)}" + (", ..." if len(pairs) > 1 else ""),
                DataWarning,
            )

    def _text(self, i):
        return f"{self.names[i]} {self.low[i]:g}-{self.high[i]:g}"


def _nearest_charge(masses, mass_to_charge):
    """Charge with which an isotope is nearest to a mass-to-charge ratio [Da]."""
    charges = np.arange(1, MOST_ELECTRONS + 1)
    return 1 + int(abs(masses[:, None] / charges - mass_to_charge).min(axis=0).argmin())
