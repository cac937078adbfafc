import pickle
import weakref
from dataclasses import dataclass, replace

import h5py
import numpy as np
import pytest

import apt_evap as ae
from apt_evap.plot.map_figures import specimen_title
from apt_evap.simulation.columns import columns_of

ENERGY = ae.TruncatedNormal(0.155, 0.155)
BUILT_IN = (
    ae.Unperturbed(),
    ae.LateralVelocity(ae.emission.Thermal(60.0)),
    ae.RollUp(ENERGY),
    ae.Combined(0.3, 0.75),
)


@dataclass(frozen=True)
class Hop:
    """A perturbation of a user's own that launches from above the site, where no response was made."""

    height: float = 0.1

    def launch(self, emissions, random):
        push = random.normal(3) * 50.0
        where = emissions.positions + self.height * emissions.normals
        return ae.emission.Launches(where, push, np.zeros(len(emissions), bool))


@pytest.fixture(scope="session")
def run(small_tip):
    return ae.Simulation(small_tip, seed=7).run(120, emissions=(*BUILT_IN, Hop()), progress=False)


def arrays_of(run):
    """Every array a run holds, by name."""
    return columns_of(run, run.every_column)


def same_bits(one, other):
    one, other = arrays_of(one), arrays_of(other)
    assert one.keys() == other.keys()
    for name in one:
        a, b = np.asarray(one[name]), np.asarray(other[name])
        assert a.dtype == b.dtype, name
        assert np.array_equal(a, b, equal_nan=a.dtype.kind == "f"), name
    return True


def same_hits(one, other):
    return one.columns == other.columns and all(
        np.array_equal(getattr(one, name), getattr(other, name), equal_nan=getattr(one, name).dtype.kind == "f")
        for name in one.columns
    )


# ---- observation ---------------------------------------------------------------------------------------------------


def test_the_observation_of_a_run_is_one_object(run):
    part = run[:20]
    assert part.observation is part.observation and part.observation is not run.observation
    assert replace(part, ended="stopped").observation is not part.observation
    x, y, _ = part.places(ae.RollUp(ENERGY))
    copied = pickle.loads(pickle.dumps(part))
    assert set(vars(copied)) == set(vars(run[:20])), "what was computed is not copied"
    assert same_bits(part, copied)
    assert np.array_equal(copied.places(ae.RollUp(ENERGY))[:2], (x, y), equal_nan=True)


def test_a_run_with_an_observation_needs_no_garbage_collector(run):
    part = run[:20]
    part.hits(ae.Unperturbed())
    gone = weakref.ref(part)
    del part
    assert gone() is None


# ---- columns -------------------------------------------------------------------------------------------------------


def test_columns_fit_the_specimen(run, small_tip):
    assert len(run) == 120
    assert np.array_equal(run.emissions.ions, np.arange(120))
    assert np.array_equal(run.emissions.positions, small_tip.positions[run.site])
    assert len(np.unique(run.site)) == 120
    hits = run.hits(ae.Unperturbed())
    assert np.array_equal(hits.site, run.site)
    assert np.array_equal(hits.positions, run.emissions.positions)
    assert np.array_equal(hits.voltage, np.full(120, 1000.0))
    assert np.array_equal(hits.mass_to_charge, np.full(120, small_tip.masses[0] / small_tip.charge_states[0]))
    steps = run.emissions.neighbours - run.emissions.positions
    rolls = np.isfinite(steps).all(axis=1)
    assert np.linalg.norm(steps[rolls], axis=1) == pytest.approx(small_tip.nearest_neighbour_distance, rel=1e-9)


def test_time_of_flight_is_that_of_the_energy(run):
    """At a flight of 100 mm the way to full speed, some 0.1 um, is nothing: t = path sqrt(m/(2 z e U))."""
    hits = run.hits(ae.Unperturbed())
    path = np.sqrt(hits.x**2 + hits.y**2 + 100.0**2) * 1e6
    speed = ae.units.speed_from_energy(run.emissions.charge_states * 1000.0, run.emissions.masses)
    ratio = (hits.time_of_flight * speed / path)[hits.detected]
    # an ion starts where the potential is a few per cent below the voltage: half an atom or so outside of the surface
    assert ratio.min() > 1.0
    assert ratio.max() < 1.15


def test_summary_counts_everything(run):
    summary = run.summary()
    assert summary["ions"] == 120
    assert summary["hit"] + summary["missed"] + summary["never_left"] == 120
    assert summary["perturbation"] == "Unperturbed()"
    assert summary["ended"] == ""
    assert "120 ions" in repr(run)


# ---- perturbations afterwards --------------------------------------------------------------------------------------


def test_a_perturbation_of_ones_own_is_flown_when_named(run):
    hits, plain = run.hits(Hop()), run.hits(ae.Unperturbed())
    assert np.isfinite(hits.x).any()
    assert not np.array_equal(hits.x, plain.x)


def test_and_refused_afterwards(run):
    with pytest.raises(ValueError, match=r"Hop\(height=0.2\) was not flown in this run .* emissions="):
        run.hits(Hop(0.2))


def test_one_that_says_its_velocities_along_the_surface_is_not_refused(run):
    class Twice:
        """Lateral velocities of twice the energy: follows from the responses like any built-in one."""

        def tangential(self, emissions, random):
            rolled, first, second, *_ = ae.LateralVelocity(ENERGY).tangential(emissions, random)
            return rolled, np.sqrt(2) * first, np.sqrt(2) * second

    double = ae.TruncatedNormal(0.31, 0.31)  # which has twice the quantiles
    expected = run.hits(ae.LateralVelocity(double))
    got = run.hits(Twice())
    assert got.x == pytest.approx(expected.x, abs=1e-9, nan_ok=True)


def test_without_responses(small_tip):
    run = ae.Simulation(small_tip, seed=7).run(10, responses=False, progress=False)
    assert run.perturbations == (ae.Unperturbed(),)
    assert not run.flagged.any()
    assert len(run.hits(ae.Unperturbed())) == 10
    with pytest.raises(ValueError, match="no responses"):
        run.hits(ae.RollUp(ENERGY))


# ---- files ---------------------------------------------------------------------------------------------------------


def test_save_and_load(run, tmp_path):
    run.save(tmp_path / "run.h5")
    loaded = ae.load(tmp_path / "run.h5")
    assert same_bits(run, loaded)
    assert loaded.perturbations[:-1] == BUILT_IN
    for name in ("seed", "voltage", "detector", "response_settings", "elements", "ended", "provenance"):
        assert getattr(loaded, name) == getattr(run, name), name
    assert loaded.settings["tip"] == run.settings["tip"]
    others = (ae.RollUp(0.2), ae.Combined(ENERGY, 0.5), ae.LateralVelocity(0.1))
    for perturbation in (*BUILT_IN, *others):
        assert same_hits(run.hits(perturbation), loaded.hits(perturbation))
    # a user's own comes back as what is known of it, and can be asked for by that
    assert loaded.perturbations[-1]["repr"] == "Hop(height=0.1)"
    assert same_hits(run.hits(Hop()), loaded.hits(loaded.perturbations[-1]))
    assert loaded.summary() == run.summary()
    # and once more, to the same
    loaded.save(tmp_path / "again.h5")
    assert same_bits(run, ae.load(tmp_path / "again.h5"))


def test_the_settings_make_the_tip_again(run, small_tip):
    again = ae.Tip.from_settings(run.settings["tip"])
    assert np.array_equal(again.positions, small_tip.positions)


def test_reasons_and_missing_responses_are_kept(small_tip, tmp_path):
    run = ae.Simulation(small_tip).run(5, responses=False, progress=False).ended_by("interrupted")
    run.save(tmp_path / "run.h5")
    loaded = ae.load(tmp_path / "run.h5")
    assert loaded.ended == "interrupted"
    assert loaded.responses is None
    assert same_bits(run, loaded)


def test_saving_replaces_whole_or_not_at_all(run, tmp_path):
    path = tmp_path / "run.h5"
    run.save(path)
    before = path.read_bytes()
    broken = replace(run, settings=run.settings | {"bad": object()})
    with pytest.raises(TypeError, match="serializable"):
        broken.save(path)
    assert path.read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == ["run.h5"]


def test_files_that_are_no_runs(tmp_path, run):
    with pytest.raises(ae.FileError, match=r"missing\.h5"):
        ae.load(tmp_path / "missing.h5")
    (tmp_path / "text.h5").write_text("no HDF5")
    with pytest.raises(ae.FileError, match=r"text\.h5"):
        ae.load(tmp_path / "text.h5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = 1
    with pytest.raises(ae.FileError, match="not a run"):
        ae.load(tmp_path / "other.h5")
    run.save(tmp_path / "run.h5")
    (tmp_path / "cut.h5").write_bytes((tmp_path / "run.h5").read_bytes()[:20_000])
    with pytest.raises(ae.FileError, match=r"cut\.h5"):
        ae.load(tmp_path / "cut.h5")
    with h5py.File(tmp_path / "run.h5", "a") as file:
        del file["entry1/simulation/site"]
    with pytest.raises(ae.FileError, match=r"run\.h5"):
        ae.load(tmp_path / "run.h5")


def test_another_detector_sees_the_same_ions(run, tmp_path):
    plane = run.hits(ae.Unperturbed())
    curved = run.on_detector(ae.Detector(100.0, 300.0, projection="equidistant"))
    seen = curved.hits(ae.Unperturbed())
    both = plane.detected & seen.detected
    assert both.sum() > 50
    radius = np.hypot(plane.x, plane.y)[both]
    assert np.hypot(seen.x, seen.y)[both] == pytest.approx(100 * np.arctan(radius / 100), rel=1e-10)
    assert (seen.time_of_flight[both] < plane.time_of_flight[both]).mean() > 0.9
    curved.save(tmp_path / "curved.h5")
    assert ae.load(tmp_path / "curved.h5").detector == curved.detector


def test_maps_of_its_ions_cover_the_detector(run):
    hits = run.hits(ae.RollUp(ENERGY))
    map = hits.map(bins=30)
    assert map.extent == hits.extent == (-150, 150, -150, 150) and map.values.shape == (30, 30)
    assert map.mask.all() and map.ions == hits.counts[ae.detection.Outcome.HIT] == map.detected
    # a part of the detector, and what lies beside it
    part = hits.map(bins=40, extent=(-200, 0, -200, 0))
    x, y = np.meshgrid(*part.centres)
    assert np.array_equal(part.mask, (x > -150) & (y > -150))
    # the detector is not known of ions chosen or moved
    moved = ae.Registration(0.0, 0.5, (10.0, 0.0)).hits(hits)
    for other in (hits[::2], hits.within_circle(80.0), moved, replace(hits, y=hits.y / 2, extent=None)):
        assert other.extent is None and not other.map(bins=30).mask.all()
    assert run.on_detector(ae.Detector(width=100.0)).hits(ae.RollUp(ENERGY)).map(bins=30).extent == (-50, 50, -50, 50)


def test_texts_that_are_read_are_of_fixed_length(run, tmp_path):
    """The heap of texts of any length is what HDF5 hangs in, or crashes, where a file is damaged."""
    run.save(tmp_path / "a.h5")
    texts = []

    def look(item, path=""):
        # scalars outside the simulation are for other programs
        if isinstance(item, h5py.Dataset) and (item.shape or path.startswith("entry1/simulation")):
            kind = h5py.check_string_dtype(item.dtype)
            texts.extend([] if kind is None else [path.rpartition("/")[2]])
            assert kind is None or kind.length is not None, path
        for name in item.attrs:
            kind = h5py.check_string_dtype(item.attrs.get_id(name).dtype)
            if kind is not None and name not in ("units", "NX_class", "version", "depends_on"):  # for other programs
                texts.append(name)
                assert kind.length is not None, name

    with h5py.File(tmp_path / "a.h5") as file:
        look(file)
        file.visititems(lambda name, item: look(item, name))
    assert {"format", "settings", "provenance", "elements", "ended", "perturbation"} <= set(texts)


def test_texts_longer_than_an_attribute_are_kept(run, tmp_path):
    words = {"config": "Ω" * 40_000}  # 80 kB in UTF-8
    replace(run, provenance=run.provenance | words).save(tmp_path / "a.h5")
    assert ae.load(tmp_path / "a.h5").provenance["config"] == words["config"]


def test_an_element_of_two_phases_is_named_once(tmp_path):
    particle = ae.specimen.Phase("particle", "Ni", ae.specimen.Sphere((0, 0, 1.0), 0.5), evaporation_field=30.0)
    tip = ae.Tip(phases=[ae.specimen.Phase("matrix", "Ni"), particle], apex_radius=1.6, shank_length=1.6)
    run = ae.Simulation(tip).run(10, responses=False, progress=False)
    assert run.elements == ("Ni", "Ni")
    assert "10 ions of Ni at" in repr(run) and specimen_title(run).startswith("Ni, axis")
    run.save(tmp_path / "run.h5")
    with h5py.File(tmp_path / "run.h5") as file:
        assert file["entry1/specimen/atom_types"].asstr()[()] == "Ni"
