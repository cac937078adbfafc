"""`apt-evap twin`: what is kept in its folder belongs to one file and one set of options."""

import hashlib
import json
import os
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.cli._files import measured_source
from apt_evap.cli.main import main
from apt_evap.cli.parser import make_parser
from apt_evap.fit.measured_map import FEWEST_IONS, bins_for_run, measured_map
from apt_evap.maps.indexing.master_pattern import master_patterns
from apt_evap.simulation.config.simulation_file import read_config
from apt_evap.simulation.stop_reason import StopReason
from apt_evap.warnings import warn
from apt_evap.workflows import kept_files, twin_of_map
from apt_evap.workflows.advice import advice_as_notes
from apt_evap.workflows.kept_files import RECORD, KeptFiles
from apt_evap.workflows.twin_of_map import Twin
from apt_evap.workflows.twin_options import TwinOptions

ARGUMENTS = ("--element", "Ni", "--scales", "56,64")


def measurement(path, rotation=20.0, voltages=(2000.0, 2500.0)):
    pattern = master_patterns("fcc")[0]
    truth = ae.Orientation("Ni", axis=(0.30, 0.54, 0.79), rotation=rotation)
    measured = pattern.map(truth, ae.detection.Projection(60.0), 70.0, ions=6_000, rolled=0.5, seed=1)
    x, y = (np.repeat(part.ravel(), measured.values.astype(int).ravel()) for part in np.meshgrid(*measured.centres))
    order = np.random.default_rng(1).permutation(len(x))
    voltage = np.linspace(*voltages, len(x)).astype("f4")
    ions = ae.Hits(
        x=x[order].astype("f4"), y=y[order].astype("f4"), voltage=voltage, mass_to_charge=np.full(len(x), 29.0, "f4"),
        time_of_flight=np.full(len(x), 500.0, "f4"), positions=np.zeros((len(x), 3), "f4"),
        multiplicity=np.ones(len(x), int), pulse_id=np.arange(len(x)),
    )  # fmt: skip
    ae.write(path, ions)
    return ions


class _Study:
    """In the place of a study: what the command asks it for."""

    likeness = SimpleNamespace(verdict="alike")
    no_energy = ""

    def lines(self):
        return ["the maps are alike"]


class _Left(NamedTuple):
    """In the place of a run that an earlier call has left; its length is that of the tuple."""

    ended: str
    provenance: dict


@pytest.fixture
def quick(tmp_path, monkeypatch, indexed_once):
    """The command with a simulation and a comparison that only write files; the calls of both are counted."""
    calls = []

    def simulate(settings, output, **_):
        calls.append("run")
        output.write_text("a run")
        return SimpleNamespace(interrupted=False, run=Run())

    def compare(run, measured, folder, *_, **__):
        calls.append("compare")
        folder.mkdir(exist_ok=True)
        (folder / "report.html").write_text("a report")
        return _Study()

    class Run:
        def hits(self, emission):
            places = np.random.default_rng(0).uniform(-30, 30, (2, 500))
            return ae.Hits(x=places[0], y=places[1])

    def index(measured, material, **options):
        calls.append("index")
        return indexed_once(measured, material, **options)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(twin_of_map, "simulate", simulate)
    monkeypatch.setattr(twin_of_map, "compare", compare)
    whole = _Left("", {})
    monkeypatch.setattr(twin_of_map, "load", lambda path: whole)  # the simulated run is in memory
    monkeypatch.setattr(twin_of_map, "is_run", lambda path: path.read_text() == "a run")
    monkeypatch.setattr(twin_of_map, "index", index)
    monkeypatch.setattr(twin_of_map, "register_near", lambda *_: ae.Registration(1.0, 1.0, (0.0, 0.0)))
    measurement("ni.epos")
    return calls


def refused(capsys, *arguments):
    """Message of a command that is refused."""
    assert main(["twin", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


@pytest.mark.slow
def test_a_folder_belongs_to_one_file_and_one_set_of_options(quick, capsys):
    first = ["ni.epos", *ARGUMENTS, "-o", "t"]
    assert main(["twin", *first]) == 0
    answer = capsys.readouterr().out
    assert quick == ["index", "run", "compare"] and "wrote t/study/report.html" in answer
    quick.clear()
    os.rename("ni.epos", "copy.epos")  # the name does not matter
    assert main(["twin", "copy.epos", *first[1:], "--threads", "1"]) == 0
    assert quick == ["run"] and capsys.readouterr().out.splitlines()[-2:] == answer.splitlines()[-2:]
    measurement("ni.epos", rotation=50.0)
    assert "another FILE" in refused(capsys, *first)
    for name, value in (
        ("element", "Cu"), ("scales", "55,64"), ("distance", "90"), ("field-factor", "5"), ("efficiency", "0.3"),
        ("minutes", "5"), ("lens", "local-electrode"), ("ions", "0,4000"), ("mass", "20,40"), ("circle", "30"),
        ("pole", "3,4"), ("line", "0,0,9,9"), ("byte-order", "little"),
    ):  # fmt: skip
        assert f"--{name}" in refused(capsys, "copy.epos", *first[1:], f"--{name}={value}")
    assert quick == ["run"]  # nothing was computed for them


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["specimen.toml", "start.json", "registration.json", "answer.txt", "study/report.html"]
)
def test_files_that_this_command_did_not_write_are_refused(quick, capsys, name, tmp_path):
    first = ["ni.epos", *ARGUMENTS, "-o", "t"]
    assert main(["twin", *first]) == 0
    original = (tmp_path / "t" / name).read_bytes()
    (tmp_path / "t" / name).write_bytes(b"precious")
    capsys.readouterr()
    assert f"t/{name}" in refused(capsys, *first)
    assert (tmp_path / "t" / name).read_bytes() == b"precious"
    # without it, what depends on it is made again
    (tmp_path / "t" / name).unlink()
    quick.clear()
    assert main(["twin", *first]) == 0
    assert ("index" in quick) == (name in ("specimen.toml", "start.json")) and "compare" in quick
    assert (tmp_path / "t" / name).read_bytes() == original
    capsys.readouterr()
    (tmp_path / "t" / "run.h5").write_bytes(b"precious")
    assert "t/run.h5" in refused(capsys, *first)
    # without the record, nobody knows what the files were made from
    (tmp_path / "t" / RECORD).unlink()
    capsys.readouterr()
    assert "t/specimen.toml" in refused(capsys, *first)


@pytest.mark.slow
def test_a_run_whose_time_was_over_is_not_continued_unless_it_is_another(quick, capsys, monkeypatch):
    first = ["ni.epos", *ARGUMENTS, "-o", "t"]
    assert main(["twin", *first]) == 0
    quick.clear()
    key = read_config("t/specimen.toml").key
    for provenance, steps in (({"settings": key}, []), ({"settings": "of another file"}, ["run"]), ({}, ["run"])):
        left = _Left(StopReason.TIME_OVER, provenance)
        monkeypatch.setattr(twin_of_map, "load", lambda path, left=left: left)
        assert main(["twin", *first]) == 0
        assert quick == steps
        quick.clear()


@pytest.mark.slow
def test_the_simulation_leaves_time_for_the_fit(quick, monkeypatch):
    seconds = []
    simulate = twin_of_map.simulate

    def timed(settings, output, **options):
        seconds.append(options["seconds"])
        return simulate(settings, output)

    monkeypatch.setattr(twin_of_map, "simulate", timed)
    monkeypatch.setattr(twin_of_map, "time", SimpleNamespace(monotonic=lambda: 0.0))  # the indexing takes no time
    for minutes, threads in ((10, 1), (10, 2), (1, 1)):
        ae.twin("ni.epos", "Ni", scales=(56, 64), minutes=minutes, threads=threads, folder=f"t{minutes}{threads}")
    one, two, short = seconds
    # 6,000 measured ions: four draws of 20,000 ions, 180 maps of the grid and 125 between its points
    fit = 305 * (0.025 + 0.5e-6 * 4 * 20_000)
    assert one(20_000) == pytest.approx(600 - 14 - fit) and two(20_000) == pytest.approx(600 - 14 - fit / 2)
    assert one(40_000) < one(20_000) < one(5_000)
    assert short(1_000_000) == 12  # a fifth at least


def test_a_folder_of_others_stays_as_it_is(quick, capsys, tmp_path):
    (tmp_path / "mine").mkdir()
    os.mkfifo(tmp_path / "mine" / "specimen.toml")
    (tmp_path / "file").write_text("x")
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / "answer.txt").symlink_to(tmp_path / "elsewhere")
    for folder, text in (("mine", "specimen.toml"), ("file", "folder"), ("no/such", "no/such"), ("linked", "answer")):
        assert text in refused(capsys, "ni.epos", *ARGUMENTS, "-o", folder)
    assert not quick and sorted(os.listdir()) == ["file", "linked", "mine", "ni.epos"]
    assert os.listdir("mine") == ["specimen.toml"]


@pytest.mark.slow
def test_a_name_with_a_dash_is_not_an_option(quick, capsys, tmp_path):
    os.rename("ni.epos", "-ni.epos")
    assert main(["twin", *ARGUMENTS, "--distance", "90", "--", "-ni.epos"]) == 0
    assert (tmp_path / "-ni_twin" / "answer.txt").exists()
    (command,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("reconstruct with")]
    assert " ./-ni.epos " in command


@pytest.mark.slow
def test_after_every_write_the_command_continues(quick, capsys, tmp_path, monkeypatch):
    """Killed after the nth file that it writes; started again, it ends with the same files."""
    first = ["ni.epos", *ARGUMENTS, "-o"]
    assert main(["twin", *first, "whole"]) == 0
    replace_file = kept_files.replace_file
    for last in range(1, 10):
        written = 0

        def replaced(path, last=last):
            nonlocal written
            written += 1
            if written > last:
                raise KeyboardInterrupt
            return replace_file(path)

        monkeypatch.setattr(kept_files, "replace_file", replaced)
        code = main(["twin", *first, f"t{last}"])
        assert code == (130 if written > last else 0)
        monkeypatch.setattr(kept_files, "replace_file", replace_file)
        assert main(["twin", *first, f"t{last}"]) == 0
        for name in ("specimen.toml", "start.json", "registration.json", "answer.txt"):
            assert (tmp_path / f"t{last}" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    assert code == 0  # fewer writes than this


@pytest.mark.slow
def test_the_content_of_the_first_step_is_checked(quick, capsys, tmp_path):
    first = ["ni.epos", *ARGUMENTS, "-o", "t"]
    assert main(["twin", *first]) == 0
    facts, record = (json.loads((tmp_path / "t" / name).read_bytes()) for name in ("start.json", RECORD))
    best = facts["candidates"][0]
    wrong = ["", "[" * 100_000, "{}", "[]", '{"candidates": []}', "\udcff"]
    changes = (
        {"rolled": "x"},
        {"axis": [0, 0, 0]},
        {"scale": float("nan")},
        {"scale": 1e400},
        {"centre": [1]},
        {"score": 2},
    )
    wrong += [json.dumps(facts | {"candidates": [best | change]}) for change in changes]
    wrong += [json.dumps(facts | {"candidates": [{}]}), json.dumps(facts | {"simulated_radius": -1})]
    capsys.readouterr()
    for text in wrong:
        content = text.encode(errors="surrogateescape")
        (tmp_path / "t" / "start.json").write_bytes(content)
        record["files"]["start.json"] = hashlib.sha256(content).hexdigest()  # a folder that somebody made up
        (tmp_path / "t" / RECORD).write_text(json.dumps(record))
        assert "start.json" in refused(capsys, *first)
    for text in ("", "[]", "[" * 100_000, '{"made_from": [], "files": {}}', "\udcff"):
        (tmp_path / "t" / RECORD).write_bytes(text.encode(errors="surrogateescape"))
        assert RECORD in refused(capsys, *first)


def test_the_digest_is_recorded_before_the_file(tmp_path):
    one, two = "1" * 64, "2" * 64
    kept = KeptFiles(tmp_path / "t", {"FILE": one, "scales": (1.0, 2.0)}, ["a"])
    assert not kept.has("a") and not (tmp_path / "t").exists()
    kept.write({"a": b"1"})
    again = KeptFiles(tmp_path / "t", {"FILE": one, "scales": [1.0, 2.0]}, ["a"])
    assert again.has("a") and again.read("a") == b"1"
    (tmp_path / "t" / "a").rename(tmp_path / "elsewhere")
    (tmp_path / "t" / "a").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ae.FileError, match="a' was not made by this command"):
        again.has("a")
    (tmp_path / "elsewhere").replace(tmp_path / "t" / "a")
    again.forget("a")
    assert os.listdir(tmp_path / "t") == [RECORD]
    with pytest.raises(ae.FileError, match="another FILE"):
        KeptFiles(tmp_path / "t", {"FILE": two, "scales": [1.0, 2.0]}, ["a"])


@pytest.mark.slow
def test_ions_without_a_voltage_are_left_out_of_the_constants(tmp_path, indexed_once):
    ions = measurement(tmp_path / "ni.epos", voltages=(2000.0, 4000.0))
    best = indexed_once(ions, "Ni", scales=(56, 64), patterns=master_patterns("fcc")[:1]).best
    lens = ae.detection.LocalElectrode(distance=40e3, aperture=20e3, shank_angle=5.0)
    holes = ions.voltage.copy()
    holes[[100, 3000]] = 0.0, np.nan
    for options in ({}, {"lens": lens, "distance": 90.0}):
        shanks = [
            ae.fit.constants_of(ions.map(bins=128), best, each, **options).constants[-1]
            for each in (ions, replace(ions, voltage=holes))
        ]
        assert "shank" in shanks[0].name
        np.testing.assert_allclose(shanks[1].value, shanks[0].value, rtol=0.02)
        assert np.isfinite(shanks[0].value) or options


@pytest.mark.slow
def test_a_twin_of_the_command_is_one_of_python(quick, capsys, tmp_path):
    """The same folder for both, and nothing is done again; ions in memory are another measurement than their file."""
    assert main(["twin", "ni.epos", *ARGUMENTS, "--all-ions", "-o", "t"]) == 0
    said = capsys.readouterr().out.splitlines()
    quick.clear()
    made = ae.twin("ni.epos", "Ni", scales=(56, 64), folder="t")
    assert quick == ["run"] and capsys.readouterr().out == ""  # its notes go to `note`
    assert made.report() == Path("t/study/report.html") and f"wrote {made.report()}" == said[-1]
    assert made.registration == ae.Registration(1.0, 1.0, (0.0, 0.0))
    assert made.candidate.orientation.material.name == "Ni" and made.indexing.verdict in repr(made)
    assert quick == ["run", "index"]  # when it is asked for
    assert set(made.measurement.arguments) > {"atomic_volume", "efficiency"}
    assert [str(constant.name) in "\n".join(made.answer) for constant in made.measurement.constants].count(False) == 0
    shown = made._repr_html_()
    assert made.answer[0].partition(",")[0] in shown and "report.html" in shown
    for changed in ({"minutes": 5.0}, {"lens": "local-electrode"}, {"poles": [(3.0, 4.0)]}, {"efficiency": 0.3}):
        (name,) = changed
        with pytest.raises(ae.FileError, match=f"'t' was made with.* --{name.removesuffix('s')}"):
            ae.twin("ni.epos", "Ni", scales=(56, 64), folder="t", **changed)
    with pytest.raises(ae.FileError, match="another FILE"):
        ae.twin(ae.read("ni.epos"), "Ni", scales=(56, 64), folder="t")
    assert quick == ["run", "index"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")
def test_a_twin_is_that_of_the_file_without_strays(quick, tmp_path, monkeypatch):
    """Every tenth ion has a number for "no position", two are far away."""
    ions = ae.read("ni.epos")
    rows = np.union1d(np.arange(0, len(ions), 10), [1, 2])
    x, y = ions.x.copy(), ions.y.copy()
    x[rows], y[rows] = -90.0, -90.0
    x[1], y[2] = 3e29, -700.0
    kept = np.ones(len(ions), bool)
    kept[rows] = False
    files = {}
    for name, measured in (("with", replace(ions, x=x, y=y)), ("without", ions[kept])):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        ae.write("ni.epos", measured)
        assert main(["twin", "ni.epos", *ARGUMENTS, "--distance", "90", "-o", "t"]) == 0
        settings = Path("t/specimen.toml").read_text().splitlines()
        files[name] = [line for line in settings if not line.startswith("# SHA-256")]
        files[name] += [Path("t", each).read_text() for each in ("start.json", "registration.json", "answer.txt")]
    assert files["with"] == files["without"] and "radius at the first ions" in files["with"][-1]


def test_ions_of_the_peaks_are_not_all_ions(quick, capsys):
    """The command selects those of the crystal, the function takes all; and off is not the same as not given."""
    source = measured_source(make_parser("twin").parse_args(["twin", "ni.epos", *ARGUMENTS]))
    chosen = TwinOptions("Ni", 10.0, None, None, None, 0.5, (56.0, 64.0), (), (), None)
    how = {"threads": 1, "progress": False, "note": print, "command": ""}
    Twin(Path("t"), source, chosen, **how)._kept.write({"answer.txt": b"an answer"})
    with pytest.raises(ae.FileError, match=r"'t' was made with --all-ions = 'no, those of Ni', but True is asked for"):
        ae.twin("ni.epos", "Ni", scales=(56, 64), folder="t")
    assert "--partial = None, but True" in refused(capsys, "ni.epos", *ARGUMENTS, "-o", "t", "--partial")
    with pytest.raises(ae.FileError, match="--partial = None, but False"):
        Twin(Path("t"), replace(source, file=replace(source.file, partial=False)), chosen, **how)
    assert quick == []


@pytest.mark.slow
def test_a_folder_belongs_to_its_ions(quick):
    ions = ae.read("ni.epos")
    ae.twin(ions, "Ni", scales=(56, 64), folder="mine")
    ae.twin(replace(ions, source="another name"), "Ni", scales=(56, 64), folder="mine")
    assert quick == ["index", "run", "compare", "run"]
    heavier = replace(ions, mass_to_charge=ions.mass_to_charge + 1)
    for other in (ions[:-1], heavier, replace(ions, extent=(-40, 40, -40, 40)), ions.map(bins=64)):
        with pytest.raises(ae.FileError, match="another FILE"):
            ae.twin(other, "Ni", scales=(56, 64), folder="mine")
    density = replace(ions.map(bins=64), is_counts=False)  # the same numbers, without their noise
    ae.twin(ions.map(bins=64), "Ni", scales=(56, 64), folder="of_map")
    with pytest.raises(ae.FileError, match="another FILE"):
        ae.twin(density, "Ni", scales=(56, 64), folder="of_map")


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"minutes": 0}, "minutes must be a finite number [min] > 0, got 0"),
        ({"efficiency": 1.5}, "efficiency must be"),
        ({"measured": 3}, "path must be a file name, got 3"),
        ({"measured": "run.h5"}, "measured must be ions or a map, 'run.h5' contains a Run"),
    ],
)
def test_what_is_wrong_is_said_before_anything_is_done(quick, small_tip, changed, sentence):
    ae.Simulation(small_tip, seed=1).run(10, responses=False, progress=False).save("run.h5")
    arguments = {"measured": "ni.epos", "element": "Ni", "folder": "t"} | changed
    with pytest.raises(ValueError) as error:
        ae.twin(**arguments)
    assert sentence in str(error.value) and quick == [] and not os.path.exists("t")


@pytest.mark.slow
@pytest.mark.parametrize("verdict, given", [("alike", True), ("not alike", False)])
def test_constants_of_the_crystal_and_commands_are_given_only_for_its_maps(quick, capsys, monkeypatch, verdict, given):
    monkeypatch.setattr(_Study, "likeness", SimpleNamespace(verdict=verdict))
    monkeypatch.setattr(_Study, "no_energy", "" if given else "the maps are not alike")
    assert main(["twin", "ni.epos", "--element", "Ni", "--distance", "90", "-o", "t"]) == 0
    answer = open("t/answer.txt").read()
    for text in ("radius at the first ions", "scale of the map", "apt-evap reconstruct"):
        assert (text in answer) == given
    assert "voltage of the first ions" in answer  # measured, whatever the crystal is
    assert "report.html" in capsys.readouterr().out


@pytest.mark.slow
def test_a_radius_has_the_digits_of_its_field_factor(quick):
    assert main(["twin", "ni.epos", "--element", "Ni", "--distance", "90", "-o", "t"]) == 0
    (line,) = [line for line in open("t/answer.txt") if line.startswith("radius at the first ions")]
    value = line.partition(": ")[2].split()[0]
    assert len(value.strip("0").replace(".", "")) <= 2  # k_f is 2 to 8


def test_a_twin_takes_as_many_bins_as_the_run_has_ions_for():
    """The comparison warns of fewer ions in a bin, which the user has not chosen."""
    edges = np.linspace(-30, 30, 129)

    class Run:
        def __init__(self, ions):
            self.ions = ions

        def hits(self, emission):
            x, y = np.random.default_rng(0).uniform(-30, 30, (2, self.ions))
            return ae.Hits(x=x, y=y)

    here = ae.Registration(0.0, 1.0, (0.0, 0.0))
    for is_counts in (True, False):
        measured = ae.DetectorMap.from_array(np.ones((128, 128)), edges, edges, is_counts=is_counts)
        for merged in (True, False):
            assert bins_for_run(Run(40_000), measured, here, merged) is None
            bins = bins_for_run(Run(2_000), measured, here, merged)
            used = max(measured_map(measured, bins).values.shape) if merged else bins
            assert 24 <= used and 2_000 / used**2 >= FEWEST_IONS


def test_an_advice_on_the_settings_of_a_twin_is_a_note():
    told = []
    with warnings.catch_warnings(), advice_as_notes(told.append):
        warnings.simplefilter("always")
        warn("12 ions are inexact", ae.warnings.ResponseWarning, "use a smaller energy_limit")
    assert told == ["note: 12 ions are inexact"]
    with pytest.warns(ae.warnings.MapWarning, match="the map does not decide"):
        warn("the map does not decide", ae.warnings.MapWarning)
    with pytest.warns(ae.warnings.ResponseWarning, match="inexact: use"):  # elsewhere it is an advice
        warn("12 ions are inexact", ae.warnings.ResponseWarning, "use a smaller energy_limit")
