"""Measured ions of the explorer: default masses, a range that is dragged, a part of the sequence, all as text, too."""

import shlex
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.cli._explorer_of_files import explorer_and_view
from apt_evap.cli.main import main
from apt_evap.cli.parser import make_parser
from apt_evap.detection.timing import mass_to_charge
from apt_evap.explore.explorer import Explorer
from apt_evap.explore.measured_ions import IonSelection, MeasuredIons
from apt_evap.io.measured_file import MeasuredFile

pytestmark = pytest.mark.usefixtures("spectra_once")


@pytest.fixture(scope="session")
def hits():
    """Ions of copper inside a circle, of silicon outside it, and a background."""
    rng = np.random.default_rng(4)
    n = 15_000
    place = rng.normal(size=(2, n)) * 8.0
    copper = np.hypot(*place) < 9.0
    mass = np.where(copper, rng.choice([62.93, 64.93], n, p=[0.69, 0.31]),
                    rng.choice([13.988, 14.488, 14.987], n, p=[0.922, 0.047, 0.031]))  # fmt: skip
    mass = mass * rng.normal(1.0, 3e-4, n)
    noise = rng.random(n) < 0.05
    mass[noise] = rng.uniform(1.0, 100.0, noise.sum())
    volts = np.full(n, 5000.0)
    time = np.sqrt(mass / mass_to_charge(volts, np.ones(n), *place, 90.0))  # m/n grows with the square of the time
    return ae.Hits(x=place[0], y=place[1], mass_to_charge=mass, pulse_id=np.arange(n), voltage=volts,
                   time_of_flight=time)  # fmt: skip


def test_the_main_element_of_a_spectrum(hits):
    ions = MeasuredIons(hits)
    assert ions.spectrum().main_element == "Si"
    noise = ae.Hits(mass_to_charge=np.random.default_rng(1).uniform(1, 100, 5000))
    assert ae.spectrum(noise).main_element is None


def test_times_of_flight_without_a_length_are_said_to_need_one(hits):
    notes, file = [], MeasuredFile("a.raw", peaks="Cu")
    bare = replace(hits, mass_to_charge=None)
    assert len(file.select(bare, notes.append)) == len(hits)
    assert notes == ["all ions are used: --distance MM, the flight length, gives m/n, and the ions of Cu"]
    assert len(file.select(replace(bare, voltage=None), notes.append)) == len(hits)
    assert len(notes) == 1  # without voltages it would not


@pytest.mark.parametrize("of_times", [False, True])
@pytest.mark.parametrize(
    "selection",
    [
        pytest.param(IonSelection("Cu", ions=(100, 10_000)), marks=pytest.mark.slow),
        IonSelection(mass=(13.5, 15.5)),
        IonSelection(mass=(None, 20.0), ions=(None, 9_000)),
        IonSelection(ions=(500, 700)),
    ],
    ids=repr,
)
@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")
def test_a_selection_is_the_same_as_text(hits, selection, of_times, tmp_path, monkeypatch):
    """The command and the Python lines give the ions that the page shows."""
    monkeypatch.chdir(tmp_path)
    if of_times:
        columns = {name: getattr(hits, name) for name in ("x", "y", "voltage", "time_of_flight", "pulse_id")}
        hits = ae.Hits(**columns)
    monkeypatch.setattr("apt_evap.cli._files.read_file", lambda path, **options: hits)
    chosen = MeasuredIons(hits, selection.of(MeasuredFile("a.epos", distance=90.5 if of_times else None)))
    explorer, view = explorer_and_view(make_parser().parse_args(["explore", *chosen.arguments]))
    assert np.array_equal(explorer.measured.x, chosen.hits.x) and 0 < len(chosen.hits) < len(hits)
    if selection.element == "Cu":
        assert np.mean(np.hypot(chosen.hits.x, chosen.hits.y) < 9.0) > 0.98
    command = explorer.commands(view)
    names = {}
    monkeypatch.setattr(ae, "read", lambda path, **options: hits)
    exec(command.python.partition("\nfrom apt_evap")[0], names)
    exec("measured = " + chosen.code, names)
    assert np.array_equal(names["measured"].x, chosen.hits.x)
    assert chosen.code in command.python
    drawn = []
    monkeypatch.setattr(
        "apt_evap.workflows.written_pictures.save_picture",
        lambda path, maps, titles, *_, **__: drawn.append(maps[0]),
    )
    assert main([*shlex.split(command.shell)[1:], "--quiet"]) == 0
    assert np.array_equal(drawn[0].density, explorer.show(view).whole.density, equal_nan=True)


@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")
def test_numbers_of_ions_are_those_of_the_file(hits, monkeypatch):
    """Also beside a circle, in the command and in the Python lines."""
    monkeypatch.setattr("apt_evap.cli._files.read_file", lambda path, **options: hits)
    monkeypatch.setattr(ae, "read", lambda path, **options: hits)
    words = ["explore", "a.epos", "--circle=8", "--ions=1000,3000"]
    explorer, view = explorer_and_view(make_parser().parse_args(words))
    expected = hits.window(ion=(1000, 3000)).within_circle(8.0)
    assert np.array_equal(explorer.measured.x, expected.x) and explorer.ions_of_file.number > 14_500
    command = explorer.commands(view)
    again, _ = explorer_and_view(make_parser().parse_args(["explore", *shlex.split(command.shell)[2:-4]]))
    assert np.array_equal(again.measured.x, expected.x)
    (code,) = [line for line in command.python.splitlines() if line.startswith("measured")]
    names = {"Explorer": lambda run, measured: SimpleNamespace(bins_like=lambda bins: measured), "ae": ae}
    exec(code, names)
    assert np.array_equal(names["measured"].x, expected.x)


def test_the_command_names_the_crystal(tmp_path, monkeypatch):
    pytest.importorskip("bokeh")
    from bokeh.document import Document

    from apt_evap.explore.page import Page

    monkeypatch.chdir(tmp_path)
    edges = np.linspace(-20.0, 20.0, 41)
    counts = np.random.default_rng(1).poisson(20.0, (40, 40))
    np.savez("map.npz", counts=counts, x_edges_mm=edges, y_edges_mm=edges)
    explorer, view = explorer_and_view(make_parser().parse_args(["explore", "map.npz", "--element", "Ni"]))
    page = Page(explorer, Document(), view, later=lambda function, delay: None)
    assert page.index.material.value == "Ni" and "111" in page.index.family.options
    page.close()
    explorer, _ = explorer_and_view(make_parser().parse_args(["explore", "map.npz"]))
    assert explorer.crystal == ""
    with pytest.raises(ValueError, match="--element"):
        explorer_and_view(make_parser().parse_args(["explore", "map.npz", "--element", "Xy"]))


def test_what_cannot_be_selected(hits):
    ions = MeasuredIons(hits)
    ions.select(IonSelection(mass=(10.0, 20.0)))
    before = ions.hits
    for selection, sentence in (
        (IonSelection("W"), "W"),
        (IonSelection(mass=(300.0, 301.0)), "select none"),
        (IonSelection(ions=(5, 5)), "select none"),
    ):
        with pytest.raises(ValueError, match=sentence):
            ions.select(selection)
        assert ions.hits is before and ions.selection == IonSelection(mass=(10.0, 20.0))
    bare = MeasuredIons(ae.Hits(x=hits.x, y=hits.y))
    assert not bare.has_masses and not bare.lacks_distance
    with pytest.raises(ValueError, match="mass_to_charge"):
        bare.select(IonSelection(mass=(1.0, 2.0)))


def test_the_explorer_takes_other_ions(hits):
    ions = MeasuredIons(hits)
    explorer = Explorer(None, ions)
    everything = explorer.show(explorer.start).measured.values.sum()
    ions.select(IonSelection("Si"))
    explorer.selection_changed()
    maps = explorer.show(explorer.start)
    x, y = np.meshgrid(*maps.measured.centres)
    assert maps.measured.values.sum() < 0.6 * everything
    assert maps.measured.values[np.hypot(x, y) < 8.0].sum() < 0.02 * maps.measured.values.sum()
