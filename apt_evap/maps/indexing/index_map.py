"""Which crystal direction is where on a map: the search, its refinement, and what the map decides."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from apt_evap._common.blas_threads import one_blas_thread
from apt_evap._common.types import Floats
from apt_evap._common.validation import check_array, check_count, check_kind, check_number, check_sequence, short_text
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.detection.projection import Projection
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.maps.folded_map import FoldedMap, folded
from apt_evap.maps.gains import Densities, DensityGains, density_gains
from apt_evap.maps.indexing.contrast_search import Terms, terms_of
from apt_evap.maps.indexing.deciding_marks import deciding_marks
from apt_evap.maps.indexing.drawn_star import best_star
from apt_evap.maps.indexing.halves_and_surrogates import second_grain, second_lattice, surrogates_of, unseen_grain
from apt_evap.maps.indexing.joint_search import CONTRAST, COUNTED, JOINT, JointSearch
from apt_evap.maps.indexing.marked_poles import Mark, check_places, contradictory_marks, contradictory_pair, marks_of
from apt_evap.maps.indexing.master_pattern import MasterPattern, master_patterns, mixture
from apt_evap.maps.indexing.orientation_search import Start, UnusableMap, disc_of, flattened_by_rings
from apt_evap.maps.indexing.refine import Refined, refine, resolution
from apt_evap.maps.indexing.two_criteria import View, Weighed, angle_between, dispersion_of, view_of, weighed
from apt_evap.specimen.materials import Material, as_material
from apt_evap.specimen.symmetry import point_group

WIDEST, NARROWEST = 45.0, 12.0
"""Half angles of the field of view between which the scale is searched, if it is not known [degrees]."""
LARGEST_ANGLE, LEAST_ANGLE = 60.0, 5.0
"""Half angles of the field of view that a scale may give [degrees]."""
DIFFERENT = 6.0
"""Angle between the crystal directions that two results give to the places of a map, its RMS, above which they are
different results [degrees]: in orientation, or in scale."""
DECIDED = 20.0
"""Evidence over the next best orientation or scale above which a map decides, see the notes of `index`."""
SECOND_LATTICE = 12.0
"""Evidence of another orientation in a half of the map above which it may hold a second lattice."""
LEAST_EVIDENCE = 6.0
"""Evidence of the local contrast of a whole map, over that of no crystal, from which on it is one: "strong" by
R. E. Kass and A. E. Raftery, J. Am. Stat. Assoc. 90, 773 (1995). Four twins that the counts alone preferred, 5 to 21
degrees off, have -13 to 4, right ones 22 and more, measured tungsten 16 to 26."""
SEEN_STAR, OVER_STAR = 20.0, 30.0
"""Evidence of the local contrast for a star of drawn lines (`drawn_star`) from which on there may be one, and evidence
that an orientation must then have over it: twice the logarithm of the number of orientations and scales that a map
distinguishes, 2 to 6 million."""
CLEAR, UNSEEN, PART = 50.0, -40.0, 0.25
"""Evidence of the local contrast of a whole map from which on the winner must have the second number, and this part of
the evidence, in every half, no crystal being 0. Measured tungsten, cut at 60 mm and indexed as [001], has 58, and in a
half -32, bicrystals 62 and -26, 134 and -24, 154 and -14; right twins 63 and -22, 76 and -11, 112 and -8, measured
nickel 197 and 28."""
SECOND_GRAIN = 20.0
"""Evidence of a second grain in a segment above which a map may hold one, with the amplitudes of the winner."""
UNSEEN_GRAIN = 12.0
"""Evidence of no pattern over that of the winner in a segment at the rim, above which another grain may be there. In a
grain of the winner noise needs at least the root of it, 3.5 standard errors, and some 20 segments are independent. Of
110 judged twins one has more, 17, and of 98 with a second grain of 4 to 12 % 34; measured nickel has 2."""
ABOVE_SURROGATES = 3.0
"""Standard deviations above the surrogates of the map from which on a result is a crystal."""
RIVAL = 20.0
"""Evidence of another crystal structure over the own one above which the map is undecided, if the other one passes the
same checks; from -RIVAL on the map decides for the structure that was given, and the reason names the other one."""
UNPROVED = 40.0
"""The same of another structure that does not pass the checks, above which the map is undecided, too: a drawn star of
six lines, as nickel, has 58 for hcp."""
EXCLUDED = 45.0
"""Evidence below the own one, on the grid of the search, at which another crystal structure is not refined."""
LENS = 0.1
"""Standard deviation of the prior of the change of the scale to the rim, for the candidates. With that of the search,
0.05, their scale is 4.0 % off (RMS), with 0.1 and 0.2 3.6 %, for 150 twins with lenses of -20 to 20 %."""
COMMON = 0.02
"""Relative error of a scale that all patterns have in common, beside that by noise and the standard deviation of the
scales with patterns of single radii: lines and poles of a specimen are not those of the patterns. The most likely one
for 40 twins of Al and W, with lenses of -20 to 20 %, is between 0.020 and 0.025; their deviations correlate with the
standard deviation of the radii (0.7), but not with the noise (-0.1)."""
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
_STARTS, _TO_THE_END = 8, 5  # orientations by each criterion that are refined quickly, and to the end
_FEW_STARTS, _FEW_TO_THE_END = 3, 2  # of another crystal structure at first
_STAGES = (1, 1, 120.0), (_FEW_STARTS, _FEW_TO_THE_END, 80.0), (_STARTS, _TO_THE_END, math.inf)
"""Starts of another crystal structure by each criterion, how many are refined to the end, and evidence below the own
one at which no more are refined: more starts than the few gain up to 68, more than one up to 19 (11 crystals)."""
_TYPICAL = {"fcc": "Ni", "bcc": "W", "diamond": "Si", "hcp": "Ti"}  # crystals of the patterns
_SEARCHED, _REFINED, _CHECKED = 0.13, 0.25, 0.35  # parts of the time of a decided map, measured for nickel
_BEYOND = 1.1  # refined scales may leave bounds that nobody gave by this factor: the stretch changes the scale
_OTHER_SCALES = 1.12  # factor of the scales at which other crystals are searched for their densities
_MAP_BINS = 128
_LENS_STEPS = 20  # of the refinement of a candidate at most
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
        beyond the noise. It does not decide: the right orientation of measured nickel has 0.18, others have 0.3.
    confidence : float
        Confidence that this candidate, or an orientation within 6 degrees, is right, if one of the candidates is.
    rolled : float
        Part of the pattern of ions that roll up, 0 to 1.
    contrast : float
        Sum of the amplitudes of the patterns; 1 for a map like the simulated ones, less for fainter lines.
    angle_error : float
        Standard error of the orientation by noise alone [degrees].
    pattern : MasterPattern
        The mixture of the patterns of all radii that fits best.
    rim_change : float
        Relative change of the distance per angle from the centre to the rim of the field of view, by a lens or by the
        flight: negative for a barrel. The scale of the projection is that at the centre. Both are fitted again, with
        the orientation, after the verdict, whose score and confidence are of a smaller change.
    scale_error : float or None
        Standard error of this scale [mm/rad], by noise and by what the patterns leave open: lines and poles of a
        specimen are not those of the patterns, and scales with patterns of other radii are others. At a bound that was
        given it is the error without the bound. None if the scale was not fitted.
    """

    orientation: Orientation
    projection: Projection
    score: float
    confidence: float
    rolled: float
    contrast: float
    angle_error: float
    pattern: MasterPattern
    rim_change: float = 0.0
    scale_error: float | None = None

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
            "barrel": projection.barrel,
            "rim_change": self.rim_change,
            "scale_error": self.scale_error,
            "score": self.score,
            "confidence": self.confidence,
            "rolled": self.rolled,
            "contrast": self.contrast,
            "angle_error": self.angle_error,
            "pattern_radius": self.pattern.apex_radius,
        }

    def __str__(self):
        axis = " ".join(f"{index:.2f}" for index in self.orientation.axis)
        change = round(100 * self.rim_change)
        rim = f", {abs(change)} % {'more' if change > 0 else 'less'} at the rim" if change else " and at the rim"
        error = "" if self.scale_error is None else f" ± {self.scale_error:.1f}"
        scale = f"{self.projection.scale:.1f}{error} mm/rad in the centre"
        return f"[{axis}], rotation {self.orientation.rotation:.1f}°, {scale}{rim}"


@dataclass(frozen=True, eq=False)
class Indexing:
    """Orientations that a map may show, and whether it decides; the result of `index`.

    Parameters
    ----------
    map : DetectorMap
        The map.
    candidates : tuple of Candidate
        Different orientations, or scales of one orientation, the best one first; none for a map that cannot show any.
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
        """The first candidate; a ValueError with the reason if there is none."""
        if not self.candidates:
            raise ValueError(f"no orientation: {self.reason}")
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

    def density_gains(
        self, plane: Sequence[int], pattern: Densities | None = None, *, reach: float = 20.0, seed: int = 0
    ) -> DensityGains:
        """How much better a pattern reproduces the densities about a pole than drawn lines, or other crystals, do.

        Parameters
        ----------
        plane : sequence of int
            Miller indices of a family of planes; of its poles the one nearest to the axis.
        pattern : callable, optional
            Densities of shape (k, n) in the directions of the specimen (n, 3), such as those of a run; by default the
            patterns of the package for the first candidate.
        reach, seed
            As for `maps.density_gains`.

        Returns
        -------
        DensityGains
            The other crystals are searched at scales within 12 % of that of the first candidate.
        """
        best = self.best
        view = view_of(flattened_by_rings(disc_of(self.map)))
        scale = best.projection.scale
        bounds = scale / _OTHER_SCALES, scale * _OTHER_SCALES

        def densities(orientation, projection):
            patterns = master_patterns(orientation.material.structure)

            def at(directions):
                crystal = projection.directions(best.projection.places(directions)) @ orientation.matrix
                return np.concatenate([each.at(crystal, sigma=_SHOWN_SIGMA) for each in patterns])

            return at

        others = []
        with one_blas_thread():
            for structure, element in _TYPICAL.items():
                if structure == best.orientation.material.structure:
                    continue
                crystal = _Crystal(view, as_material(element), master_patterns(structure), bounds, bounds)
                results = crystal.refined(crystal.starts(_FEW_STARTS), _FEW_TO_THE_END)
                fit = crystal.different(results, dispersion_of([item.fit for item in results]))[0][0].fit
                group = point_group(structure)
                orientation = _orientation(crystal.material, fit.matrix, group[np.linalg.det(group) > 0])
                others.append(densities(orientation, _projection(view.disc, fit, bounds)))
            pattern = densities(best.orientation, best.projection) if pattern is None else pattern
            return density_gains(
                self.map, best.orientation, best.projection, pattern, plane, others=others, reach=reach, seed=seed
            )

    def to_dict(self) -> dict[str, Any]:
        """Return the result in plain types, without the map.

        Returns
        -------
        dict
            verdict, reason, of each candidate its axis, rotation, scale, centre, barrel, rim_change, scale_error,
            score, confidence, rolled, contrast, angle_error and the radius of the pattern, and the sentences of
            `deciding_marks`.
        """
        return {
            "verdict": self.verdict,
            "reason": self.reason,
            "candidates": [candidate._plain() for candidate in self.candidates],
            "deciding_marks": list(self.deciding_marks),
        }

    def __repr__(self) -> str:
        several = "s" * (len(self.candidates) != 1)
        first = f", first {self.best}" if self.candidates else ""
        return f"<Indexing: {self.verdict}, {len(self.candidates)} candidate{several}{first}>"

    def __str__(self):
        rows = [f"{self.verdict}: {self.reason}"]
        shown = self.candidates[: 1 if self.decided else SHOWN]
        rows += [f"{number}. {candidate}" for number, candidate in enumerate(shown, 1)]
        return "\n".join(rows + list(self.deciding_marks))

    @cached_property
    def deciding_marks(self) -> tuple[str, ...]:
        """Sentences: which marked pole would decide between the first candidates of an undecided map."""
        if self.decided or not self.candidates or self.best.score == 0:
            return ()
        shown = self.candidates[:SHOWN]
        seen = disc_of(self.map).map  # a map without a mask has corners where nothing can be marked
        return deciding_marks(seen, [(candidate.orientation, candidate.projection) for candidate in shown])


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
    progress: Callable[[float], None] | None = None,
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
    progress : callable, optional
        Called after each step with the part of the search that is done, between 0 and 1. An error that it raises ends
        the search.

    Returns
    -------
    Indexing

    Raises
    ------
    ValueError
        If there is no pattern of the structure, an argument is outside its range, or a mark is outside the map.

    Notes
    -----
    The map is divided by the trimmed mean of every ring about its centre. A search over all axes, rotations and scales
    compares its counts with master patterns, the simulated densities of hits in every direction of the crystal, for
    ions that roll up and for ions that do not; and its local contrast with the patterns, with zone lines that may be
    bright or dark, and with dark poles: what a person sees. The best results are refined by two criteria. One is the
    likelihood of the counts, with free amplitudes of the patterns of all radii and a slow change of the efficiency:
    twice its logarithm, divided by the variance of the sums of neighbouring residuals of the best model in units of
    Poisson's, so that a model that leaves structure unexplained decides less. The other one is twice the logarithm of
    the marginal likelihood of the local contrast. Their sum is the evidence of a result.

    The map is `decided` if the first result passes five checks. (1) Its evidence is more than 20 above that of the next
    different result. Results are different if they give crystal directions to the places of the map that are more than
    6 degrees apart (RMS): other orientations, or the same one at another scale. (2) No half of the map has another
    orientation with 12 more than the first result, and than no crystal; the first result is seen everywhere at the rim,
    and in every half if the local contrast of the map is clear: else it may hold a second lattice. (3) A drawing of
    lines through one point, without a crystal, explains the local contrast less well, by 30. (4) The map is more
    than 3 standard deviations above the mean of its surrogates, and above all of them: maps with the same rings and
    lines at random azimuths. (5) No other crystal structure, searched as hard, has 20 more; one that is within 20 is
    named, as the result holds only if the specimen is what you say. The map also needs 4,000 ions. With marks of a user
    only the first check applies. The reason says which check refused, and what would help.

    A map of noise has a score of 0. A map that can show no orientation, such as one without hits, is undecided and has
    no candidates. Marks that no orientation explains, or that contradict the map, are named in the reason, and the map
    is not decided. `Indexing.deciding_marks` says which mark would decide. The scale of a candidate is that at the
    centre, with an error; a lens changes it to the rim, and both are printed.

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
    >>> found.reason.partition("its scale is that of ")[2]
    'a flight length of 72 to 132 mm: if yours is another one, give it (distance, --distance)'
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
    if not len(patterns):
        raise ValueError("patterns must be one MasterPattern or more, got none")
    for pattern in patterns:
        check_kind(pattern, "patterns", MasterPattern, "MasterPattern")
        if pattern.structure != material.structure:
            raise ValueError(f"patterns must be of {material.structure}, got {pattern!r}")
    marks = marks_of(material, poles, lines)
    n = check_count(candidates, "candidates", at_least=1)
    try:
        disc = disc_of(measured)
        view = view_of(flattened_by_rings(disc))
    except UnusableMap as error:
        return Indexing(measured, (), False, str(error))
    check_places(marks, measured, disc.radius)
    unbounded = scales is None and distance is None
    scales, bounds = _scales(disc, scales, distance, start)
    crystal = _Crystal(view, material, patterns, scales, bounds, marks)
    told = progress or (lambda part: None)
    with one_blas_thread():
        if start is None:
            starts = crystal.starts()
            told(_SEARCHED)
            results = crystal.refined(starts)
        else:
            results = crystal.refined([Start(_matrix_at(disc.centre, *start), start[1].scale, 0.0)])
        told(_REFINED)
        dispersion = dispersion_of([item.fit for item in results])
        different, weights = crystal.different(results, dispersion)
        contradiction = contradictory_pair(marks, disc.centre, bounds)
        contradiction = contradiction or contradictory_marks(marks, different[0].fit.deviations)
        result = _judged(measured, crystal, different, weights, n, contradiction)
        if start is not None:
            return replace(result, decided=False, reason="refined from a given orientation, others were not searched")
        if result.decided and not marks:
            result = _checked(result, crystal, different[0], dispersion, float(weights[0]), told)
    if result.decided and unbounded:
        # a single pole that the emission blurs may fit at a wrong scale: a user knows the instrument
        low, high = (factor * result.best.projection.scale for factor in (LEAST_COMPRESSION, LARGEST_COMPRESSION))
        return replace(result, reason=(
            f"{result.reason}; its scale is that of a flight length of {low:.0f} to {high:.0f} mm: if yours is another "
            "one, give it (distance, --distance)"
        ))  # fmt: skip
    return result


class _Crystal:
    """A crystal to which a map is compared.

    Parameters
    ----------
    view : View
        The map.
    material : Material
        The crystal.
    patterns : sequence of MasterPattern
        Its patterns.
    scales, bounds : tuple of float
        Smallest and largest scale of the search, and of the results [mm/rad].
    marks : sequence of Mark
        Marks of a user.
    """

    def __init__(
        self,
        view: View,
        material: Material,
        patterns: Sequence[MasterPattern],
        scales: tuple[float, float],
        bounds: tuple[float, float],
        marks: Sequence[Mark] = (),
    ) -> None:
        self.view, self.material, self.patterns, self.scales, self.bounds = view, material, patterns, scales, bounds
        self.marks = marks
        self._known: dict[tuple, Any] = {}
        self._starts: list[list[Start]] | None = None
        packaged = patterns is master_patterns(material.structure)
        self.terms = terms_of(material) if packaged else Terms(material, patterns)

    @cached_property
    def search(self) -> JointSearch:
        """Comparison with all orientations and scales."""
        return JointSearch(self.view.disc, self.view.picture, self.terms, self.patterns, self.scales, self.marks)

    @cached_property
    def densities(self) -> Floats:
        """Densities of the patterns, smoothed for the bins, shape (k, m, m)."""
        sigma = resolution(self.view.disc, math.sqrt(self.scales[0] * self.scales[1]))
        return np.concatenate([pattern.smoothed(sigma) for pattern in self.patterns], dtype=np.float32)

    def starts(self, n: int = _STARTS) -> list[Start]:
        """Best `n` orientations of the search by every criterion."""
        if self._starts is None:
            self._starts = [self.search.starts(criterion, _STARTS) for criterion in (CONTRAST, COUNTED, JOINT)]
        found = [start for best in self._starts for start in best[:n]]
        if self.marks:  # which may be wrong
            found += self.search.starts(JOINT, _STARTS, marked=False)
        return found

    def refined(self, starts: Sequence[Start], n: int = _TO_THE_END) -> list[Weighed]:
        """Orientations, refined by both criteria; the best `n` by either to the end."""
        results = weighed(self.view, self.terms, self.densities, starts, n, self.bounds, self.marks, self._known)
        if self.bounds != self.scales:
            low, high = self.bounds
            results = [item for item in results if low * 1.001 < item.fit.scale_at_centre < high / 1.001] or results
        return results

    def with_lens(self, fit: Refined) -> tuple[Refined, float]:
        """A result with the prior of a lens, whose scale and change to the rim decide nothing, and its scale error."""
        disc, bins, _ = self.view

        def refined(densities, near, amplitudes, bounds):
            return refine(
                bins, disc, densities, near.matrix, near.scale, amplitudes, self.marks, _LENS_STEPS, bounds,
                near.stretch, LENS,
            )  # fmt: skip

        best = refined(self.densities, fit, fit.amplitudes, self.bounds)
        bounds = best.scale_at_centre / _BEYOND**2, best.scale_at_centre * _BEYOND**2
        radii = np.split(self.densities, len(self.patterns))
        scales = [refined(densities, best, None, bounds).scale_at_centre for densities in radii]
        spread = float(np.std(scales, ddof=1)) if len(scales) > 1 else 0.0
        return best, math.hypot(best.scale_error, spread, COMMON * best.scale_at_centre)

    def different(self, results: Sequence[Weighed], dispersion: float) -> tuple[list[Weighed], Floats]:
        """Results that are different orientations or scales, the best one first, and their weights."""
        group = point_group(self.material.structure)
        different: list[Weighed] = []
        for item in sorted(results, key=lambda item: -item.weight(dispersion)):
            if all(angle_between(item.fit, other.fit, group, self.view.disc.radius) > DIFFERENT for other in different):
                different.append(item)
        return different, np.array([item.weight(dispersion) for item in different])

    def refusal(self, best: Weighed) -> str:
        """Why the best result is no single crystal, in one sentence; empty if it passes the checks it can fail."""
        if best.evidence < LEAST_EVIDENCE:
            return (
                "only the ion density over large areas prefers this orientation: its lines and poles have evidence "
                f"{_floor(best.evidence)} against a map without any, where {LEAST_EVIDENCE:g} is needed; more ions, or "
                "a marked pole would help"
            )
        second, least = second_lattice(self.view, self.terms, best.fit)
        if second > SECOND_LATTICE:
            return (
                "the map may hold a second lattice: the lines and poles in half of it fit another orientation better, "
                f"with evidence {_floor(second)} over this one, where {SECOND_LATTICE:g} is allowed; a map of one "
                "grain would help"
            )
        limit = UNSEEN + PART * best.evidence
        if best.evidence > CLEAR and least < limit:
            return (
                "the map may hold a second lattice: the lines and poles of the whole map have evidence "
                f"{_floor(best.evidence)} for the orientation, but those in half of it {_floor(least)}, where "
                f"{_floor(limit)} is needed; a map of one grain, or another part of the map would help"
            )
        grain = second_grain(self.view, self.terms, best.fit)
        if grain.evidence > SECOND_GRAIN:
            return (
                f"the map may hold a second grain: farther than {grain.chord:g} radii towards {grain.azimuth:.0f} "
                f"degrees lines and poles fit another orientation better, with evidence {_floor(grain.evidence)} "
                f"over this one, where {SECOND_GRAIN:g} is allowed; a map of one grain would help"
            )
        grain = unseen_grain(self.view, self.densities, best.fit)
        if grain.evidence > UNSEEN_GRAIN:
            return (
                f"the map may hold a second grain: farther than {grain.chord:g} radii towards {grain.azimuth:.0f} "
                "degrees the pattern of this orientation is not seen, the counts without it have evidence "
                f"{_floor(grain.evidence)}, where {UNSEEN_GRAIN:g} is allowed; a map of one grain would help"
            )
        star = best_star(self.view.picture)
        if star.evidence > SEEN_STAR and best.evidence < star.evidence + OVER_STAR:
            lines = f"{star.lines} straight line{'s' * (star.lines > 1)} through one point"
            about = "better than" if star.evidence > best.evidence else "about as well as"
            return (
                f"{lines}, at any angles and without a crystal, explain{'s' * (star.lines == 1)} the bright and dark "
                f"features of the map {about} this orientation does: evidence {_floor(star.evidence)} for the "
                f"{'line' if star.lines == 1 else 'lines'} and {_floor(best.evidence)} for the orientation, where "
                f"{OVER_STAR:g} more than for the lines are needed; a wider field of view with a second pole, or a "
                "marked pole would help"
            )
        surrogates = surrogates_of(self.view, self.search, self.terms, self.densities, self.bounds, best.fit)
        if surrogates.above or surrogates.deviations <= ABOVE_SURROGATES:
            return (
                "maps with the same rings and lines at random azimuths are explained about as well: this one is "
                f"{surrogates.deviations:.1f} standard deviations above their mean, where more than "
                f"{ABOVE_SURROGATES:g} are needed, and {surrogates.above} of {len(surrogates.weights)} are above it, "
                "where none may be; more ions or a marked pole would help"
            )
        return ""


def _checked(result, crystal, best, dispersion, weight, told):
    """The result of a map that prefers one orientation, if it passes the checks that it can fail, or undecided."""
    if refusal := crystal.refusal(best):
        return replace(result, decided=False, reason=refusal)
    told(_CHECKED)
    excess, rival = _best_rival(crystal, dispersion, weight, told)
    if excess <= -RIVAL:
        return result
    name, structure = crystal.material.name, rival.material.structure
    if excess > RIVAL:
        # what nobody asked for needs the same proof
        different, weights = rival.different(rival.refined(rival.starts()), dispersion)
        preferred = len(weights) == 1 or weights[0] - weights[1] > DECIDED
        if excess > UNPROVED or (preferred and not rival.refusal(different[0])):
            return replace(result, decided=False, reason=(
                f"a {structure} crystal explains the map better, with evidence {_floor(excess)} over {name}; if the "
                f"specimen is {name}, bounds of the scale or a marked pole would help, and if not, a {structure} "
                "material"
            ))  # fmt: skip
        return replace(result, reason=(
            f"{result.reason}; it holds if the specimen is {name}: a {structure} crystal has evidence "
            f"{_floor(excess)} over it, but does not pass the checks that this result passes"
        ))  # fmt: skip
    return replace(result, reason=(
        f"{result.reason}; it holds if the specimen is {name}: the evidence of a {structure} crystal is "
        f"{_floor(abs(excess))} {'larger' if excess > 0 else 'smaller'}"
    ))  # fmt: skip


def _best_rival(crystal, dispersion, weight, told):
    """Largest evidence of another crystal structure over the own one, and this crystal."""
    best = -math.inf, crystal
    for number, (structure, element) in enumerate(_TYPICAL.items()):
        told(_CHECKED + (1 - _CHECKED) * number / len(_TYPICAL))
        if structure == crystal.material.structure:
            continue
        patterns = master_patterns(structure)
        rival = _Crystal(crystal.view, as_material(element), patterns, crystal.scales, crystal.bounds)
        if rival.search.largest <= crystal.search.largest - EXCLUDED:
            continue
        # as hard as the own structure, unless a few starts show that it is far below
        for starts, to_the_end, hopeless in _STAGES:
            results = rival.refined(rival.starts(starts), to_the_end)
            excess = max(item.weight(dispersion) for item in results) - weight
            if excess > best[0]:
                best = excess, rival
            if excess < -hopeless:
                break
    return best


def _floor(number):
    return f"{math.floor(number):d}"  # 11.6 is not 12


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
        got = [
            check_number(low, name, above=0),
            check_number(high, "the second of scales", at_least=low, unit="mm/rad"),
        ]
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


def _judged(measured, crystal, results, weights, n, contradiction):
    """Candidates of the best results, and whether the first one is preferred."""
    disc, bins, _ = crystal.view
    material, patterns = crystal.material, crystal.patterns
    fits = [item.fit for item in results]
    structured = bins.structure > LEAST_STRUCTURE * bins.structure_error
    structured = structured or max(fit.gain for fit in fits) >= LEAST_GAIN
    scores = [float(np.clip(fit.explained, 0, 1)) if structured else 0.0 for fit in fits]
    confidences = np.exp(0.5 * (weights - weights[0]))
    confidences /= confidences.sum()
    proper = point_group(material.structure)
    proper = proper[np.linalg.det(proper) > 0]
    fits, errors = zip(*(crystal.with_lens(fit) for fit in fits[:n]), strict=True)
    candidates = tuple(
        Candidate(
            orientation=_orientation(material, fit.matrix, proper),
            projection=_projection(disc, fit, crystal.bounds),
            rim_change=-fit.stretch,
            scale_error=error if math.isfinite(error) else None,
            score=score,
            confidence=float(confidence),
            rolled=float(fit.amplitudes[1::2].sum() / max(fit.amplitudes.sum(), 1e-9)),
            contrast=float(fit.amplitudes.sum()),
            angle_error=float(np.degrees(np.sqrt(np.trace(fit.covariance[:3, :3]) * fit.dispersion))),
            pattern=mixture(patterns, fit.amplitudes),
        )
        for fit, error, confidence, score in zip(fits, errors, confidences, scores, strict=False)
    )
    margin = float(weights[0] - weights[1]) if len(weights) > 1 else math.inf
    decided = margin > DECIDED
    numbers = f"evidence over the next best one {_floor(min(margin, 9999))}; {DECIDED:g} is needed"
    if not structured:
        decided, reason = False, "the map has no structure beyond its noise"
    elif contradiction:
        decided, reason = False, contradiction
    elif not crystal.marks and measured.is_counts and measured.ions < LEAST_IONS:
        decided, reason = False, f"{measured.ions:,} ions are too few to decide: {LEAST_IONS:,} are needed"
    elif decided:
        reason = f"counts and local contrast fit it better than any other orientation or scale ({numbers})"
    else:
        several = int(np.count_nonzero(weights > weights[0] - DECIDED))
        equal = {2: "candidates 1 and 2", 3: "candidates 1 to 3"}.get(several, f"{several} orientations or scales")
        reason = (
            f"{equal} explain the map about equally well ({numbers}); more ions, bounds of the scale or a marked pole "
            "would help"
        )
    return Indexing(measured, candidates, decided, reason)


def _orientation(material, matrix, proper):
    """The equal orientation whose axis is in the standard triangle, or in its mirror image."""
    axes = np.einsum("nij,j->ni", proper, matrix[2])
    general = np.array([0.36, 0.52, 0.775]) if material.structure != "hcp" else np.array([0.5, 0.13, 0.85])
    mirrored = general * (-1, 1, 1) if material.structure != "hcp" else general * (1, -1, 1)
    member = proper[np.maximum(axes @ general, axes @ mirrored - 1e-3).argmax()]
    return Orientation.from_matrix(material, matrix @ member.T)


def _projection(disc, refined, bounds):
    """The projection of a fit."""
    scale = float(np.clip(refined.scale_at_centre, *bounds))  # by rounding
    return Projection(scale, disc.centre, barrel=refined.stretch * (refined.scale / disc.radius) ** 2)
