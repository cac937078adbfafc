"""Figures of the paper: made once, with captions from their numbers, and refused in one sentence."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.cli.main import main
from apt_evap.workflows import figures_of_paper
from apt_evap.workflows.figures_of_paper import AGREES, DIFFERS, OPEN, PaperClaim, PaperFigure, paper
from apt_evap.workflows.paper_runs import ALUMINIUM, NICKEL, PaperSize

TINY = PaperSize("quick", 8, 10, 1200, 1200, 24, 3, 1.0)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(figures_of_paper, "QUICK", TINY)
    return tmp_path


def made(number, **options):
    lines = []
    (figure,) = paper("out", [number], progress=lambda: False, note=lines.append, threads=1, **options)
    content = json.loads(Path(f"out/figure{number}.json").read_text())
    assert content["caption"] == figure.caption == Path(f"out/figure{number}.txt").read_text()
    return figure, content["numbers"], lines


@pytest.mark.slow
def test_chosen_atoms_and_what_their_caption_says(folder):
    figure, numbers, _ = made(2)
    assert Path("out/figure2.png").stat().st_size > 50_000 and Path("out/figures.html").stat().st_size > 50_000
    fields = np.array(numbers["Ni[111]"]["field [V/nm]"])
    neighbours = numbers["Ni[111]"]["neighbours"]
    assert fields[neighbours.index(6)] > fields[neighbours.index(8)]  # kinks stick out
    jump = np.array(numbers["Ni[111]"]["roll [mm]"]) / np.array(numbers["Ni[111]"]["lateral 0.5 eV [mm]"])
    # the caption follows its numbers
    assert figure.claims[2].verdict == (AGREES if jump.min() < 1 < jump.max() else DIFFERS)
    assert f"{jump.min():.2g} to {jump.max():.2g} of it" in figure.claims[2].here


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::apt_evap.warnings.AptWarning")  # of few ions and small specimens
def test_runs_are_made_once_and_shared(folder):
    figure, numbers, lines = made(6)
    assert lines[0].startswith("quick size, R = 8 a: about 1 minute of one processor (2 runs")
    run, twin = (ae.load(f"out/runs/Ni_{role}_R8a.h5") for role in ("run", "twin"))
    # two specimens: another origin of the lattice, other random numbers
    assert run.settings["tip"]["offset_seed"] != twin.settings["tip"]["offset_seed"] and run.seed != twin.seed
    assert [claim.verdict for claim in figure.claims] == [AGREES, DIFFERS]  # nickel that rolled looks like no other
    assert numbers["roll-up"]["gain"]["value"] > 0.5
    before = {path.name: path.stat().st_mtime_ns for path in Path("out/runs").glob("*.h5")}
    with pytest.raises(ValueError, match="profile"):  # that few ions show no line
        made(7)
    assert {name: Path(f"out/runs/{name}").stat().st_mtime_ns for name in before} == before
    blunt = ae.load("out/runs/Ni_blunt_R10a.h5")
    assert len(blunt) == round(1200 * (10 / 8) ** 3) and blunt.responses is None  # one depth over the radius


@pytest.mark.slow
def test_lines_of_one_run_are_equally_wide(run20):
    figure, described = figures_of_paper._figure_7(run20, run20, (20, 30))
    assert [claim.verdict for claim in described.claims] == [AGREES, AGREES]
    assert described.numbers["enhanced"]["chi_square"] == 0 and described.numbers["enhanced"]["ratio"] == 1
    # the rectangles are where the lines are: widths of R = 20 a on a detector at 100 mm
    assert all(8 < described.numbers[kind]["lines"]["R = 20 a"]["width"] < 18 for kind in ("depleted", "enhanced"))
    assert len(figure.axes) >= 6


def test_the_energies_of_the_paper():
    """0.3 ± 0.0944 eV and 0.200 ± 0.123 eV after the truncation, as the paper says."""
    for case, mean, deviation in ((ALUMINIUM, 0.3, 0.0944), (NICKEL, 0.200, 0.123)):
        energy = case.perturbation.energy
        # half of the last digit that is printed
        assert energy.true_mean == pytest.approx(mean, abs=5e-4)
        assert energy.true_standard_deviation == pytest.approx(deviation, abs=5e-4)


def test_a_caption_has_claims_and_limits():
    claims = (PaperClaim("lines are wide.", AGREES, "1 mm."), PaperClaim("0.1 eV.", OPEN, "hidden."))
    text = PaperFigure(5, "Maps.", claims, "One specimen.", {}).caption
    assert text.split("\n\n") == [
        "Figure 5. Maps.", "Agrees: lines are wide. Here: 1 mm.", "Cannot be shown: 0.1 eV. Here: hidden.",
        "One specimen.\n",
    ]  # fmt: skip


def test_a_map_that_is_not_alike_judges_no_claim():
    study = SimpleNamespace(
        likeness=SimpleNamespace(verdict="doubtful"), lines=lambda: ["doubtful that maps are alike"]
    )
    claim = figures_of_paper._judged("0.155 eV.", True, "0.3 eV.", study)
    assert (claim.verdict, claim.here) == (OPEN, "0.3 eV. doubtful that maps are alike.")
    study.likeness.verdict = "alike"
    assert figures_of_paper._judged("0.155 eV.", True, "0.3 eV.", study).verdict == AGREES


def test_what_is_refused(folder, capsys):
    """One sentence, and nothing is written."""
    Path("full").mkdir()
    Path("full/thesis.txt").write_text("mine")
    np.savez("map.npz", a=np.zeros(3))
    ae.write("masses.epos", ae.Hits(mass_to_charge=np.full(50, 29.0)))
    for words, message in (
        ("--figure 1", "figure must be one of 2, 3, 4, 5, 6, 7, got 1"),
        ("--figure 8 --figure 3", "figure must be one of 2, 3, 4, 5, 6, 7, got 8"),
        ("-o full --figure 2", "'full' is not empty and was not made by apt-evap paper"),
        ("--measured masses.epos --element Ni", "no detector coordinates"),
        ("--measured masses.epos --element Ni --figure 7", "figure must be one of 3, 4, 5, 6, got 7"),
        ("--measured masses.epos", "--measured FILE and --element E belong together"),
        ("--element Ni", "--measured FILE and --element E belong together"),
        ("--measured none.epos --element Ni", "none.epos"),
        ("--measured map.npz --element Ni", "map.npz"),
    ):
        before = sorted(path.name for path in folder.rglob("*"))
        assert main(["paper", *words.split()]) == 2, words
        error = capsys.readouterr().err
        assert message in error and error.count("apt-evap: error: ") == 1, error
        assert sorted(path.name for path in folder.rglob("*")) == before, words


def test_a_folder_has_one_size(folder, capsys):
    Path("paper").mkdir()
    Path("paper/paper.json").write_text('{"size": "full"}\n')
    assert main(["paper", "--figure", "2"]) == 2
    assert (
        "'paper' was made with size = 'full', but 'quick' is asked for: give another folder" in capsys.readouterr().err
    )
