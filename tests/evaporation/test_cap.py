"""The cap of a surface: the sphere through its atoms, and their mean field."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import apt_evap as ae
from apt_evap.evaporation.cap import HALF_ANGLE, NO_CAP, measure_cap
from apt_evap.units import COULOMB

COSINE = np.cos(np.radians(HALF_ANGLE))


def fibonacci(n):
    """Unit vectors, each of the same share of the sphere."""
    k = np.arange(n) + 0.5
    z, azimuth = 1 - 2 * k / n, np.pi * (1 + np.sqrt(5)) * k
    return np.stack([np.sqrt(1 - z * z) * np.cos(azimuth), np.sqrt(1 - z * z) * np.sin(azimuth), z], axis=1)


def slow_cap(positions, normals, fields, evaporation_fields):
    """Twin: three rounds of an algebraic least-squares sphere by NumPy, about atoms within 45 degrees of the axis."""
    chosen = normals[:, 2] >= COSINE
    for _ in range(3):
        points = positions[chosen]
        matrix = np.column_stack([2 * points, np.ones(len(points))])
        *centre, rest = np.linalg.lstsq(matrix, (points**2).sum(axis=1), rcond=None)[0]
        off = positions - centre
        chosen = off[:, 2] >= COSINE * np.linalg.norm(off, axis=1)
    radius = np.sqrt(rest + np.dot(centre, centre))
    ratios = (fields / evaporation_fields)[chosen]
    weights = fields[chosen]
    field, ratio = np.average(weights, weights=weights), np.average(ratios, weights=weights)
    return field, ratio, radius, centre[2] + radius


# ---- points --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("centre", [(0, 0, 0), (1.5, -2.0, 30.0)])
def test_a_perfect_sphere(centre, rng):
    directions, radius = fibonacci(2000), 7.0
    fields, evaporation_fields = rng.uniform(10, 20, 2000), rng.uniform(20, 40, 2000)
    cap = measure_cap(centre + radius * directions, directions, fields, evaporation_fields)
    # a linear problem of four numbers, whose condition number of about 100 multiplies roundings
    assert cap.radius == pytest.approx(radius, rel=1e-12)
    assert cap.apex == pytest.approx(centre[2] + radius, rel=1e-12)
    # averaged is over exactly the atoms within 45 degrees, seen from the centre: the centre is right
    inside = directions[:, 2] >= COSINE
    assert cap.field == pytest.approx(np.average(fields[inside], weights=fields[inside]), rel=1e-12)
    ratios = (fields / evaporation_fields)[inside]
    assert cap.ratio == pytest.approx(np.average(ratios, weights=fields[inside]), rel=1e-12)
    assert inside.sum() == pytest.approx(2000 * (1 - COSINE) / 2, abs=1)


def test_the_centre_is_found_from_any_normals_that_point_upwards(rng):
    """The normals only choose the atoms of the first round."""
    directions = fibonacci(3000)
    positions = [0.3, 0.2, 5.0] + 6.0 * directions
    normals = directions + rng.normal(0, 0.2, directions.shape)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    fields = rng.uniform(10, 20, 3000)
    one, two = (measure_cap(positions, each, fields, np.full(3000, 35.0)) for each in (directions, normals))
    assert one == pytest.approx(two, rel=1e-12)  # the same atoms, but for rounding


def test_turning_and_moving_a_surface_leaves_its_cap(surface12):
    positions, normals, charges = surface12
    evaporation_fields = np.full(len(charges), 35.0)
    cap = measure_cap(positions, normals, charges, evaporation_fields)
    turn = Rotation.from_euler("z", 0.7).as_matrix().T
    shift = np.array([3.0, 4.0, -20.0])
    turned = measure_cap(positions @ turn + shift, normals @ turn, charges, evaporation_fields)
    scaled = measure_cap(2.0 * positions, normals, 3.0 * charges, evaporation_fields)
    moved = cap._replace(apex=cap.apex - 20.0)
    assert turned == pytest.approx(moved, rel=1e-11)  # roundings of positions of 20 nm, in squares
    assert scaled == pytest.approx((3 * cap.field, 3 * cap.ratio, 2 * cap.radius, 2 * cap.apex), rel=1e-12)


def test_atoms_far_from_the_axis_do_not_matter(rng):
    directions = fibonacci(2000)
    cap = directions[:, 2] > 0.6  # beyond 45 degrees
    positions, fields = 5.0 * directions, rng.uniform(10, 20, 2000)
    shank = np.where(cap[:, None], positions, positions * rng.uniform(0.5, 0.9, (2000, 1)))
    evaporation_fields = np.full(2000, 35.0)
    assert measure_cap(shank, directions, fields, evaporation_fields) == pytest.approx(
        measure_cap(positions, directions, fields, evaporation_fields), rel=1e-12
    )


def test_a_rough_sphere():
    """The algebraic sphere of a cap is a little too small: by 10.5 (sd/R)^2 of R, measured with 80,000 points."""
    directions, radii = fibonacci(5000), []
    for seed in range(20):
        rough = (10.0 + np.random.default_rng(seed).normal(0, 0.1, (5000, 1))) * directions
        radii.append(measure_cap(rough, directions, np.ones(5000), np.ones(5000)).radius)
    # 730 atoms: the radii have a standard deviation of 0.04, and so their mean one of 0.009
    assert np.mean(radii) == pytest.approx(10.0 - 10.5 * 0.1**2, abs=4 * 0.009)
    assert np.std(radii) == pytest.approx(0.04, rel=0.5)


@pytest.mark.parametrize(("n", "known"), [(0, False), (11, False), (12, True)])
def test_too_few_atoms_have_no_cap(n, known):
    directions = fibonacci(200)
    around, elsewhere = directions[directions[:, 2] > 0.75][:n], directions[directions[:, 2] < 0.5]
    points = np.concatenate([around, elsewhere])
    assert len(around) == n
    cap = measure_cap(points, points, np.ones(len(points)), np.ones(len(points)))
    if known:
        assert cap == pytest.approx((1.0, 1.0, 1.0, 1.0), rel=1e-12)
    else:
        assert np.isnan(cap).all() and np.isnan(NO_CAP).all()


# ---- of an emitter -------------------------------------------------------------------------------------------------


def test_the_cap_of_an_emitter_is_that_of_its_evaporable_atoms(tip12):
    emitter = ae.evaporation.Emitter(tip12, n_threads=1)
    assert sum(map(len, emitter.advance(150))) == 150
    may = tip12.evaporable[emitter.atoms]
    assert not may.all()
    arrays = emitter.positions[may], emitter.normals[may], emitter.fields[may], np.full(may.sum(), 35.0)
    assert emitter.cap == pytest.approx(slow_cap(*arrays), rel=1e-9)  # normal equations square a condition of 100
    # a rough cap of 4.22 nm: its atoms are 0 to 0.3 nm below the sphere that cut them out
    assert 0.9 * tip12.apex < emitter.cap.radius < tip12.apex
    assert emitter.cap.ratio == pytest.approx(emitter.cap.field / 35.0, rel=1e-14)


def test_atoms_that_never_evaporate_are_not_of_the_cap(nickel, small_tip):
    may = (small_tip.positions[:, 2] > 0) & (small_tip.positions[:, 0] > -0.3)
    tip = ae.Tip.from_positions(small_tip.positions, small_tip.species, [nickel], evaporable=may)
    emitter = ae.evaporation.Emitter(tip, n_threads=1)
    chosen = may[emitter.atoms]
    arrays = emitter.positions, emitter.normals, emitter.fields, np.full(len(emitter), 35.0)
    assert emitter.cap == pytest.approx(slow_cap(*(array[chosen] for array in arrays)), rel=1e-9)
    assert emitter.cap != pytest.approx(slow_cap(*arrays), rel=1e-4)


def test_fields_of_the_cap_are_in_proportion_to_the_voltage(small_tip):
    one, two = (ae.evaporation.Emitter(small_tip, voltage, n_threads=1).cap for voltage in (500.0, 1500.0))
    # charges converge to rounding in the same steps
    assert two == pytest.approx((3 * one.field, 3 * one.ratio, one.radius, one.apex), rel=1e-9)


def test_the_ratio_of_an_alloy_is_that_of_each_species():
    tip = ae.Tip("Al", apex_radius=3.0, shank_length=3.0, solutes={"Cu": 0.3}, seed=1)
    emitter = ae.evaporation.Emitter(tip, n_threads=1)
    may = tip.evaporable[emitter.atoms]
    evaporation_fields = tip.evaporation_fields[tip.species[emitter.atoms[may]]]
    assert len(np.unique(evaporation_fields)) == 2
    twin = slow_cap(emitter.positions[may], emitter.normals[may], emitter.fields[may], evaporation_fields)
    assert emitter.cap == pytest.approx(twin, rel=1e-9)


def free_sphere(nickel, radius):
    """Emitter of an fcc sphere without a shank; the lattice has no site at its centre."""
    n = int(radius) + 2
    grid = np.arange(-n, n + 1)
    cells = np.stack(np.meshgrid(grid, grid, grid), axis=-1).reshape(-1, 1, 3)
    sites = (cells + np.array([[0, 0, 0], [0.5, 0.5, 0], [0.5, 0, 0.5], [0, 0.5, 0.5]])).reshape(-1, 3)
    sites -= [0.13, 0.27, 0.41]
    positions = nickel.a * sites[np.linalg.norm(sites, axis=1) < radius]
    n = len(positions)
    tip = ae.Tip.from_positions(
        positions, np.zeros(n, int), [nickel], evaporable=np.ones(n, bool), potential_point=np.zeros(3)
    )
    return ae.evaporation.Emitter(tip, 1000.0, n_threads=1)


def test_fields_of_a_free_sphere_of_atoms(nickel):
    """Weighted by the charges, the mean field is V/R: k_f = 1. The plain mean of a rough surface is 13 % lower."""
    errors = []
    for radius in (10, 20):
        emitter = free_sphere(nickel, radius)
        electrical = COULOMB * emitter.charges.sum() / emitter.voltage  # R of a sphere with this charge
        assert electrical == pytest.approx(radius * nickel.a, rel=0.03)  # atoms are up to d/2 below the cut
        smooth = emitter.voltage / electrical
        errors.append(np.average(emitter.fields, weights=emitter.charges) / smooth - 1)
        # the cap about [001] differs by the share of its poles
        assert emitter.cap.field / smooth == pytest.approx(1.0, abs=0.3 / radius + 0.01)
    assert abs(errors[1]) < abs(errors[0]) < 0.03  # measured -2.2, -1.0 and -0.5 % for R = 12, 24 and 40 a
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.3)  # of the first order in d/R


# ---- of a run ------------------------------------------------------------------------------------------------------


def test_the_history_of_a_run_has_the_cap_after_each_relaxation(small_tip, tmp_path):
    settings = ae.evaporation.ChargeSettings(sweep_interval=40, potential_bound=1.0)
    run = ae.Simulation(small_tip, charge_settings=settings, n_threads=1).run(
        130, responses=False, progress=False, batch_size=25
    )
    assert run.cap.ions.tolist() == [0, 40, 80, 120]
    emitter, caps, n = ae.evaporation.Emitter(small_tip, settings=settings, n_threads=1), [], 0
    for batch in emitter.advance(130):
        if n % 40 == 0 and len(batch):
            caps.append(batch.cap)
        n += len(batch)
    assert np.array_equal(np.array(caps).T, [run.cap.fields, run.cap.ratios, run.cap.radii, run.cap.apexes])
    first = ae.evaporation.Emitter(small_tip, n_threads=1).cap
    assert tuple(values[0] for values in run.cap[1:]) == first
    run.save(tmp_path / "run.h5")
    loaded = ae.load(tmp_path / "run.h5").cap
    assert all(np.array_equal(one, other) for one, other in zip(loaded, run.cap, strict=True))


def test_the_cap_of_a_shrinking_specimen(tip12):
    """While the first cap rounds off, the radius changes little and the field follows it at constant voltage."""
    emitter = ae.evaporation.Emitter(tip12, n_threads=1)
    caps = [batch.cap for batch in emitter.advance(1000) if batch.cap is not None]
    assert len(caps) >= 10
    radii, fields = (np.array([getattr(cap, name) for cap in caps]) for name in ("radius", "field"))
    assert radii == pytest.approx(radii.mean(), rel=0.05)  # 1,000 of 19,000 evaporable atoms: 2 nm of 4.2 at most
    # F is in proportion to 1/R for a form that stays the same: what it changes is below 5 %
    assert radii * fields == pytest.approx((radii * fields).mean(), rel=0.05)
