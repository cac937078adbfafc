"""Width of a zone line, fitted to a profile across it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_kind, check_number
from apt_evap.maps.profiles import Profile

EXPONENTS = 1.0, 12.0  # of a fitted line: from a cusp to almost a box
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)


@dataclass(frozen=True)
class ZoneLine:
    """A line on a linear background, fitted to a profile by `fit_zone_line`.

    Parameters
    ----------
    centre, width : float
        Position of the line, and its full width at half height [mm, or the unit of the profile].
    height : float
        Density at its centre minus the background, in units of the profile: > 0 for an enhanced line, < 0 for a
        depleted one.
    background : float
        Density of the background at the centre.
    slope : float
        Slope of the background [1/mm].
    exponent : float
        2 for a Gaussian, larger for a line with a flat centre.
    centre_error, width_error, height_error, background_error, exponent_error : float
        Standard deviations; 0 for a fixed exponent.
    chi_square : float
        Sum of the squared residuals in units of their errors; NaN for a profile without errors.
    degrees_of_freedom : int
        Number of bins minus the number of fitted parameters.
    unit : str
        Unit of the profile, mm or degrees.
    """

    centre: float
    width: float
    height: float
    background: float
    slope: float
    exponent: float
    centre_error: float
    width_error: float
    height_error: float
    background_error: float
    exponent_error: float
    chi_square: float
    degrees_of_freedom: int
    unit: str = "mm"

    @property
    def kind(self) -> str:
        """Text "enhanced" or "depleted"."""
        return "enhanced" if self.height > 0 else "depleted"

    def density(self, position: ArrayLike) -> Floats:
        """Density of the line and its background at positions [mm] of any shape, in units of the profile."""
        distance = np.asarray(position, float) - self.centre
        return self.background + self.slope * distance + self.height * _shape(distance, self.width, self.exponent)

    def __str__(self):
        size = f"{self.width:.2f} ± {self.width_error:.2f} {self.unit}"
        return f"{self.kind}, {size} wide at {self.centre:+.2f} {self.unit}"


def fit_zone_line(profile: Profile, *, exponent: float | None = 2.0) -> ZoneLine:
    r"""Fit a dip or a peak on a linear background to a profile across a zone line.

    Parameters
    ----------
    profile : Profile
        Profile of at least 8 bins.
    exponent : float, optional
        Shape of the line, 1 to 12: 2 is a Gaussian. With None it is fitted too, for lines with a flat centre, such as
        dark lines without hits; this needs about hundred hits per bin.

    Returns
    -------
    ZoneLine

    Raises
    ------
    ValueError
        If there are too few bins, or no line within the profile that is wider than half a bin and narrower than the
        profile.

    Notes
    -----
    The density at the distance u from the centre is

    .. math:: b + c u + h \, 2^{-|2 u / w|^p}

    with the width w, the height h and the exponent p; it is averaged over each bin. All bins have equal weights:
    with weights from counting errors, the few hits at the minimum of a dark line would dominate its width. The
    errors sigma of the bins give the covariance P diag(sigma^2) P^T of the parameters, with P the pseudoinverse of
    the derivatives of the model; without errors of the bins, it follows from the scatter around the fit. If
    `chi_square` is much larger than `degrees_of_freedom`, the line has another shape; its width then depends on the
    width of the profile.
    """
    finite = np.isfinite(check_kind(profile, "profile", Profile, "a Profile").density)
    position, density, error = (np.asarray(column)[finite] for column in profile[:3])
    if len(position) < 8:
        raise ValueError(f"a profile must have at least 8 bins to fit a line, got {len(position)}")
    if exponent is not None:
        exponent = check_number(exponent, "exponent", at_least=EXPONENTS[0], at_most=EXPONENTS[1])
    bin_width = float(np.median(np.diff(position)))
    span = float(position[-1] - position[0]) + bin_width

    def model(position, centre, width, height, background, slope, exponent=exponent):
        line = _mean_shape(position - centre, width, exponent, bin_width)
        return background + slope * (position - centre) + height * line

    start = [*_best_of_grid(position, density, exponent or 2.0, bin_width, span), *([3.0] if exponent is None else [])]
    lowest = [position[0], bin_width / 2, -np.inf, -np.inf, -np.inf, EXPONENTS[0]][: len(start)]
    highest = [position[-1], span, np.inf, np.inf, np.inf, EXPONENTS[1]][: len(start)]
    no_line = f"the profile of {len(position)} bins over {span:g} mm has no line"
    try:
        parameters, covariance = scipy.optimize.curve_fit(model, position, density, start, bounds=(lowest, highest))
    except RuntimeError as failure:
        raise ValueError(f"{no_line}: {failure}") from failure
    at_edge = [np.isclose(parameters[:2], edge[:2], atol=1e-6 * span) for edge in (lowest, highest)]
    if np.any(at_edge) or not np.isfinite(covariance).all():
        raise ValueError(f"{no_line}: the fit gave a width of {parameters[1]:.3g} mm at {parameters[0]:.3g} mm")
    if np.isfinite(error).all():
        change = np.linalg.pinv(scipy.optimize.approx_fprime(parameters, lambda values: model(position, *values)))
        covariance = (change * error**2) @ change.T
    names = ("centre", "width", "height", "background", "slope", "exponent")
    values = {"exponent": exponent} | dict(zip(names, parameters.tolist(), strict=False))
    errors = {"exponent": 0.0} | dict(zip(names, np.sqrt(np.diag(covariance)).tolist(), strict=False))
    expected = model(position, *parameters)
    pulls = (density - expected) / _errors_of(expected, density, error)
    return ZoneLine(
        **values,
        **{f"{name}_error": errors[name] for name in names if name != "slope"},
        chi_square=float(pulls @ pulls),
        degrees_of_freedom=len(position) - len(parameters),
        unit=profile.unit,
    )


def _shape(distance, width, exponent):
    """Shape of the line: 1 at the centre, 1/2 at half the width from it."""
    return 0.5 ** (np.abs(2 * distance / width) ** exponent)


def _mean_shape(distance, width, exponent, bin_width):
    """Shape averaged over bins at a `distance` from its centre, by Gauss quadrature."""
    return _shape(distance[:, None] + bin_width / 2 * _NODES, width, exponent) @ _WEIGHTS / 2


def _best_of_grid(position, density, exponent, bin_width, span):
    """Start values of all parameters: on a grid of centre and width, the others by linear least squares."""
    best = (np.inf,)
    for width in np.geomspace(bin_width, 0.9 * span, 8):
        for centre in position[1:-1]:
            distance = position - centre
            line = _mean_shape(distance, width, exponent, bin_width)
            columns = np.stack([line, np.ones_like(distance), distance], axis=1)
            values, *_ = np.linalg.lstsq(columns, density, rcond=None)
            residual = density - columns @ values
            best = min(best, (residual @ residual, centre, width, *values))
    return best[1:]


def _errors_of(expected, density, error):
    """Counting errors of expected densities; the hits per unit of density follow from density and error."""
    with np.errstate(divide="ignore", invalid="ignore"):
        hits_per_density = np.where(density > 0, density / error**2, 1 / error)
    return np.sqrt(np.maximum(expected * hits_per_density, 1)) / hits_per_density
