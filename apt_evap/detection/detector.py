"""The detector, and the hits of straight flights onto it."""

import math

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.codec import choice, number, settings
from apt_evap._common.small_matrices import squared_lengths
from apt_evap._common.types import Floats
from apt_evap._core.elementary import arctangent
from apt_evap.detection.binning import bin_edges
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Outcome
from apt_evap.detection.projection import Projection, along_axis, stereographic, stereographic_stretch
from apt_evap.units import NM_PER_MM

PROJECTIONS = {"plane": 1.0, "equidistant": None}
"""Image compression of each `Projection`; None is the azimuthal equidistant one."""


@settings
class Detector:
    """Square detector, centred on the axis of the specimen.

    Examples
    --------
    >>> detector = ae.Detector(distance=90.0, width=80.0)
    >>> detector.extent  # mm
    (-40.0, 40.0, -40.0, 40.0)
    >>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1)), seed=1).run(100)
    >>> run.on_detector(detector).hits(ae.Unperturbed())  # without new flights
    <Hits: 100 ions, 22 detected from 'simulation, Unperturbed()'; x, y, time_of_flight, ...>
    """

    # more than 1 km is a wrong unit
    distance: float = number("Distance from the apex to the detector.", default=100.0, above=0, at_most=1e6, unit="mm")
    width: float = number("Edge of the square.", default=300.0, above=0, at_most=1e6, unit="mm")
    projection: str = choice(
        'Position of an ion at the polar angle theta. "plane": a flat detector at the distance D, at D tan(theta) from '
        'the centre. "equidistant": at D theta, the azimuthal equidistant projection. It approximates measured maps, '
        "whose ions pass a reflectron or a curved field. The time of flight is then that to the sphere of radius D.",
        PROJECTIONS,
        default="plane",
    )

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Area of the detector: x_min, x_max, y_min, y_max [mm]."""
        half = self.width / 2
        return -half, half, -half, half

    def polar_angle(self, radius: float) -> float:
        """Polar angle [degrees], at most 90, of the ions that arrive at this distance from the centre [mm]."""
        angle = radius / self.distance
        if self.projection == "plane":
            angle = float(arctangent(angle))
        return min(90.0, angle * (180.0 / math.pi))

    @property
    def half_angle(self) -> float:
        """Polar angle of the corners [degrees], at most 90."""
        # a little more, so that rounding leaves no corner outside
        return min(90.0, self.polar_angle(math.sqrt(0.5) * self.width) * (1.0 + 1e-9))

    def grid(self, bins: int) -> DetectorMap:
        """Empty map of the complete detector, for the `like` of other maps.

        Parameters
        ----------
        bins : int
            Number of bins along each side.

        Returns
        -------
        DetectorMap
            Without hits and without an outline: all bins are inside.

        Examples
        --------
        >>> ae.Detector(width=80.0).grid(200)
        <DetectorMap: 0 ions, 200 x 200 bins of 0.4 x 0.4 mm>
        """
        x_edges, y_edges = bin_edges(np.empty(0), np.empty(0), bins, self.extent)
        empty = np.zeros((len(y_edges) - 1, len(x_edges) - 1))
        return DetectorMap.from_array(empty, x_edges, y_edges, is_counts=True)

    @property
    def seen_from_apex(self) -> Projection:
        """Projection of flight directions, seen from the apex, onto this detector."""
        return Projection(self.distance, compression=PROJECTIONS[self.projection])

    def directions(self, positions: Floats, velocities: Floats, apex: float) -> tuple[Floats, Floats]:
        """Directions of the hits on the plane, seen from the apex.

        The directions are stereographic, s = tan(polar angle / 2) (cos, sin)(azimuth). They stay smooth and finite also
        for ions that fly parallel to the plane or away from it, where the position on the plane diverges.

        Parameters
        ----------
        positions, velocities : ndarray, shape (n, 3)
            At the end of the flights [nm], [any unit].
        apex : float
            z of the apex [nm].

        Returns
        -------
        directions : ndarray, shape (n, 2)
            Stereographic directions.
        remaining : ndarray, shape (n,)
            Time from the end of the flight to the plane [nm / unit of velocity]; infinite if the ion does not reach it.
        """
        plane = apex + self.distance * NM_PER_MM
        ahead = velocities[:, 2] > 0
        with np.errstate(divide="ignore", invalid="ignore"):
            remaining = np.where(ahead, (plane - positions[:, 2]) / velocities[:, 2], np.inf)
            place = np.where(
                ahead[:, None],
                (positions + velocities * np.where(ahead, remaining, 0.0)[:, None]) - (0, 0, apex),
                velocities,
            )
            return stereographic(place), remaining

    def impacts(self, directions: Floats, times: Floats) -> tuple[Floats, Floats, Floats, NDArray[np.int8]]:
        """Positions and times of the hits.

        Parameters
        ----------
        directions : ndarray, shape (n, 2)
            Stereographic directions, see `directions`; NaN for an ion that never left.
        times : ndarray, shape (n,)
            Times of flight to the plane [ns].

        Returns
        -------
        x, y : ndarray, shape (n,)
            Detector coordinates [mm]; NaN for ions that do not fly towards the plane.
        times : ndarray, shape (n,)
            Times of flight to the detector [ns].
        outcome : ndarray of int8, shape (n,)
            `Outcome` of each ion.
        """
        s2 = squared_lengths(directions)
        ahead = s2 < 1.0
        with np.errstate(divide="ignore", invalid="ignore"):
            stretch = stereographic_stretch(s2, PROJECTIONS[self.projection])
            if self.projection == "equidistant":
                times = np.where(ahead, along_axis(times, s2), times)  # cos(theta) of the path to the plane
            scale = np.where(ahead, self.distance * stretch, np.nan)
        x, y = directions[:, 0] * scale, directions[:, 1] * scale
        outcome = np.full(len(x), Outcome.MISSED, np.int8)
        outcome[(np.abs(x) <= self.width / 2) & (np.abs(y) <= self.width / 2)] = Outcome.HIT
        outcome[np.isnan(s2)] = Outcome.NEVER_LEFT
        return x, y, times, outcome
