"""Errors against the true sites: imposed constants are found, and a simulated run is compared with its sites."""

import json

import numpy as np
import pytest

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
    with pytest.raises(ValueError, match="fit must be one of shift, rotation"):
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
    with pytest.raises(ValueError, match="truth must be the run of these hits"):
        ae.reconstruct(other, atomic_volume=0.011, distance=100.0, radius=4.0, detector_radius=75.0).errors(run)


def test_measured_ions_have_no_true_sites(rng):
    hits = ae.Hits(x=rng.random(50), y=rng.random(50), positions=np.zeros((50, 3)))
    result = ae.reconstruct(hits, atomic_volume=0.011, distance=100.0, radius=4.0)
    with pytest.raises(ValueError, match="truth is needed for hits that were not simulated"):
        result.errors()
    with pytest.raises(ValueError, match="errors need at least 3 ions, got 2"):
        ae.reconstruct(hits[:2], atomic_volume=0.011, distance=100.0, radius=4.0).errors(np.zeros((2, 3)))
