"""
A tilted or shifted specimen
============================

Where is the centre of the image if the specimen is tilted about its apex, or shifted from the axis of the electrode? To
the first order, the displacement u of the surface changes its potential by (u n) E, with the normal n and the field E
of the undisturbed lens. This has the azimuth cos(phi), and so has the charge that restores the potential: rings with a
density proportional to cos(phi). Their field on the axis deflects the ion that leaves the apex.

    python tilt.py
"""

import math

import numpy as np
import scipy

from apt_evap.detection.microscope.boundary_elements import _FINE
from apt_evap.detection.microscope.conductors import straight_flank
from apt_evap.detection.microscope.lens import Lens
from apt_evap.detection.microscope.local_electrode import LocalElectrode

POINTS = 1500  # of the field along the axis


def cosine_potential(rho, z, radius, height):
    """Potential of rings with the density cos(phi) / (2 pi radius), at phi = 0, with m and s as for `ring_potential`.

    2/(pi s) ((2 - m) K - 2 E) / m; for small m the series pi m/16 (1 + 3/4 m + 75/128 m^2) of the second factor.
    """
    far, near = (rho + radius) ** 2 + (z - height) ** 2, (rho - radius) ** 2 + (z - height) ** 2
    m = 4 * rho * radius / far
    first, second = scipy.special.ellipkm1(near / far), scipy.special.ellipe(1 - near / far)
    with np.errstate(divide="ignore", invalid="ignore"):
        exact = ((2 - m) * first - 2 * second) / m
    series = np.pi * m / 16 * (1 + m * (0.75 + m * 75 / 128))
    return 2 / np.pi / np.sqrt(far) * np.where(m < 1e-3, series, exact)


def charges(lens):
    """Nodes of the rings, and their charges for a shift along x [per nm] and a tilt towards x [per rad]."""
    charged = lens._charged
    panels, (nodes, weights) = charged.panels, _FINE
    places = panels.places(nodes)
    areas = panels.areas(places, weights)
    rho, z = (column[:, None, None] for column in charged.middles.T)
    matrix = (cosine_potential(rho, z, places[..., 0], places[..., 1]) * areas).sum(axis=-1)
    half = (nodes + 1) / 2  # denser towards the middle, for the panel itself
    graded, graded_weights = half**3, weights / 2 * 3 * half**2
    nodes, weights = np.concatenate([-graded, graded]), np.tile(graded_weights, 2)
    own = panels.places(nodes)
    itself = cosine_potential(charged.middles[:, :1], charged.middles[:, 1:], own[..., 0], own[..., 1])
    np.fill_diagonal(matrix, (itself * panels.areas(own, weights)).sum(axis=-1))
    along = panels.ends - panels.starts
    along /= np.linalg.norm(along, axis=1)[:, None]
    normal = np.column_stack([-along[:, 1], along[:, 0]])
    field = charged.surface_fields * (panels.potentials > 0)  # the electrode stays
    rho, z = charged.middles.T
    wanted = np.column_stack([field * normal[:, 0], field * (z * normal[:, 0] - rho * normal[:, 1])])
    return places, areas[..., None] * np.linalg.solve(matrix, wanted)[:, None, :]


def image(lens):
    """Angle of the ion that leaves the apex behind the electrode, per shift [rad/nm] and per tilt."""
    places, amounts = charges(lens)
    radius, height = places[..., 0], places[..., 1]
    start, end = 2 * lens._start, lens.distance + 40 * max(lens.distance, lens.aperture)
    distances = np.geomspace(start / 1.1, end * 1.1, POINTS)
    across = [np.einsum("ij,ijk", radius / (2 * (radius**2 + (z - height) ** 2) ** 1.5), amounts) for z in distances]
    logarithms = np.log(distances)
    potential, field = lens.along_axis(distances)
    potential, field, across = (scipy.interpolate.CubicSpline(logarithms, each) for each in (potential, field, across))

    def speed(logarithm):
        return math.sqrt(2 * (1 - float(potential(logarithm))))

    def change(logarithm, state):
        place, velocity = state.reshape(2, 2)
        z = math.exp(logarithm)
        acceleration = -across(logarithm) - field(logarithm, 1) / z * place / 2
        return np.concatenate([velocity, acceleration]) * z / speed(logarithm)

    first, last = math.log(start), math.log(end)
    # up to here along the normal of the displaced apex
    state = np.array([1.0, start, 0.0, speed(first)])
    solved = scipy.integrate.solve_ivp(change, (first, last), state, method="DOP853", rtol=1e-8, atol=1e-10)
    return solved.y[2:, -1] / speed(last)


def main():
    cases = {
        "free": lambda k: Lens(50.0, straight_flank(50.0, math.radians(5), 1e5), 1e9, 1e9, math.radians(75), k),
        "local electrode": lambda k: LocalElectrode(40e3, 20e3, 5.0).lens(50.0, k),
        "plane electrode": lambda k: LocalElectrode(40e3, 20e3, 5.0, electrode_angle=90.0).lens(50.0, k),
        "local electrode, R = 100 nm": lambda k: LocalElectrode(40e3, 20e3, 5.0).lens(100.0, k),
        "local electrode, shank 10": lambda k: LocalElectrode(40e3, 20e3, 10.0).lens(50.0, k),
    }
    for name, lens in cases.items():
        for refinement in (1, 2, 4):
            shift, tilt = image(lens(refinement))
            print(
                f"{name}, panels x {refinement}: {math.degrees(shift) * 1e3:+.4f} degrees per um, tilt times {tilt:.4f}"
            )


if __name__ == "__main__":
    main()
