"""Reconstruction: positions of the ions in the specimen from their hits and their sequence.

Every ion leaves the surface of a spherical cap that recedes along the axis. Its angle on the cap follows from its
distance from the centre of the detector, and its depth from the volume of all ions before it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.types import AnyPath, Floats
from apt_evap._common.validation import (
    check_array,
    check_choice,
    check_count,
    check_kind,
    check_number,
    short_text,
)
from apt_evap.detection.hits import Hits
from apt_evap.detection.microscope.lens import LAST_ANGLE
from apt_evap.detection.microscope.local_electrode import LocalElectrode
from apt_evap.io.formats import write
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
from apt_evap.simulation.real_units import trailing_mean
from apt_evap.simulation.run import Run

PROTOCOLS = ("cap", "bas")
"""Depth increments: of the spherical cap, exact; with the area of the detector, of Bas et al."""

PROJECTIONS = ("bas", "equidistant", "compressed")
"""Relations between the distance on the detector and the angle on the cap."""

FRAMES = ("depth", "specimen")
"""Direction of z: the depth, or out of the specimen."""

_RIGHT_ANGLE = math.pi / 2
_WIDEST = math.radians(89.0)  # rim of the field of view, at the largest compression that is fitted
_LAST_ON_LENS = math.radians(LAST_ANGLE)
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
    settings : mapping
        Protocol, projection and constants of the reconstruction. With a lens, the compression is a factor of the angles
        that the lens gives, 1 before a fit.
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
    settings: Mapping[str, Any]
    shifts: Floats | None = None
    covariances: Floats | None = None

    @property
    def specimen_positions(self) -> Floats:
        """x, y and z [nm], shape (n, 3), with z out of the specimen: a right-handed frame, for crystal directions."""
        return self.positions * (1.0, 1.0, -1.0)

    @property
    def angles(self) -> Floats:
        """Polar angle of each ion on the cap [degrees], shape (n,)."""
        return _angles(self.positions, self.radii)

    @property
    def depths(self) -> Floats:
        """Depth of the apex at the evaporation of each ion [nm], shape (n,)."""
        return self.positions[:, 2] - _below(self.positions, self.radii)

    def to_hits(self, frame: str = "depth") -> Hits:
        """The ions with the reconstructed positions in place of others.

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

    def write(self, path: AnyPath, frame: str = "depth", **options: Any) -> None:
        """Write the reconstructed ions to a file.

        Parameters
        ----------
        path : str or path-like
            The file, .pos, .epos, .xyz or .vtp.
        frame : str
            "depth" or "specimen", as for `to_hits`.
        **options
            As for `write`.
        """
        write(path, self.to_hits(frame), **options)

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
        if len(self) < 3 or not free & {"radius", "compression"}:
            errors = errors_of(self.positions, self.angles, sites, linear, group, _below(self.positions, self.radii))
            return replace(errors, compression=self.settings["compression"])
        factor, compression = self._fitted(sites, free)
        radii = factor * self.radii
        positions = _placed(self.hits, radii, {**self.settings, "compression": compression}, self.shifts)
        errors = errors_of(positions, _angles(positions, radii), sites, linear, group, _below(positions, radii))
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
        known = self.settings["compression"]
        names = sorted(free & {"radius", "compression"})
        every = slice(None, None, -(-len(self) // _FIT_IONS))

        def constants(logarithms):
            factors = dict(zip(names, np.exp(logarithms), strict=True))
            return float(factors.get("radius", 1.0)), known * float(factors.get("compression", 1.0))

        def residuals(logarithms):
            factor, compression = constants(logarithms)
            settings = {**self.settings, "compression": compression}
            positions = _placed(self.hits, factor * self.radii, settings, self.shifts)[every]
            below = _below(positions, factor * self.radii[every])
            return (moved(positions, below, sites[every], free)[0] - sites[every]).ravel()

        low, high = np.full(len(names), -math.log(2.0)), np.full(len(names), math.log(2.0))
        if "compression" in names:
            high[names.index("compression")] = math.log(self._largest_compression() / known)
        start = np.zeros(len(names))
        fitted = scipy.optimize.least_squares(residuals, start, bounds=(low, high), xtol=1e-10, ftol=1e-10)
        return constants(fitted.x)

    def _largest_compression(self):
        """Twice the compression; less if the angle at the rim would exceed 89 degrees."""
        known, voltages = self.settings["compression"], _lens_voltages(self.hits, self.settings)
        rim = max(float(np.hypot(self.hits.x, self.hits.y).max()), self.settings["field_of_view"])

        def excess(compression):
            settings = {**self.settings, "compression": compression}
            angles = _angles_on_cap(rim, self.radii, voltages, settings)
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
        depths = self.depths
        swept = float(depths[-1] - depths[0])
        widening = float(self.radii[-1] - self.radii[0]) / swept if swept > 0 else 0.0
        voltages = _lens_voltages(self.hits, self.settings)
        rim = float(np.mean(_angles_on_cap(self.settings["field_of_view"], self.radii, voltages, self.settings)))
        return density_of(self.positions[:, :2] / self.radii[:, None], math.sin(rim), widening, bins)

    def __len__(self) -> int:
        return len(self.positions)

    def __repr__(self) -> str:
        extents = " x ".join(f"{extent:.1f}" for extent in np.ptp(self.positions, axis=0))
        low, high = self.radii.min(), self.radii.max()
        radius = f"R {low:.1f} nm" if low == high else f"R {low:.1f} to {high:.1f} nm"
        constants = self.settings
        names = ["field_factor", "evaporation_field", "initial_radius", "shank_angle", "compression", "efficiency"]
        if "lens" in constants:
            names.remove("compression")
        listed = ", ".join(f"{name} {constants[name]:g}" for name in names if constants.get(name) is not None)
        protocol = f"{constants['protocol']}, {constants['projection']}, {radius} ({constants['radius']})"
        return f"<Reconstruction: {len(self):,} ions, {extents} nm, {protocol}; {listed}>"


def reconstruct(
    hits: Hits,
    *,
    atomic_volume: float,
    distance: float,
    protocol: str = "cap",
    projection: str | None = None,
    radius: str | float | ArrayLike = "voltage",
    evaporation_field: float | None = None,
    field_factor: float | None = None,
    compression: float | None = None,
    efficiency: float = 1.0,
    detector_radius: float | None = None,
    area: float | None = None,
    initial_radius: float | None = None,
    shank_angle: float | None = None,
    smoothing: int = 1,
    origins: OriginTable | None = None,
    lens: LocalElectrode | None = None,
) -> Reconstruction:
    r"""Reconstruct the positions of ions from their hits.

    Parameters
    ----------
    hits : Hits
        Ions in the sequence of evaporation, simulated or measured. Ions that did not hit the detector are left out.
    atomic_volume : float
        Mean volume per ion in the specimen [nm^3].
    distance : float
        Flight length [mm]; of an instrument with a reflectron the virtual one.
    protocol : str
        Depth increment: "cap", exact for a spherical cap, or "bas", with the area of the detector.
    projection : str, optional
        Angle on the cap: "bas" (default), "equidistant" or "compressed", see the notes.
    radius : str, float or array_like
        Radius of the cap: "voltage", from the voltage of each ion; "shank", from the volume and the angle of the shank;
        or radii [nm], a number or one for each of the hits.
    evaporation_field : float, optional
        F [V/nm], for ``radius="voltage"``.
    field_factor : float, optional
        k_f in V = k_f F R, for ``radius="voltage"``; 3.3 by default.
    compression : float, optional
        Image compression xi; 1.5 by default.
    efficiency : float
        Fraction of the ions that the detector detects.
    detector_radius : float, optional
        Radius of the circular field of view [mm]. Ions outside it are left out. By default the largest distance of an
        ion from the centre.
    area : float, optional
        Area of the detector [mm^2] in place of `detector_radius`, for a detector that is not circular. No ion is left
        out.
    initial_radius : float, optional
        Radius of the cap at the first ion [nm], for ``radius="shank"``.
    shank_angle : float, optional
        Half the opening angle of the shank [degrees], for ``radius="shank"``.
    smoothing : int
        Number of ions, up to each ion, over which the voltage is averaged.
    origins : OriginTable, optional
        Table of where the ions of simulated hits came from. Lateral positions are corrected by it, and get covariances.
        The hits must have the axes of the simulated specimen.
    lens : LocalElectrode, optional
        The lens of specimen and electrode in place of projection, field factor and compression: they then follow from
        the radius of each ion. For radii from the voltage, or given ones.

    Returns
    -------
    Reconstruction

    Raises
    ------
    ValueError
        If a constant that the choices need is missing, an argument is out of range, a column is missing, or no ion hit
        the detector.

    Notes
    -----
    The voltage of an ion is the sum of the standing voltage and the voltage pulse, if there is one: it leaves at the
    top of the pulse. For field factors of the standing voltage alone, use `dataclasses.replace` with
    ``pulse_voltage=None``.

    With the distance rho of an ion from the centre of the detector, the flight length L and
    :math:`\tan\theta' = \rho/L`, the angle on the cap is

    * bas: :math:`\theta = \theta' + \arcsin((\xi-1)\sin\theta')`, a projection from a point behind the centre of the
      cap;
    * equidistant: :math:`\theta = \xi\rho/L` (De Geuser and Gault, Microsc. Microanal. 23, 238 (2017));
    * compressed: :math:`\theta = \xi\theta'`, as in `Projection` and `image_compression`.

    The position is :math:`R\sin\theta` from the axis, at the depth :math:`z + R(1-\cos\theta)`, where z is the depth
    of the apex. With the volume Omega of an atom, the efficiency eta and the angle :math:`\theta_m` at the rim of the
    field of view, the volume of the ions equals the volume that the cap sweeps:

    .. math:: \Omega/\eta = \pi R^2 \, [\sin^2\theta_m \, dz - (1-\cos\theta_m)^2 \, dR]   \quad \text{(cap)}

    with the mean of :math:`R^2` between both ions. Bas et al., Appl. Surf. Sci. 87/88, 298 (1995) and Gault et al.,
    Ultramicroscopy 111, 448 (2011) use the area A of the detector:
    :math:`\Omega/\eta = A \xi^2 R^2 dz / L^2`. On a shank of half angle alpha,
    :math:`dR = dz \sin\alpha/(1-\sin\alpha)`.

    Examples
    --------
    >>> nickel = ae.material("Ni")
    >>> run = ae.Simulation(ae.Tip(nickel, apex_radius=2.0, axis=(1, 1, 1)), seed=1).run(200)
    >>> hits = run.at_evaporation_field(field_factor=3.3).hits(ae.Unperturbed())
    >>> constants = {"atomic_volume": nickel.a**3 / 4, "distance": 100.0, "detector_radius": 80.0}
    >>> ae.reconstruct(hits, **constants, evaporation_field=35.0, projection="compressed", compression=1.13)
    <Reconstruction: 129 ions, 2.6 x 2.6 x 0.6 nm, cap, compressed, R 2.0 to 2.0 nm (voltage); field_factor 3.3,
    evaporation_field 35, compression 1.13, efficiency 1>
    """
    check_kind(hits, "hits", Hits, "Hits, such as read(path) or run.hits(perturbation)")
    if protocol == "geiser":
        raise ValueError(
            'protocol must be "cap" or "bas", got "geiser": public descriptions of wide-angle increments are that of '
            '"cap", and no different one was found'
        )
    check_choice(protocol, "protocol", PROTOCOLS)
    if origins is not None:
        check_kind(origins, "origins", OriginTable, "an OriginTable, such as origin_table(runs)")
    if lens is not None:
        check_kind(lens, "lens", LocalElectrode, "a LocalElectrode")
        by_lens = {"projection": projection, "field_factor": field_factor, "compression": compression}
        for name, value in by_lens.items():
            if value is not None:
                raise ValueError(f"{name} follows from the lens, got {name}={short_text(value)} and a lens")
        if isinstance(radius, str) and radius == "shank":
            raise ValueError('radius must be "voltage" or radii with a lens, got "shank"')
        projection, field_factor, compression = "lens", 1.0, 1.0
    else:
        projection = check_choice("bas" if projection is None else projection, "projection", PROJECTIONS)
    field_factor = 3.3 if field_factor is None else field_factor
    compression = 1.5 if compression is None else compression
    volume = check_number(atomic_volume, "atomic_volume", above=0, unit="nm^3")
    distance = check_number(distance, "distance", above=0, unit="mm")
    compression = check_number(compression, "compression", above=0)
    efficiency = check_number(efficiency, "efficiency", above=0, at_most=1)
    if detector_radius is not None and area is not None:
        raise ValueError(f"detector_radius and area exclude each other, got {detector_radius} mm and {area} mm^2")
    needs: dict[str, dict[str, Any]] = {
        "voltage": {"evaporation_field": evaporation_field},
        "shank": {"initial_radius": initial_radius, "shank_angle": shank_angle},
    }
    mode = check_choice(radius, "radius", tuple(needs)) if isinstance(radius, str) else "given"
    radii = _given_radii(radius, len(hits)) if mode == "given" else np.empty(0)
    for wanted, constants in needs.items():
        for name, value in constants.items():
            if wanted == mode and value is None:
                raise ValueError(f'radius="{mode}" needs {" and ".join(constants)}, got {name}=None')
            if wanted != mode and value is not None:
                raise ValueError(f'{name} is for radius="{wanted}", got {name}={short_text(value)} and {mode} radii')

    x, y = (column.astype(np.float64) for column in hits.require("x", "y"))
    rho = np.hypot(x, y)
    chosen = hits.detected
    if detector_radius is not None:
        detector_radius = check_number(detector_radius, "detector_radius", above=0, unit="mm")
        with np.errstate(invalid="ignore"):
            chosen &= rho <= detector_radius
    if not chosen.any():
        where = "" if detector_radius is None else f" within the detector_radius, got {detector_radius:g} mm"
        raise ValueError(f"nothing to reconstruct: none of the {len(hits):,} ions hit the detector{where}")
    selection = hits if chosen.all() else hits[chosen]
    x, y, rho = x[chosen], y[chosen], rho[chosen]
    if area is not None:
        rim = math.sqrt(check_number(area, "area", above=0, unit="mm^2") / math.pi)
    else:
        rim = float(rho.max()) if detector_radius is None else detector_radius
    if rim == 0:
        raise ValueError("all ions hit the centre of the detector: detector_radius or area is needed, got neither")

    settings: dict[str, Any] = {
        "protocol": protocol,
        "projection": projection,
        "radius": mode,
        "compression": compression,
        "efficiency": efficiency,
        "atomic_volume": volume,
        "distance": distance,
        "field_of_view": rim,
    }
    if lens is not None:
        settings["lens"] = lens
    if mode == "voltage":
        field = check_number(evaporation_field, "evaporation_field", above=0, unit="V/nm")
        field_factor = check_number(field_factor, "field_factor", at_least=0.1, at_most=100)
        mean = trailing_mean(_voltages(selection), check_count(smoothing, "smoothing", at_least=1))
        radii = mean / (field_factor * field) if lens is None else lens.radius(mean, field)
    elif mode == "given":
        radii = radii[chosen]
    # the angle at the rim depends on the radius with a lens only
    at_rim = _angles_on_cap(max(rim, float(rho.max())), radii, _lens_voltages(selection, settings), settings)
    widest, limit = float(np.max(at_rim)), _RIGHT_ANGLE if lens is None else _LAST_ON_LENS
    if not widest < limit:  # also NaN
        got = f"{math.degrees(widest):.0f} degrees" if widest >= limit else "a larger one"
        raise ValueError(
            f"all angles on the cap must be < {math.degrees(limit):.0f} degrees, got {got} at the rim: reduce "
            f"detector_radius{'' if lens else ' or compression'}"
        )
    if mode == "shank":
        swept, widening = _cross_sections(settings)
        rim_angle = float(_angles_on_cap(rim, radii, None, settings))
        per_ion = volume / efficiency
        start = check_number(initial_radius, "initial_radius", above=0, unit="nm")
        sine = math.sin(math.radians(check_number(shank_angle, "shank_angle", at_least=0, below=45, unit="degrees")))
        slope = sine / (1 - sine)
        net = swept - slope * widening
        if net <= 0:
            raise ValueError(
                f"the shank must be narrower than the field of view of {math.degrees(rim_angle):.0f} degrees, "
                f"got shank_angle={shank_angle:g}"
            )
        radii = np.cbrt(start**3 + 3 * slope * per_ion / net * np.arange(len(selection)))

    settings |= {name: float(value) for name, value in needs.get(mode, {}).items()}  # type: ignore[arg-type]
    if mode == "voltage":
        settings |= {"smoothing": smoothing} if lens else {"field_factor": field_factor, "smoothing": smoothing}
    shifts = covariances = None
    if origins is not None:
        shifts, covariances = origins.shifts_at(_on_cap(selection, radii, settings)[0])
        covariances *= (radii * radii)[:, None, None]
    positions = _placed(selection, radii, settings, shifts)
    return Reconstruction(positions, selection, radii, settings, shifts, covariances)


def _lens_voltages(hits, settings):
    """Voltage of each ion [V] for a detector with a potential; None if the lens does not need it."""
    return _voltages(hits) if "lens" in settings and settings["lens"].detector_potential else None


def _angles_on_cap(rho, radii, voltages, settings):
    """Angles on the cap [rad] for distances on the detector [mm]; with a lens for each radius and voltage."""
    if "lens" not in settings:
        return _cap_angles(np.asarray(rho) / settings["distance"], settings["projection"], settings["compression"])
    lens, voltages = settings["lens"], 1.0 if voltages is None else voltages
    return settings["compression"] * np.radians(lens.cap_angle(rho, radii, voltages, settings["distance"]))


def _on_cap(hits, radii, settings):
    """Place of each ion, x / R and y / R, shape (n, 2), and its angle on the cap [rad]."""
    x, y = (column.astype(np.float64) for column in hits.require("x", "y"))
    rho = np.hypot(x, y)
    angles = _angles_on_cap(rho, radii, _lens_voltages(hits, settings), settings)
    sine_over_rho = np.divide(np.sin(angles), rho, out=np.zeros_like(rho), where=rho > 0)
    return np.column_stack([sine_over_rho * x, sine_over_rho * y]), angles


def _placed(hits, radii, settings, shifts=None):
    """Positions [nm] of ions on caps of known radii; `shifts` of x / R and y / R are added."""
    places, angles = _on_cap(hits, radii, settings)
    below = 2 * np.sin(angles / 2) ** 2
    if shifts is not None:
        places = places + shifts
        squares = np.minimum((places**2).sum(axis=1), 1.0)
        below = squares / (1 + np.sqrt(1 - squares))
    swept, widening = _cross_sections(settings, radii, _lens_voltages(hits, settings))
    depths = _apex_depths(radii, settings["atomic_volume"] / settings["efficiency"], swept, widening)
    return np.column_stack([radii[:, None] * places, depths + radii * below])


def _cross_sections(settings, radii=None, voltages=None):
    """Areas in units of R^2 that the cap sweeps by its recession, and loses by its widening; arrays with a lens."""
    if settings["protocol"] == "bas" and "lens" not in settings:
        return math.pi * (settings["compression"] * settings["field_of_view"] / settings["distance"]) ** 2, 0.0
    rim = _angles_on_cap(settings["field_of_view"], radii, voltages, settings)
    if settings["protocol"] == "bas":  # xi = theta_m L / r
        return math.pi * rim**2, 0.0
    return math.pi * np.sin(rim) ** 2, math.pi * (1 - np.cos(rim)) ** 2


def _below(positions, radii):
    """Depth below the apex of ions on the cap [nm]."""
    squares = (positions[:, :2] ** 2).sum(axis=1)
    return squares / (radii + np.sqrt(np.maximum(radii * radii - squares, 0.0)))


def _angles(positions, radii):
    """Polar angles on the cap [degrees]."""
    return np.degrees(np.arcsin(np.minimum(np.hypot(positions[:, 0], positions[:, 1]) / radii, 1.0)))


def _cap_angles(ratios, projection, compression):
    """Angles on the cap [rad] for distances on the detector divided by the flight length."""
    if projection == "equidistant":
        return compression * ratios
    straight = np.arctan(ratios)
    if projection == "compressed":
        return compression * straight
    sine = (compression - 1) * np.sin(straight)
    return straight + np.arcsin(np.clip(sine, -1.0, 1.0)) + np.where(np.abs(sine) > 1, _RIGHT_ANGLE, 0.0)


def _voltages(hits):
    """Standing voltage plus pulse of each ion [V]."""
    (voltages,) = hits.require("voltage")
    voltages = voltages.astype(np.float64)
    if hits.pulse_voltage is not None:
        voltages += hits.pulse_voltage
    wrong = np.flatnonzero(~(np.isfinite(voltages) & (voltages > 0)))
    if len(wrong):
        raise ValueError(
            f"the voltage of every ion must be finite and > 0, got {voltages[wrong[0]]:g} V for ion {wrong[0]}"
        )
    return voltages


def _given_radii(radius, n):
    """Validated radii of the user, shape (n,)."""
    radii = np.full(n, check_number(radius, "radius", above=0, unit="nm")) if np.ndim(radius) == 0 else None
    if radii is None:
        radii = check_array(radius, "radius", (n,))
        if radii.min() <= 0:
            raise ValueError(f"radius must be > 0 nm, got {radii.min():g}")
    return radii


def _apex_depths(radii, volume, swept, widening):
    """Depth of the apex at each ion [nm]: volume = <R^2> (swept dz - widening dR) between two ions."""
    before, after = radii[:-1], radii[1:]
    swept, widening = (each if np.ndim(each) == 0 else (each[:-1] + each[1:]) / 2 for each in (swept, widening))
    squares = (before * before + before * after + after * after) / 3  # exact for dR proportional to dz
    depths = np.zeros(len(radii))
    np.cumsum((volume / squares + widening * (after - before)) / swept, out=depths[1:])
    return depths
