"""Density of hits along a circle, a radius or across a zone line, with counting errors; comparison of two profiles."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy

from apt_evap._common.codec import number, settings, vector
from apt_evap._common.short_repr import short_repr
from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_count, check_kind, check_number, check_sequence
from apt_evap.detection.binning import MAX_BINS
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits


class Profile(NamedTuple):
    """Density of hits against azimuth, radius, or distance from a line."""

    position: np.ndarray
    """Centres of the bins: azimuth [degrees], radius or distance [mm], shape (bins,)."""
    density: np.ndarray
    """Hits per area relative to the mean over all bins, NaN for bins without area, shape (bins,)."""
    error: np.ndarray
    """Poisson error of the density (one standard deviation), NaN for maps of densities, shape (bins,)."""
    unit: str = "mm"
    """Unit of the position: mm or degrees."""

    def __repr__(self) -> str:
        return short_repr(self)


@settings
class Rectangle:
    """Rectangle on the detector along a zone line.

    Raises
    ------
    ValueError
        If a number is not finite, or a length is not positive.
    """

    centre: tuple = vector("Centre x, y", 2, unit="mm")
    angle: float = number(
        "Direction of the line, from x towards y. Distances are positive to the left of the line: along y for an angle "
        "of 0, along x for -90.",
        unit="degrees",
    )
    length: float = number("Size along the line", above=0, unit="mm")
    width: float = number("Size across the line", above=0, unit="mm")

    def along_and_across(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Distances from the centre along the line and across it [mm], shape (n,) each, of positions x, y [mm]."""
        cosine, sine = np.cos(np.radians(self.angle)), np.sin(np.radians(self.angle))
        x, y = np.asarray(x, float) - self.centre[0], np.asarray(y, float) - self.centre[1]
        return x * cosine + y * sine, y * cosine - x * sine

    def turned(self, angle: float) -> "Rectangle":
        """Return the rectangle rotated about the centre of the detector by an angle from x towards y [degrees]."""
        cosine, sine = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        x, y = self.centre
        return replace(self, centre=(x * cosine - y * sine, x * sine + y * cosine), angle=self.angle + angle)

    @property
    def corners(self) -> Floats:
        """Corners, counterclockwise [mm], shape (4, 2)."""
        cosine, sine = np.cos(np.radians(self.angle)), np.sin(np.radians(self.angle))
        half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [self.length / 2, self.width / 2]
        return half @ [[cosine, sine], [-sine, cosine]] + self.centre


def azimuthal_profile(
    hits: Hits | DetectorMap, centre: tuple[float, ...] = (0.0, 0.0), *, inner: float, outer: float, bins: int = 72
) -> Profile:
    """Density of hits in a ring against the azimuth.

    Parameters
    ----------
    hits : Hits or DetectorMap
        Hits, which should fill the complete ring; for a map, only the inside of the detector counts.
    centre : tuple of float
        Centre of the ring [mm].
    inner, outer : float
        Radii of the ring [mm].
    bins : int
        Number of sectors; the first begins at the x axis, azimuths increase from x to y.

    Returns
    -------
    Profile
        `position` is the azimuth [degrees], 0 to 360.

    Raises
    ------
    ValueError
        If the radii are invalid, or the ring contains no hits.
    """
    inner, outer, bins = _check_ring(inner, outer, bins)
    places = _Places(hits)
    radius, azimuth = _polar(places, centre)
    ring = (radius >= inner) & (radius < outer)
    sector = np.floor(azimuth[ring] * (bins / 360)).astype(np.intp) % bins
    exact = np.full(bins, np.pi * (outer**2 - inner**2) / bins)
    centres = (np.arange(bins) + 0.5) * (360 / bins)
    return _profile(centres, sector, ring, places, exact, "between inner and outer")._replace(unit="degrees")


def radial_profile(
    hits: Hits | DetectorMap,
    centre: tuple[float, ...] = (0.0, 0.0),
    *,
    outer: float,
    inner: float = 0.0,
    bins: int = 50,
) -> Profile:
    """Density of hits against the distance from a centre.

    Parameters
    ----------
    hits : Hits or DetectorMap
        Hits, which should fill the complete disc; for a map, only the inside of the detector counts.
    centre : tuple of float
        Centre of the rings [mm].
    outer, inner : float
        Largest and smallest radius of the profile [mm].
    bins : int
        Number of rings of equal width.

    Returns
    -------
    Profile
        `position` is the radius [mm].

    Raises
    ------
    ValueError
        If `outer` is not larger than `inner`, or there are no hits between them.
    """
    inner, outer, bins = _check_ring(inner, outer, bins)
    places = _Places(hits)
    radius, _ = _polar(places, centre)
    ring = (radius >= inner) & (radius < outer)
    edges = np.linspace(inner, outer, bins + 1)
    annulus = np.minimum((radius[ring] - inner) * (bins / (outer - inner)), bins - 1).astype(np.intp)
    centres = (edges[:-1] + edges[1:]) / 2
    return _profile(centres, annulus, ring, places, np.pi * np.diff(edges**2), "between inner and outer")


def zone_line_profile(
    hits: Hits | DetectorMap, rectangles: Rectangle | Sequence[Rectangle], *, bins: int = 40
) -> Profile:
    """Density of hits across a zone line, averaged along it within a rectangle.

    Parameters
    ----------
    hits : Hits or DetectorMap
        Hits, which should fill the complete rectangle; for a map, only bins inside the detector count.
    rectangles : Rectangle or sequence of Rectangle
        Position and direction of the line. The profiles of several rectangles, along symmetry-equivalent lines, are
        added; they must have the same width.
    bins : int
        Number of strips of equal width along the line. For a map they should be wider than its bins.

    Returns
    -------
    Profile
        `position` is the distance from the centre of the rectangle [mm], positive to the left of the line.

    Raises
    ------
    ValueError
        If the rectangles contain no hits, or differ in width.

    Notes
    -----
    The normalized hit density p(X) of Shaikh et al., arXiv 2509.13744, figure 7, is the density divided by the width
    of the rectangle. The quantisation of measured hits causes stripes across a line along x or y: make a map first,
    with bins that are multiples of the quantisation step. Simulated ions evaporate layer by layer and scatter less than
    random ions, so Poisson errors are slightly too large for them.
    """
    if isinstance(rectangles, Rectangle):
        rectangles = [rectangles]
    rectangles = check_sequence(rectangles, "rectangles", "Rectangle")
    for rectangle in rectangles:
        check_kind(rectangle, "rectangles", Rectangle, "Rectangles")
    bins = check_count(bins, "bins", at_least=1, at_most=MAX_BINS)
    widths = {rectangle.width for rectangle in rectangles}
    if len(widths) != 1:
        raise ValueError(f"rectangles must contain at least one, all of equal width, got widths {sorted(widths)} mm")
    (width,) = widths
    places = _Places(hits)
    strips, selections = [], []
    for rectangle in rectangles:
        along, across = rectangle.along_and_across(places.x, places.y)
        inside = np.flatnonzero((np.abs(along) < rectangle.length / 2) & (np.abs(across) < width / 2))
        strips.append(np.clip(np.floor((across[inside] / width + 0.5) * bins), 0, bins - 1).astype(np.intp))
        selections.append(inside)
    centres = width * ((np.arange(bins) + 0.5) / bins - 0.5)
    exact = np.full(bins, width / bins * sum(rectangle.length for rectangle in rectangles))
    where = "in " + ", ".join(map(str, rectangles))
    return _profile(centres, np.concatenate(strips), np.concatenate(selections), places, exact, where)


class ProfileComparison(NamedTuple):
    """Comparison of two profiles of the same rectangle, each relative to its own mean."""

    position: np.ndarray
    """Centres of the bins, shape (bins,)."""
    difference: np.ndarray
    """Density of the first minus that of the second, in units of the error, shape (bins,)."""
    chi_square: float
    """Sum of the squares of the differences."""
    degrees_of_freedom: int
    """Number of bins minus one: both profiles have the mean 1."""
    probability: float
    """Probability that counting noise alone gives a larger chi_square."""
    relative: float
    """Root mean square difference of the densities after subtraction of the noise; 0 if noise explains all of it."""

    def __repr__(self) -> str:
        return short_repr(self)


def compare_profiles(first: Profile, second: Profile) -> ProfileComparison:
    """Compare two profiles bin by bin, in units of the errors.

    Parameters
    ----------
    first, second : Profile
        Profiles with the same bins and with errors, from hits or from maps of counts.

    Returns
    -------
    ProfileComparison

    Raises
    ------
    ValueError
        If bins differ, or a profile has no errors.
    """
    for name, profile in (("first", first), ("second", second)):
        check_kind(profile, name, Profile, "a Profile")
        if not np.isfinite(profile.error).any():
            raise ValueError(f"{name} must have errors, got a profile of densities: use hits or a map of counts")
    if first.position.shape != second.position.shape or not np.allclose(first.position, second.position):
        raise ValueError(
            f"the profiles must have equal bins, got {len(first.position)} and {len(second.position)} "
            f"around {first.position.mean():g} and {second.position.mean():g}"
        )
    difference = first.density - second.density
    error = np.hypot(first.error, second.error)
    pull = difference / error
    chi_square, bins = float(np.nansum(pull**2)), int(np.isfinite(pull).sum())
    beyond = np.nanmean(difference**2) - np.nanmean(error**2)
    return ProfileComparison(
        position=first.position,
        difference=pull,
        chi_square=chi_square,
        degrees_of_freedom=bins - 1,
        probability=float(scipy.stats.chi2.sf(chi_square, bins - 1)),
        relative=float(np.sqrt(max(beyond, 0.0))),
    )


class _Places:
    """Positions of single hits, or of the bins of a map with their values and their area."""

    x: Floats
    y: Floats
    values: Floats | None = None
    area: float | None = None

    def __init__(self, hits: Hits | DetectorMap) -> None:
        if isinstance(hits, DetectorMap):
            self.x, self.y = (grid[hits.mask] for grid in np.meshgrid(*hits.centres))
            self.values, self.area = hits.values[hits.mask], float(np.prod(hits.bin_size))
            self.counted = hits.is_counts
        else:
            detected = check_kind(hits, "hits", Hits, "Hits or a DetectorMap").detected
            self.x, self.y = (values[detected] for values in hits.require("x", "y"))
            self.counted = True


def _check_ring(inner, outer, bins):
    inner = check_number(inner, "inner", at_least=0, unit="mm")
    return (
        inner,
        check_number(outer, "outer", above=inner, unit="mm"),
        check_count(bins, "bins", at_least=1, at_most=MAX_BINS),
    )


def _polar(places, centre):
    """Radius [mm] and azimuth [degrees] around a centre, shape (n,)."""
    centre = check_array(centre, "centre", (2,))
    x, y = places.x - centre[0], places.y - centre[1]
    return np.hypot(x, y), np.degrees(np.arctan2(y, x)) % 360


def _profile(position, index, inside, places, areas, where):
    """Sum hits and areas over the bins of a profile; single hits use the given `areas`."""
    if places.values is None:
        number = np.bincount(index, minlength=len(position)).astype(float)
    else:
        number = np.bincount(index, weights=places.values[inside], minlength=len(position))
        areas = places.area * np.bincount(index, minlength=len(position))
    if not number.any():
        raise ValueError(f"a profile needs hits, got none {where}")
    # an empty bin gets the error of one hit
    spread = np.sqrt(np.maximum(number, 1)) if places.counted else np.full(len(position), np.nan)
    scale = np.where(areas > 0, areas, np.nan) * (number.sum() / areas.sum())
    return Profile(position, number / scale, spread / scale)
