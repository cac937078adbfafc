"""The geometry of a reconstruction: detector, angles on the cap, and the depth of the apex."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats
from apt_evap.detection.hits import Hits
from apt_evap.detection.microscope.lens import LAST_ANGLE
from apt_evap.detection.microscope.local_electrode import LocalElectrode
from apt_evap.reconstruction.reconstruction_settings import ReconstructionSettings

_PART = 1 << 15  # ions that are computed at a time: the temporary arrays stay in the cache
_RIGHT_ANGLE = math.pi / 2
_LAST_ON_LENS = math.radians(LAST_ANGLE)


@dataclass(frozen=True)
class CapGeometry:
    """How a place on the detector, a radius and a number of ions become a position.

    Parameters
    ----------
    protocol : str
        Depth increment, "cap" or "bas".
    projection : str
        Relation of the distance on the detector to the angle on the cap: one of `PROJECTIONS`, or "lens".
    compression : float
        Image compression; with a lens a factor of the angles that the lens gives, 1 before a fit.
    distance : float
        Flight length [mm].
    field_of_view : float
        Radius of the field of view on the detector [mm].
    volume : float
        Volume of the specimen per detected ion [nm^3].
    lens : LocalElectrode or None
        The lens.
    """

    protocol: str
    projection: str
    compression: float
    distance: float
    field_of_view: float
    volume: float
    lens: LocalElectrode | None

    @classmethod
    def of(cls, settings: ReconstructionSettings, field_of_view: float) -> CapGeometry:
        """Geometry for resolved settings and a radius of the field of view [mm]."""
        return cls(
            settings.protocol,
            "lens" if settings.projection is None else settings.projection,
            1.0 if settings.compression is None else settings.compression,
            settings.distance,
            field_of_view,
            settings.atomic_volume / settings.efficiency,  # type: ignore[operator]
            settings.lens,
        )

    @property
    def largest_angle(self) -> float:
        """Angle on the cap that no ion may reach [rad]."""
        return _RIGHT_ANGLE if self.lens is None else _LAST_ON_LENS

    def lens_voltages(self, hits: Hits) -> Floats | None:
        """Voltage of each ion [V] for a detector with a potential; None if the lens does not need it."""
        return voltages_of(hits) if self.lens is not None and self.lens.detector_potential else None

    def angles(self, rho: ArrayLike, radii: Floats | None = None, voltages: Floats | None = None) -> Floats:
        """Angles on the cap [rad].

        Parameters
        ----------
        rho : array_like
            Distances from the centre of the detector [mm].
        radii, voltages : ndarray, optional
            Radius [nm] and voltage [V] of each ion, for a lens.
        """
        if self.lens is None:
            return _cap_angles(np.asarray(rho) / self.distance, self.projection, self.compression)
        voltages = 1.0 if voltages is None else voltages  # type: ignore[assignment]
        return self.compression * np.radians(self.lens.cap_angle(rho, radii, voltages, self.distance))  # type: ignore[arg-type]

    def rim_angles(self, hits: Hits, radii: Floats) -> Floats:
        """Angle on the cap at the rim of the field of view [rad]; with a lens for each ion."""
        return self.angles(self.field_of_view, radii, self.lens_voltages(hits))

    def places(self, hits: Hits, radii: Floats) -> tuple[Floats, Floats]:
        """Place of each ion on the cap, x / R and y / R, shape (n, 2), and its angle on the cap [rad], shape (n,)."""
        columns, angles = self._places(hits, slice(None), radii, self.lens_voltages(hits))
        return np.column_stack(columns), angles

    def _places(self, hits, rows, radii, voltages):
        """`places` of some rows of the ions, as columns."""
        x, y = (column[rows].astype(np.float64) for column in hits.require("x", "y"))
        rho = np.hypot(x, y)
        angles = self.angles(rho, radii, voltages)
        sine_over_rho = np.divide(np.sin(angles), rho, out=np.zeros_like(rho), where=rho > 0)
        return (sine_over_rho * x, sine_over_rho * y), angles

    def _projected(self, hits, rows):
        """Place of some ions, x / R and y / R, and depth below the apex over R, projected from behind the centre.

        With theta - theta' as the angle at the centre, all sines follow from those of theta' without an arc.
        """
        x, y = (column[rows].astype(np.float64) for column in hits.require("x", "y"))
        squares = x * x + y * y
        cosine = 1 / np.sqrt(1 + squares / self.distance**2)  # of theta'
        shift = (self.compression - 1) / self.distance * cosine  # sin(theta - theta') / rho
        straight = np.sqrt(np.maximum(1 - squares * shift * shift, 0.0))  # cos(theta - theta')
        sine = cosine * (straight / self.distance + shift)  # sin(theta) / rho
        # 1 - cos(theta) without a difference of near numbers
        below = squares * sine * sine / (1 + cosine * (straight - squares * shift / self.distance))
        return (sine * x, sine * y), below

    def positions(self, hits: Hits, radii: Floats, shifts: Floats | None = None) -> Floats:
        """Positions of ions on caps of known radii.

        Parameters
        ----------
        hits : Hits
            The ions.
        radii : ndarray
            Radius of the cap at each ion [nm], shape (n,).
        shifts : ndarray, optional
            Correction of x / R and y / R of each ion, shape (n, 2).

        Returns
        -------
        ndarray
            x, y and depth [nm], shape (n, 3).
        """
        voltages = self.lens_voltages(hits)
        swept, widening = self.cross_sections(radii, voltages)
        positions = np.empty((len(radii), 3))
        _put_apex_depths(positions[:, 2], radii, self.volume, swept, widening)
        # all at once with a lens
        for rows in parts_of(len(radii)) if self.lens is None else [slice(None)]:
            # depth below the apex in units of R, 1 - cos(theta)
            if self.projection == "bas":
                places, below = self._projected(hits, rows)
            else:
                places, angles = self._places(hits, rows, radii[rows], voltages)
                below = 2 * np.sin(angles / 2) ** 2
            if shifts is not None:
                places = places + shifts[rows].T
                squares = np.minimum((places**2).sum(axis=0), 1.0)
                below = squares / (1 + np.sqrt(1 - squares))
            for axis, place in enumerate(places):
                positions[rows, axis] = radii[rows] * place
            positions[rows, 2] += radii[rows] * below
        return positions

    def cross_sections(self, radii: Floats | None = None, voltages: Floats | None = None) -> tuple[Floats, Floats]:
        """Areas in units of R^2 that the cap sweeps by its recession, and loses by its widening; arrays with a lens."""
        if self.protocol == "bas" and self.lens is None:
            return math.pi * (self.compression * self.field_of_view / self.distance) ** 2, 0.0  # type: ignore[return-value]
        rim = self.angles(self.field_of_view, radii, voltages)
        if self.protocol == "bas":  # xi = theta_m L / r
            return math.pi * rim**2, 0.0  # type: ignore[return-value]
        return math.pi * np.sin(rim) ** 2, math.pi * (1 - np.cos(rim)) ** 2


def voltages_of(hits: Hits) -> Floats:
    """Standing voltage plus pulse of each ion [V], shape (n,)."""
    (voltages,) = hits.require("voltage")
    voltages = voltages.astype(np.float64)
    for rows in parts_of(len(voltages)):
        part = voltages[rows]
        if hits.pulse_voltage is not None:
            part += hits.pulse_voltage[rows]
        wrong = np.flatnonzero(~(np.isfinite(part) & (part > 0)))
        if len(wrong):
            ion = rows.start + wrong[0]
            raise ValueError(f"the voltage of every ion must be finite and > 0, got {part[wrong[0]]:g} V for ion {ion}")
    return voltages


def depths_below_apex(positions: Floats, radii: Floats) -> Floats:
    """Depth below the apex of ions on the cap [nm], shape (n,)."""
    below = np.empty(len(radii))
    for rows in parts_of(len(radii)):
        squares = positions[rows, 0] ** 2 + positions[rows, 1] ** 2
        below[rows] = squares / (radii[rows] + np.sqrt(np.maximum(radii[rows] * radii[rows] - squares, 0.0)))
    return below


def parts_of(ions: int) -> Iterator[slice]:
    """Rows of parts of the ions, whose temporary arrays stay in the cache."""
    for start in range(0, ions, _PART):
        yield slice(start, min(start + _PART, ions))


def polar_angles(positions: Floats, radii: Floats) -> Floats:
    """Polar angle of ions on the cap [degrees], shape (n,)."""
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


def _put_apex_depths(depths, radii, volume, swept, widening):
    """Set the depth of the apex at each ion [nm]: volume = <R^2> (swept dz - widening dR) between two ions."""
    # areas half way between two ions
    swept, widening = (area if np.ndim(area) == 0 else (area[:-1] + area[1:]) / 2 for area in (swept, widening))
    depths[:1] = 0
    for rows in parts_of(len(radii) - 1):
        before, after = radii[:-1][rows], radii[1:][rows]
        areas, losses = (area if np.ndim(area) == 0 else area[rows] for area in (swept, widening))
        squares = (before * before + before * after + after * after) / 3  # exact for dR proportional to dz
        steps = (volume / squares + losses * (after - before)) / areas
        steps[0] += depths[rows.start]
        np.cumsum(steps, out=depths[1:][rows])
