"""Radius of a tip from its map: the width of a pole and the contrast of its zone lines, for a family of runs over R."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import ArrayLike

from apt_evap._common.types import Floats
from apt_evap._common.validation import check_count, check_kind, check_number, check_sequence
from apt_evap.detection.detector_map import DetectorMap
from apt_evap.emission.perturbations import Perturbation
from apt_evap.fit.structure import Structure
from apt_evap.maps.crystallography.directions import plane_normals
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.maps.pole_frame import Directions
from apt_evap.maps.pole_profiles import pole_profile
from apt_evap.maps.rings import RINGS, ring_statistics
from apt_evap.simulation.apex import image_compression
from apt_evap.simulation.run import Run

RADII = (0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0, 12.0, 14.0)
"""Edges of the radial densities [degrees]: the facet of {111} has a radius of sqrt(2 d / R), 9.7 degrees at 40 a."""
_FEWEST = 4  # runs: a straight line has two parameters
_CURVED = 6  # runs for a parabola
_TRIALS = 401
_BINS = 400
_CONFIDENCE = 0.95


@dataclass(frozen=True, eq=False)
class RadiusFit:
    """Radius of a measured tip; result of `fit_radius`.

    Parameters
    ----------
    radius : float
        Radius that fits best [nm].
    interval : tuple of float
        Interval of 95 % [nm].
    open_ends : tuple of bool
        Whether the lower and the upper bound are the ends of the family: the radius may be beyond.
    radii : ndarray, shape (n,)
        Trial values of the radius [nm].
    chi_square : ndarray, shape (n,)
        Sum of the squared differences from the measured values, in units of their variance, at each trial value.
    degrees_of_freedom : int
        Number of compared values minus one.
    run_radii : ndarray, shape (m,)
        Radii of the runs [nm].
    values : ndarray, shape (m, k)
        Contrasts of the rings and radial densities of each run.
    measured : ndarray, shape (k,)
        Those of the measured map.
    """

    radius: float
    interval: tuple[float, float]
    open_ends: tuple[bool, bool]
    radii: Floats
    chi_square: Floats
    degrees_of_freedom: int
    run_radii: Floats
    values: Floats
    measured: Floats

    def __repr__(self) -> str:
        low, high = self.interval
        below, above = self.open_ends
        return (
            f"<RadiusFit: {self.radius:.3g} nm ({'at most ' if below else ''}{low:.3g} to "
            f"{'at least ' if above else ''}{high:.3g}), chi square {self.chi_square.min():.3g} for "
            f"{self.degrees_of_freedom} degrees of freedom>"
        )


def fit_radius(
    runs: Sequence[Run],
    measured: DetectorMap,
    projection: Directions,
    perturbations: Perturbation | Sequence[Perturbation],
    plane: Sequence[int],
    *,
    pole: ArrayLike = (0.0, 0.0, 1.0),
    fold: int = 1,
    rings: Sequence[Sequence[float]] = RINGS,
    radii: Sequence[float] = RADII,
    draws: int = 1,
    ions: float | None = None,
) -> RadiusFit:
    """Find the radius of a tip from the structure about a pole, by a family of runs of tips with different radii.

    Parameters
    ----------
    runs : sequence of Run
        At least 4 runs of tips with at least 3 apex radii. If their lattice origins and shank angles differ, too, the
        interval contains the effect of these.
    measured : DetectorMap
        Counts or densities, not smoothed.
    projection : Projection
        Of the measured map, with the scale in crystal degrees from indexed poles (`fit_orientation`).
    perturbations : perturbation or sequence of perturbations
        Emission of the ions of all runs, or of each one. A pole can also be filled by energy, so that the radius is
        that for this emission. With runs in real units (`Run.at_evaporation_field`) one energy is the same for all
        radii.
    plane : sequence of int
        Miller indices of the pole on the maps of the runs, shape (3,).
    pole : array_like
        Direction of the pole in the frame of `projection`, shape (3,).
    fold : int
        Rotational symmetry about the pole.
    rings, radii : sequence
        As for `ring_statistics` and `pole_profile` [degrees].
    draws : int
        Draws of the random numbers of each ion, for runs with responses.
    ions : float, optional
        As for `ring_statistics`.

    Returns
    -------
    RadiusFit

    Raises
    ------
    ValueError
        If there are too few runs or radii, numbers differ, the rings are not on a map, or there are several draws of a
        run without responses.

    Notes
    -----
    The compared values are the contrasts of the rings and the radial densities. Each is a polynomial of ln R, of second
    order for at least 6 runs, fitted to the runs. Its variance is that of the measured value, plus the scatter of the
    runs about the polynomial times 1 + 1/n: the measured tip is one more member of the family. The interval is the
    range where chi square exceeds its minimum by at most t^2, with the quantile t of Student's distribution for the
    degrees of freedom of the scatter; if the minimum exceeds the number of values, by more in proportion.
    """
    runs = check_sequence(runs, "runs", "Runs")
    run_radii = np.array([_radius_of(run) for run in runs])
    if len(runs) < _FEWEST or len(np.unique(run_radii)) < 3:
        raise ValueError(f"runs must be at least {_FEWEST} with at least 3 radii, got {sorted(run_radii.tolist())} nm")
    if callable(getattr(perturbations, "launch", None)):
        perturbations = [perturbations] * len(runs)  # type: ignore[list-item]
    perturbations = check_sequence(perturbations, "perturbations", "perturbations")
    if len(perturbations) != len(runs):
        raise ValueError(f"perturbations must be one or {len(runs)}, one for each run, got {len(perturbations)}")
    draws = check_count(draws, "draws", at_least=1)
    if draws > 1 and any(run.responses is None for run in runs):
        raise ValueError(f"draws must be 1 for runs without responses, whose ions have one flight each, got {draws}")
    settings = rings, radii, fold
    target = _structure(measured, projection, pole, *settings, ions)
    values = []
    for run, perturbation in zip(runs, perturbations, strict=True):
        projection_and_pole = image_compression(run).projection, _direction(run, plane)
        values.append(_structure(_map_of(run, perturbation, draws), *projection_and_pole, *settings, None).values)
    return _fit(run_radii, np.array(values), target.values, np.nan_to_num(target.errors))


def _fit(run_radii, family, target, error):
    """RadiusFit for values of shape (m, k) at m radii, and measured values and errors of shape (k,)."""
    known = np.isfinite(family).all(axis=0) & np.isfinite(target)
    order = 2 if len(run_radii) >= _CURVED else 1
    middle = np.log(run_radii).mean()
    polynomial = np.polynomial.polynomial
    coefficients = polynomial.polyfit(np.log(run_radii) - middle, family[:, known], order)
    smooth = polynomial.polyval(np.log(run_radii) - middle, coefficients).T
    freedom = len(run_radii) - order - 1
    scatter = ((family[:, known] - smooth) ** 2).sum(axis=0) / freedom * (1 + 1 / len(run_radii))
    trial = np.exp(np.linspace(np.log(run_radii.min()), np.log(run_radii.max()), _TRIALS))
    model = polynomial.polyval(np.log(trial) - middle, coefficients).T
    chi_square = ((model - target[known]) ** 2 / (scatter + error[known] ** 2)).sum(axis=1)
    best, number = int(chi_square.argmin()), int(known.sum()) - 1
    # with few runs the scatter itself is uncertain
    allowance = scipy.stats.t.ppf((1 + _CONFIDENCE) / 2, freedom) ** 2 * max(1.0, chi_square[best] / number)
    allowed = np.flatnonzero(chi_square <= chi_square[best] + allowance)
    return RadiusFit(
        radius=float(trial[best]),
        interval=(float(trial[allowed[0]]), float(trial[allowed[-1]])),
        open_ends=(bool(allowed[0] == 0), bool(allowed[-1] == _TRIALS - 1)),
        radii=trial,
        chi_square=chi_square,
        degrees_of_freedom=number,
        run_radii=run_radii,
        values=family,
        measured=target,
    )


def _radius_of(run):
    radius = check_kind(run, "runs", Run, "Runs").settings["tip"].get("apex_radius")
    return check_number(radius, "the apex radius of a run", above=0, unit="nm")


def _direction(run, plane):
    """Direction of a pole in the frame of a run."""
    orientation = Orientation.from_settings(run.settings["tip"])
    return orientation.directions(plane_normals(orientation.material, np.atleast_2d(np.asarray(plane))))[0]


def _map_of(run, perturbation, draws):
    """Counts on the complete detector, over several draws."""
    grid = run.grid(_BINS)
    by_response = draws > 1  # a flight does not depend on the seed
    hits = [replace(run, seed=run.seed + draw).hits(perturbation, by_response=by_response) for draw in range(draws)]
    maps = [part.map(like=grid, position_step=None) for part in hits]
    return replace(maps[0], values=np.sum([map.values for map in maps], axis=0), detected=None)


def _structure(map, projection, pole, rings, radii, fold, ions):
    statistics = ring_statistics(map, projection, pole, rings, fold=fold, ions=ions)
    return Structure(statistics, pole_profile(map, projection, pole, radii, ions=ions))
