"""Errors against the true sites: imposed constants are found, and a simulated run is compared with its sites."""

import json

import numpy as np
import pytest
import scipy

import apt_evap as ae
from apt_evap.reconstruction.errors import errors_of


@pytest.fixture
def cloud(rng):
    """Reconstructed positions, with the depth downwards, and angles."""
    return rng.random((4000, 3)) * [20, 20, 10] - [10, 10, 0], 40 * rng.random(4000)


def sites_of(positions, shift=(0, 0, 0), rotation=0.0, lateral=1.0, depth=1.0):
    cosine, sine = np.cos(np.radians(rotation)), np.sin(np.radians(rotation))
    turned = positions[:, :2] @ np.array([[cosine, sine], [-sine, cosine]])
    return np.column_stack([lateral * turned, -depth * positions[:, 2]]) + shift


def test_imposed_constants_are_found(cloud):
    positions, angles = cloud
    truth = sites_of(positions, (1.0, -2.0, 30.0), 25.0, 1.2, 0.9)
    errors = errors_of(positions, angles, truth)
    assert errors.shift == pytest.approx([1.0, -2.0, 30.0])
    assert (errors.rotation, errors.lateral_scale, errors.depth_scale) == pytest.approx((25.0, 1.2, 0.9))
    assert np.abs(errors.residuals).max() < 1e-12  # rounding of 30 nm
    assert errors.order_correlation == pytest.approx(1.0)


@pytest.mark.parametrize(
    "imposed",
    [{"shift": (1, 2, 3)}, {"rotation": 30.0}, {"lateral": 1.3}, {"depth": 0.7}],
    ids=lambda item: next(iter(item)),
)
def test_each_constant_needs_its_freedom(cloud, imposed):
    positions, angles = cloud
    (kind,) = imposed
    name = {"lateral": "lateral_scale", "depth": "depth_scale"}.get(kind, kind)
    truth = sites_of(positions, **imposed)
    alone = errors_of(positions, angles, truth, fit=(name,))
    assert np.abs(alone.residuals).max() < 1e-12
    others = errors_of(
        positions, angles, truth, fit=tuple({"shift", "rotation", "lateral_scale", "depth_scale"} - {name})
    )
    assert others.lateral_rms + others.depth_rms > 0.5
    with pytest.raises(ValueError, match="fit"):
        errors_of(positions, angles, truth, fit=("scale",))


def test_the_fit_is_the_least_of_the_squares(cloud, rng):
    positions, angles = cloud
    truth = sites_of(positions, (1, 2, 3), 5.0) + rng.normal(size=positions.shape)
    errors = errors_of(positions, angles, truth)
    # three degrees of freedom of 4,000 ions; the scatter of an RMS of n normal deviates is 1 / sqrt(2 n): 1 %
    assert errors.lateral_rms == pytest.approx(np.sqrt(2), rel=0.05)
    assert errors.depth_rms == pytest.approx(1.0, rel=0.05)
    for change in ({"rotation": 0.1}, {"lateral": 1.003}, {"depth": 0.997}, {"shift": (0.02, 0, 0.02)}):
        moved = sites_of(errors.residuals + truth - errors.shift, **change) * [1, 1, -1] + errors.shift - truth
        assert (moved**2).sum() > (errors.residuals**2).sum()


def test_bins_of_angle_and_depth(cloud):
    positions, angles = cloud
    truth = sites_of(positions) + np.column_stack([angles, 0 * angles, positions[:, 2]])
    errors = errors_of(positions, angles, truth, fit=())
    edges, ions, lateral, _ = errors.by_angle
    assert np.array_equal(edges, np.arange(0, 41, 5)) and ions.sum() == 4000
    for low, high, error in zip(edges, edges[1:], lateral, strict=False):
        assert low < error < high  # the lateral error is the angle here
    edges, ions, _, depth = errors.by_depth
    assert len(ions) == 10 and (np.diff(depth) > 0).all()
    assert errors.lateral_rms**2 == pytest.approx((angles**2).mean())
    told = json.loads(json.dumps(errors.to_dict(), allow_nan=False))
    assert told["by_depth"]["ions"] == ions.tolist() and "residuals" not in told


def test_the_order_within_cylinders(cloud, rng):
    positions, angles = cloud
    truth = sites_of(positions)
    shuffled = np.column_stack([truth[:, :2], rng.permutation(truth[:, 2])])
    # correlations of about 30 ions each in 100 cylinders: 1 / sqrt(3,000) = 0.02, four times
    assert abs(errors_of(positions, angles, shuffled).order_correlation) < 0.08
    assert errors_of(positions, angles, truth * [1, 1, -1]).order_correlation == pytest.approx(-1.0)
    # a tilt between places that are far apart keeps the order within each cylinder
    tilted = truth + np.column_stack([0 * angles, 0 * angles, 5 * np.floor(truth[:, 0] / 2)])
    assert errors_of(positions, angles, tilted).order_correlation == pytest.approx(1.0)
    few = errors_of(positions[:20], angles[:20], truth[:20])
    assert few.cylinders == 0 and np.isnan(few.order_correlation) and few.to_dict()["order_correlation"] is None


def test_the_order_is_the_correlation_of_ranks(cloud, rng):
    """The same cylinder by cylinder, with equal depths."""
    positions, angles = cloud
    positions = np.column_stack([positions[:, :2], np.round(positions[:, 2] + rng.normal(size=4000), 0)])
    truth = np.column_stack([cloud[0][:, :2], np.round(-cloud[0][:, 2], 1)])
    cells = np.floor(truth[:, :2] / 2)
    near = ((truth[:, :2] - 2 * cells - 1) ** 2).sum(axis=1) <= 1
    correlations, weights = [], []
    for cell in np.unique(cells[near], axis=0):
        chosen = near & (cells == cell).all(axis=1)
        if np.count_nonzero(chosen) >= 10:
            correlations.append(scipy.stats.spearmanr(-truth[chosen, 2], positions[chosen, 2]).statistic)
            weights.append(np.count_nonzero(chosen))
    errors = errors_of(positions, angles, truth)
    assert errors.cylinders == len(weights) > 50
    assert errors.order_correlation == pytest.approx(np.average(correlations, weights=weights), abs=1e-12)
    assert 0.5 < errors.order_correlation < 0.99


@pytest.fixture(scope="session")
def cap():
    """Hits of a cap that follows the point projection exactly, and their sites: R = 30 nm, compression 1.6."""
    rng = np.random.default_rng(11)
    n, radius, xi, distance, rim = 6000, 30.0, 1.6, 90.0, 38.0
    rho, azimuth = rim * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    straight = np.arctan(rho / distance)
    theta = straight + np.arcsin((xi - 1) * np.sin(straight))
    depth = np.linspace(0, 8, n)
    sites = radius * np.column_stack([np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)])
    hits = ae.Hits(x=rho * np.cos(azimuth), y=rho * np.sin(azimuth))
    return hits, sites - depth[:, None] * [0, 0, 1]


def test_radius_and_compression_are_found(cap):
    hits, sites = cap
    turned = sites @ np.array([[0.6, 0.8, 0], [-0.8, 0.6, 0], [0, 0, 1]]) + [0.5, -1.0, 40.0]
    wrong = ae.reconstruct(
        hits, atomic_volume=0.02, distance=90.0, detector_radius=38.0, radius=24.0, compression=1.3, efficiency=0.5
    )
    errors = wrong.errors(turned)
    # the depth is a line in the number of ions: all that is wrong can be fitted, to the tolerance of the search
    assert max(errors.lateral_rms, errors.depth_rms) < 1e-6
    assert (errors.radius_factor, errors.compression) == pytest.approx((30 / 24, 1.6), rel=1e-6)
    assert errors.rotation == pytest.approx(np.degrees(np.arctan2(0.8, 0.6)), abs=1e-5)
    assert errors.shift == pytest.approx([0.5, -1.0, 70.0], abs=1e-4)  # z of the apex of the first ion
    assert errors.lateral_scale == 1.0
    for fit in (("shift", "rotation", "depth_scale", "radius"), ("shift", "rotation", "depth_scale", "compression")):
        alone = wrong.errors(turned, fit=fit)
        assert alone.lateral_rms > 0.05  # fitted completely by both, above
        assert alone.compression == 1.3 if "compression" not in fit else alone.radius_factor == 1.0
    told = json.loads(json.dumps(errors.to_dict(), allow_nan=False))
    assert told["compression"] == errors.compression and "directions" not in told


def test_directions_are_those_of_the_specimen(cap):
    hits, sites = cap
    result = ae.reconstruct(hits, atomic_volume=0.02, distance=90.0, detector_radius=38.0, radius=30.0, compression=1.6)
    depth = np.linspace(0, 8, len(sites))
    directions = (sites + depth[:, None] * [0, 0, 1]) / 30.0
    quarter = sites[:, [1, 0, 2]] * [-1, 1, 1]
    assert result.errors(sites).directions == pytest.approx(directions, abs=1e-7)
    assert result.errors(quarter).directions == pytest.approx(directions[:, [1, 0, 2]] * [-1, 1, 1], abs=1e-7)


def test_errors_near_poles(cap):
    hits, sites = cap
    result = ae.reconstruct(hits, atomic_volume=0.02, distance=90.0, detector_radius=38.0, radius=30.0, compression=1.6)
    pole = np.array([0.3, 0.2, 1.0])
    true = result.errors(sites).directions
    angle = np.degrees(np.arccos(np.clip(true @ pole / np.linalg.norm(pole), -1, 1)))
    moved = sites + np.column_stack([np.zeros(len(sites))] * 2 + [0.1 * angle])
    errors = result.errors(moved, fit=())
    edges, ions, _, depth = errors.by_poles([pole, [0, 0, -1]], [0, 2, 4, 8])
    assert ions.tolist() == np.histogram(angle, [0, 2, 4, 8])[0].tolist()
    found = errors.residuals[:, 2]
    for low, high, error in zip(edges, edges[1:], depth, strict=False):
        chosen = (angle >= low) & (angle < high)
        assert error == pytest.approx(np.sqrt((found[chosen] ** 2).mean()))
    assert len(errors.by_poles(pole[None]).ions) == 6
    for poles, bins in (([], [0, 1]), ([[0, 0, 0]], [0, 1]), ([pole], [1, 0])):
        with pytest.raises(ValueError, match=r"^(poles|edges) must be"):
            errors.by_poles(np.reshape(poles, (-1, 3)), bins)


def test_the_residual_field(cloud, rng):
    positions, angles = cloud
    azimuth = np.arctan2(positions[:, 1], positions[:, 0])
    away = np.column_stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth])
    about = np.column_stack([-np.sin(azimuth), np.cos(azimuth), 0 * azimuth])
    shift = 0.3 * away - 0.1 * about + 0.05 * positions[:, 2:] * [0, 0, 1] + 0.02 * rng.normal(size=positions.shape)
    errors = errors_of(positions, angles, positions * [1, 1, -1] - shift, fit=())
    found = errors.residual_field(5.0, 4)
    assert found.ions.shape == (8, 4) and found.ions.sum() == 4000
    scatter = 4 * 0.02 / np.sqrt(found.ions)  # of a mean, four times
    assert (np.abs(found.radial - 0.3) < scatter).all() and (np.abs(found.azimuthal + 0.1) < scatter).all()
    middle = (found.depth_edges[:-1] + found.depth_edges[1:]) / 2
    slope = 0.05 * np.diff(found.depth_edges)[0] / np.sqrt(12)
    assert (np.abs(found.depth - 0.05 * middle) < scatter + 4 * slope / np.sqrt(found.ions)).all()
    assert found.lateral_scatter == pytest.approx(np.full((8, 4), 0.02 * np.sqrt(2)), rel=0.35)  # 4 / sqrt(2 n), n > 80
    assert found.depth_scatter == pytest.approx(np.full((8, 4), np.hypot(0.02, slope)), rel=0.35)


def test_groups_of_ions(cloud):
    positions, angles = cloud
    groups = np.where(positions[:, 0] > 0, 7, -2)
    truth = sites_of(positions) - np.where(groups == 7, 0.5, 0.0)[:, None] * [1, 0, 2]
    errors = errors_of(positions, angles, truth, (), groups)
    found = errors.by_group
    assert found.groups.tolist() == [-2, 7] and found.ions.sum() == 4000
    assert found.shift == pytest.approx(np.array([[0, 0, 0], [0.5, 0, 1.0]]), abs=1e-12)
    assert found.lateral == pytest.approx([0, 0.5]) and found.depth == pytest.approx([0, 1.0])
    assert errors.to_dict()["by_group"]["groups"] == [-2, 7]


def test_groups_are_given_for_the_hits_or_the_run(few20, nickel):
    hits = few20.hits(ae.Unperturbed())
    known = {"atomic_volume": nickel.a**3 / 4, "distance": 100.0, "detector_radius": 75.0, "radius": 7.0}
    result = ae.reconstruct(hits[:2000], **known, projection="compressed", compression=1.13)
    height = (few20.emissions.positions[:, 2] > 6.5).astype(int)
    by_run = result.errors(few20, groups=height).by_group
    by_hit = result.errors(few20, groups=height[result.hits.ion]).by_group
    assert by_run.ions.tolist() == by_hit.ions.tolist() and len(by_run.groups) == 2
    assert result.errors(few20).by_group.groups.tolist() == [0]  # the species
    assert result.errors().by_group is None
    with pytest.raises(ValueError, match="groups"):
        result.errors(few20, groups=[1, 2])


@pytest.mark.slow
def test_a_simulated_run_is_compared_with_its_sites(tip12, nickel):
    simulation = ae.Simulation(tip12, seed=3, detector=ae.Detector(distance=100.0, width=300.0))
    run = simulation.run(1200, [ae.Unperturbed()], responses=False, progress=False).at_evaporation_field()
    hits = run.hits(ae.Unperturbed())
    known = {"atomic_volume": nickel.a**3 / 4, "distance": 100.0, "detector_radius": 75.0, "compression": 1.13}
    factor = run.voltages[0] / (35.0 * 12 * nickel.a)
    known |= {"projection": "compressed", "evaporation_field": 35.0, "field_factor": factor}
    result = ae.reconstruct(hits, **known)
    errors = result.errors()
    assert len(result) > 500 and np.isfinite(result.positions).all()
    assert errors.lateral_rms == result.errors(run).lateral_rms == result.errors(result.hits.positions).lateral_rms
    # the scatter of the paths, 2 degrees of 4.2 nm, is 0.15 nm (seen: 0.17 nm); the depth is better than the spacing
    # of the (111) planes of 0.2 nm by a multiple (seen: 0.03 nm), as atoms leave in layers
    assert 0.05 < errors.lateral_rms < 0.3 and 0.005 < errors.depth_rms < 0.1
    assert abs(errors.rotation) < 2 and errors.lateral_scale == pytest.approx(1.0, abs=0.2)
    # wrong constants are worse once they are not fitted
    wrong = ae.reconstruct(hits, **known | {"compression": 2.0}).errors(run, fit=("shift", "rotation"))
    assert wrong.lateral_rms > result.errors(run, fit=("shift", "rotation")).lateral_rms
    other = ae.Hits(x=hits.x, y=hits.y, ion=hits.ion + 5000)
    with pytest.raises(ValueError, match="truth"):
        ae.reconstruct(other, atomic_volume=0.011, distance=100.0, radius=4.0, detector_radius=75.0).errors(run)


def test_measured_ions_have_no_true_sites(rng):
    hits = ae.Hits(x=rng.random(50), y=rng.random(50), positions=np.zeros((50, 3)))
    result = ae.reconstruct(hits, atomic_volume=0.011, distance=100.0, radius=4.0)
    with pytest.raises(ValueError, match="truth is needed for hits that were not simulated"):
        result.errors()
    with pytest.raises(ValueError, match="errors need at least 3 ions, got 2"):
        ae.reconstruct(hits[:2], atomic_volume=0.011, distance=100.0, radius=4.0).errors(np.zeros((2, 3)))
