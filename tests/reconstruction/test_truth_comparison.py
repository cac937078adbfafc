"""A measure of all sites, of detected ions and of reconstructions, and the correction that follows."""

import json
import math

import numpy as np
import pytest

import apt_evap as ae
from apt_evap._common.types import Estimated
from apt_evap.reconstruction.truth_comparison import TruthComparison


@pytest.fixture(scope="session")
def run():
    tip = ae.Tip("Ni", apex_radius=2.5, axis=(1, 1, 1), solutes={"Al": 0.1}, seed=1)
    return ae.Simulation(tip, seed=1).run(300, [ae.Unperturbed()], responses=False, progress=False)


def measure(cloud):
    return {"Al": cloud.fractions()["Al"], "width": np.ptp(cloud.positions[:, 0]), "z": cloud.positions[:, 2].mean()}


def test_detection_and_trajectories_are_two_losses(run):
    instrument = ae.Instrument(distance=100.0, field_of_view=120.0, efficiency=0.5)
    compared = ae.reconstruction.compare_with_truth(run, measure, instrument, seed=3)
    hits = run.in_real_units().record(instrument, ae.Unperturbed(), seed=3)
    ions = compared.ions
    assert (
        ions["detected"] == ions["cap"] == len(hits) < 0.8 * ions["all sites"]
    )  # the hull of half the ions is smaller
    hull = ae.measures.ConvexHull(hits.positions)
    assert ions["all sites"] == (hull.distance(run.emissions.positions) <= 1e-7).sum() < len(run)
    al = compared.values["Al"]
    assert al["detected"] == al["cap"]  # the same ions
    assert al["detected"].value == pytest.approx(np.mean(hits.extra["element"] == "Al"))
    assert compared.loss_to_trajectories("Al") == 0.0 != compared.loss_to_detection("Al")
    z = compared.values["z"]
    # the shift is fitted: the mean height is that of the sites
    assert z["cap"].value == pytest.approx(z["detected"].value, abs=1e-9) and math.isnan(z["cap"].error)
    assert compared.loss_to_trajectories("width") != 0.0
    assert compared.table().splitlines()[0].split() == ["all", "sites", "detected", "cap"]
    kept = json.loads(json.dumps(compared.to_dict()))
    assert kept["values"]["z"]["cap"]["error"] is None
    again = ae.reconstruction.TruthComparison.from_dict(kept)
    assert again.table() == compared.table() and again.to_dict() == kept
    for wrong in (kept["values"], [], kept | {"values": {"z": {"cap": {"value": 1.0}}}}):
        with pytest.raises(ValueError, match="content must be the result of to_dict, got"):
            ae.reconstruction.TruthComparison.from_dict(wrong)
    assert len(ae.plot.truth_comparison(compared, title="three ways")) == 3


def test_a_region_and_several_reconstructions(run):
    half = ae.specimen.HalfSpace((0, 0, 0), (1, 0, 0))
    protocols = {"cap": {}, "bas": {"protocol": "bas"}}
    compared = ae.reconstruction.compare_with_truth(run, measure, reconstructions=protocols, region=half)
    assert compared.reconstructions == ("cap", "bas")
    assert compared.ions["all sites"] == (run.emissions.positions[:, 0] >= -1e-7).sum()
    assert compared.values["z"]["cap"] != compared.values["z"]["bas"]


def synthetic(seen, true):
    clouds = {"all sites": 1, "detected": 1, "cap": 1}
    values = {"all sites": Estimated(true, math.nan), "detected": Estimated(0, 0), "cap": Estimated(seen, 0.1)}
    return TruthComparison(clouds, {"size": values})


def test_the_error_of_a_correction_covers_the_truth():
    """Corrections by 8 simulations of a line with scatter: intervals of 68 % contain 68 % of the true values."""
    covered, tried = 0, 0
    for seed in range(800):
        rng = np.random.default_rng(seed)
        seen = 1 + 2 * rng.random(9)
        true = 0.3 + 1.6 * seen + 0.05 * rng.normal(size=9)
        if not seen[:8].min() <= seen[8] <= seen[:8].max():
            continue  # beyond what the simulations show
        tried += 1
        comparisons = [synthetic(*pair) for pair in zip(seen[:8], true[:8], strict=True)]
        value, error = ae.reconstruction.corrected(comparisons, "size", seen[8])
        covered += abs(value - true[8]) <= error
    assert tried > 500
    assert covered / tried == pytest.approx(0.683, abs=0.06)  # three standard deviations of 600


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda r: ae.reconstruction.compare_with_truth(r, 5), "measure must be a function of a point cloud, got 5"),
        (lambda r: ae.reconstruction.compare_with_truth(r, lambda c: 3), "result of measure must be a mapping"),
        (lambda r: ae.reconstruction.compare_with_truth(r, measure, reconstructions={"detected": {}}), "names other"),
        (lambda r: ae.reconstruction.compare_with_truth(r, measure, reconstructions={}), "names other than"),
        (lambda r: ae.reconstruction.compare_with_truth(5, measure), "run must be a Run, got 5"),
        (lambda r: ae.reconstruction.corrected([synthetic(1, 1)] * 3, "size", 1.0), "at least 4, got 3"),
        (lambda r: ae.reconstruction.corrected([synthetic(1, 1)] * 5, "size", 1.0), "different values of size, got 1"),
        (lambda r: ae.reconstruction.corrected([synthetic(k, k) for k in range(5)], "size", 9.0), "value must be"),
        (lambda r: ae.reconstruction.corrected([synthetic(k, k) for k in range(5)], "wide", 1.0), "measure must"),
    ],
)
def test_wrong_arguments_are_named(run, call, message):
    with pytest.raises(ValueError, match=message):
        call(run)
