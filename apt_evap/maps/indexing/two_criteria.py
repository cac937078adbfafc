"""Orientations of a map by two criteria: the likelihood of its counts, and the evidence of its local contrast.

The likelihood (`refine`) sees amplitudes and every count, but slow changes, a dark rim or one very bright line that the
patterns do not have can mislead it. The evidence (`contrast_search`) sees edges of either sign and no amplitudes of
large areas, but one filter does not see poles of all sizes. Both are twice the logarithm of a likelihood, so the weight
of a result is their sum. The logarithm of the likelihood is divided by the dispersion about the best model: a model
that leaves structure unexplained decides less.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from apt_evap._common.types import Floats
from apt_evap.maps.indexing.contrast_search import Explained, Terms, picture_of, places_of, refine_contrast
from apt_evap.maps.indexing.marked_poles import Mark
from apt_evap.maps.indexing.orientation_search import Disc, Start, misorientation
from apt_evap.maps.indexing.refine import Bins, Refined, bins_of, directions_of, refine
from apt_evap.specimen.symmetry import point_group

_SAME, _SAME_SCALE = 2.0, 0.05  # degrees, logarithm of the scale: starts that are nearer are refined once
_QUICK, _STEPS = 7, 20  # of the refinements of all starts, and of the best ones
_EVERY = 7  # of the points of a polar picture: for angles


class View(NamedTuple):
    """A map as both criteria need it."""

    disc: Disc
    """Its field of view."""
    bins: Bins
    """Its counts."""
    picture: Floats
    """Its local contrast."""


class Weighed(NamedTuple):
    """A result of the search."""

    fit: Refined
    """That of the likelihood."""
    evidence: float
    """That of the local contrast."""

    def weight(self, dispersion: float) -> float:
        """Twice the logarithm of both likelihoods, for a dispersion of the counts about their best model."""
        return self.fit.gain / dispersion - self.fit.misfit + self.evidence


def view_of(disc: Disc) -> View:
    """A map as both criteria need it."""
    return View(disc, bins_of(disc), picture_of(disc))


def angle_between(first: Refined | Explained, second: Refined | Explained, group: Floats, radius: float) -> float:
    """RMS angle [degrees] between the crystal directions that two results give to the places of a disc [mm]."""
    places, areas = (values[::_EVERY] for values in places_of())
    one, two = (directions_of(places, radius, fit.scale, fit.stretch) @ fit.matrix for fit in (first, second))
    cosines = np.einsum("gij,nj,ni->gn", group, two, one)
    angles = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    return float(np.sqrt((angles**2 @ areas).min() / areas.sum()))


def weighed(
    view: View,
    terms: Terms,
    densities: Floats,
    starts: Sequence[Start],
    n: int,
    bounds: tuple[float, float],
    marks: Sequence[Mark] = (),
    known: dict[tuple, Any] | None = None,
) -> list[Weighed]:
    """Refine orientations by both criteria, the `n` best ones by each of them to the end.

    `densities` are those of the patterns, smoothed for the bins, shape (k, m, m), `bounds` those of the scale [mm/rad].
    `known` are refinements of the same map and crystal; those of this call are added.
    """
    disc, bins, picture = view
    group = point_group(terms.structure)

    known = {} if known is None else known

    def by_likelihood(start, steps):
        key = start.matrix.tobytes(), start.scale, steps
        if key not in known:
            known[key] = refine(bins, disc, densities, start.matrix, start.scale, None, marks, steps, bounds)
        return known[key]

    def by_contrast(start):
        key = start.matrix.tobytes(), start.scale
        if key not in known:
            known[key] = refine_contrast(picture, disc.radius, terms, start, bounds)
        return known[key]

    starts = _distinct(starts, group)
    likely = [by_likelihood(start, _QUICK) for start in starts]
    seen = [by_contrast(start) for start in starts]
    dispersion = dispersion_of(likely)
    likely.sort(key=lambda fit: fit.misfit - fit.gain / dispersion)
    seen.sort(key=lambda fit: -fit.evidence)
    different: list = []
    for start in likely[:n] + seen[:n]:
        if all(angle_between(start, other, group, disc.radius) > _SAME for other in different):
            different.append(start)
    results = []
    for start in different:
        fit = by_likelihood(start, _STEPS)
        # each from where the other one is best
        evidence = start.evidence if isinstance(start, Explained) else by_contrast(start).evidence
        results.append(Weighed(fit, max(evidence, by_contrast(fit).evidence)))
    return results


def _distinct(starts, group):
    """Starts that are not nearly the same as an earlier one."""
    proper = group[np.linalg.det(group) > 0]
    distinct: list[Start] = []
    for start in starts:
        if not any(
            abs(math.log(start.scale / other.scale)) < _SAME_SCALE
            and misorientation(start.matrix, other.matrix, proper) < _SAME
            for other in distinct
        ):
            distinct.append(start)
    return distinct


def dispersion_of(fits: Sequence[Refined]) -> float:
    """Dispersion about the model that explains most."""
    return max(fits, key=lambda fit: fit.gain).dispersion
