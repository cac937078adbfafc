"""Rings about a pole in a fit of energies, which do not reward blurring: contrast of zone lines, and a dark pole.

Structural similarity compares maps place by place. If lines of both maps differ in place or width, a blurred map can be
more similar than a sharp one. The contrast of rings about a pole and the radial densities do not depend on places: blur
reduces the contrast, and fills the pole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.codec import to_plain
from apt_evap._common.short_repr import short_repr
from apt_evap._common.types import Floats, Integers
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.projection import Projection
from apt_evap.maps.crystallography.directions import plain_label, plane_normals, poles
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.maps.folded_map import FoldedMap, folded, symmetric_cells
from apt_evap.maps.pole_frame import pole_frame
from apt_evap.maps.pole_profiles import pole_profile
from apt_evap.maps.profiles import Profile
from apt_evap.maps.registration.register import Registration
from apt_evap.maps.rings import RINGS, LineAmplitude, Ring, line_amplitude, ring_statistics
from apt_evap.simulation.apex import image_compression
from apt_evap.simulation.run import Run
from apt_evap.specimen.symmetry import pole_symmetry

LOST = 0.5
"""A ring has lost its structure if its contrast is below this fraction of the measured one."""
SIGNIFICANT = 2.0
"""A measured contrast above this number of its errors, or a difference of misfits, is significant."""
_CELL = 0.75  # degrees: half the width of a narrow line
_FAMILIES = 3  # of largest spacing: their poles have wide dark facets
_COVERED = 0.7  # fraction of the circle of the outermost ring inside the compared region
_SECTORS = (72, 36, 24)  # of a ring: the most that its bins fill, and multiples of all folds


@dataclass(frozen=True)
class RegisteredProjection:
    """Projection of directions in the simulated specimen onto the measured detector.

    Parameters
    ----------
    projection : Projection
        Onto the detector of the run.
    registration : Registration
        From there into the measured frame.
    """

    projection: Projection
    registration: Registration

    def places(self, directions: ArrayLike) -> Floats:
        """Positions of directions on the detector [mm], shape (n, 2), as `Projection.places`."""
        return np.column_stack(self.registration.points(*self.projection.places(directions).T))

    def directions(self, places: ArrayLike) -> Floats:
        """Unit vectors at positions on the detector, shape (n, 3), as `Projection.directions`."""
        x, y = np.asarray(places, float).T
        return self.projection.directions(np.column_stack(self.registration.inverse_points(x, y)))


class Structure(NamedTuple):
    """Rings and radial densities about a pole."""

    rings: tuple[Ring, ...]
    """Statistics of the rings."""
    radial: Profile
    """Density against the angle from the pole."""
    folded: FoldedMap | None = None
    """The map, folded about the pole; None if it has no hits there."""

    @property
    def values(self) -> Floats:
        """Contrasts of the rings and radial densities, shape (n,)."""
        return np.array([*(ring.contrast for ring in self.rings), *self.radial.density])

    @property
    def errors(self) -> Floats:
        """Standard errors of the values, NaN for unknown noise, shape (n,)."""
        return np.array([*(ring.error for ring in self.rings), *self.radial.error])

    def misfit(self, measured: Structure) -> tuple[float, float]:
        """Root mean square difference of the values from measured ones, and its error by noise.

        All values are relative to the mean density: 0.1 is a difference by 10 % of the mean. A ring without hits lacks
        all of it: its difference is 1.
        """
        known = np.isfinite(measured.values)
        difference = np.nan_to_num(self.values - measured.values, nan=1.0)
        difference = difference[known]
        error = np.hypot(np.nan_to_num(self.errors[known]), np.nan_to_num(measured.errors[known]))
        misfit = float(np.sqrt(np.mean(difference**2)))
        if misfit == 0.0:
            return 0.0, float(np.sqrt(np.mean(error**2)))
        return misfit, float(np.sqrt(np.sum((difference * error) ** 2)) / (len(difference) * misfit))

    def correlation(self, measured: Structure) -> float:
        """Correlation of the folded maps, NaN if one of them is not known."""
        if self.folded is None or measured.folded is None:
            return float("nan")
        try:
            return self.folded.correlation(measured.folded)
        except ValueError:  # too small a common part
            return float("nan")

    def lost(self, measured: Structure) -> bool:
        """Whether all rings with a significant measured contrast have lost it."""
        pairs = self.significant_rings(measured)
        return bool(pairs) and all(ring.contrast < LOST * other.contrast for ring, other in pairs)

    def significant_rings(self, measured: Structure) -> list[tuple[Ring, Ring]]:
        """Pairs of rings of this and of a measured structure in which the measured one has a significant contrast."""
        return [
            (ring, other)
            for ring, other in zip(self.rings, measured.rings, strict=True)
            if other.contrast > SIGNIFICANT * np.nan_to_num(other.error) and other.contrast > 0
        ]


class PoleMeasure:
    """Measures the structure about one pole on maps in the measured frame.

    Parameters
    ----------
    run : Run
        Run of a crystal; its orientation and image compression give the place of the poles.
    registration : Registration
        Into the measured frame.
    region : DetectorMap
        Measured map, whose mask is the compared region.
    plane : sequence of int, optional
        Miller indices of the pole; by default of the one with the most complete rings among those of the three
        families of largest spacing.

    Raises
    ------
    ValueError
        If the run has no crystal orientation, or no pole has its rings inside the region.
    """

    def __init__(
        self, run: Run, registration: Registration, region: DetectorMap, plane: Sequence[int] | None = None
    ) -> None:
        orientation = Orientation.from_settings(run.settings["tip"])
        self.projection = RegisteredProjection(image_compression(run).projection, registration)
        if plane is None:
            families = poles(orientation.material, _FAMILIES)
            planes, normals = families.planes, families.normals
        else:
            planes = np.atleast_2d(np.asarray(plane))
            normals = plane_normals(orientation.material, planes)
        directions = orientation.directions(normals)
        covered = [self._covered(region, direction) for direction in directions]
        best = int(np.argmax(np.round(covered, 1)))  # of equal ones the first, of the largest spacing
        if covered[best] < _COVERED:
            raise ValueError(
                f"no pole has {_COVERED:.0%} of a ring at {RINGS[-1][0]:g} degrees inside the compared region, "
                f"at most {covered[best]:.0%}"
            )
        self.plane = tuple(int(index) for index in planes[best])
        self.pole = directions[best]
        symmetry = pole_symmetry(orientation.material, normals[best])
        self.fold, self.symmetry = symmetry.order, symmetry.name
        self.toward = orientation.directions([symmetry.toward])[0]
        sectors = [self._sectors(region, ring) for ring in RINGS]
        self.rings = [(ring, number) for ring, number in zip(RINGS, sectors, strict=True) if number]
        if not self.rings:
            raise ValueError(f"the bins of {region!r} are too wide for rings about a pole")

    def structure(self, map: DetectorMap, ions: float | None = None) -> Structure:
        """Structure of a map in the measured frame; `ions` as for `ring_statistics`."""
        rings = tuple(self._ring(map, ring, sectors, ions) for ring, sectors in self.rings)
        return Structure(rings, pole_profile(map, self.projection, self.pole, ions=ions), self._folded(map, ions))

    def cells(self, region: DetectorMap) -> Integers:
        """Cells about the pole for a `FoldedComparison`, shape of the map."""
        return symmetric_cells(
            region, self.projection, self.pole, self.symmetry, self.toward, self.rings[-1][0][1], _CELL
        )

    def _folded(self, map, ions):
        seed = 0 if ions is None else None  # two halves only for a ceiling, that of the measured map
        about = self.pole, self.symmetry, self.toward
        try:
            return folded(map, self.projection, *about, reach=self.rings[-1][0][1], seed=seed)
        except ValueError:  # no hits near the pole
            return None

    def _ring(self, map, ring, sectors, ions):
        """A ring; one without hits has no contrast: its values are NaN."""
        try:
            return ring_statistics(
                map, self.projection, self.pole, (ring,), fold=self.fold, sectors=sectors, ions=ions
            )[0]
        except ValueError:  # not too few bins: the number of sectors is chosen for them
            unknown, profile = float("nan"), np.full(sectors // self.fold, np.nan)
            return Ring(*ring, profile, profile, *[unknown] * 6, ions=0.0)

    def _sectors(self, region, ring):
        """Largest number of sectors of a ring for the bins of the region, 0 if there are too few bins."""
        for sectors in _SECTORS:
            try:
                ring_statistics(
                    region, self.projection, self.pole, (ring,), fold=self.fold, sectors=sectors, ions=np.inf
                )
            except ValueError:
                continue
            return sectors
        return 0

    def _covered(self, region, direction):
        """Fraction of the sectors of the outermost ring with bins inside the region."""
        if not np.isfinite(self.projection.places(direction[None])).all():
            return 0.0
        frame = pole_frame(region, self.projection, direction, np.inf)
        inner, outer = RINGS[-1]
        ring = (frame.angle >= inner) & (frame.angle < outer)
        return len(np.unique((frame.azimuth[ring] * 36).astype(int))) / 36


class StructureScores(NamedTuple):
    """Second objective of a study: misfit of the contrasts of rings and of the radial densities about a pole."""

    plane: tuple[int, ...]
    """Miller indices of the pole."""
    measured: Structure
    """Structure of the measured map."""
    unperturbed: Structure
    """Structure of the unperturbed map."""
    optimum: Structure
    """Structure of the map that is best by similarity."""
    correlations: np.ndarray
    """Correlation of the folded maps with the measured one on the grid, NaN if not known, shape of the grid."""
    misfit: np.ndarray
    """Root mean square difference from the measured values on the grid, shape of the grid."""
    errors: np.ndarray
    """Error of the misfit by noise, shape of the grid."""
    best: tuple[int, ...]
    """Index of the point with the smallest misfit."""
    at_optimum: tuple[int, ...]
    """Index of the point that is best by similarity."""

    def __repr__(self) -> str:
        return short_repr(self)

    @property
    def amplitudes(self) -> dict[tuple[float, float], LineAmplitude]:
        """Amplitudes of the measured lines in the map that is best by similarity, for rings with a measured contrast.

        The keys are the inner and outer radii [degrees].
        """
        pairs = zip(self.optimum.rings, self.measured.rings, strict=True)
        return {(other.inner, other.outer): line_amplitude(ring, other) for ring, other in pairs if other.contrast > 0}

    @property
    def evidence(self) -> str:
        """Sentence on the structure about the pole that the map of highest similarity reproduces; no full stop."""
        sentences = []
        correlation = float(self.correlations[self.at_optimum])
        if np.isfinite(correlation):
            ceiling = self.measured.folded.ceiling if self.measured.folded is not None else float("nan")
            most = f" (at most {ceiling:.2f} with the noise of the measurement)" if np.isfinite(ceiling) else ""
            sentences.append(f"the folded maps correlate to {correlation:.2f}{most}")
        known = {ring: amplitude.value for ring, amplitude in self.amplitudes.items() if np.isfinite(amplitude.value)}
        if known:
            degrees = ", ".join(f"{inner:g} to {outer:g}" for inner, outer in known)
            values = ", ".join(f"{value:.1f}" for value in known.values())
            sentences.append(f"the lines have {values} of the measured amplitude at {degrees} degrees")
        return f"about the pole ({plain_label(self.plane)}) {', and '.join(sentences)}" if sentences else ""

    def to_dict(self) -> dict[str, Any]:
        """Return the scores and the structures in plain types, without the folded maps."""
        without = {name: getattr(self, name)._replace(folded=None) for name in ("measured", "unperturbed", "optimum")}
        folded = self.measured.folded
        return to_plain(self._replace(**without)) | {
            "disagrees": self.disagrees,
            "lost": self.lost,
            "ceiling": float("nan") if folded is None else folded.ceiling,
            "evidence": self.evidence,
        }

    @property
    def disagrees(self) -> bool:
        """Whether the point that is best by similarity has a significantly larger misfit than the best one."""
        excess = self.misfit[self.at_optimum] - self.misfit[self.best]
        error = np.hypot(self.errors[self.at_optimum], self.errors[self.best])
        return bool(excess > SIGNIFICANT * error)

    @property
    def lost(self) -> bool:
        """Whether the map that is best by similarity has lost the structure of the measured one."""
        return self.optimum.lost(self.measured)
