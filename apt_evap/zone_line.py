"""The width of a zone line from a profile across it, and two profiles compared."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import curve_fit
from scipy.special import ndtr
from scipy.stats import chi2

from apt_evap.profiles import Profile

FULL_WIDTH = 2 * np.sqrt(2 * np.log(2))  # full width at half height of a Gaussian, in standard deviations


@dataclass(frozen=True)
class ZoneLine:
    """A Gaussian line on a linear background, fitted to a profile by `fit_zone_line`.

    Parameters
    ----------
    centre, width : float
        Where the line is, and its full width at half height [mm].
    height : float
        Density at its centre above the background, in units of the profile: above 0 for an enhanced line, below 0 for
        a depleted one.
    background : float
        Density of the background at the centre.
    slope : float
        Slope of the background [1/mm].
    centre_error, width_error, height_error, background_error : float
        Standard deviations, from the counting errors of the profile.
    chi_square : float
        Sum of the squared misfits in units of their errors; NaN for a profile without errors.
    degrees_of_freedom : int
        Bins less the five numbers fitted.
    """

    centre: float
    width: float
    height: float
    background: float
    slope: float
    centre_error: float
    width_error: float
    height_error: float
    background_error: float
    chi_square: float
    degrees_of_freedom: int

    @property
    def kind(self):
        """The word "enhanced" or "depleted"."""
        return "enhanced" if self.height > 0 else "depleted"

    def density(self, position):
        """Density of the line and its background at some positions [mm], in units of the profile, any shape."""
        away = np.asarray(position, float) - self.centre
        peak = np.exp(-0.5 * (away * (FULL_WIDTH / self.width)) ** 2)
        return self.background + self.slope * away + self.height * peak

    def __str__(self):
        return f"{self.kind}, {self.width:.2f} ± {self.width_error:.2f} mm wide at {self.centre:+.2f} mm"


def fit_zone_line(profile):
    """Fit a Gaussian dip or peak on a linear background to a profile across a zone line.

    Parameters
    ----------
    profile : Profile
        Profile of at least 8 bins.

    Returns
    -------
    ZoneLine

    Raises
    ------
    ValueError
        If there are too few bins, or no line between the edges of the profile that is wider than half a bin and
        narrower than half the profile.

    Notes
    -----
    The Gaussian is averaged over each bin. The fit is least squares weighted with the counting errors, which are taken
    from the fitted densities in a second round: those of the counts themselves would favour bins that happen to be
    low. A profile without errors is fitted with equal weights. A `chi_square` well above `degrees_of_freedom` says
    that the line is no Gaussian, as an unperturbed one with a bright core; the errors do not know of that.
    """
    good = np.isfinite(profile.density)
    position, density, error = (np.asarray(column)[good] for column in profile)
    if len(position) < 8:
        raise ValueError(f"a profile must have at least 8 bins to fit a line, got {len(position)}")
    bin_width = float(np.median(np.diff(position)))
    span = position[-1] - position[0] + bin_width
    weighted = bool(np.isfinite(error).all())

    def model(position, centre, sigma, height, background, slope):
        peak = _mean_gaussian(position - centre, sigma, bin_width)
        return background + slope * (position - centre) + height * peak

    start = _best_of_grid(position, density, error if weighted else np.ones_like(density), bin_width, span)
    lowest = [position[0], bin_width / (2 * FULL_WIDTH), -np.inf, -np.inf, -np.inf]
    highest = [position[-1], span / (2 * FULL_WIDTH), np.inf, np.inf, np.inf]
    missing = f"the profile of {len(position)} bins over {span:g} mm shows no line"
    try:
        for _ in range(2 if weighted else 1):
            found, covariance = curve_fit(
                model,
                position,
                density,
                start,
                sigma=error if weighted else None,
                absolute_sigma=weighted,
                bounds=(lowest, highest),
            )
            start = found
            last_error = error
            error = _errors_of(model(position, *found), profile.density[good], profile.error[good])
    except RuntimeError as failure:
        raise ValueError(f"{missing}: {failure}") from failure
    at_edge = np.isclose(found[:2], lowest[:2], atol=1e-6 * span) | np.isclose(found[:2], highest[:2], atol=1e-6 * span)
    if at_edge.any() or not np.isfinite(covariance).all():
        raise ValueError(f"{missing}: the fit ran to {FULL_WIDTH * found[1]:.3g} mm wide at {found[0]:.3g} mm")
    centre, sigma, height, background, slope = (float(value) for value in found)
    errors = np.sqrt(np.diag(covariance))
    misfit = (density - model(position, *found)) / last_error
    return ZoneLine(
        centre=centre,
        width=FULL_WIDTH * sigma,
        height=height,
        background=background,
        slope=slope,
        centre_error=float(errors[0]),
        width_error=float(FULL_WIDTH * errors[1]),
        height_error=float(errors[2]),
        background_error=float(errors[3]),
        chi_square=float(misfit @ misfit),
        degrees_of_freedom=len(position) - 5,
    )


def _mean_gaussian(away, sigma, bin_width):
    """Gaussian of height 1 averaged over bins that lie `away` from its centre."""
    upper, lower = (away + bin_width / 2) / sigma, (away - bin_width / 2) / sigma
    return np.sqrt(2 * np.pi) * sigma / bin_width * (ndtr(upper) - ndtr(lower))


def _best_of_grid(position, density, error, bin_width, span):
    """Centre, sigma, height, background and slope to start from: for each centre and sigma the rest is linear."""
    best = (np.inf,)
    for sigma in np.geomspace(bin_width / 2, span / (2.2 * FULL_WIDTH), 6):
        for centre in position[1:-1]:
            away = position - centre
            columns = np.stack([_mean_gaussian(away, sigma, bin_width), np.ones_like(away), away], axis=1)
            values, *_ = np.linalg.lstsq(columns / error[:, None], density / error, rcond=None)
            misfit = (density - columns @ values) / error
            best = min(best, (misfit @ misfit, centre, sigma, *values))
    return best[1:]


def _errors_of(expected, density, error):
    """Counting errors of expected densities, by the hits per unit of density that density and error tell."""
    with np.errstate(divide="ignore", invalid="ignore"):
        hits_per_density = np.where(density > 0, density / error**2, 1 / error)
    return np.sqrt(np.maximum(expected * hits_per_density, 1)) / hits_per_density


class ProfileComparison(NamedTuple):
    """Two profiles of one rectangle, each relative to its own mean."""

    position: np.ndarray
    """Centres of the bins, shape (bins,)."""
    difference: np.ndarray
    """Density of the first less that of the second, in units of its error, shape (bins,)."""
    chi_square: float
    """Sum of the squares of the differences."""
    degrees_of_freedom: int
    """Bins less one: both have the mean 1."""
    probability: float
    """Probability that the noise of counting alone makes a larger chi_square."""
    relative: float
    """Root mean square of the difference of the densities beyond what noise explains; 0 if noise explains all."""


def compare_profiles(first, second):
    """Compare two profiles bin by bin, in units of the errors.

    Parameters
    ----------
    first, second : Profile
        Profiles with the same bins and with errors: of hits, or of maps of counts.

    Returns
    -------
    ProfileComparison

    Raises
    ------
    ValueError
        If bins differ, or a profile has no errors.
    """
    for name, profile in (("first", first), ("second", second)):
        if not isinstance(profile, Profile):
            raise ValueError(f"{name} must be a Profile, got {profile!r:.80}")
        if not np.isfinite(profile.error).any():
            raise ValueError(f"{name} must have errors, got a profile of densities: count hits instead")
    if first.position.shape != second.position.shape or not np.allclose(first.position, second.position):
        raise ValueError(
            f"the profiles must have the same bins, got {len(first.position)} and {len(second.position)} "
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
        probability=float(chi2.sf(chi_square, bins - 1)),
        relative=float(np.sqrt(max(beyond, 0.0))),
    )
