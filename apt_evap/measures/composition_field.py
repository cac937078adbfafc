"""Composition in voxels, with its counting error, and its isosurfaces."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import scipy
import skimage
from numpy.typing import ArrayLike

from apt_evap._common.types import Booleans, Floats
from apt_evap._common.validation import check_array, check_number
from apt_evap.measures.triangle_mesh import TriangleMesh

_MOST = 200_000_000  # voxels: 5 GB for the three fields
_FEWEST = 10.0  # effective ions of a voxel of an isosurface: an error of 0.16 at a fraction of one half
_THINNEST = 0.25  # of the median density: an edge of the specimen has one half, between two sides of it one quarter
_TRUNCATE = 4.0  # standard deviations of the Gaussian


@dataclass(frozen=True, eq=False)
class CompositionField:
    r"""Fraction of a solute in voxels.

    Parameters
    ----------
    origin : ndarray
        Centre of the first voxel [nm], shape (3,).
    voxel : float
        Edge of the voxels [nm].
    delocalisation : float
        Standard deviation of the Gaussian over which each ion is distributed [nm].
    fraction : ndarray
        Fraction of the solute, shape (nx, ny, nz); NaN without ions.
    effective_ions : ndarray
        Number of ions that the fraction is a mean of, shape (nx, ny, nz).
    density : ndarray
        Atoms per volume [1 / nm^3], shape (nx, ny, nz).

    Notes
    -----
    An ion counts in a voxel with a weight w, a Gaussian of its distance. The fraction is the mean with these weights,
    and the number of effective ions :math:`(\sum w)^2 / \sum w^2` (O. C. Hellman et al., Ultramicroscopy 95, 199
    (2003)). The Gaussian moves a curved isosurface towards its centre, by about its variance over the radius.
    """

    origin: Floats = field(repr=False)
    voxel: float
    delocalisation: float
    fraction: Floats = field(repr=False)
    effective_ions: Floats = field(repr=False)
    density: Floats = field(repr=False)

    @classmethod
    def of(
        cls,
        positions: ArrayLike,
        solute: ArrayLike,
        voxel: float = 0.5,
        delocalisation: float = 0.5,
        weights: ArrayLike | None = None,
    ) -> CompositionField:
        """Composition field of ions.

        Parameters
        ----------
        positions : array_like
            Positions [nm], shape (n, 3).
        solute : array_like
            Which ions are solutes, bool, or how many atoms of the solute each ion has, shape (n,).
        voxel : float
            Edge of the voxels [nm].
        delocalisation : float
            Standard deviation of the Gaussian [nm]; 0 counts each ion in its voxel only.
        weights : array_like, optional
            Number of atoms of each ion, shape (n,); by default 1.

        Returns
        -------
        CompositionField

        Raises
        ------
        ValueError
            If there is no ion, no solute, or there are more than 200 million voxels.

        Examples
        --------
        >>> rng = np.random.default_rng(1)
        >>> cloud = 6 * rng.random((20_000, 3)) - 3
        >>> in_ball = np.linalg.norm(cloud, axis=1) < 1.5
        >>> surface = ae.measures.CompositionField.of(cloud, in_ball, 0.25, 0.2).isosurface(0.5)
        >>> print(f"{surface.area:.0f} nm^2 of {4 * np.pi * 1.5**2:.0f}")
        28 nm^2 of 28
        """
        places = check_array(positions, "positions", ("n", 3))
        numbers = check_array(np.asarray(solute), "solute", (len(places),), dtype=np.float64)
        atoms = np.ones(len(places)) if weights is None else check_array(weights, "weights", (len(places),))
        voxel = check_number(voxel, "voxel", above=0, unit="nm")
        width = check_number(delocalisation, "delocalisation", at_least=0, unit="nm")
        if not numbers.any():
            raise ValueError(f"solute must mark at least one ion, got none of {len(places):,}")
        # one voxel more at each end, so that a surface can close around the ions
        low = np.floor(places.min(axis=0) / voxel).astype(int) - 1
        shape = tuple((np.floor(places.max(axis=0) / voxel).astype(int) - low + 2).tolist())
        if math.prod(shape) > _MOST:
            raise ValueError(
                f"voxel must be larger: {' x '.join(map(str, shape))} voxels of {voxel:g} nm are more than {_MOST:,}"
            )
        place = np.ravel_multi_index(tuple((np.floor(places / voxel).astype(int) - low).T), shape)
        kernel = _kernel(width / voxel)
        volumes = [np.bincount(place, part, math.prod(shape)).reshape(shape) for part in (atoms, numbers)]
        squares = volumes[0] if weights is None else np.bincount(place, atoms**2, math.prod(shape)).reshape(shape)
        total, part = (_filtered(values, kernel) for values in volumes)
        squared = _filtered(squares, kernel**2)
        tiny = 1e-3 * kernel.max() ** 3  # less than a thousandth of an ion: no composition
        with np.errstate(invalid="ignore", divide="ignore"):
            fraction = np.where(total > tiny, part / total, np.nan)
            ions = np.where(total > tiny, total**2 / squared, 0.0)
        return cls((low + 0.5) * voxel, voxel, width, fraction, ions, total / voxel**3)

    @property
    def errors(self) -> Floats:
        """Standard deviation of the fraction by the number of ions, shape (nx, ny, nz); NaN without ions."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(np.clip(self.fraction * (1 - self.fraction), 0, None) / self.effective_ions)

    def filled(self, fewest: float = _FEWEST) -> Booleans:
        """Voxels with this number of effective ions and a quarter of the median density of such, bool (nx, ny, nz)."""
        enough = self.effective_ions >= fewest
        return enough & (self.density >= _THINNEST * np.median(self.density[enough])) if enough.any() else enough

    def isosurface(self, isovalue: float, fewest: float = _FEWEST) -> TriangleMesh:
        """Surface of a fraction, with the larger fraction inside, by marching cubes.

        Parameters
        ----------
        isovalue : float
            The fraction.
        fewest : float
            Voxels with fewer effective ions have no surface: it stays open where the ions end.

        Returns
        -------
        TriangleMesh

        Raises
        ------
        ValueError
            If the fraction is nowhere in the field.
        """
        isovalue = check_number(isovalue, "isovalue", at_least=0, at_most=1)
        filled = self.filled(fewest)
        values = self.fraction[filled]
        if not (len(values) and values.min() <= isovalue <= values.max()):
            bounds = f"from {values.min():.3g} to {values.max():.3g}" if len(values) else "in no voxel"
            raise ValueError(
                f"isovalue must be within the fractions of voxels with at least {fewest:g} ions, {bounds}, got "
                f"{isovalue:g}"
            )
        cubes = scipy.ndimage.minimum_filter(filled, 2, mode="constant", cval=False)  # all eight corners are filled
        field_ = np.where(filled, self.fraction, isovalue)
        try:
            vertices, faces, *_ = skimage.measure.marching_cubes(
                field_, isovalue, spacing=(self.voxel,) * 3, mask=cubes, gradient_direction="ascent"
            )
        except RuntimeError as error:
            raise ValueError(f"isovalue {isovalue:g} has no surface within the filled voxels") from error
        return TriangleMesh(vertices.astype(np.float64) + self.origin, faces)


def _kernel(width: float) -> Floats:
    """Gaussian on the voxels with the sum 1."""
    reach = math.ceil(_TRUNCATE * width)
    values = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(width, 1e-9)) ** 2)
    return values / values.sum()


def _filtered(values: Floats, kernel: Floats) -> Floats:
    for axis in range(3):
        values = scipy.ndimage.correlate1d(values, kernel, axis, mode="constant") if len(kernel) > 1 else values
    return values
