"""Phases: the parts of a specimen, each with its crystal, its composition and its evaporation fields."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.codec import checked, number, settings
from apt_evap._common.small_matrices import matrix_product
from apt_evap._common.types import Floats, Integers
from apt_evap._common.validation import check_choice, check_kind, check_name, check_number, check_sequence
from apt_evap.specimen import lattice
from apt_evap.specimen.alloy import (
    SOLUTE,
    SUBLATTICE,
    VACANCY,
    Segregation,
    by_material,
    check_solutes,
    choose,
    site_numbers,
)
from apt_evap.specimen.materials import Material, as_material
from apt_evap.specimen.ordered import check_order, order_of, sublattice
from apt_evap.specimen.regions import boundary_distance, check_region, contains, region_of
from apt_evap.specimen.surface_criterion import SurfaceCriterion

_MOST_PHASES = 127  # int8 per atom
_HIGHEST_FIELD = 1000.0  # [V/nm]: as for a Material


def _field(value, name):
    """Evaporation field of a phase, a number or by element."""
    if not isinstance(value, Mapping):
        return check_number(value, name, above=0, at_most=_HIGHEST_FIELD, unit="V/nm")
    return {
        str(element): check_number(field, f"{name} of {element}", above=0, at_most=_HIGHEST_FIELD, unit="V/nm")
        for element, field in value.items()
    }


def _solutes(value, name):
    return check_solutes(value)


@settings
class Phase:
    """A part of a specimen: a crystal in a region."""

    name: str = checked('Any name, such as "matrix".', "str", check_name)
    material: Any = checked(
        "The crystal, and its main element. A precipitate that is coherent with the matrix has the lattice constant of "
        'the matrix: ``ae.material("Cu", a=aluminium.a)``.',
        "Material or str",
        as_material,
    )
    region: Any = checked(
        "Where the phase is: a region such as `Sphere`, or a function of points (n, 3) [nm] that returns booleans "
        "(n,). None for the first phase, the matrix, which is everywhere else.",
        "region or callable",
        check_region,
        default=None,
        read=region_of,
    )
    axis: Sequence[float] | None = checked(
        "Crystal direction along +z, see `specimen.rotation_to_axis`; by default that of the tip.",
        "sequence of float",
        lambda axis, name: axis,  # checked with the structure
        default=None,
    )
    rotation: float | None = number(
        "Rotation of the crystal about z; by default that of the tip.", default=None, unit="degrees"
    )
    order: Any = checked(
        "Order of a compound on the sites of the crystal.",
        "Superlattice or UnitCell",
        lambda order, name: order,  # checked with the structure
        default=None,
        read=order_of,
    )
    solutes: Mapping[Any, Any] = checked(
        "Substitutional solutes on random sites: atomic fraction, or a `Segregation`, by element (str or Material).",
        "mapping",
        _solutes,
        default={},
        read=by_material,
        hash=False,
    )
    evaporation_field: float | Mapping[str, float] | None = checked(
        "Evaporation field of the atoms in this phase, for all elements or by name; by default that of each material.",
        "float or mapping",
        _field,
        default=None,
        unit="V/nm",
        hash=False,
    )
    vacancies: float = number(
        "Fraction of the sites without an atom; 1 for a void.", default=0.0, at_least=0, at_most=1
    )

    def _check(self):
        structure = self.material.structure
        check_order(self.order, structure)
        if isinstance(self.evaporation_field, Mapping):
            names = [element.name for element in self._materials()]
            for element in self.evaporation_field:
                check_choice(element, "element in evaporation_field", names)
        return {"axis": None if self.axis is None else lattice.check_axis(structure, self.axis)}

    def _materials(self):
        """Materials that occur in the phase, without its evaporation fields."""
        ordered = [element for occupant in self.order.occupants() for element, _ in occupant] if self.order else []
        return (self.material, *ordered, *self.solutes)

    def of_phase(self, element: Material) -> Material:
        """Return a material with the evaporation field that it has in this phase."""
        value: Any = self.evaporation_field
        if isinstance(value, Mapping):
            value = value.get(element.name)
        if value is None or value == element.evaporation_field:
            return element
        sources = {**element.sources, "evaporation_field": f"given for the phase {self.name}"}
        return replace(element, evaporation_field=value, sources=sources)

    @property
    def is_random(self) -> bool:
        """Whether the atoms of the phase depend on random numbers."""
        occupants = self.order.occupants() if self.order else []
        return bool(self.solutes) or 0 < self.vacancies < 1 or any(len(occupant) > 1 for occupant in occupants)


def check_phases(phases: Any) -> tuple[Phase, ...]:
    """Return phases as a tuple; ValueError unless they are phases, the matrix first and the others with a region."""
    phases = check_sequence(phases, "phases", "phases")
    for phase in phases:
        check_kind(phase, "phases", Phase, "phases such as Phase('matrix', 'Al')")
    if not 1 <= len(phases) <= _MOST_PHASES:
        raise ValueError(f"phases must be 1 to {_MOST_PHASES} phases, got {len(phases)}")
    if phases[0].region is not None or phases[0].vacancies == 1:
        raise ValueError(
            f"the first of the phases is the matrix, with atoms and without a region, got {phases[0].name}"
        )
    names = [phase.name for phase in phases]
    for place, phase in enumerate(phases):
        if place and phase.region is None:
            raise ValueError(f"phase {phase.name} must have a region: only the first of the phases is everywhere")
        if phase.name in names[:place]:
            raise ValueError(f"phases must have different names, got {phase.name} twice")
    return phases


def _key(element):
    """What makes two materials the same species."""
    return element.name, element.evaporation_field, element.charge_state, element.mass, element.polarizability


class Arrangement:
    """Which atom is on which site of a specimen with several phases.

    Parameters
    ----------
    phases : sequence of Phase
        The matrix first; a later phase replaces an earlier one where both are.
    axis, rotation
        Orientation of phases without their own.
    origin : ndarray
        Position of a site of every lattice [nm], shape (3,).
    offset : ndarray or None
        Further shift of each lattice, in fractions of its cell, shape (3,).
    seed : int or None
        Seed of solutes, vacancies and fractions on sublattices.

    Attributes
    ----------
    lattices : list of Lattice
        Different lattices of the phases.
    elements : tuple of Material
        Species, the material of the matrix first.
    criteria : tuple of SurfaceCriterion
        Criterion of each phase.
    has_sites : ndarray of bool
        Whether `labels` has met a site of each phase, also of one without atoms.
    """

    def __init__(
        self,
        phases: Sequence[Phase],
        axis: Sequence[float],
        rotation: float,
        origin: Floats,
        offset: Floats | None,
        seed: int | None,
    ) -> None:
        self._phases, self._seed = tuple(phases), seed
        self.lattices: list[lattice.Lattice] = []
        self._lattice_of = []
        species: dict[Any, int] = {}
        elements = []
        self._species, self._sublattices = [], []
        for phase in phases:
            host = phase.material
            if phase.vacancies == 1:  # a void has no atoms
                self._lattice_of.append(-1)
                self._species.append([])
                self._sublattices.append(None)
                continue
            turned = lattice.rotation_to_axis(
                host,
                axis if phase.axis is None else phase.axis,  # type: ignore[arg-type]
                rotation if phase.rotation is None else phase.rotation,
            )
            shift = origin
            if offset is not None:
                lengths = lattice.cell_lengths(host.structure, host.a, host.c)
                shift = origin + matrix_product(turned, offset * lengths)
            orientation = tuple(map(tuple, turned.tolist()))
            cell = lattice.Lattice(host.structure, host.a, host.c, orientation, tuple(shift.tolist()))
            if cell not in self.lattices:
                self.lattices.append(cell)
            self._lattice_of.append(self.lattices.index(cell))
            # numbers of the species, in the order in which they first occur
            numbers = []
            for element in phase._materials():
                element = phase.of_phase(element)
                if _key(element) not in species:
                    species[_key(element)] = len(elements)
                    elements.append(element)
                numbers.append(species[_key(element)])
            self._species.append(numbers)
            self._sublattices.append(None if phase.order is None else phase.order.occupants())
        self.elements = tuple(elements)
        self.has_sites = np.zeros(len(self._phases), dtype=bool)
        hosts = [phase.material if phase.vacancies < 1 else phases[0].material for phase in phases]
        self.criteria = tuple(SurfaceCriterion.of(host.structure, host.nearest_neighbour_distance) for host in hosts)

    @property
    def is_pure(self) -> bool:
        """Whether all sites have the same atom."""
        return len(self._phases) == 1 and len(self.elements) == 1 and self._phases[0].vacancies == 0

    def phase_of(self, points: Floats) -> NDArray[np.int8]:
        """Index of the phase at points (n, 3) [nm], int8 (n,)."""
        phase = np.zeros(len(points), dtype=np.int8)
        for index, later in enumerate(self._phases[1:], 1):
            phase[contains(later.region, points)] = index
        return phase

    def labels(self, number: int, points: Floats, cells: Integers, site: int) -> NDArray[np.int32]:
        """Phase and species of the sites of a lattice, as one number; -1 for a site without an atom of this lattice.

        Parameters
        ----------
        number : int
            Number of the lattice.
        points : ndarray, shape (n, 3)
            The sites [nm].
        cells : ndarray of int, shape (3, n)
            Indices of their cells.
        site : int
            Number of the site in each cell.

        Returns
        -------
        ndarray of int, shape (n,)
            Phase times the number of species, plus species.
        """
        labels = np.full(len(points), -1, dtype=np.int32)
        phases = self.phase_of(points)
        self.has_sites |= np.bincount(phases, minlength=len(self._phases)) > 0
        for index, phase in enumerate(self._phases):
            if self._lattice_of[index] != number or phase.vacancies == 1:
                continue
            chosen = np.flatnonzero(phases == index)
            if phase.vacancies and len(chosen):
                numbers = site_numbers(self._seed, number, cells[:, chosen], site, VACANCY)  # type: ignore[arg-type]
                chosen = chosen[numbers >= phase.vacancies]
            if len(chosen):
                species = self._species_at(index, number, points[chosen], cells[:, chosen], site)
                labels[chosen] = index * len(self.elements) + species
        return labels

    def _species_at(self, index, number, points, cells, site):
        phase, known = self._phases[index], self._species[index]
        species = np.full(len(points), known[0], dtype=np.int32)
        first = 1  # number of the next material in `known`
        if phase.order is not None:
            occupants = self._sublattices[index]
            n_sites = len(lattice.BASES[phase.material.structure])
            where = sublattice(phase.order, cells, site, n_sites)
            for place, occupant in enumerate(occupants):
                rows = np.flatnonzero(where == place) if occupant else ()
                if len(rows) and len(occupant) == 1:
                    species[rows] = known[first]
                elif len(rows):
                    numbers = site_numbers(self._seed, number, cells[:, rows], site, SUBLATTICE)
                    chosen = choose(numbers, [fraction for _, fraction in occupant])
                    # the last one also if the sum of the fractions is rounded to less than 1
                    species[rows] = np.array(known[first : first + len(occupant)])[chosen]
                first += len(occupant)
        if phase.solutes:
            numbers = site_numbers(self._seed, number, cells, site, SOLUTE)
            fractions = [self._fraction(index, fraction, points) for fraction in phase.solutes.values()]
            chosen = choose(numbers, fractions)
            solute = chosen >= 0
            species[solute] = np.array(known[first:])[chosen[solute]]
        return species

    def _fraction(self, index, fraction, points):
        """Fraction of a solute at points: a number or an array (n,)."""
        if not isinstance(fraction, Segregation):
            return fraction
        regions = [fraction.region or self._phases[index].region]
        if regions == [None]:
            regions = [phase.region for phase in self._phases[1:]]
        distances = np.full(len(points), np.inf)
        for region in regions:
            distances = np.minimum(distances, np.abs(boundary_distance(region, points)))
        return fraction.fractions(distances)
