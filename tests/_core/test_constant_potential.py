"""Charges at a constant potential: closed forms, the dense twin, and Robin's rule for smooth surfaces."""

import numpy as np
import pytest
import twins
from scipy.special import erfc
from smooth import fibonacci, spheroid

import apt_evap as ae
from apt_evap._core.constant_potential import LATTICE_SUM, ConstantPotential, gaussian_table
from apt_evap._core.interactions import InteractionLists
from apt_evap._core.octree import Octree
from apt_evap._core.potentials import Potentials
from apt_evap.units import COULOMB

EXACT = ae.evaporation.ChargeSettings(opening_angle=0.0, relaxation_angle=0.0, start_tolerance=1e-9)


def solved(positions, normals, self_term=0.0, gaussian=False, opening_angle=0.0, tolerance=1e-9, known=False):
    """Charges at the potential 1 [e/nm] in the order given, tree, rule and number of sweeps."""
    tree = Octree(np.ascontiguousarray(positions), np.ones(len(positions)))
    rule = ConstantPotential(self_term, gaussian, False, 1e-5)
    if known:  # no first estimate of the area per atom, for a surface without an inside
        rule.state = {"self_term": self_term, "area": 1.0}
    sweeps, residual = rule.solve(
        tree,
        np.ascontiguousarray(normals[tree.atoms]),
        InteractionLists(tree, opening_angle, 1),
        potential=1.0,
        tolerance=tolerance,
        double_precision=True,
    )
    assert residual < tolerance
    charges = np.empty(len(positions))
    charges[tree.atoms] = tree.charges
    return charges, tree, rule, sweeps


# ---- closed forms --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("factor", [0.8, 1.0, 1.3])
def test_charge_of_a_sphere_and_the_place_of_its_electrical_surface(factor):
    radius, n = 7.0, 4000
    area = 4 * np.pi * radius**2 / n
    points = fibonacci(n)
    charges, tree, *_ = solved(radius * points, points, factor * LATTICE_SUM / np.sqrt(area), opening_angle=0.2)
    # z_0 = -s/(4 pi) (S - 3.92/sqrt(s)), outwards: Q = V (R + z_0). The spiral is no triangular lattice: its sum is
    # 1 % smaller in the mean, which moves the surface by 0.3 % of 3.92 sqrt(s)/(4 pi)
    shift = -np.sqrt(area) / (4 * np.pi) * LATTICE_SUM * (factor - 1)
    assert charges.sum() == pytest.approx(radius + shift, abs=0.03 * np.sqrt(area))
    # the potential inside is that of the surface, the field outside that of the charge
    inside = tree.potentials(points[::40] * 0.9 * radius, 0.0)
    assert inside == pytest.approx(charges.sum() / radius, rel=1e-4)
    assert np.linalg.norm(tree.fields(points[::40] * 0.9 * radius, 0.0), axis=1).max() < 1e-3 / radius
    outside = np.linalg.norm(tree.fields(points[::40] * 1.3 * radius, 0.0), axis=1)
    assert outside == pytest.approx(charges.sum() / (1.3 * radius) ** 2, rel=1e-4)


def test_field_of_a_sphere_is_voltage_over_radius():
    errors = []
    for n in (1000, 4000):
        points = fibonacci(n)
        charges, _, rule, _ = solved(7.0 * points, points, opening_angle=0.2)
        # the first order error is the same as Robin's: an atom lacks half of the curvature of its own patch
        errors.append(4 * np.pi * charges.mean() / rule.area * 7.0 - 1)
        assert rule.self_term == pytest.approx(LATTICE_SUM / np.sqrt(4 * np.pi * 49 / n), rel=0.03)
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.1)
    assert abs(2 * errors[1] - errors[0]) < 3e-3


def test_spheroid():
    """sigma ~ (x^2/a^4 + y^2/b^4 + z^2/c^4)^-1/2 (Landau and Lifshitz VIII, 4)."""
    ratios = []
    for n in (1000, 4000):
        positions, normals = spheroid(n, 5.0, 10.0)
        charges = solved(positions, normals, opening_angle=0.3)[0]
        exact = 1 / np.sqrt((positions[:, :2] ** 2).sum(axis=1) / 5.0**4 + positions[:, 2] ** 2 / 10.0**4)
        ring = np.arange(n) * 10 // n
        ratios.append(np.bincount(ring, charges) / charges.sum() / (np.bincount(ring, exact) / exact.sum()) - 1)
    # the neighbourhood of an atom is curved: an error of the order of spacing over radius of curvature (2.5 nm at the
    # poles), which halves with the spacing
    assert np.abs(ratios[1]).max() < 0.01
    assert np.abs(ratios[1]).max() < 0.6 * np.abs(ratios[0]).max()


@pytest.fixture(scope="session")
def disc():
    """A disc of a triangular lattice of spacing 0.25 nm, radius 6 nm."""
    i, j = np.meshgrid(np.arange(-40, 41), np.arange(-40, 41))
    points = np.stack([i + 0.5 * j, np.sqrt(0.75) * j, 0 * i], axis=-1).reshape(-1, 3) * 0.25
    return points[np.linalg.norm(points, axis=1) < 6.0]


def test_disc(disc):
    """sigma = Q / (2 pi a sqrt(a^2 - r^2)) on both faces together, Q = 2 a V / pi (Landau and Lifshitz VIII, 4)."""
    area = np.sqrt(0.75) * 0.25**2
    normals = np.tile([0.0, 0.0, 1.0], (len(disc), 1))
    charges, tree, _, _ = solved(disc, normals, LATTICE_SUM / np.sqrt(area), known=True)
    edge = np.sqrt(len(disc) * area / np.pi)  # of the same area
    assert charges.sum() == pytest.approx(2 * edge / np.pi, rel=0.01)  # the edge is known to a part of a spacing
    r = np.linalg.norm(disc, axis=1)
    inner = r < 0.5 * edge  # far from the edge, where charges are those of atoms on a line
    exact = area / (np.pi**2 * np.sqrt(edge**2 - r**2))
    assert charges[inner] == pytest.approx(exact[inner], rel=0.01)
    # one spacing above and below the lattice its field is that of a sheet, 2 pi sigma
    for side in (-0.5, 0.5):
        field = tree.fields(np.array([[0.1, 0.05, side]]), 0.0)[0]
        assert field[2] / np.sign(side) == pytest.approx(2 * np.pi * charges[np.argmin(r)] / area, rel=0.1)


def test_a_flat_lattice_has_the_lattice_sum(disc):
    # lim 2 sqrt(pi N) - sum sqrt(s)/r over the N nearest atoms; fluctuates with the number of atoms in a circle
    area, r = np.sqrt(0.75) * 0.25**2, np.sort(np.linalg.norm(disc, axis=1))[1:]
    partial = [2 * np.pi * radius / area - (1 / r[r < radius]).sum() for radius in np.linspace(4.0, 5.9, 400)]
    assert np.mean(partial) * np.sqrt(area) == pytest.approx(LATTICE_SUM, rel=0.01)


def test_smooth_surfaces_have_the_charges_of_robin():
    """A spheroid: the two rules agree as the spacing over the radius vanishes."""
    differences = []
    for n in (400, 1000, 2500):
        positions, normals = spheroid(n, 5.0, 10.0)
        charges = solved(positions, normals, opening_angle=0.3, tolerance=1e-6)[0]
        robin, _ = twins.robin(positions, normals, tolerance=1e-6)
        ring = np.arange(n) * 10 // n
        first, second = np.bincount(ring, charges) / charges.sum(), np.bincount(ring, robin) / robin.sum()
        differences.append(np.abs(first / second - 1).max())
    assert differences[2] < 0.025
    assert differences[0] > 1.3 * differences[1] > 1.3**2 * differences[2]  # spacings of 1 : 0.63 : 0.4


# ---- the dense twin ------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("gaussian", [False, True])
def test_charges_are_those_of_the_dense_matrix(small_tip, gaussian):
    rule = ae.ConstantPotential(self_term=None if not gaussian else 9.0, charges="gaussian" if gaussian else "points")
    emitter = ae.evaporation.Emitter(small_tip, 1000.0, settings=EXACT, rule=rule)
    self_term = emitter._core.rule.self_term
    eta = self_term * np.sqrt(np.pi / 2) if gaussian else None
    twin = twins.constant_potential(emitter.positions, self_term, eta) * 1000.0 / COULOMB
    # solved to a change of 1e-9 in a sweep; the table of Gaussian charges is exact to 1e-6 of the self term
    assert emitter.charges == pytest.approx(twin, abs=(1e-5 if gaussian else 1e-7) * twin.mean())
    if gaussian:
        points = twins.constant_potential(emitter.positions, self_term) * 1000.0 / COULOMB
        assert np.abs(points - twin).max() > 0.01 * twin.mean()  # the correction of near atoms matters


def test_all_atoms_have_the_potential_of_the_specimen(small_tip):
    emitter = ae.evaporation.Emitter(small_tip, 1000.0, settings=EXACT, rule=ae.ConstantPotential())
    at_atoms = COULOMB * twins.potential_of_others(emitter.positions, emitter.charges)
    potentials = at_atoms + COULOMB * emitter._core.rule.self_term * emitter.charges
    assert potentials == pytest.approx(1000.0, rel=1e-6)
    # two layers below the surface of the cap: potentials of point charges at interior atoms
    tip = emitter.tip
    inside = tip.positions[np.linalg.norm(tip.positions, axis=1) < 4 * 0.352]
    assert emitter.potential_at(inside, 0.0) == pytest.approx(1000.0, rel=2e-3)
    assert emitter.potential_at(inside, 0.0).std() < 0.3  # V; Robin's rule has 1 to 3 V


def test_the_self_term_follows_from_the_area_per_atom(small_tip):
    emitter = ae.evaporation.Emitter(small_tip, 1000.0, rule=ae.ConstantPotential(law_field="charge"))
    robin = ae.evaporation.Emitter(small_tip, 1000.0)
    # the first estimate stops at a change of 1e-2
    assert emitter._core.rule.self_term == pytest.approx(LATTICE_SUM / np.sqrt(robin.area_per_atom), rel=2e-3)
    # the total charge is that of Robin's rule to 0.5 %, its contrast larger
    assert emitter.charges.sum() == pytest.approx(robin.charges.sum(), rel=5e-3)
    assert emitter.charges.std() > 1.2 * robin.charges.std()
    # the mean field of the cap does not depend on the rule, but for the few atoms of so small a tip; 2e-4 at R = 12 a
    assert emitter.cap.field == pytest.approx(robin.cap.field, rel=0.04)


def test_gaussian_table():
    table, per_square = gaussian_table(10.0)
    r = np.sqrt(np.arange(1, len(table)) / per_square)
    # beyond the last entry the difference is left out
    assert -table[1:] * r == pytest.approx(erfc(10.0 * r / np.sqrt(2)), abs=1e-6)


def test_preconditioner_is_symmetric_and_positive(rng):
    rule = ConstantPotential(10.0, False, False, 1e-5)
    rule.state = {"self_term": 10.0, "area": 1.0}
    n = 75  # incomplete blocks
    matrix = np.array([rule.preconditioned(row) for row in np.eye(n)])
    assert np.allclose(matrix, matrix.T, rtol=0, atol=1e-15)  # rounding of entries of 0.1
    assert np.linalg.eigvalsh(matrix).min() > 0


def test_warm_starts_and_few_iterations(surface12):
    positions, normals, _ = surface12
    *_, cold = solved(positions, normals, opening_angle=0.4, tolerance=1e-5)
    assert cold < 40
    top = np.argmax(positions[:, 2])
    left = np.arange(len(positions)) != top
    charges, tree, rule, _ = solved(positions, normals, opening_angle=0.4, tolerance=1e-5)
    tree = Octree(np.ascontiguousarray(positions[left]), charges[left])
    lists = InteractionLists(tree, 0.4, 1)
    warm, _ = rule.solve(tree, np.ascontiguousarray(normals[left][tree.atoms]), lists, potential=1.0, tolerance=1e-3)
    assert warm <= 12


@pytest.mark.parametrize("self_term", [1.0, 5.0])
def test_a_self_term_that_is_too_small_is_refused(small_tip, self_term):
    with pytest.raises(ValueError, match="self_term"):
        ae.evaporation.Emitter(small_tip, rule=ae.ConstantPotential(self_term=self_term))


# ---- sums of charges of either sign --------------------------------------------------------------------------------


@pytest.fixture
def signed(rng):
    """Charges of both signs on a sphere, some in pairs of opposite charges: nodes without a centre of charge."""
    points = 5 * fibonacci(1500)
    charges = rng.normal(size=len(points)) + 0.3
    pairs = 4 * fibonacci(300)
    points = np.concatenate([points, pairs, pairs * 1.02])
    return points, np.concatenate([charges, np.full(300, 2.0), np.full(300, -2.0)])


def test_octree_with_charges_of_either_sign(signed, rng):
    points, charges = signed
    tree = Octree(points, charges)
    assert tree.n_cancelling > 5
    targets = rng.normal(size=(100, 3))
    targets *= (np.array([5.5, 7.0, 12.0, 50.0])[np.arange(100) % 4] / np.linalg.norm(targets, axis=1))[:, None]
    errors = []
    for angle in (0.3, 0.6):
        field = tree.fields(targets, angle) - twins.field(targets, points, charges)
        potential = tree.potentials(targets, angle) - twins.potential(targets, points, charges)
        # errors of a cell are relative to the sum of the absolute charges
        r = np.linalg.norm(targets, axis=1)
        total = np.abs(charges).sum()
        errors.append([np.abs(potential * r / total).max(), np.abs(field * r[:, None] ** 2 / total).max()])
    assert errors[0][0] < 3e-4
    assert errors[0][1] < 2e-3
    assert errors[0][0] < errors[1][0]
    same = tree.copy()
    assert same.n_cancelling == tree.n_cancelling
    assert np.array_equal(same.fields(targets, 0.6), tree.fields(targets, 0.6))


def test_potentials_at_all_atoms(signed):
    points, charges = signed
    tree = Octree(points, charges)
    exact = twins.potential_of_others(tree.positions, tree.charges)
    errors = []
    for angle in (0.0, 0.3, 0.6):
        potentials = np.empty(len(points))
        Potentials(InteractionLists(tree, angle, 1)).of(tree.charges, potentials, True)
        errors.append(np.sqrt(np.mean((potentials - exact) ** 2)))
        single = np.empty(len(points))
        Potentials(InteractionLists(tree, angle, 1)).of(tree.charges, single, False, 2)
        # partial sums of 64 terms in single precision
        assert np.abs(single - potentials).max() < 1e-6 * np.abs(charges).sum()
    assert errors[0] < 1e-12 * np.abs(charges).sum()
    assert errors[1] < 0.2 * errors[2]  # an octupole's error: the fourth power of the angle, 1/16
    assert errors[2] < 1e-4 * np.abs(charges).sum()
