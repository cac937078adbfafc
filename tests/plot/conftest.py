"""A small study, made once for all tests of reports."""

import sys

import pytest
from fits import fit_energies
from rough import ROUGH

import apt_evap as ae


@pytest.fixture(scope="session")
def study(small_tip, made_once):
    """Study of 1,800 ions with a map of the same run as the measured one; two roll-up fractions."""
    run = made_once(small_tip, 2000, seed=1, **ROUGH)[:1800]
    measured = run.hits(ae.RollUp(0.2)).within_circle(60.0).map(bins=24, extent=(-60, 60, -60, 60))
    energies = {"means": (0.1, 0.2, 0.3), "relative_spreads": (0.5, 1.0), "rollup_fractions": (0.5, 1.0)}
    here = ae.Registration(0.0, 1.0, (0.0, 0.0))
    return fit_energies(
        run,
        measured,
        "combined",
        registration=here,
        objective="similarity",
        replicas=1,
        resamples=5,
        progress=False,
        **energies,
    )


@pytest.fixture(autouse=True)
def _figures_closed():
    """Figures of pyplot live until they are closed."""
    yield
    if (pyplot := sys.modules.get("matplotlib.pyplot")) is not None:
        pyplot.close("all")
