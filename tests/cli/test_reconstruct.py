"""`apt-evap reconstruct`, of measured ions and of a run."""

import json
import re
from argparse import Namespace
from types import SimpleNamespace

import numpy as np
import pytest
from rough import ROUGH

import apt_evap as ae
from apt_evap.cli import reconstruct
from apt_evap.cli.main import main
from apt_evap.fit import crystal_constants
from apt_evap.fit.crystal_constants import CrystalConstants, PoleSpacing
from apt_evap.reconstruction.constants import run_constants
from apt_evap.reconstruction.evolving import PhaseField
from apt_evap.reconstruction.origins import OriginTable
from apt_evap.reconstruction.phase_size import PhaseSize
from apt_evap.reconstruction.specimen_check import SpecimenCheck


@pytest.fixture
def measured(tmp_path, monkeypatch, rng):
    monkeypatch.chdir(tmp_path)
    radius, azimuth = 35 * np.sqrt(rng.random(2000)), 2 * np.pi * rng.random(2000)
    hits = ae.Hits(
        x=radius * np.cos(azimuth),
        y=radius * np.sin(azimuth),
        voltage=np.linspace(3000.0, 3100.0, 2000),
        mass_to_charge=np.full(2000, 29.0),
        positions=np.zeros((2000, 3)),
        pulse_id=np.arange(2000),
    )
    ae.write("ni.epos", hits)
    return ae.read("ni.epos")


@pytest.mark.usefixtures("rough_layout")
def test_measured_ions(measured, nickel, tmp_path, capsys):
    command = ["reconstruct", "ni.epos", "--element", "Ni", "--distance", "90", "--efficiency", "0.6"]
    assert main([*command, "--compression", "1.6"]) == 0
    told = capsys.readouterr().out
    assert "<Reconstruction: 2,000 ions, " in told and "wrote 2,000 ions to ni_reconstructed.pos" in told
    assert (tmp_path / "ni_reconstructed.png").stat().st_size > 10_000  # it is drawn without being asked
    known = {"atomic_volume": nickel.a**3 / 4, "distance": 90.0, "efficiency": 0.6, "compression": 1.6}
    expected = ae.reconstruct(measured, **known, evaporation_field=35.0)
    assert ae.read("ni_reconstructed.pos").positions == pytest.approx(expected.positions, rel=1e-6, abs=1e-5)  # float32
    ranges = "[Ions]\nNumber=1\nIon1=Ni\n[Ranges]\nNumber=1\nRange1=28 30 Vol:0.01 Ni:1 Color:FF0000\n"
    (tmp_path / "ni.rrng").write_text(ranges)
    assert main([*command, "-o", "b.pos", "--ranges", "ni.rrng", "--picture", "b.png"]) == 0
    assert "wrote b.png" in capsys.readouterr().out and (tmp_path / "b.png").stat().st_size > 10_000
    assert main(command) == 2 and "'ni_reconstructed.pos' exists: --force" in capsys.readouterr().err
    # a table without shifts changes nothing but the direction of z
    places = np.random.default_rng(1).random((500, 2)) * 2 - 1
    OriginTable(places, np.zeros((500, 2))).save("table.npz")
    corrected = ["--compression", "1.6", "--origins", "table.npz", "--frame", "specimen", "-o", "corrected.pos"]
    assert main([*command, *corrected]) == 0 and capsys.readouterr()
    assert ae.read("corrected.pos").positions == pytest.approx(expected.specimen_positions, rel=1e-6, abs=1e-5)
    shank = ["--radius", "shank", "--initial-radius", "30", "--shank-angle", "5", "--protocol", "bas", "--json"]
    assert main([*command, *shank, "--projection", "equidistant", "--ions", "0,500", "-o", "shank.epos"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["ions"] == 500 and result["settings"]["shank_angle"] == 5.0 and "errors" not in result
    assert len(ae.read("shank.epos")) == 500


def test_constants_of_the_crystal(measured, monkeypatch, capsys):
    poles = (PoleSpacing((0, 0, 2), 1.01, 0.004, SimpleNamespace(found=True), True),)
    constants = {"compression": 1.4, "projection": "compressed", "field_factor": 3.1}
    found, given = CrystalConstants(constants, np.eye(3) / 1000, poles, None), {}
    monkeypatch.setattr(crystal_constants, "constants_of_crystal", lambda hits, **more: given.update(more) or found)
    monkeypatch.setattr(reconstruct, "_surface", lambda *_: {"shape": "cap", "ranges": None, "twin": None})
    command = ["reconstruct", "ni.epos", "--distance", "90", "--calibrate", "--force", "--ions", "0,40"]
    assert main([*command, "--element", "Ni", "--field-factor", "3.5"]) == 0
    assert given["shape"] == "cap" and given["field_factor"] == 3.5 and "twin" not in given
    told = capsys.readouterr().out
    assert "compression 1.400 ± 3.2%, field factor 3.1 ± 3.2%, correlation of compression and radius 0.00; " in told
    assert "field_factor 3.1, evaporation_field 35, compression 1.4" in told and "assumed efficiency" in told
    assert main([*command, "--element", "Ni", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["calibrated"]["constants"] == constants and result["settings"]["projection"] == "compressed"
    assert result["calibrated"]["poles"] == [{"pole": [0, 0, 2], "ratio": 1.01, "error": 0.004, "is_used": True}]
    assert main([*command, "--atomic-volume", "0.011", "--evaporation-field", "35"]) == 2
    assert "--calibrate needs --element, got none" in capsys.readouterr().err
    assert main([*command, "--element", "Ni", "--compression", "1.4"]) == 2
    assert "--calibrate finds a compression: --compression must be left out, got 1.4" in capsys.readouterr().err


def test_a_run_is_compared_with_its_sites(tmp_path, monkeypatch, small_tip, nickel, capsys):
    monkeypatch.chdir(tmp_path)
    ae.Simulation(small_tip, seed=1).run(60, [ae.Unperturbed()], responses=False, progress=False).save("ni.h5")
    command = ["reconstruct", "ni.h5", "--real-units", "--element", "Ni", "--field-factor", "1.3"]
    command += ["--detector-radius", "80", "-o", "ni.pos"]
    assert main([word for word in command if word != "--real-units"]) == 2
    assert (
        "the field factor needs a run in real units: use run.at_evaporation_field(), or --real-units"
        in capsys.readouterr().err
    )
    assert main([*command, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["settings"]["distance"] == 100.0 and result["settings"]["efficiency"] == 1.0
    assert "efficiency" not in {one["name"] for one in result["assumed"]}  # all that reach the detector are in a run
    assert result["settings"]["atomic_volume"] == pytest.approx(nickel.a**3 / 4)
    assert 0 < result["errors"]["lateral_rms"] < 2.1  # the radius of the tip
    # 60 ions are too few for a sphere and for a compression: the radius of the tip, and 1.5
    assert main(["reconstruct", "ni.h5", "--real-units", "--detector-radius", "80", "-o", "few.pos", "--json"]) == 0
    few = json.loads(capsys.readouterr().out)["settings"]
    assert few["compression"] == 1.5 and few["field_factor"] < 2
    assert main([*command, "--force"]) == 0 and "RMS errors: " in capsys.readouterr().out
    # sizes count on the scatter of the emission
    rolled, plain = [], ae.Run.hits
    monkeypatch.setattr(ae.Run, "hits", lambda run, _: plain(run, ae.Unperturbed()))
    monkeypatch.setattr(reconstruct, "_tell_check", lambda *arguments: rolled.append(arguments[-2]))
    for emission in ("Unperturbed", "RollUp:0.2,0.1"):
        words = ["--shape", "evolving", "--check", "--perturbation", emission]
        assert main([*command, "--force", *words]) == 0
    assert rolled == [False, True]


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ("--element Ni", "'ni.epos' lacks constants, start with --distance 90 (mm, of straight flights"),
        ("", "--element NAME (the main element; or --atomic-volume"),
        ("--distance 90", "start with --element NAME"),
        ("--distance 90 --element Ni --radius apex", "--radius must be voltage, shank or a number [nm], got 'apex'"),
        ("--distance 90 --element Ni --radius -1", "--radius must be a finite number [nm] > 0, got -1.0"),
        ("--distance 90 --element Nix", "--element"),
        ("--distance 90 --atomic-volume 0.01", "start with --evaporation-field VALUE (that of the main element [V/nm]"),
        ("--distance 90 --element Ni --real-units", "--real-units needs a run (.h5)"),
        ("--distance 90 --element Ni -o ni.png", "format of 'ni.png' must be one of"),
        ("--distance 90 --element Ni --protocol geiser", "invalid choice: 'geiser'"),
        ("--distance -1 --element Ni", "distance must be a finite number [mm] > 0, got -1.0"),
        ("--distance far --element Ni", "--distance: invalid float value: 'far'"),
        ("--distance 90 --element Ni --efficiency 57", "efficiency must be a finite number > 0 and <= 1, got 57.0"),
        ("--distance 90 --element Ni --smoothing 1.5", "--smoothing: must be an integer >= 1, got '1.5'"),
        ("--distance 90 --element Ni --shank-angle 45", "shank_angle must be a finite number [degrees] >= 0"),
        ("--distance 90 --element Ni --check", "--check needs --shape evolving and --element, got --shape cap"),
        ("--distance 90 --element Ni --twin ni.h5", "--twin needs --shape evolving, got --shape cap"),
        ("--distance 90 --element Ni --shape evolving --twin ni.h5", "'ni.h5'"),
        ("--distance 90 --element Ni --shape evolving --check 0,1", "--check: axis must be three numbers such as"),
        ("--distance 90 --element Ni --shape evolving --check up", "--check: must be numbers separated by commas"),
    ],
)
def test_wrong_options_are_one_sentence(measured, capsys, tmp_path, options, sentence):
    assert main(["reconstruct", "ni.epos", *options.split()]) == 2
    told = capsys.readouterr().err
    assert sentence in told and told.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["ni.epos"]


@pytest.mark.usefixtures("blank_pictures")
def test_all_that_a_file_lacks_is_named_at_once_and_is_enough(measured, tmp_path, rng, capsys):
    """A file as exported, without voltages and with positions of its own, of nickel by its isotopes."""
    masses = rng.choice([57.935, 59.931, 61.928], 2000, p=[0.70, 0.265, 0.035])
    positions = rng.random((2000, 3)) * [40.0, 39.0, 75.0]
    lateral = {"x": measured.x, "y": measured.y, "pulse_id": np.arange(2000)}
    spread = masses * rng.normal(1, 3e-4, 2000)
    ae.write("flat.epos", ae.Hits(**lateral, mass_to_charge=spread, positions=positions))
    assert main(["reconstruct", "flat.epos"]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and "--radius voltage" not in told
    options = re.findall(r"(--distance|--element|--radius) ([\w.]+)", told)
    assert options == [("--distance", "90"), ("--element", "Ni"), ("--radius", "30")]
    assert "for it has no voltages" in told and "--initial-radius 30 --shank-angle 5" in told
    assert main(["reconstruct", "flat.epos", *(word for option in options for word in option)]) == 0
    told = capsys.readouterr()
    size = " x ".join(f"{length:.1f}" for length in np.ptp(np.float32(positions), axis=0))
    assert f"the positions in 'flat.epos', {size} nm, are not used" in told.err
    assert "assumed efficiency 1 (usual is 0.57 of straight flights" in told.out
    ae.write("flat.pos", ae.Hits(mass_to_charge=spread, positions=positions))
    assert (
        main(["reconstruct", "flat.pos", "-o", "other.pos"]) == 2
    )  # the file cannot be reconstructed with any constants
    told = capsys.readouterr().err.splitlines()[-1]
    assert "'flat.pos' has no detector coordinates x and y" in told and "its own positions are what planes" in told
    assert main(["reconstruct", "ni.epos", "--element", "Ni", "--distance", "90"]) == 0
    assert "positions" not in capsys.readouterr().err  # all at one place: none


@pytest.fixture(scope="session")
def radius5(made_once, tmp_path_factory):
    """A run of 1,200 ions of a tip with a radius of 5 nm, and its file."""
    tip = ae.Tip("Ni", apex_radius=5.0, axis=(1, 1, 1), shank_length=5.0, depth=1.5)
    run = made_once(tip, 1200, seed=1, **ROUGH)
    path = tmp_path_factory.mktemp("radius") / "r5.h5"
    run.save(path)
    return run, path


@pytest.mark.slow
def test_the_constants_of_a_run_are_its_own(radius5, tmp_path, monkeypatch, capsys):
    run, path = radius5
    monkeypatch.chdir(tmp_path)
    for k, reference in enumerate(("cap", "site")):
        assert main(["reconstruct", str(path), "--real-units", reference, "-o", f"{k}.pos", "--json"]) == 0
        result = json.loads(capsys.readouterr().out)
        real = run.at_evaporation_field(field_reference=reference)
        settings = result["settings"]
        radii = real.voltages / (settings["field_factor"] * settings["evaporation_field"])
        assert np.median(radii) == pytest.approx(5.0, rel=0.02)  # the cap of the first ions, between its terraces
        assert settings["compression"] == pytest.approx(ae.simulation.image_compression(run).compression)
        assert settings["projection"] == "compressed" and settings["atomic_volume"] == pytest.approx(0.352**3 / 4)
        # measured 0.19 and 0.08 nm; with 3.3 and 1.5 the radius is 1.7 nm and its errors are larger
        assert result["errors"]["lateral_rms"] < 0.25 and result["errors"]["depth_rms"] < 0.12
    # options win
    command = ["reconstruct", str(path), "--real-units", "--field-factor", "3", "--compression", "1.2", "-o", "2.pos"]
    assert main([*command, "--evaporation-field", "30", "--distance", "120", "--json"]) == 0
    settings = json.loads(capsys.readouterr().out)["settings"]
    assert (settings["field_factor"], settings["compression"]) == (3.0, 1.2)
    assert (settings["evaporation_field"], settings["distance"]) == (30.0, 120.0)


def test_run_constants_follow_the_field_and_need_real_units(radius5):
    run, _ = radius5
    real = run.at_evaporation_field()
    own, other = run_constants(real), run_constants(real, evaporation_field=2 * 35.0)
    assert own["evaporation_field"] == pytest.approx(35.0)
    assert other["field_factor"] == pytest.approx(own["field_factor"] / 2)
    reported = run_constants(run.at_evaporation_field(field_factor=3.3))
    assert reported["field_factor"] == pytest.approx(3.3, rel=0.02)  # R at the first ion against the fitted cap
    rebuilt = ae.reconstruct(real.hits(ae.Unperturbed()), **own)
    assert np.median(rebuilt.radii) == pytest.approx(5.0, rel=0.02)
    with pytest.raises(ValueError, match="run"):
        run_constants(run)


def test_an_unknown_element_names_the_options_of_the_shell(measured, capsys):
    assert main(["reconstruct", "ni.epos", "--element", "Ca", "--distance", "90"]) == 2
    told = capsys.readouterr().err
    assert all(name in told for name in ("--element", "'Ca'", "--atomic-volume", "--evaporation-field"))
    assert "Material(" not in told and told.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize("ions", [1, 2, 5, 49, 50])
def test_few_ions_are_reconstructed(measured, tmp_path, capsys, ions):
    """A picture that nobody asked for does not stop them; one that is asked for is refused before a file is written."""
    command = ["reconstruct", "ni.epos", "--element", "Ni", "--distance", "90", "--ions", f"0,{ions}", "-o", "few.pos"]
    assert main(command) == 0
    assert len(ae.read("few.pos")) == ions and (tmp_path / "few.png").exists() == (ions == 50)
    if ions < 50:
        capsys.readouterr()
        assert main([*command[:-1], "other.pos", "--picture", "p.png"]) == 2
        assert "at least 50 ions" in capsys.readouterr().err and not (tmp_path / "other.pos").exists()


def test_the_specimen_of_a_check_has_crystal_and_axis_of_the_options_or_of_the_run():
    run = ae.Orientation("Al", (0, 1, 2), 0.0)
    for check, settings, crystal, name, axis in (
        ((), {}, run, "Al", (0, 1, 2)),
        ((1, 1, 1), {"element": "Ni"}, run, "Ni", (1, 1, 1)),
        ((), {"element": "Ni"}, None, "Ni", (0, 0, 1)),
    ):
        material, found = reconstruct._crystal(Namespace(shape="evolving", check=check), settings, crystal)
        assert (material.name, found) == (name, axis)


def test_a_field_that_was_not_found_is_no_number(capsys):
    found = PhaseField("Cu", 1.2, 0.03, 90, 0.02, 0.4, 12.0)
    missing = PhaseField("label 1", np.nan, np.nan, 90, 0.0, 1.0, np.nan)
    told = Namespace(verdict="as told", phases=(found, missing), history=None)
    reconstruct._tell_surface(Namespace(quiet=False, json=False), told)
    assert capsys.readouterr().out.splitlines() == [
        "as told",
        "evaporation field of Cu, 40.0% in 2.0%: 1.200 ± 0.030 of the matrix",
        "evaporation field of label 1: not found",
    ]


@pytest.mark.slow  # a minute: the example, and two simulations of what is found in it
def test_the_precipitate_of_the_example_is_found_measured_and_confirmed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["run", "precipitate", "-o", "p.h5", "--quiet"]) == 0
    capsys.readouterr()
    assert main(["reconstruct", "p.h5", "--shape", "evolving", "--solutes", "Cu", "--check", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    (phase,) = found["surface"]["phases"]
    assert abs(phase["ratio"] - 23 / 19) < 2 * phase["error"] < 0.12
    check = found["check"]
    assert check["axis"] == [0, 0, 1] and check["confirmed"] and 0.4 < check["explained"] < 1
    run = ae.read("p.h5")
    sites = run.hits(run.first_perturbation).positions
    sphere = sites[((sites - (1.0, 0.0, 4.9)) ** 2).sum(axis=1) < 1.2**2]  # what left of it
    axes = np.sqrt(5) * sphere.std(axis=0)
    (size,) = check["sizes"]
    assert abs(size["lateral"] - axes[:2].mean()) < 2 * size["lateral_error"] < 0.3
    assert abs(size["depth"] - axes[2]) < 2 * size["depth_error"] < 0.3
    assert check["errors_of_sizes"]["scatter_along"] == 0.174 and check["errors_of_sizes"]["radius"] == 0.05


def test_the_errors_of_sizes_are_said_with_what_they_count_on(monkeypatch, capsys):
    size, told = PhaseSize("Cu", 99, 1.0, 0.7, 0.1, 0.1, 0.0), []
    checked = SpecimenCheck(*np.ones((3, 4, 2, 2)), explained=0.6, error=0.04, ions=9)
    monkeypatch.setattr("apt_evap.reconstruction.phase_size.phase_sizes", lambda *given: told.append(given) or [size])
    monkeypatch.setattr("apt_evap.reconstruction.specimen_check.check_specimen", lambda *_, **__: checked)
    found = Namespace(phases=[Namespace(error=0.03)])
    reconstruct._tell_check(Namespace(json=False, quiet=False), found, ae.material("Al"), (0, 0, 1), False)
    out = capsys.readouterr().out
    assert "count on compression 5%, radius 5%, efficiency 5%" in out and "0.17 nm, as of ions at rest" in out
    assert "those of ions that roll scatter by 0.75 nm" in out
    numbers = reconstruct._tell_check(
        Namespace(json=False, quiet=False), found, ae.material("Al"), (0, 0, 1), False, rolled=True
    )
    assert "0.75 nm, as of ions that roll (Al" in capsys.readouterr().out
    assert numbers["errors_of_sizes"]["scatter_across"] == 0.078
    assert told == [(found, None, (0.174, 0.057)), (found, None, (0.749, 0.078))]
    # constants that the crystal has determined, with their correlations
    calibrated = Namespace(covariance=np.diag([0.035, 0.012, 0.05]) ** 2)
    reconstruct._tell_check(
        Namespace(json=False, quiet=False), found, ae.material("Al"), (0, 0, 1), False, calibrated=calibrated
    )
    assert "count on compression 3.5%, radius 1.2%, efficiency 5%" in capsys.readouterr().out
    assert told[-1][1] is calibrated.covariance
