"""Statistics of rings about a pole: how bright and how dark the zone lines are, whatever their width.

Structural similarity rewards the right blur everywhere more than the right lines somewhere. The azimuthal profile of
rings about a pole shows the lines themselves: its standard deviation is their contrast, its minimum the depth of the
dark lines, its maximum the height of the bright ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_count, check_kind, check_sequence
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.projection import Projection

RINGS = ((5.0, 9.0), (9.0, 14.0), (14.0, 20.0))
"""Inner and outer radius of the default rings [degrees]: outside the pole of the usual (111) facets."""
RADII = (0.0, 1.0, 2.0, 3.0, 6.0)
"""Edges of the radial density [degrees]."""
_INNER = 16.0  # degrees: the radial density is relative to the mean within this angle
_FEWEST_BINS = 3  # of a map in a sector


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
    contrast : float
        Standard deviation of the profile without the noise of the counts.
    error : float
        Standard deviation of the contrast by the noise of the counts; NaN for densities, whose noise is not known.
    minimum, maximum : float
        Of the profile.
    ions : float
        Counts in the ring; NaN for densities.
    """

    inner: float
    outer: float
    profile: np.ndarray
    contrast: float
    error: float
    minimum: float
    maximum: float
    ions: float

    def __repr__(self) -> str:
        error = "" if np.isnan(self.error) else f" ± {self.error:.2f}"
        return (
            f"<Ring {self.inner:g} to {self.outer:g} degrees: contrast {self.contrast:.2f}{error}, "
            f"{self.minimum:.2f} to {self.maximum:.2f} of the mean>"
        )


def ring_statistics(
    map: DetectorMap,
    projection: Projection,
    pole: ArrayLike = (0.0, 0.0, 1.0),
    rings: Sequence[Sequence[float]] = RINGS,
    *,
    fold: int = 1,
    sectors: int = 72,
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

    Returns
    -------
    tuple of Ring

    Raises
    ------
    ValueError
        If an argument is outside its range, or a ring has too few bins on the map.

    Notes
    -----
    The density of a sector is its counts (or the sum of its densities times areas) over the solid angle of its bins
    inside the mask. A first harmonic a + b cos + c sin is fitted to the densities over their mean and divided out: it
    contains gradients over the detector. With n counts per averaged sector, 1/n is subtracted from the variance of the
    profile. The error is that of 200 resamples of the counts with Poisson noise.
    """
    check_kind(map, "map", DetectorMap, "a DetectorMap")
    check_kind(projection, "projection", Projection, "a Projection")
    fold, sectors = check_count(fold, "fold", at_least=1), check_count(sectors, "sectors", at_least=4, at_most=3600)
    if sectors % fold:
        raise ValueError(f"sectors must be a multiple of fold, {fold}, got {sectors}")
    angle, azimuth, weight, solid = _about(map, projection, pole)
    found = []
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
        found.append(_ring(inner, outer, counts, np.where(known, areas, np.nan), fold, map.is_counts))
    return tuple(found)


def radial_densities(
    map: DetectorMap, projection: Projection, pole: ArrayLike = (0.0, 0.0, 1.0), radii: Sequence[float] = RADII
) -> Floats:
    """Density in circles about a pole, relative to the mean within 16 degrees: how dark and how wide the pole is.

    Parameters
    ----------
    map, projection, pole
        As for `ring_statistics`.
    radii : sequence of float
        Edges of the rings [degrees], increasing.

    Returns
    -------
    ndarray, shape (len(radii) - 1,)
        NaN for a ring without a bin.
    """
    check_kind(map, "map", DetectorMap, "a DetectorMap")
    check_kind(projection, "projection", Projection, "a Projection")
    edges = check_array(radii, "radii", ("n",))
    if len(edges) < 2 or not (np.diff(edges) > 0).all() or edges[0] < 0:
        raise ValueError(f"radii must be at least two increasing numbers >= 0 [degrees], got {edges.tolist()}")
    angle, _, weight, solid = _about(map, projection, pole)
    mean = weight[angle < _INNER].sum() / solid[angle < _INNER].sum()
    counts, areas = (np.histogram(angle, edges, weights=values)[0] for values in (weight, solid))
    return np.divide(counts, areas * mean, out=np.full(len(counts), np.nan), where=areas > 0)


def _about(map, projection, pole):
    """Angle from the pole [degrees], azimuth [turns], weight and solid angle of each bin inside the mask."""
    pole = check_array(pole, "pole", (3,))
    if not np.linalg.norm(pole) > 0:
        raise ValueError("pole must not be zero, got (0, 0, 0)")
    pole = pole / np.linalg.norm(pole)
    x, y = (grid[map.mask] for grid in np.meshgrid(*map.centres))
    width, height = map.bin_size
    places = np.column_stack([x, y])
    directions = projection.directions(places)
    # solid angle of a bin, from the directions of its neighbours
    across, along = (
        projection.directions(places + half) - projection.directions(places - half)
        for half in (np.array([0.5 * width, 0.0]), np.array([0.0, 0.5 * height]))
    )
    solid = np.linalg.norm(np.cross(across, along), axis=1)
    # azimuth 0 towards the axis that is farthest from the pole
    first = np.eye(3)[np.abs(pole).argmin()]
    first = first - pole * (first @ pole)
    first /= np.linalg.norm(first)
    second = np.cross(pole, first)
    angle = np.degrees(np.arccos(np.clip(directions @ pole, -1.0, 1.0)))
    azimuth = np.arctan2(directions @ second, directions @ first) / (2 * np.pi) % 1.0
    values = np.asarray(map.values[map.mask], float)
    return angle, azimuth, values if map.is_counts else values * solid, solid


def _ring(inner, outer, counts, areas, fold, is_counts):
    profile, fit = _profile(counts, areas, fold)
    variance, error, noise = float(np.nanvar(profile)), float("nan"), 0.0
    if is_counts:
        noise = _noise(counts, areas, fold)
        random = np.random.default_rng(0)
        contrasts = []
        for _ in range(200):
            resampled = _folded(random.poisson(counts) / areas / fit, fold)
            contrasts.append(np.sqrt(max(np.nanvar(resampled / np.nanmean(resampled)) - 2 * noise, 0.0)))
        error = float(np.std(contrasts))
    return Ring(
        inner=inner,
        outer=outer,
        profile=profile,
        contrast=float(np.sqrt(max(variance - noise, 0.0))),
        error=error,
        minimum=float(np.nanmin(profile)),
        maximum=float(np.nanmax(profile)),
        ions=float(counts.sum()) if is_counts else float("nan"),
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
    parts = profile.reshape(fold, -1)
    known = np.isfinite(parts)
    total = np.where(known, parts, 0.0).sum(axis=0)
    return np.divide(total, known.sum(axis=0), out=np.full(parts.shape[1], np.nan), where=known.any(axis=0))


def _noise(counts, areas, fold):
    """Variance of the folded profile by the noise of the counts."""
    parts = np.where(np.isfinite(areas), counts, 0.0).reshape(fold, -1).sum(axis=0)
    return float(np.mean(1.0 / np.maximum(parts.mean(), 1.0)))
