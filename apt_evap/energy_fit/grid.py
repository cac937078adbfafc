"""Energies of a study: a grid of distributions for one mechanism, and the maximum between its points."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats, Integers
from apt_evap._common.validation import check_array, check_choice
from apt_evap.emission.energies import TruncatedNormal
from apt_evap.emission.perturbations import Combined, LateralVelocity, Perturbation, RollUp
from apt_evap.energy_fit.defaults import MEANS, MECHANISMS, ROLLUP_FRACTIONS, RSDS

_HALVES = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
_FINE = np.linspace(-1.0, 1.0, 41)


@dataclass(frozen=True)
class EnergyGrid:
    """Grid of truncated normal energy distributions, by mean and relative standard deviation, for one mechanism.

    Parameters
    ----------
    mechanism : {"roll-up", "lateral", "combined"}
        Mechanism of emission: `RollUp`, `LateralVelocity` or `Combined`.
    means : tuple of float
        Means before the truncation [eV], increasing.
    rsds : tuple of float
        Standard deviations before the truncation, relative to the means, increasing.
    rollup_fractions : tuple of float, optional
        Fractions of the energy for the roll-up, increasing; only for "combined".

    Raises
    ------
    ValueError
        If the mechanism is unknown, or an axis is empty, not increasing or outside its range.
    """

    mechanism: str
    means: Sequence[float] = MEANS
    rsds: Sequence[float] = RSDS
    rollup_fractions: Sequence[float] = None  # type: ignore[assignment]  # the mechanism sets them

    def __post_init__(self):
        check_choice(self.mechanism, "mechanism", MECHANISMS)
        fractions = self.rollup_fractions
        if self.mechanism == "combined":
            fractions = ROLLUP_FRACTIONS if fractions is None else fractions
        elif fractions is not None:
            raise ValueError(f"rollup_fractions are only for the mechanism 'combined', got {self.mechanism!r}")
        else:
            fractions = (1.0,) if self.mechanism == "roll-up" else (0.0,)
        for name, values, low, high in (
            ("means", self.means, np.nextafter(0, 1), np.inf),
            ("rsds", self.rsds, np.nextafter(0, 1), np.inf),
            ("rollup_fractions", fractions, 0.0, 1.0),
        ):
            axis = check_array(values, name, ("n",))
            if not (len(axis) and (np.diff(axis) > 0).all() and low <= axis[0] and axis[-1] <= high):
                bounds = "from 0 to 1" if high == 1 else "> 0"
                raise ValueError(f"{name} must be increasing numbers {bounds}, got {axis.tolist()}")
            object.__setattr__(self, name, tuple(axis.tolist()))

    @property
    def shape(self) -> tuple[int, int, int]:
        """Numbers of roll-up fractions, relative standard deviations and means."""
        return len(self.rollup_fractions), len(self.rsds), len(self.means)

    @property
    def cells(self) -> list[tuple[int, ...]]:
        """Index (fraction, rsd, mean) of every point of the grid, list of tuple."""
        return list(product(*map(range, self.shape)))

    def values_at(self, index: ArrayLike) -> Floats:
        """Roll-up fraction, relative standard deviation and mean [eV] at an index, also between points.

        Parameters
        ----------
        index : array_like
            Positions on the three axes in steps of the grid, shape (..., 3).

        Returns
        -------
        ndarray
            Shape (..., 3). Interpolation between points is geometric for the relative standard deviation, and linear
            for the others.
        """
        places = np.moveaxis(np.asarray(index, float), -1, 0)
        axes = np.array(self.rollup_fractions), np.log(self.rsds), np.array(self.means)
        fraction, rsd, mean = (np.interp(p, np.arange(len(a)), a) for p, a in zip(places, axes, strict=True))
        nearest = np.rint(places[1]).astype(int)
        # exact values at the points of the grid, to the last bit
        rsd = np.where(places[1] == nearest, np.array(self.rsds)[nearest], np.exp(rsd))
        return np.stack([fraction, rsd, mean], axis=-1)

    def perturbation(self, fraction: float, rsd: float, mean: float) -> Perturbation:
        """Perturbation with a roll-up fraction, a relative standard deviation and a mean [eV]."""
        energy = TruncatedNormal(float(mean), float(rsd * mean))
        if self.mechanism == "combined":
            return Combined(energy, float(fraction))
        return (RollUp if self.mechanism == "roll-up" else LateralVelocity)(energy)

    def share_above(self, energy: float) -> Floats:
        """Fraction of the ions above an energy [eV] at every point of the grid, shape `shape`."""
        means, rsds = np.array(self.means), np.array(self.rsds)[:, None]
        fraction = scipy.special.ndtr((means - energy) / (rsds * means)) / scipy.special.ndtr(1 / rsds)
        return np.broadcast_to(fraction, self.shape)

    def around(self, cell: tuple[int, ...]) -> list[Floats]:
        """Half steps within one step of a point of the grid on every axis, shifted inwards at the ends.

        Parameters
        ----------
        cell : tuple of int
            Index of the point.

        Returns
        -------
        list of ndarray
            Positions on the three axes in steps of the grid: five, or only that of the point on an axis of less than
            three.
        """
        return [
            np.clip(at, 1, number - 2) + _HALVES if number >= 3 else np.array([float(at)])
            for at, number in zip(cell, self.shape, strict=True)
        ]


def maxima(values: Floats) -> Integers:
    """Indices of the largest value in each of k matrices, shape (k, a, b, c); int of shape (k, 3)."""
    return np.stack(np.unravel_index(values.reshape(len(values), -1).argmax(axis=1), values.shape[1:]), axis=1)


def spline_maxima(places: list[Floats], values: Floats) -> Floats:
    """Maxima of cubic splines through the points of `EnergyGrid.around`, to 1/20 of a step.

    Parameters
    ----------
    places : list of ndarray
        Positions on the three axes, five or one.
    values : ndarray
        Values at these positions, shape (k, a, b, c).

    Returns
    -------
    ndarray
        Positions of the k maxima, shape (k, 3).
    """
    spline, fine = scipy.interpolate.make_interp_spline(_HALVES, np.eye(5))(_FINE), []
    for axis, along in enumerate(places):
        fine.append(along if len(along) == 1 else along[2] + _FINE)
        if len(along) > 1:
            values = np.moveaxis(np.tensordot(values, spline, axes=(axis + 1, 1)), -1, axis + 1)
    return np.stack([along[index] for along, index in zip(fine, maxima(values).T, strict=True)], axis=1)
