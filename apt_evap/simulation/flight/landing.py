"""Straight flight to the detector: direction and time of flight."""

from typing import Any, NamedTuple

import numpy as np

from apt_evap._common.types import Booleans, Floats
from apt_evap.detection.detector import Detector


class Ends(NamedTuple):
    """Ends of the flights, outside the field: m launches of each of n ions."""

    positions: Floats
    """[nm], shape (n, m, 3); NaN where there was no flight."""
    velocities: Floats
    """[sqrt(V)], shape (n, m, 3)."""
    times: Floats
    """Reduced times [nm/sqrt(V)], shape (n, m)."""
    left: Booleans
    """Whether the ion left the field, shape (n, m)."""

    def rows(self, rows: Any) -> "Ends":
        """Ends of the launches of some of the ions."""
        return Ends(self.positions[rows], self.velocities[rows], self.times[rows], self.left[rows])


def land(ends: Ends, slowness: Floats, detector: Detector, apex: float) -> tuple[Floats, Floats]:
    """Continue m flights of each of n ions in a straight line from the end of the field to the detector.

    `slowness` (n,) is the time of flight per reduced time, see `Emissions.slowness`, `apex` the z of the apex [nm]. The
    results are stereographic directions (n, m, 2), see `Detector.directions`, and times of flight (n, m) [ns], NaN for
    an ion that never left.
    """
    n, m = ends.left.shape
    left = ends.left.ravel()
    directions, remaining = detector.directions(ends.positions.reshape(-1, 3), ends.velocities.reshape(-1, 3), apex)
    directions[~left] = np.nan
    times = np.where(left, (ends.times.ravel() + remaining) * np.repeat(slowness, m), np.nan)
    return directions.reshape(n, m, 2), times.reshape(n, m)
