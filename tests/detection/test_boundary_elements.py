import math

import numpy as np
import pytest
from scipy.integrate import quad

from apt_evap.detection.microscope.boundary_elements import ChargedPanels, Panels, joined, ring_field, ring_potential
from apt_evap.detection.microscope.conductors import graded


def sphere(count, radius=1.0, height=0.0, potential=1.0):
    angles = np.linspace(0, math.pi, count + 1)
    points = np.column_stack([radius * np.sin(angles), height + radius * np.cos(angles)])
    return Panels(points[:-1], points[1:], np.full(count, height), np.full(count, potential))


def line(points, potential):
    return Panels(points[:-1], points[1:], np.full(len(points) - 1, np.nan), np.full(len(points) - 1, potential))


RINGS = [
    (0.7, 0.3, 1.0, -0.2),
    (3.0, 1.0, 0.5, 0.0),
    (1.001, 0.0, 1.0, 0.001),
    (1e-6, 0.4, 1.0, 0.0),
    (0.0, -2.0, 3.0, 0.5),
]


@pytest.mark.parametrize(("rho", "z", "radius", "height"), RINGS)
def test_a_ring_is_a_sum_of_point_charges(rho, z, radius, height):
    """Twin: the integral over the azimuth, of potential and field."""

    def over(function):
        return quad(function, 0, math.pi, epsabs=1e-13, epsrel=1e-9, limit=500, points=[1e-3, 0.1])[0] / math.pi

    def distance(azimuth):
        return math.sqrt((rho - radius) ** 2 + 4 * rho * radius * math.sin(azimuth / 2) ** 2 + (z - height) ** 2)

    twin = (
        over(lambda azimuth: 1 / distance(azimuth)),
        over(lambda azimuth: (rho - radius * math.cos(azimuth)) / distance(azimuth) ** 3),
        over(lambda azimuth: (z - height) / distance(azimuth) ** 3),
    )
    found = ring_field(*(np.array([value]) for value in (rho, z, radius, height)))
    # 1e-7: the integral for a radial field close to the axis is a difference of large parts
    np.testing.assert_allclose(np.concatenate(found), twin, rtol=1e-7, atol=1e-12)
    assert found[0][0] == ring_potential(*(np.array([value]) for value in (rho, z, radius, height)))[0]


def test_a_sphere():
    """F R / V and the charge are 1; outside, the potential is that of the charge in the centre."""
    charged = ChargedPanels(sphere(80))
    # measured: 5e-9, because the panels are arcs and the density is constant
    np.testing.assert_allclose(charged.surface_fields, 1.0, atol=1e-7)
    assert charged.charges.sum() == pytest.approx(1.0, abs=1e-7)
    points = np.array([[0.0, 1.1], [0.8, -0.9], [3.0, 4.0]])
    potential, radial, axial = charged.fields(points[:, 0], points[:, 1])
    distance = np.hypot(*points.T)
    np.testing.assert_allclose(potential, 1 / distance, rtol=1e-5)  # of 3 nodes on far panels
    np.testing.assert_allclose(np.column_stack([radial, axial]), points / distance[:, None] ** 3, atol=1e-5)


def test_the_sphere_converges():
    errors = [abs(ChargedPanels(sphere(count)).charges.sum() - 1) for count in (10, 20, 40)]
    assert errors[0] > errors[1] > errors[2]


def test_a_spherical_capacitor():
    """Inside a grounded sphere of twice the radius the charge doubles: Q = V / (1/a - 1/b)."""
    charged = ChargedPanels(joined(sphere(60), sphere(60, 2.0, potential=0.0)))
    assert charged.charges[:60].sum() == pytest.approx(2.0, rel=1e-3)  # panels of both spheres are 0.05 and 0.1 long
    assert charged.charges.sum() == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("distance", [10.0, 100.0])
def test_confocal_paraboloids(distance):
    """A paraboloid with the radius R = 1 at its apex before a confocal one: k_f = ln(1 + 2 d / R) / 2."""

    def paraboloid(apex, first):
        # the focus is at (0, 0), the apex at z = apex: rho^2 = 4 apex (apex - z)
        depths = graded(np.array([[0.0, 0.0], [0.0, 300 * distance]]), first, 0.05)[:, 1]
        return np.column_stack([2 * np.sqrt(apex * depths), apex - depths])

    # points in equal steps of the square root of the depth at the apex
    fine = np.linspace(0, 1.5, 40)[:-1] ** 2

    def points(apex, scale):
        tail = paraboloid(apex, 0.15 * scale)
        near = np.column_stack([2 * np.sqrt(apex * fine * scale), apex - fine * scale])
        return np.vstack([near, tail[tail[:, 1] < near[-1, 1] - 0.05 * scale]])

    inner, outer = points(0.5, 0.5), points(0.5 + distance, 0.5 + distance)
    charged = ChargedPanels(joined(line(inner, 1.0), line(outer, 0.0)))
    field = np.polynomial.Polynomial.fit(charged.middles[2:12, 0] ** 2, charged.surface_fields[2:12], 2)(0.0)
    # 0.5 %: the paraboloids end at 300 d
    assert 1 / field == pytest.approx(math.log(1 + 2 * distance) / 2, rel=5e-3)
