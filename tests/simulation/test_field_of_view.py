"""Flights of a field of view: no ion that arrives in it is lost, and nothing else changes."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.detection import Outcome
from apt_evap.simulation.config.simulation_file import read_config
from apt_evap.simulation.flight.field_of_view import scouts_of, stereographic_rim
from apt_evap.warnings import ResponseWarning, RunWarning

DETECTOR = ae.Detector(distance=100.0, width=400.0)
EMISSIONS = (
    ae.Unperturbed(),
    ae.LateralVelocity(1.5),
    ae.RollUp(1.5),
    ae.RollUp(ae.TruncatedNormal(0.3, 0.1)),
    ae.Combined(1.5, 0.5),
    ae.LateralVelocity(1.5, height=0.2),
    ae.RollUp(1.5, sharpness=1.0, height=0.2),
    ae.Combined(1.5, 0.5, probability=0.5, sharpness=0.1),
)


@pytest.fixture(scope="session")
def tips(nickel):
    """Small tips, where ions deviate most; in the alloy, atoms of tungsten stand out."""
    radius = 8 * nickel.a
    return {
        "nickel": ae.Tip(nickel, apex_radius=radius, axis=(1, 1, 1), offset_seed=3),
        "alloy": ae.Tip(nickel, apex_radius=radius, axis=(0, 1, 2), solutes={"W": 0.15}, seed=1),
    }


def simulate(tip, n=400, field_of_view=None, detector=DETECTOR, **options):
    flights = ae.simulation.FlightSettings(field_of_view=field_of_view)
    return ae.Simulation(tip, seed=1, detector=detector, flight_settings=flights, **options).run(n, progress=False)


@pytest.fixture(scope="session")
def every_ion(tips):
    """All ions of the alloy."""
    return simulate(tips["alloy"])


@pytest.fixture(scope="session")
def part_of_view(tips):
    """The same ions in a field of view of 20 degrees."""
    return simulate(tips["alloy"], field_of_view=20.0)


def polar_angles(hits):
    return np.degrees(np.arctan(np.hypot(hits.x, hits.y) / DETECTOR.distance))


# ---- ions that can arrive --------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::apt_evap.warnings.ResponseWarning")
@pytest.mark.parametrize("name", ["nickel", "alloy"])
def test_no_ion_that_arrives_is_lost(tips, name):
    every = simulate(tips[name])
    angle = 20.0
    part = simulate(tips[name], field_of_view=angle)
    flown = ~part.not_flown
    assert 0.2 < part.not_flown.mean() < 0.9
    for array in ("site", "rolled", "residuals"):
        np.testing.assert_array_equal(getattr(part.responses, array)[flown], getattr(every.responses, array)[flown])
        assert np.isnan(getattr(part.responses, array)[~flown]).all()
    for perturbation in EMISSIONS:
        expected, hits = every.hits(perturbation), part.hits(perturbation)
        inside = polar_angles(expected) <= angle
        # 400 mm at 100 mm contain the whole field of view
        np.testing.assert_array_equal(hits.outcome == Outcome.HIT, inside)
        np.testing.assert_array_equal(hits.outcome == Outcome.OUTSIDE, ~inside)
        for column in ("x", "y", "time_of_flight"):
            np.testing.assert_array_equal(getattr(hits, column)[inside], getattr(expected, column)[inside])
            assert np.isnan(getattr(hits, column)[~inside]).all()


def test_scouts_are_among_the_launches_of_the_responses(every_ion):
    settings, emissions = every_ion.response_settings, every_ion.emissions
    scouts = scouts_of(emissions, settings)
    assert scouts.positions.shape == scouts.velocities.shape == (len(emissions), 8, 3)
    assert scouts.families.tolist() == [3, 5]
    speeds = np.linalg.norm(scouts.velocities, axis=2)
    fastest = np.sqrt(2 * settings.energy_limit / emissions.charge_states)
    np.testing.assert_allclose(speeds[:, [1, 2, 4, 5]], fastest[:, None] * np.ones(4), rtol=1e-12)
    assert (speeds[:, [0, 3, 6, 7]] == 0).all()
    assert np.abs((scouts.velocities * emissions.normals[:, None]).sum(axis=2)).max() < 1e-12


@pytest.mark.slow
def test_the_prediction_is_needed(tips, every_ion, monkeypatch):
    """Without it, with the flight at rest from the site alone and no margin, ions are lost."""

    def at_rest(emissions, settings):
        scouts = scouts_of(emissions, settings)
        return scouts._replace(
            positions=scouts.positions[:, [0, 0, 0]],
            velocities=0 * scouts.velocities[:, :3],
            families=np.array([3]),
        )

    monkeypatch.setattr("apt_evap.simulation.simulation.scouts_of", at_rest)
    monkeypatch.setattr("apt_evap.simulation.flight.flight_pool.LEAST_MARGIN", 0.0)
    part = simulate(tips["alloy"], field_of_view=20.0)
    inside = polar_angles(every_ion.hits(ae.RollUp(1.5))) <= 20.0
    assert np.count_nonzero(inside & part.not_flown) > 10


@pytest.mark.slow
@pytest.mark.parametrize("energy_limit", [0.3, 4.0])
def test_the_margin_follows_the_energy_limit(tips, energy_limit):
    settings = ae.ResponseSettings(energy_limit=energy_limit)
    every = simulate(tips["nickel"], response_settings=settings)
    part = simulate(tips["nickel"], field_of_view=15.0, response_settings=settings)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResponseWarning)  # 1.0001 of the limit
        for perturbation in (ae.LateralVelocity(energy_limit), ae.RollUp(energy_limit), ae.Combined(energy_limit, 0.5)):
            inside = polar_angles(every.hits(perturbation)) <= 15.0
            np.testing.assert_array_equal(part.hits(perturbation).detected, inside)


@pytest.mark.slow
def test_a_smaller_energy_limit_flies_fewer_ions(tips):
    low, high = (
        simulate(tips["nickel"], 200, 20.0, response_settings=ae.ResponseSettings(energy_limit=limit))
        for limit in (0.3, 3.0)
    )
    assert low.not_flown.sum() > high.not_flown.sum() + 10


# ---- the run ---------------------------------------------------------------------------------------------------------


def test_bits_do_not_depend_on_threads_batches_and_interruptions(tips, tmp_path):
    settings = {"flight_settings": ae.simulation.FlightSettings(field_of_view=20.0), "detector": DETECTOR, "seed": 1}
    one = ae.Simulation(tips["alloy"], n_threads=1, **settings).run(60, progress=False)
    two = ae.Simulation(tips["alloy"], n_threads=2, **settings).run(60, progress=False, batch_size=17)
    path = tmp_path / "run.h5"
    ae.Simulation(tips["alloy"], **settings).run(25, progress=False, checkpoint=path)
    resumed = ae.Simulation(tips["alloy"], **settings).run(
        60, progress=False, checkpoint=ae.simulation.Checkpoint(path, resume=True)
    )
    assert 0 < one.not_flown.sum() < 60
    for run in (two, resumed, ae.load(path)):
        assert run.fingerprint() == one.fingerprint()
        np.testing.assert_array_equal(run.not_flown, one.not_flown)
        assert run.field_of_view == 20.0
    with pytest.raises(ae.FileError, match="flights"):
        settings["flight_settings"] = ae.simulation.FlightSettings(field_of_view=25.0)
        ae.Simulation(tips["alloy"], **settings).run(80, checkpoint=ae.simulation.Checkpoint(path, resume=True))


def test_ions_are_counted(part_of_view):
    summary = part_of_view.summary()
    hits = part_of_view.hits(ae.Unperturbed())
    assert summary["outside"] == hits.counts[Outcome.OUTSIDE] == len(part_of_view) - summary["hit"]
    assert summary["not_flown"] == part_of_view.not_flown.sum() < summary["outside"]
    assert not part_of_view.flagged[part_of_view.not_flown].any()
    assert part_of_view[:50].not_flown.sum() == part_of_view.not_flown[:50].sum()
    assert len(hits[hits.detected]) == summary["hit"] == hits.map(bins=20).ions
    assert f"{summary['not_flown']} ions not flown" in repr(part_of_view)


@pytest.mark.slow
def test_perturbations_with_their_own_flights_are_flown_for_all_ions(tips):
    perturbations = (ae.Unperturbed(), ae.RollUp(0.5))
    run = ae.Simulation(
        tips["nickel"], seed=1, detector=DETECTOR, flight_settings=ae.simulation.FlightSettings(field_of_view=15.0)
    ).run(100, perturbations, progress=False)
    assert run.not_flown.any()
    for flown, perturbation in zip(run.flown, perturbations, strict=True):
        assert np.isfinite(flown.directions).all()
        outside = np.hypot(*flown.directions.T) > stereographic_rim(15.0)
        np.testing.assert_array_equal(run.hits(perturbation).outcome == Outcome.OUTSIDE, outside)
    alone = ae.Simulation(
        tips["nickel"], seed=1, detector=DETECTOR, flight_settings=ae.simulation.FlightSettings(field_of_view=15.0)
    ).run(100, perturbations, responses=False, progress=False)
    np.testing.assert_array_equal(alone.flown[1].directions, run.flown[1].directions)


def test_ions_that_never_leave_are_not_outside(tips):
    flights = ae.simulation.FlightSettings(field_of_view=15.0, max_steps=3)
    run = ae.Simulation(tips["nickel"], flight_settings=flights, detector=DETECTOR).run(20, progress=False)
    assert run.summary()["never_left"] == 20 and not run.not_flown.any()


def test_real_units_keep_the_field_of_view(every_ion, part_of_view):
    expected, found = (run.at_evaporation_field() for run in (every_ion, part_of_view))
    np.testing.assert_array_equal(found.voltages, expected.voltages)
    perturbation = ae.RollUp(0.1)
    expected, hits = (run.hits(perturbation) for run in (expected, found))
    inside = polar_angles(expected) <= 20.0
    np.testing.assert_array_equal(hits.detected, inside)
    np.testing.assert_array_equal(hits.mass_to_charge, expected.mass_to_charge)


# ---- detectors -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("projection", ["plane", "equidistant"])
def test_the_detector_is_a_field_of_view(tips, projection):
    detector = ae.Detector(distance=100.0, width=60.0, projection=projection)
    every = simulate(tips["nickel"], detector=detector)
    part = simulate(tips["nickel"], field_of_view="detector", detector=detector)
    assert part.field_of_view == detector.half_angle
    assert part.not_flown.any()
    for perturbation in EMISSIONS[:4]:
        expected, hits = every.hits(perturbation), part.hits(perturbation)
        np.testing.assert_array_equal(hits.detected, expected.detected)
        np.testing.assert_array_equal(hits.x[hits.detected], expected.x[hits.detected])
        assert hits.extent == detector.extent
        np.testing.assert_array_equal(hits.map(bins=16).values, expected.map(bins=16).values)


def test_polar_angles_of_a_detector():
    plane, equidistant = (ae.Detector(100.0, 80.0, projection) for projection in ("plane", "equidistant"))
    assert plane.polar_angle(100.0) == pytest.approx(45.0, rel=1e-15)
    assert plane.half_angle == pytest.approx(np.degrees(np.arctan(0.4 * np.sqrt(2))), rel=2e-9)
    assert equidistant.polar_angle(50.0) == pytest.approx(np.degrees(0.5), rel=1e-15)
    assert ae.Detector(10.0, 1000.0, "equidistant").half_angle == 90.0
    assert stereographic_rim(90.0) == pytest.approx(1.0, rel=1e-15)


def test_a_detector_that_sees_more_is_warned_about(part_of_view):
    with pytest.warns(RunWarning, match="field of view"):
        seen = part_of_view.on_detector(ae.Detector(distance=50.0, width=80.0))
    assert seen.hits(ae.Unperturbed()).extent is None  # an outline follows from the ions, as of measured ones
    grid = part_of_view.grid(40)
    x = (grid.x_edges[1:] + grid.x_edges[:-1]) / 2
    np.testing.assert_array_equal(grid.mask, np.hypot(*np.meshgrid(x, x)) <= 100.0 * np.tan(np.radians(20.0)))
    assert part_of_view.hits(ae.RollUp(1.5)).map(like=grid).ions > 30
    real = part_of_view.at_evaporation_field()
    with pytest.warns(RunWarning, match="field of view"):
        real.record(ae.Instrument(distance=100.0, field_of_view=80.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error", RunWarning)
        seen = part_of_view.on_detector(ae.Detector(distance=100.0, width=50.0))
        assert seen.hits(ae.Unperturbed()).extent == (-25.0, 25.0, -25.0, 25.0)
        recorded = real.record(ae.Instrument(distance=100.0, field_of_view=70.0), ae.RollUp(0.1))
    assert len(recorded) and np.isfinite(recorded.x).all()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::apt_evap.warnings.ResponseWarning")  # a few energies are above the limit
def test_a_detector_behind_a_lens(tips):
    lens = ae.detection.LocalElectrode.preset("local electrode")
    detector = ae.Detector(distance=90.0, width=40.0)
    angle = ae.detection.field_of_view(lens, tips["nickel"], detector)
    assert detector.half_angle + 5.0 < angle < 45.0
    every, part = (simulate(tips["nickel"], 150, limit, detector) for limit in (None, angle))
    assert part.not_flown.any()
    first_cap = type(every.cap)(*(column[:1] for column in every.cap))  # a lens for each stage takes seconds
    every = replace(every, cap=first_cap).on_detector(detector, lens)
    part = replace(part, settings=part.settings | {"microscope": every.settings["microscope"]})  # the same cap
    for perturbation in EMISSIONS:
        expected, hits = every.hits(perturbation), part.hits(perturbation)
        np.testing.assert_array_equal(hits.detected, expected.detected)
        np.testing.assert_array_equal(hits.x[hits.detected], expected.x[hits.detected])
        assert hits.extent == detector.extent
    turned_back = replace(lens, detector_potential=1000.0)
    with pytest.raises(ValueError, match="detector_potential"):
        ae.detection.field_of_view(turned_back, tips["nickel"], detector)


# ---- settings --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [0.0, -5.0, 91.0, "all", True])
def test_bad_fields_of_view_are_refused(value):
    with pytest.raises(ValueError, match="field_of_view"):
        ae.simulation.FlightSettings(field_of_view=value)


@pytest.mark.slow
@pytest.mark.parametrize("lens", ["", '[microscope]\npreset = "local electrode"\n'])
def test_a_settings_file_has_a_field_of_view(tmp_path, lens):
    path = tmp_path / "view.toml"
    path.write_text(
        '[tip]\nmaterial = "Ni"\napex_radius = 2.0\naxis = [1, 1, 1]\n[simulation]\nions = 40\n'
        f'[detector]\ndistance = 90.0\nwidth = 40.0\n[flights]\nfield_of_view = "detector"\n{lens}'
    )
    config = read_config(path)
    assert config.flight_settings.field_of_view == "detector"
    simulation = config.simulation(n_threads=1)
    found = simulation.flight_settings.field_of_view
    assert found == pytest.approx(config.detector.half_angle) if not lens else found > config.detector.half_angle + 5
    assert simulation.settings["flights"]["field_of_view"] == found
