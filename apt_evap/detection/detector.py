"""The detector in front of the specimen, and where a flight that has left the field meets it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.small_matrices import squared_lengths
from apt_evap._common.types import Floats
from apt_evap._common.validation import check_choice, check_number
from apt_evap.detection.hits import Outcome
from apt_evap.detection.projection import Projection, along_axis, stereographic, stereographic_stretch
from apt_evap.units import NM_PER_MM

PROJECTIONS = {"plane": 1.0, "equidistant": None}
"""Image compression of each `Projection`; None is the azimuthal equidistant one."""


@dataclass(frozen=True)
class Detector:
    """A square detector, centred on the axis of the specimen.

    Parameters
    ----------
    distance : float
        From the apex to the detector [mm].
    width : float
        Edge of the square [mm].
    projection : str
        "plane": a flat detector, on which an ion at the polar angle theta lands at D tan(theta) from the centre, with D
        the distance. "equidistant": at D theta, the azimuthal equidistant projection that measured maps come close to,
        whose ions have passed a reflectron or a curved field; the time of flight is that to the sphere of radius D.

    Raises
    ------
    ValueError
        If a length is not above 0 or is above 1 km, or the projection is unknown.
    """

    distance: float = 100.0
    width: float = 300.0
    projection: str = "plane"

    def __post_init__(self):
        check_choice(self.projection, "projection", PROJECTIONS)
        for name in ("distance", "width"):
            # a kilometre is a slip of the unit
            checked = check_number(getattr(self, name), name, above=0, at_most=1e6, unit="mm")
            object.__setattr__(self, name, checked)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Where it reaches: x_min, x_max, y_min, y_max [mm]."""
        half = self.width / 2
        return -half, half, -half, half

    @property
    def seen_from_apex(self) -> Projection:
        """The projection of the directions in which ions fly, as seen from the apex, onto this detector."""
        return Projection(self.distance, compression=PROJECTIONS[self.projection])

    def directions(self, positions: Floats, velocities: Floats, apex: float) -> tuple[Floats, Floats]:
        """Directions in which ions meet the plane, as seen from the apex.

        The direction is given stereographically, s = tan(polar angle / 2) (cos, sin)(azimuth): it stays smooth and
        finite up to ions that fly along the plane and beyond, where the place on the plane does not.

        Parameters
        ----------
        positions, velocities : ndarray, shape (n, 3)
            At the end of the flights [nm], any unit.
        apex : float
            z of the apex [nm].

        Returns
        -------
        directions : ndarray, shape (n, 2)
            Stereographic directions.
        remaining : ndarray, shape (n,)
            Time from the end of the flight to the plane [nm over the unit of velocity]; infinite if it is never met.
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
        """Where and when ions meet the detector.

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
            An `Outcome` each.
        """
        s2 = squared_lengths(directions)
        ahead = s2 < 1.0
        with np.errstate(divide="ignore", invalid="ignore"):
            stretch = stereographic_stretch(s2, PROJECTIONS[self.projection])
            if self.projection == "equidistant":
                times = np.where(ahead, along_axis(times, s2), times)  # cos(theta) of the way to the plane
            scale = np.where(ahead, self.distance * stretch, np.nan)
        x, y = directions[:, 0] * scale, directions[:, 1] * scale
        outcome = np.full(len(x), Outcome.MISSED, np.int8)
        outcome[(np.abs(x) <= self.width / 2) & (np.abs(y) <= self.width / 2)] = Outcome.HIT
        outcome[np.isnan(s2)] = Outcome.NEVER_LEFT
        return x, y, times, outcome
