"""Tracks on the detector of selected ions of a run, for varying launch energy and direction."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from apt_evap._common.short_repr import short_repr
from apt_evap._common.validation import check_array, check_kind
from apt_evap.emission.emissions import TangentialLaunches
from apt_evap.emission.surface_frame import rollup_direction
from apt_evap.simulation.flight.response import Responses
from apt_evap.simulation.run import Run
from apt_evap.units import speed_from_energy


class Tracks(NamedTuple):
    """Positions on the detector of n ions at m energies, and for lateral tracks at k directions."""

    x: np.ndarray
    """[mm], shape (n, m) or (n, m, k); NaN for an ion that flies away from the detector."""
    y: np.ndarray
    """[mm], same shape."""
    energies: np.ndarray
    """Launch energies [eV], shape (m,)."""

    def __repr__(self) -> str:
        return short_repr(self)


def lateral_tracks(run: Run, ions: ArrayLike, energies: ArrayLike, azimuths: ArrayLike | None = None) -> Tracks:
    """Positions of ions launched from their sites, for every energy and every direction along the surface.

    Parameters
    ----------
    run : Run
        A run with responses.
    ions : array_like of int
        Indices of ions of the run, shape (n,).
    energies : array_like
        Launch energies [eV], shape (m,), up to the `energy_limit` of the responses.
    azimuths : array_like, optional
        Directions, from t1 to t2 of `tangent_frame` [degrees], shape (k,); by default 72 evenly spaced ones.

    Returns
    -------
    Tracks
        Shape (n, m, k).

    Raises
    ------
    ValueError
        If the run has no responses, or if ions or energies are outside their range.
    """
    ions, energies = _check(run, ions, energies)
    azimuths = np.arange(0, 360, 5) if azimuths is None else check_array(azimuths, "azimuths", ("k",))
    azimuths = np.radians(azimuths)
    speeds = speed_from_energy(energies, run.emissions.masses[ions][:, None])[:, :, None]
    velocities = np.stack([speeds * np.cos(azimuths), speeds * np.sin(azimuths)], axis=-1)
    x, y = _places(run, ions, velocities, rolled=False)
    return Tracks(x, y, energies)


def rollup_tracks(run: Run, ions: ArrayLike, energies: ArrayLike) -> Tracks:
    """Positions of ions that roll up, for every energy; NaN for an ion without a neighbour.

    Parameters
    ----------
    run : Run
        A run with responses.
    ions : array_like of int
        Indices of ions of the run, shape (n,).
    energies : array_like
        Launch energies [eV], shape (m,), up to the `energy_limit` of the responses.

    Returns
    -------
    Tracks
        Shape (n, m).

    Raises
    ------
    ValueError
        If the run has no responses, or if ions or energies are outside their range.
    """
    ions, energies = _check(run, ions, energies)
    can_roll, first, second = rollup_direction(run.emissions[ions])
    speeds = speed_from_energy(energies, run.emissions.masses[ions][:, None])
    velocities = np.stack([speeds * first[:, None], speeds * second[:, None]], axis=-1)
    x, y = _places(run, ions, velocities, rolled=True)
    x[~can_roll] = y[~can_roll] = np.nan
    return Tracks(x, y, energies)


def _check(run, ions, energies):
    check_kind(run, "run", Run, "a Run").require_responses()
    ions = check_array(ions, "ions", ("n",), dtype=np.int64)
    if len(ions) == 0 or ions.min() < 0 or ions.max() >= len(run):
        raise ValueError(f"ions must be indices from 0 to {len(run) - 1}, got {ions}")
    energies = check_array(energies, "energies", ("m",))
    limit = run.response_settings.energy_limit
    if len(energies) == 0 or energies.min() < 0 or energies.max() > limit:
        raise ValueError(f"energies must be from 0 to {limit:g} eV, the limit of the responses, got {energies}")
    return ions, energies


def _places(run, ions, velocities, rolled):
    """Positions on the detector [mm], shape (...), of launches along the surface [nm/ns] of shape (..., 2)."""
    shape = velocities.shape[:-1]
    repeats = np.repeat(ions, int(np.prod(shape[1:])))
    responses = run.responses
    chosen = Responses(responses.site[repeats], responses.rolled[repeats], responses.residuals[repeats])
    first, second = velocities.reshape(-1, 2).T
    starts = np.full(len(repeats), rolled)
    launches = TangentialLaunches(starts, first, second)
    ends = run.response_model.evaluate(chosen, launches, run.emissions.masses[repeats])
    x, y, *_ = run.detector.impacts(*ends)
    return x.reshape(shape), y.reshape(shape)
