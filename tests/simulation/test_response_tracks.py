from dataclasses import replace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.units import speed_from_energy

ENERGY = 0.6  # eV


@pytest.fixture(scope="session")
def run(small_tip):
    """60 ions with responses, and flown at 0.6 eV."""
    simulation = ae.Simulation(small_tip, voltage=1000.0, seed=2)
    return simulation.run(60, [ae.LateralVelocity(ENERGY), ae.RollUp(ENERGY)], progress=False)


def test_tracks_are_where_the_run_has_its_hits(run):
    ions = np.array([3, 0, 41, 59])
    rolled = ae.simulation.rollup_tracks(run, ions, [0.0, 0.25, ENERGY])
    assert rolled.x.shape == rolled.y.shape == (4, 3)
    for column, energy in enumerate((0.0, 0.25, ENERGY)):
        hits = run.hits(ae.RollUp(energy), by_response=True)[ions]
        # the same polynomials: rounding of places of 100 mm
        np.testing.assert_allclose(rolled.x[:, column], hits.x, rtol=0, atol=1e-9)
        np.testing.assert_allclose(rolled.y[:, column], hits.y, rtol=0, atol=1e-9)
    lateral = ae.simulation.lateral_tracks(run, ions, [0.0, ENERGY])
    assert lateral.x.shape == (4, 2, 72)
    still = run.hits(ae.Unperturbed())[ions]
    np.testing.assert_allclose(lateral.x[:, 0], np.repeat(still.x[:, None], 72, axis=1), rtol=0, atol=1e-9)


def test_tracks_are_where_flights_land(run):
    """Against the flights themselves, in the directions that were drawn for them."""
    good = ~run.flagged & np.isfinite(run.emissions.neighbours).all(axis=1)
    flown = {kind: run.hits(kind(ENERGY)) for kind in (ae.LateralVelocity, ae.RollUp)}
    for hits in flown.values():
        good &= hits.detected
    ions = np.flatnonzero(good)
    assert len(ions) > 30
    _, first, second, *_ = ae.LateralVelocity(ENERGY).tangential(
        run.emissions, ae.emission.IonRandom(run.seed, run.emissions.ions)
    )
    np.testing.assert_allclose(np.hypot(first, second), speed_from_energy(ENERGY, run.emissions.masses))
    azimuths = np.degrees(np.arctan2(second, first))
    lateral = [ae.simulation.lateral_tracks(run, [ion], [ENERGY], [azimuths[ion]]) for ion in ions]
    rolled = ae.simulation.rollup_tracks(run, ions, [ENERGY])
    bound = run.response_settings.bound  # above it an ion would have been marked
    for places, hits in (
        (np.array([[track.x[0, 0, 0], track.y[0, 0, 0]] for track in lateral]), flown[ae.LateralVelocity]),
        (np.column_stack([rolled.x[:, 0], rolled.y[:, 0]]), flown[ae.RollUp]),
    ):
        assert np.hypot(places[:, 0] - hits.x[ions], places[:, 1] - hits.y[ions]).max() < bound


def test_an_ion_without_a_neighbour_has_no_track(run):
    neighbours = run.emissions.neighbours.copy()
    neighbours[5] = np.nan
    alone = replace(run, emissions=replace(run.emissions, neighbours=neighbours))
    tracks = ae.simulation.rollup_tracks(alone, [4, 5], [0.0, 1.0])
    assert np.isfinite(tracks.x[0]).all() and np.isnan(tracks.x[1]).all() and np.isnan(tracks.y[1]).all()


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda run: ae.simulation.rollup_tracks(run, [60], [0.1]), r"ions must be indices from 0 to 59, got \[60\]"),
        (lambda run: ae.simulation.rollup_tracks(run, [], [0.1]), "ions must be indices"),
        (lambda run: ae.simulation.lateral_tracks(run, [0.5], [0.1]), "ions must contain integers"),
        (lambda run: ae.simulation.lateral_tracks(run, [0], [1.6]), "energies must be from 0 to 1.5 eV, the limit of"),
        (lambda run: ae.simulation.rollup_tracks(run, [0], [-0.1]), "energies must be from 0 to 1.5 eV"),
        (lambda run: ae.simulation.lateral_tracks(run, [0], [0.1], [[0.0]]), r"azimuths must have shape \(k,\)"),
    ],
)
def test_bad_arguments_are_named(run, call, message):
    with pytest.raises(ValueError, match=message):
        call(run)


def test_a_run_without_responses_has_no_tracks(run):
    with pytest.raises(ValueError, match="run must have responses"):
        ae.simulation.rollup_tracks(replace(run, responses=None), [0], [0.1])
