"""Flights of a field of view: scouts of an ion decide whether its other launches are flown.

The responses of an ion cover all launches from several places with any velocity along the surface up to a largest one.
Its scouts start at these places, at rest and with the largest velocity in two directions. They predict the directions
of all launches, as linear functions of the velocity. If all predictions end outside the field of view by more than a
margin, no launch of the ion can arrive in it.
"""

from typing import NamedTuple

import numpy as np

from apt_evap._common.types import Floats, Integers
from apt_evap._core.elementary import sine_and_cosine
from apt_evap.emission.emissions import Emissions
from apt_evap.emission.surface_frame import along_surface, shared_positions
from apt_evap.simulation.flight.launch_designs import shares_of
from apt_evap.simulation.flight.response import ResponseSettings

MARGIN = 0.5
"""Margin in units of the largest predicted deviation from the flight at rest from the site. Measured: launches end up
to 0.39 of it closer to the axis than all predictions (20,300 ions; Ni, Al, W, Ni with 15 % W, a particle of Ni in Al;
five axes; R = 8 and 16 a; energies up to 0.3, 1.5 and 4 eV)."""
LEAST_MARGIN = 0.5
"""Further margin for errors that do not depend on the energy, such as those of the scouts themselves [degrees]."""


class Scouts(NamedTuple):
    """Launches that decide whether the other launches of n ions are flown."""

    positions: Floats
    """[nm], shape (n, m, 3)."""
    velocities: Floats
    """[sqrt(V)], shape (n, m, 3)."""
    families: Integers
    """Number of launches of each family: three from one place, at rest and with the largest velocity in two directions,
    and further ones at rest from places that have the same dependence on the velocity, shape (f,), int64."""


def stereographic_rim(half_angle: float) -> float:
    """Length tan(a / 2) of the stereographic directions at a polar angle a [degrees]."""
    sine, cosine = sine_and_cosine(half_angle * np.pi / 180.0)
    return float(sine / (1.0 + cosine))


def scouts_of(emissions: Emissions, settings: ResponseSettings) -> Scouts:
    """Scouts from the site and from the places of the roll-up."""
    corners = shares_of(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))  # of the places of a roll-up
    places = [emissions.positions[:, None], shared_positions(emissions, corners[None])]
    fastest = np.sqrt(2.0 * settings.energy_limit / emissions.charge_states)
    first = along_surface(emissions.normals, fastest, np.zeros_like(fastest))
    second = along_surface(emissions.normals, np.zeros_like(fastest), fastest)
    rest = np.zeros_like(first)
    starts = [place[:, number] for place in places for number in (0, 0, 0, *range(1, place.shape[1]))]
    velocities = [velocity for place in places for velocity in (rest, first, second, *[rest] * (place.shape[1] - 1))]
    positions = np.stack(starts, axis=1)
    # an ion that cannot roll up has its site only
    positions = np.where(np.isfinite(positions), positions, emissions.positions[:, None])
    families = np.array([2 + place.shape[1] for place in places], np.int64)
    return Scouts(positions, np.stack(velocities, axis=1), families)
