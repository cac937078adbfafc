"""Commands and the explorer give the answer of the file without strays."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rough import ROUGH

import apt_evap as ae
from apt_evap.cli._explorer_of_files import explorer_and_view
from apt_evap.cli.main import main
from apt_evap.cli.parser import make_parser

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::apt_evap.warnings.AptWarning")]
OUT = ["-o", "a.png"]
QUICK = ["--means", "0.1,0.2", "--relative-spreads", "0.5", "--replicas", "1", "--resamples", "2", "--bins", "24"]


@pytest.fixture(scope="session")
def made(small_tip, made_once, tmp_path_factory):
    """A run, and folders with the same ions of another one: with strays, and without these ions."""
    folder = tmp_path_factory.mktemp("strays")
    run = made_once(small_tip, 2000, seed=1, **ROUGH)
    hits = replace(run, seed=2).hits(ae.RollUp(ae.TruncatedNormal(0.2, 0.1))).within_circle(60.0)
    n = len(hits)
    random = np.random.default_rng(4)
    mass = np.where(random.random(n) < 0.7, 28.97, random.uniform(5, 60, n)) * random.normal(1, 3e-4, n)
    ions = ae.Hits(
        x=hits.x, y=hits.y, mass_to_charge=mass, voltage=np.linspace(3000, 4000, n), pulse_voltage=np.zeros(n),
        time_of_flight=np.full(n, 500.0), positions=np.zeros((n, 3)), pulse_id=np.arange(n),
        multiplicity=np.ones(n, int),
    )  # fmt: skip
    rows = np.arange(3, n, 10)
    x, y = ions.x.copy(), ions.y.copy()
    x[rows], y[rows] = -190.0, -190.0
    x[rows[0]], y[rows[1]] = 3e29, 700.0
    kept = np.ones(n, bool)
    kept[rows] = False
    run.save(folder / "run.h5")
    for name, measured in (("with", replace(ions, x=x, y=y)), ("without", ions[kept])):
        (folder / name).mkdir()
        ae.write(folder / name / "a.epos", measured)
    return folder


@pytest.fixture
def both(made, monkeypatch):
    def both(answer):
        """What a function returns in the two folders."""
        answers = []
        for name in ("with", "without"):
            monkeypatch.chdir(made / name)
            answers.append(answer())
        return answers

    return both


@pytest.mark.parametrize(
    ("words", "file"),
    [
        (["map", "a.epos", *OUT], "a.png"),
        (["spectrum", "a.epos", "--element", "Ni", *OUT], "a.png"),
        (["composition", "a.epos", "--element", "Ni"], None),
        (["reconstruct", "a.epos", "--element", "Ni", "--distance", "90", "-o", "a.pos"], "a.pos"),
        (["compare", "../run.h5", "a.epos", "--registration", "0,1,0,0", *QUICK, "-o", "study"], "study/study.json"),
    ],
    ids=lambda words: words[0] if isinstance(words, list) else None,
)
def test_a_command(both, capsys, words, file):
    def answer():
        assert main([*words, *([] if words[0] in ("composition", "compare") else ["--force"])]) == 0
        return capsys.readouterr().out, None if file is None else Path(file).read_bytes()

    first, second = both(answer)
    assert first == second


def test_the_explorer(both):
    def answer():
        explorer, view = explorer_and_view(make_parser("explore").parse_args(["explore", "../run.h5", "a.epos"]))
        shown = explorer.bins_like(64)
        commands = explorer.commands(view)
        return shown.values.tolist(), shown.x_edges.tolist(), commands.shell, commands.python

    first, second = both(answer)
    assert json.dumps(first) == json.dumps(second)
