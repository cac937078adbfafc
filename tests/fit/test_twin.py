"""`apt-evap twin`: what is kept in its folder belongs to one file and one set of options."""

import hashlib
import json
import os
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.cli.main import main
from apt_evap.maps.indexing.master_pattern import master_patterns
from apt_evap.studies.workflows import kept_files, twin_of_map
from apt_evap.studies.workflows.kept_files import RECORD, KeptFiles

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


class _Likeness:
    """In the place of a study: what the command asks it for."""

    def lines(self):
        return ["the maps are alike"]


@pytest.fixture
def quick(tmp_path, monkeypatch):
    """The command with a simulation and a comparison that only write files; the calls of both are counted."""
    calls = []
    made = {}

    def simulate(settings, output, **_):
        calls.append("run")
        output.write_text("a run")
        return SimpleNamespace(interrupted=False)

    def compare(run, measured, folder, *_, **__):
        calls.append("compare")
        folder.mkdir(exist_ok=True)
        (folder / "report.html").write_text("a report")
        return _Likeness()

    class Run:
        def hits(self, emission):
            return emission

    def index(measured, material, **options):
        calls.append("index")
        key = (measured.values.tobytes(), material, repr(options))
        if key not in made:
            made[key] = index_map(measured, material, **options)
        return made[key]

    index_map = twin_of_map.index
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(twin_of_map, "simulate", simulate)
    monkeypatch.setattr(twin_of_map, "compare", compare)
    monkeypatch.setattr(twin_of_map, "load", lambda path: Run())
    monkeypatch.setattr(twin_of_map, "is_run", lambda path: path.read_text() == "a run")
    monkeypatch.setattr(twin_of_map, "index", index)
    monkeypatch.setattr(twin_of_map, "_registered", lambda *_: ae.Registration(1.0, 1.0, (0.0, 0.0)))
    measurement("ni.epos")
    return calls


def refused(capsys, *arguments):
    """Message of a command that is refused."""
    assert main(["twin", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


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


def test_a_name_with_a_dash_is_not_an_option(quick, capsys, tmp_path):
    os.rename("ni.epos", "-ni.epos")
    assert main(["twin", *ARGUMENTS, "--distance", "90", "--", "-ni.epos"]) == 0
    assert (tmp_path / "-ni_twin" / "answer.txt").exists()
    (command,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("reconstruct with")]
    assert " ./-ni.epos " in command


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
    kept = KeptFiles(tmp_path / "t", {"FILE": "1"}, {"scales": (1.0, 2.0)}, ["a"])
    assert not kept.has("a") and not (tmp_path / "t").exists()
    kept.write({"a": b"1"})
    again = KeptFiles(tmp_path / "t", {"FILE": "1"}, {"scales": [1.0, 2.0]}, ["a"])
    assert again.has("a") and again.read("a") == b"1"
    again.forget("a")
    assert os.listdir(tmp_path / "t") == [RECORD]
    with pytest.raises(ae.FileError, match="another FILE"):
        KeptFiles(tmp_path / "t", {"FILE": "2"}, {"scales": [1.0, 2.0]}, ["a"])


def test_ions_without_a_voltage_are_left_out_of_the_constants(tmp_path):
    ions = measurement(tmp_path / "ni.epos", voltages=(2000.0, 4000.0))
    best = ae.index(ions, "Ni", scales=(56, 64), patterns=master_patterns("fcc")[:1]).best
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
