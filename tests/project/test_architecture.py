"""Packages are on layers: imports go down only, without circles, read off the files."""

import ast
import re
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from source_trees import nodes_of

PACKAGE = Path(__file__).parents[2] / "apt_evap"


def module_of(path):
    """Dotted name of a file below the package; a folder's `__init__` has that of the folder."""
    parts = Path(path).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def package_of(module):
    """Package of a module: the outermost folder it lies in, or itself where it lies beside the folders."""
    return module.split(".")[0]


@cache
def sources():
    """Text of each Python and Cython file by its path below the package, but for the names for users."""
    paths = (path for path in PACKAGE.rglob("*.p[yx]*") if path.suffix in (".py", ".pyx", ".pxd"))
    paths = [path for path in paths if path.parent != PACKAGE or not path.name.startswith("__")]
    return {path.relative_to(PACKAGE).as_posix(): path.read_text() for path in sorted(paths)}


def with_line(path, line):
    """The same with one more line in a file."""
    return sources() | {path: f"{sources()[path]}\n{line}\n"}


@cache
def imports(source, package):
    """Dotted names, without "apt_evap.", that a source imports, wherever it does: also by name, or for type hints."""
    found = []
    for node in nodes_of(source):
        names = []
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
            names = [item.value for item in node.args if isinstance(item, ast.Constant)]
        elif isinstance(node, ast.Import):
            names = [item.name for item in node.names]
        elif isinstance(node, ast.ImportFrom):
            inner = [*package[: len(package) - node.level + 1]] if node.level else []
            start = ".".join([*inner, node.module] if node.module else inner)
            names = [f"{start}.{item.name}" for item in node.names]
        for name in names:
            if name.split(".")[0] == "apt_evap":
                found.append(name.partition(".")[2])
    return found


@cache
def cython_imports(source):
    """The same for a Cython source."""
    return re.findall(r"^\s*(?:from|cimport|import)\s+apt_evap\.?([\w.]*)", source, re.MULTILINE)


def graph_of(texts):
    """Modules that each module imports, by dotted name."""
    graph = {module_of(path): set() for path in texts}
    for path, text in texts.items():
        inner = ("apt_evap", *Path(path).parts[:-1])
        names = imports(text, inner) if path.endswith(".py") else cython_imports(text)
        graph[module_of(path)].update(known(name, graph, path) for name in names)
    return {module: names - {module} for module, names in graph.items()}


def known(name, graph, where):
    """The module that holds an imported name."""
    while name and name not in graph:
        name = name.rpartition(".")[0]
    assert name, f"{where} imports the package itself, whose names are for users"
    return name


def between_packages(graph):
    """Other packages that each package imports from."""
    packages = {}
    for module, names in graph.items():
        packages.setdefault(package_of(module), set()).update(package_of(name) for name in names)
    return {name: below - {name} for name, below in packages.items()}


def check_layers(texts):
    """Fail on modules, or packages, that import each other in a circle; return packages from the lowest layer up."""
    graph = graph_of(texts)
    for what, each in (("modules", graph), ("packages", between_packages(graph))):
        try:
            order = list(TopologicalSorter(each).static_order())
        except CycleError as error:
            pytest.fail(f"{what} import each other in a circle: {' <- '.join(error.args[1])}")
    return order


def test_imports_go_down_from_package_to_package():
    order = check_layers(sources())
    assert len(order) < 23  # with units, warnings and the version
    for low, high in (
        ("_core", "_common"),
        ("_common", "specimen"),
        ("specimen", "evaporation"),
        ("evaporation", "simulation"),
        ("io", "simulation"),
        ("io", "studies"),
        ("maps", "simulation"),
        ("measures", "simulation"),
        ("simulation", "fit"),
        ("fit", "plot"),
        ("plot", "cli"),
    ):
        assert order.index(low) < order.index(high)


def test_no_package_imports_from_more_packages_than_it_did():
    """What only an annotation, a default or one function needs can often be passed in, or lie lower."""
    assert sum(map(len, between_packages(graph_of(sources())).values())) <= 124


@pytest.mark.parametrize(
    ("module", "line", "what"),
    [
        ("specimen/shape.py", "from apt_evap.simulation.run import Run", "modules"),
        ("_common/files.py", "import apt_evap.io.formats", "modules"),
        ("detection/detector_map.py", "from apt_evap.detection.hits import Hits", "modules"),
        ("detection/binning.py", "def f():\n    from apt_evap.detection.detector_map import DetectorMap", "modules"),
        ("_core/octree.pyx", "from apt_evap._core.flights cimport Flights", "modules"),
        ("detection/binning.py", "from apt_evap.maps.crystallography.directions import Poles", "packages"),
        (
            "simulation/run_table.py",
            "if TYPE_CHECKING:\n    from apt_evap.simulation.run import Run",
            "modules",
        ),
        ("detection/hits.py", 'import_module("apt_evap.spectra.mass_spectrum")', "modules"),
        ("io/hdf5.py", "def f():\n    from apt_evap.simulation.run import load", "packages"),
    ],
)
def test_an_upward_import_or_a_circle_is_found(module, line, what):
    with pytest.raises(pytest.fail.Exception, match=f"{what} import each other"):
        check_layers(with_line(module, line))


def test_the_package_itself_is_for_users():
    with pytest.raises(AssertionError, match="for users"):
        check_layers(with_line("specimen/shape.py", "import apt_evap"))


def test_the_core_knows_nothing_of_the_package():
    for module, names in graph_of(sources()).items():
        if package_of(module) == "_core":
            assert {package_of(name) for name in names} <= {"_core"}, module


@pytest.mark.parametrize(
    "package", sorted(path.parent.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("__init__.py"))
)
def test_a_package_has_one_sentence(package):
    tree = ast.parse((PACKAGE / package / "__init__.py").read_text())
    sentence = (ast.get_docstring(tree) or "").partition("\n\nExamples\n")[0]
    assert sentence and sentence.endswith(".") and "\n" not in sentence
    assert not any(isinstance(node, (ast.FunctionDef, ast.ClassDef)) for node in ast.walk(tree))


def test_the_tests_mirror_the_packages():
    packages = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    folders = {path.parent.name for path in (PACKAGE.parent / "tests").glob("*/test_*.py")}
    assert folders - {"project"} <= packages


def test_the_name_of_a_module_occurs_once():
    """But for the commands, each in a module of its name."""
    names = [path.stem for path in PACKAGE.rglob("*.py") if path.parent.name != "cli" and path.stem != "__init__"]
    assert {name for name in names if names.count(name) > 1} == set()


def test_nobody_goes_on_with_an_interrupted_run():
    """Ctrl-C ends `Simulation.run` with the ions so far: who asks for a run says what becomes of it then."""
    asking = re.compile(r"[sS]imulation\([^\n]*\)\.run\(|\bsimulation\.run\(")
    handling = re.compile(r"\.unless_interrupted\(\)|StopReason\.INTERRUPTED")
    callers = {}
    for path in PACKAGE.rglob("*.py"):
        code = "\n".join(line for line in path.read_text().splitlines() if not re.match(r"\s*(>>>|\.\.\.) ", line))
        if asking.search(code) and '"pass it to the simulation' not in code:
            callers[path.relative_to(PACKAGE).as_posix()] = bool(handling.search(code))
    assert len(callers) >= 6 and all(callers.values()), callers
