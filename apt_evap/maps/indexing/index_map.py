"""Which crystal direction is where on a map: the search, its refinement, and what the map decides."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_count, check_kind, check_number, check_sequence, short_text
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.detection.projection import Projection
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.maps.crystallography.symmetry import point_group
from apt_evap.maps.folded_map import FoldedMap, folded
from apt_evap.maps.indexing.contrast_search import search_contrast
from apt_evap.maps.indexing.deciding_marks import deciding_marks
from apt_evap.maps.indexing.marked_poles import check_places, contradictory_marks, contradictory_pair, marks_of
from apt_evap.maps.indexing.master_pattern import MasterPattern, master_patterns
from apt_evap.maps.indexing.orientation_search import Start, disc_of, misorientation, search
from apt_evap.maps.indexing.refine import NO_STRETCH, Refined, bins_of, refine, resolution
from apt_evap.specimen.materials import as_material

WIDEST, NARROWEST = 45.0, 12.0
"""Half angles of the field of view between which the scale is searched, if it is not known [degrees]."""
LARGEST_ANGLE, LEAST_ANGLE = 60.0, 5.0
"""Half angles of the field of view that a scale may give [degrees]."""
DIFFERENT = 6.0
"""Angle between two orientations, or between the half angles of the field of view at two scales, above which they are
different results [degrees]."""
DECIDED = 12.0
"""Margin to the next different orientation above which a map decides, see the notes of `index`."""
RIVAL = 0.8
"""Largest score of another orientation or scale, relative to that of the first one, with which a map decides."""
LEAST_SCORE = 1 / 3
"""Smallest score with which a map decides, without marks: a measured nickel map reaches 0.28 for a wrong orientation
with a margin of 26, a measured tungsten map 0.40 for the right one. Chosen with these two maps."""
LEAST_IONS = 4_000
"""Fewest ions with which a map decides, without marks: of 11 decided maps of 1,500 to 4,300 ions 4 were wrong, all
below 3,100 ions (articles/find_the_poles)."""
LEAST_GAIN, LEAST_STRUCTURE = 40.0, 4.0
"""A map has structure beyond its noise if an orientation decreases the deviance by the first number, or if it deviates
from slow changes by more than the second one, in standard errors: 52 maps of noise reach 13 to 31 and at most 2.1,
maps of 1,000 simulated ions 50 to 88."""
LEAST_COMPRESSION, LARGEST_COMPRESSION = 1.2, 2.2
"""Image compressions between which the scale is searched, if only the flight length is known."""
SHOWN = 3
"""Largest number of candidates of an undecided map in texts and pictures."""
_STARTS, _SEEN = 12, 8  # orientations of both searches that are refined
_FINAL = 6  # that are refined to the end
_QUICK, _RIVALS = 7, 4  # steps of a first refinement; orientations of each other structure that are tried
_BEYOND = 1.1  # refined scales may leave bounds that nobody gave by this factor: the stretch changes the scale
_MAP_BINS = 128
_SHOWN_SIGMA = 0.7  # smoothing of a pattern that is drawn [degrees]


@dataclass(frozen=True, eq=False)
class Candidate:
    """An orientation that a map may show.

    Parameters
    ----------
    orientation : Orientation
        Orientation of the crystal, with the axis of the specimen at the centre of the map: for `Tip`.
    projection : Projection
        Where directions are on the map.
    score : float
        Fraction of the structure of the map that the orientation explains, 0 to 1: of its deviance from slow changes,
        beyond the noise.
    confidence : float
        Confidence that this candidate, or an orientation within 6 degrees, is right, if one of the candidates is.
    rolled : float
        Part of the pattern of ions that roll up, 0 to 1.
    contrast : float
        Sum of the amplitudes of the patterns; 1 for a map like the simulated ones, less for fainter lines.
    angle_error : float
        Standard error of the orientation by noise alone [degrees].
    pattern : MasterPattern
        The pattern that fits best.
    """

    orientation: Orientation
    projection: Projection
    score: float
    confidence: float
    rolled: float
    contrast: float
    angle_error: float
    pattern: MasterPattern

    def __repr__(self) -> str:
        return f"<Candidate: {self.orientation.material.name} {self}, score {self.score:.2f}>"

    def predicted(self, like: DetectorMap) -> DetectorMap:
        """Density of the pattern in the bins of a map, with a mean of 1, without noise or a change of efficiency.

        Parameters
        ----------
        like : DetectorMap
            The map.

        Returns
        -------
        DetectorMap
        """
        x, y = (values.ravel() for values in np.meshgrid(*like.centres))
        directions = self.projection.directions(np.column_stack([x, y])) @ self.orientation.matrix
        parts = self.pattern.at(directions, sigma=_SHOWN_SIGMA)
        density = ((1 - self.rolled) * parts[0] + self.rolled * parts[1]).reshape(like.values.shape)
        density = np.where(like.mask, density / density[like.mask].mean(), np.nan)
        return DetectorMap.from_array(density, like.x_edges, like.y_edges, like.mask, source=f"pattern of {self}")

    def _plain(self):
        projection = self.projection
        return {
            "axis": [round(index, 4) for index in self.orientation.axis],
            "rotation": round(self.orientation.rotation, 2),
            "scale": projection.scale,
            "centre": list(projection.centre),
            "compression": projection.compression,
            "score": self.score,
            "confidence": self.confidence,
            "rolled": self.rolled,
            "contrast": self.contrast,
            "angle_error": self.angle_error,
            "pattern_radius": self.pattern.apex_radius,
        }

    def __str__(self):
        axis = " ".join(f"{index:.2f}" for index in self.orientation.axis)
        return f"[{axis}], rotation {self.orientation.rotation:.1f}°, {self.projection.scale:.1f} mm/rad"


@dataclass(frozen=True, eq=False)
class Indexing:
    """Orientations that a map may show, and whether it decides; the result of `index`.

    Parameters
    ----------
    map : DetectorMap
        The map.
    candidates : tuple of Candidate
        Different orientations, or scales of one orientation, the best one first.
    decided : bool
        Whether the map decides for the first candidate.
    reason : str
        One sentence: why it is decided or not.
    """

    map: DetectorMap
    candidates: tuple[Candidate, ...]
    decided: bool
    reason: str

    @property
    def best(self) -> Candidate:
        """The first candidate."""
        return self.candidates[0]

    @property
    def verdict(self) -> str:
        """The word "indexed" or "undecided"."""
        return "indexed" if self.decided else "undecided"

    def folded(self, plane: Sequence[int], candidate: Candidate | None = None, **options: Any) -> FoldedMap:
        """The map, folded about a pole by the symmetry of the crystal.

        Parameters
        ----------
        plane : sequence of int
            Miller indices of a family of planes; of its poles the one nearest to the axis.
        candidate : Candidate, optional
            Orientation and projection; by default those of the first candidate.
        **options
            ``reach``, ``smoothing``, ``ions`` and ``seed`` of `maps.folded`.

        Returns
        -------
        FoldedMap
        """
        chosen = self.best if candidate is None else candidate
        return folded(self.map, chosen.projection, *chosen.orientation.nearest_pole(plane), **options)

    def to_dict(self) -> dict[str, Any]:
        """Return the result in plain types, without the map.

        Returns
        -------
        dict
            verdict, reason, of each candidate its axis, rotation, scale, centre, compression, score, confidence,
            rolled, contrast, angle_error and the radius of the pattern, and the sentences of `deciding_marks`.
        """
        return {
            "verdict": self.verdict,
            "reason": self.reason,
            "candidates": [candidate._plain() for candidate in self.candidates],
            "deciding_marks": list(self.deciding_marks),
        }

    def __repr__(self) -> str:
        several = "s" * (len(self.candidates) != 1)
        return f"<Indexing: {self.verdict}, {len(self.candidates)} candidate{several}, first {self.best}>"

    def __str__(self):
        rows = [f"{self.verdict}: {self.reason}"]
        shown = self.candidates[: 1 if self.decided else SHOWN]
        rows += [f"{number}. score {candidate.score:.2f}  {candidate}" for number, candidate in enumerate(shown, 1)]
        return "\n".join(rows + list(self.deciding_marks))

    @cached_property
    def deciding_marks(self) -> tuple[str, ...]:
        """Sentences: which marked pole would decide between the first candidates of an undecided map."""
        if self.decided or self.best.score == 0:
            return ()
        shown = self.candidates[:SHOWN]
        return deciding_marks(self.map, [(candidate.orientation, candidate.projection) for candidate in shown])


def index(
    measured: DetectorMap | Hits,
    material: Any,
    *,
    scales: Sequence[float] | None = None,
    poles: Sequence[Any] = (),
    lines: Sequence[Any] = (),
    patterns: Sequence[MasterPattern] | None = None,
    distance: float | None = None,
    candidates: int = 4,
    start: tuple[Orientation, Projection] | None = None,
) -> Indexing:
    """Find out which crystal direction is where on a map.

    Parameters
    ----------
    measured : DetectorMap or Hits
        A map of one element or phase.
    material : Material or str
        The crystal.
    scales : sequence of two float, optional
        Bounds of the scale of all candidates [mm/rad]: the flight length divided by the image compression. A lens gives
        them within 10 %: ``L / lens.compression(radius)``. By default those of `distance`, or a half angle of the field
        of view between 12 and 45 degrees. Scales for which the half angle is not 5 to 60 degrees are left out.
    poles : sequence, optional
        Poles that you see: (x, y) [mm], or (x, y, indices) if you know which one it is.
    lines : sequence, optional
        Zone lines that you see: (x, y, x, y) of two points far from each other [mm], or with the indices of the zone
        axis as a fifth value. They need not meet in a pole. Indices are at most 9.
    patterns : sequence of MasterPattern, optional
        Patterns of the crystal; by default those of the package, for several radii.
    distance : float, optional
        Flight length [mm], for a scale between 1/2.2 and 1/1.2 of it.
    candidates : int
        Largest number of candidates in the result.
    start : tuple of Orientation and Projection, optional
        Refine this orientation, such as one of `fit_orientation`, instead of a search. The result is then undecided.

    Returns
    -------
    Indexing

    Raises
    ------
    ValueError
        If there is no pattern of the structure, an argument is outside its range, a mark is outside the map, or the map
        has too few bins.

    Notes
    -----
    A search over all axes, rotations and scales compares the map with a master pattern: the density of hits in every
    direction of the crystal, simulated, for ions that roll up and for ions that do not. A second search compares local
    contrast with the patterns, with zone lines that may be bright or dark, and with dark poles: it proposes what a
    person sees. The best results of both are refined by the likelihood of the counts, with free amplitudes of both
    patterns and a slow change of the efficiency. The margin of two results is twice the logarithm of the ratio of their
    likelihoods, divided by the variance of the sums of neighbouring residuals of the better one in units of Poisson's.
    So a model that leaves structure unexplained decides less.

    The map is `decided` if the margin to the next result is above 12: another orientation, by more than 6 degrees, or
    the same one at a scale that changes the half angle of the field of view by more than 6 degrees. Without marks of a
    user it also needs 4,000 ions and a score of a third, no such result may explain more than 0.8 of what the first one
    explains, and no other crystal structure more. A map of noise has a score of 0. Marks that no orientation explains,
    or that contradict the map, are named in the reason, and
    the map is not decided. `Indexing.deciding_marks` says which mark would decide.

    The axis is that at the centre of the field of view. An orientation and its mirror image look the same in crystals
    with mirror planes: a map does not decide its handedness.

    :doc:`/howto/find_orientation` has what was measured with simulated and measured maps.

    Examples
    --------
    >>> pattern = ae.maps.master_patterns("fcc")[0]
    >>> orientation = ae.Orientation("Ni", axis=(0.30, 0.54, 0.79), rotation=20.0)
    >>> simulated = pattern.map(orientation, ae.detection.Projection(60.0), width=70.0, ions=30_000, rolled=0.5, seed=1)
    >>> found = ae.index(simulated, "Ni")
    >>> found.verdict, f"{found.best.projection.scale:.0f} mm/rad"
    ('indexed', '60 mm/rad')
    """
    material = as_material(material)
    if isinstance(measured, Hits):
        measured = measured.map(bins=_MAP_BINS)
    check_kind(measured, "measured", DetectorMap, "a DetectorMap or Hits")
    patterns = (
        master_patterns(material.structure)
        if patterns is None
        else check_sequence(patterns, "patterns", "MasterPattern")
    )
    for pattern in patterns:
        check_kind(pattern, "patterns", MasterPattern, "MasterPattern")
        if pattern.structure != material.structure:
            raise ValueError(f"patterns must be of {material.structure}, got {pattern!r}")
    disc = disc_of(measured)
    marks = marks_of(material, poles, lines)
    check_places(marks, measured, disc.radius)
    (low, high), bounds = _scales(disc, scales, distance, start)
    bins = bins_of(disc)
    sigma = resolution(disc, math.sqrt(low * high))
    densities = [pattern.smoothed(sigma) for pattern in patterns]

    def refined(start, steps):
        number = start[0]
        return number, refine(bins, disc, densities[number], *start[1:], marks, steps, bounds)

    if start is None:
        starts = search(disc, patterns, (low, high), _STARTS, marks)
        if marks:  # which may be wrong
            starts += search(disc, patterns, (low, high), _RIVALS)
        else:
            starts += search_contrast(disc, material, patterns, (low, high), _SEEN)
    else:
        matrix = _matrix_at(disc.centre, *start)
        starts = [Start(matrix, start[1].scale, 0.0, 0.5, number) for number in range(len(patterns))]
    group = point_group(material.structure)
    proper = group[np.linalg.det(group) > 0]
    fits = [refined((first.pattern, first.matrix, first.scale, first.rolled), _QUICK) for first in starts]
    fits = _ranked(fits)
    again = []
    for number, fit in fits[:_FINAL]:  # of the best ones with more iterations
        rolled = fit.amplitudes[1] / max(fit.amplitudes.sum(), 1e-9)
        again.append(refined((number, fit.matrix, fit.scale, rolled), 20))
    fits = _ranked(again + fits[_FINAL:])
    if bounds != (low, high):
        inside = [fit for fit in fits if bounds[0] * 1.001 < fit[1].scale_at_centre < bounds[1] / 1.001]
        fits = inside or fits
    different: list[tuple[int, Refined]] = []
    for number, fit in fits:
        if all(differ(fit, other, proper, disc.radius) for _, other in different):
            different.append((number, fit))
    n = check_count(candidates, "candidates", at_least=1)
    contradiction = contradictory_pair(marks, disc.centre, bounds)
    contradiction = contradiction or contradictory_marks(marks, different[0][1].deviations)
    result = _judged(measured, disc, bins, material, patterns, different, proper, n, bounds, bool(marks), contradiction)
    if start is not None:
        return replace(result, decided=False, reason="refined from a given orientation, others were not searched")
    if result.decided and not marks:
        rival = _rival(disc, bins, sigma, (low, high), bounds, different[0][1], result.best.pattern)
        if rival:
            result = replace(result, decided=False, reason=f"a {rival} crystal explains the map better")
    return result


def differ(first: Refined, second: Refined, proper: Floats, radius: float) -> bool:
    """Whether two fits are different results: in orientation, or in the scale of the same orientation.

    Scales count by the angle that they give to the rim of the disc. So a narrow field of view, which cannot tell them
    precisely, need not.
    """
    apart = math.degrees(abs(radius / first.scale - radius / second.scale)) > DIFFERENT
    return apart or misorientation(first.matrix, second.matrix, proper) > DIFFERENT


def _evidence(fits):
    """Twice the logarithm of the likelihood, in units of the noise about the model of the largest gain, shape (n,)."""
    dispersion = max((fit for _, fit in fits), key=lambda fit: fit.gain).dispersion
    return np.array([fit.gain / dispersion - fit.misfit for _, fit in fits])


def _ranked(fits):
    """Fits with the largest evidence first."""
    return [fits[k] for k in np.argsort(-_evidence(fits), kind="stable")]


def _rival(disc, bins, sigma, scales, bounds, best, pattern):
    """Another structure that explains a map better than the best orientation, "" if there is none."""
    for other in ("fcc", "bcc", "diamond", "hcp"):
        if other == pattern.structure:
            continue
        rival = min(master_patterns(other), key=lambda known: abs(math.log(known.apex_radius / pattern.apex_radius)))
        densities = rival.smoothed(sigma)
        for start in search(disc, (rival,), scales, _RIVALS):
            fit = refine(bins, disc, densities, start.matrix, start.scale, start.rolled, (), _QUICK, bounds)
            if fit.gain > best.gain:
                return other
    return ""


def _matrix_at(centre, orientation, projection):
    """Rotation from crystal to specimen with z along a place on the map, for a map that is not mirrored."""
    matrix = orientation.matrix
    if projection.mirror:  # crystals of the patterns have an inversion centre: x of all directions, or y and z
        matrix, projection = np.diag([1.0, -1.0, -1.0]) @ matrix, replace(projection, mirror=False)
    (z,) = projection.directions(np.array([centre]))
    axis = np.cross(z, [0.0, 0.0, 1.0])
    turn = axis * (np.arccos(np.clip(z[2], -1, 1)) / max(np.linalg.norm(axis), 1e-12))
    return scipy.spatial.transform.Rotation.from_rotvec(turn).as_matrix() @ matrix


def _scales(disc, scales, distance, start):
    """Bounds of the scale for the search, and for the result [mm/rad]."""
    if scales is not None and distance is not None:
        raise ValueError("give scales or distance, not both")
    name, factors = "scales", (1.0, 1.0)
    if scales is not None:
        low, high = check_array(scales, "scales", (2,)).tolist()
        got = [check_number(low, name, above=0), check_number(high, name, at_least=low, unit="mm/rad")]
    elif distance is not None:
        name, factors = "distance", (LEAST_COMPRESSION, LARGEST_COMPRESSION)
        length = got = check_number(distance, name, above=0, unit="mm")
        low, high = length / LARGEST_COMPRESSION, length / LEAST_COMPRESSION
    elif start is not None:
        name, got = "the scale of start", start[1].scale
        low, high = got / _BEYOND**2, got * _BEYOND**2
    else:
        low, high = disc.radius / math.radians(WIDEST), disc.radius / math.radians(NARROWEST)
        return (low, high), (low / _BEYOND, high * _BEYOND)
    least, largest = disc.radius / math.radians(LARGEST_ANGLE), disc.radius / math.radians(LEAST_ANGLE)
    if high < least or low > largest:
        unit = "mm" if name == "distance" else "mm/rad"
        raise ValueError(
            f"{name} must be from {least * factors[0]:.3g} to {largest * factors[1]:.3g} {unit} for this map (half "
            f"angles of {LEAST_ANGLE:g} to {LARGEST_ANGLE:g} degrees for its radius of {disc.radius:.3g} mm), got "
            f"{short_text(got)}"
        )
    bounds = max(low, least), min(high, largest)
    return bounds, bounds


def _judged(measured, disc, bins, material, patterns, fits, proper, n, bounds, marked, contradiction):
    """Candidates of the best fits, and whether they decide."""
    evidence = _evidence(fits)
    structured = bins.structure > LEAST_STRUCTURE * bins.structure_error
    structured = structured or max(fit.gain for _, fit in fits) >= LEAST_GAIN
    scores = [float(np.clip(fit.explained, 0, 1)) if structured else 0.0 for _, fit in fits]
    weights = np.exp(0.5 * (evidence - evidence[0]))
    candidates = []
    for (number, fit), weight, score in zip(fits[:n], weights / weights.sum(), scores, strict=False):
        contrast = float(fit.amplitudes.sum())
        candidates.append(
            Candidate(
                orientation=_orientation(material, fit.matrix, proper),
                projection=_projection(disc, fit, bounds),
                score=score,
                confidence=float(weight),
                rolled=float(fit.amplitudes[1] / max(contrast, 1e-9)),
                contrast=contrast,
                angle_error=float(np.degrees(np.sqrt(np.trace(fit.covariance[:3, :3]) * fit.dispersion))),
                pattern=patterns[number],
            )
        )
    margin, best = math.inf, scores[0]
    if len(fits) > 1:
        margin = float(evidence[0] - evidence[1])
    next_best = max(scores[1:], default=0.0)
    decided = margin > DECIDED and (marked or next_best < RIVAL * best)
    floor = f"{np.floor(margin):.0f}"  # 11.6 is not 12
    numbers = f"{best:.2f} of the structure instead of {next_best:.2f} (margin {floor}; {DECIDED:g} is needed)"
    if not structured:
        decided, reason = False, "the map has no structure beyond its noise"
    elif contradiction:
        decided, reason = False, contradiction
    elif not marked and measured.is_counts and measured.ions < LEAST_IONS:
        decided, reason = False, f"{measured.ions:,} ions are too few to decide: {LEAST_IONS:,} are needed; {numbers}"
    elif decided and not marked and best < LEAST_SCORE:
        decided, reason = False, f"no orientation explains {LEAST_SCORE:.2f} of the structure: the first {numbers}"
    elif decided and best <= next_best:
        reason = f"only it fits the marks and the map (margin {floor}; {DECIDED:g} is needed)"
    elif decided:
        reason = f"it explains more than any other orientation or scale, {numbers}"
    elif margin > DECIDED:
        reason = f"another orientation or scale explains nearly as much: the first {numbers}"
    else:
        several = int(np.count_nonzero(evidence > evidence[0] - DECIDED))
        reason = f"{several} orientations or scales explain the map about equally well, {numbers}"
    return Indexing(measured, tuple(candidates), decided, reason)


def _orientation(material, matrix, proper):
    """The equal orientation whose axis is in the standard triangle, or in its mirror image."""
    axes = np.einsum("nij,j->ni", proper, matrix[2])
    general = np.array([0.36, 0.52, 0.775]) if material.structure != "hcp" else np.array([0.5, 0.13, 0.85])
    mirrored = general * (-1, 1, 1) if material.structure != "hcp" else general * (1, -1, 1)
    member = proper[np.maximum(axes @ general, axes @ mirrored - 1e-3).argmax()]
    return Orientation.from_matrix(material, matrix @ member.T)


def _projection(disc, refined, bounds):
    """The projection whose radius has the same first two terms: equidistant, or compressed for a negative stretch."""
    stretch = refined.stretch
    scale = float(np.clip(refined.scale_at_centre, *bounds))  # by rounding
    if stretch > NO_STRETCH:
        return Projection(scale, disc.centre)
    return Projection(scale, disc.centre, compression=math.sqrt(-(1 - stretch) / (3 * stretch)) * disc.radius / scale)
