"""Reconstructed ions, and the reconstruction by a spherical cap.

Every ion leaves the surface of a spherical cap that recedes along the axis. Its angle on the cap follows from its
distance from the centre of the detector, and its depth from the volume of all ions before it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.quantiles import quantile
from apt_evap._common.types import Booleans, Floats, Integers
from apt_evap._common.validation import check_array, check_choice
from apt_evap.detection.hits import Hits, MassRanges
from apt_evap.measures.interface import CompositionProfile
from apt_evap.measures.point_cloud import Clusters, PointCloud
from apt_evap.reconstruction.cap_geometry import CapGeometry, depths_below_apex, parts_of, polar_angles, voltages_of
from apt_evap.reconstruction.density import CapDensity, density_of
from apt_evap.reconstruction.errors import (
    FREE,
    ReconstructionErrors,
    errors_of,
    free_constants,
    groups_of,
    moved,
    true_sites,
)
from apt_evap.reconstruction.origins import OriginTable
from apt_evap.reconstruction.reconstruction_settings import (
    ReconstructionSettings,
    slope_of_shank,
)
from apt_evap.simulation.real_units import trailing_mean
from apt_evap.simulation.run import Run

FRAMES = ("depth", "specimen")
"""Direction of z: the depth, or out of the specimen."""

_CORE = 0.5  # of the field of view
_WIDEST = math.radians(89.0)  # rim of the field of view, at the largest compression that is fitted
_FIT_IONS = 100_000  # of which radius and compression are fitted: errors of 1e-3 of those of an ion


@dataclass(frozen=True, eq=False, repr=False)
class Reconstruction:
    """Reconstructed ions, in the order of the hits.

    Parameters
    ----------
    positions : ndarray
        x, y and depth z [nm], shape (n, 3). The depth increases during the measurement. It is 0 at the apex of the
        first ion. The z axis of a specimen points the other way, so this frame is its mirror image: see
        `specimen_positions`.
    hits : Hits
        The ions: those that hit the detector within its radius.
    radii : ndarray
        Radius of the cap at the evaporation of each ion [nm], shape (n,).
    settings : ReconstructionSettings
        Protocol, projection and constants, with a number for every constant that has a default.
    geometry : CapGeometry
        What follows from them and the ions: the field of view and the relation of the detector to the cap.
    shifts : ndarray or None
        Correction of x / R and y / R of each ion by a table of origins, shape (n, 2).
    covariances : ndarray or None
        Covariance of x and y of each ion by this table [nm^2], shape (n, 2, 2).

    Examples
    --------
    >>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1)), seed=1).run(200)
    >>> constants = {"atomic_volume": 0.0109, "distance": 100.0, "detector_radius": 80.0, "compression": 1.13}
    >>> reconstruction = ae.reconstruct(run.hits(ae.Unperturbed()), radius=2.0, projection="compressed", **constants)
    >>> print(f"{len(reconstruction)} ions, {np.ptp(reconstruction.positions[:, 2]):.1f} nm deep")
    129 ions, 0.6 nm deep
    >>> print(f"lateral error {reconstruction.errors(run).lateral_rms:.2f} nm")
    lateral error 0.09 nm
    """

    positions: Floats
    hits: Hits
    radii: Floats
    settings: ReconstructionSettings
    geometry: CapGeometry
    shifts: Floats | None = None
    covariances: Floats | None = None

    _has_free_projection: ClassVar[bool] = True  # whether radius and compression can be changed afterwards

    @property
    def specimen_positions(self) -> Floats:
        """x, y and z [nm], shape (n, 3), with z out of the specimen: a right-handed frame, for crystal directions."""
        return self.positions * (1.0, 1.0, -1.0)

    @cached_property
    def extents(self) -> tuple[float, float, float]:
        """Lengths along x, y and depth [nm]."""
        width, height, depth = (float(np.ptp(column)) for column in self.positions.T)
        return width, height, depth

    @cached_property
    def depths(self) -> Floats:
        """Depth of the apex at the evaporation of each ion [nm], shape (n,)."""
        return self.depths_of(slice(None))

    def depths_of(self, ions: Any) -> Floats:
        """The `depths` of some ions, a slice or their numbers: of many, all are a large array."""
        positions = self.positions[ions]
        return positions[:, 2] - depths_below_apex(positions, self.radii[ions])

    @cached_property
    def core(self) -> tuple[Booleans, float]:
        """Ions within half the field of view, where densities and profiles are counted, (n,), and its radius [nm]."""

        def across(rows):
            x, y = self.positions[rows, :2].T
            return np.sqrt(x * x + y * y)

        parts = list(parts_of(len(self)))
        farthest = max(float(across(rows).max()) for rows in parts)
        rim = _CORE * quantile(lambda: map(across, parts), 0.0, farthest, 0.99)
        return np.concatenate([across(rows) < rim for rows in parts]), rim

    @property
    def angles(self) -> Floats:
        """Polar angle of each ion on the cap [degrees], shape (n,)."""
        return polar_angles(self.positions, self.radii)

    def to_hits(self, frame: str = "depth") -> Hits:
        """Ions with the reconstructed positions, for files: ``ae.write("ions.pos", reconstruction.to_hits())``.

        Parameters
        ----------
        frame : str
            "depth": z is the depth, as in `positions`. "specimen": z goes out of the specimen, as in
            `specimen_positions`.

        Returns
        -------
        Hits
        """
        chosen = check_choice(frame, "frame", FRAMES)
        return replace(self.hits, positions=self.positions if chosen == "depth" else self.specimen_positions)

    def cloud(self, ranges: MassRanges | None = None, frame: str = "depth") -> PointCloud:
        """The reconstructed ions with their species, for measures such as `measures.PointCloud.clusters`.

        Parameters
        ----------
        ranges : Ranges, optional
            Ranges of mass of measured ions; by default the elements of simulated ions.
        frame : str
            As for `to_hits`.

        Returns
        -------
        PointCloud
        """
        return PointCloud.of(self.to_hits(frame), ranges)

    def clusters(self, *arguments: Any, ranges: MassRanges | None = None, **options: Any) -> Clusters:
        """Clusters of a solute, see `measures.PointCloud.clusters`; ranges as for `cloud`."""
        return self.cloud(ranges).clusters(*arguments, **options)

    def proxigram(self, *arguments: Any, ranges: MassRanges | None = None, **options: Any) -> CompositionProfile:
        """Proxigram of an isosurface, see `measures.PointCloud.proxigram`; ranges as for `cloud`."""
        return self.cloud(ranges).proxigram(*arguments, **options)

    def errors(
        self,
        truth: Run | ArrayLike | None = None,
        fit: Sequence[str] = FREE,
        groups: ArrayLike | None = None,
    ) -> ReconstructionErrors:
        """Errors of the positions, compared with the true sites of the ions.

        Parameters
        ----------
        truth : Run or array_like, optional
            The run that the hits belong to, or the sites of the ions [nm], shape (n, 3), with z along the axis of the
            specimen and out of it. By default the positions of simulated hits, which are their sites.
        fit : sequence of str
            Free constants that are fitted by least squares before the comparison: "shift", "rotation" about the axis,
            "depth_scale", "radius" (one factor of all radii), "compression"; also "lateral_scale".
        groups : array_like of int, optional
            Group of each ion, such as its phase: one number for each of the reconstructed ions, or for each ion of the
            run. By default the species, if it is known.

        Returns
        -------
        ReconstructionErrors

        Raises
        ------
        ValueError
            If there are no true sites, or too few ions.

        Notes
        -----
        Radius and compression are found by a search, the other constants by linear least squares at each of its steps.
        The radii are those of this reconstruction, times the factor; corrections by a table of origins stay the same.
        Of more than 100,000 ions the search uses part.
        """
        sites, group = true_sites(self.hits, truth), groups_of(self.hits, truth, groups)
        free = free_constants(fit)
        linear = tuple(free - {"radius", "compression"})
        if len(self) < 3 or not self._has_free_projection or not free & {"radius", "compression"}:
            errors = errors_of(self.positions, self.angles, sites, linear, group, self.positions[:, 2] - self.depths)
            return replace(errors, compression=self.geometry.compression)
        factor, compression = self._fitted(sites, free)
        radii = factor * self.radii
        geometry = replace(self.geometry, compression=compression)
        positions = geometry.positions(self.hits, radii, self.shifts)
        errors = errors_of(
            positions, polar_angles(positions, radii), sites, linear, group, depths_below_apex(positions, radii)
        )
        return replace(errors, radius_factor=factor, compression=compression)

    def fitted_positions(self, truth: Run | ArrayLike | None = None, fit: Sequence[str] = FREE) -> Floats:
        """Positions in the coordinates of the specimen, after the fit of the free constants.

        These are the positions that `errors` compares with the sites. The regions of the phases apply to them:
        ``region.distance(positions)``.

        Parameters
        ----------
        truth, fit
            As for `errors`.

        Returns
        -------
        ndarray
            x, y and z of each ion [nm], shape (n, 3), with z out of the specimen.
        """
        return true_sites(self.hits, truth) + self.errors(truth, fit).residuals

    def _fitted(self, sites, free):
        """Factor of the radii and compression by least squares, all linear constants fitted for each pair."""
        known = self.geometry.compression
        names = sorted(free & {"radius", "compression"})
        every = slice(None, None, -(-len(self) // _FIT_IONS))

        def constants(logarithms):
            factors = dict(zip(names, np.exp(logarithms), strict=True))
            return float(factors.get("radius", 1.0)), known * float(factors.get("compression", 1.0))

        def residuals(logarithms):
            factor, compression = constants(logarithms)
            geometry = replace(self.geometry, compression=compression)
            positions = geometry.positions(self.hits, factor * self.radii, self.shifts)[every]
            below = depths_below_apex(positions, factor * self.radii[every])
            return (moved(positions, below, sites[every], free)[0] - sites[every]).ravel()

        low, high = np.full(len(names), -math.log(2.0)), np.full(len(names), math.log(2.0))
        if "compression" in names:
            high[names.index("compression")] = math.log(self._largest_compression() / known)
        start = np.zeros(len(names))
        fitted = scipy.optimize.least_squares(residuals, start, bounds=(low, high), xtol=1e-10, ftol=1e-10)
        return constants(fitted.x)

    def _largest_compression(self):
        """Twice the compression; less if the angle at the rim would exceed 89 degrees."""
        known, voltages = self.geometry.compression, self.geometry.lens_voltages(self.hits)
        rim = max(float(np.hypot(self.hits.x, self.hits.y).max()), self.geometry.field_of_view)

        def excess(compression):
            angles = replace(self.geometry, compression=compression).angles(rim, self.radii, voltages)
            return float(np.max(angles)) - _WIDEST

        if excess(2 * known) <= 0:
            return 2 * known
        if excess(known) >= 0:
            return known * (1 + 1e-6)
        return float(scipy.optimize.brentq(excess, known, 2 * known))

    def density_map(self, bins: int = 32) -> CapDensity:
        """Number of ions per area of the cap over its expectation.

        Parameters
        ----------
        bins : int
            Number of bins along the diameter of the field of view.

        Returns
        -------
        CapDensity
        """
        depths = self.depths_of([0, -1])
        swept = float(depths[-1] - depths[0])
        widening = float(self.radii[-1] - self.radii[0]) / swept if swept > 0 else 0.0
        rim = float(np.mean(self.geometry.rim_angles(self.hits, self.radii)))
        return density_of(self.positions[:, :2] / self.radii[:, None], math.sin(rim), widening, bins)

    def __len__(self) -> int:
        return len(self.positions)

    def __repr__(self) -> str:
        extents = " x ".join(f"{extent:.1f}" for extent in self.extents)
        low, high = self.radii.min(), self.radii.max()
        radius = f"R {low:.1f} nm" if low == high else f"R {low:.1f} to {high:.1f} nm"
        names = ("field_factor", "evaporation_field", "initial_radius", "shank_angle", "compression", "efficiency")
        constants = {name: getattr(self.settings, name) for name in names}
        listed = ", ".join(f"{name} {value:g}" for name, value in constants.items() if value is not None)
        protocol = f"{self.settings.protocol}, {self.geometry.projection}, {radius} ({self.settings.mode})"
        return f"<Reconstruction: {len(self):,} ions, {extents} nm, {protocol}; {listed}>"


def cap_reconstruction(
    hits: Hits, settings: ReconstructionSettings, origins: OriginTable | None = None
) -> tuple[Reconstruction, Integers]:
    """Reconstruction by a cap that stays a sphere, for resolved settings, and the rows of its ions."""
    selection, rows, rim, farthest = _field_of_view(hits, settings)
    geometry = CapGeometry.of(settings, rim)
    if settings.mode == "given":
        radii = _radii_of_user(settings.radius, len(hits))[rows]
    elif settings.mode == "voltage":
        radii = _radii_by_voltage(selection, settings)
    else:
        radii = np.empty(0)  # the angle at the rim does not depend on them
    _check_angles(selection, radii, geometry, farthest)
    if settings.mode == "shank":
        radii = _radii_on_shank(len(selection), settings, geometry)

    shifts = covariances = None
    if origins is not None:
        shifts, covariances = origins.shifts_at(geometry.places(selection, radii)[0])
        covariances *= (radii * radii)[:, None, None]
    positions = geometry.positions(selection, radii, shifts)
    found = Reconstruction(positions, selection, radii, settings, geometry, shifts, covariances)
    return found, np.flatnonzero(rows)


def _field_of_view(hits, settings):
    """Ions within the field of view, which of the hits these are, its radius, and the largest distance in it [mm]."""
    x, y = hits.require("x", "y")
    rows, radius, farthest = hits.detected, settings.detector_radius, 0.0
    for part in parts_of(len(hits)):
        with np.errstate(invalid="ignore", over="ignore"):
            rho = np.sqrt(np.square(x[part], dtype=np.float64) + np.square(y[part], dtype=np.float64))
            if radius is not None:
                rows[part] &= rho <= radius
        farthest = max(farthest, float(rho.max(where=rows[part], initial=0.0)))
    if not rows.any():
        where = "" if radius is None else f" within the detector_radius, got {radius:g} mm"
        raise ValueError(f"nothing to reconstruct: none of the {len(hits):,} ions hit the detector{where}")
    if settings.area is not None:
        rim = math.sqrt(settings.area / math.pi)
    else:
        rim = farthest if radius is None else radius
    if rim == 0:
        raise ValueError("all ions hit the centre of the detector: detector_radius or area is needed, got neither")
    return hits if rows.all() else hits[rows], rows, rim, farthest


def _radii_of_user(radius, n):
    """Radii that are given, shape (n,)."""
    return np.full(n, radius) if np.ndim(radius) == 0 else check_array(radius, "radius", (n,))


def _radii_by_voltage(hits, settings):
    """Radius of the cap from the voltage of each ion [nm], shape (n,)."""
    mean = trailing_mean(voltages_of(hits), settings.smoothing)
    if settings.lens is not None:
        return settings.lens.radius(mean, settings.evaporation_field)
    mean /= settings.field_factor * settings.evaporation_field
    return mean


def _radii_on_shank(n, settings, geometry):
    """Radius of the cap from the volume of the ions before each one [nm], shape (n,)."""
    swept, widening = geometry.cross_sections()
    slope = slope_of_shank(settings.shank_angle)
    net = swept - slope * widening
    if net <= 0:
        rim = math.degrees(float(geometry.angles(geometry.field_of_view)))
        raise ValueError(
            f"the shank must be narrower than the field of view of {rim:.0f} degrees, "
            f"got shank_angle={settings.shank_angle:g}"
        )
    # R^2 dR = slope volume / net for each ion
    return np.cbrt(settings.initial_radius**3 + 3 * slope * geometry.volume / net * np.arange(n))


def _check_angles(hits, radii, geometry, farthest):
    """Raise an error if an ion or the rim of the field of view is too far from the axis of the cap."""
    rim = max(geometry.field_of_view, farthest)
    widest = float(np.max(geometry.angles(rim, radii, geometry.lens_voltages(hits))))
    limit = geometry.largest_angle
    if not widest < limit:  # also NaN
        got = f"{math.degrees(widest):.0f} degrees" if widest >= limit else "a larger one"
        raise ValueError(
            f"all angles on the cap must be < {math.degrees(limit):.0f} degrees, got {got} at the rim: reduce "
            f"detector_radius{'' if geometry.lens else ' or compression'}"
        )
