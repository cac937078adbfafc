"""Registration: rotation, scale, shift and mirror that transform a simulated map into the frame of a measured one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.codec import checked, from_plain, number, part, settings, switch, vector
from apt_evap._common.types import Floats
from apt_evap._common.validation import (
    check_array,
    check_count,
    check_kind,
    check_number,
    check_sequence,
    check_switch,
    check_values,
    short_text,
)
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.detection.hits import Hits
from apt_evap.maps.registration.correlation_search import (
    FEWEST,
    FINE,
    MEDIUM,
    NARROW,
    ROTATION_STEP,
    SCALE_STEP,
    ShiftBounds,
    View,
    distinct,
    hits_on,
    refine,
    search,
)
from apt_evap.maps.registration.patches import patch_displacements
from apt_evap.maps.registration.polynomial import LARGEST_DEGREE, Distortion, fit_polynomial
from apt_evap.maps.registration.transform import SimilarityTransform
from apt_evap.warnings import RegistrationWarning, warn

DOUBTFUL = 0.5
"""Limit of score times square root of the overlap. Wrong transforms reach 0.25 on noise, 0.5 on maps of other poles."""
_MAX_FITS = 12  # transforms that are refined: twice the number of symmetric ones of a threefold axis with mirrors
_AT_BOUND = 0.01  # part of the range of a search within which a result is at its bound
_BINS = 384  # bins of a map of simulated hits


def _score(value, name):
    """A number that may be NaN; in files NaN is None."""
    unknown = value is None or (isinstance(value, float) and value != value)
    return math.nan if unknown else check_number(value, name)


def _method(value, name):
    return check_kind(value, name, str, "a text")


def _ties(value, name):
    return tuple(check_kind(tie, name, Registration, "Registrations") for tie in check_sequence(value, name, _TIES))


def _read_ties(plain, name):
    return [from_plain(tie, Registration, what=name) for tie in check_sequence(plain, name, _TIES)]


_TIES = "Registrations"


@settings
class Registration:
    """A similarity transform from the simulated into the measured frame, made by `register` or `register_points`.

    Notes
    -----
    With z = x + iy, a point moves to z' = scale exp(i rotation) z + shift, with the conjugate of z if mirrored, and
    then by the distortion.

    Examples
    --------
    >>> registration = ae.Registration(rotation=30.0, scale=0.5, shift=(1.0, 2.0))
    >>> x, y = registration.points([10.0], [0.0])
    >>> print(f"({x[0]:.2f}, {y[0]:.2f}) mm")
    (5.33, 4.50) mm
    >>> print(registration.inverse)
    rotated by -30.00°, scaled by 2, shifted by (-3.73, -2.46) mm
    """

    rotation: float = number("Rotation, anticlockwise.", unit="degrees")
    scale: float = number("Measured mm per simulated mm.", above=0)
    shift: tuple = vector("Shift in x and y, applied last.", 2, unit="mm")
    mirror: bool = switch("Whether y changes sign, before the rotation.", default=False)
    score: float = checked(
        "Correlation coefficient of the flattened maps in their common area; NaN if points were registered.",
        "float",
        _score,
        default=float("nan"),
        read=_score,
    )
    overlap: float = checked(
        "Fraction of the measured field of view that the simulated map covers; NaN if points were registered.",
        "float",
        _score,
        default=float("nan"),
        read=_score,
    )
    residual: float = checked(
        "Root mean square distance of registered points; NaN if maps were registered.",
        "float",
        _score,
        default=float("nan"),
        read=_score,
        unit="mm",
    )
    method: str = checked(
        'Origin of the transform: "search", "start", "pole", "points", or "" if given by the user.',
        "str",
        _method,
        default="",
    )
    ties: tuple = checked(
        "Other transforms that are equally good within the noise, usually by the symmetry of the crystal.",
        "tuple of Registration",
        _ties,
        default=(),
        read=_read_ties,
    )
    distortion: Distortion | None = part(
        "Polynomial terms, applied last: the distortion of an instrument with a reflectron.", Distortion, default=None
    )

    def _check(self):
        return {"rotation": (self.rotation + 180) % 360 - 180}

    @property
    def transform(self) -> SimilarityTransform:
        """The transform of complex points, anchored at 0."""
        return SimilarityTransform(self.rotation, self.scale, self.mirror, place=complex(*self.shift))

    def points(self, x: ArrayLike, y: ArrayLike) -> tuple[Floats, Floats]:
        """Move points into the measured frame.

        Parameters
        ----------
        x, y : array_like
            Simulated detector coordinates [mm], of equal shape.

        Returns
        -------
        x, y : ndarray
            Measured detector coordinates [mm].
        """
        z = check_values(x, "x", finite=False) + 1j * check_values(y, "y", finite=False)
        z = self.transform.apply(z)
        if self.distortion is not None:
            z = self.distortion.apply(z)
        return z.real, z.imag

    def inverse_points(self, x: ArrayLike, y: ArrayLike) -> tuple[Floats, Floats]:
        """Move points of the measured frame into the simulated one; NaN where a distortion cannot be inverted.

        Parameters
        ----------
        x, y : array_like
            Measured detector coordinates [mm], of equal shape.

        Returns
        -------
        x, y : ndarray
            Simulated detector coordinates [mm].
        """
        z = check_values(x, "x", finite=False) + 1j * check_values(y, "y", finite=False)
        if self.distortion is not None:
            z = self.distortion.apply_inverse(z)
        z = self.transform.apply_inverse(z)
        return z.real, z.imag

    def hits(self, hits: Hits) -> Hits:
        """Move hits into the measured frame.

        Parameters
        ----------
        hits : Hits
            Simulated ions with x and y.

        Returns
        -------
        Hits
            With all their other columns as they were.
        """
        x, y = self.points(*hits.require("x", "y"))
        return replace(hits, x=x, y=y, extent=None)

    @property
    def inverse(self) -> Registration:
        """The transform from the measured into the simulated frame, a Registration without score.

        Raises
        ------
        ValueError
            With a distortion: use `inverse_points`.
        """
        if self.distortion is not None:
            raise ValueError("a registration with a distortion has no inverse Registration, use inverse_points(x, y)")
        inverse = self.transform.inverse
        back = Registration(inverse.rotation, inverse.scale, (0.0, 0.0), inverse.mirror)
        shift = -back.transform.apply(inverse.anchor)  # with the angle of `back`, to the last bit
        return replace(back, shift=(float(shift.real), float(shift.imag)))

    @property
    def doubtful(self) -> bool:
        """Whether the search had no start, and its score is in the range of unrelated maps."""
        return self.method == "search" and self.score * np.sqrt(self.overlap) < DOUBTFUL

    def warn_if_doubtful(self) -> None:
        """Warn if the registration is `doubtful`."""
        if self.doubtful:
            warn(
                f"the registration is doubtful: the correlation of the maps is only {self.score:.2f} in their common "
                f"area ({self.overlap:.0%} of the measured one), as for unrelated maps; plot the overlay, check the "
                "axis of the simulated specimen, and give known values of rotation, scale and shift",
                RegistrationWarning,
            )

    def to_text(self) -> str:
        """Return the transform as ``--registration`` takes it: ROTATION,SCALE,DX,DY[,mirror] (str)."""
        return ",".join([*map(repr, (self.rotation, self.scale, *self.shift)), *(["mirror"] if self.mirror else [])])

    def __str__(self):
        parts = [f"rotated by {self.rotation:.2f}°", f"scaled by {self.scale:.4g}"]
        parts.append(f"shifted by ({self.shift[0]:.2f}, {self.shift[1]:.2f}) mm")
        if self.mirror:
            parts.insert(0, "mirrored")
        if self.distortion is not None:
            parts.append(f"with a distortion of degree {self.distortion.degree}")
        return ", ".join(parts)


def register(
    simulated: DetectorMap | Hits,
    measured: DetectorMap | Hits,
    *,
    start: Registration | None = None,
    pole: tuple[Any, ...] | None = None,
    tolerance: float | None = None,
    rotations: float | tuple[float, ...] | None = None,
    scales: float | tuple[float, ...] | None = None,
    mirrors: Sequence[bool] | None = None,
    overlap: float = 0.5,
) -> Registration:
    """Find the rotation, scale, shift and mirror that transform a simulated map into a measured one.

    Each map is smoothed slightly and divided by a strongly smoothed copy. Poles and zone lines remain; broad density
    gradients, which would bias the scale, are removed. Every combination of rotation, scale and mirror is tried with
    all shifts at once. The best ones are then refined.

    Parameters
    ----------
    simulated, measured : DetectorMap or Hits
        The maps; the measured map may show any part of the simulated one.
    start : Registration, optional
        Approximate transform. The search is limited to 15 degrees, 20 % of the scale, a fifth of the measured diameter
        and the same mirror, unless the following parameters are given.
    pole : tuple, optional
        Position of one pole in both frames, simulated and measured: ((x, y), (x, y)) [mm].
    tolerance : float, optional
        Largest distance between the transformed simulated pole and the measured one, in x and in y [mm]; by default
        1/50 of the measured diameter. With `start` and no pole, that of the centre of the measured map.
    rotations : float or tuple of float, optional
        Rotation, or its lower and upper bound [degrees]; all by default.
    scales : float or tuple of float, optional
        Scale, or its lower and upper bound [measured mm per simulated mm], known for example from angles between poles.
        By default the simulated map covers at least half of the measured area, and the measured map at least 1/25 of
        the simulated area and 1,000 simulated hits (or a quarter of them all): fewer fit anywhere by chance.
    mirrors : sequence of bool, optional
        Whether to try the simulated map unmirrored, mirrored, or both: (False, True), the default.
    overlap : float
        Smallest fraction of the measured field of view that the simulated map must cover.

    Returns
    -------
    Registration
        The best transform; among equally good ones within the noise, the best unmirrored one. The others are its
        ``ties``. A pole with mirror symmetry, such as fcc [111], always has ties.

    Raises
    ------
    ValueError
        If an argument is outside its range, or no transform has this overlap.

    Warns
    -----
    RegistrationWarning
        If the search had no start, and the score is in the range of unrelated maps, or if rotation, scale or shift are
        at a bound of the search.

    Notes
    -----
    The shifts are found by masked correlation in Fourier space (Padfield, IEEE Trans. Image Process. 21, 2706 (2012)),
    the refinement uses the simplex method of Nelder and Mead. Two scores r are equal within the noise if they differ by
    less than 2 sqrt(2 / n) (1 - r^2): two standard errors of a difference of correlation coefficients of n independent
    patches (here of area 4 pi sigma^2, with the smoothing sigma, 0.8 % of the diameter).

    Measured: known transforms of simulated maps were recovered within 0.2 degrees and 0.6 %, with scores of 0.83 to
    0.92, for 50,000 to 100,000 ions of another energy and a measured density that decreases across the map.

    The scale is biased, or the registration fails, in these cases. Lines are wider in one map, as for a smaller tip
    (between two halves of a run in which the tip got blunter: up to 2 %). Lines are dark in one map and bright in the
    other, as without and with roll-up. The simulated field of view covers less than `overlap` of the measured one; then
    a larger scale is found. Lines through a single pole look the same at any scale.

    Wrong transforms reach scores of 0.5 on maps of other poles, and 0.6 to 0.7 on maps of the same crystal along
    another axis, with similar poles.

    Examples
    --------
    >>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.5, axis=(1, 1, 1)), seed=1).run(400)
    >>> simulated = run.hits(ae.RollUp(0.2))
    >>> measured = ae.Registration(rotation=20.0, scale=0.3, shift=(1.0, 2.0)).hits(simulated)
    >>> maps = simulated.map(bins=32), measured.map(bins=32)
    >>> found = ae.register(*maps, rotations=(0, 40), scales=(0.25, 0.35), mirrors=[False])
    >>> print(f"rotated by {found.rotation:.0f} degrees, scaled by {found.scale:.2f}")
    rotated by 20 degrees, scaled by 0.30
    """
    simulated, measured = (_view(value, name) for value, name in ((simulated, "simulated"), (measured, "measured")))
    if start is not None and not isinstance(start, Registration):
        raise ValueError(f"start must be a Registration, got {start!r:.80}")
    least = check_number(overlap, "overlap", above=0, at_most=1)
    shift_bounds = _shift_bounds(start, pole, tolerance, measured)
    rotations, scales, mirrors = _transform_bounds(start, rotations, scales, mirrors)
    ratio = measured.diameter / simulated.diameter
    fewest = _fewest_hits(simulated) if scales is None else 0.0
    scale_range = _default_scales(simulated, fewest, ratio) if scales is None else scales

    # all transforms on a grid of rotations and scales, with the best shift of each
    angles = np.arange(0, 360, ROTATION_STEP) if rotations is None else _steps(rotations, ROTATION_STEP)
    fits = search(
        simulated, measured, angles, np.exp(_steps(np.log(scale_range), SCALE_STEP)), mirrors, least, shift_bounds
    )
    if not fits:
        raise ValueError(
            f"the simulated map must cover at least {least:.0%} of the measured field of view (overlap), which is "
            f"impossible for scales of {scale_range[0]:.3g} to {scale_range[1]:.3g}"
        )

    # the best of them refined with few pixels, then with many; those within the noise of the best one are ties
    bounds = rotations, scales, shift_bounds

    def shown(fit):
        return not fewest or hits_on(simulated, measured, fit.transform) >= fewest

    fits = [
        refine(simulated, measured, fit.transform, MEDIUM, least, *bounds)
        for fit in distinct(filter(shown, fits), _MAX_FITS)
    ]
    fits = [*filter(shown, fits)]
    if not fits:
        raise ValueError(
            f"the measured map must show at least {fewest:.0f} of the simulated hits, which no registration does: "
            "give scales, or simulate more ions"
        )
    fits = distinct(sorted(fits, key=lambda fit: -fit.rank), _MAX_FITS)
    fits = [fit for fit in fits if fit.rank > fits[0].rank - 2 * _noise(fits[0], MEDIUM)]
    for _ in range(2):  # repeated, with flattening at the new scale
        fits = [refine(simulated, measured, fit.transform, FINE, least, *bounds) for fit in fits]
    fits = sorted(fits, key=lambda fit: -fit.rank)
    fits = distinct([fit for fit in fits if fit.rank > fits[0].rank - _noise(fits[0], FINE)], _MAX_FITS)
    fits.sort(key=lambda fit: fit.transform.mirror)  # stable: each kind stays in the order of its rank

    # the result, with what may be wrong
    method = "search" if shift_bounds is None else "start" if pole is None else "pole"
    best, *ties = (_registration(fit, method) for fit in fits)
    best = replace(best, ties=tuple(ties))
    best.warn_if_doubtful()
    at = _bounds_reached(fits[0].transform, *bounds)
    if at:
        warn(
            f"the registration is at a bound of its search: {', '.join(at)}; widen it, or check the maps and the axis "
            "of the simulated specimen",
            RegistrationWarning,
        )
    return best


class ScoreSurface(NamedTuple):
    """Best correlation of two maps for every rotation and scale, over all shifts: the result of `score_surface`."""

    rotations: Floats
    """[degrees], shape (n,)."""
    scales: Floats
    """[measured mm per simulated mm], shape (m,)."""
    scores: Floats
    """Correlation in the common area, times the square root of the overlap; NaN without overlap, shape (m, n)."""
    mirror: bool
    """Whether the simulated map is mirrored."""


def score_surface(
    simulated: DetectorMap | Hits,
    measured: DetectorMap | Hits,
    *,
    scales: tuple[float, ...],
    rotations: tuple[float, ...] = (0.0, 354.0),
    mirror: bool = False,
    overlap: float = 0.5,
) -> ScoreSurface:
    """Correlation of two maps as a function of rotation and scale: what `register` chooses from.

    One sharp maximum is a registration that can be trusted. Several equal ones are the symmetry of the pole. A ridge
    along the scale, as for lines that cross in a single pole, says that the maps do not determine it.

    Parameters
    ----------
    simulated, measured, overlap
        As in `register`.
    scales : tuple of float
        Lower and upper bound [measured mm per simulated mm], in steps of at most 5 %.
    rotations : tuple of float
        Lower and upper bound [degrees], in steps of at most 3 degrees.
    mirror : bool
        Whether the simulated map is mirrored.

    Returns
    -------
    ScoreSurface

    Raises
    ------
    ValueError
        If an argument is outside its range.

    Examples
    --------
    >>> run = ae.Simulation(ae.Tip("Ni", apex_radius=2.5, axis=(1, 1, 1)), seed=1).run(400)
    >>> simulated = run.hits(ae.RollUp(0.2))
    >>> measured = ae.Registration(rotation=20.0, scale=0.3, shift=(1.0, 2.0)).hits(simulated)
    >>> maps = simulated.map(bins=32), measured.map(bins=32)
    >>> surface = ae.maps.score_surface(*maps, rotations=(0, 60), scales=(0.25, 0.35))
    >>> best = np.unravel_index(np.nanargmax(surface.scores), surface.scores.shape)
    >>> print(f"{surface.rotations[best[1]]:.0f} degrees, {surface.scales[best[0]]:.2f}")
    21 degrees, 0.30
    """
    simulated, measured = (_view(value, name) for value, name in ((simulated, "simulated"), (measured, "measured")))
    turns = _steps(_range(rotations, "rotations", unit="degrees"), ROTATION_STEP / 2)
    factors = np.exp(_steps(np.log(_range(scales, "scales", above=0)), SCALE_STEP / 2))
    mirror, least = check_switch(mirror, "mirror"), check_number(overlap, "overlap", above=0, at_most=1)
    scores = np.full((len(factors), len(turns)), np.nan)
    for fit in search(simulated, measured, turns, factors, (mirror,), least):
        row = np.argmin(np.abs(factors - fit.transform.scale))
        scores[row, np.argmin(np.abs(turns - fit.transform.rotation))] = fit.rank
    return ScoreSurface(turns, factors, scores, mirror)


def register_distortion(
    registration: Registration,
    simulated: DetectorMap | Hits,
    measured: DetectorMap | Hits,
    *,
    degree: int | None = None,
) -> Registration:
    """Add polynomial terms to a registration, from the displacements of patches of both maps.

    For a measured map of an instrument with a reflectron, without a calibration grid. The maps are flattened as for
    `register`, and divided into overlapping patches. The displacement of each patch with the largest correlation is one
    point of a least squares fit, weighted by its accuracy.

    Parameters
    ----------
    registration : Registration
        Result of `register`.
    simulated, measured : DetectorMap or Hits
        The same maps.
    degree : int, optional
        As for `register_points`, by default the largest degree that is not over-fitted.

    Returns
    -------
    Registration
        With `residual`, the root mean square residual of the patches [mm]. Unchanged if no terms are significant.

    Raises
    ------
    ValueError
        If too few patches have a clear maximum of the correlation.

    Notes
    -----
    A patch is 1/5 of the diameter wide, and may move by a third of that. The accuracy of its place follows from its
    correlation coefficient r: the variance is proportional to (1 - r^2) / r^2. Patches with r < 0.5 are ignored.
    """
    check_kind(registration, "registration", Registration, "a Registration")
    moving, fixed = _view(simulated, "simulated"), _view(measured, "measured")
    best = replace(registration, distortion=None)
    for _ in range(2):  # repeated with patches of the distorted map
        centres, targets, weights = patch_displacements(moving, fixed, best.inverse_points, best.scale)
        x, y = best.inverse_points(centres.real, centres.imag)
        source = x - 1j * y if best.mirror else x + 1j * y
        fit = fit_polynomial(source, targets, degree, weights)
        if fit.degree == 0:
            return registration
        best = _polynomial_registration(registration, fit, registration.method)
    return best


def register_points(
    simulated_points: ArrayLike, measured_points: ArrayLike, mirror: bool | None = None, *, degree: int | None = 0
) -> Registration:
    """Find the transform of simulated points, such as poles, to measured points by least squares.

    Parameters
    ----------
    simulated_points, measured_points : array_like
        The same n >= 2 points in both frames [mm], shape (n, 2).
    mirror : bool, optional
        Whether the frames are mirror images. By default the better fit for n >= 3, and False for two points, which fit
        both ways.
    degree : int, optional
        Degree of polynomial terms for the distortion of a reflectron: 0 for a similarity transform, 1 with anisotropy,
        2 and 3 with quadratic and cubic terms. None for the largest degree that is not over-fitted, see the notes.

    Returns
    -------
    Registration

    Raises
    ------
    ValueError
        If there are fewer than two points, numbers differ, all points of one frame coincide, or there are too few
        points for the degree.

    Warns
    -----
    RegistrationWarning
        If a similarity transform was fitted, but polynomial terms are significant.

    Notes
    -----
    With None, terms of a degree are kept if they pass two tests, in comparison with the next lower degree: an F test at
    1 % of the decrease of the residual, and a smaller residual of points that are left out of the fit, one at a time.
    A degree of 1, 2 or 3 needs more than 3, 6 or 10 points.
    """
    simulated = check_array(simulated_points, "simulated_points", ("n", 2))
    measured = check_array(measured_points, "measured_points", (len(simulated), 2))
    if len(simulated) < 2:
        raise ValueError(f"simulated_points must contain at least two points, got {len(simulated)}")
    for points, name in ((simulated, "simulated_points"), (measured, "measured_points")):
        if not np.ptp(points, axis=0).any():
            raise ValueError(f"{name} must contain different points, got {points[0].tolist()} {len(points)} times")
    choices = (False, True) if mirror is None else (check_switch(mirror, "mirror"),)
    source, target = (points[:, 0] + 1j * points[:, 1] for points in (simulated, measured))
    fits = [_least_squares(source, target, choice) for choice in choices]
    # rounding must not decide if both fit exactly
    best = min(fits, key=lambda one: (round(one.residual / np.ptp(target.real + target.imag), 9), one.mirror))
    if not best.scale > 0:
        raise ValueError("simulated_points and measured_points must be related by rotation, scale and shift")
    if degree is not None:
        degree = check_count(degree, "degree", at_most=LARGEST_DEGREE)
    points = source.conj() if best.mirror else source
    fit = fit_polynomial(points, target, degree or None)
    if degree != 0:
        return _polynomial_registration(best, fit, "points")
    if fit.degree:
        warn(
            f"the residual of the points, {best.residual:.2f} mm, has a systematic part: terms of degree {fit.degree} "
            f"reduce it to {fit.residual:.2f} mm; for an instrument with a reflectron use Hits.undistorted, or "
            "degree=None",
            RegistrationWarning,
        )
    return best


def _polynomial_registration(registration, fit, method):
    """Registration with the linear part and the distortion of a fit."""
    factor, shift = fit.similarity
    return replace(
        registration,
        rotation=float(np.degrees(np.angle(factor))),
        scale=float(abs(factor)),
        shift=(shift.real, shift.imag),
        residual=fit.residual,
        method=method,
        distortion=fit.distortion,
    )


def _least_squares(source, target, mirror):
    points = source.conj() if mirror else source
    matrix = np.column_stack([points, np.ones(len(source))])
    (factor, shift), *_ = np.linalg.lstsq(matrix, target, rcond=None)
    residual = np.sqrt(np.mean(np.abs(matrix @ (factor, shift) - target) ** 2))
    shift = (float(shift.real), float(shift.imag))
    angle = float(np.degrees(np.angle(factor)))
    return Registration(angle, float(abs(factor)), shift, mirror, residual=float(residual), method="points")


def _transform_bounds(start, rotations, scales, mirrors):
    """Ranges of rotations [degrees] and scales, None for all, and kinds of mirrors; by default those about a start."""
    if start is not None:
        rotations = (start.rotation - 15, start.rotation + 15) if rotations is None else rotations
        scales = (start.scale / 1.2, start.scale * 1.2) if scales is None else scales
        mirrors = (start.mirror,) if mirrors is None else mirrors
    if rotations is not None:
        rotations = _range(rotations, "rotations", unit="degrees")
        rotations = None if rotations[1] - rotations[0] >= 360 else rotations
    if scales is not None:
        scales = _range(scales, "scales", above=0)
    mirrors = (False, True) if mirrors is None else check_sequence(mirrors, "mirrors", "True and False")
    mirrors = tuple(dict.fromkeys(check_switch(mirror, "mirrors") for mirror in mirrors))
    if not mirrors:
        raise ValueError("mirrors must contain False, True or both, got none")
    return rotations, scales, mirrors


def _shift_bounds(start, pole, tolerance, measured):
    """Bounds of the shift from a pole or a start, or None."""
    if pole is not None:
        (x, y), (at_x, at_y) = check_array(pole, "pole", (2, 2)).tolist()
        anchor, place, fraction = complex(x, y), complex(at_x, at_y), 1 / 50
    elif start is not None:
        x, y = start.inverse_points(measured.centre.real, measured.centre.imag)
        anchor, place, fraction = complex(x, y), measured.centre, 1 / 5
    elif tolerance is not None:
        raise ValueError(f"tolerance needs a pole or a start, got {short_text(tolerance)} alone")
    else:
        return None
    if tolerance is None:
        tolerance = fraction * measured.diameter
    return ShiftBounds(anchor, place, check_number(tolerance, "tolerance", at_least=0, unit="mm"))


def at_bound(value: float, ends: tuple[float, float]) -> bool:
    """Whether a result of a search lies within 1 % of its range from one of the ends."""
    return min(value - ends[0], ends[1] - value) < _AT_BOUND * (ends[1] - ends[0])


def _bounds_reached(transform, rotations, scales, shift_bounds):
    """Descriptions of the numbers of a transform that are within 1 % of a bound of the search."""
    reached = []
    for name, value, ends in (("rotation", transform.rotation, rotations), ("scale", transform.scale, scales)):
        if ends is not None and ends[1] > ends[0]:
            low, high = ends
            if name == "rotation":
                value = low + (value - low + 180.0) % 360.0 - 180.0 if value < low or value > high else value
            if at_bound(value, ends):
                reached.append(f"{name} {value:.4g} of {low:.4g} to {high:.4g}")
    if shift_bounds is not None and shift_bounds.tolerance > 0:
        away = transform.apply(shift_bounds.anchor) - shift_bounds.place
        if max(abs(away.real), abs(away.imag)) > (1 - 2 * _AT_BOUND) * shift_bounds.tolerance:
            reached.append(
                f"shift ({away.real:.2g}, {away.imag:.2g}) mm of at most {shift_bounds.tolerance:.2g} mm (tolerance)"
            )
    return reached


def _view(value, name):
    if not isinstance(value, DetectorMap):
        if not hasattr(value, "detected"):
            raise ValueError(f"{name} must be a DetectorMap or Hits, got {value!r:.80}")
        # without the extent of the detector the bins cover only the hits
        value = DetectorMap.from_hits(replace(value, extent=None), bins=_BINS if name == "simulated" else 256)
    return View(value)


def _fewest_hits(simulated):
    """Simulated hits that the measured map must show, 0 if they are not counted."""
    return min(FEWEST, simulated.map.values[simulated.mask].sum() / 4) if simulated.map.is_counts else 0.0


def _default_scales(simulated, fewest, ratio):
    """Scales of the search; at the largest one the measured map shows the fewest hits, at twice their mean density."""
    shown = simulated.map.values[simulated.mask].sum() / fewest if fewest else np.inf
    return np.sqrt(0.5) * ratio, min(5, np.sqrt(2 * shown)) * ratio


def _range(value, name, **limits):
    low, high = (value, value) if np.ndim(value) == 0 else check_array(value, name, (2,)).tolist()
    low = check_number(low, name, **limits)
    return low, check_number(high, f"the second of {name}", at_least=low)


def _steps(ends, step):
    low, high = ends
    return np.linspace(low, high, int(np.ceil((high - low) / step)) + 1)


def _noise(fit, pixels):
    """Difference of the scores of two fits by chance: two standard errors of a difference."""
    patches = fit.overlap * pixels**2 / 4 / (4 * NARROW**2)  # area of the field of view divided by 4 pi sigma^2
    return 2 * np.sqrt(2 / patches) * (1 - fit.score**2)


def _registration(fit, method):
    transform = fit.transform
    shift = complex(transform.apply(0j))  # image of the origin
    return Registration(
        rotation=float(transform.rotation),
        scale=float(transform.scale),
        shift=(shift.real, shift.imag),
        mirror=transform.mirror,
        score=fit.score,
        overlap=fit.overlap,
        method=method,
    )
