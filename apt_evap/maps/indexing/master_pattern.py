"""Master patterns: the density of hits in every direction of a crystal, for ions that roll up and for ions that do not.

Every simulated direction is folded by the point group of the crystal, so that one run along any axis covers the sphere:
each ion counts 48 times for the cubic lattices. The density of one run falls with the angle from its axis, smoothly.
The pattern is what remains after division by this decrease.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.short_repr import short_repr
from apt_evap._common.types import AnyPath, Floats
from apt_evap._common.validation import check_array, check_count, check_kind, check_number, check_seed, check_sequence
from apt_evap.analysis.apex import image_compression
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.projection import Projection
from apt_evap.emission.perturbations import Perturbation
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.maps.crystallography.symmetry import point_group
from apt_evap.simulation.run import Run
from apt_evap.specimen.lattice import check_structure

HALF = 160
"""Pixels from the pole to the rim of a pattern."""
_RIM = 1.45  # of the equal-area disc: its equator is at sqrt(2)
PIXEL = _RIM / HALF
"""Size of a pixel at the pole [rad], 0.52 degrees."""
BRIGHTEST = 8.0
"""Largest density of a stored pattern [mean densities]; brighter pixels are set to this."""
_WIDEST = 50.0  # degrees from the axis of the tip: farther out are ions from the shank
_ROUNDS = 6  # of density and decrease in turn: the last changes are below 0.1 %
_DEGREE = 3  # of the decrease, in the squared sine of the polar angle
_LEVELS = 255 / math.sqrt(BRIGHTEST)  # stored values are square roots: noise of a count is equal at all densities


def _disc(directions: Floats) -> Floats:
    """Pixels, shape (2, n), of directions on the equal-area disc of a hemisphere; opposite directions are equal."""
    x, y, z = np.where(directions[:, 2:] < 0, -directions, directions).T
    stretch = np.sqrt(2 / (1 + z)) / PIXEL
    return np.stack([y * stretch, x * stretch]) + HALF


@cache
def _grid() -> Floats:
    """Directions of all pixels, shape ((2 HALF + 1)^2, 3); beyond the equator they are on the other hemisphere."""
    steps = np.arange(-HALF, HALF + 1) * PIXEL
    x, y = (each.ravel() for each in np.meshgrid(steps, steps))
    z = 1 - (x * x + y * y) / 2
    stretch = np.sqrt(np.maximum((1 + z) / 2, 0))
    return np.column_stack([x * stretch, y * stretch, z])


@dataclass(frozen=True, eq=False)
class MasterPattern:
    """Density of hits in every direction of a crystal.

    Parameters
    ----------
    structure : str
        Crystal structure: fcc, bcc, diamond or hcp.
    apex_radius : float
        Radius of the tip [lattice constants].
    densities : ndarray
        Densities relative to their mean over the sphere, of ions that do not roll up and of ions that do, shape
        (2, n, n) on the equal-area disc of a hemisphere about [001].
    ions : int
        Number of ions in each density, before they are folded.

    Examples
    --------
    >>> pattern = ae.maps.master_patterns("fcc")[0]
    >>> flat, rolled = pattern.at([[1, 1, 1], [1, 2, 4]])
    >>> print("the {111} pole is dark:", flat[0] < 0.5 * flat[1])
    the {111} pole is dark: True
    """

    structure: str
    apex_radius: float
    densities: np.ndarray
    ions: int

    def __post_init__(self):
        side = 2 * HALF + 1
        check_structure(self.structure)
        check_number(self.apex_radius, "apex_radius", above=0, unit="lattice constants")
        check_array(self.densities, "densities", (2, side, side))

    def __repr__(self) -> str:
        return short_repr(self)

    def at(self, directions: ArrayLike, sigma: float = 0.0) -> Floats:
        """Densities in directions of the crystal.

        Parameters
        ----------
        directions : array_like
            Vectors of any length in the Cartesian frame of the crystal, shape (n, 3).
        sigma : float
            Standard deviation of a Gaussian that smooths the pattern [degrees].

        Returns
        -------
        ndarray
            Of ions that do not roll up, and of ions that do, shape (2, n).
        """
        directions = check_array(directions, "directions", ("n", 3))
        directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        return sampled(self.smoothed(sigma), directions)

    def smoothed(self, sigma: float) -> Floats:
        """Densities smoothed by a Gaussian [degrees], of the shape of `densities`."""
        sigma = check_number(sigma, "sigma", at_least=0, unit="degrees")
        if sigma == 0:
            return self.densities
        return scipy.ndimage.gaussian_filter(self.densities, (0, *2 * [math.radians(sigma) / PIXEL]), mode="nearest")

    def map(
        self,
        orientation: Orientation,
        projection: Projection,
        width: float,
        *,
        ions: int,
        rolled: float = 0.0,
        bins: int = 128,
        seed: int = 0,
    ) -> DetectorMap:
        """Draw a map from the pattern, without a simulation, on a circular detector.

        Parameters
        ----------
        orientation : Orientation
            Orientation of the crystal.
        projection : Projection
            Where directions are on the map.
        width : float
            Diameter of the detector [mm].
        ions : int
            Expected number of hits.
        rolled : float
            Fraction of the pattern of ions that roll up, 0 to 1.
        bins : int
            Bins across the detector.
        seed : int
            Seed of the noise of the counts.

        Returns
        -------
        DetectorMap
        """
        check_kind(orientation, "orientation", Orientation, "an Orientation")
        check_kind(projection, "projection", Projection, "a Projection")
        half = check_number(width, "width", above=0, unit="mm") / 2
        rolled = check_number(rolled, "rolled", at_least=0, at_most=1)
        edges = np.linspace(-half, half, check_count(bins, "bins", at_least=2) + 1)
        middle = (edges[:-1] + edges[1:]) / 2
        x, y = (each.ravel() for each in np.meshgrid(middle, middle))
        directions = projection.directions(np.column_stack([x, y])) @ orientation.matrix
        density = np.array([1 - rolled, rolled]) @ self.at(directions)
        mask = np.hypot(x, y) < half
        mean = np.where(mask, density, 0.0) * (check_count(ions, "ions", at_least=1) / density[mask].sum())
        counts = np.random.default_rng(check_seed(seed)).poisson(mean)
        shape = (len(middle), len(middle))
        source = f"master pattern of {orientation.material.name}"
        return DetectorMap.from_array(
            counts.reshape(shape), edges, edges, mask.reshape(shape), is_counts=True, source=source
        )

    @classmethod
    def from_runs(cls, runs: Sequence[Run] | Run, emissions: Sequence[Perturbation] | None = None) -> MasterPattern:
        """Make a pattern from runs of one pure crystal.

        Parameters
        ----------
        runs : Run or sequence of Run
            Runs of one material and radius along any axes.
        emissions : sequence of Perturbation, optional
            Two emissions: of ions that do not roll up, and of ions that do. By default the first two that were flown
            in each run.

        Returns
        -------
        MasterPattern

        Raises
        ------
        ValueError
            If the runs are of different crystals, or too short for an image compression (`image_compression`).

        Notes
        -----
        The hits in directions v of tips with the orientation M have the density ``s(theta) D(g M^T v)`` for all members
        g of the point group. D, the counts over the sum of s, and s, a polynomial in sin^2 theta up to 50 degrees, are
        computed in turn.
        """
        runs = (runs,) if isinstance(runs, Run) else check_sequence(runs, "runs", "Runs")
        for run in runs:
            check_kind(run, "runs", Run, "Runs")
        pairs = [run.perturbations[:2] if emissions is None else emissions for run in runs]
        if not pairs or any(len(check_sequence(each, "emissions", "two perturbations")) != 2 for each in pairs):
            raise ValueError("a master pattern needs runs with two emissions: without and with roll-up")
        orientations = [Orientation.from_settings(run.settings["tip"]) for run in runs]
        material = orientations[0].material
        sizes = [round(run.settings["tip"]["apex_radius"] / material.a, 6) for run in runs]
        if any(each.material != material for each in orientations) or len(set(sizes)) > 1:
            raise ValueError("runs of a master pattern must be of one material and radius")
        views = []
        for run, orientation, pair in zip(runs, orientations, pairs, strict=True):
            projection = image_compression(run).projection
            hits = [run.hits(each) for each in pair]
            places = [np.column_stack([each.x, each.y])[each.detected] for each in hits]
            views.append((orientation.matrix, [projection.directions(each) for each in places]))
        densities = np.stack(
            [_folded(material.structure, [(matrix, each[k]) for matrix, each in views]) for k in (0, 1)]
        )
        return cls(material.structure, sizes[0], densities, sum(len(run) for run in runs))

    def save(self, path: AnyPath) -> None:
        """Write the pattern to a file (.npz): square roots of the densities in 255 levels, up to 8 mean densities."""
        levels = np.rint(np.sqrt(np.clip(self.densities, 0, BRIGHTEST)) * _LEVELS).astype(np.uint8)
        with open(path, "wb") as file:
            np.savez_compressed(
                file, structure=self.structure, apex_radius=self.apex_radius, levels=levels, ions=self.ions
            )

    @classmethod
    def load(cls, path: AnyPath) -> MasterPattern:
        """Read a pattern that `save` wrote."""
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            densities = (file["levels"] / _LEVELS) ** 2
            return cls(str(file["structure"]), float(file["apex_radius"]), densities, int(file["ions"]))


def sampled(densities: Floats, directions: Floats) -> Floats:
    """Densities on the disc, shape (k, n, n), at unit vectors of shape (m, 3), by linear interpolation, (k, m)."""
    pixels = _disc(directions)
    return np.stack([scipy.ndimage.map_coordinates(each, pixels, order=1, mode="nearest") for each in densities])


def nearest(densities: Floats, directions: Floats) -> Floats:
    """Densities on the disc, shape (k, n, n), at the pixels next to unit vectors of shape (m, 3), (k, m)."""
    row, column = np.rint(_disc(directions)).astype(np.intp)
    return densities[:, row, column]


def _folded(structure: str, views: Sequence[tuple[Floats, Floats]]) -> Floats:
    """Density over the sphere, folded, of directions (n, 3) of tips with the rotation matrices (3, 3)."""
    group, grid = point_group(structure), _grid()
    side = 2 * HALF + 1
    edges = (np.arange(side + 1) - HALF - 0.5) * PIXEL
    hemisphere = np.hypot(*(np.indices((side, side)) - HALF)) * PIXEL < math.sqrt(2)
    lowest = math.cos(math.radians(_WIDEST))
    counts = np.zeros((side, side))
    cosines, kept = [], []
    for matrix, directions in views:
        directions = directions[directions[:, 2] > lowest]
        kept.append(directions)
        for member in group:
            folded = directions @ (matrix @ member)
            x, y, z = folded.T
            stretch = np.sqrt(2 / np.maximum(1 + z, 1e-9))
            counts += np.histogram2d(y * stretch, x * stretch, (edges, edges))[0]
        cosines.append([grid @ (matrix @ member).T[:, 2] for member in group])
    bins = np.linspace(0, 1 - lowest**2, 21)
    middle = (bins[:-1] + bins[1:]) / 2
    decrease = [np.array([1.0] + [0.0] * _DEGREE) for _ in views]
    density = counts
    for _ in range(_ROUNDS):
        exposure = np.zeros(len(grid))
        for polynomial, each in zip(decrease, cosines, strict=True):
            for cosine in each:
                exposure += np.where(cosine > lowest, np.polynomial.polynomial.polyval(1 - cosine**2, polynomial), 0.0)
        exposure = exposure.reshape(side, side)
        density = np.divide(counts, exposure, out=np.zeros_like(counts), where=exposure > 1e-3 * exposure.max())
        density /= density[hemisphere].mean()
        for k, (matrix, _) in enumerate(views):
            seen = np.histogram(1 - kept[k][:, 2] ** 2, bins)[0]
            cosine = (grid @ matrix.T[:, 2])[hemisphere.ravel()]
            expected = np.histogram(1 - cosine**2, bins, weights=density[hemisphere])[0]
            ratio = np.divide(seen, expected, out=np.zeros(len(middle)), where=expected > 0)
            polynomial = np.polynomial.polynomial.polyfit(middle, ratio, _DEGREE, w=np.sqrt(expected))
            decrease[k] = polynomial / polynomial[0]
    return sampled(density[None], grid)[0].reshape(side, side)  # beyond the equator that of the opposite direction


@cache
def master_patterns(structure: str) -> tuple[MasterPattern, ...]:
    """Patterns of a crystal structure that come with the package, one for each radius, the smallest first.

    Parameters
    ----------
    structure : str
        fcc, bcc, diamond or hcp.

    Returns
    -------
    tuple of MasterPattern

    Raises
    ------
    ValueError
        If there is no pattern of this structure.
    """
    files = sorted((Path(__file__).parent / "patterns").glob(f"{check_structure(structure)}_*.npz"))
    if not files:
        raise ValueError(f"master patterns come for fcc, bcc, diamond and hcp, got {structure}")
    return tuple(sorted((MasterPattern.load(each) for each in files), key=lambda each: each.apex_radius))
