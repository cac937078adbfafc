"""Files of other programs in the shell: read by every command, and written by export."""

import json

import h5py
import numpy as np
import pytest
from ion_files import RNG, pyccapt_instrument, tapsim_table

import apt_evap as ae
from apt_evap.cli.main import main


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pyccapt_instrument("oxcart.h5", 400)
    (tmp_path / "results").write_bytes(tapsim_table(30)[0])
    (tmp_path / "a.rng").write_text(RNG)
    rng = np.random.default_rng(1)
    ions = ae.Hits(x=rng.normal(size=200), y=rng.normal(size=200), mass_to_charge=np.repeat([26.0, 14.0], 100))
    ae.write("ions.nxs", ions, elements=["Cr", "Si"])
    return tmp_path


@pytest.mark.parametrize(("name", "ions"), [("oxcart.h5", 400), ("results", 30), ("ions.nxs", 200)])
def test_info_and_map(folder, name, ions, capsys, blank_pictures):
    assert main(["info", name, "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["ions"] == ions and "x" in summary["columns"]
    assert main(["map", name, "--bins", "10", "-o", "map.png"]) == 0 and (folder / "map.png").exists()


def test_ranges(folder, capsys):
    assert main(["info", "ions.nxs", "--ranges", "a.rng", "--species", "Cr", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["ions"] == 100


@pytest.mark.filterwarnings("ignore:.*are they in mm:apt_evap.warnings.DataWarning")
def test_measured_ions_in_other_formats(folder, capsys):
    assert main(["export", "oxcart.h5", "-o", "oxcart.epos"]) == 0
    here, there = ae.read("oxcart.h5"), ae.read("oxcart.epos")
    np.testing.assert_array_equal(there.x, here.x.astype("f4"))
    assert there.multiplicity.tolist() == here.multiplicity.tolist()
    assert main(["export", "oxcart.h5", "-o", "oxcart.nxs", "--elements", "Al,Cu"]) == 0
    np.testing.assert_array_equal(ae.read("oxcart.nxs").x, here.x)
    with h5py.File("oxcart.nxs") as file:
        assert file["entry1/specimen/atom_types"].asstr()[()] == "Al, Cu"
    assert main(["export", "oxcart.h5", "-o", "oxcart.csv", "--ions", "0,10"]) == 0
    assert len((folder / "oxcart.csv").read_text().splitlines()) == 11
    form = ["--decimals", "2", "--separator", "semicolon", "--ions", "0,10", "--force"]
    assert main(["export", "oxcart.h5", "-o", "oxcart.csv", *form]) == 0
    assert ae.read("oxcart.csv").x.tolist() == np.round(here.x[:10], 2).tolist()
    assert main(["export", "oxcart.epos", "-o", "again.h5"]) == 0
    np.testing.assert_array_equal(ae.read("again.h5").x.astype("f4"), there.x)
    assert main(["export", "results", "-o", "again.tapsim"]) == 0 and len(ae.read("again.tapsim")) == 30
    capsys.readouterr()
    for command, message in (
        (["oxcart.h5", "-o", "b.nxs"], "--elements is missing, such as Si,O"),
        (["oxcart.h5", "-o", "b.epos", "--elements", "Al"], "--elements is for an .nxs file, got 'b.epos'"),
        (["oxcart.h5", "-o", "b.nxs", "--elements", "al"], "elements must be chemical symbols"),
        (["oxcart.h5", "-o", "b.epos", "--decimals", "2"], "--decimals is for a .csv file, got 'b.epos'"),
        (["oxcart.h5", "-o", "oxcart.h5", "--force"], "'oxcart.h5' is the file that is read: -o needs another name"),
        (["oxcart.h5", "-o", "b.epos", "--jitter", "1"], "--jitter needs a run (.h5), 'oxcart.h5' contains measured"),
    ):
        assert main(["export", *command]) == 2 and message in capsys.readouterr().err
        assert not list(folder.glob("b.*"))


def test_a_run_as_nxapm(folder, small_tip):
    run = ae.Simulation(small_tip, seed=1).run(40, progress=False)
    run.save("run.h5")
    assert main(["export", "run.h5", "-o", "run.nxs"]) == 0
    hits = run.hits(ae.Unperturbed())
    np.testing.assert_array_equal(ae.read("run.nxs").x, hits[hits.detected].x)


@pytest.mark.usefixtures("blank_pictures")
def test_reconstruct_an_instrument_file(folder):
    command = ["reconstruct", "oxcart.h5", "--element", "Al", "--distance", "110", "-o", "rec.pos", "--quiet"]
    assert main(command) == 0
    assert len(ae.read("rec.pos")) == 400


@pytest.mark.usefixtures("blank_pictures")
def test_species_of_a_run_are_known(tmp_path, monkeypatch, capsys, nickel):
    monkeypatch.chdir(tmp_path)
    tip = ae.Tip(nickel, apex_radius=5 * nickel.a, axis=(1, 1, 1), solutes={"Cu": 0.3}, seed=1)
    run = ae.Simulation(tip, seed=1).run(80, responses=False, progress=False)
    run.save("alloy.h5")
    hits = run.hits(ae.Unperturbed())
    copper = int((run.species == run.elements.index("Cu")).sum())
    assert 0 < copper < 80 and (hits.extra["element"] == np.array(run.elements)[run.species]).all()
    ae.write("alloy.xyz", hits)
    assert [line.split()[0] for line in (tmp_path / "alloy.xyz").read_text().splitlines()[2:]] == [
        run.elements[k] for k in run.species
    ]
    ae.write("alloy.csv", hits)
    titles, *rows = (line.split(",") for line in (tmp_path / "alloy.csv").read_text().splitlines())
    assert sum(row[titles.index("element")] == "Cu" for row in rows) == copper
    # in the shell, without ranges
    assert main(["info", "alloy.h5", "--species", "Cu", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["ions"] == copper
    assert main(["map", "alloy.h5", "--species", "Cu", "--bins", "8", "-o", "cu.png", "--json"]) == 0
    (drawn,) = json.loads(capsys.readouterr().out)["maps"]
    assert "Cu" in drawn["title"] and drawn["ions"] <= copper
    for command in (["alloy.h5", "--species", "Al"], ["alloy.h5", "--ranges", "r.rrng"]):
        assert main(["map", *command, "-o", "no.png"]) == 2 and not (tmp_path / "no.png").exists()


def test_measured_ions_need_ranges_for_species(folder, capsys):
    assert main(["map", "ions.nxs", "--species", "Cr", "-o", "no.png"]) == 2
    assert "--ranges" in capsys.readouterr().err
    assert main(["map", "ions.nxs", "--ranges", "a.rng", "--species", "Cr", "-o", "cr.png", "--json"]) == 0
    assert "Cr" in json.loads(capsys.readouterr().out)["maps"][0]["title"]


def test_an_export_says_what_it_leaves_out(folder, small_tip, capsys):
    ae.Simulation(small_tip, seed=1).run(20, progress=False).save("run.h5")
    capsys.readouterr()
    assert main(["export", "run.h5", "-o", "run.pos", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert {"x", "y", "outcome", "element"} <= set(told["left_out"]) and told["zeros"] == []
    assert main(["export", "run.h5", "-o", "run.epos"]) == 0
    line = capsys.readouterr().out
    assert ", without " in line and "element" in line and ", with zeros for " in line and "pulse_voltage" in line
    assert main(["export", "oxcart.h5", "-o", "oxcart.epos"]) == 0
    out, err = capsys.readouterr()
    assert "without the columns start_counter" in err and "with zeros for positions, mass_to_charge" in out


@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")
def test_units_of_a_file_in_the_shell(folder, capsys):
    ions = ae.Hits(x=[-3.0, 3.0], y=[-3.0, 3.0], voltage=[50.0, 60.0], pulse_voltage=[1.0, 2.0])
    ae.write("cm.epos", ions)
    assert main(["info", "cm.epos", "--unit", "cm", "--voltage-unit", "V", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["columns"]
    assert told["x"] == [-30, 30] and told["voltage"] == [50, 60]
    assert main(["info", "cm.epos"]) == 0 and "(--voltage-unit V) reads them in V" in capsys.readouterr().err
    for arguments, message in ((["--unit", "inch"], "--unit"), (["--format", "pos", "--unit", "cm"], "cm.epos")):
        assert main(["info", "cm.epos", *arguments]) == 2 and message in capsys.readouterr().err
