"""Small specimens, made once for all tests, and runs, made once for all tests until what computes them changes."""

import ast
import gc
import hashlib
import os
import pickle
import shutil
import signal
import sys
from functools import cache
from pathlib import Path

if "PYTEST_XDIST_WORKER" in os.environ:  # before NumPy is imported: every processor has a worker already
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")

if sys.dont_write_bytecode:  # otherwise every worker and every program of a test compiles all sources
    sys.dont_write_bytecode, sys.pycache_prefix = False, str(Path(__file__).parents[1] / ".pytest_cache" / "bytecode")
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

sys.path.append(str(Path(__file__).parent))  # for twins.py, whatever the import mode

from rough import ROUGH

import apt_evap as ae
from apt_evap._common.codec import to_plain
from apt_evap._common.files import replace_file
from apt_evap.explore import measured_ions
from apt_evap.maps.indexing.master_pattern import master_patterns
from apt_evap.simulation.locks import FileLock
from apt_evap.spectra import mass_spectrum
from apt_evap.spectra.mass_spectrum import spectrum

DRAWN = (  # of an artist of Matplotlib: what it shows
    *("get_text", "get_xydata", "get_array", "get_clim", "get_extent", "get_offsets", "get_paths", "get_path"),
    *("get_color", "get_facecolor", "get_edgecolor", "get_alpha", "get_visible", "get_xlim", "get_ylim"),
)
FLOWN20 = (ae.Unperturbed(), ae.RollUp(ae.TruncatedNormal(0.155, 0.155)))
OPTIONS20 = {"voltage": 1000.0, "seed": 1, "detector": ae.Detector(distance=100.0, width=300.0), **ROUGH}
PACKAGES_OF_RUNS = ("_common", "_core", "specimen", "detection", "emission", "evaporation", "simulation")

# a shell that has put the tests into the background lets them ignore Ctrl-C, which some of them press
signal.signal(signal.SIGINT, signal.default_int_handler)

# examples are not timed: the machine may be slow or busy
untimed = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow, HealthCheck.function_scoped_fixture]}
settings.register_profile("quick", max_examples=15, derandomize=True, **untimed)
settings.register_profile("thorough", max_examples=300, **untimed)
settings.load_profile("quick")


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Collect tests without the collector of garbage: what is made then stays, and to look through it takes seconds."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(20_000, 20, 20)  # figures and pages are larger than what the defaults are for
        gc.enable()


def read_only(thing):
    """The same object, whose arrays, one level down too, nobody can change: all tests share it."""
    for value in (*vars(thing).values(), *getattr(thing, "flown", ())):
        for array in (value, *getattr(value, "__dict__", {}).values()):
            if isinstance(array, np.ndarray):
                array.flags.writeable = False
    return thing


def hash_of(*parts):
    """Hash of bytes."""
    hashed = hashlib.sha256()
    for part in parts:
        hashed.update(hashlib.sha256(part).digest())
    return hashed.hexdigest()[:24]


@cache
def code_of(path):
    """Bytes of a file; of Python the code alone, since comments and docstrings change no run."""
    if path.suffix != ".py":
        return path.read_bytes()
    tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            del node.body[0]
    return ast.dump(tree).encode()


def kept_folder(config, tmp_path_factory, name, packages):
    """Folder of what these packages compute: it outlives the tests, and goes when their code has changed."""
    if not hasattr(config, "cache"):  # without the plugin of pytest
        return tmp_path_factory.mktemp(name)
    package = Path(ae.__file__).parent
    paths = [path for part in packages for path in sorted((package / part).rglob("*")) if path.is_file()]
    paths += sorted(package.glob("*.py"))  # such as the units
    sources = [code_of(path) for path in paths if path.suffix in (".py", ".so", ".pyd", ".npz")]
    folder = config.cache.mkdir(name) / hash_of(*sources)
    folder.mkdir(exist_ok=True)
    for other in folder.parent.iterdir():
        if other != folder:
            shutil.rmtree(other, ignore_errors=True)
    return folder


@pytest.fixture(scope="session")
def kept_runs(pytestconfig, tmp_path_factory):
    """Folder of the runs of this core."""
    return kept_folder(pytestconfig, tmp_path_factory, "runs", PACKAGES_OF_RUNS)


@pytest.fixture(scope="session")
def computed_once(pytestconfig, tmp_path_factory):
    """`compute()`, by the first test that needs what these packages compute from these arguments."""
    folders = {}

    def computed(name, packages, arguments, compute):
        if name not in folders:
            folders[name] = kept_folder(pytestconfig, tmp_path_factory, name, packages)
        key = hash_of(pickle.dumps(arguments))
        path = folders[name] / f"{key}.pickle"
        lock = FileLock(path.with_suffix(".lock"), key, wait=lambda: None)
        try:
            if not path.exists():
                content = compute()
                with replace_file(path) as file:
                    pickle.dump(content, file)
        finally:
            lock.release()
        return pickle.loads(path.read_bytes())

    return computed


@pytest.fixture(scope="session")
def indexed_once(computed_once):
    """`ae.index`, computed by the first test that needs it."""
    packages = ("_common", "_core", "specimen", "detection", "maps")

    def indexed(measured, material, **options):
        arguments = (measured, material, sorted(options.items()))
        return computed_once("indexings", packages, arguments, lambda: ae.index(measured, material, **options))

    return indexed


@pytest.fixture(scope="session")
def indexed_nickel(indexed_once):
    """Orientation of nickel, a map of it at a scale of 60 mm/rad, and what `ae.index` says of this map."""
    truth = ae.Orientation("Ni", axis=(0.30, 0.54, 0.79), rotation=20.0)
    pattern = master_patterns("fcc")[0]
    measured = pattern.map(truth, ae.detection.Projection(60.0), 70.0, ions=30_000, rolled=0.5, seed=1)
    return truth, indexed_once(measured, "Ni", scales=(54, 66), patterns=[pattern])


@pytest.fixture(scope="session")
def made_once(kept_runs):
    """`Simulation(tip, **options).run(ions, emissions, responses)`, by the first test that needs this run."""

    def made(tip, ions, emissions=(), responses=True, **options):
        plain = {name: to_plain(value) for name, value in options.items() if name != "n_threads"}
        key = hash_of(repr((tip.settings, ions, to_plain(emissions), responses, sorted(plain.items()))).encode())
        path = kept_runs / f"{key}.h5"
        lock = FileLock(path.with_suffix(".lock"), key, wait=lambda: None)
        try:
            if not path.exists():
                simulation = ae.Simulation(tip, **options)
                simulation.run(ions, emissions, responses=responses, progress=False).save(path)
        finally:
            lock.release()
        return read_only(ae.load(path))

    return made


@pytest.fixture(scope="session")
def nickel():
    return ae.material("Ni")


@pytest.fixture(scope="session")
def small_tip(nickel):
    """Ni[111], R = 6 a: 10,000 atoms, 2,100 at the surface."""
    return read_only(ae.Tip(nickel, apex_radius=6 * nickel.a, axis=(1, 1, 1), shank_length=6 * nickel.a))


@pytest.fixture(scope="session")
def tip12(nickel):
    """Ni[111], R = 12 a, of a random origin: no two charges are equal."""
    return read_only(
        ae.Tip(nickel, apex_radius=12 * nickel.a, axis=(1, 1, 1), shank_length=12 * nickel.a, offset_seed=3)
    )


@pytest.fixture(scope="session")
def surface12(tip12):
    """Positions, normals and charges of the surface atoms of `tip12`, solved to 1e-8."""
    emitter = ae.evaporation.Emitter(tip12, 1000.0)
    arrays = emitter.positions, emitter.normals, emitter.charges
    for array in arrays:
        array.flags.writeable = False
    return arrays


@pytest.fixture(scope="session")
def tip20(nickel):
    """Ni[111], R = 20 a, centred on an atom: as symmetric as the crystal."""
    return read_only(
        ae.Tip(nickel, apex_radius=20 * nickel.a, axis=(1, 1, 1), shank_angle=1.5, shank_length=20 * nickel.a)
    )


@pytest.fixture(scope="session")
def run20(tip20, made_once):
    """15,000 ions of `tip20`, each flown at rest and rolled up, with responses."""
    return made_once(tip20, 15_000, FLOWN20, **OPTIONS20)


@pytest.fixture(scope="session")
def few20(tip20, made_once):
    """The first 6,000 ions of `run20`, for tests that are not slow."""
    return made_once(tip20, 6_000, FLOWN20, **OPTIONS20)


@pytest.fixture(scope="session")
def _spectra():
    """Spectra by the hash of their ions and options."""
    return {}


@pytest.fixture
def spectra_once(_spectra, monkeypatch):
    """`ae.spectrum` computes that of the same ions with the same options once: for tests of what is made of it."""

    def once(hits, *args, **options):
        columns = {name: np.asarray(getattr(hits, name)) for name in (*hits.columns, "detected")}
        key = hash_of(pickle.dumps((columns, args, sorted(options.items()))))
        if key not in _spectra:
            _spectra[key] = spectrum(hits, *args, **options)
        return _spectra[key]

    for place in (ae, measured_ions, mass_spectrum):
        monkeypatch.setattr(place, "spectrum", once)


@pytest.fixture
def rough_layout(monkeypatch):
    """Pictures are laid out once instead of up to three times: for tests that do not look where their labels are."""
    monkeypatch.setattr("apt_evap.plot._figure._Layout.execute", ConstrainedLayoutEngine.execute)


@pytest.fixture
def blank_pictures(monkeypatch, rough_layout):
    """Pictures are written with nothing on them: for tests of all but pictures, which take a second each."""
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda figure, *args, **options: save(Figure((1, 1)), *args, **options))


def hash_of_figure(figure):
    """Hash of what a figure draws: the values, texts, colours and limits of all its artists."""
    parts = []
    for artist in figure.findobj():
        parts.append(type(artist).__name__.encode())
        for name in DRAWN:
            value = getattr(artist, name, tuple)()
            for item in value if isinstance(value, list) else [value]:
                array = np.asarray(getattr(item, "vertices", item))
                parts.append(repr(array.tolist()).encode() if array.dtype == object else array.tobytes())
    return hash_of(*parts)


@pytest.fixture
def hashed_pictures(monkeypatch):
    """Pictures are written with the hash of what they show: for tests that compare two, without drawing both."""
    save = Figure.savefig

    def save_hash(figure, *args, metadata, **options):
        save(Figure((1, 1)), *args, metadata=metadata | {"Description": hash_of_figure(figure)}, **options)

    monkeypatch.setattr(Figure, "savefig", save_hash)


@pytest.fixture
def rng():
    return np.random.default_rng(20260)
