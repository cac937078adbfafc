"""The numbers of the explorer: the same bits as those of the library, and text that gives them again."""

import math
import re
import shlex
import sys
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from rough import ROUGH

import apt_evap as ae
from apt_evap.cli._explorer_of_files import explorer_and_view, with_file
from apt_evap.cli.main import main
from apt_evap.cli.parser import make_parser
from apt_evap.explore.controls import MECHANISMS, controls_of, perturbation_of, values_of
from apt_evap.explore.explorer import Explorer, ExplorerSettings
from apt_evap.explore.measured_ions import IonSelection
from apt_evap.explore.placement import misplaced
from apt_evap.explore.specimen_surface import surface_atoms
from apt_evap.fit.indexed_registration import index_as_run
from apt_evap.fit.structure import PoleMeasure
from apt_evap.io.measured_file import MeasuredFile

TURNED = ae.Registration(20.0, 0.5, (1.0, -2.0), True)
ENERGY = ae.TruncatedNormal(0.2, 0.1)
PERTURBATIONS = [
    ae.Unperturbed(),
    ae.LateralVelocity(ENERGY),
    ae.RollUp(ENERGY),
    ae.RollUp(0.3),
    ae.Combined(ENERGY, 0.4),
]


@pytest.fixture(scope="session")
def run(small_tip, made_once):
    return made_once(small_tip, 2000, seed=1, **ROUGH)


@pytest.fixture(scope="session")
def run_in(run):
    """Function of the units: the run in them."""

    @cache
    def converted(units):
        if units == "simulated":
            return run
        lens = ae.detection.LocalElectrode.preset("local electrode") if units == "lens" else None
        return run.at_evaporation_field(lens)

    return converted


@pytest.fixture(scope="session")
def measured(run):
    """Ions of the same run with other random numbers, turned and scaled."""
    hits = TURNED.hits(replace(run, seed=2).hits(ae.RollUp(ENERGY)))
    pulses = np.arange(len(hits))
    return ae.Hits(x=hits.x, y=hits.y, mass_to_charge=hits.mass_to_charge, pulse_id=pulses).within_circle(35.0)


@pytest.fixture(scope="session")
def explorer(run, measured):
    return Explorer(run, measured, TURNED)


def equal(first, second):
    assert np.array_equal(first.values, second.values) and np.array_equal(first.mask, second.mask)
    assert np.array_equal(first.x_edges, second.x_edges) and np.array_equal(first.y_edges, second.y_edges)
    assert first.values.sum() > 300  # not two empty maps
    return True


@pytest.mark.filterwarnings("ignore::apt_evap.warnings.ResponseWarning")
@pytest.mark.parametrize("units", ["simulated", "cap", pytest.param("lens", marks=pytest.mark.slow)])
@pytest.mark.parametrize("perturbation", PERTURBATIONS, ids=repr)
def test_maps_have_the_bits_of_the_library(run_in, measured, perturbation, units):
    run = run_in(units)
    explorer = Explorer(run, measured, TURNED)
    settings = ExplorerSettings(perturbation, 24, 2.0, flattening=8.0)
    for _ in range(2):  # also when everything is kept from the first time
        maps = explorer.show(settings)
        like = explorer.bins_like(24)
        map = TURNED.hits(run.hits(perturbation)).map(like=like)
        assert equal(maps.simulated, map) and maps.measured is like
        similarity = ae.similarity(map.flattened(8.0), like.flattened(8.0), smoothing=2.0)
        assert maps.similarity.value == similarity.value
        assert np.array_equal(maps.pictures[0].density, map.flattened(8.0).smoothed(2.0).density, equal_nan=True)
        assert maps.ions == len(run) and not maps.preview
        explorer.show(replace(settings, perturbation=ae.Unperturbed()))
    with pytest.raises(ValueError, match="sigma"):
        explorer.show(replace(settings, flattening=1e4))  # wider than the map
    plain = explorer.show(replace(settings, flattening=0.0))
    assert plain.ceiling.value == ae.maps.similarity_ceiling(like, smoothing=2.0).value


@pytest.mark.slow
def test_a_flown_perturbation_has_the_bits_of_its_flights(small_tip):
    flown = ae.RollUp(ENERGY)
    run = ae.Simulation(small_tip, seed=3, **ROUGH).run(1200, [flown], progress=False)
    explorer = Explorer(run, preview=400)
    maps = explorer.show(ExplorerSettings(flown, 32, 0.0))
    like = explorer.bins_like(32)
    assert equal(maps.simulated, run.hits(flown).map(like=like))
    assert not np.array_equal(explorer.hits(maps.settings).x, run.hits(flown, by_response=True).x)
    every = run.hits(flown)[::3]
    assert np.array_equal(
        explorer.show(ExplorerSettings(flown, 32, 0.0), preview=True).simulated.values, every.map(like=like).values
    )


def test_the_region_is_inside_both_maps(run, measured, explorer):
    like = explorer.bins_like(24)
    complete = measured.map(24)
    assert np.array_equal(like.values, complete.values)
    assert 0 < like.mask.sum() <= complete.mask.sum() and not (like.mask & ~complete.mask).any()
    away = Explorer(run, measured, replace(TURNED, scale=0.2, shift=(20.0, 0.0))).bins_like(24)
    x = np.meshgrid(*away.centres)[0]
    # smaller and moved to the right, the simulated ions cover the right part of the measured ones only
    assert away.mask.sum() < like.mask.sum() and x[away.mask].mean() > x[like.mask].mean() + 5


def test_ions_from_to(run, explorer):
    settings = ExplorerSettings(ae.RollUp(ENERGY), 24, 0.0, ions=(500, 1700))
    expected = TURNED.hits(run.hits(ae.RollUp(ENERGY))).window(ion=(500, 1700)).map(like=explorer.bins_like(24))
    assert equal(explorer.show(settings).simulated, expected)
    assert explorer.show(settings).ions == 1200
    late = Explorer(replace(run, emissions=replace(run.emissions, ions=run.emissions.ions + 7000)))
    assert late.first_and_last == (7000, 9000)
    assert late.hits(replace(settings, ions=(7500, 8000))).ion[[0, -1]].tolist() == [7500, 7999]


def test_a_preview_is_every_nth_ion(run, measured):
    explorer = Explorer(run, measured, TURNED, preview=500)
    settings = ExplorerSettings(ae.Combined(ENERGY, 0.4), 24, 2.0)
    maps = explorer.show(settings, preview=True)
    hits = TURNED.hits(run.hits(settings.perturbation)[::4])
    assert maps.preview and maps.ions == 500
    assert np.array_equal(maps.simulated.values, hits.map(like=explorer.bins_like(24)).values)
    assert not explorer.show(settings).preview
    assert not Explorer(run, preview=2000).show(replace(settings, bins=32), preview=True).preview  # all of its ions


def test_without_a_measurement_it_is_the_map_of_the_command_line(run, tmp_path, monkeypatch):
    run.save(tmp_path / "run.h5")
    monkeypatch.chdir(tmp_path)
    explorer = Explorer(run, run_arguments=["run.h5"])
    drawn = []
    monkeypatch.setattr(
        "apt_evap.workflows.written_pictures.save_picture",
        lambda path, maps, titles, *_, **__: drawn.append(maps[0]),
    )
    for settings in (explorer.start, ExplorerSettings(ae.Combined(ENERGY, 0.4), 48, 3.5, ions=(100, 1500))):
        words = shlex.split(explorer.commands(settings).shell)
        assert words[:2] == ["apt-evap", "map"]
        assert main([*words[1:], "-o", "map.png", "--quiet"]) == 0
        picture = explorer.show(settings).pictures[0]
        assert np.array_equal(drawn[-1].density, picture.density) and np.nanstd(picture.density) > 0.1
    assert explorer.show(explorer.start).similarity is None


def executed(python, **names):
    """Names that Python lines leave."""
    exec(python, names)
    return names


@pytest.mark.slow
@pytest.mark.parametrize("ions", [None, (300, 1900)])
@pytest.mark.parametrize("with_map", [False, True])
def test_python_lines_give_the_same_maps(run, measured, with_map, ions, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    explorer = Explorer(run, measured, TURNED) if with_map else Explorer(run)
    settings = ExplorerSettings(ae.Combined(ae.TruncatedNormal(0.15, 0.05), 0.25), 30, 2.5, flattening=6.0, ions=ions)
    names = executed(explorer.commands(settings).python, run=run, measured=measured)
    maps = explorer.show(settings)
    assert equal(names["simulated"], maps.simulated)
    assert (tmp_path / "maps.png").stat().st_size > 10_000
    if with_map:
        assert equal(names["measured"], maps.measured)
        assert f"{maps.similarity.value:.4f}" in capsys.readouterr().out


@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")
@pytest.mark.filterwarnings("ignore::apt_evap.warnings.ResponseWarning")
def test_the_command_gives_the_same_maps(run, measured, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run.save("run.h5")
    ae.write("ions.epos", measured)
    registration = f"--registration={TURNED.to_text()}"
    options = ["--mass", "50,", "--circle", "30,1,2", "--box=-25,25,-20,25", "--simulated", ",1800", "--flatten", "9"]
    line = ["explore", "run.h5", "ions.epos", registration, "--perturbation", "Combined:0.2,0.1,0.3", "--bins", "28"]
    line += [*options, "--real-units"]
    explorer, settings = explorer_and_view(make_parser().parse_args(line))
    assert settings.ions == (0, 1800) and settings.bins == 28 and settings.smoothing == explorer.smoothing_for(28)
    commands = explorer.commands(settings)
    words = shlex.split(commands.shell)
    assert words[0] == "apt-evap"
    other, again = explorer_and_view(make_parser().parse_args(words[1:]))
    assert again == settings and other.registration == explorer.registration
    maps, same = explorer.show(settings), other.show(again)
    assert equal(maps.simulated, same.simulated) and equal(maps.measured, same.measured)
    assert maps.similarity.value == same.similarity.value
    assert other.commands(again) == commands
    # the Python lines read the files as the command does
    names = executed(commands.python)
    assert equal(names["simulated"], maps.simulated) and equal(names["measured"], maps.measured)


def test_a_rectangle_selects_ions(run, measured, explorer, tmp_path, monkeypatch):
    settings = ExplorerSettings(ae.RollUp(ENERGY), 24, 0.0)
    selection = explorer.selection(settings, (10.0, -5.0), (-8.0, 6.0))
    names = executed(selection.python, run=run, measured=measured)
    for name, hits in (("hits", explorer.hits(settings)), ("measured", measured)):
        inside = (hits.x >= -5) & (hits.x < 10) & (hits.y >= -8) & (hits.y < 6)
        assert len(names[name]) == np.count_nonzero(inside) > 50
    monkeypatch.chdir(tmp_path)
    ae.write("MEASURED.epos", measured)
    drawn = []
    monkeypatch.setattr(
        "apt_evap.workflows.written_pictures.save_picture",
        lambda path, maps, titles, *_, **__: drawn.append(maps[0]),
    )
    words = shlex.split(selection.shell.replace("MEASURED", "MEASURED.epos"))
    assert main([*words[1:], "--quiet"]) == 0
    # an .epos has float32
    assert drawn[0].detected == pytest.approx(len(names["measured"]), abs=2)
    # of the run alone
    run.save("RUN.h5")
    alone = Explorer(run).selection(settings, (-50.0, 0.0), (-50.0, 50.0))
    assert main([*shlex.split(alone.shell)[1:], "-o", "part.png", "--quiet"]) == 0
    assert drawn[1].detected == np.count_nonzero(executed(alone.python, run=run)["hits"].detected) > 100
    # a map has no ions
    assert Explorer(run, measured.map(24), TURNED).selection(settings, (-5, 5), (-5, 5)).shell == ""


def test_atoms_at_a_place(run, explorer):
    settings = ExplorerSettings(ae.RollUp(ENERGY), 24, 0.0, ions=(200, 1900))
    atoms = explorer.atoms_at(settings, 3.0, -2.0, 4.0)
    hits = TURNED.hits(run.hits(ae.RollUp(ENERGY)))
    near = [
        row
        for row in range(200, 1900)
        if hits.outcome[row] == 0 and (hits.x[row] - 3.0) ** 2 + (hits.y[row] + 2.0) ** 2 <= 16.0
    ]
    assert len(near) > 5 and atoms.site.tolist() == run.site[near].tolist()
    assert np.array_equal(atoms.positions, run.emissions.positions[near])
    assert np.array_equal(atoms.extra["field"], run.fields[near])
    assert len(explorer.atoms_at(settings, 900.0, 0.0, 1.0)) == 0


def test_profiles_across_a_line(explorer):
    maps = explorer.show(ExplorerSettings(ae.RollUp(ENERGY), 32, 0.0))
    rectangle, profiles = explorer.profiles(maps, [[-10.0, -10.0], [10.0, 10.0]], 12.0)
    assert rectangle.centre == (0.0, 0.0) and rectangle.angle == pytest.approx(45)
    assert rectangle.length == pytest.approx(20 * np.sqrt(2)) and rectangle.width == 12.0
    for map, profile in zip((maps.simulated, maps.measured), profiles, strict=True):
        expected = ae.maps.zone_line_profile(map, rectangle, bins=len(profile.position))
        assert np.array_equal(profile.density, expected.density, equal_nan=True)
    with pytest.raises(ValueError, match="length"):
        explorer.profiles(maps, [[1.0, 1.0], [1.0, 1.0]], 3.0)


@pytest.mark.slow
def test_rings_about_the_pole(run20):
    """[111] has three-fold symmetry; the ring statistic is that of the library, in the frame of the measured map."""
    run = replace(run20, perturbations=(), flown=())  # its responses alone
    registration = ae.Registration(33.0, 0.4, (4.0, -3.0))
    projection = ae.simulation.image_compression(run).projection
    alone = Explorer(run)
    assert alone.poles.pole(None).label == "$111$" and alone.poles.pole(None).fold == 3
    assert alone.poles.pole(None).place == pytest.approx((0.0, 0.0), abs=1e-9)  # mm: rounding
    maps = alone.show(ExplorerSettings(ae.Unperturbed(), 256, 0.0))
    (rings,) = alone.poles.rings(maps, None)
    for ring, expected in zip(rings, ae.maps.ring_statistics(maps.simulated, projection, fold=3), strict=True):
        assert ring.contrast == pytest.approx(expected.contrast, rel=1e-9)
    measured = registration.hits(run.hits(ae.Unperturbed())).within_circle(30.0, registration.shift)
    explorer = Explorer(run, ae.Hits(x=measured.x, y=measured.y), registration)
    assert explorer.poles.pole(registration).place == pytest.approx((4.0, -3.0), abs=1e-9)
    first, second = explorer.poles.rings(explorer.show(ExplorerSettings(ae.Unperturbed(), 256, 0.0)), registration)
    for one, other, moved in zip(first, second, rings, strict=True):
        assert one.contrast == pytest.approx(other.contrast, rel=1e-9)  # the same ions
        # other bins: within the noise of the counts
        assert one.contrast == pytest.approx(moved.contrast, abs=4 * (one.error + moved.error))


def test_poles_over_the_maps(few20):
    """They lie where the registration puts the run, and only on the detector."""
    run = replace(few20, perturbations=(), flown=())
    hits = TURNED.hits(run.hits(ae.Unperturbed()))
    explorer = Explorer(run, ae.Hits(x=hits.x, y=hits.y).within_circle(30.0, TURNED.shift), TURNED)
    settings = ExplorerSettings(ae.Unperturbed(), 64, 2.0)
    drawn = explorer.poles.overlay(explorer.show(settings), TURNED)
    alone = Explorer(run).poles.overlay(Explorer(run).show(settings), None)
    on_detector = dict(zip(alone.labels, alone.places, strict=True))
    assert len(drawn.labels) >= 7 and drawn.labels[0] == "111"
    for label, place in zip(drawn.labels, drawn.places, strict=True):
        assert place == pytest.approx(np.array(TURNED.points(*on_detector[label])))
        assert math.hypot(*(place - TURNED.shift)) < 31.0
    bare = replace(run, settings={**run.settings, "tip": {"source": "a file"}})
    assert Explorer(bare).poles.overlay(Explorer(bare).show(settings), None) is None


def test_a_run_is_registered_where_the_indexed_map_has_its_axis(few20, measured, monkeypatch):
    """The map is indexed once, in the process of the search; a map that does not decide gives no start."""
    candidate = SimpleNamespace(
        orientation=ae.Orientation("Ni", axis=(1, 1, 1)), projection=ae.detection.Projection(60.0, centre=(4.0, -3.0))
    )
    called = []
    for decided in (True, False):
        explorer = Explorer(few20, measured)
        indexing = SimpleNamespace(decided=decided, best=candidate, map=measured.map(64))

        def call(function, arguments, *_, indexing=indexing):
            called.append(function.__name__)
            return indexing if function is index_as_run else ae.Registration(0.0, 0.5, arguments[2]["start"].shift)

        if decided:
            for _ in range(2):
                explorer.register([ae.Unperturbed()], apply=call)
            assert called == ["index_as_run", "_registration", "_registration"]
            assert explorer.registration.shift == pytest.approx((4.0, -3.0), abs=0.01)
            explorer.selection_changed()  # other ions may decide otherwise
            explorer.register([ae.Unperturbed()], apply=call)
            assert called[3:] == ["index_as_run", "_registration"]
        else:
            with pytest.raises(KeyError, match="start"):
                explorer.register([ae.Unperturbed()], apply=call)
            assert explorer.search.options == {}


@pytest.mark.parametrize(("axis", "label", "fold"), [((0, 0, 1), "$002$", 4), ((0, 1, 1), "$022$", 2)])
def test_the_symmetry_of_a_pole(run, axis, label, fold):
    settings = run.settings | {"tip": run.settings["tip"] | {"axis": list(axis)}}
    explorer = Explorer(replace(run, settings=settings))
    assert explorer.poles.nearest[0] == label and explorer.poles.nearest[2] == fold


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the registration is doubtful:UserWarning")
def test_a_registration_is_found(run, measured):
    """The best of those for several emissions; half a minute each."""
    explorer = Explorer(run, measured)
    explorer.register()
    target = measured.map(128)
    scores = [ae.register(run.hits(each), target).score for each in (ae.Unperturbed(), explorer.start.perturbation)]
    assert explorer.registration.score >= max(scores)
    assert explorer.registration.method == "search"


def test_the_best_registration_is_kept(run, measured):
    """Each better one is set at once; an error of the progress ends the search."""
    scores = iter([0.6, 0.9, 0.7])
    explorer, steps = Explorer(run, measured), []
    explorer.search.options = {"rotations": 0.0}

    def found(function, arguments):
        assert arguments[2] == {"rotations": 0.0}
        assert len(arguments[0]) == len(run) and arguments[1].values.shape == measured.map(128).values.shape
        return ae.Registration(0.0, 0.5, (0.0, 0.0), score=next(scores))

    def progress(done, number):
        steps.append((done, number, explorer.registration.score))

    emissions = [ae.Unperturbed(), ae.RollUp(0.2), ae.RollUp(0.3)]
    assert explorer.register(emissions, progress, found).score == 0.9 == explorer.registration.score
    assert [each[:2] for each in steps] == [(k, 3) for k in range(4)] and steps[2][2] == 0.6
    scores = iter([ValueError("empty"), 0.8])

    def fails(function, arguments):
        if isinstance(score := next(scores), ValueError):
            raise score
        return ae.Registration(0.0, 0.5, (0.0, 0.0), score=score)

    assert explorer.register(emissions[:2], apply=fails).score == 0.8
    scores = iter([ValueError("empty")])
    with pytest.raises(ValueError, match="empty"):
        explorer.register(emissions[:1], apply=fails)
    scores = iter([0.95])

    def stopped(done, number):
        if done:
            raise KeyError

    with pytest.raises(KeyError):
        explorer.register(emissions, stopped, found)
    assert explorer.registration.score == 0.8
    for arguments in ((run,), (None, measured)):
        with pytest.raises(ValueError, match="registration"):
            Explorer(*arguments).register()


def test_before_the_registration_both_maps_have_one_size(run, measured):
    explorer = Explorer(run, measured)
    assert not explorer.registered and explorer.registration.rotation == 0.0
    maps = explorer.show(explorer.start)
    assert maps.similarity is None and maps.ceiling is None
    assert "--registration" not in explorer.commands(maps.settings).shell
    hits = explorer.hits(replace(maps.settings, perturbation=ae.Unperturbed()))
    hits = hits[hits.detected]
    for own, other in ((hits.x, measured.x), (hits.y, measured.y)):
        assert np.nanmedian(own) == pytest.approx(np.median(other), abs=6)  # mm, of a field of view of 70 mm
    assert np.ptp(np.nanpercentile(hits.x, [1, 99])) == pytest.approx(
        np.ptp(np.percentile(measured.x, [1, 99])), rel=0.2
    )
    explorer.set_registration(TURNED)
    assert explorer.registered and explorer.show(explorer.start).similarity is not None


def test_the_verdict_is_that_of_the_library(run, measured, explorer):
    maps = explorer.show(ExplorerSettings(ae.RollUp(ENERGY), 24, 2.0))
    found = explorer.poles.likeness(maps, explorer.registration)
    expected = ae.maps.likeness(maps.simulated, maps.measured, TURNED)
    assert expected.verdict == "alike" and found.reason.startswith(expected.reason)
    # too few ions for lines about the pole, which are not a part of that
    assert found.verdict == "doubtful" and explorer.poles.structures(maps, explorer.registration)[0] is None


@pytest.mark.slow
@pytest.mark.parametrize("emission", [ae.Unperturbed(), ae.RollUp(0.2)], ids=repr)
def test_the_verdict_takes_lines_about_the_pole(run20, emission, monkeypatch):
    """Maps of one crystal have the same symmetries, also if one of them has dark lines where the other's are bright."""
    run = replace(run20, perturbations=(), flown=())
    hits = run.hits(emission)
    inside = np.hypot(hits.x, hits.y) <= 100.0  # without a word on one that is far outside
    measured = ae.Hits(x=hits.x[inside], y=hits.y[inside])
    explorer = Explorer(run, measured, ae.Registration(0.0, 1.0, (0.0, 0.0)))
    measures = []

    class Counted(PoleMeasure):
        def __init__(self, *arguments):
            measures.append(self)
            super().__init__(*arguments)

    monkeypatch.setattr("apt_evap.explore.poles_of_run.PoleMeasure", Counted)
    verdicts = {}
    for other in (ae.Unperturbed(), ae.RollUp(0.2)):
        maps = explorer.show(ExplorerSettings(other, 64, 2.0))
        assert ae.maps.likeness(maps.simulated, maps.measured, explorer.registration).verdict == "alike"
        found = explorer.poles.likeness(maps, explorer.registration)
        verdicts[other] = found.verdict
        assert ("correlate only" in found.reason) == (other != emission)
        region = PoleMeasure(run, explorer.registration, maps.measured)
        simulated, measured = explorer.poles.structures(maps, explorer.registration)
        assert np.array_equal(measured.values, region.structure(maps.measured).values, equal_nan=True)
        assert np.array_equal(simulated.values, region.structure(maps.simulated).values, equal_nan=True)
    assert {verdict for other, verdict in verdicts.items() if other != emission} == {"doubtful"}
    assert verdicts[emission] == "alike"
    assert len(measures) == 1  # the place of the pole and the measured structure are those of all emissions
    explorer.set_registration(ae.Registration(0.0, 1.0, (0.5, 0.0)))
    explorer.poles.likeness(explorer.show(ExplorerSettings(emission, 64, 2.0)), explorer.registration)
    assert len(measures) == 2


@pytest.mark.parametrize(("rotation", "scale"), [(0.0, 60.0), (20.0, 60.0), (120.0, 60.0), (0.0, 51.0)])
def test_maps_that_do_not_lie_on_each_other(rotation, scale):
    """The verdict depends on the registration: rotations by the symmetry of [111], 120 degrees, are as good."""
    pattern, name = ae.maps.master_patterns("fcc")[0], "Ni"
    simulated, measured = (
        pattern.map(ae.Orientation(name, axis=(1, 1, 1), rotation=turn), ae.detection.Projection(each), width=70.0,
                    ions=40_000, rolled=0.8, seed=seed)
        for turn, each, seed in ((0.0, 60.0, 1), (rotation, scale, 2))
    )  # fmt: skip
    measured = replace(measured, x_edges=simulated.x_edges, y_edges=simulated.y_edges)
    why = misplaced(simulated, measured, ae.Registration(0.0, 1.0, (0.0, 0.0)))
    if rotation == 20.0:
        assert any(f"turned by {angle}° and scaled by 1 " in why for angle in range(-180, 181, 3)
                   if abs((angle - 20.0 + 60) % 120 - 60) <= 1.5)  # fmt: skip
    else:
        assert ("scaled by 0.85" in why) == bool(why) == (scale != 60.0)


@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")
@pytest.mark.parametrize("as_map", [False, True])
def test_a_measurement_alone(measured, as_map, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ae.write("ions.epos", measured)
    ions = ae.read("ions.epos")
    given = ions.map(64) if as_map else ions
    explorer = Explorer(None, given, file=MeasuredFile("ions.epos"))
    settings = replace(explorer.start, bins=32)
    maps = explorer.show(settings)
    assert maps.simulated is None and maps.similarity is None and maps.ions == 0
    assert maps.measured.values.sum() >= 0.99 * len(ions) and maps.pictures == (maps.whole,)
    assert np.array_equal(maps.whole.density, maps.measured.smoothed(settings.smoothing).density, equal_nan=True)
    assert max(maps.measured.values.shape) == 32
    _, (profile,) = explorer.profiles(maps, [[-10.0, -10.0], [10.0, 10.0]], 12.0)
    assert len(profile.density) > 3
    if not as_map:
        names = executed(explorer.commands(settings).python)
        assert equal(names["measured"], maps.measured)
        assert executed(explorer.selection(settings, (0.0, 9.0), (0.0, 9.0)).python)["measured"].x.min() >= 0
        drawn = []
        monkeypatch.setattr(
            "apt_evap.workflows.written_pictures.save_picture",
            lambda path, maps, titles, *_, **__: drawn.append(maps[0]),
        )
        words = shlex.split(explorer.commands(settings).shell)
        assert main([*words[1:], "--quiet"]) == 0
        assert np.array_equal(drawn[0].density, maps.whole.density, equal_nan=True)


@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")
@pytest.mark.parametrize("files", [[], ["run.h5"], ["ions.epos"], ["run.h5", "ions.epos"]])
def test_the_command_opens_what_there_is(run, measured, tmp_path, monkeypatch, files):
    monkeypatch.chdir(tmp_path)
    run.save("run.h5")
    ae.write("ions.epos", measured)
    explorer, settings = explorer_and_view(make_parser().parse_args(["explore", *files]))
    if not files:
        assert explorer is settings is None
        return
    assert (explorer.run is not None, explorer.measured is not None) == tuple(
        name in files for name in ("run.h5", "ions.epos")
    )
    assert explorer.names == tuple(name if name in files else "" for name in ("run.h5", "ions.epos"))
    assert explorer.show(settings).pictures


@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")
def test_a_file_is_opened_beside_the_others(run, measured, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run.save("run.h5")
    ae.write("ions.epos", measured)
    options = make_parser().parse_args(["explore", "--circle", "20", "--distance", "90", "--t0", "12.5"])
    explorer, _ = with_file(options, "ions.epos")
    assert options.distance is None and not options.time_zero
    assert explorer.run is None and len(explorer.measured) == len(measured)  # the circle was of another file
    with pytest.raises(ValueError, match="none"):
        with_file(options, "none.epos")
    explorer, settings = with_file(options, "run.h5")  # the file that failed is forgotten
    assert explorer.names == ("run.h5", "ions.epos") and len(explorer.show(settings).pictures) == 2


def test_a_run_keeps_the_selected_ions(run, measured):
    """Ions that were selected on the page are those beside a run that is opened later."""
    words = {"run_arguments": ["run.h5"], "file": MeasuredFile("ions.epos")}
    before = Explorer(None, measured, **words)
    before.ions_of_file.select(IonSelection(ions=(0, 500)))
    before.selection_changed()
    explorer = Explorer(run, measured, **words)
    size = explorer.registration.scale
    explorer.keep_ions(before)
    assert explorer.measured is before.measured and len(explorer.measured) == 500
    shown = explorer.show(explorer.start)
    assert shown.whole.ions <= 500 and "--ions=0,500" in explorer.commands(shown.settings).shell
    assert explorer.registration.scale == pytest.approx(size, rel=0.1) and not explorer.registered
    other = Explorer(run, measured, run_arguments=["run.h5"], file=MeasuredFile("other.epos"))
    other.keep_ions(before)
    assert other.measured is not before.measured
    volts = replace(measured, voltage=np.full(len(measured), 5000.0))  # of --voltage-unit, in the same file
    for first, second in ((measured, volts), (volts, replace(volts, voltage=volts.voltage + 1))):
        before, other = Explorer(None, first, **words), Explorer(run, second, **words)
        other.keep_ions(before)
        assert other.measured is not before.measured


def test_what_is_refused(run, measured):
    for arguments, sentence in [
        ((run, None, TURNED), "registration needs"),
        ((None, measured, TURNED), "registration needs"),
        ((), "run, measured"),
        (("run",), "run must be a Run"),
        ((run, measured, 3.0), "registration must be a Registration"),
    ]:
        with pytest.raises(ValueError, match=sentence):
            Explorer(*arguments)
    with pytest.raises(ValueError, match=r"none of .* hits is in x"):
        Explorer(run, measured, replace(TURNED, shift=(300.0, 0.0))).bins_like(24)
    for changes in ({"bins": 0}, {"smoothing": -1.0}, {"ions": (5, 5)}, {"flattening": np.nan}):
        with pytest.raises(ValueError, match=next(iter(changes)).rstrip("s")):
            replace(ExplorerSettings(ae.Unperturbed(), 24, 0.0), **changes)


# ---- controls and the specimen -------------------------------------------------------------------------------------


@pytest.mark.parametrize("mechanism", MECHANISMS)
def test_controls_and_perturbations_are_the_same(mechanism):
    values = {each.name: each.low + 0.3 * (each.high - each.low) for each in controls_of(mechanism)}
    perturbation = perturbation_of(mechanism, values)
    assert type(perturbation) is MECHANISMS[mechanism]
    name, back = values_of(perturbation)
    assert name == mechanism and back == pytest.approx(values, rel=1e-8)  # standard deviations have 9 digits
    assert perturbation_of(name, back) == perturbation
    if "mean" in values:  # an unperturbed ion has a height, but no energy
        equal_energies = perturbation_of(mechanism, values | {"relative_spread": 0.0})
        assert equal_energies.energy == values["mean"]
        with pytest.raises(ValueError, match="'mean'"):
            perturbation_of(mechanism, {})


def test_heights_are_those_that_the_run_serves(run):
    for height in (0.2, 0.35):
        explorer = Explorer(replace(run, response_settings=ae.ResponseSettings(height=height)))
        controls = {control.name: control for control in explorer.controls("roll-up")}
        assert controls["height"].high == height and "sharpness" in controls


def test_maps_follow_every_option(small_tip):
    run = ae.Simulation(small_tip, seed=2).run(60, progress=False)
    explorer = Explorer(run)
    for options in ({}, {"sharpness": 0.15}, {"sharpness": 0.15, "probability": 0.5}, {"probability": 0.5}, {}):
        perturbation = ae.RollUp(ENERGY, **options)
        expected = run[:].hits(perturbation)  # a new run, which knows nothing of the previous ones
        assert np.array_equal(explorer.hits(ExplorerSettings(perturbation, 24, 0.0)).x, expected.x, equal_nan=True)


def test_a_run_without_responses_shows_the_emission_that_was_flown(small_tip, measured):
    emission = ae.LateralVelocity(0.1)
    run = ae.Simulation(small_tip, seed=2, **ROUGH).run(300, [emission], responses=False, progress=False)
    explorer = Explorer(run, measured, ae.Registration(0.0, 1.0, (0.0, 0.0)))
    assert not explorer.has_sliders and explorer.start.perturbation == emission
    maps = explorer.show(replace(explorer.start, bins=24))
    expected = run.hits(emission).map(like=explorer.bins_like(24), position_step=None)
    assert np.array_equal(maps.simulated.values, expected.values)


def test_perturbations_without_controls():
    widths = ae.RollUp(ae.TruncatedNormal(0.2, 0.1), 0.5, others=ae.TruncatedNormal(0.1, 0.1))
    others = widths, ae.RollUp(0.2, ae.emission.ChargeRatio(0.9)), ae.Combined(0.2, 0.5, others=0.1)
    energies = ae.RollUp(ae.emission.Thermal(50.0)), ae.LateralVelocity(ae.TruncatedNormal(0.0, 0.1))
    for perturbation in (*others, *energies, "RollUp"):
        with pytest.raises(ValueError, match="the explorer has controls for"):
            values_of(perturbation)


def test_atoms_of_the_surface(run):
    """Seen from above and from the sides, every front atom is among them."""
    atoms = surface_atoms(run, "field", ions=(400, 2000))
    positions, diameter = run.emissions.positions[400:], run.emissions.nearest_neighbour_distance
    assert len(atoms.positions) < len(positions)
    rows = [int(np.flatnonzero((positions == each).all(axis=1))[0]) for each in atoms.positions]
    assert np.array_equal(atoms.values, run.fields[400:][rows])
    radius, seen = 0.6 * diameter, []  # spheres of the page
    for depth, sign in ((2, 1), (0, 1), (0, -1), (1, 1), (1, -1)):
        across = np.delete(positions, depth, axis=1)
        for k in range(0, len(positions), 23):
            rest = radius**2 - ((across - across[k]) ** 2).sum(axis=1)
            over = np.flatnonzero(rest > 0)
            seen.append(over[(sign * positions[over, depth] + np.sqrt(rest[over])).argmax()] in rows)
    assert np.mean(seen) > 0.98


def test_colours_of_the_specimen(run):
    for color, values in (("order", run.emissions.ions), ("field", run.fields), ("charge", run.charges)):
        assert np.isin(surface_atoms(run, color).values, values).all()
    assert not surface_atoms(run, "phase").values.any()
    with pytest.raises(ValueError, match="color"):
        surface_atoms(run, "mass")


# ---- command line ---------------------------------------------------------------------------------------------------


def test_without_bokeh_one_sentence(run, tmp_path, monkeypatch, capsys):
    run.save(tmp_path / "run.h5")
    for name in [name for name in sys.modules if name.split(".")[0] == "bokeh" or name == "apt_evap.explore.page"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "bokeh", None)
    assert main(["explore", str(tmp_path / "run.h5")]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err == (
        "apt-evap: error: explore needs bokeh, which is not installed: pip install 'apt_evap[explore]'\n"
    )


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        (["ions.npz", "run.h5"], "RUN must be"),
        (["run.h5", "run.h5"], "MEASURED must be measured ions or a map, 'run.h5' is a run"),
        (["run.h5", "--registration=1,1,0,0"], "--registration"),
        (["run.h5", "--perturbation", "RollUp:1,2,3"], "'RollUp' takes"),
        (["run.h5", "--simulated", "5000,"], "--simulated selects none of the ions 0 to 2000"),
        (["none.h5"], "cannot read 'none.h5'"),
    ],
)
def test_what_the_command_refuses(run, tmp_path, monkeypatch, line, sentence):
    monkeypatch.chdir(tmp_path)
    run.save("run.h5")
    with pytest.raises((ValueError, OSError), match=re.escape(sentence)):
        explorer_and_view(make_parser().parse_args(["explore", *line]))
