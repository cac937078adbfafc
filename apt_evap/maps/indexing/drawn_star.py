"""A drawing that needs no crystal: lines through one point of a map, with a dark spot there.

Zone lines meet in poles, so any star of lines resembles some crystal, and evidence over no crystal does not prove one.
A star of a few lines with free azimuths, widths, signs and amplitudes is therefore fitted to the local contrast of the
map. Its evidence is that of a crystal (`contrast_search`), less twice the logarithm of the number of drawings among
which it is chosen: places of the point, and azimuths and widths of every line.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy

from apt_evap._common.types import Floats
from apt_evap.maps.indexing.contrast_search import LINES, NARROW, PIECES, POLES, WIDE, exact_evidence, places_of
from apt_evap.maps.indexing.orientation_search import AZIMUTHS, RINGS

MOST_LINES = 6
"""Lines of a star at most."""
WIDTHS = 0.03, 0.07
"""Standard deviations of the lines [radii of the field of view]."""
SPOTS = 0.05, 0.1, 0.2
"""Standard deviations of the dark spot [radii]."""
_REACH = 0.92  # radii: largest distance of the point from the centre
_STEP = 0.05  # radii: distance of neighbouring points
_OFFSETS = np.arange(-50, 51) * 0.02  # distances of lines from the centre [radii]
_BESIDE = 2  # azimuths up to which a line is the same one
_POINTS, _REFINED = 12, 3  # points whose lines are chosen one after the other, and stars that are refined
_STEPS, _FINE, _DIFFERENCE = 12, 0.3, 1e-4  # of the refinement: steps at most, change that ends it, derivatives
_HALF = AZIMUTHS // 2
_DISTINCT = 2 * NARROW  # radii: drawings that are nearer are the same


class Star(NamedTuple):
    """The best star."""

    evidence: float
    """E of `contrast_search`, less what the choice of the drawing costs."""
    lines: int
    """Number of its lines."""
    point: tuple[float, float]
    """Where they meet [radii of the field of view]."""


def best_star(picture: Floats) -> Star:
    """Find the star that explains the local contrast of a map best.

    Parameters
    ----------
    picture : ndarray
        Local contrast, of `picture_of`.
    """
    places, areas = places_of()
    weighted = picture * areas
    spectrum = scipy.fft.rfft(weighted.reshape(RINGS, AZIMUTHS), axis=1)
    # products of the picture with lines of every width, distance and azimuth up to 180 degrees
    products = scipy.fft.irfft((_lines()[1] * spectrum).sum(axis=2), AZIMUTHS, axis=2)[..., :_HALF]
    azimuths = np.arange(_HALF) * (2 * math.pi / AZIMUTHS)
    normals = np.array([-np.sin(azimuths), np.cos(azimuths)])
    steps = np.arange(-_REACH, _REACH + _STEP, _STEP)
    points = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    points = points[np.hypot(*points.T) < _REACH]
    nearest = np.rint((points @ normals - _OFFSETS[0]) / (_OFFSETS[1] - _OFFSETS[0])).astype(int)
    through = products[:, nearest, np.arange(_HALF)]  # widths, points, azimuths
    strongest = np.sort((through**2).max(axis=0), axis=1)[:, -3 * (2 * _BESIDE - 1) :].sum(axis=1)
    drawings = []
    for place in np.argsort(-strongest, kind="stable")[:_POINTS]:
        lines = [_turned(pictures, nearest[place]) for pictures in _lines()[0]]
        spots = _spots(np.hypot(*(places - points[place]).T), SPOTS)
        terms = np.concatenate([_normal(spots), *lines])
        gram, cross = (terms * areas) @ terms.T, terms @ weighted
        for spot in (None, *range(len(SPOTS))):
            evidence, chosen = _greedy(gram, cross, spot)
            widths, turns = np.divmod(np.array(chosen), _HALF)
            size = 1.0 if spot is None else SPOTS[spot]
            geometry = [*points[place], math.log(size), *np.log(np.take(WIDTHS, widths)), *azimuths[turns]]
            drawings.append((evidence, spot is not None, np.array(geometry)))
    drawings.sort(key=lambda drawing: -drawing[0])
    return max((_refined(picture, *drawing[1:]) for drawing in drawings[:_REFINED]), key=lambda star: star.evidence)


def _cost(lines):
    """What the choice of a star costs: twice the logarithm of the number of stars."""
    number = math.log(math.pi / _DISTINCT**2) + math.log(1 + len(SPOTS))
    return 2 * (number + lines * math.log(len(WIDTHS) * math.pi / _DISTINCT) - math.lgamma(lines + 1))


def _greedy(gram, cross, spot):
    """Evidence of the best number of lines, each one that explains most beside the earlier ones, and these lines."""
    n = len(SPOTS)
    chosen = [] if spot is None else [spot]
    allowed = np.ones(len(cross), bool)
    allowed[:n] = False
    azimuth = (np.arange(len(cross)) - n) % _HALF
    best = -math.inf, [0]
    for number in range(1, MOST_LINES + 1):
        part = gram[chosen]
        solved = np.linalg.solve(part[:, chosen] + np.eye(len(chosen)) / PIECES, np.column_stack([part, cross[chosen]]))
        left = cross - part.T @ solved[:, -1]
        own = 1 - np.einsum("ij,ij->j", part, solved[:, :-1])
        new = int(np.where(allowed, left**2 / np.maximum(own, 0.05), -1.0).argmax())
        chosen.append(new)
        apart = (azimuth - azimuth[new] + _HALF // 2) % _HALF - _HALF // 2
        allowed &= np.abs(apart) >= _BESIDE
        value = _of_terms(gram[np.ix_(chosen, chosen)], cross[chosen], spot is not None)[0] - _cost(number)
        if value > best[0]:
            best = value, [line - n for line in chosen if line >= n]
    return best


def _of_terms(gram, cross, spot):
    """Evidence and amplitudes of a spot, if there is one, and lines."""
    lines = np.arange(len(cross)) >= spot
    return exact_evidence(gram, cross, np.where(lines, LINES, POLES), lines)


def _refined(picture, spot, geometry):
    """The best star near a geometry: point, logarithms of the widths, azimuths; by Gauss-Newton steps."""
    places, areas = places_of()
    n = (len(geometry) - 3) // 2
    widths, turns = slice(3, 3 + n), slice(3 + n, None)

    def terms(geometry):
        x, y = (places - geometry[:2]).T
        angles = geometry[turns, None]
        shown = _line(np.cos(angles) * y - np.sin(angles) * x, np.exp(geometry[widths, None]))
        return np.concatenate([_spots(np.hypot(x, y), np.exp(geometry[2:3])), shown]) if spot else shown

    def judged(geometry):
        pictures = terms(geometry)
        pictures = pictures - (pictures @ areas)[:, None]
        norms = np.maximum(np.sqrt(pictures**2 @ areas), 1e-9)
        pictures /= norms[:, None]
        value, amplitudes = _of_terms((pictures * areas) @ pictures.T, (pictures * areas) @ picture, spot)
        return value, amplitudes / norms, amplitudes @ pictures

    value, amplitudes, model = judged(geometry)
    for _ in range(_STEPS):
        here = amplitudes @ terms(geometry)
        slopes = (amplitudes @ terms(geometry + shift) - here for shift in _DIFFERENCE * np.eye(len(geometry)))
        slopes = np.stack([slope - areas @ slope for slope in slopes]) / _DIFFERENCE
        normal = (slopes * areas) @ slopes.T
        damped = normal + np.diag(1e-2 * np.diag(normal) + 1e-9)
        step = np.clip(np.linalg.solve(damped, (slopes * areas) @ (picture - model)), -0.2, 0.2)
        for _ in range(3):
            moved = geometry + step
            moved[2:3] = np.clip(moved[2:3], *np.log([SPOTS[0] / 2, SPOTS[-1] * 2]))
            moved[widths] = np.clip(moved[widths], *np.log([WIDTHS[0] / 2, WIDTHS[-1] * 2]))
            new = judged(moved)
            if new[0] > value:
                break
            step = step / 3
        gain = new[0] - value
        if gain > 0:
            geometry, (value, amplitudes, model) = moved, new
        if gain < _FINE:
            break
    return Star(value - _cost(n), n, (float(geometry[0]), float(geometry[1])))


def _line(distances, width):
    """Local contrast of a line, without the division by its standard deviation."""
    fine, slow = (
        1 + width / np.hypot(width, s) * np.exp(-0.5 * (distances / np.hypot(width, s)) ** 2) for s in (NARROW, WIDE)
    )
    return fine / slow - 1


def _spots(distances, sizes):
    """The same of dark spots, shape (sizes, n)."""
    squares = np.reshape(sizes, (-1, 1)) ** 2
    fine, slow = (
        1 - squares / (squares + s**2) * np.exp(-0.5 * distances**2 / (squares + s**2)) for s in (NARROW, WIDE)
    )
    return fine / slow - 1


@lru_cache(maxsize=1)
def _lines():
    """Lines with the azimuth 0 of all widths and distances from the centre, shape (widths, distances, RINGS, AZIMUTHS).

    And their conjugate spectra along the azimuth.
    """
    pictures = np.array([_normal(_line(places_of()[0][:, 1] - _OFFSETS[:, None], width)) for width in WIDTHS])
    pictures = pictures.reshape(len(WIDTHS), len(_OFFSETS), RINGS, AZIMUTHS)
    return pictures, scipy.fft.rfft(pictures, axis=3).conj()


def _turned(pictures, offsets):
    """Lines of these distances, each turned to its azimuth, shape (_HALF, n)."""
    return np.stack([np.roll(pictures[offset], turn, axis=1).ravel() for turn, offset in enumerate(offsets)])


def _normal(pictures):
    """Pictures with a mean of 0 and a variance of 1."""
    areas = places_of()[1]
    pictures = pictures - (pictures @ areas)[..., None]
    return pictures / np.maximum(np.sqrt(pictures**2 @ areas), 1e-9)[..., None]
