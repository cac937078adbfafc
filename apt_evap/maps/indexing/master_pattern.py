"""Master patterns: the density of hits in every direction of a crystal, for ions that roll up and for ions that do not.

`apt_evap.fit.master_pattern` makes a pattern from runs.
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
from apt_evap._common.validation import check_array, check_count, check_kind, check_number, check_seed
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.projection import Projection
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.specimen.lattice import check_structure

HALF = 160
"""Pixels from the pole to the rim of a pattern."""
_RIM = 1.45  # of the equal-area disc: its equator is at sqrt(2)
PIXEL = _RIM / HALF
"""Size of a pixel at the pole [rad], 0.52 degrees."""
BRIGHTEST = 8.0
"""Largest density of a stored pattern [mean densities]; brighter pixels are set to this."""
_LEVELS = 255 / math.sqrt(BRIGHTEST)  # stored values are square roots: noise of a count is equal at all densities


def pixels_of(directions: Floats) -> Floats:
    """Pixels, shape (2, n), of directions on the equal-area disc of a hemisphere; opposite directions are equal."""
    if (directions[:, 2] < 0).any():
        directions = np.where(directions[:, 2:] < 0, -directions, directions)
    x, y, z = directions.T
    stretch = np.sqrt(2 / (1 + z)) / PIXEL
    return np.stack([y * stretch, x * stretch]) + HALF


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
        x, y = (values.ravel() for values in np.meshgrid(middle, middle))
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


def sampled(densities: Floats, directions: Floats, corner: tuple[int, int] = (0, 0)) -> Floats:
    """Densities on the disc, shape (k, n, n), at unit vectors of shape (m, 3), by linear interpolation, (k, m).

    A part of the disc begins at the row and the column of `corner`. Both in float32 give densities in float32.
    """
    height, width = densities.shape[1:]
    row, column = pixels_of(directions)
    row, column = np.clip(row - corner[0], 0, height - 1), np.clip(column - corner[1], 0, width - 1)
    # the four pixels about a place and their weights are those of all densities
    top, left = np.minimum(np.floor(row), height - 2), np.minimum(np.floor(column), width - 2)
    down, right = row - top, column - left
    first = (top * width + left).astype(np.intp)
    flat = densities.reshape(len(densities), -1)
    upper = flat.take(first, axis=1) * (1 - right) + flat.take(first + 1, axis=1) * right
    first += width
    lower = flat.take(first, axis=1) * (1 - right) + flat.take(first + 1, axis=1) * right
    return upper * (1 - down) + lower * down


def nearest_pixels(directions: Floats) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels next to unit vectors of shape (m, 3)."""
    row, column = np.rint(pixels_of(directions)).astype(np.intp)
    return row, column


def mixture(patterns: Sequence[MasterPattern], amplitudes: Floats) -> MasterPattern:
    """Mean of patterns of one structure and several radii, with amplitudes (2 n,) of their two densities.

    Its radius is the mean of the logarithms of theirs.
    """
    parts = np.asarray(amplitudes, float).reshape(-1, 2) + 1e-9  # equal ones, if there is none
    weights = parts / parts.sum(axis=0)
    densities = np.einsum("ks,ksij->sij", weights, np.stack([pattern.densities for pattern in patterns]))
    radii = np.log([pattern.apex_radius for pattern in patterns])
    radius = math.exp(parts.sum(axis=1) @ radii / parts.sum())
    return MasterPattern(patterns[0].structure, radius, densities, sum(pattern.ions for pattern in patterns))


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
    return tuple(sorted((MasterPattern.load(file) for file in files), key=lambda pattern: pattern.apex_radius))
