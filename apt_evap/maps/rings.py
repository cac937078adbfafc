"""Statistics of rings about a pole: how bright and how dark the zone lines are, whatever their width.

Structural similarity rewards the right blur everywhere more than the right lines somewhere. The azimuthal profile of
rings about a pole shows the lines themselves: its standard deviation is their contrast, its minimum the depth of the
dark lines, its maximum the height of the bright ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.validation import check_array, check_count, check_kind, check_sequence, check_switch
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.maps.pole_frame import Directions, pole_frame

RINGS = ((5.0, 9.0), (9.0, 14.0), (14.0, 20.0))
"""Inner and outer radius of the default rings [degrees]: outside the pole of the usual (111) facets."""
_FEWEST_BINS = 3  # of a map in a sector
_RESAMPLES = 200  # for the error of a contrast: 5 % of it


@dataclass(frozen=True, eq=False)
class Ring:
    """Azimuthal profile of the density in a ring about a pole.

    Parameters
    ----------
    inner, outer : float
        Radii [degrees of crystal angle].
    profile : ndarray, shape (m,)
        Density in sectors of equal width over their mean, after the first harmonic was divided out and symmetric
        sectors were averaged; NaN for a sector outside the map.
    profile_error : ndarray, shape (m,)
        Standard deviation of each value by the noise of the counts; NaN if the noise is not known.
    contrast : float
        Standard deviation of the profile without the noise of the counts.
    error : float
        Standard deviation of the contrast by the noise of the counts; NaN if the noise is not known.
    minimum, maximum : float
        Of the profile. Noise lowers the minimum and raises the maximum: compare maps with similar errors.
    minimum_error, maximum_error : float
        Errors of the profile at its minimum and its maximum.
    ions : float
        Hits in the ring; for densities the number with the same noise, NaN if it is not known.
    """

    inner: float
    outer: float
    profile: np.ndarray
    profile_error: np.ndarray
    contrast: float
    error: float
    minimum: float
    maximum: float
    minimum_error: float
    maximum_error: float
    ions: float

    def __repr__(self) -> str:
        error = "" if np.isnan(self.error) else f" ± {self.error:.2f}"
        return (
            f"<Ring {self.inner:g} to {self.outer:g} degrees: contrast {self.contrast:.2f}{error}, "
            f"{self.minimum:.2f} to {self.maximum:.2f} of the mean>"
        )


class LineAmplitude(NamedTuple):
    """Amplitude of the lines of a measured ring in another ring; result of `line_amplitude`."""

    value: float
    """1 for the measured lines, negative for lines of the other sign."""
    error: float
    """Standard deviation by noise; NaN if the noise is not known."""


def ring_statistics(
    map: DetectorMap,
    projection: Directions,
    pole: ArrayLike = (0.0, 0.0, 1.0),
    rings: Sequence[Sequence[float]] = RINGS,
    *,
    fold: int = 1,
    sectors: int = 72,
    ions: float | None = None,
) -> tuple[Ring, ...]:
    """Contrast of the zone lines in rings about a pole.

    Parameters
    ----------
    map : DetectorMap
        Counts or densities, not smoothed.
    projection : Projection
        From directions in the crystal onto the detector, such as that of `image_compression`; or
        ``Projection(scale, centre=place_of_the_pole)`` for a measured map with a pole in its centre.
    pole : array_like
        Direction of the pole in the frame of the projection, shape (3,).
    rings : sequence of (float, float)
        Inner and outer radii [degrees].
    fold : int
        Rotational symmetry about the pole: 3 for (111). Symmetric sectors are averaged.
    sectors : int
        Number of sectors, a multiple of `fold`; 72 are 5 degrees wide.
    ions : float, optional
        Number of hits in the map whose counting noise it has. By default its counts, and for densities the result of
        `effective_ions`; infinite for densities without noise.

    Returns
    -------
    tuple of Ring

    Raises
    ------
    ValueError
        If an argument is outside its range, or a ring has too few bins on the map.

    Notes
    -----
    The density of a sector is its hits over the solid angle of its bins inside the mask. A first harmonic a + b cos + c
    sin is fitted to the densities over their mean and divided out: it contains gradients over the detector. With n hits
    per averaged sector, 1/n is subtracted from the variance of the profile. The error is that of 200 resamples of the
    hits with Poisson noise.
    """
    fold, sectors = check_count(fold, "fold", at_least=1), check_count(sectors, "sectors", at_least=4, at_most=3600)
    if sectors % fold:
        raise ValueError(f"sectors must be a multiple of fold, {fold}, got {sectors}")
    _, angle, azimuth, weight, solid, noise_known = pole_frame(map, projection, pole, ions)
    statistics = []
    for ring in check_sequence(rings, "rings", "pairs of radii [degrees]"):
        inner, outer = check_array(ring, "rings", (2,)).tolist()
        if not 0 <= inner < outer <= 90:
            raise ValueError(f"rings must be pairs 0 <= inner < outer <= 90 degrees, got {inner:g} and {outer:g}")
        inside = (angle >= inner) & (angle < outer)
        number = (azimuth[inside] * sectors).astype(int) % sectors
        counts, areas, bins = (
            np.bincount(number, values, sectors) for values in (weight[inside], solid[inside], np.ones(inside.sum()))
        )
        known = bins >= _FEWEST_BINS
        if np.count_nonzero(known) < sectors / 2 or not counts[known].any():
            raise ValueError(f"the ring {inner:g} to {outer:g} degrees has too few bins or counts on {map!r}")
        statistics.append(_ring(inner, outer, counts, np.where(known, areas, np.nan), fold, noise_known))
    return tuple(statistics)


def line_amplitude(ring: Ring, measured: Ring, *, shift: int = 0, mirror: bool = False) -> LineAmplitude:
    r"""Amplitude of the lines of a measured ring in another ring, with their sign.

    The contrast of a ring has no sign: a map with dark lines where the measured ones are bright can have the same
    contrast. The amplitude is 1 for the measured lines, 0 for a map without them, and negative where they are dark. It
    is linear in the density: for a mixture of two kinds of ions it is the mean of both, weighted with their densities.

    Parameters
    ----------
    ring, measured : Ring
        Rings with the same number of sectors.
    shift : int
        Sectors by which the profile of `ring` is turned onto the measured one; 0 for maps in the same frame.
    mirror : bool
        Whether the profile of `ring` is mirrored first.

    Returns
    -------
    LineAmplitude

    Raises
    ------
    ValueError
        If the numbers of sectors differ, or the measured ring has no contrast.

    Notes
    -----
    .. math:: A = \frac{\sum_k (p_k - 1)(m_k - 1)}{n c^2}

    with the profiles p and m of n sectors and the measured contrast c, from which the noise is removed. Noise of p does
    not bias A. The error is that by the noise of p.
    """
    for name, value in (("ring", ring), ("measured", measured)):
        check_kind(value, name, Ring, "a Ring")
    shift = check_count(shift, "shift")
    check_switch(mirror, "mirror")
    if len(ring.profile) != len(measured.profile):
        raise ValueError(
            f"ring and measured must have equal sectors, got {len(ring.profile)} and {len(measured.profile)}"
        )
    if not measured.contrast > 0:
        raise ValueError(f"the measured ring must have a contrast > 0, got {measured!r}")
    turned, error = (
        np.roll(values[::-1] if mirror else values, shift) for values in (ring.profile - 1.0, ring.profile_error)
    )
    pattern = measured.profile - 1.0
    known = np.isfinite(turned) & np.isfinite(pattern)
    norm = np.count_nonzero(known) * measured.contrast**2
    return LineAmplitude(
        float((turned[known] * pattern[known]).sum() / norm),
        float(np.sqrt(((error[known] * pattern[known]) ** 2).sum()) / norm),
    )


def _ring(inner, outer, counts, areas, fold, noise_known):
    profile, fit = _profile(counts, areas, fold)
    variance, error, noise = float(np.nanvar(profile)), float("nan"), 0.0
    errors = np.full(len(profile), np.nan)
    if noise_known:
        noise = _noise(counts, areas, fold)
        errors = _errors(counts, areas, fit, fold)
        drawn = np.random.default_rng(0).poisson(counts, (_RESAMPLES, len(counts)))
        drawn = drawn[drawn[:, np.isfinite(areas)].any(axis=1)]  # of few hits, a resample may have none
        resampled = _folded(drawn / areas / fit, fold)
        resampled /= np.nanmean(resampled, axis=1, keepdims=True)
        error = float(np.sqrt(np.maximum(np.nanvar(resampled, axis=1) - 2 * noise, 0.0)).std())
    lowest, highest = np.nanargmin(profile), np.nanargmax(profile)
    return Ring(
        inner=inner,
        outer=outer,
        profile=profile,
        profile_error=errors,
        contrast=float(np.sqrt(max(variance - noise, 0.0))),
        error=error,
        minimum=float(profile[lowest]),
        maximum=float(profile[highest]),
        minimum_error=float(errors[lowest]),
        maximum_error=float(errors[highest]),
        ions=float(counts.sum()) if noise_known else float("nan"),
    )


def _profile(counts, areas, fold):
    """Folded profile without its first harmonic, and the fitted density of each sector."""
    density = counts / areas
    known = np.isfinite(density)
    azimuth = 2 * np.pi * (np.arange(len(counts)) + 0.5) / len(counts)
    matrix = np.column_stack([np.ones(len(counts)), np.cos(azimuth), np.sin(azimuth)])
    fit = matrix @ np.linalg.lstsq(matrix[known], density[known], rcond=None)[0]
    fit = np.where(fit > 0, fit, np.nan)
    folded = _folded(density / fit, fold)
    return folded / np.nanmean(folded), fit


def _folded(profile, fold):
    """Mean over the symmetric sectors of profiles of shape (..., sectors)."""
    parts = profile.reshape(*profile.shape[:-1], fold, -1)
    known = np.isfinite(parts)
    total = np.where(known, parts, 0.0).sum(axis=-2)
    return np.divide(total, known.sum(axis=-2), out=np.full(total.shape, np.nan), where=known.any(axis=-2))


def _errors(counts, areas, fit, fold):
    """Poisson errors of the folded profile; an empty sector gets the error of one hit."""
    of_sector = np.sqrt(np.maximum(counts, 1.0)) / areas / fit
    known = np.isfinite(of_sector).reshape(fold, -1).sum(axis=0)
    mean = np.nanmean(_folded(counts / areas / fit, fold))
    # quadratic mean over the sectors divided by the square root of their number
    return np.sqrt(_folded(of_sector**2, fold) / np.maximum(known, 1)) / mean


def _noise(counts, areas, fold):
    """Variance of the folded profile by the noise of the counts."""
    parts = np.where(np.isfinite(areas), counts, 0.0).reshape(fold, -1).sum(axis=0)
    return float(np.mean(1.0 / np.maximum(parts.mean(), 1.0)))
