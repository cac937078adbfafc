"""Shape of the surface over a particle with another evaporation field, against a theory.

On a nearly spherical conductor with the contrast f = F_P / F_M on a disc, the surface r = R + h adjusts until the field
is proportional to the evaporation field. To first order the field of a harmonic h_l of the surface is
F_0 (1 + (l - 1) h_l / R), so that h_l = R ln(f)_l / (l - 1). The harmonics 0 and 1 are a growth and a shift, which
evaporation does not restore.
"""

import numpy as np
import pytest
from numpy.polynomial import legendre
from scipy.optimize import least_squares

import apt_evap as ae

R, RADIUS = 9.0, 3.0
HARMONICS = 400


def theory(ratio):
    """Ratio of the radii of spheres fitted to the particle and to the matrix."""
    x, weights = legendre.leggauss(4000)
    contrast = np.where(x > np.sqrt(1 - (RADIUS / R) ** 2), np.log(ratio), 0.0)
    angle = np.linspace(0, np.arcsin(0.8), 2000)
    height = np.zeros_like(angle)
    for order in range(2, HARMONICS):
        unit = np.zeros(order + 1)
        unit[order] = 1
        part = (2 * order + 1) / 2 * (weights * contrast * legendre.legval(x, unit)).sum()
        height += R * part / (order - 1) * legendre.legval(np.cos(angle), unit)
    rho, z = (R + height) * np.sin(angle), (R + height) * np.cos(angle)
    return fitted(rho, np.zeros_like(rho), z, rho < 0.75 * RADIUS, weights=rho) / fitted(
        rho, np.zeros_like(rho), z, (rho > 1.3 * RADIUS) & (rho < 0.8 * R), weights=rho
    )


def fitted(x, y, z, chosen, weights=None):
    """Radius of the sphere about the axis that fits points best."""
    rho, z = np.hypot(x, y)[chosen], z[chosen]
    scale = 1.0 if weights is None else np.sqrt(weights[chosen])
    return least_squares(lambda v: scale * (np.hypot(rho, z - v[0]) - v[1]), [0, R]).x[1]


def tip_with_ball(ratio):
    """Aluminium with a ball below the apex, whose evaporation field has this ratio to that of the matrix."""
    aluminium = ae.material("Al")
    ball = ae.specimen.Phase(
        "ball", aluminium, ae.specimen.Sphere((0, 0, R - 0.3 * RADIUS), RADIUS), evaporation_field=19.0 * ratio
    )
    return ae.Tip(
        phases=[ae.specimen.Phase("matrix", aluminium), ball], apex_radius=R, axis=(0, 1, 2), shank_length=R, depth=5.0,
        offset_seed=1,
    )  # fmt: skip


def measured(ratio, first, snapshots, step):
    """The same of a simulated surface, the mean of several times."""
    tip = tip_with_ball(ratio)
    emitter = ae.evaporation.Emitter(tip, n_threads=1, settings=ae.evaporation.ChargeSettings(sweep_interval=300))
    ratios = []
    for events in [first, *[step] * (snapshots - 1)]:
        for _ in emitter.advance(events):
            pass
        x, y, z = emitter.positions.T
        phase, rho, up = emitter.tip.phase[emitter.atoms], np.hypot(x, y), z > 0
        ratios.append(
            fitted(x, y, z, (phase == 1) & up & (rho < 0.75 * RADIUS))
            / fitted(x, y, z, (phase == 0) & up & (rho > 1.3 * RADIUS) & (rho < 0.8 * R))
        )
    return np.mean(ratios)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ratio", "first"),
    [
        (0.9, 3000),
        (1.2, 7000),  # before that the matrix has not receded enough
    ],
)
def test_the_surface_over_a_particle_adjusts_to_its_evaporation_field(ratio, first):
    # measured: 1.32 and 0.79, theory 1.31 and 0.78; a single snapshot scatters by 0.07, so that the mean of six does by
    # 0.03. A curvature in proportion to the evaporation field would give 1.11 and 0.83
    assert measured(ratio, first, 6, 900) == pytest.approx(theory(ratio), rel=0.1)


def density(ratio):
    """Hits in the image of the ball over those of the matrix between 30 and 45 degrees, and its relative error."""
    simulation = ae.Simulation(
        tip_with_ball(ratio), n_threads=1, charge_settings=ae.evaporation.ChargeSettings(sweep_interval=300)
    )
    for _ in simulation.emitter.advance(2500):  # until the shape has adjusted
        pass
    run = simulation.run(4500, responses=False, progress=False)
    hits = run.hits(ae.Unperturbed())
    angle = np.degrees(np.arctan(np.hypot(hits.x, hits.y) / run.detector.distance))
    core, ring = angle < 10, (angle > 30) & (angle < 45)
    assert (run.phase[core] == 1).all()
    return core.sum() / ring.sum(), np.sqrt(1 / core.sum() + 1 / ring.sum())


@pytest.mark.slow
def test_the_density_of_the_hits_goes_with_the_square_of_the_radius():
    (soft, error), (equal, other) = density(0.9), density(1.0)
    # measured: 1.59 with a Poisson error of 9 %, theory 1.72. The fields alone would give 1.23
    assert np.hypot(error, other) < 0.1
    assert soft / equal == pytest.approx(theory(0.9) ** 2, rel=0.15)
