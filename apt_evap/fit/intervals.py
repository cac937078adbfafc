"""Intervals of the energies: all points whose similarity is not significantly below the largest one.

Energies with equal true means have similar maps, so that the similarity has a ridge; the intervals follow it to its
end. Two errors count.

*Noise* of measured and simulated ions. With a quadratic maximum, the similarity of the true point is below that of the
best one by half of the deviation of their difference times its quantile.

*The model*: the simulated specimen is not the measured one. Its misfit |1 - SSIM| remains at the best point, and at the
true point it is larger by a fraction of that, which was measured with twins (`defaults.MODEL_ERROR`): smaller for mean
energies than for their widths, which maps hardly see. The misfit of few ions is uncertain, and could be 0 by accident:
its largest value within the errors counts.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

from apt_evap._common.types import Booleans, Floats
from apt_evap.emission.energies import TruncatedNormal
from apt_evap.fit.grid import EnergyGrid

_MEANS = "mean", "true_mean"
_NARROW = 0.1  # relative standard deviation: below, energies differ by 10 %, speeds by 5 %, and maps do not change
_NORMAL = 1.96  # quantile of 95 %
_STEPS = 10  # of the interpolation in a step of the grid
_MOST = 50_000  # points of the interpolation


class Intervals(NamedTuple):
    """Intervals of 95 % by the name of the number."""

    bounds: dict[str, tuple[float, float]]
    """Lower and upper bound: of each axis of the grid, of "true_mean" and of "true_standard_deviation"."""
    open_ends: dict[str, tuple[bool, bool]]
    """Whether the lower and the upper bound are ends of the grid, so that the interval may continue beyond it."""


def intervals(
    grid: EnergyGrid,
    similarities: Floats,
    best: Sequence[float],
    error_of_means: float,
    error_of_others: float | None = None,
) -> Intervals:
    """Intervals of the energies and options of a study.

    Parameters
    ----------
    grid : EnergyGrid
        The grid.
    similarities : ndarray
        Similarities of all ions and of each resample on the grid, shape (1 + resamples, *grid.shape).
    best : sequence of float
        Position of the refined optimum in steps of the grid; the intervals contain it.
    error_of_means, error_of_others : float
        Relative increase of the misfit for the error of the model: for "mean" and "true_mean", and for all other
        numbers; the same by default.

    Returns
    -------
    Intervals
    """
    places, fine = _interpolated(grid, similarities)
    first, resamples = fine[0], fine[1:]
    top = np.unravel_index(first.argmax(), first.shape)
    deficit = first[top] - first
    misfit = abs(1.0 - float(first[top]))
    noise = np.zeros(first.shape)
    if len(resamples) > 1:
        at_top = resamples[(slice(None), *top)].reshape(-1, *[1] * first.ndim)
        misfit += _NORMAL * float(at_top.std(ddof=1))
        noise = 0.5 * _NORMAL * (at_top - resamples).std(axis=0, ddof=1)
    means = _bounds(grid, places, deficit <= error_of_means * misfit + noise, best)
    if error_of_others is None or error_of_others == error_of_means:
        return means
    others = _bounds(grid, places, deficit <= error_of_others * misfit + noise, best)
    chosen = {name: means if name in _MEANS else others for name in others.bounds}
    return Intervals(
        {name: interval.bounds[name] for name, interval in chosen.items()},
        {name: interval.open_ends[name] for name, interval in chosen.items()},
    )


def _interpolated(grid, values):
    """Positions on each axis, and values at them by splines of at most third order; shape (k, ...)."""
    shape = grid.shape
    steps = _STEPS
    while steps > 1 and np.prod([(number - 1) * steps + 1 for number in shape]) > _MOST:
        steps -= 1
    places = []
    for axis, number in enumerate(shape):
        along = np.linspace(0, number - 1, (number - 1) * steps + 1)
        if number > 1:
            spline = scipy.interpolate.make_interp_spline(np.arange(number), np.eye(number), k=min(3, number - 1))
            values = np.moveaxis(np.tensordot(values, spline(along), axes=(axis + 1, 1)), -1, axis + 1)
        places.append(along)
    return places, values


def _bounds(grid: EnergyGrid, places: list[Floats], inside: Booleans, best: Sequence[float]) -> Intervals:
    """Smallest and largest value of each number inside the region, which is extended to the best point."""
    names, bounds, ends = list(grid.axes), {}, {}
    open_axes = [_open_ends(grid, axis) for axis in range(inside.ndim)]
    along = []
    for axis, (name, numbers) in enumerate(grid.axes.items()):
        others = tuple(other for other in range(inside.ndim) if other != axis)
        reached = places[axis][inside.any(axis=others)]
        low, high = min(reached[0], best[axis]), max(reached[-1], best[axis])
        index = np.zeros((2, len(names)))
        index[:, axis] = low, high
        values = grid.values_at(index)[:, axis]
        bounds[name] = (float(values[0]), float(values[1]))
        ends[name] = bool(low == 0 and open_axes[axis][0]), bool(high == len(numbers) - 1 and open_axes[axis][1])
        along.append(values)
    index = np.zeros((len(places[-2]), len(places[-1]), len(names)))
    index[..., -2], index[..., -1] = np.meshgrid(places[-2], places[-1], indexing="ij")
    energies = grid.values_at(index)
    allowed = inside.any(axis=tuple(range(inside.ndim - 2)))
    relative_spread, mean = energies[allowed][:, -2], energies[allowed][:, -1]
    at = grid.values_at(np.asarray(best, float))
    distributions = [
        TruncatedNormal(m, r * m) for r, m in zip([*relative_spread, at[-2]], [*mean, at[-1]], strict=True)
    ]
    edge = np.zeros(allowed.shape, bool)
    for part, (low_end, high_end) in zip((edge, edge.T), open_axes[-2:], strict=True):
        part[0] |= low_end
        part[-1] |= high_end
    at_edge = edge[allowed]
    for name in ("true_mean", "true_standard_deviation"):
        values = np.array([getattr(energy, name) for energy in distributions])
        order = int(values.argmin()), int(values.argmax())
        bounds[name] = (float(values[order[0]]), float(values[order[1]]))
        ends[name] = tuple(bool(at < len(at_edge) and at_edge[at]) for at in order)  # type: ignore[assignment]
    return Intervals(bounds, ends)


def _open_ends(grid, axis):
    """Whether an axis could continue beyond its ends: not if it is fixed, or if the physics ends there."""
    name, numbers = list(grid.axes.items())[axis]
    if len(numbers) == 1:
        return False, False
    ends = []
    for end, beyond in ((0, 1), (-1, -2)):
        step = 1e-3 * (numbers[end] - numbers[beyond])
        values = [numbers[0] for numbers in grid.axes.values()]
        values[axis] = numbers[end] + step
        try:
            grid.perturbation(*values)
            ends.append(True)
        except ValueError:
            ends.append(False)
    return (ends[0] and not (name == "relative_spread" and numbers[0] <= _NARROW)), ends[1]
