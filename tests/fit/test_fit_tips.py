"""Which of several specimens, and which energies, a measured map belongs to."""

import numpy as np
import pytest
from fits import fit_energies, fit_tips
from rough import ROUGH

import apt_evap as ae

ROLLUP = ae.RollUp(ae.TruncatedNormal(0.155, 0.155))
HERE = ae.Registration(0.0, 1.0, (0.0, 0.0))
GRID = {"means": (0.05, 0.155, 0.3), "relative_spreads": (0.316, 1.0), "progress": False, "n_threads": 1, "replicas": 4}


@pytest.fixture(scope="session")
def run_of(nickel, made_once):
    """Function of an axis, the origin of the lattice and a number of ions: their run."""

    def make(axis, offset, ions=1500):
        tip = ae.Tip(nickel, apex_radius=8 * nickel.a, axis=axis, shank_length=8 * nickel.a, offset_seed=offset)
        return made_once(tip, ions, seed=offset, **ROUGH)

    return make


@pytest.fixture(scope="session")
def runs(run_of):
    """1,500 ions of three tips: two along [111], of different origins of the lattice, and one along [001]."""
    tips = {"right": ((1, 1, 1), 1), "axis": ((0, 0, 1), 1), "measured": ((1, 1, 1), 2)}
    return {name: run_of(*tip) for name, tip in tips.items()}


@pytest.fixture(scope="session")
def few(run_of):
    """700 ions of them."""
    tips = {"right": ((1, 1, 1), 1), "axis": ((0, 0, 1), 1), "measured": ((1, 1, 1), 2)}
    return {name: run_of(*tip, 700) for name, tip in tips.items()}


@pytest.fixture(scope="session")
def fit(runs):
    measured = runs["measured"].hits(ROLLUP)
    candidates = {name: runs[name] for name in ("axis", "right")}
    return fit_tips(candidates, measured, registration=HERE, bins=32, resamples=20, **GRID)


@pytest.mark.slow
def test_the_tip_and_its_energies_are_found(fit):
    assert fit.best == "right" and fit.order == ["right", "axis"]
    assert fit.studies["right"].optimum.mean == 0.155
    right, wrong = (fit.studies[name].refined.score for name in fit.order)
    assert right.value - wrong.value > 3 * np.hypot(right.error, wrong.error)
    assert fit.shares == {"axis": 0.0, "right": 1.0}


def test_all_runs_are_compared_in_the_same_region_with_the_same_settings(few):
    candidates = {name: few[name] for name in ("axis", "right")}
    fit = fit_tips(candidates, few["measured"].hits(ROLLUP), registration=HERE, bins=32, resamples=2, **GRID)
    first, second = fit.studies.values()
    assert (first.measured.mask == second.measured.mask).all() and first.measured.mask.any()
    assert first.settings == second.settings
    assert sum(fit.shares.values()) == pytest.approx(1)


@pytest.mark.slow
def test_options_of_the_perturbation_are_axes_of_every_study(runs):
    candidates = {name: runs[name] for name in ("axis", "right")}
    fit = fit_tips(
        candidates,
        runs["measured"].hits(ROLLUP),
        registration=HERE,
        bins=32,
        resamples=20,
        options={"probability": (0.5, 1.0)},
        **GRID,
    )
    assert fit.best == "right" and fit.shares["right"] == 1.0
    assert fit.studies["right"].optimum.options == {"probability": 1.0}


@pytest.mark.slow
def test_the_table_has_a_row_for_each_run_that_json_takes(fit):
    rows = fit.rows()
    assert [row["run"] for row in rows] == fit.order
    best = fit.studies["right"]
    assert rows[0]["similarity"] == best.refined.score.value and rows[0]["mean"] == best.refined.true_mean
    assert rows[0]["real_mean"] == best.real_energies[0] and rows[0]["doubtful"] is False
    assert rows[0]["mean_low"] <= rows[0]["mean"] <= rows[0]["mean_high"]
    assert repr(fit).startswith("<TipFit: 2 runs, 0 failed; best 'right'")


def test_a_single_tip_is_the_study_of_its_own_region(few, tmp_path):
    measured = few["measured"].hits(ROLLUP).map(32)
    path = tmp_path / "right.h5"
    few["right"].save(path)
    fit = fit_tips({"right": path}, measured, registration=HERE, resamples=0, **GRID)
    alone = fit_energies(few["right"], measured, registration=HERE, resamples=0, **GRID)
    region = fit.studies["right"].measured.mask
    assert not (region & ~alone.measured.mask).any()
    assert np.isnan(fit.shares["right"]) and fit.rows()[0]["share"] is None
    assert fit.order == [fit.best] == ["right"] and repr(fit).startswith("<TipFit: 1 runs, 0 failed; best 'right'")


def test_a_run_without_responses_is_reported(few, nickel):
    tip = ae.Tip(nickel, apex_radius=6 * nickel.a, shank_length=6 * nickel.a)
    without = ae.Simulation(tip).run(20, responses=False, progress=False)
    measured = few["measured"].hits(ROLLUP).map(32)
    options = {"registration": HERE, "resamples": 0, **GRID}
    fit = fit_tips({"without": without, "right": few["right"]}, measured, **options)
    assert list(fit.studies) == ["right"] and "must have responses" in fit.failed["without"]
    with pytest.raises(ValueError, match="none of 1 runs can be compared; without: run must have responses"):
        fit_tips({"without": without}, measured, **options)
    with pytest.raises(ValueError, match="runs must contain at least one run, got none"):
        fit_tips({}, measured)
    with pytest.raises(ValueError, match="runs must be a mapping of runs by name"):
        fit_tips([without], measured)
