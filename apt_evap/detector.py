"""The detector: a plane in front of the specimen, and where a flight that has left the field meets it."""

from dataclasses import dataclass

import numpy as np

from apt_evap._arrays import check_number
from apt_evap.hits import Outcome
from apt_evap.units import NM_PER_MM


@dataclass(frozen=True)
class Detector:
    """A square plane detector, centred on the axis of the specimen.

    Parameters
    ----------
    distance : float
        From the apex to the plane [mm].
    width : float
        Edge of the square [mm].

    Raises
    ------
    ValueError
        If a length is not above 0.
    """

    distance: float = 100.0
    width: float = 300.0

    def __post_init__(self):
        for name in ("distance", "width"):
            object.__setattr__(self, name, check_number(getattr(self, name), name, above=0, unit="mm"))

    def directions(self, positions, velocities, apex):
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
            directions = place[:, :2] / (np.linalg.norm(place, axis=1) + place[:, 2])[:, None]
        return directions, remaining

    def impacts(self, directions):
        """Where ions meet the plane.

        Parameters
        ----------
        directions : ndarray, shape (n, 2)
            Stereographic directions, see `directions`; NaN for an ion that never left.

        Returns
        -------
        x, y : ndarray, shape (n,)
            Detector coordinates [mm]; NaN for ions that do not fly towards the plane.
        outcome : ndarray of int8, shape (n,)
            An `Outcome` each.
        """
        s2 = np.einsum("ij,ij->i", directions, directions)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = np.where(s2 < 1.0, 2.0 * self.distance / (1.0 - s2), np.nan)
        x, y = directions[:, 0] * scale, directions[:, 1] * scale
        outcome = np.full(len(x), Outcome.MISSED, np.int8)
        outcome[(np.abs(x) <= self.width / 2) & (np.abs(y) <= self.width / 2)] = Outcome.HIT
        outcome[np.isnan(s2)] = Outcome.NEVER_LEFT
        return x, y, outcome
