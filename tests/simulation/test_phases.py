"""Runs of specimens with several phases."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

import apt_evap as ae
from apt_evap.simulation.description import describe

AL = ae.material("Al")
SHAPE = {"apex_radius": 3.5, "shank_length": 3.5, "axis": (1, 1, 1)}


def run_of(tip, n=250, **options):
    return ae.Simulation(tip, n_threads=1).run(n, responses=False, progress=False, **options)


@pytest.fixture(scope="session")
def mixed():
    """A tip of three phases on two lattices, with a void."""
    phases = [
        ae.specimen.Phase("matrix", AL, solutes={"Cu": 0.05}),
        ae.specimen.Phase("tungsten", "W", ae.specimen.Sphere((0, 0, 3), 1.5), axis=(0, 1, 1), evaporation_field=21.0),
        ae.specimen.Phase(
            "soft", AL, ae.specimen.HalfSpace((0, 1, 0), (0, 1, 0)), evaporation_field=17.0, vacancies=0.02
        ),
    ]
    return ae.Tip(phases=phases, seed=3, depth=1.6, **SHAPE)


def test_equal_phases_have_the_bits_of_one_phase():
    one = ae.Tip(AL, solutes={"Cu": 0.1}, seed=1, depth=1.5, **SHAPE)
    alloy = {"material": AL, "solutes": {"Cu": 0.1}}
    two = ae.Tip(
        phases=[
            ae.specimen.Phase("matrix", **alloy),
            ae.specimen.Phase("ball", region=ae.specimen.Sphere((0.5, 0, 3), 1.5), **alloy),
        ],
        seed=1,
        depth=1.5,
        **SHAPE,
    )
    runs = [ae.Simulation(tip, n_threads=1).run(200, progress=False) for tip in (one, two)]
    assert runs[0].fingerprint() == runs[1].fingerprint()
    assert runs[0].phase_names == ("matrix",) and not runs[0].phase.any()
    assert 0 < runs[1].phase.sum() < 200
    np.testing.assert_array_equal(runs[1].phase, two.phase[runs[1].site])


def test_a_run_knows_the_phase_of_every_ion_through_a_file(mixed, tmp_path):
    run = run_of(mixed)
    run.save(tmp_path / "run.h5")
    loaded = ae.load(tmp_path / "run.h5")
    assert loaded.fingerprint() == run.fingerprint() and loaded.settings["tip"] == run.settings["tip"]
    assert loaded.phase_names == ("matrix", "tungsten", "soft")
    np.testing.assert_array_equal(loaded.phase, run.phase)
    assert set(loaded.phase.tolist()) == {0, 1, 2}
    fields = {(0, "Al"): 19.0, (0, "Cu"): 30.0, (1, "W"): 21.0, (2, "Al"): 17.0}
    for phase, species, field in zip(loaded.phase, loaded.species, loaded.evaporation_fields, strict=True):
        assert fields[phase, loaded.elements[species]] == field
    described = describe(loaded)
    assert sum(described["phases"].values()) == sum(described["species"].values()) == len(run)
    assert described["species"]["Al"] == sum(run.elements[species] == "Al" for species in run.species)
    tip = ae.Tip.from_settings(loaded.settings["tip"])
    np.testing.assert_array_equal(tip.phase[loaded.site[loaded.site < len(tip)]], loaded.phase[loaded.site < len(tip)])
    assert ae.Orientation.from_settings(loaded.settings["tip"]).material == AL


@pytest.mark.slow
def test_a_resumed_run_has_the_same_bits(mixed, tmp_path):
    whole = run_of(mixed, 700)
    checkpoint = ae.simulation.Checkpoint(tmp_path / "run.h5", resume=True)
    for ions in (201, 480, 700):
        run = run_of(mixed, ions, checkpoint=checkpoint)
    assert run.fingerprint() == whole.fingerprint()
    np.testing.assert_array_equal(run.phase, whole.phase)
    np.testing.assert_array_equal(run.emissions.rollup_distances, whole.emissions.rollup_distances)


def test_an_ion_rolls_up_by_the_mean_distance_of_both_phases(mixed, tmp_path):
    run = run_of(mixed)
    distances = np.array([criterion.nearest_neighbour_distance for criterion in mixed.criteria])
    rolling = run.emissions.can_roll
    neighbour = run.emissions.neighbours[rolling]
    of_neighbour = mixed.phase[cKDTree(mixed.positions).query(neighbour)[1]]
    expected = 0.5 * (distances[run.phase[rolling]] + distances[of_neighbour])
    np.testing.assert_array_equal(run.emissions.rollup_distances[rolling], expected)
    assert len(set(expected.tolist())) == 3
    launches = ae.RollUp(0.1).launch(run.emissions, ae.emission.IonRandom(1, run.emissions.ions))
    height = np.linalg.norm(launches.positions[rolling] - neighbour, axis=1)
    np.testing.assert_allclose(height, expected, rtol=1e-12)
    run.save(tmp_path / "run.h5")
    np.testing.assert_array_equal(
        ae.load(tmp_path / "run.h5").emissions.rollup_distances, run.emissions.rollup_distances
    )
    assert run.emissions[3:9].rollup_distances.tolist() == run.emissions.rollup_distances[3:9].tolist()


def test_an_instrument_keeps_the_phase_as_truth(mixed):
    hits = run_of(mixed).at_evaporation_field(smoothing=50).record(ae.Instrument(efficiency=0.5))
    assert set(hits.extra["phase"].tolist()) <= {0, 1, 2} and len(hits.extra["phase"]) == len(hits)


@pytest.mark.slow
def test_atoms_with_a_higher_evaporation_field_leave_later():
    """Retention: among atoms of equal height, those of the phase with the high field have the later numbers."""
    hard = ae.specimen.Phase("hard", AL, ae.specimen.HalfSpace((0, 0, 0), (1, 0, 0)), evaporation_field=21.0)
    tip = ae.Tip(phases=[ae.specimen.Phase("matrix", AL), hard], **SHAPE)
    run = run_of(tip, 1500)
    apex = run.emissions.positions[:, 2] > 2.5
    assert np.median(run.emissions.ions[apex & (run.phase == 1)]) > np.median(
        run.emissions.ions[apex & (run.phase == 0)]
    )
