"""Distortion of the detector coordinates by an instrument, such as a reflectron, and its removal by a calibration grid.

A grid of wires in front of the specimen casts its shadow on the detector. The crossings of the wires have known places
in the plane of the grid and measured places on the detector. Between them, the map from the detector to the plane is
affine in each triangle of a Delaunay triangulation.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.codec import check_itself
from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array

_FEWEST = 6  # crossings: as many as two squares
_SLIVER = 0.1  # smallest height of a triangle over its longest side: thinner ones lie at the rim only


class _Fit(NamedTuple):
    """Corrected crossings [mm], whether the grid is mirrored, and the triangles that are not slivers at the rim."""

    corrected: Floats
    mirrored: bool
    triangles: scipy.spatial.Delaunay
    proper: np.ndarray


@dataclass(frozen=True, eq=False, repr=False)
class DistortionGrid:
    """Calibration grid: places of wire crossings on the detector and in the plane of the grid.

    Parameters
    ----------
    detector : array_like
        Places on the detector [mm], shape (n, 2).
    grid : array_like
        Places of the same crossings in the plane of the grid, in any unit, shape (n, 2).
    source : str
        Origin of the grid.

    Raises
    ------
    ValueError
        If there are less than 6 crossings, two of them coincide, all lie on a line, or a triangle is folded over.

    Notes
    -----
    The corrected places are those in the plane of the grid, moved by the similarity transform that fits them best to
    the places on the detector: they have the scale, the direction and the centre of the detector, without its
    distortion.
    """

    detector: np.ndarray
    grid: np.ndarray
    source: str = ""
    _fit: _Fit = field(init=False)

    def __post_init__(self):
        check_itself(self)

    def _check(self):
        detector = check_array(self.detector, "detector", ("n", 2))
        grid = check_array(self.grid, "grid", (len(detector), 2))
        name = f"grid {self.source!r}" if self.source else "a grid"
        if len(detector) < _FEWEST:
            raise ValueError(f"{name} must have at least {_FEWEST} crossings, got {len(detector)}")
        for places, where in ((detector, "on the detector"), (grid, "in the plane of the grid")):
            nearest = scipy.spatial.cKDTree(places).query(places, k=2)[0][:, 1]
            if (first := int(nearest.argmin())) >= 0 and nearest[first] < 1e-6 * np.ptp(places, axis=0).max():
                raise ValueError(f"{name} must have different crossings {where}, got {places[first].tolist()} twice")
            if np.linalg.matrix_rank(places - places.mean(axis=0), tol=1e-6 * np.abs(places).max()) < 2:
                raise ValueError(f"{name} must not have all crossings on one line {where}")
        fitted, mirrored = _similarity(grid, detector)
        triangles = scipy.spatial.Delaunay(detector)
        corners = triangles.simplices
        proper = _thickness(detector[corners]) > _SLIVER
        areas = _areas(fitted[corners]) / _areas(detector[corners])
        if (areas[proper] <= 0).any():
            folded = detector[corners[proper][areas[proper] <= 0][0]].mean(axis=0)
            raise ValueError(
                f"{name} must not be folded: adjacent crossings around ({folded[0]:.3g}, {folded[1]:.3g}) mm on the "
                "detector are in another order in the plane of the grid"
            )
        return {"detector": detector, "grid": grid, "_fit": _Fit(fitted, bool(mirrored), triangles, proper)}

    @property
    def residual(self) -> float:
        """Root mean square distance of the distorted from the corrected crossings [mm]."""
        return float(np.sqrt(np.mean(np.sum((self._fit.corrected - self.detector) ** 2, axis=1))))

    @property
    def mirrored(self) -> bool:
        """Whether the grid fits the detector better mirrored, as if the axes of one of them were exchanged."""
        return self._fit.mirrored

    def undistorted(self, x: ArrayLike, y: ArrayLike) -> tuple[Floats, Floats]:
        """Corrected places [mm] for places x, y on the detector [mm], all of shape (n,); NaN outside the grid."""
        x = check_array(x, "x", ("n",), finite=False)
        y = check_array(y, "y", (len(x),), finite=False)
        places = np.column_stack([x, y])
        triangles: scipy.spatial.Delaunay = self._fit.triangles
        index = triangles.find_simplex(np.where(np.isfinite(places), places, 1e300))
        inside = np.flatnonzero(index >= 0)
        inside = inside[self._fit.proper[index[inside]]]
        simplex = index[inside]
        transform = triangles.transform[simplex]
        first = np.einsum("ijk,ik->ij", transform[:, :2], places[inside] - transform[:, 2])
        weights = np.column_stack([first, 1 - first.sum(axis=1)])
        corners = self._fit.corrected[triangles.simplices[simplex]]
        result = np.full(places.shape, np.nan)
        result[inside] = np.einsum("ij,ijk->ik", weights, corners)
        return result[:, 0], result[:, 1]

    def __repr__(self) -> str:
        source = f" from {self.source!r}" if self.source else ""
        return f"<DistortionGrid: {len(self.grid)} crossings{source}, distorted by {self.residual:.2f} mm (RMS)>"


def _similarity(grid, detector):
    """Places of the grid after the similarity transform that fits the detector best, and whether it is mirrored."""
    target = detector @ [1, 1j]
    fits = []
    for points in (grid @ [1, 1j], grid @ [1, -1j]):
        matrix = np.column_stack([points, np.ones(len(points))])
        moved = matrix @ np.linalg.lstsq(matrix, target, rcond=None)[0]
        fits.append((float(np.abs(moved - target).sum()), moved))
    mirrored = fits[1][0] < fits[0][0]
    moved = fits[mirrored][1]
    return np.column_stack([moved.real, moved.imag]), mirrored


def _areas(corners):
    """Twice the signed areas of triangles, shape (n,), from corners of shape (n, 3, 2)."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]


def _thickness(corners):
    """Smallest height of each triangle over its longest side."""
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    return np.abs(_areas(corners)) / sides.max(axis=1) ** 2
