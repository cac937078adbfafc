"""The surface that follows its ions: harmonics with closed forms, flights by direct integration, conserved volume."""

import math
import os
import subprocess
import sys

import numpy as np
import pytest
import scipy
from fluxes import even_flux

from apt_evap.reconstruction.evolving_surface import EvolvingSurface, IonSequence, transfer
from apt_evap.reconstruction.spherical_harmonics import SphericalTransform

RIM = 0.54  # rad
RADIUS = 13.0  # nm
VOLUME = 0.033  # nm^3


def zonal(degree, cosines):
    """Orthonormal harmonic about the axis, and its slope over the polar angle."""
    scale = math.sqrt((2 * degree + 1) / (4 * math.pi))
    polynomial = np.polynomial.legendre.Legendre.basis(degree)
    return scale * polynomial(cosines), -scale * polynomial.deriv()(cosines) * np.sqrt(1 - cosines**2)


def flown(degree, epsilon, theta, steps=200_000):
    """Angle far away of an ion that starts at rest at theta, in the potential to first order in epsilon."""
    # u = 1/r from 1 to 0; the angular momentum L = r^2 d(angle)/dt obeys dL/dt = -d(phi)/d(angle), with V = R = q/m = 1
    # radially r'^2 / 2 = 1 - u; from the substitution u = 1 - s^2 the start at rest is no singularity
    s = (np.arange(steps) + 0.5) / steps
    u = 1 - s * s
    speed = math.sqrt(2) * s
    dt = 2 * s / (speed * u * u) / steps
    slope = zonal(degree, np.cos(theta))[1]
    momentum = np.cumsum(-epsilon * slope * u ** (degree + 1) * dt)
    return theta + float(np.sum(momentum * u * u * dt))


@pytest.mark.parametrize("degree", [1, 2, 4, 10])
def test_one_harmonic_deflects_as_the_flight_in_its_potential(degree):
    theta, epsilon = 0.3, 1e-4
    expected = theta - transfer(degree) * epsilon * zonal(degree, np.cos(theta))[1]
    # midpoints of 2e5 steps: 1e-5 of the deflection
    assert flown(degree, epsilon, theta) - theta == pytest.approx(float(expected) - theta, rel=1e-4)


def test_transfer_is_that_of_a_shift_and_falls_as_one_over_the_root():
    assert transfer([0, 1]) == pytest.approx([0.0, 1.0], abs=1e-14)
    assert transfer([2, 10]) == pytest.approx([5 / 6, 0.4675], abs=5e-5)  # B(2, 1/2) = 4/3
    # B(l, 1/2) is sqrt(pi / l) (1 + 1/(8 l) + ...), and 1/l is taken off
    assert transfer(400) * math.sqrt(400 / math.pi) == pytest.approx(1 - 1 / math.sqrt(400 * math.pi), rel=1e-3)


def test_the_transform_returns_fields_and_gradients_in_closed_form():
    transform = SphericalTransform(20)
    x, y, z = np.moveaxis(transform.nodes, -1, 0)
    field = x + 0.3 * z**3 + 0.2 * (x**2 - y**2) * z
    coefficients = transform.analysis(field[None])
    (again,), ((along, across),) = transform.fields_and_gradient(coefficients, coefficients)
    np.testing.assert_allclose(again, field, atol=1e-12)  # rounding of 1,800 nodes
    polar, azimuth = transform.polar[:, None], transform.azimuths
    sine, cosine, double = np.sin(polar), np.cos(polar), np.cos(2 * azimuth)
    expected = cosine * np.cos(azimuth) - 0.9 * cosine**2 * sine + 0.2 * double * (2 * sine * cosine**2 - sine**3)
    np.testing.assert_allclose(along, expected, atol=1e-10)
    expected = -np.sin(azimuth) - 0.4 * np.sin(2 * azimuth) * sine * cosine
    np.testing.assert_allclose(across, expected * np.ones_like(along), atol=1e-10)


def surface_of(n=20_000, **changes):
    directions = changes.pop("directions", even_flux(n, RIM))
    return EvolvingSurface(IonSequence(directions, VOLUME, RIM, RADIUS, **changes))


def test_ions_of_an_even_flux_stay_on_the_sphere():
    surface = surface_of(12_000)
    found = surface.integrate()
    ions = surface.ions
    depth = (ions.depths[1:] + ions.depths[:-1]) / 2
    expected = RADIUS * ions.directions
    expected[:, 2] -= depth
    # within a step 400 ions lie on 650 nodes: their noise is 0.02 nm
    assert np.sqrt(((found.positions - expected) ** 2).mean()) < 0.03
    assert np.abs(found.fields - 1).mean() < 0.03
    np.testing.assert_allclose(found.steps.recession, 1.0, atol=0.03)


def test_shapes_are_averaged_over_their_depths_and_are_not_late():
    surface = surface_of(2000)
    depths = np.linspace(0, 6, 601)
    shapes = np.zeros((601, 45, 45), np.complex128)
    # a degree that grows evenly is late by its damping, D = exp(-l^2 / 2 / 24^2), and the rate at which it is forgotten
    damping = math.exp(-(20**2) / 2 / 24**2)
    late = RADIUS * (1 - damping) / damping / (float(transfer(20)) * 420 - 2)
    noise = np.random.default_rng(5).normal(size=601)
    shapes[:, 3, 20], shapes[:, 0, 1], shapes[:, 0, 12] = 0.1j * (depths - late), noise, noise
    found = surface.settled(shapes, depths)
    middle = slice(80, 500)  # four standard deviations of 15 depths and the delay from the ends
    np.testing.assert_allclose(found[middle, 3, 20], 0.1j * depths[middle], atol=1e-6)
    assert late > 0.03
    np.testing.assert_array_equal(found[:, 0, 1], noise)  # the frame
    # a Gaussian of a width of w depths leaves 1 / sqrt(2 w sqrt(pi)) of the noise; 420 / 30 values are independent
    left = 1 / math.sqrt(2 * RADIUS / 87 / 0.01 * math.sqrt(math.pi))
    assert found[middle, 0, 12].real.std() == pytest.approx(left, rel=0.4)
    np.testing.assert_array_equal(surface.settled(shapes[:1], depths[:1]), shapes[:1])


def test_a_cone_widens_the_sphere_and_keeps_its_volume():
    growth = 0.1
    surface = surface_of(12_000, growth=growth)
    found = surface.integrate()
    radii = RADIUS + growth * found.apex_depths
    # volume between the first and the last sphere within the cone of the field of view, in slices of dz
    depths = np.linspace(0, found.apex_depths[-1], 2000)
    middle = RADIUS + growth * (depths[1:] + depths[:-1]) / 2
    volume = float((surface.ions.swept * middle**2 * np.diff(depths)).sum())
    assert volume == pytest.approx(12_000 * VOLUME, rel=0.01)  # the noise of the ring
    centre = found.positions + np.array([0, 0, 1])[None] * (found.apex_depths * (1 + growth))[:, None]
    np.testing.assert_allclose(np.linalg.norm(centre, axis=1), radii, atol=0.15)  # 0.03 nm, at most 5 times


def test_a_shifted_sphere_is_the_same_sphere():
    """A sphere whose centre lies beside the axis: its ions appear from their true directions, its field is even."""
    surface = surface_of(2000)
    shift = 0.02  # of R, across the axis
    coefficients = surface.transform.analysis((shift * surface.nodes[..., 0])[None])
    degrees = surface.transform.degrees
    (excess,), ((*deflection,),) = surface.transform.fields_and_gradient(
        (degrees - 1) * coefficients, -transfer(degrees) * coefficients
    )
    np.testing.assert_allclose(excess, 0.0, atol=1e-12)
    apparent = even_flux(500, RIM)
    origins, _, _ = surface.origins(apparent, np.stack(deflection), np.stack(deflection))
    # a point of the shifted sphere, seen from its own centre
    seen = (1 + shift * origins[:, :1]) * origins - np.array([shift, 0, 0])
    seen /= np.linalg.norm(seen, axis=1)[:, None]
    # first order: the square of the shift; bilinear cells of 2.6 degrees: 0.1 % of it
    np.testing.assert_allclose(seen, apparent, atol=2 * shift**2)


@pytest.mark.parametrize("degree", [2, 4])
def test_a_wrong_shape_is_forgotten_at_the_rate_of_its_degree(degree):
    """An even flux on a sphere with a small bump about the axis: the bump decays as exp(-rate z / R)."""
    surface = surface_of(200_000, directions=even_flux(200_000, math.radians(58)))
    rate = float(transfer(degree)) * degree * (degree + 1) - 2
    nodes, transform = surface.nodes, surface.transform
    epsilon = 1e-3
    bump = RADIUS * epsilon * zonal(degree, nodes[..., 2])[0]
    # one step of the equations with the flux that an even sphere sends, in closed form
    coefficients = transform.analysis(bump[None])[0]
    degrees = transform.degrees
    eps = coefficients / RADIUS
    (_, divergence), (deflection, slope) = transform.fields_and_gradient(
        np.stack([coefficients, transfer(degrees) * degrees * (degrees + 1) * eps]),
        np.stack([-transfer(degrees) * eps, eps]),
    )
    axis = surface._axis
    seen = nodes[..., 2] + (deflection * axis).sum(axis=0)
    change = -seen * (1 + divergence) * (1 - 2 * bump / RADIUS) + nodes[..., 2] - (slope * axis).sum(axis=0)
    # near the axis cos(theta) is 1: the decay of h there, relative to h
    top = nodes[..., 2] > math.cos(0.06)
    np.testing.assert_allclose((change[top] * RADIUS / bump[top]).mean(), -rate, rtol=0.06)


def test_the_origins_of_ions_are_those_of_a_slow_search():
    surface = surface_of(2000)
    rng = np.random.default_rng(1)
    nodes = surface.nodes
    deflection = np.stack(
        [0.05 * np.sin(9 * nodes[..., 0]) * nodes[..., 2], 0.05 * np.cos(7 * nodes[..., 1] + nodes[..., 0])]
    )
    apparent = even_flux(200, RIM)[rng.permutation(200)[:40]]
    origins, values, counts = surface.origins(apparent, deflection, nodes[..., :2].transpose(2, 0, 1).copy())
    polar, azimuth = surface.transform.polar, surface.transform.azimuths
    tables = [scipy.interpolate.RegularGridInterpolator((polar, azimuth), part) for part in deflection]

    def seen_from(direction):
        x, y, z = direction
        at = (math.acos(y), math.pi + math.atan2(x, z))
        along, across = (float(table(at)) for table in tables)
        turned, upright = math.sin(at[1] - math.pi), math.cos(at[1] - math.pi)
        tangent = np.array([y * turned, -math.sin(at[0]), y * upright])
        side = np.array([upright, 0.0, -turned])
        seen = direction + along * tangent + across * side
        return seen / np.linalg.norm(seen)

    for one, found in zip(apparent, origins, strict=True):
        # eight sweeps that contract by 0.5; nodes of Gauss and Legendre taken as equidistant: 1e-3 of a cell
        np.testing.assert_allclose(seen_from(found), one, atol=4e-3)
    # bilinear between nodes 2.6 degrees apart: an eighth of the square of that
    np.testing.assert_allclose(values, origins[:, :2], atol=1e-3)
    np.testing.assert_allclose(counts.sum(), len(apparent), rtol=1e-12)
    np.testing.assert_allclose((counts[..., None] * nodes).sum(axis=(0, 1)), origins.sum(axis=0), atol=0.02)


def test_the_volume_of_the_ions_is_what_the_surface_loses():
    """Within the field of view the volume between the first and the last surface is that of the ions."""
    rng = np.random.default_rng(2)
    directions = even_flux(15_000, RIM)
    directions[:, 0] += 0.1 * directions[:, 0] * np.abs(rng.standard_normal(15_000))  # an uneven flux
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    inside = directions[:, 2] > math.cos(RIM)
    surface = surface_of(directions=directions[inside])
    found = surface.integrate()
    density = 1 / VOLUME
    centre = np.array([0, 0, RADIUS - 2.0])
    ball = 1.2
    counted = np.count_nonzero(np.linalg.norm(found.positions - centre, axis=1) < ball)
    expected = density * 4 / 3 * math.pi * ball**3
    # counts: 4 standard deviations of 520 ions, and 3 % by the damping of the volume
    assert counted == pytest.approx(expected, rel=4 / math.sqrt(expected) + 0.03)


@pytest.mark.slow  # 3 s: three processes
def test_the_bits_do_not_depend_on_the_threads():
    code = (
        "import sys; sys.path[:0] = ['tests', 'tests/reconstruction']\n"
        "from test_evolving_surface import surface_of\n"
        "import hashlib\n"
        "print(hashlib.sha256(surface_of(5000).integrate().positions.tobytes()).hexdigest())"
    )
    digests = set()
    for threads in ("1", "2", "3"):
        variables = os.environ | {name: threads for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
        run = subprocess.run(
            [sys.executable, "-P", "-c", code], env=variables, capture_output=True, text=True, check=True
        )
        digests.add(run.stdout)
    assert len(digests) == 1


def test_ions_that_are_searched_together_have_the_origins_that_each_has_alone():
    surface = surface_of(2000)
    apparent, rng = np.ascontiguousarray(surface.ions.directions[:19]), np.random.default_rng(3)
    deflection, table = (
        rng.normal(0, 0.02, (2, *surface.nodes.shape[:2])),
        rng.normal(size=(1, *surface.nodes.shape[:2])),
    )
    together = surface.origins(apparent, deflection, table)
    alone = [surface.origins(apparent[[ion]], deflection, table) for ion in range(19)]
    for k in (0, 1):
        np.testing.assert_array_equal(together[k], np.concatenate([one[k] for one in alone]))
    np.testing.assert_allclose(together[2], sum(one[2] for one in alone), atol=1e-14)


@pytest.mark.parametrize(
    ("radius", "ions", "degree"),
    [
        (3.0, 1e6, 44),
        (20.0, 1e6, 44),
        (30.0, 1e6, 51),
        (88.0, 1e7, 88),
        (88.0, 6e4, 44),
        (88.0, 24e4, 65),
        (900.0, 1e8, 117),
    ],
)
def test_degrees_grow_with_the_root_of_large_radii_if_there_are_ions_for_it(radius, ions, degree):
    volume = math.pi * math.sin(RIM) ** 2 * radius**3 / ions  # this many in one radius of depth
    surface = EvolvingSurface(IonSequence(even_flux(10, RIM), volume, RIM, radius))
    assert surface.transform.degree == degree
    orders = np.arange(degree + 1)
    rates = transfer(orders) * orders * (orders + 1) * np.exp(-0.5 * (orders * 11 / 6 / degree) ** 2)
    assert surface.step == pytest.approx(0.7 * radius / rates.max(), rel=0.02)  # 0.7 of the time of the fastest degree
