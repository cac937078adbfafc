"""Relative error of m/n along a spectrum: one smooth curve with its own uncertainty."""

import math
from collections.abc import Sequence

import numpy as np

from apt_evap._common.types import Floats

_COMMON = 0.004  # standard deviation of an error of all m/n
_SMOOTH, _LENGTH = 0.003, 0.7  # of one that changes along ln m/n, and over which distance; measured: H2+ lies 1.2 %
# and Si2+ 0.35 % beside their masses in one file


class MassCalibration:
    """Gaussian process in ln m/n of the relative error of m/n.

    Attributes
    ----------
    points : list of tuple
        What it learnt: m/n [Da], relative error, and its standard deviation.
    scatter : float
        Relative scatter of the peaks about the curve.
    """

    def __init__(self) -> None:
        self._logs = np.zeros(0)
        self.points: list[tuple[float, float, float]] = []
        self.scatter = 1e-4

    def learn(self, points: Sequence[tuple[float, float, float]]) -> None:
        """Learn from m/n [Da], relative errors and their standard deviations."""
        self.points = list(points)
        if not len(points):
            self._logs = np.zeros(0)
            return
        mass, shift, noise = np.array(points).T
        self._logs = np.log(mass)
        self._inverse = np.linalg.inv(self._covariance(self._logs) + np.diag(noise**2))
        self._weights = self._inverse @ shift

    def _covariance(self, logs):
        distance = (logs[:, None] - self._logs) / _LENGTH
        return _COMMON**2 + _SMOOTH**2 * np.exp(-0.5 * distance**2)

    def shift(self, mass: Floats | float) -> tuple[Floats, Floats]:
        """Relative error of m/n, and its standard deviation, at m/n [Da], shape (n,)."""
        logs = np.log(np.atleast_1d(np.asarray(mass, float)))
        if not len(self._logs):
            return np.zeros(len(logs)), np.full(len(logs), math.hypot(_COMMON, _SMOOTH))
        covariance = self._covariance(logs)
        variance = _COMMON**2 + _SMOOTH**2 - ((covariance @ self._inverse) * covariance).sum(1)
        return covariance @ self._weights, np.sqrt(np.maximum(variance, 0))

    def place(self, mass: Floats) -> Floats:
        """Measured m/n of ions of a mass-to-charge ratio [Da]."""
        return np.asarray(mass) * (1 + self.shift(mass)[0])
