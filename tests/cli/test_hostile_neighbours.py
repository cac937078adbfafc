"""A folder of somebody else: whatever lies beside, above or inside what is opened, its code is not executed."""

import inspect
import shutil
import sys
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.cli._explorer_of_files import explorer_and_view, with_file
from apt_evap.cli._files import read_registration
from apt_evap.cli.main import main
from apt_evap.cli.parser import COMMANDS, make_parser
from apt_evap.explore.background_run import BackgroundRun
from apt_evap.fit.start_settings import is_start
from apt_evap.simulation.config.simulation_file import read_config
from apt_evap.simulation.simulation import Simulation
from apt_evap.studies.sweep.planning import plan_sweep
from apt_evap.workflows.kept_files import KeptFiles
from apt_evap.workflows.twin_of_map import twin

CLASSES = '''
import pathlib
(pathlib.Path(__file__).parent / "EXECUTED").touch()
class Mine:
    """All interfaces at once."""
    def __init__(self, **_): pass
    def launch(self, emissions, random): raise ValueError
    def keys(self, tip, atoms, fields, bonds): raise ValueError
    def solve(self, positions, normals, charges, field_of, potential, tolerance): raise ValueError
    def solve_patch(self, positions, normals, charges, field): raise ValueError
    def quantile(self, u): return u
    def probabilities(self, emissions): raise ValueError
    def distance(self, points): return points[:, 0]
'''
TIP = '[tip]\nmaterial = "Ni"\napex_radius = 1.5\naxis = [1, 1, 1]\nshank_length = 1.0\n'
SIMULATION = "[simulation]\nions = 30\n"
START = "# Settings of a simulation, made from a measured map by apt_evap 0.1.0.\n"
PANELS = (
    '\n[[maps.panels]]\nperturbation = {{ name = "mine:Mine" }}\n[[maps.panels]]\nperturbation = {{ name = "{}" }}\n'
)
# further places of a class in settings, each in a file of its own
PLACES = {
    "law": '[law]\nname = "mine:Mine"\n',
    "bonds": '[law]\nname = "Extremal"\nbonds = { name = "mine:Mine" }\n',
    "rule": '[rule]\nname = "mine:Mine"\n',
    "energy": '[[maps.panels]]\nperturbation = { name = "RollUp", energy = { name = "mine:Mine" } }\n',
    "probability": '[[maps.panels]]\nperturbation = { name = "RollUp", energy = 0.1, '
    'probability = { name = "mine:Mine" } }\n',
    "region": '[[phases]]\nname = "a"\nmaterial = "Ni"\n[[phases]]\nname = "b"\nmaterial = "Ni"\n'
    'region = { name = "mine:Mine" }\n',
}


class Executed:
    """Leaves a file when it is unpickled."""

    def __reduce__(self):
        return Path.touch, (Path("EXECUTED"),)


@pytest.fixture(scope="session")
def hostile(tmp_path_factory):
    """Harmless files among settings and modules that execute code."""
    folder = tmp_path_factory.mktemp("hostile")
    evil = START + TIP + SIMULATION + PANELS.format("subprocess:Popen")
    for name in ("mine", "numpy", "apt_evap", "sitecustomize", "conftest", "study", "own", "run"):
        (folder / f"{name}.py").write_text(CLASSES)
    (folder / "matplotlibrc").write_text("backend: module://mine\n")
    tip = ae.Tip("Ni", apex_radius=1.5, axis=(1, 1, 1), shank_length=1.0)
    ae.Simulation(tip, n_threads=1).run(60, progress=False).save(folder / "run.h5")
    random = np.random.default_rng(0)
    n = 3000
    x, y = random.normal(0, 8, (2, n)).astype("f4")
    hits = ae.Hits(
        x=x,
        y=y,
        voltage=np.linspace(3000, 4000, n).astype("f4"),
        pulse_voltage=np.zeros(n, "f4"),
        mass_to_charge=np.where(np.arange(n) % 4, 29.0, 27.0).astype("f4"),
        time_of_flight=np.full(n, 500.0, "f4"),
        positions=random.uniform(-5, 5, (n, 3)).astype("f4"),
        multiplicity=np.ones(n, int),
        pulse_id=np.arange(n),
    )
    ae.write(folder / "ions.epos", hits)
    (folder / "ions.rrng").write_text("[Ranges]\nRange1=28.5 29.5 Ni:1\nRange2=26.5 27.5 Al:1\n")
    (folder / "grid.csv").write_text(
        "\n".join(
            ["detectorX,detectorY,gridX,gridY", *(f"{5 * i},{5 * j},{i},{j}" for i in range(9) for j in range(9))]
        )
    )
    counts = hits.map(bins=64)
    edges = {"x_edges_mm": counts.x_edges, "y_edges_mm": counts.y_edges}
    np.savez(folder / "map.npz", counts=counts.values, **edges)
    for name in ("run", "ions", "map", "settings", "specimen", "Ni"):
        (folder / f"{name}.toml").write_text(evil)
    assert is_start(folder / "run.toml")
    (folder / "own.toml").write_text(TIP + SIMULATION)
    (folder / "base.toml").write_text(TIP + SIMULATION)
    (folder / "study.toml").write_text('base = "base.toml"\n[sweep]\n"simulation.seed" = [1, 2]\n[dataset]\n')
    sweep = plan_sweep(folder / "study.toml")
    for key in sweep.keys:
        settings = sweep.folder_of(key) / "settings.toml"
        settings.write_text(settings.read_text() + PANELS.format("subprocess:Popen"))  # with the same key
        (settings.parent / "mine.py").write_text(CLASSES)
    np.savez(folder / "pickle.npz", counts=np.array([Executed()], dtype=object), **edges)
    (folder / "visible.toml").write_text(TIP + SIMULATION + PANELS.format("subprocess:Popen") + "[visibility]\n")
    return folder


@pytest.fixture
def folder(hostile, tmp_path, monkeypatch, rough_layout):
    """A copy, in which the test works; afterwards nothing has been executed."""
    copy = tmp_path / "copy"
    shutil.copytree(hostile, copy)
    monkeypatch.chdir(copy)
    yield copy
    assert not [path for path in copy.rglob("*") if path.name == "EXECUTED"]
    assert "mine" not in sys.modules


RANGES = ("--ranges", "ions.rrng")
OF_NICKEL = ("--element", "Ni", "--distance", "90")
RUNS = {
    "run": [("run", "own.toml", "--quiet"), ("run", "own.toml", "--resume", "--quiet")],
    "map": [
        ("map", "run.h5"), ("map", "ions.epos", "--undistort", "grid.csv", *RANGES, "--species", "Ni"),
        ("map", "map.npz"), ("map", "pickle.npz"),
    ],
    "info": [("info", "run.h5"), ("info", "ions.epos"), ("info", "map.npz")],
    "spectrum": [("spectrum", "ions.epos")],
    "planes": [("planes", "ions.epos")],
    "clusters": [("clusters", "ions.epos", *RANGES, "--solute", "Al", "--d-max", "0.5", "--n-min", "5")],
    "proxigram": [("proxigram", "ions.epos", *RANGES, "--solute", "Al", "--isovalue", "0.2")],
    "composition": [("composition", "ions.epos"), ("composition", "ions.epos", *RANGES)],
    "index": [("index", "ions.epos", "--element", "Ni", "--scales", "50,50")],
    "start": [("start", "ions.epos", "--element", "Ni", "--scales", "50,50", "-o", "started.toml")],
    "export": [("export", "run.h5", "-o", "x.pos"), ("export", "ions.epos", "-o", "x.csv")],
    "reconstruct": [
        ("reconstruct", "ions.epos", *OF_NICKEL),
        ("reconstruct", "ions.epos", *OF_NICKEL, *RANGES, "--shape", "evolving", "--solutes", "Al", "--check"),
    ],
    "examples": [("examples", "--to", "copied")],
    "completion": [("completion", "bash")],
    "compare": [
        ("compare", "run.h5", "ions.epos", "--bins", "16", "--means", "0.1,0.2", "--replicas", "1",
         "--registration", "0,0.16,0,0"),
    ],
    "sweep": [
        ("sweep", "status", "study.toml"),
        ("sweep", "work", "study.toml", "--quiet"),
        ("sweep", "work", "study.toml", "--point", "0"),
        ("sweep", "collect", "study.toml"),
    ],
    "dataset": [("dataset", "study.toml", "-o", "set")],
    "visible": [("visible", "visible.toml")],
}  # fmt: skip
"""Command lines of all commands but `explore`, `twin` and `paper`, which are below."""
SLOW = ("index", "start", "compare")
REFUSED = {
    ("map", "pickle.npz"), ("sweep", "work", "study.toml", "--point", "0"), ("sweep", "collect", "study.toml"),
    ("dataset", "study.toml", "-o", "set"), ("visible", "visible.toml"),
}  # fmt: skip
AGAIN = (  # what the line before has met
    RUNS["map"][1],
    *RUNS["info"][1:],
    RUNS["composition"][1],
    RUNS["export"][0],
    ("run", "own.toml", "--resume", "--quiet"),
    ("sweep", "work", "study.toml", "--quiet"),
    ("map", "run.h5"),
    RUNS["reconstruct"][1],
)


def test_every_command_is_here():
    assert set(RUNS) | {"explore", "twin", "paper"} == set(COMMANDS)


LINES = [
    pytest.param(words, id=" ".join(words[:2]), marks=[pytest.mark.slow] if words[0] in SLOW or words in AGAIN else [])
    for lines in RUNS.values()
    for words in lines
]


@pytest.mark.parametrize("words", LINES)
def test_a_command_executes_nothing_that_it_finds(folder, words):
    assert main(list(words)) == (2 if words in REFUSED else 0)


def test_a_file_that_is_opened_in_the_explorer_executes_nothing_beside_it(folder):
    options = make_parser("explore").parse_args(["explore", "run.h5", "ions.epos"])
    explorer_and_view(options)
    for name in ("run.h5", "map.npz", "ions.epos"):
        with_file(options, name)
    running = BackgroundRun(folder / "run.toml", folder / "other.h5")  # what the page writes has no such class
    running.stop(wait=True)
    assert not running.finished and "own_classes" in running.message


@pytest.mark.slow
def test_a_folder_of_the_paper_executes_nothing(folder, monkeypatch):
    """Its runs are not made: what is beside them is met before, and again when the command continues."""

    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(Simulation, "run", stop)
    for _ in range(2):
        assert main(["paper", "--figure", "7"]) == 130
        written = list((folder / "paper").rglob("*.toml"))
        assert written
        for path in written:
            path.write_text(path.read_text() + PANELS.format("subprocess:Popen"))
            for name in ("mine", "numpy", "run"):
                (path.parent / f"{name}.py").write_text(CLASSES)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the map does not decide")
def test_a_folder_of_a_twin_executes_nothing(folder):
    """Its record is right: it came with the measurement."""
    kept = {}
    write = KeptFiles.write

    def stop(self, files, others=()):
        kept.update(files)
        changed = {
            name: content + PANELS.format("subprocess:Popen").encode() if name.endswith("toml") else content
            for name, content in files.items()
        }
        write(self, changed, others)
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(KeptFiles, "write", stop)
        twin("ions.epos", "Ni", scales=(50, 50), minutes=0.5, threads=1)
    (folder / "ions_twin" / "mine.py").write_text(CLASSES)
    with pytest.raises(ae.FileError, match="own_classes"):
        twin("ions.epos", "Ni", scales=(50, 50), minutes=0.5, threads=1)


@pytest.mark.parametrize("place", PLACES)
def test_settings_with_a_class_are_read_only_with_the_switch(folder, place):
    tip = TIP.replace('material = "Ni"\n', "") if place == "region" else TIP
    Path("a.toml").write_text(tip + SIMULATION + PLACES[place])
    for reader in (read_config, ae.simulate):
        with pytest.raises(ae.FileError, match="apt-evap run names, or with own_classes=True"):
            reader("a.toml")


def read_chunks(path):
    return list(ae.io.chunks(path, 1000))


READERS = [
    ae.read, ae.load, ae.read_tip, ae.load_dataset, ae.io.read_map, ae.io.read_ranges, ae.io.read_grid, ae.io.read_mesh,
    ae.io.chunks, ae.simulate, ae.studies.open_sweep, ae.studies.plan_sweep, ae.studies.plan_dataset,
    ae.studies.run_point, ae.studies.verify_dataset, ae.studies.visibility_of_file, ae.studies.OriginOperators.load,
    read_config, read_registration,
]  # fmt: skip
ELSEWHERE = [ae.compare, ae.twin, ae.fit.fit_tips]  # with a measurement, or as commands
WRITERS = [
    ae.write, ae.Run.save, ae.Simulation.run, ae.io.write_nodes, ae.io.write_rrng, ae.io.write_types,
    ae.plot.write_study, ae.plot.write_sweep, ae.studies.OriginOperators.save, ae.studies.collect_sweep,
    ae.studies.make_dataset,
]  # fmt: skip


def test_every_reader_is_here():
    """All public functions and methods with a parameter for a path."""
    found = set()
    for name in dir(ae):
        module = getattr(ae, name)
        if not inspect.ismodule(module):
            module = SimpleNamespace(**{name: module})
        for public in (getattr(module, each) for each in dir(module) if not each.startswith("_")):
            methods = [getattr(public, each) for each in dir(public) if not each.startswith("_")]
            for function in [public, *(methods if inspect.isclass(public) else [])]:
                if inspect.isfunction(function) or inspect.ismethod(function):
                    kinds = [str(each.annotation) for each in inspect.signature(function).parameters.values()]
                    if any("PathLike" in kind or "AnyPath" in kind or "pathlib" in kind for kind in kinds):
                        found.add(function.__qualname__)
    known = {function.__qualname__ for function in (*READERS, *ELSEWHERE, *WRITERS)}
    assert found == known - {"read_config", "read_registration"}  # of the commands


FOUND = (
    "run.h5",
    "ions.epos",
    "map.npz",
    "pickle.npz",
    "run.toml",
    "mine.py",
    "study.toml",
    "visible.toml",
    "study",
    ".",
)


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.__qualname__)
@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")
def test_a_reader_executes_nothing(folder, reader):
    if reader is ae.io.chunks:
        reader = read_chunks
    names = [*FOUND, *map(str, sorted(Path("study").rglob("*"))), "own.toml", "ions.rrng", "grid.csv"]
    read = 0
    for name in names:
        with suppress(ValueError):
            reader(name)
            read += 1
    # each has met its own kind of file, but for those that are not in the folder
    assert read or reader in (ae.read_tip, ae.load_dataset, ae.io.read_mesh, *UNMADE)


UNMADE = (
    ae.studies.verify_dataset, ae.studies.visibility_of_file, ae.studies.OriginOperators.load, read_registration,
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::apt_evap.warnings.MapWarning")  # of 60 ions
def test_tips_of_files_execute_nothing(folder):
    grid = ae.fit.EnergyGrid(means=(0.1, 0.2), relative_spreads=(0.5,))
    settings = ae.fit.FitSettings(bins=16, replicas=1, resamples=2)
    here = ae.Registration(0.0, 0.16, (0.0, 0.0))
    ae.fit.fit_tips({"a": "run.h5", "b": "run.h5"}, ae.read("ions.epos"), grid, settings, registration=here)
