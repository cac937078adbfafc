"""Errors of reconstructed positions against the true sites of the ions."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats, Integers
from apt_evap._common.validation import check_array, check_choice, check_sequence
from apt_evap.detection.hits import Hits
from apt_evap.simulation.run import Run

FREE = ("shift", "rotation", "lateral_scale", "depth_scale")
"""Constants that can be fitted before positions are compared with sites."""

_RING = 5.0  # width of a ring of angles [degrees]
_DEPTH_BINS = 10
_CYLINDER = 2.0  # diameter of the cylinders for the order of depths [nm]
_LEAST_IONS = 10  # fewest ions for the correlation in a cylinder


class ErrorBins(NamedTuple):
    """Errors in bins of the angle or of the depth."""

    edges: Floats
    """Edges of the bins [degrees] or [nm], shape (n + 1,)."""
    ions: Integers
    """Number of ions in each bin, shape (n,)."""
    lateral: Floats
    """RMS of the lateral error in each bin [nm], shape (n,); NaN without ions."""
    depth: Floats
    """RMS of the depth error in each bin [nm], shape (n,); NaN without ions."""


@dataclass(frozen=True, eq=False)
class ReconstructionErrors:
    """Fitted constants, and residuals of the fitted positions from the true sites.

    The fitted position of an ion at x, y and depth z is (lateral_scale Rot(rotation) (x, y), -depth_scale z) + shift.

    Parameters
    ----------
    shift : ndarray
        Shift [nm], shape (3,).
    rotation : float
        Rotation about the axis [degrees].
    lateral_scale, depth_scale : float
        Factor of x and y, and of the depth.
    residuals : ndarray
        Fitted position minus true site [nm], shape (n, 3).
    lateral_rms : float
        RMS of the lateral residual, the length of its x and y [nm].
    depth_rms : float
        RMS of the residual along the axis [nm].
    order_correlation : float
        Spearman correlation of true and reconstructed depth within cylinders of 2 nm diameter, mean over the ions. NaN
        if no cylinder has 10 ions of different depths.
    cylinders : int
        Number of these cylinders.
    by_angle, by_depth : ErrorBins
        Errors in rings of 5 degrees on the cap, and in ten bins of the reconstructed depth.
    """

    shift: Floats = field(repr=False)
    rotation: float
    lateral_scale: float
    depth_scale: float
    residuals: Floats = field(repr=False)
    lateral_rms: float
    depth_rms: float
    order_correlation: float
    cylinders: int
    by_angle: ErrorBins = field(repr=False)
    by_depth: ErrorBins = field(repr=False)

    def to_dict(self) -> dict[str, Any]:
        """All but the residuals as numbers and lists, None for NaN, for JSON.

        Returns
        -------
        dict
        """
        names = ("rotation", "lateral_scale", "depth_scale", "lateral_rms", "depth_rms", "order_correlation")
        content: dict[str, Any] = {"shift": _plain(self.shift)}
        content |= {name: _plain([getattr(self, name)])[0] for name in names}
        content["cylinders"] = self.cylinders
        for name in ("by_angle", "by_depth"):
            content[name] = {part: _plain(values) for part, values in getattr(self, name)._asdict().items()}
        return content


def true_sites(hits: Hits, truth: "Run | ArrayLike | None") -> Floats:
    """Sites of reconstructed ions [nm], shape (n, 3); `truth` as for `Reconstruction.errors`."""
    if isinstance(truth, Run):
        (numbers,) = hits.require("ion")
        known = truth.emissions.ions
        order = np.argsort(known)
        place = np.minimum(np.searchsorted(known, numbers, sorter=order), len(known) - 1) if len(known) else numbers
        if not len(known) or not np.array_equal(known[order[place]], numbers):
            raise ValueError(f"truth must be the run of these hits, got {truth!r} without some of their ions")
        return truth.emissions.positions[order[place]]
    if truth is None:
        if hits.outcome is None or hits.positions is None:
            raise ValueError("truth is needed for hits that were not simulated: sites of shape (n, 3), got None")
        truth = hits.positions
    return check_array(truth, "truth", (len(hits), 3))


def errors_of(positions: Floats, angles: Floats, truth: Floats, fit: Sequence[str] = FREE) -> ReconstructionErrors:
    """Fit the free constants and compare positions with sites.

    Parameters
    ----------
    positions : ndarray
        x, y and depth z [nm], shape (n, 3).
    angles : ndarray
        Angles on the cap [degrees], shape (n,).
    truth : ndarray
        Sites [nm], shape (n, 3), with z out of the specimen.
    fit : sequence of str
        Constants that are fitted, of `FREE`.

    Returns
    -------
    ReconstructionErrors
    """
    free = {check_choice(name, "fit", FREE) for name in check_sequence(fit, "fit", "names of free constants")}
    n = len(positions)
    if n < 3:
        raise ValueError(f"errors need at least 3 ions, got {n}")
    lateral, x_shift, y_shift = _lateral_fit(positions, truth, free)
    depth, z_shift = _depth_fit(positions[:, 2], truth[:, 2], free)
    turned = lateral * (positions[:, 0] + 1j * positions[:, 1])
    fitted = np.column_stack([turned.real + x_shift, turned.imag + y_shift, z_shift - depth * positions[:, 2]])
    residuals = fitted - truth
    squares = np.column_stack([(residuals[:, :2] ** 2).sum(axis=1), residuals[:, 2] ** 2])
    rings = _RING * np.arange(max(1, math.ceil(angles.max() / _RING)) + 1)
    layers = np.linspace(positions[:, 2].min(), positions[:, 2].max(), _DEPTH_BINS + 1)
    correlation, cylinders = _order_correlation(positions, truth)
    across, along = np.sqrt(squares.mean(axis=0))
    # a lateral scale without rotation can be negative: the sign is then part of the scale
    rotation = math.degrees(math.atan2(lateral.imag, lateral.real)) if "rotation" in free else 0.0
    return ReconstructionErrors(
        shift=np.array([x_shift, y_shift, z_shift]),
        rotation=rotation,
        lateral_scale=abs(lateral) if "rotation" in free else lateral.real,
        depth_scale=depth,
        residuals=residuals,
        lateral_rms=float(across),
        depth_rms=float(along),
        order_correlation=correlation,
        cylinders=cylinders,
        by_angle=_binned(angles, rings, squares),
        by_depth=_binned(positions[:, 2], layers, squares),
    )


def _lateral_fit(positions, truth, free):
    """Complex factor and shift of x + i y by least squares."""
    ours, sites = (points[:, 0] + 1j * points[:, 1] for points in (positions, truth))
    centre, goal = (ours.mean(), sites.mean()) if "shift" in free else (0.0, 0.0)
    size = float((np.abs(ours - centre) ** 2).sum())
    factor = complex(np.vdot(ours - centre, sites - goal)) / size if size > 0 else 1 + 0j
    if "rotation" not in free:
        factor = complex(factor.real)
    if "lateral_scale" not in free:
        factor = factor / abs(factor) if "rotation" in free and factor else 1 + 0j
    shift = complex(goal - factor * centre)
    return factor, shift.real, shift.imag


def _depth_fit(depth, height, free):
    """Factor and shift of the depth by least squares: height = shift - factor depth."""
    centre, goal = (depth.mean(), height.mean()) if "shift" in free else (0.0, 0.0)
    size = float(((depth - centre) ** 2).sum())
    factor = -float((depth - centre) @ (height - goal)) / size if "depth_scale" in free and size > 0 else 1.0
    return factor, float(goal + factor * centre)


def _order_correlation(positions, truth):
    """Mean Spearman correlation of the depths within cylinders on a square grid, and the number of cylinders."""
    cells = np.floor(truth[:, :2] / _CYLINDER)
    offset = truth[:, :2] - (cells + 0.5) * _CYLINDER
    inside = np.flatnonzero((offset**2).sum(axis=1) <= (_CYLINDER / 2) ** 2)
    _, labels, counts = np.unique(cells[inside], axis=0, return_inverse=True, return_counts=True)
    members = np.split(inside[np.argsort(labels.ravel(), kind="stable")], np.cumsum(counts)[:-1])
    correlations, weights = [], []
    for ions in members:
        depths = -truth[ions, 2], positions[ions, 2]
        if len(ions) >= _LEAST_IONS and all(np.ptp(values) > 0 for values in depths):
            correlations.append(scipy.stats.spearmanr(*depths).statistic)
            weights.append(len(ions))
    if not weights:
        return math.nan, 0
    return float(np.average(correlations, weights=weights)), len(weights)


def _binned(values, edges, squares):
    """Root of the mean squares in bins; the last edge is included."""
    n = len(edges) - 1
    bins = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, n - 1)
    ions = np.bincount(bins, minlength=n)
    with np.errstate(invalid="ignore"):
        lateral, depth = (np.sqrt(np.bincount(bins, part, minlength=n) / ions) for part in squares.T)
    return ErrorBins(edges, ions, lateral, depth)


def _plain(values):
    """List of numbers, None for NaN."""
    return [None if value != value else value for value in np.asarray(values).tolist()]
