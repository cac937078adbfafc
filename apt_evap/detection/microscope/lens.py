"""The lens at one radius of the apex: charges of the conductors, and flights of ions from the cap."""

import math
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array
from apt_evap.detection.microscope.boundary_elements import ChargedPanels, joined
from apt_evap.detection.microscope.conductors import CAP_PANELS, Flank, electrode, specimen

LAST_ANGLE = 50.0
"""Largest angle on the cap that a lens projects [degrees]."""
_FIT = math.radians(55)  # of the fields on the cap: beyond LAST_ANGLE, before the shank of 30 degrees
_ORDER = 4  # of the field on the cap in squares of the angle (measured: residuals below 1e-4 of the field)
_CLEAR = 0.9  # of the aperture: farther out, the singular field of the rim deflects ions
_TOLERANCE = 1e-7
_END = 40  # distances of the electrode or radii of the aperture (measured: potential below 1e-5 of the voltage)


class Flights(NamedTuple):
    """Ends of flights behind the electrode, in the half plane; signed where an ion crossed the axis."""

    rho: Floats
    """Distance from the axis [nm], shape (n,)."""
    z: Floats
    """Distance from the apex along the axis [nm], shape (n,)."""
    radial: Floats
    """Velocity away from the axis in units of sqrt(n e V / m), shape (n,)."""
    axial: Floats
    """Velocity along the axis in the same unit, shape (n,)."""
    time: Floats
    """Time since the launch [nm] in units of 1 / sqrt(n e V / m), shape (n,)."""
    energy: Floats
    """Kinetic and potential energy in units of n e V, shape (n,): 1 plus the energy of the launch."""

    @property
    def angles(self) -> Floats:
        """Angles of the flights from the axis [degrees], shape (n,)."""
        return np.degrees(np.arctan2(self.radial, self.axial))

    @property
    def delays(self) -> Floats:
        """Lengths of free flight at the final energy in the time that the lens adds [nm], shape (n,)."""
        return math.sqrt(2) * self.time - np.hypot(self.rho, self.z)


class Lens:
    """Solved charges of a specimen and its electrode for one radius of the apex.

    Potentials and fields are per unit of the voltage between both. The apex is at z = 0.

    Parameters
    ----------
    radius : float
        Radius of the cap [nm].
    flank : Flank
        The shank.
    distance, aperture : float
        Distance of the electrode from the apex, and radius of its aperture [nm].
    electrode_angle : float
        Half the opening angle of the electrode [rad].
    refinement : int
        Factor of the number of panels.
    """

    def __init__(
        self,
        radius: float,
        flank: Flank,
        distance: float,
        aperture: float,
        electrode_angle: float,
        refinement: int = 1,
    ) -> None:
        self.radius, self.distance, self.aperture = radius, distance, aperture
        self._charged = ChargedPanels(
            joined(specimen(radius, flank, refinement), electrode(distance, aperture, electrode_angle, refinement))
        )
        cap = slice(0, CAP_PANELS * refinement)
        rho, z = self._charged.middles[cap].T
        angles = np.arctan2(rho, z + radius)
        used = angles < _FIT
        fields = self._charged.surface_fields[cap]
        self._cap_field = np.polynomial.Polynomial.fit(angles[used] ** 2, fields[used], _ORDER)
        self._start = float(self._charged.lengths[0])  # closer to the surface the panels are visible

    @property
    def field_factor(self) -> float:
        """V / (F R) with the field F of the smooth apex."""
        return float(1 / (self._cap_field(0.0) * self.radius))

    def potential_and_field(self, points: Floats) -> tuple[Floats, Floats]:
        """Potential and field in the half plane.

        Parameters
        ----------
        points : ndarray
            Distances from the axis and from the apex along the axis [nm], shape (n, 2), outside the conductors.

        Returns
        -------
        potential : ndarray
            Per volt, shape (n,).
        field : ndarray
            Radial and axial [1/nm], shape (n, 2).
        """
        points = check_array(points, "points", ("n", 2))
        potential, radial, axial = self._charged.fields(np.abs(points[:, 0]), points[:, 1])
        return potential, np.column_stack([np.sign(points[:, 0]) * radial, axial])

    def along_axis(self, distances: Floats) -> tuple[Floats, Floats]:
        """Potential per volt and field [1/nm], shape (n,), at distances from the apex [nm], shape (n,)."""
        potential, field = self.potential_and_field(np.column_stack([np.zeros_like(distances), distances]))
        field = field[:, 1]
        near = distances < self._start
        if near.any():  # a cubic between the surface, whose potential and field are known, and the first good point
            edge, slope = self.potential_and_field(np.array([[0.0, self._start]]))
            share, length = distances[near] / self._start, self._start
            at, at_edge = -self._cap_field(0.0) * length, -float(slope[0, 1]) * length
            rise = float(edge[0]) - 1.0
            square, cube = 3 * rise - 2 * at - at_edge, at + at_edge - 2 * rise
            potential[near] = 1 + share * (at + share * (square + share * cube))
            field[near] = -(at + share * (2 * square + share * 3 * cube)) / length
        return potential, field

    def fly(
        self, angles: Floats, lateral: Floats | float = 0.0, *, height: float = 0.0, to_electrode: bool = False
    ) -> Flights:
        """Flights of ions from the cap.

        Parameters
        ----------
        angles : ndarray
            Angles of the launch on the cap from the axis [rad], shape (n,).
        lateral : ndarray or float
            Kinetic energy along the surface at launch, in units of n e V, away from the axis.
        height : float
            Height above the cap at which the ions start [nm].
        to_electrode : bool
            Whether the flights end before the electrode.

        Notes
        -----
        The equation of motion in the logarithm of the time, by `scipy.integrate.solve_ivp` (DOP853). The first 4 % of
        the radius are a series in the distance s from the surface. The field along it is s F' / R, with F' = dF /
        dtheta. An ion that starts at rest at the height h is displaced along it by (h (s - h) + (s - h)^2 / 6) F' / (R
        F), and its path has the inclination (s + 2 h) F' / (3 R F).
        """
        # from the cap to the distance s = start: series of the displacement along the surface and of the time,
        # t = sqrt(2 (s - h) / F) (1 + (s - h) / 6 R)
        radius, start, count = self.radius, max(self._start, 2 * height), len(angles)
        # first part of the path, where the elements of the surface are inaccurate: series in its length over the radius
        field = self._cap_field(angles**2)
        bend = 2 * angles * self._cap_field.deriv()(angles**2) / field / radius
        way = start - height
        time = np.sqrt(2 * way / field) * (1 + way / (6 * radius))
        speed = np.sqrt(2 * lateral) * np.ones(count)
        far = radius + start
        place = angles + bend * (height * way + way**2 / 6) / far + speed * time / radius * (1 - start / (1.5 * radius))
        rho, z = far * np.sin(place), far * np.cos(place) - radius

        # velocity at this distance: across by the angular momentum of the launch, which is conserved, and by the bent
        # path; outwards by the conservation of energy
        turning = speed * radius / far
        energy = 1 - height * field * (1 - height / radius) - self._charged.fields(np.abs(rho), z)[0] + lateral
        outwards = np.sqrt(2 * energy - turning**2)
        turning = turning + outwards * bend * (start + 2 * height) / 3
        outwards = np.sqrt(2 * energy - turning**2)
        velocity = outwards * np.array([np.sin(place), np.cos(place)]) + turning * np.array(
            [np.cos(place), -np.sin(place)]
        )
        state = np.concatenate([rho, z, *velocity])

        def change(logarithm, state):
            rho, z, radial, axial = state.reshape(4, count)
            _, outward, forward = self._charged.fields(np.abs(rho), z)
            # times are relative to those at the start, which differ slightly
            return (
                np.concatenate([radial, axial, np.sign(rho) * outward, forward])
                * np.tile(time, 4)
                * math.exp(logarithm)
            )

        def before_electrode(_, state):
            return state[count : 2 * count].max() - _CLEAR * self.distance

        before_electrode.terminal = to_electrode  # type: ignore[attr-defined]
        # equation of motion r'' = E(r) in the logarithm of the time, to far behind the electrode
        size = max(self.distance, self.aperture)
        last = math.log((self.distance + _END * size) / math.sqrt(2) / time.min())
        solved = scipy.integrate.solve_ivp(
            change,
            (0.0, last),
            state,
            method="DOP853",
            rtol=_TOLERANCE,
            atol=1e-9 * np.repeat([radius, 1.0], 2 * count),
            events=before_electrode if to_electrode else None,
        )
        rho, z, radial, axial = solved.y[:, -1].reshape(4, count)
        energy = (radial**2 + axial**2) / 2 + self._charged.fields(np.abs(rho), z)[0]
        return Flights(rho, z, radial, axial, time * math.exp(solved.t[-1]), energy)

    @cached_property
    def widest_angle(self) -> float:
        """Angle of the launch whose ion touches the aperture [degrees], at most `LAST_ANGLE`."""
        return min(LAST_ANGLE, float(np.interp(math.atan(self.aperture / self.distance), self._arrivals, _ANGLES)))

    @cached_property
    def _arrivals(self):
        """Angles, seen from the apex [rad], at which ions from _ANGLES reach the plane of the aperture."""
        flights = self.fly(np.radians(_ANGLES), to_electrode=True)
        rho = flights.rho + (self.distance - flights.z) * flights.radial / flights.axial
        return np.arctan(rho / self.distance)

    @cached_property
    def coefficients(self) -> Floats:
        """Coefficients of theta' / theta and of the delay [nm], each in powers of theta^2 [rad], shape (6,).

        The fit is to flights that pass the aperture. Farther out, where the electrode stops the ions, it continues
        smoothly.
        """
        passing = _ANGLES[np.tan(self._arrivals) < _CLEAR * self.aperture / self.distance]
        widest = min(float(passing[-1]) if len(passing) else _ANGLES[0], 45.0)
        angles = np.radians(np.linspace(widest / 7, widest, 7))
        flights = self.fly(angles)
        # an aperture that only small angles pass does not determine the third coefficient
        order = 1 if self.aperture < _NARROW * self.distance else 2
        ratio = np.polynomial.polynomial.polyfit(angles**2, np.radians(flights.angles) / angles, order)
        delay = np.polynomial.polynomial.polyfit(angles**2, flights.delays, order)
        return np.concatenate([np.pad(row, (0, 2 - order)) for row in (ratio, delay)])

    @property
    def compression(self) -> float:
        """Mean of theta / theta' for theta from 5 to 30 degrees."""
        square = _COMPRESSION**2
        zeroth, first, second = self.coefficients[:3]
        return float(np.mean(1 / (zeroth + square * (first + square * second))))


_ANGLES = np.linspace(7.0, 56.0, 8)
_NARROW = 0.36  # tan(20 degrees)
_COMPRESSION = np.radians(np.linspace(5.0, 30.0, 26))
