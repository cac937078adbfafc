"""Energies of a study: a grid of distributions for one mechanism, and the maximum between its points."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import product

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.codec import checked, settings
from apt_evap._common.types import Floats, Integers
from apt_evap._common.validation import check_array, check_choice, check_kind, short_text
from apt_evap.emission.energies import TruncatedNormal
from apt_evap.emission.perturbations import Combined, LateralVelocity, Perturbation, RollUp

MEANS = (0.01, 0.0825, 0.155, 0.2275, 0.3, 0.3725)
"""Means of the grid of Shaikh et al. (2025) [eV]: from 0.01 to 0.3725 in even steps."""
RSDS = (0.01, 0.0316, 0.1, 0.316, 1.0, 3.16)
"""Relative standard deviations of the grid of Shaikh et al. (2025): from 0.01 to 3.16, two per decade."""
ROLLUP_FRACTIONS = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Roll-up fractions of the energy in the grid of Shaikh et al. (2025)."""

MECHANISMS = ("roll-up", "lateral", "combined")
"""Mechanisms of emission: `RollUp`, `LateralVelocity` or `Combined`."""

_RESERVED = ("energy", "mean", "relative_spread", "rollup_fraction", "true_mean", "true_standard_deviation")
_HALVES = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
_FINE = np.linspace(-1.0, 1.0, 41)


def _mechanism(mechanism, name):
    return mechanism if callable(mechanism) else check_choice(mechanism, name, MECHANISMS)


def _increasing(values, name):
    """Increasing numbers."""
    axis = check_array(values, name, ("n",))
    if not (len(axis) and (np.diff(axis) > 0).all()):
        raise ValueError(f"{name} must be increasing numbers, got {short_text(axis.tolist())}")
    return tuple(axis.tolist())


def _positive(values, name):
    axis = _increasing(values, name)
    if not axis[0] > 0:
        raise ValueError(f"{name} must be increasing numbers > 0, got {short_text(list(axis))}")
    return axis


def _fractions(values, name):
    axis = _increasing(values, name)
    if not 0 <= axis[0] <= axis[-1] <= 1:
        raise ValueError(f"{name} must be increasing numbers from 0 to 1, got {short_text(list(axis))}")
    return axis


def _options(options, name):
    axes = {}
    for option, values in check_kind(options, name, Mapping, "a mapping of names to numbers").items():
        check_kind(option, f"a name in {name}", str, "text")
        if option in _RESERVED:
            raise ValueError(f"{name} must not contain {short_text(option)}: it has its own argument")
        axes[option] = _increasing(values, f"option {option}")
    return axes


@settings
class EnergyGrid:
    """Grid of truncated normal energy distributions, by mean and relative standard deviation, for one mechanism."""

    mechanism: str | Callable[..., Perturbation] = checked(
        "Mechanism of emission: `RollUp`, `LateralVelocity` or `Combined`. Also a function of an energy distribution "
        "and of the options by name that returns a perturbation, such as a class of perturbations.",
        '{"roll-up", "lateral", "combined"} or callable',
        _mechanism,
        default="roll-up",
    )
    means: Sequence[float] = checked(
        "Means before the truncation, increasing. The default is that of Shaikh et al. (2025).",
        "sequence of float",
        _positive,
        default=MEANS,
        unit="eV",
    )
    relative_spreads: Sequence[float] = checked(
        "Standard deviations before the truncation, relative to the means, increasing. The default is that of Shaikh "
        "et al. (2025).",
        "sequence of float",
        _positive,
        default=RSDS,
    )
    rollup_fractions: Sequence[float] | None = checked(
        'Fractions of the energy for the roll-up, increasing; only for "combined". By default 0, 0.25, 0.5, 0.75 and '
        "1, those of Shaikh et al. (2025).",
        "sequence of float",
        _fractions,
        default=None,
    )
    options: Mapping[str, Sequence[float]] = checked(
        "More axes of the grid: options of the perturbation by name, each with increasing numbers.",
        "mapping",
        _options,
        default={},
        hash=False,
    )

    def _check(self):
        fixed = (0.0,) if self.mechanism == "lateral" else (1.0,)
        fractions = self.rollup_fractions
        if self.mechanism == "combined":
            fractions = ROLLUP_FRACTIONS if fractions is None else fractions
        elif fractions not in (None, fixed):
            raise ValueError(f"rollup_fractions are only for the mechanism 'combined', got {self.name!r}")
        object.__setattr__(self, "rollup_fractions", fractions or fixed)
        for end in (0, -1):  # the perturbation validates its own options
            try:
                self.perturbation(*(axis[end] for axis in self.axes.values()))
            except TypeError as error:
                raise ValueError(f"options must be those of the mechanism {self.name!r}: {error}") from error

    @property
    def name(self) -> str:
        """Name of the mechanism."""
        return self.mechanism if isinstance(self.mechanism, str) else getattr(self.mechanism, "__name__", "own")

    @property
    def axes(self) -> dict[str, Sequence[float]]:
        """Numbers on each axis by name: the options, then "rollup_fraction", "relative_spread" and "mean", dict."""
        last = {
            "rollup_fraction": self.rollup_fractions or (),
            "relative_spread": self.relative_spreads,
            "mean": self.means,
        }
        return {**self.options, **last}

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of points on each axis: options, roll-up fractions, relative standard deviations, means."""
        return tuple(map(len, self.axes.values()))

    @property
    def cells(self) -> list[tuple[int, ...]]:
        """Index (options, fraction, relative_spread, mean) of every point of the grid, list of tuple."""
        return list(product(*map(range, self.shape)))

    @property
    def layers(self) -> list[str]:
        """Title of each matrix of energies: the roll-up fraction and the options, if there are several, list of str."""
        leading = dict(list(self.axes.items())[:-2])
        shown = [name for name, values in leading.items() if len(values) > 1 and name != "rollup_fraction"]
        shown += ["rollup_fraction"] * (self.mechanism == "combined")
        titles = []
        for values in product(*leading.values()):
            named = dict(zip(leading, values, strict=True))
            titles.append(", ".join(f"{name.replace('rollup_', 'roll-up ')} {named[name]:g}" for name in shown))
        return titles

    def values_at(self, index: ArrayLike) -> Floats:
        """Options, roll-up fraction, relative standard deviation and mean [eV] at an index, also between points.

        Parameters
        ----------
        index : array_like
            Positions on the axes in steps of the grid, shape (..., number of axes).

        Returns
        -------
        ndarray
            Shape as `index`. Interpolation between points is geometric for the relative standard deviation, and linear
            for the others.
        """
        places = np.moveaxis(np.asarray(index, float), -1, 0)
        values = []
        for place, (name, axis) in zip(places, self.axes.items(), strict=True):
            points = np.arange(len(axis))
            value = np.interp(place, points, np.log(axis) if name == "relative_spread" else axis)
            if name == "relative_spread":
                nearest = np.rint(place).astype(int)
                # exact values at the points of the grid, to the last bit
                value = np.where(place == nearest, np.array(axis)[nearest], np.exp(value))
            values.append(value)
        return np.stack(values, axis=-1)

    def perturbation(self, *values: float) -> Perturbation:
        """Perturbation for options, a roll-up fraction, a relative standard deviation and a mean [eV]."""
        *options, fraction, relative_spread, mean = (float(value) for value in values)
        energy = TruncatedNormal(mean, relative_spread * mean)
        named = dict(zip(self.options, options, strict=True))
        if callable(self.mechanism):
            return self.mechanism(energy, **named)
        if self.mechanism == "combined":
            return Combined(energy, rollup_fraction=fraction, **named)
        return (RollUp if self.mechanism == "roll-up" else LateralVelocity)(energy, **named)

    def share_above(self, energy: float) -> Floats:
        """Fraction of the ions above an energy [eV] at every point of the grid, shape `shape`."""
        means, relative_spreads = np.array(self.means), np.array(self.relative_spreads)[:, None]
        fraction = scipy.special.ndtr((means - energy) / (relative_spreads * means)) / scipy.special.ndtr(
            1 / relative_spreads
        )
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
            Positions on the axes in steps of the grid: five, or only that of the point on an axis of less than
            three.
        """
        return [
            np.clip(at, 1, number - 2) + _HALVES if number >= 3 else np.array([float(at)])
            for at, number in zip(cell, self.shape, strict=True)
        ]


def maxima(values: Floats) -> Integers:
    """Indices of the largest value in each of k matrices, shape (k, a, b, ...); int of shape (k, number of axes)."""
    return np.stack(np.unravel_index(values.reshape(len(values), -1).argmax(axis=1), values.shape[1:]), axis=1)


def spline_maxima(places: list[Floats], values: Floats) -> Floats:
    """Positions of the maxima of cubic splines through the points of `EnergyGrid.around`, to 1/20 of a step, (k, axes).

    `places` are positions on the axes, five or one, `values` those of the k splines at these, shape (k, a, b, ...).
    """
    spline, fine = scipy.interpolate.make_interp_spline(_HALVES, np.eye(5))(_FINE), []
    for axis, along in enumerate(places):
        fine.append(along if len(along) == 1 else along[2] + _FINE)
        if len(along) > 1:
            values = np.moveaxis(np.tensordot(values, spline, axes=(axis + 1, 1)), -1, axis + 1)
    return np.stack([along[index] for along, index in zip(fine, maxima(values).T, strict=True)], axis=1)
