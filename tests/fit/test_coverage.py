"""Coverage of the intervals: hidden energies of other specimens lie inside; intervals by noise alone miss them."""

import importlib.util
from pathlib import Path

import pytest

from apt_evap.fit.fit_settings import MODEL_ERROR

TWINS = range(100, 106)


@pytest.mark.slow
def test_hidden_energies_lie_inside_the_intervals(kept_runs):
    path = Path(__file__).parents[2] / "articles" / "intervals" / "coverage.py"
    spec = importlib.util.spec_from_file_location("coverage_of_intervals", path)
    coverage = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(coverage)
    folder = kept_runs / path.stem
    folder.mkdir(exist_ok=True)
    run, *twins = (coverage.run_of(number, 14.0, 10_000, folder) for number in (0, *TWINS))
    inside = {MODEL_ERROR: 0, 0.0: 0}
    for number, twin in zip(TWINS, twins, strict=True):
        energy = coverage.hidden_energy(number)
        study = coverage.fitted(run, coverage.measured_map(twin, energy))
        for error in inside:
            inside[error] += sum(coverage.inside(coverage.bounds_of(study, error), coverage.truth_of(energy)).values())
    # 24 intervals; of 96 % coverage, two or less are missed in 93 %, and the numbers of a twin are not independent
    assert inside[MODEL_ERROR] >= 21
    assert inside[0.0] <= 14  # of 23 twins, less than half without the error of the model
