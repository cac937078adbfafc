"""The specimen: a crystal (or any arrangement of atoms) in the shape of a tip."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from apt_evap._common.codec import from_plain, to_plain
from apt_evap._common.memory import check_memory
from apt_evap._common.notebook import as_table
from apt_evap._common.small_matrices import lengths
from apt_evap._common.types import Booleans, Floats
from apt_evap._common.validation import (
    check_array,
    check_kind,
    check_number,
    check_seed,
    check_sequence,
    digest,
    short_text,
)
from apt_evap.specimen import ase_atoms, lattice, orientation_check
from apt_evap.specimen.alloy import check_solutes
from apt_evap.specimen.materials import Material, as_material
from apt_evap.specimen.phases import Arrangement, Phase, check_phases
from apt_evap.specimen.shape import TaperedCap
from apt_evap.specimen.shell import Shell
from apt_evap.specimen.surface_criterion import SurfaceCriterion
from apt_evap.warnings import DataWarning, warn

_ROUNDING = 1e-6  # [d_nn]: sites on the surface are all included, in spite of rounding
_LAYER = 0.74  # thickness of the layer of surface atoms [d_nn]: for fcc, 0.48 a^2 of the surface per atom
_WIDEST = 10  # largest neighbourhood [d_nn]: 6,000 atoms each; larger ones do not fit into memory
_MAX_CELLS = 5e8  # neighbourhoods in the bounding box of all atoms: 2 GB for the neighbour grid
_CLOSEST = 0.7  # [d_nn]: of two atoms of different lattices that are closer, one is left out
_FARTHEST = 1e6  # [nm]: a coordinate beyond 1 mm is a wrong unit
_SAMPLE = 10_000  # atoms whose nearest neighbour distance is measured
_SHAPE_SETTINGS = (
    "apex_radius",
    "axis",
    "shank_angle",
    "shank_length",
    "base",
    "rotation",
    "origin",
    "offset_seed",
    "seed",
)


class Tip:
    """A crystal in the shape of a field emitter: a spherical cap on a shank that widens downwards.

    The shape is a `TaperedCap`: the centre of the cap is the origin, the apex is at z = R, and the shank
    points down to z = -L. Atoms below z = -L/2 never evaporate.

    Parameters
    ----------
    material : Material or str, optional
        The crystal; a str is looked up by `material`. Or `phases`.
    apex_radius : float
        Radius R of the cap [nm].
    axis : sequence of float
        Crystal direction along +z, of integers or any other numbers, see `specimen.rotation_to_axis`.
    shank_angle : float
        Half the opening angle of the shank [degrees], >= 0 and < 45.
    shank_length : float, optional
        Length L of the shank [nm]; 2 R by default.
    base : str
        "rounded" or "flat".
    rotation : float
        Rotation of the crystal about z [degrees].
    origin : sequence of float
        Position of one lattice site [nm]. A site at the centre of the cap makes the tip symmetric.
    offset_seed : int, optional
        Seed of a random shift of the lattice by a fraction of its cell, in addition to `origin`: a tip without
        symmetry.
    depth : float, optional
        Keep only a shell: atoms at most this far below the surface of the cap [nm]; None keeps all atoms. Below z =
        -R/2, where few atoms evaporate, the shell is thinner. Its innermost layer, one neighbourhood thick, is
        `support`.
    solutes : mapping, optional
        Substitutional solutes of a random alloy: atomic fraction by element (str or Material).
    seed : int, optional
        Seed of the random alloy, needed with `solutes`, and of solutes and vacancies of phases. The atom on a site
        depends on the seed and the site only: a deeper shell is the same alloy.
    phases : sequence of Phase, optional
        Phases instead of `material` and `solutes`, the matrix first. Where several are, the last one is. Of two atoms
        of different lattices that are closer than 0.7 nearest neighbour distances, that of the earlier phase is left
        out. A phase without atoms, such as one outside the specimen, causes a warning.

    Attributes
    ----------
    positions : ndarray
        Atoms [nm], shape (n, 3).
    elements : tuple of Material
        The species.
    species : ndarray of int32
        Index into `elements`, shape (n,).
    evaporable, support : ndarray of bool
        Whether an atom can evaporate; whether it only completes the neighbourhoods of others, shape (n,).
    phases : tuple of Phase
        The phases; for a tip of one material a single phase "matrix", empty for a tip made from positions.
    phase : ndarray of int8
        Index of each atom into `phases`, shape (n,); 0 for a tip made from positions.
    criteria : tuple of SurfaceCriterion
        Distances that define surface atoms and nearest neighbours, of each phase.
    evaporation_fields, charge_states, masses : ndarray
        Of each species [V/nm], [e], [Da].
    apex : float
        z of the apex [nm].
    potential_point : ndarray
        Where the potential is the applied voltage [nm], shape (3,).
    settings : dict
        Parameters of the tip, in plain types.

    Raises
    ------
    ValueError
        If the shape is impossible, or needs more memory than is free.

    Examples
    --------
    >>> ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1))
    <Tip: 8,159 atoms of Ni [1 1 1], apex radius 2 nm, shank 4 nm at 1.5 degrees, rounded base>

    A random alloy:

    >>> alloy = ae.Tip("Ni", apex_radius=2.0, solutes={"Al": 0.1}, seed=1)
    >>> for element, atoms in zip(alloy.elements, np.bincount(alloy.species)):
    ...     print(element.name, atoms)
    Ni 7304
    Al 875
    """

    def __init__(
        self,
        material: Material | str | None = None,
        apex_radius: float | None = None,
        axis: Sequence[float] = (0, 0, 1),
        *,
        shank_angle: float = 1.5,
        shank_length: float | None = None,
        base: str = "rounded",
        rotation: float = 0.0,
        origin: ArrayLike = (0.0, 0.0, 0.0),
        offset_seed: int | None = None,
        depth: float | None = None,
        solutes: Mapping[Material, float] | Mapping[str, float] | None = None,
        seed: int | None = None,
        phases: Sequence[Phase] | None = None,
    ) -> None:
        self.phases: tuple[Phase, ...] = _phases_of(material, solutes, phases)
        if seed is not None or any(phase.is_random for phase in self.phases):
            check_seed(seed, "seed (of the random sites of the solutes)")
        d = max(phase.material.nearest_neighbour_distance for phase in self.phases)
        radius = check_number(apex_radius, "apex_radius", at_least=3 * d, unit="nm", why="3 neighbour distances")
        shape = TaperedCap(radius, 2 * radius if shank_length is None else shank_length, shank_angle, base)
        origin = check_array(origin, "origin", (3,))
        offset = None
        if offset_seed is not None:
            offset = np.random.default_rng(check_seed(offset_seed, "offset_seed")).random(3)
        arrangement = Arrangement(self.phases, axis, rotation, origin, offset, seed)
        self._fill(shape, depth, arrangement, d)
        whole = all(float(index).is_integer() for index in axis)
        common = {
            "apex_radius": radius,
            "axis": [int(index) if whole else float(index) for index in axis],
            "shank_angle": shape.shank_angle,
            "shank_length": shape.shank_length,
            "base": base,
            "rotation": float(rotation),
            "origin": origin.tolist(),
            "offset_seed": None if offset_seed is None else int(offset_seed),
            "depth": self._shell.depth,
            "seed": None if seed is None else int(seed),
        }
        if phases is None:
            host = self.phases[0]
            self.settings = {"material": to_plain(host.material), **common, "solutes": to_plain(host.solutes)}
        else:
            self.settings = {**common, "phases": to_plain(self.phases), "elements": to_plain(self.elements)}

    def _fill(self, shape, depth, arrangement, spacing):
        """Fill the shape, or a shell of it, with the atoms of an arrangement; `spacing` is the largest d_nn [nm]."""
        self.criteria = arrangement.criteria
        if depth is not None:
            depth = check_number(depth, "depth", above=self.neighbour_radius, unit="nm")
        self._shell = Shell(shape, depth, self.neighbour_radius)
        density = max(lattice.atom_density(cell.structure, cell.a, cell.c) for cell in arrangement.lattices)
        check_memory(self._shell.volume() * density, shape.volume(_LAYER * spacing) * density)

        self.positions, species, self._phase = self._atoms(arrangement)
        self._warn_of_empty_phases(arrangement)
        self._has_gaps = len(arrangement.lattices) > 1 or any(phase.vacancies for phase in self.phases)
        self._set_flags()
        self._set_elements(arrangement.elements, species)
        self.apex = shape.apex_radius
        self.potential_point = np.zeros(3)

    def _atoms(self, arrangement):
        """Positions, species and phases of all atoms; no phases (None) if there is one only."""
        shape, depth = self._shell.shape, self._shell.depth
        d, lattices = self.nearest_neighbour_distance, arrangement.lattices
        # atoms below the shell can displace others in it
        margin = 0.0 if len(lattices) == 1 else self.neighbour_radius
        positions, labels = [], []
        for number, cell in enumerate(lattices):
            points, label = lattice.lattice_sites_in(
                cell,
                shape.signed_distance,
                shape.bounds,
                depth=None if depth is None else lambda points: self._shell.depth_at(points) + margin,
                tolerance=_ROUNDING * d,
                label=None if arrangement.is_pure else partial(arrangement.labels, number),
            )
            positions.append(points)
            labels.append(label)
        n_species = len(arrangement.elements)
        if len(lattices) == 1:
            places, label = positions[0], labels[0]
        else:
            kept = self._without_overlap(positions, [numbers // n_species for numbers in labels])
            if depth is not None:  # without the margin, now that atoms in it have displaced others
                rounding = _ROUNDING * d
                for points, keep in zip(positions, kept, strict=True):
                    keep &= shape.signed_distance(points) >= -(self._shell.depth_at(points) + rounding)
            places = np.concatenate([points[keep] for points, keep in zip(positions, kept, strict=True)])
            label = np.concatenate([numbers[keep] for numbers, keep in zip(labels, kept, strict=True)])
        if arrangement.is_pure:
            return places, np.zeros(len(places), dtype=np.int32), None
        phase = (label // n_species).astype(np.int8) if len(self.phases) > 1 else None
        return places, label % n_species, phase

    def _warn_of_empty_phases(self, arrangement):
        for number, phase in enumerate(self.phases if len(self.phases) > 1 else ()):
            is_void = phase.vacancies == 1
            if not (arrangement.has_sites[number] if is_void else (self._phase == number).any()):
                warn(
                    f"phase {phase.name} has no {'sites' if is_void else 'atoms'}: its region is outside the specimen, "
                    "covered by later phases, or too small",
                    DataWarning,
                )

    def _without_overlap(self, positions, phases):
        """Which atoms of each lattice remain: without those too close to an atom of a later phase on another one."""
        distances = np.array([criterion.nearest_neighbour_distance for criterion in self.criteria])
        trees = [scipy.spatial.cKDTree(points) for points in positions]
        kept = [np.ones(len(points), dtype=bool) for points in positions]
        for first in range(len(trees)):
            for second in range(first):
                reach = _CLOSEST * float(distances.max())
                near = trees[first].sparse_distance_matrix(trees[second], reach, output_type="ndarray")
                one, other = phases[first][near["i"]], phases[second][near["j"]]
                close = near["v"] < _CLOSEST * 0.5 * (distances[one] + distances[other])
                kept[first][near["i"][close & (one < other)]] = False
                kept[second][near["j"][close & (other < one)]] = False
        return kept

    @classmethod
    def from_positions(
        cls,
        positions: ArrayLike,
        species: ArrayLike,
        elements: Iterable[Material | str],
        evaporable: ArrayLike | None = None,
        neighbour_radius: float | None = None,
        surface_threshold: float | None = None,
        potential_point: ArrayLike | None = None,
    ) -> Tip:
        """Make a tip from any arrangement of atoms, with its axis along +z.

        Parameters
        ----------
        positions : array_like
            Atoms [nm], shape (n, 3).
        species : array_like of int
            Index of each atom into `elements`, shape (n,).
        elements : sequence of Material or str
            The species; the structure of the first one sets the criterion for surface atoms.
        evaporable : array_like of bool, optional
            Which atoms can evaporate, shape (n,). By default those in the upper half of the tip, because the rim of a
            cut base carries the largest charges.
        neighbour_radius, surface_threshold : float, optional
            [nm]; by default from the median nearest neighbour distance.
        potential_point : array_like, optional
            Where the potential is the applied voltage [nm], shape (3,): any point well inside the cap. By default on
            the mean axis, half the smallest extent of the tip below the apex.

        Returns
        -------
        Tip

        Raises
        ------
        ValueError
            If shapes disagree, if an index has no element, if atoms are at the same place or far away, or if their
            distances show that the positions are in another unit.

        Warns
        -----
        SpecimenWarning
            If the specimen stands upside down or lies on its side, is in several bodies that do not touch, or has atoms
            closer than 0.6 or farther than 1.6 times the nearest neighbour distance of their materials.
        """
        tip = cls.__new__(cls)
        tip._shell, tip._phase, tip._has_gaps, tip.phases = None, None, False, ()  # type: ignore[assignment]
        tip.positions = _checked_positions(positions)
        n = len(tip.positions)
        elements = check_sequence(elements, "elements", "materials, such as ('Ni',)")
        if not elements:
            raise ValueError("elements must contain at least one material, got none")
        elements = tuple(as_material(element, "elements") for element in elements)
        tip._set_elements(elements, check_array(species, "species", (n,), dtype=np.int32))
        if not 0 <= tip.species.min() <= tip.species.max() < len(elements):
            raise ValueError(
                f"species must be indices from 0 to {len(elements) - 1}, got {tip.species.min()} to {tip.species.max()}"
            )
        distance = _spacing_of(tip.positions)
        criterion = _criterion(tip.elements[0].structure, distance, neighbour_radius, surface_threshold)
        tip.criteria = (criterion,)
        low, high = tip.positions.min(axis=0), tip.positions.max(axis=0)
        span = high - low
        if np.prod(span / tip.neighbour_radius + 1) > _MAX_CELLS:
            raise ValueError(
                f"positions must be close together, got {n:,} atoms that span {span[0]:.4g} x {span[1]:.4g} x "
                f"{span[2]:.4g} nm: is one atom far away?"
            )
        tip.apex = float(high[2])
        used = np.unique(tip.species).tolist()
        expected = [elements[number].nearest_neighbour_distance for number in used]
        orientation_check.check_spacing(distance, expected, [elements[number].name for number in used], n)
        orientation_check.warn_of_bodies(tip.positions, max(distance, *expected))
        orientation_check.warn_of_direction(tip.positions)
        if evaporable is None:
            evaporable = tip.positions[:, 2] >= (low[2] + high[2]) / 2
        tip.evaporable = check_array(evaporable, "evaporable", (n,), dtype=bool).copy()
        tip.support = np.zeros(n, dtype=bool)
        if potential_point is None:  # on the mean axis, half the smallest extent below the apex
            below = min((high[0] - low[0]) / 2, (high[1] - low[1]) / 2, (high[2] - low[2]) / 2)
            potential_point = [*tip.positions[:, :2].mean(axis=0), high[2] - below]
        tip.potential_point = check_array(potential_point, "potential_point", (3,))
        tip.settings = {
            "atoms": n,
            "sha256": digest(tip.positions, tip.species, tip.evaporable),
            "elements": to_plain(tip.elements),
            "neighbour_radius": tip.neighbour_radius,
            "surface_threshold": tip.surface_threshold,
            "potential_point": tip.potential_point.tolist(),
        }
        return tip

    @classmethod
    def from_atoms(cls, atoms: Any, materials: Mapping[str, Material] | None = None, **options: Any) -> Tip:
        """Make a tip from an ASE Atoms object, with its axis along +z.

        Parameters
        ----------
        atoms : ase.Atoms
            Positions in Angstrom; the cell is ignored. An array "evaporable" sets which atoms can evaporate.
        materials : mapping of str to Material, optional
            Materials by chemical symbol, instead of those that `material` knows.
        **options
            Passed to `from_positions`.

        Returns
        -------
        Tip
            Its `elements` begin with the most frequent one.

        Raises
        ------
        ValueError
            If a symbol has no material, or as in `from_positions`.
        """
        return cls.from_positions(**(ase_atoms.from_atoms(atoms, materials) | options))

    def to_atoms(self) -> Any:
        """Return the specimen as ase.Atoms [Angstrom], with arrays "evaporable" and "support"; needs ASE."""
        arrays = {"evaporable": self.evaporable, "support": self.support}
        return ase_atoms.to_atoms(self.positions, self.elements, self.species, **arrays)

    @classmethod
    def from_settings(cls, settings: Mapping[str, Any]) -> Tip:
        """Rebuild a tip from its `settings`; not possible for a tip made from positions.

        Raises
        ------
        ValueError
            If a setting is unknown or the tip was made from positions.
        """
        settings = dict(check_kind(settings, "settings", Mapping, "the settings of a tip"))
        if "phases" in settings:
            settings.pop("elements", None)
        if "apex_radius" not in settings:
            raise ValueError(
                "settings must contain 'apex_radius' (a tip made from positions cannot be rebuilt), "
                f"got {', '.join(settings)}"
            )
        try:
            if "phases" in settings:
                settings["phases"] = [from_plain(phase, Phase, what="phase") for phase in settings["phases"]]
            else:
                settings["material"] = as_material(settings["material"])
                settings["solutes"] = {as_material(solute): fraction for solute, fraction in settings["solutes"] or ()}
            return cls(**settings)
        except (KeyError, TypeError) as error:
            raise ValueError(f"settings must be those of a tip, got {short_text(settings)}: {error}") from error

    @property
    def criterion(self) -> SurfaceCriterion:
        """Distances that define surface atoms and nearest neighbours in the matrix."""
        return self.criteria[0]

    @property
    def phase(self) -> NDArray[np.int8]:
        """Index of each atom into `phases`, int8 (n,)."""
        return np.zeros(len(self), dtype=np.int8) if self._phase is None else self._phase

    def phase_at(self, atoms: NDArray[np.integer]) -> NDArray[np.int8]:
        """Index into `phases` of chosen atoms, int8 (m,)."""
        return np.zeros(len(atoms), dtype=np.int8) if self._phase is None else self._phase[atoms]

    @property
    def phase_names(self) -> tuple[str, ...]:
        """Names of the phases, ("matrix",) for a tip made from positions."""
        return tuple(phase.name for phase in self.phases) or ("matrix",)

    @property
    def nearest_neighbour_distance(self) -> float:
        """Nearest neighbour distance d_nn of the matrix [nm]."""
        return self.criterion.nearest_neighbour_distance

    @property
    def neighbour_radius(self) -> float:
        """Largest radius of the neighbourhood whose mean position identifies surface atoms, of all phases [nm]."""
        return max(criterion.neighbour_radius for criterion in self.criteria)

    @property
    def surface_threshold(self) -> float:
        """Smallest distance of a surface atom from the mean of its neighbourhood, in the matrix [nm]."""
        return self.criterion.surface_threshold

    @property
    def bond_length(self) -> float:
        """Atoms of the matrix closer than this are nearest neighbours [nm]."""
        return self.criterion.bond_length

    def __len__(self) -> int:
        return len(self.positions)

    _repr_html_ = as_table

    def __repr__(self) -> str:
        names = "-".join(dict.fromkeys(element.name for element in self.elements))
        if len(self.phases) > 1:
            names += f" in {len(self.phases)} phases"
        if self._shell is None:
            return f"<Tip: {len(self):,} atoms of {names} from positions>"
        shape, depth = self._shell.shape, self._shell.depth
        axis = " ".join(f"{index:.4g}" for index in self.settings["axis"])
        shell = "" if depth is None else f", shell to a depth of {depth:.4g} nm"
        return (
            f"<Tip: {len(self):,} atoms of {names} [{axis}], apex radius {shape.apex_radius:.4g} nm, "
            f"shank {shape.shank_length:.4g} nm at {shape.shank_angle:g} degrees, {shape.base} base{shell}>"
        )

    @property
    def max_ions(self) -> int:
        """Number of atoms that can evaporate, including those below a shell; exact only without `depth`."""
        n_evaporable = int(np.count_nonzero(self.evaporable))
        if self._shell is None or self._shell.depth is None:
            return n_evaporable
        host, shape = self.phases[0].material, self._shell.shape
        volume = shape.volume_above(-shape.shank_length / 2)
        return max(n_evaporable, round(volume * lattice.atom_density(host.structure, host.a, host.c)))

    def signed_distance(self, points: Floats) -> Floats:
        """Distance from the surface of the shape [nm], negative inside: see `TaperedCap.signed_distance`.

        Raises
        ------
        ValueError
            If the tip was made from positions.
        """
        if self._shell is None:
            raise ValueError("a tip made from positions has no shape, and so no signed distance")
        return self._shell.shape.signed_distance(check_array(points, "points", ("n", 3)))

    @property
    def outer(self) -> Booleans | None:
        """Whether atoms are near the surface of the shape, bool (n,); None for a tip without voids and interfaces."""
        if not self._has_gaps or self._shell is None:
            return None
        return self._shell.shape.signed_distance(self.positions) >= -self.neighbour_radius

    def deepened(self, by: float | None = None) -> Tip:
        """Return this tip with a thicker shell.

        Parameters
        ----------
        by : float, optional
            Increase of the depth [nm]; by default two neighbourhood radii.

        Returns
        -------
        Tip
            Its first atoms are those of this tip, in the same order.

        Raises
        ------
        ValueError
            If this tip is not a shell: it was made from positions, or contains all atoms.
        """
        if self._shell is None or self._shell.depth is None:
            raise ValueError(f"{self!r} is not a shell that can be deepened: it contains all atoms")
        by = 2 * self.neighbour_radius if by is None else check_number(by, "by", above=0, unit="nm")
        settings = {key: self.settings[key] for key in _SHAPE_SETTINGS} | {"depth": self._shell.depth + by}
        if "phases" in self.settings:
            deeper = Tip(phases=self.phases, **settings)
        else:
            deeper = Tip(self.phases[0].material, solutes=self.phases[0].solutes, **settings)
        rounding = 2 * _ROUNDING * self.nearest_neighbour_distance
        below = self._shell.below(deeper.positions, rounding)
        deeper.positions = np.concatenate([self.positions, deeper.positions[below]])
        deeper.species = np.concatenate([self.species, deeper.species[below]])
        if self._phase is not None:
            deeper._phase = np.concatenate([self._phase, deeper.phase[below]])
        deeper._set_flags()
        return deeper

    def _set_flags(self):
        """Set which atoms are support, and which can evaporate."""
        self.support = self._shell.support(self.positions)
        self.evaporable = self._shell.evaporable(self.positions, self.support)

    def _set_elements(self, elements, species):
        self.elements = elements
        self.species = species
        self.evaporation_fields = np.array([element.evaporation_field for element in elements])
        self.charge_states = np.array([element.charge_state for element in elements], dtype=np.int32)
        self.masses = np.array([element.mass for element in elements])


def _phases_of(material, solutes, phases):
    """Phases of a tip: those of the user, or one of a material with solutes."""
    if (material is None) == (phases is None):
        raise ValueError(
            f"material or phases must be given, not both, got {short_text(material)} and {short_text(phases)}"
        )
    if phases is not None:
        if solutes is not None:
            raise ValueError(f"solutes must be those of a phase if there are phases, got {short_text(solutes)}")
        return check_phases(phases)
    fractions = check_solutes(solutes, profiles=False)
    matrix = Phase("matrix", as_material(material), solutes=fractions)  # type: ignore[arg-type]
    if matrix.material in fractions:
        raise ValueError(f"solutes must differ from the material, got {matrix.material.name}")
    return (matrix,)


def _checked_positions(positions):
    """Positions of at least two atoms that are not too far away [nm]."""
    positions = check_array(positions, "positions", ("n", 3))
    if len(positions) < 2:
        raise ValueError(f"positions must contain at least 2 atoms, got {len(positions)}")
    farthest = float(np.abs(positions).max())
    if farthest > _FARTHEST:
        raise ValueError(f"positions must be at most {_FARTHEST:g} nm from the origin, got {farthest:.4g} nm")
    return positions


def _spacing_of(positions):
    """Median distance of atoms from their nearest neighbour [nm]; ValueError if two are at the same place."""
    sample = positions[:: max(1, len(positions) // _SAMPLE)]
    neighbours = scipy.spatial.cKDTree(positions)
    nearest = neighbours.query(sample, k=2)[1]
    distances = lengths(positions[nearest[:, 1]] - positions[nearest[:, 0]])
    if not distances.min() > 0 or neighbours.query_pairs(1e-3 * float(np.median(distances))):
        raise ValueError("positions must be distinct, got two atoms at the same place")
    return float(np.median(distances))


def _criterion(structure, distance, neighbour_radius, surface_threshold):
    """Criterion for surface atoms with a measured d_nn [nm], and the distances that a user replaces [nm]."""
    criterion = SurfaceCriterion.of(structure, distance)
    if neighbour_radius is not None:
        radius = check_number(neighbour_radius, "neighbour_radius", above=0, at_most=_WIDEST * distance, unit="nm")
        criterion = replace(criterion, neighbour_radius=radius)
    if surface_threshold is not None:
        threshold = check_number(
            surface_threshold, "surface_threshold", above=0, at_most=criterion.neighbour_radius, unit="nm"
        )
        criterion = replace(criterion, surface_threshold=threshold)
    return criterion


def estimated_atoms(
    *,
    apex_radius: float,
    material: Material | str | None = None,
    phases: Sequence[Phase] | None = None,
    shank_angle: float = 1.5,
    shank_length: float | None = None,
    base: str = "rounded",
    depth: float | None = None,
    **others: Any,
) -> tuple[float, float]:
    """Estimate the numbers of atoms in memory and of surface atoms of a `Tip`, without building it."""
    host = as_material(material) if phases is None else phases[0].material  # type: ignore[arg-type]
    shape = TaperedCap(apex_radius, 2 * apex_radius if shank_length is None else shank_length, shank_angle, base)
    criterion = SurfaceCriterion.of(host.structure, host.nearest_neighbour_distance)
    shell = Shell(shape, depth, criterion.neighbour_radius)
    density = lattice.atom_density(host.structure, host.a, host.c)
    layer = shape.volume(_LAYER * host.nearest_neighbour_distance)
    return shell.volume() * density, layer * density
