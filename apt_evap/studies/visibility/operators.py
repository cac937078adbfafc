"""Origin operators: how far the ions of a feature and of its surroundings are shifted and blurred, and the emulator."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy

from apt_evap._common.checked_hdf5 import open_hdf5, put_field, put_text, write_hdf5
from apt_evap._common.codec import from_plain, to_plain
from apt_evap._common.files import FileError
from apt_evap._common.kept import check_made_from
from apt_evap._common.types import AnyPath, Booleans, Floats, Integers
from apt_evap._common.validation import check_array, check_choice, check_kind, check_number, check_seed
from apt_evap.detection.instrument import Instrument
from apt_evap.emission.perturbations import Perturbation, Unperturbed
from apt_evap.simulation.config.tables import check_table
from apt_evap.simulation.simulation import Simulation
from apt_evap.specimen.phases import Phase
from apt_evap.specimen.tip import Tip
from apt_evap.studies.visibility.cases import (
    VARIABLES,
    check_feature,
    coordinates,
    depth_for,
    described,
    made,
    simulated,
    size_of,
    specimen_of,
    values_of,
    varied,
)
from apt_evap.studies.visibility.recorded import Ions, names_of, recorded_ions

_FINE = np.concatenate([np.arange(0, 2, 0.25), np.arange(2, 9)])  # edges, in sizes of the feature
_SIGNED = np.concatenate([-_FINE[:0:-1], _FINE])
_ACROSS = np.linspace(0, 1, 11)  # edges, in radii of the apex
_CELLS = {(len(_SIGNED) - 1, len(edges) - 1) for edges in (_FINE, _ACROSS)}  # shapes of the tables of a group
_CELL = 0.025  # edge of the cells of the recorded fraction, in radii of the apex
_FEWEST = 4  # ions of a cell: with 8, most cells of small particles take their shift from others
_KIND = "operators"
REMEDY = "remove it, or make operators in another file"
"""What the user can do if operators are those of something else."""


@dataclass(frozen=True, eq=False)
class OriginOperators:
    """Mean shift and covariance of the ions of a feature and of its surroundings, from full simulations.

    Parameters
    ----------
    axes : mapping
        Values of each variable [units of `VARIABLES`], in increasing order.
    elements : tuple of str
        Names of the elements, in alphabetical order.
    means : ndarray, shape (axes ..., groups, n, m, 3)
        Mean shift [nm] away from the axis of the feature, across, and along the axis of the specimen. The groups are
        the elements outside the feature, then inside. The n and m cells are those of the two coordinates of a site.
    covariances : ndarray, shape (axes ..., groups, n, m, 3, 3)
        Covariance about the mean [nm^2].
    recorded : ndarray, shape (axes ..., k, l)
        Fraction of the sites whose ions arrive, by the depth below the apex and the distance from the axis.
    depth : float
        Depth that evaporates [nm].
    settings : mapping
        What they were made from, in plain types: feature, specimen, instrument, perturbation, seed, and the settings of
        the simulations.
    source : str
        The file that they were read from, for messages.
    """

    axes: Mapping[str, Floats]
    elements: tuple[str, ...]
    means: Floats = field(repr=False)
    covariances: Floats = field(repr=False)
    recorded: Floats = field(repr=False)
    depth: float
    settings: Mapping[str, Any] = field(repr=False)
    source: str = "operators"

    def check(
        self,
        feature: Phase,
        specimen: Tip,
        instrument: Instrument,
        perturbation: Perturbation | None = None,
        *,
        axes: Mapping[str, Any] | None = None,
        n_threads: int | None = None,
        **settings: Any,
    ) -> None:
        """Check that these operators are those of a feature: all but the values of the axes, and the efficiency.

        Parameters
        ----------
        feature, specimen, instrument, perturbation, n_threads, **settings
            As for `origin_operators`.
        axes : mapping, optional
            Values of each variable; by default all axes that contain the feature.

        Raises
        ------
        FileError
            If they were made from something else; the message names the first difference.
        """
        arguments = specimen_of(specimen)
        tip = made(check_feature(feature), arguments, 0, self.depth)
        values = values_of(feature, arguments, self.axes)  # also of the feature and the specimen of these operators
        own_feature, own_specimen = self._case()
        kept = dict(self.settings) | {"elements": list(self.elements)}
        kept |= described(*varied(own_feature, own_specimen, **values))
        asked = described(*varied(feature, arguments, **values)) | {"elements": names_of(tip.elements)[0]}
        asked["instrument"] = to_plain(check_kind(instrument, "instrument", Instrument, "an Instrument"))
        asked["perturbation"] = to_plain(Unperturbed() if perturbation is None else perturbation)
        asked["simulation"] = _of_simulation(Simulation(tip, n_threads=n_threads, **settings).settings)
        for plain in (kept, asked):
            plain["instrument"] = {**plain["instrument"], "efficiency": None}
            plain.pop("seed", None)
        if axes is not None:
            asked["axes"] = to_plain(grid_of(axes))
            kept["axes"] = {name: to_plain(self.axes.get(name)) for name in axes}
        check_made_from(self.source, kept, asked, REMEDY)

    def emulate(self, seed: int, efficiency: float | None = None, **values: float) -> Ions:
        """Draw the reconstructed ions of another specimen with the feature.

        Atoms are drawn as for a `Tip`, with a random shift of the lattice. Each ion is shifted and blurred by the
        operators between the nearest values of each variable, and recorded with the efficiency.

        Parameters
        ----------
        seed : int
            Seed of the specimen, of the blur and of the instrument.
        efficiency : float, optional
            By default that of the instrument.
        **values
            Variables, see `VARIABLES`; by default those of the feature and of the specimen.

        Returns
        -------
        Ions
        """
        random = np.random.default_rng(check_seed(seed))
        if efficiency is None:
            efficiency = self.settings["instrument"].get("efficiency", 1.0)
        check_number(efficiency, "efficiency", above=0, at_most=1)
        feature, specimen = self._case()
        feature, arguments = varied(feature, specimen, **values)
        means, covariances, recorded = self._at(feature, arguments, values)
        tip = made(feature, arguments, seed, self.depth)
        radius = arguments["apex_radius"]
        fractions = recorded.ravel()[_place(tip.positions, radius, recorded.shape)] * efficiency
        kept = random.random(len(fractions)) < fractions
        sites = tip.positions[kept]
        labels = names_of(tip.elements)[1][tip.species[kept]]
        inside = _in_feature(tip)[kept]
        groups = labels + len(self.elements) * inside
        positions = displaced(sites, groups, coordinates(feature, sites, radius), means, covariances, random)
        return Ions(positions, labels, inside, sites)

    def save(self, path: AnyPath) -> None:
        """Write the operators to an HDF5 file.

        Parameters
        ----------
        path : str or path-like
            The file to write or overwrite.
        """
        with write_hdf5(path, _KIND, self.means[..., 0, 0, 0, 0].size) as file:
            for name in ("means", "covariances", "recorded"):
                put_field(file, name, getattr(self, name))
            for name, values in self.axes.items():
                put_field(file, f"axes/{name}", values)
            names = {"elements": self.elements, "axes": list(self.axes), "depth": self.depth}
            put_text(file, "settings", json.dumps(names | dict(self.settings)))

    @classmethod
    def load(cls, path: AnyPath) -> OriginOperators:
        """Read operators from a file of `save`.

        Parameters
        ----------
        path : str or path-like
            The file.

        Returns
        -------
        OriginOperators

        Raises
        ------
        FileError
            If it is missing, damaged or has other content.
        """
        with open_hdf5(path, "origin operators") as file:
            try:
                settings = file.json("settings")
                check_table(settings, "settings")
                axes = {name: file.read(f"axes/{name}", np.float64, (None,)) for name in settings.pop("axes")}
                means, covariances, recorded = (
                    file.read(name, np.float64, None) for name in ("means", "covariances", "recorded")
                )
                elements, depth = tuple(settings.pop("elements")), settings.pop("depth")
                return cls(axes, elements, means, covariances, recorded, depth, settings, str(path))._checked()
            except FileError:
                raise
            except (KeyError, ValueError, TypeError, AttributeError, RecursionError) as error:
                raise FileError(f"{str(path)!r} does not contain origin operators: {error}") from error

    def _checked(self):
        """These operators, if all parts fit together; ValueError, KeyError or TypeError otherwise."""
        check_number(self.depth, "depth", above=0, unit="nm")
        check_seed(self.settings["seed"])
        for name in ("specimen", "instrument", "perturbation", "simulation"):
            check_kind(self.settings[name], name, Mapping, "a table")
        grid = grid_of(self.axes)
        if any(not np.array_equal(grid[name], values) for name, values in self.axes.items()):
            raise ValueError("values of the axes must be in increasing order")
        varied(*self._case(), **{name: float(values[0]) for name, values in grid.items()})
        lengths = tuple(len(values) for values in grid.values())
        cells = self.means.shape[-3:-1]
        shape = (*lengths, 2 * len(self.elements), *cells, 3)
        if cells not in _CELLS or self.means.shape != shape or self.covariances.shape != (*shape, 3):
            raise ValueError(f"means must have a shape such as {shape}, got {self.means.shape}")
        if self.recorded.shape[:-2] != lengths or not self.recorded.size:
            raise ValueError(f"recorded must have the shape {lengths} and two more axes, got {self.recorded.shape}")
        if not all(np.isfinite(table).all() for table in (self.means, self.covariances, self.recorded)):
            raise ValueError("means, covariances and recorded must be finite")
        return self

    def _case(self):
        specimen = dict(self.settings["specimen"])
        specimen["phases"] = tuple(from_plain(phase, Phase, what="phases") for phase in specimen["phases"])
        return from_plain(self.settings["feature"], Phase, what="feature"), specimen

    def _at(self, feature, arguments, values):
        """Tables between those of the nearest values of each variable."""
        tables = self.means, self.covariances, self.recorded
        known = {"size": size_of(feature), "apex_radius": arguments["apex_radius"], **values}
        for name in set(values) - set(self.axes):
            raise ValueError(f"{name} was not varied, only {', '.join(self.axes) or 'nothing'}")
        for name, points in self.axes.items():
            if name not in known:
                raise ValueError(f"{name} is missing: it was varied from {points[0]:g} to {points[-1]:g}")
            value = check_number(known[name], name, at_least=points[0] - 1e-9, at_most=points[-1] + 1e-9)
            upper = min(max(int(np.searchsorted(points, value)), 1), len(points) - 1)
            if len(points) == 1:
                tables = tuple(table[0] for table in tables)
                continue
            weight = (value - points[upper - 1]) / (points[upper] - points[upper - 1])
            tables = tuple((1 - weight) * table[upper - 1] + weight * table[upper] for table in tables)
        return tables


def origin_operators(
    feature: Phase,
    specimen: Tip,
    instrument: Instrument | None = None,
    perturbation: Perturbation | None = None,
    *,
    axes: Mapping[str, Any] | None = None,
    seed: int = 1,
    n_threads: int | None = None,
    **settings: Any,
) -> OriginOperators:
    """Simulate a feature for all combinations of some variables, and count where its ions went.

    Parameters
    ----------
    feature : Phase
        The feature: a phase with a region in the coordinates of the specimen.
    specimen : Tip
        The specimen without it.
    instrument, perturbation
        As for `recorded_ions`.
    axes : mapping, optional
        Values of each variable, see `VARIABLES`; by default the size is halved and doubled.
    seed : int
        Seed of the first simulation; each has another one, and another shift of the lattice.
    n_threads : int, optional
        As for `Simulation`.
    **settings
        Further arguments of `Simulation`, such as `law`.

    Returns
    -------
    OriginOperators

    Examples
    --------
    >>> particle = ae.specimen.Phase("particle", "Ni", ae.specimen.Sphere((0, 0, 2.0), 0.5), evaporation_field=28.0)
    >>> tip = ae.Tip("Ni", apex_radius=3.0)
    >>> operators = ae.studies.origin_operators(particle, tip, axes={"size": [0.5]})
    >>> ions = operators.emulate(seed=1)
    >>> len(ions.positions) > 500
    True
    """
    instrument = Instrument(field_of_view=160.0) if instrument is None else instrument
    check_kind(instrument, "instrument", Instrument, "an Instrument")
    check_seed(seed)
    arguments = specimen_of(specimen)
    check_feature(feature)
    axes = default_axes(feature) if axes is None else axes
    grid = grid_of(axes)
    nodes = [dict(zip(grid, point, strict=True)) for point in itertools.product(*grid.values())]
    depth = depth_for(feature, arguments, nodes)
    parts: list[tuple[Floats, ...]] = []
    for number, values in enumerate(nodes):
        variant, chosen = varied(feature, arguments, **values)
        run = simulated(variant, chosen, perturbation, seed=seed + number, depth=depth, n_threads=n_threads, **settings)
        ions = recorded_ions(run, replace(instrument, efficiency=1.0), perturbation)
        elements = tuple(names_of(run.elements)[0])
        arrived = _arrived(made(variant, chosen, seed + number, depth), ions, chosen["apex_radius"], depth)
        parts.append((*_moments(variant, ions, len(elements), chosen["apex_radius"]), arrived))
    shape = tuple(len(values) for values in grid.values())
    means, covariances, recorded = (np.reshape(tables, shape + tables[0].shape) for tables in zip(*parts, strict=True))
    plain = described(feature, arguments) | {
        "instrument": to_plain(instrument),
        "perturbation": to_plain(Unperturbed() if perturbation is None else perturbation),
        "simulation": _of_simulation(run.settings),
        "seed": seed,
    }
    return OriginOperators(grid, elements, means, covariances, recorded, depth, plain)


def default_axes(feature: Phase) -> dict[str, list[float]]:
    """Half, all and twice the size of a feature; nothing for one without a size."""
    size = size_of(feature)
    return {"size": [0.5 * size, size, 2 * size]} if math.isfinite(size) else {}


def grid_of(axes: Mapping[str, Any]) -> dict[str, Floats]:
    """Values of each variable in increasing order."""
    return {check_choice(name, "axes", VARIABLES): np.unique(check_array(axes[name], name, ("n",))) for name in axes}


def _of_simulation(settings):
    """Settings of a run that are the same for all specimens of the operators, and change their ions."""
    return {name: value for name, value in settings.items() if name not in ("tip", "seed", "monitor")}


def displaced(
    sites: Floats,
    groups: Integers,
    frame: tuple[Floats, Floats],
    means: Floats,
    covariances: Floats,
    random: np.random.Generator,
) -> Floats:
    """Sites that are shifted and blurred by the tables of their groups [nm], shape (n, 3)."""
    places, directions = frame
    # of the cells, because the nearest one is used: a factor is not linear in the covariance
    factors = np.linalg.cholesky(covariances + 1e-12 * np.eye(3))
    edges = _edges(means.shape[-3:-1])
    cells = tuple(_cell(places[:, k], edges[k]) for k in (0, 1))
    shifts = _between(means, groups, places, edges)
    normal = random.standard_normal(sites.shape)
    local = shifts + np.matmul(factors[(groups, *cells)], normal[:, :, None])[:, :, 0]
    return sites + np.matmul(local[:, None], directions)[:, 0]


def _edges(shape):
    """Edges of the cells of both coordinates, by the number of cells."""
    known = {len(edges) - 1: edges for edges in (_FINE, _SIGNED, _ACROSS)}
    return known[shape[0]], known[shape[1]]


def _cell(values, edges):
    return np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)


def _between(table, groups, places, edges):
    """Bilinear interpolation between the centres of the cells, of the group of each site."""
    centres = [(bounds[1:] + bounds[:-1]) / 2 for bounds in edges]
    steps = [np.interp(places[:, k], centres[k], np.arange(len(centres[k]))) for k in (0, 1)]
    low = [np.minimum(step.astype(np.int64), len(bounds) - 2) for step, bounds in zip(steps, centres, strict=True)]
    first, second = (step - below for step, below in zip(steps, low, strict=True))
    flat = table.reshape(-1, table.shape[-1])
    rows = (groups * len(centres[0]) + low[0]) * len(centres[1]) + low[1]
    out = np.zeros((len(places), table.shape[-1]))
    for row, column in itertools.product((0, 1), (0, 1)):
        weight = (first if row else 1 - first) * (second if column else 1 - second)
        out += weight[:, None] * flat[rows + row * len(centres[1]) + column]
    return out


def _moments(feature, ions, elements, radius):
    """Mean shifts and covariances of each group in cells."""
    places, directions = coordinates(feature, ions.sites, radius)
    edges = (_SIGNED, _FINE if type(feature.region).__name__ == "Sphere" else _ACROSS)
    shape = 2 * elements, len(edges[0]) - 1, len(edges[1]) - 1
    groups = ions.labels + elements * ions.inside
    cells = np.ravel_multi_index((groups, *(_cell(places[:, k], edges[k]) for k in (0, 1))), shape)
    local = np.matmul(directions, (ions.positions - ions.sites)[:, :, None])[:, :, 0]
    means = _filled(cells, local, shape)
    # from the interpolated mean: its change within a cell is not a blur
    rest = local - _between(means, groups, places, edges)
    squares = (rest[:, :, None] * rest[:, None]).reshape(-1, 9)
    return means, _filled(cells, squares, shape).reshape(*shape, 3, 3)


def _filled(cells, values, shape):
    """Mean of values in each cell, that of the nearest cell where there are few ions; zeros for a group without ions.

    A group with few ions everywhere has one mean.
    """
    n = np.bincount(cells, minlength=math.prod(shape))
    sums = np.stack([np.bincount(cells, column, len(n)) for column in values.T], axis=-1)
    out = np.zeros((*shape, values.shape[1]))
    for group in range(shape[0]):
        count = n.reshape(shape)[group]
        summed = sums.reshape(*shape, -1)[group]
        enough = count >= _FEWEST
        if not enough.any():
            out[group] = summed.sum(axis=(0, 1)) / max(1, count.sum())
            continue
        nearest = scipy.ndimage.distance_transform_edt(~enough, return_distances=False, return_indices=True)
        out[group] = (summed / np.maximum(count, 1)[..., None])[tuple(nearest)]
    return out


def _in_feature(tip: Tip) -> Booleans:
    return tip.phase == len(tip.phases) - 1


def _place(sites, radius, shape):
    """Row of the cell of each site in the table of recorded fractions; the last cells contain nothing."""
    depth = np.floor((radius - sites[:, 2]) / (_CELL * radius) + 1e-9).astype(np.int64)
    across = (np.hypot(sites[:, 0], sites[:, 1]) / (_CELL * radius)).astype(np.int64)
    return np.clip(depth, 0, shape[0] - 1) * shape[1] + np.minimum(across, shape[1] - 1)


def _arrived(tip, ions, radius, depth):
    """Fraction of the sites whose ions arrive, in cells of the depth below the apex and the distance from the axis."""
    # a cap at this depth reaches from there to the height of the rim
    shape = math.ceil((depth / radius + 0.5) / _CELL) + 2, math.ceil(1 / _CELL) + 2
    every, arrived = (
        np.bincount(_place(sites, radius, shape), minlength=shape[0] * shape[1])
        for sites in (tip.positions, ions.sites)
    )
    fractions = (arrived / np.maximum(every, 1)).reshape(shape)
    # a cell between the planes of the crystal contains no site: that of another shift of the lattice may
    empty = (every == 0).reshape(shape)
    nearest = scipy.ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    fractions = fractions[tuple(nearest)]
    fractions[-1] = fractions[:, -1] = 0.0
    return fractions
