"""Direction and place of a zone line on a map, with errors: lines need not meet in a pole."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_kind, check_number
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.maps.noise import hits_per_bin
from apt_evap.maps.profiles import Rectangle

_FEWEST_BINS = 50  # inside the rectangle
_SIGNIFICANT = 5.0  # least height, in standard errors: of some hundred lines one is the best by chance
# lines of the first search: place and full width over the width of the rectangle, and change of the place along it
_PLACES, _SLOPES, _SIZES = np.linspace(-0.4, 0.4, 17), np.linspace(-0.6, 0.6, 13), (0.1, 0.2, 0.4)


@dataclass(frozen=True, eq=False)
class TracedLine:
    """A straight zone line on a map; result of `trace_line`.

    Parameters
    ----------
    middle : tuple of float
        Point of the line, at the middle of the given ends [mm].
    length : float
        Distance of the given ends [mm].
    direction, direction_error : float
        From x towards y, and its standard error [degrees].
    place_error : float
        Standard error of the place across the line, at its middle [mm].
    width : float
        Full width at half height [mm].
    height, height_error : float
        Density at the centre of the line minus that beside it, over the mean density, and its standard error: > 0 for
        a bright line, < 0 for a dark one.
    """

    middle: tuple
    length: float
    direction: float
    direction_error: float
    place_error: float
    width: float
    height: float
    height_error: float

    @property
    def ends(self) -> tuple[float, float, float, float]:
        """x, y of both ends [mm], as `index` takes a line."""
        step = 0.5 * self.length * np.array([math.cos(self._angle), math.sin(self._angle)])
        return (*(np.array(self.middle) - step).tolist(), *(np.array(self.middle) + step).tolist())

    def distance(self, point: ArrayLike) -> tuple[float, float]:
        """Distance of the line from a point [mm], positive to the left of the line, and its standard error.

        Parameters
        ----------
        point : array_like
            Such as the place of a pole, shape (2,).
        """
        x, y = np.array(self.middle) - check_array(point, "point", (2,))
        cosine, sine = math.cos(self._angle), math.sin(self._angle)
        along = -(x * cosine + y * sine)  # of the foot of the point, from the middle
        error = math.hypot(self.place_error, math.radians(self.direction_error) * along)
        return float(y * cosine - x * sine), float(error)

    @property
    def _angle(self):
        return math.radians(self.direction)

    def __repr__(self) -> str:
        x, y = self.middle
        return (
            f"<TracedLine: {self.direction:.2f} ± {self.direction_error:.2f} degrees through ({x:.2f}, {y:.2f}) mm "
            f"± {self.place_error:.2f} mm, height {self.height:.2f} ± {self.height_error:.2f}>"
        )


def trace_line(map: DetectorMap, ends: ArrayLike, *, width: float) -> TracedLine:
    """Find direction and place of a zone line near two points on it.

    Parameters
    ----------
    map : DetectorMap
        Counts, whose noise gives the errors, or densities; not smoothed.
    ends : array_like
        x and y of two points near the line [mm], shape (4,).
    width : float
        Width of the rectangle along the line in which it is searched [mm]: some times that of the line.

    Returns
    -------
    TracedLine

    Raises
    ------
    ValueError
        If an argument is outside its range, or the height of the line is below five of its errors.

    Notes
    -----
    The hits of the bins in the rectangle are fitted by a straight line with the profile of a Gaussian on a linear
    ground, with equal weights. The errors are those of the counts; if the bins scatter by more than their noise, as
    for a curved line, they are larger by the same factor. For densities the noise is that of `effective_ions`, or the
    scatter.

    Examples
    --------
    >>> x = np.linspace(-19.5, 19.5, 40)
    >>> density = 1 + 0.8 * np.exp(-(((x[:, None] - 0.1 * x - 2.0) / 1.5) ** 2))
    >>> edges = np.linspace(-20, 20, 41)
    >>> line = ae.maps.trace_line(ae.DetectorMap.from_array(density, edges, edges), (-15, 0, 15, 3), width=12.0)
    >>> print(f"{line.direction:.2f} degrees, {line.distance((0, 0))[0]:.1f} mm from the centre")
    5.71 degrees, 2.0 mm from the centre
    """
    check_kind(map, "map", DetectorMap, "a DetectorMap")
    first, second = np.split(check_array(ends, "ends", (4,)), 2)
    length = float(np.linalg.norm(second - first))
    if not length > 0:
        raise ValueError(f"ends must be two different points, got {first.tolist()} twice")
    width = check_number(width, "width", above=0, unit="mm")
    rectangle = Rectangle(tuple((first + second) / 2), math.degrees(math.atan2(*(second - first)[::-1])), length, width)
    # bins inside the rectangle, in coordinates from -1/2 to 1/2, and their density relative to the mean
    hits, known = hits_per_bin(map, None)
    along, across = rectangle.along_and_across(*(grid[map.mask] for grid in np.meshgrid(*map.centres)))
    inside = (np.abs(along) < length / 2) & (np.abs(across) < width / 2)
    if np.count_nonzero(inside) < _FEWEST_BINS or not hits[inside].any():
        raise ValueError(f"ends and width must enclose {_FEWEST_BINS} bins with hits, got {rectangle}")
    along, across, hits = along[inside] / length, across[inside] / width, hits[inside]
    mean = float(hits.mean())
    density = hits / mean

    def model(_, place, slope, size, height, ground, gradient, tilt):
        line = np.exp2(-((2 * (across - place - slope * along) / size) ** 2))
        return ground + gradient * along + tilt * across + height * line

    # least squares from the best line of a grid
    no_line = f"no line of at most the width {width:g} mm near the ends {rectangle}"
    start, low = _best_of_grid(along, across, density), max(map.bin_size) / width
    bounds = [-0.5, -np.inf, low, *[-np.inf] * 4], [0.5, np.inf, 1.0, *[np.inf] * 4]
    try:
        fitted, covariance = scipy.optimize.curve_fit(model, None, density, np.clip(start, *bounds), bounds=bounds)
    except RuntimeError as failure:
        raise ValueError(f"{no_line}: {failure}") from failure
    expected = model(None, *fitted)
    if known:
        # equal weights, as for a profile across a line; the errors are those of the counts
        change = np.linalg.pinv(scipy.optimize.approx_fprime(fitted, lambda values: model(None, *values)))
        variance = np.maximum(expected, 1e-3) / mean
        excess = max(1.0, float(np.mean((density - expected) ** 2 / variance)))
        covariance = (change * variance) @ change.T * excess
    place, slope, size, height = fitted[:4]
    height_error = math.sqrt(max(covariance[3, 3], 0.0))
    if not (_SIGNIFICANT * height_error < abs(height) and abs(place) < 0.49 and low < size < 0.99):
        raise ValueError(f"{no_line}: the fit gave a height of {height:.2g} ± {height_error:.2g}")
    # from the coordinates of the rectangle to the map
    angle = math.atan(slope * width / length)
    turn = math.radians(rectangle.angle)
    normal = np.array([-math.sin(turn), math.cos(turn)])
    middle = np.array(rectangle.centre) + place * width * normal
    return TracedLine(
        middle=tuple(middle.tolist()),
        length=length,
        direction=rectangle.angle + math.degrees(angle),
        direction_error=math.degrees(math.sqrt(covariance[1, 1]) * width / length * math.cos(angle) ** 2),
        place_error=math.sqrt(covariance[0, 0]) * width * math.cos(angle),
        width=size * width * math.cos(angle),
        height=height,
        height_error=height_error,
    )


def _best_of_grid(along: Floats, across: Floats, density: Floats) -> Floats:
    """Start of the fit: the best of some lines, each with the best heights."""
    best, start = np.inf, np.zeros(7)
    rest = np.column_stack([np.ones(len(along)), along, across])
    for place, slope, size in product(_PLACES, _SLOPES, _SIZES):
        line = np.exp2(-((2 * (across - place - slope * along) / size) ** 2))
        design = np.column_stack([line, rest])
        values, misfit, *_ = np.linalg.lstsq(design, density)
        if len(misfit) and misfit[0] < best:
            best, start = misfit[0], np.array([place, slope, size, *values])
    return start
