"""First points of the calibration of m/n: elements whose isotopes fit in distance and content."""

import math
from collections.abc import Collection

import numpy as np

from apt_evap.spectra.ion_names import COMMON, GASES, Abundances
from apt_evap.spectra.mass_calibration import MassCalibration
from apt_evap.spectra.peak_contents import Contents
from apt_evap.spectra.peak_scale import PeakScale

Point = tuple[float, float, float]
"""m/n [Da], relative error, and its standard deviation."""
_PURE = 0.97  # abundance of an isotope beside which the others say little
_FARTHEST = 0.006  # relative error of m/n that is tried
_EXPLAINED, _TOO_MUCH = 0.85, 1.3  # least part of the minor isotopes, and largest sum of all
_FEWEST = 300  # ions of the minor isotopes
_DEVIATION = 1.2  # largest deviation of the abundances
_RARE = 0.1  # weight of a rare element
_ERROR = 3e-4  # of an anchor
_MOST = 12
_WEAK = 1e-3  # evidence over that of the best anchor


def find_anchors(
    contents: Contents, scale: PeakScale, abundances: Abundances, ions: Collection[tuple[str, int]]
) -> list[Point]:
    """Points of the calibration from atomic ions with two or more isotopes, the surest first."""
    found = sorted((found for ion in ions for found in _of_ion(contents, scale, abundances, *ion)), reverse=True)
    calibration, points = MassCalibration(), []
    for evidence, mass, shift in found[:_MOST]:
        mean, error = (float(values[0]) for values in calibration.shift(mass))
        far = abs(shift - mean) > 2.5 * error + _ERROR
        if evidence < _WEAK * found[0][0] or far or any(abs(mass / other - 1) < 0.01 for other, _, _ in points):
            continue
        points.append((mass, shift, _ERROR))
        calibration.learn(points)
    return points


def _of_ion(contents, scale, abundances, element, charge):
    """Evidence, m/n and relative error for each peak that may be the most abundant isotope of an ion."""
    masses, shares = abundances.lines(element)
    if shares.max() > _PURE:
        return
    place, seen = contents.mass, contents.seen
    main = int(np.argmax(shares))
    mass = masses[main] / charge
    minor = np.arange(len(shares)) != main
    for peak in np.flatnonzero((np.abs(np.log(place / mass)) < _FARTHEST) & seen):
        lines = masses / charge * (place[peak] / mass)
        nearest = np.argmin(np.abs(np.log(place[None, :] / lines[:, None])), axis=1)
        distance, sigma = np.abs(np.log(place[nearest] / lines)), scale.sigma(lines)
        held = (distance < np.maximum(sigma, 2e-4)) & seen[nearest]
        error = np.sqrt(np.where(distance < 3 * sigma, contents.variance[nearest], 25.0))
        # another ion may share a line, and tails of one peak may be counted in the next: the middle of all lines
        amplitude = _middle(contents.ions[nearest][held] / shares[held], shares[held])
        if (~held & (shares * amplitude > 8 * error) & (shares > 0.02)).any():
            continue  # an isotope is not there
        measured = np.where(held, contents.ions[nearest] / amplitude, 0.0)
        common = np.minimum(measured, shares)[minor].sum()
        if (
            common < _EXPLAINED * shares[minor].sum()
            or measured.sum() > _TOO_MUCH
            or common * amplitude < _FEWEST
            or not held[minor].any()
        ):
            continue
        large = shares > 0.02
        deviation = math.sqrt(float(np.mean(((measured - shares)[large] / (0.05 + 0.15 * shares[large])) ** 2)))
        if deviation <= _DEVIATION:
            weight = 1.0 if element in COMMON or element in GASES else _RARE
            evidence = common * amplitude * np.count_nonzero(measured) * math.exp(-deviation) * weight
            yield float(evidence), float(mass), float(place[peak] / mass - 1)


def _middle(values, weights):
    """Weighted median."""
    order = np.argsort(values)
    sums = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(sums, sums[-1] / 2)])
