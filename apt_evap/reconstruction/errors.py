"""Errors of reconstructed positions against the true sites of the ions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from apt_evap._common.codec import ForJson
from apt_evap._common.short_repr import short_repr
from apt_evap._common.types import Floats, Integers
from apt_evap._common.validation import check_array, check_choice, check_count, check_number, check_sequence, short_text
from apt_evap.detection.hits import Hits
from apt_evap.simulation.run import Run

CONSTANTS = ("shift", "rotation", "lateral_scale", "depth_scale", "radius", "compression")
"""Constants that can be fitted before positions are compared with sites."""
FREE = ("shift", "rotation", "depth_scale", "radius", "compression")
"""Those that are fitted by default."""
LINEAR = CONSTANTS[:4]
"""Those that move positions linearly."""
NEAR_POLES = (0.0, 1.0, 2.0, 3.0, 5.0, 8.0, 12.0)
"""Edges of the distance from the nearest pole [degrees]."""

_RING = 5.0  # width of a ring of angles [degrees]
_DEPTH_BINS = 10
_CYLINDER = 2.0  # diameter of the cylinders for the order of depths [nm]
_LEAST_IONS = 10  # fewest ions for the correlation in a cylinder


class ErrorBins(NamedTuple):
    """Errors in bins of the angle, of the depth, or of the distance from a pole."""

    edges: Floats
    """Edges of the bins [degrees] or [nm], shape (n + 1,)."""
    ions: Integers
    """Number of ions in each bin, shape (n,)."""
    lateral: Floats
    """RMS of the lateral error in each bin [nm], shape (n,); NaN without ions."""
    depth: Floats
    """RMS of the depth error in each bin [nm], shape (n,); NaN without ions."""

    def __repr__(self) -> str:
        return short_repr(self)


class GroupErrors(NamedTuple):
    """Errors of groups of ions, such as species or phases; each of the k groups has one row."""

    groups: Integers
    """Number of each group, shape (k,)."""
    ions: Integers
    """Number of ions, shape (k,)."""
    shift: Floats
    """Mean residual [nm], shape (k, 3)."""
    lateral: Floats
    """RMS of the lateral error [nm], shape (k,)."""
    depth: Floats
    """RMS of the depth error [nm], shape (k,)."""

    def __repr__(self) -> str:
        return short_repr(self)


@dataclass(frozen=True, eq=False)
class ErrorField:
    """Mean residual and scatter in cells of the angle on the cap and of the depth.

    Parameters
    ----------
    angle_edges, depth_edges : ndarray
        Edges of the n angles [degrees] and of the m depths [nm], shapes (n + 1,) and (m + 1,).
    ions : ndarray of int, shape (n, m)
        Number of ions in each cell.
    radial, azimuthal, depth : ndarray, shape (n, m)
        Mean residual [nm]: away from the axis, counter-clockwise about it, and along it out of the specimen; NaN
        without ions.
    lateral_scatter, depth_scatter : ndarray, shape (n, m)
        RMS deviation from these means [nm], across the axis and along it; NaN without ions.
    """

    angle_edges: Floats = field(repr=False)
    depth_edges: Floats = field(repr=False)
    ions: Integers = field(repr=False)
    radial: Floats = field(repr=False)
    azimuthal: Floats = field(repr=False)
    depth: Floats = field(repr=False)
    lateral_scatter: Floats = field(repr=False)
    depth_scatter: Floats = field(repr=False)

    def __repr__(self) -> str:
        n, m = self.ions.shape
        return f"<ErrorField: {self.ions.sum():,} ions in {n} x {m} cells of angle and depth>"


@dataclass(frozen=True, eq=False)
class ReconstructionErrors(ForJson):
    """Fitted constants, and residuals of the fitted positions from the true sites.

    The fitted position of an ion at x, y, at the depth h below an apex at the depth z, is (lateral_scale Rot(rotation)
    (x, y), -(depth_scale z + h)) + shift, with x, y, z and h for the fitted radius and compression.

    Parameters
    ----------
    shift : ndarray
        Shift [nm], shape (3,).
    rotation : float
        Rotation about the axis [degrees].
    lateral_scale, depth_scale : float
        Factor of x and y, and of the depth of the apex.
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
    directions : ndarray
        Unit vector from the centre of the cap to each ion, in the frame of the specimen, shape (n, 3).
    depths : ndarray
        Reconstructed depth of each ion [nm], shape (n,).
    radius_factor : float
        Factor of the radii of the cap.
    compression : float
        Image compression; NaN if it was not part of the comparison.
    by_group : GroupErrors or None
        Errors of groups of ions, such as species or phases.
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
    directions: Floats = field(repr=False)
    depths: Floats = field(repr=False)
    radius_factor: float = 1.0
    compression: float = math.nan
    by_group: GroupErrors | None = field(default=None, repr=False)
    _in_json = (
        *("shift", "rotation", "lateral_scale", "depth_scale", "radius_factor", "compression", "lateral_rms"),
        *("depth_rms", "order_correlation", "cylinders", "by_angle", "by_depth", "by_group"),
    )

    def __repr__(self) -> str:
        return (
            f"<ReconstructionErrors of {len(self.depths):,} ions: RMS {self.lateral_rms:.3g} nm lateral, "
            f"{self.depth_rms:.3g} nm in depth>"
        )

    def by_poles(self, poles: ArrayLike, edges: ArrayLike = NEAR_POLES) -> ErrorBins:
        """Errors in bins of the distance from the nearest pole.

        Parameters
        ----------
        poles : array_like
            Directions in the frame of the specimen, of any length, shape (m, 3).
        edges : array_like
            Edges of the bins [degrees], increasing, shape (n + 1,). Ions beyond the last edge are left out.

        Returns
        -------
        ErrorBins

        Raises
        ------
        ValueError
            If there is no pole, a direction is zero, or the edges do not increase.
        """
        normals = check_array(poles, "poles", ("m", 3))
        lengths = np.linalg.norm(normals, axis=1)
        if not len(normals) or not lengths.all():
            raise ValueError(f"poles must be directions, got {short_text(poles)}")
        bounds = check_array(edges, "edges", ("n",))
        if len(bounds) < 2 or not (np.diff(bounds) > 0).all():
            raise ValueError(f"edges must be at least two increasing numbers [degrees], got {short_text(edges)}")
        # by the chord: the arc cosine has no digits near a pole
        chords, _ = scipy.spatial.cKDTree(normals / lengths[:, None]).query(self.directions)
        distances = np.degrees(2 * np.arcsin(np.minimum(chords / 2, 1.0)))
        inside = (distances >= bounds[0]) & (distances <= bounds[-1])
        return _binned(distances[inside], bounds, _squares(self.residuals[inside]))

    def residual_field(self, angle_width: float = 1.0, depth_bins: int = _DEPTH_BINS) -> ErrorField:
        """Mean residual and scatter in cells of the angle on the cap and of the depth.

        Parameters
        ----------
        angle_width : float
            Width of the bins of the angle [degrees].
        depth_bins : int
            Number of bins of the reconstructed depth.

        Returns
        -------
        ErrorField
        """
        width = check_number(angle_width, "angle_width", above=0, at_most=90, unit="degrees")
        depth_bins = check_count(depth_bins, "depth_bins", at_least=1, at_most=10_000)
        angles = _polar(self.directions)
        angle_edges = width * np.arange(max(1, math.ceil(float(angles.max()) / width)) + 1)
        depth_edges = np.linspace(self.depths.min(), self.depths.max(), depth_bins + 1)
        cells = _bins_of(angles, angle_edges) * depth_bins + _bins_of(self.depths, depth_edges)
        shape = len(angle_edges) - 1, depth_bins
        ions = np.bincount(cells, minlength=shape[0] * depth_bins)
        away = _unit(self.directions[:, 0] + 1j * self.directions[:, 1])
        lateral = (self.residuals[:, 0] + 1j * self.residuals[:, 1]) * away.conj()
        parts = lateral.real, lateral.imag, self.residuals[:, 2]
        with np.errstate(invalid="ignore"):
            means = [np.bincount(cells, part, len(ions)) / ions for part in parts]
            variances = [
                np.bincount(cells, (part - mean[cells]) ** 2, len(ions)) / ions
                for part, mean in zip(parts, means, strict=True)
            ]
        scatter = np.sqrt(variances[0] + variances[1]), np.sqrt(variances[2])
        tables = [values.reshape(shape) for values in (ions, *means, *scatter)]
        return ErrorField(angle_edges, depth_edges, *tables)  # type: ignore[arg-type]


def true_sites(hits: Hits, truth: Run | ArrayLike | None) -> Floats:
    """Sites of reconstructed ions [nm], shape (n, 3); `truth` as for `Reconstruction.errors`."""
    if isinstance(truth, Run):
        return truth.emissions.positions[rows_of(hits, truth)]
    if truth is None:
        if hits.outcome is None or hits.positions is None:
            raise ValueError("truth is needed for hits that were not simulated: sites of shape (n, 3), got None")
        truth = hits.positions
    return check_array(truth, "truth", (len(hits), 3))


def rows_of(hits: Hits, run: Run) -> Integers:
    """Row of each hit in its run, shape (n,)."""
    (numbers,) = hits.require("ion")
    known = run.emissions.ions
    order = np.argsort(known)
    place = np.minimum(np.searchsorted(known, numbers, sorter=order), len(known) - 1) if len(known) else numbers
    if not len(known) or not np.array_equal(known[order[place]], numbers):
        raise ValueError(f"truth must be the run of these hits, got {run!r} without some of their ions")
    return order[place]


def per_ion(values: ArrayLike, name: str, hits: Hits, truth: Run | ArrayLike | None, dtype: type) -> NDArray[Any]:
    """Validated values of each hit, shape (n,), given for the hits or for all ions of the run."""
    n = len(values) if np.iterable(values) and not isinstance(values, str) else 0  # type: ignore[arg-type]
    if isinstance(truth, Run) and n == len(truth) != len(hits):
        return check_array(values, name, (n,), dtype=dtype)[rows_of(hits, truth)]
    return check_array(values, name, (len(hits),), dtype=dtype)


def groups_of(
    hits: Hits, truth: Run | ArrayLike | None, groups: ArrayLike | None, name: str = "groups"
) -> Integers | None:
    """Group of each hit, shape (n,); by default the species, if it is known."""
    if groups is not None:
        return per_ion(groups, name, hits, truth, np.int64)
    if isinstance(truth, Run):
        return truth.species[rows_of(hits, truth)].astype(np.int64)
    species = hits.extra.get("species")
    return None if species is None or species.dtype.kind not in "iu" else species.astype(np.int64)


def free_constants(fit: Sequence[str]) -> set[str]:
    """Validated names of constants."""
    return {check_choice(name, "fit", CONSTANTS) for name in check_sequence(fit, "fit", "names of free constants")}


def errors_of(
    positions: Floats,
    angles: Floats,
    truth: Floats,
    fit: Sequence[str] = LINEAR,
    groups: Integers | None = None,
    below: Floats | float = 0.0,
) -> ReconstructionErrors:
    """Fit the linear constants, those of `LINEAR` in `fit`, and compare positions with sites, both (n, 3) [nm].

    z of positions is the depth, z of sites is out of the specimen. `angles` are those on the cap [degrees], `below` is
    the depth of each ion below the apex [nm], which the factor of the depth leaves as it is.
    """
    free = free_constants(fit)
    n = len(positions)
    if n < 3:
        raise ValueError(f"errors need at least 3 ions, got {n}")
    fitted, (lateral, depth, shift) = moved(positions, below, truth, free)
    residuals = fitted - truth
    squares = _squares(residuals)
    rings = _RING * np.arange(max(1, math.ceil(angles.max() / _RING)) + 1)
    layers = np.linspace(positions[:, 2].min(), positions[:, 2].max(), _DEPTH_BINS + 1)
    correlation, cylinders = _order_correlation(positions, truth)
    across, along = np.sqrt(squares.mean(axis=0))
    # a lateral scale without rotation can be negative: the sign is then part of the scale
    rotation = math.degrees(math.atan2(lateral.imag, lateral.real)) if "rotation" in free else 0.0
    out = np.sin(np.radians(angles)) * _unit(lateral * (positions[:, 0] + 1j * positions[:, 1]))
    return ReconstructionErrors(
        shift=shift,
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
        directions=np.column_stack([out.real, out.imag, np.cos(np.radians(angles))]),
        depths=positions[:, 2],
        by_group=None if groups is None else _grouped(groups, residuals),
    )


def moved(
    positions: Floats, below: Floats | float, truth: Floats, free: set[str]
) -> tuple[Floats, tuple[complex, float, Floats]]:
    """Positions moved onto the sites by the free linear constants, and these: complex factor, of the depth, shift."""
    lateral, x_shift, y_shift = _lateral_fit(positions, truth, free)
    apex = positions[:, 2] - below
    depth, z_shift = _depth_fit(apex, truth[:, 2] + below, free)
    turned = lateral * (positions[:, 0] + 1j * positions[:, 1])
    fitted = np.column_stack([turned.real + x_shift, turned.imag + y_shift, z_shift - depth * apex - below])
    return fitted, (lateral, depth, np.array([x_shift, y_shift, z_shift]))


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
    labels = labels.ravel()
    first, second = (
        _ranks(depths, labels, counts) - (counts[labels] + 1) / 2
        for depths in (-truth[inside, 2], positions[inside, 2])
    )
    n = len(counts)
    moments = [np.bincount(labels, part, n) for part in (first * second, first**2, second**2)]
    known = (counts >= _LEAST_IONS) & (moments[1] > 0) & (moments[2] > 0)
    if not known.any():
        return math.nan, 0
    product, *squares = (part[known] for part in moments)
    correlations = product / np.sqrt(squares[0] * squares[1])
    return float(np.average(correlations, weights=counts[known])), int(np.count_nonzero(known))


def _ranks(values, labels, counts):
    """Rank of each value within its group, from 1; equal values have their mean rank."""
    order = np.lexsort((values, labels))
    groups, ordered = labels[order], values[order]
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    ranks = np.arange(1, len(values) + 1) - starts[groups]
    new = np.ones(len(values), bool)
    new[1:] = (groups[1:] != groups[:-1]) | (ordered[1:] != ordered[:-1])
    runs = np.cumsum(new) - 1
    means = np.bincount(runs, ranks) / np.bincount(runs) if len(values) else np.empty(0)
    ranked = np.empty(len(values))
    ranked[order] = means[runs]
    return ranked


def _squares(residuals):
    """Squares of the residual across the axis and along it, shape (n, 2)."""
    return np.column_stack([(residuals[:, :2] ** 2).sum(axis=1), residuals[:, 2] ** 2])


def _polar(directions):
    """Angles from the axis [degrees]."""
    return np.degrees(np.arctan2(np.hypot(directions[:, 0], directions[:, 1]), directions[:, 2]))


def _unit(places):
    """Complex numbers of length 1; 1 for 0."""
    lengths = np.abs(places)
    return np.divide(places, lengths, out=np.ones_like(places), where=lengths > 0)


def _bins_of(values, edges):
    """Number of the bin of each value; the last edge is included."""
    return np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)


def _binned(values, edges, squares):
    """Root of the mean squares in bins."""
    bins, n = _bins_of(values, edges), len(edges) - 1
    ions = np.bincount(bins, minlength=n)
    with np.errstate(invalid="ignore"):
        lateral, depth = (np.sqrt(np.bincount(bins, part, minlength=n) / ions) for part in squares.T)
    return ErrorBins(edges, ions, lateral, depth)


def _grouped(groups, residuals):
    """Mean and RMS of the residuals of each group."""
    numbers, place, ions = np.unique(groups, return_inverse=True, return_counts=True)
    place = place.ravel()
    shift = np.column_stack([np.bincount(place, part) / ions for part in residuals.T])
    lateral, depth = (np.sqrt(np.bincount(place, part) / ions) for part in _squares(residuals).T)
    return GroupErrors(numbers, ions, shift, lateral, depth)
