"""Ions with positions and species, from a file, a reconstruction or the sites of a run, and their measures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.codec import check_itself, for_json
from apt_evap._common.types import Booleans, Estimated, Floats, Integers
from apt_evap._common.validation import check_array, check_choice, check_kind, check_number, check_sequence
from apt_evap.measures.clusters import (
    ClusterSettings,
    NeighbourDistances,
    SeparationChoice,
    choose_separation,
    held_out_atoms,
    label_clusters,
    nearest_neighbours,
)
from apt_evap.measures.composition_field import CompositionField
from apt_evap.measures.interface import CompositionProfile
from apt_evap.measures.order import RadialDistribution, ShortRangeOrder, radial_distribution, short_range_order
from apt_evap.measures.triangle_mesh import ConvexHull, TriangleMesh
from apt_evap.specimen.regions import check_region, contains
from apt_evap.warnings import DataWarning, warn

_MOST_STEPS = 100_000
_HALVED = 1.25  # errors of halves of solutes over those by the atoms that count: in 60 clouds of balls, RMS 1.24


@dataclass(frozen=True, eq=False, repr=False)
class PointCloud:
    """Ions with positions and species.

    Parameters
    ----------
    positions : array_like
        Positions [nm], shape (n, 3).
    species : array_like of int
        Index of each ion into `names`, shape (n,); -1 for an ion in no range.
    names : sequence of str
        Names of the species.
    composition : sequence of dict, optional
        Number of atoms of each element in an ion of each species; by default one atom of the name of the species.
    source : str
        Where the ions are from.

    Raises
    ------
    ValueError
        If lengths differ, a position is not finite, or a species is unknown.

    Examples
    --------
    >>> cloud = ae.measures.PointCloud(np.eye(3), [0, 1, 1], ["Cu", "AlH"], [{"Cu": 1}, {"Al": 1, "H": 1}])
    >>> cloud
    <PointCloud: 3 ions, 1.0 x 1.0 x 1.0 nm; AlH 2, Cu 1>
    >>> cloud.count_atoms()
    {'Cu': 1.0, 'Al': 2.0, 'H': 2.0}
    """

    positions: Floats
    species: Integers
    names: tuple[str, ...]
    composition: tuple[Mapping[str, float], ...] | None = None
    source: str = ""

    def __post_init__(self):
        check_itself(self)

    def _check(self):
        positions = check_array(self.positions, "positions", ("n", 3))
        n = len(positions)
        names = tuple(check_sequence(self.names, "names", "names of species"))
        species = check_array(self.species, "species", (n,), dtype=np.int64)
        if n and not (species.min() >= -1 and species.max() < len(names)):
            raise ValueError(f"species must be from -1 to {len(names) - 1}, got {species.min()} to {species.max()}")
        composition = [{name: 1} for name in names] if self.composition is None else self.composition
        if len(composition) != len(names):
            raise ValueError(f"composition must have one entry for each of {len(names)} names, got {len(composition)}")
        composition = tuple(map(dict, composition))
        return {"positions": positions, "names": names, "species": species, "composition": composition}

    def __len__(self) -> int:
        return len(self.positions)

    def __repr__(self) -> str:
        extents = " x ".join(f"{extent:.1f}" for extent in np.ptp(self.positions, axis=0)) if len(self) else "0"
        number = np.bincount(self.species + 1, minlength=len(self.names) + 1)
        parts = [f"{self.names[k]} {number[k + 1]:,}" for k in np.argsort(-number[1:], kind="stable") if number[k + 1]]
        parts += [f"in no range {number[0]:,}"] if number[0] else []
        source = f" from {self.source!r}" if self.source else ""
        return f"<PointCloud: {len(self):,} ions{source}, {extents} nm; {', '.join(parts)}>"

    @classmethod
    def of(cls, ions: Any, ranges: Any = None, positions: ArrayLike | None = None) -> PointCloud:
        """Point cloud of ions with positions.

        Parameters
        ----------
        ions : Hits
            Ions with positions, such as those of a .pos file. Ions without a finite position are left out.
        ranges : Ranges, optional
            Ranges of mass of measured ions. By default the elements of simulated ions; without any, one species "ion".
        positions : array_like, optional
            Other positions [nm], shape (n, 3), such as those of a reconstruction.

        Returns
        -------
        PointCloud

        Raises
        ------
        ValueError
            If there are no positions.

        Examples
        --------
        >>> ions = ae.Hits(positions=[[0.0, 0, 0], [0, 0, 1]], mass_to_charge=[63.0, 27.0])
        >>> ranges = ae.spectra.Ranges(["Cu", "Al"], [62.5, 26.5], [63.5, 27.5])
        >>> ae.measures.PointCloud.of(ions, ranges)
        <PointCloud: 2 ions, 0.0 x 0.0 x 1.0 nm; Cu 1, Al 1>
        """
        check_kind(ions, "ions", "require", "Hits, such as read(path)")
        places = ions.require("positions")[0] if positions is None else positions
        places = check_array(places, "positions", (len(ions), 3), finite=False)
        composition = None
        if ranges is not None:
            check_kind(ranges, "ranges", "species", "Ranges, such as ae.io.read_ranges(path)")
            names, species = ranges.species_names, ranges.species(ions)
            first = {name: atoms for name, atoms in zip(ranges.names[::-1], ranges.composition[::-1], strict=True)}
            composition = tuple(first[name] or {name: 1} for name in names)
        elif "element" in ions.extra:
            names, species = np.unique(ions.extra["element"].astype(str), return_inverse=True)
            names, species = tuple(names.tolist()), species.ravel()
        else:
            names, species = ("ion",), np.zeros(len(ions), np.int64)
        finite = np.isfinite(places).all(axis=1)
        return cls(places[finite], species[finite], names, composition, ions.source)

    # ---- selection and composition ---------------------------------------------------------------------------------

    def select(self, where: Any) -> PointCloud:
        """Ions in a region, or of a mask or indices.

        Parameters
        ----------
        where : region, callable, slice or array_like
            A region such as `specimen.Sphere`, `specimen.Cylinder`, `specimen.Box`, `specimen.Layer`,
            `measures.ConvexHull` or `measures.TriangleMesh`, in the coordinates of the positions, or a function of
            points; or a slice, a mask or indices.

        Returns
        -------
        PointCloud

        Warns
        -----
        DataWarning
            If a surface of triangles is open: what is beyond its rim may be on either side.
        """
        if isinstance(where, TriangleMesh) and not where.is_closed:
            warn(f"where is an open surface, beyond whose rim ions may be on either side: {where!r}", DataWarning)
        if callable(where) or callable(getattr(where, "distance", None)):
            where = contains(check_region(where, "where"), self.positions)
        elif not isinstance(where, slice):
            rows = np.asarray(where)
            where = check_array(
                rows, "where", (len(self),) if rows.dtype == bool else ("m",), dtype=bool if rows.dtype == bool else int
            )
        return replace(self, positions=self.positions[where], species=self.species[where])

    @property
    def elements(self) -> tuple[str, ...]:
        """Names of the elements, in the order of the species."""
        return tuple(dict.fromkeys(name for atoms in self.composition or () for name in atoms))

    @cached_property
    def atoms(self) -> Floats:
        """Number of atoms of each element in each ion, shape (n, e); 0 for an ion in no range."""
        return self._table[self.species]

    @cached_property
    def _table(self):
        """Atoms of each element in an ion of each species; the last row is for ions in no range."""
        elements = self.elements
        table = np.zeros((len(self.names) + 1, len(elements)))
        for row, atoms in zip(table, self.composition or (), strict=False):
            for name, number in atoms.items():
                row[elements.index(name)] = number
        return table

    def mark(self, solute: str | Sequence[str]) -> Booleans:
        """Ions that contain an element, or are of a species.

        Parameters
        ----------
        solute : str or sequence of str
            Names of elements or species.

        Returns
        -------
        ndarray of bool, shape (n,)

        Raises
        ------
        ValueError
            If a name is unknown.
        """
        marked = np.zeros(len(self.names) + 1, bool)
        pairs = list(zip(self.names, self.composition or (), strict=True))
        for name in [solute] if isinstance(solute, str) else check_sequence(solute, "solute", "names"):
            check_choice(name, "solute", dict.fromkeys((*self.elements, *self.names)))
            marked[:-1] |= [name == species or name in atoms for species, atoms in pairs]
        return marked[self.species]

    def count_atoms(self) -> dict[str, float]:
        """Number of atoms of each element; molecules count with all their atoms.

        Returns
        -------
        dict of str to float
        """
        number = np.bincount(self.species[self.species >= 0], minlength=len(self.names))
        return dict(zip(self.elements, (number @ self._table[:-1]).tolist(), strict=True))

    def fractions(self) -> dict[str, Estimated]:
        """Fraction of the atoms of each element, with its standard deviation by the number of atoms.

        Returns
        -------
        dict of str to Estimated
        """
        return dict(zip(self.elements, _fractions(np.array(list(self.count_atoms().values()))), strict=True))

    @property
    def hull(self) -> ConvexHull:
        """Convex hull of the ions."""
        return ConvexHull(self.positions)

    # ---- measures --------------------------------------------------------------------------------------------------

    def clusters(
        self,
        solute: str | Sequence[str],
        d_max: float | None = None,
        n_min: int | None = None,
        *,
        order: int = 1,
        envelope: float | None = None,
        erosion: float | None = None,
        trials: int = 19,
        seed: int = 0,
    ) -> Clusters:
        """Clusters of a solute, by maximum separation or the core points of DBSCAN.

        Parameters
        ----------
        solute : str or sequence of str
            Names of elements or species.
        d_max, n_min, order, envelope, erosion
            See `ClusterSettings`. Without `d_max`, it and `n_min` are chosen by `choose_separation` against random
            labels. If there are no more clusters than by chance, there are none in the result.
        trials, seed
            Random labels of this choice.

        Returns
        -------
        Clusters

        Raises
        ------
        ValueError
            If no ion is a solute.

        Warns
        -----
        DataWarning
            If there are no more clusters than by chance.
        """
        marked, choice = self._solutes(solute), None
        if d_max is None:
            choice = choose_separation(self.positions, marked, trials, seed)
            d_max, n_min = choice.d_max, choice.n_min if n_min is None else n_min
        options = ClusterSettings(d_max, 10 if n_min is None else n_min, order, envelope, erosion)
        if choice is not None and not choice.found:
            warn(
                f"there are no more clusters of {_listed(solute)} than by chance (p = {choice.p_value:.2f}); d_max and "
                "n_min search for them in spite of it",
                DataWarning,
            )
            none = np.full(len(self), -1)
            return Clusters(self, marked, none, none, options, choice)
        of_solutes, of_ions = label_clusters(self.positions, marked, options)
        return Clusters(self, marked, of_solutes, of_ions, options, choice)

    def nearest_neighbours(self, solute: str | Sequence[str], order: int = 1, **options: Any) -> NeighbourDistances:
        """Distances of the k-th nearest solutes of solutes, see `measures.nearest_neighbours`."""
        return nearest_neighbours(self.positions, self._solutes(solute), order, **options)

    def radial_distribution(
        self, about: str | Sequence[str], of: str | Sequence[str], **options: Any
    ) -> RadialDistribution:
        """Partial radial distribution function, see `measures.radial_distribution`."""
        return radial_distribution(self.positions, self._solutes(about), self._solutes(of), **options)

    def short_range_order(self, shell: float | tuple[float, float], **options: Any) -> ShortRangeOrder:
        """Warren-Cowley parameters of the species, in the order of `names`, see `measures.short_range_order`."""
        return short_range_order(self.positions, self.species, shell, **options)

    def field(self, solute: str | Sequence[str], voxel: float = 0.5, delocalisation: float = 0.5) -> CompositionField:
        """Composition in voxels.

        Parameters
        ----------
        solute : str or sequence of str
            Names of elements, of which the atoms count, or of species.
        voxel, delocalisation
            As for `CompositionField.of` [nm].

        Returns
        -------
        CompositionField
        """
        self._solutes(solute)
        known = self.species >= 0
        weights, numbers = self.atoms[known].sum(axis=1), self._atoms_in(solute)[known]
        return CompositionField.of(self.positions[known], numbers, voxel, delocalisation, weights)

    def proxigram(
        self,
        solute: str | Sequence[str] | None = None,
        isovalue: float | None = None,
        *,
        surface: Any = None,
        step: float = 0.1,
        reach: float = 3.0,
        voxel: float = 0.5,
        delocalisation: float = 0.5,
        largest: bool = False,
    ) -> CompositionProfile:
        """Proximity histogram: composition as a function of the distance from an isosurface.

        Parameters
        ----------
        solute : str or sequence of str
            Names of the elements of the isosurface.
        isovalue : float
            Their fraction at the isosurface.
        surface : TriangleMesh or region, optional
            Another surface, in place of the isosurface: such as the true boundary of a phase.
        step : float
            Width of the steps [nm].
        reach : float
            Largest distance [nm].
        voxel, delocalisation
            As for `field`.
        largest : bool
            Use the largest part of the isosurface only.

        Returns
        -------
        CompositionProfile
            The coordinate is negative inside, where the fraction is above the isovalue, as that of all regions. Ions
            whose nearest point is on the rim of an open surface do not count.

        Raises
        ------
        ValueError
            If the isovalue is outside the fractions of the field, or there is no solute.

        Notes
        -----
        O. C. Hellman et al., Microsc. Microanal. 6, 437 (2000).
        """
        step = check_number(step, "step", above=0, unit="nm")
        reach = check_number(reach, "reach", at_least=step, at_most=_MOST_STEPS / 2 * step, unit="nm")
        if surface is None:
            if solute is None or isovalue is None:
                raise ValueError("a proxigram needs a solute and an isovalue, or a surface")
            surface = self.field(solute, voxel, delocalisation).isosurface(isovalue)
            surface = surface.parts()[0] if largest else surface
        area = math.nan
        if isinstance(surface, TriangleMesh):
            area = surface.within(self.hull).area  # not where the Gaussian reaches out of the specimen
            distances, on_rim = surface.nearest(self.positions, reach)
            distances[on_rim] = np.nan
        else:
            check_kind(surface, "surface", "distance", "a TriangleMesh, or a region such as Sphere((0, 0, 20), 4)")
            distances = check_array(surface.distance(self.positions), "distances of the surface", (len(self),))
        half = max(1, round(reach / step))
        return self._profile(distances, step * np.arange(-half, half + 1), area)

    def profile(
        self, axis: ArrayLike = (0, 0, 1), step: float = 0.2, region: Any = None, area: float = math.nan
    ) -> CompositionProfile:
        """Composition along an axis.

        Parameters
        ----------
        axis : array_like
            Direction of any length, shape (3,).
        step : float
            Width of the steps [nm].
        region : region, optional
            Only ions in this region count, such as a `specimen.Cylinder`.
        area : float
            Area of its cross section [nm^2], if it is known, for the interfacial excess.

        Returns
        -------
        CompositionProfile
            The coordinate is the product of position and unit vector.
        """
        direction = check_array(axis, "axis", (3,))
        length = float(np.linalg.norm(direction))
        check_number(length, "length of axis", above=0)
        step = check_number(step, "step", above=0, unit="nm")
        along = self.positions @ (direction / length)
        if region is not None:
            along[~contains(check_region(region), self.positions)] = np.nan
        if not np.isfinite(along).any():
            raise ValueError("a profile needs at least one ion in the region, got none")
        low = math.floor(float(np.nanmin(along)) / step)
        high = max(math.floor(float(np.nanmax(along)) / step), low) + 1
        if high - low > _MOST_STEPS:
            raise ValueError(f"step must be larger: {high - low:,} steps of {step:g} nm are more than {_MOST_STEPS:,}")
        return self._profile(along, step * np.arange(low, high + 1), area)

    def _profile(self, along, edges, area):
        atoms = np.column_stack([np.histogram(along, edges, weights=column)[0] for column in self.atoms.T])
        return CompositionProfile(edges, self.elements, atoms, along, area)

    def _solutes(self, solute):
        """Marked ions, at least one."""
        marked = self.mark(solute)
        if not marked.any():
            raise ValueError(f"solute must mark at least one ion, got no {_listed(solute)} in {len(self):,} ions")
        return marked

    def _atoms_in(self, solute):
        """Number of atoms of the solute in each ion; all atoms of a species that is no element."""
        numbers = np.zeros(len(self))
        for name in [solute] if isinstance(solute, str) else solute:
            if name in self.elements:
                numbers += self.atoms[:, self.elements.index(name)]
            else:
                numbers += self.atoms.sum(axis=1) * self.mark(name)
        return np.minimum(numbers, self.atoms.sum(axis=1))


@dataclass(frozen=True, eq=False, repr=False)
class Clusters:
    """Clusters of a point cloud; sizes and other columns are in the order of their numbers.

    Parameters
    ----------
    cloud : PointCloud
        All ions.
    solute : ndarray of bool
        The solutes, shape (n,).
    members : ndarray of int
        Number of the cluster of each solute by the separation alone, shape (n,); -1 for others. Numbers of solutes,
        centres and radii are those of the members.
    labels : ndarray of int
        Number of the cluster of each ion after envelope and erosion, shape (n,); -1 outside. Sizes and atoms are those
        of these ions.
    settings : ClusterSettings
        Settings of the method.
    choice : SeparationChoice or None
        How separation and fewest solutes were chosen.
    """

    cloud: PointCloud
    solute: Booleans
    members: Integers
    labels: Integers
    settings: ClusterSettings
    choice: SeparationChoice | None = None

    def __len__(self) -> int:
        return int(self.members.max(initial=-1)) + 1

    def __repr__(self) -> str:
        density = ""
        if len(self):
            value, error = self.number_density()
            density = f", {value:.2g} ± {error:.1g} per nm^3, {self.clustered_fraction:.1%} of the solutes"
        return f"<Clusters: {len(self)} of {int(self.sizes.sum()):,} ions{density}; {self.settings}>"

    @cached_property
    def sizes(self) -> Integers:
        """Number of ions, shape (k,)."""
        return np.bincount(self.labels[self.labels >= 0], minlength=len(self))

    @cached_property
    def solutes(self) -> Integers:
        """Number of solutes, shape (k,)."""
        return np.bincount(self.members[self.members >= 0], minlength=len(self))

    @property
    def clustered_fraction(self) -> float:
        """Fraction of the solutes that are in clusters."""
        return float(np.mean(self.members[self.solute] >= 0))

    @cached_property
    def centres(self) -> Floats:
        """Mean position of the solutes [nm], shape (k, 3); NaN without solutes."""
        return self._means(self.cloud.positions)

    @cached_property
    def gyration_radii(self) -> Floats:
        """Radius of gyration of the solutes [nm], shape (k,)."""
        rows = np.flatnonzero(self.members >= 0)
        away = self.cloud.positions[rows] - self.centres[self.members[rows]]
        squares = np.bincount(self.members[rows], (away**2).sum(axis=1), len(self))
        with np.errstate(invalid="ignore"):
            return np.sqrt(squares / self.solutes)

    @property
    def radii(self) -> Floats:
        """Radius of a uniform ball with this radius of gyration, sqrt(5 / 3) times it [nm], shape (k,)."""
        return math.sqrt(5 / 3) * self.gyration_radii

    @cached_property
    def at_edge(self) -> Booleans:
        """Whether a solute is within d_max of the convex hull of all ions, so that a part may be missing, bool (k,)."""
        if not len(self):
            return np.zeros(0, bool)
        rows = np.flatnonzero(self.members >= 0)
        near = self.cloud.hull.distance(self.cloud.positions[rows]) > -self.settings.d_max
        return np.bincount(self.members[rows], near, len(self)) > 0

    @cached_property
    def atoms(self) -> Floats:
        """Number of atoms of each element of the cloud in each cluster, shape (k, e)."""
        inside = self.labels >= 0
        columns = [np.bincount(self.labels[inside], part, len(self)) for part in self.cloud.atoms[inside].T]
        return np.column_stack(columns)

    @cached_property
    def _held_out(self):
        """As `atoms`, without the solutes that chose the ions."""
        return held_out_atoms(self.cloud.positions, self.solute, self.members, self.cloud.atoms, self.settings)

    @property
    def compositions(self) -> Floats:
        """Fraction of the atoms of each element in each cluster, shape (k, e); NaN if no other ion is between solutes.

        `atoms` are too rich in solute: ions join a cluster because they are near solutes. These fractions count one
        half of the solutes, at random and twice, in the envelope and erosion of the other half: the mean of several
        such halves.
        """
        with np.errstate(invalid="ignore"):
            return self._held_out / self._held_out.sum(axis=1, keepdims=True)

    @property
    def composition_errors(self) -> Floats:
        """Standard deviation of the fractions, shape (k, e); NaN without atoms that count.

        That by the number of these atoms, with one more of the element and one more of the others, as few atoms of one
        element do not have the error 0; and a quarter more, as halves of the solutes were drawn.
        """
        return _errors_of_few(self._held_out)

    def fractions(self) -> dict[str, Estimated]:
        """Fraction of the atoms of each element in all clusters together, as `compositions`.

        Returns
        -------
        dict of str to Estimated
        """
        atoms = self._held_out.sum(axis=0)
        pairs = zip(_fractions(atoms), _errors_of_few(atoms[None])[0].tolist(), strict=True)
        return dict(zip(self.cloud.elements, (Estimated(x, error) for (x, _), error in pairs), strict=True))

    def matrix_fractions(self) -> dict[str, Estimated]:
        """Fraction of the atoms of each element outside all clusters.

        Returns
        -------
        dict of str to Estimated
        """
        return self.cloud.select(self.labels < 0).fractions()

    def number_density(self, volume: float | None = None) -> Estimated:
        """Clusters per volume [1 / nm^3], with its standard deviation by the number of clusters.

        Parameters
        ----------
        volume : float, optional
            Volume of the specimen [nm^3]; by default that of the convex hull of all ions.

        Returns
        -------
        Estimated

        Notes
        -----
        Clusters at the edge count by one half.
        """
        volume = self.cloud.hull.volume if volume is None else check_number(volume, "volume", above=0, unit="nm^3")
        number = len(self) - np.count_nonzero(self.at_edge) / 2
        return Estimated(float(number / volume), math.sqrt(number) / volume)

    def to_dict(self) -> dict[str, Any]:
        """Settings, number density and all columns as numbers and lists, None for NaN, for JSON.

        Returns
        -------
        dict
        """
        names = ("sizes", "solutes", "centres", "radii", "at_edge", "atoms", "compositions", "composition_errors")
        result = {name: getattr(self, name) for name in names}
        result |= {"settings": self.settings, "elements": self.cloud.elements, "clusters": len(self)}
        result |= {"clustered_fraction": self.clustered_fraction}
        if self.choice is not None:
            result["p_value"] = self.choice.p_value
        if len(self):
            result["number_density"], result["number_density_error"] = self.number_density()
        return for_json(result)

    def _means(self, values):
        rows = np.flatnonzero(self.members >= 0)
        with np.errstate(invalid="ignore"):
            return np.column_stack(
                [np.bincount(self.members[rows], part[rows], len(self)) / self.solutes for part in values.T]
            )


def _listed(solute: str | Sequence[str]) -> str:
    """Names of solutes in a sentence."""
    return solute if isinstance(solute, str) else ", ".join(solute)


def _fractions(atoms: Floats) -> list[Estimated]:
    """Fractions of numbers of atoms, with binomial errors; NaN without atoms."""
    total = float(atoms.sum())
    if not total:
        return [Estimated(math.nan, math.nan)] * len(atoms)
    return [Estimated(float(x), math.sqrt(x * (1 - x) / total)) for x in atoms / total]


def _errors_of_few(atoms: Floats) -> Floats:
    """Standard deviations of compositions of clusters, of numbers of atoms (k, e)."""
    total = atoms.sum(axis=1, keepdims=True)
    share = (atoms + 1) / (total + 2)
    with np.errstate(divide="ignore"):
        return np.where(total > 0, _HALVED * np.sqrt(share * (1 - share) / total), np.nan)
