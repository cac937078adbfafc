"""Packages are on layers: imports go down only, without circles, read off the files."""

import ast
import re
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[2] / "apt_evap"


def module_of(path, package=PACKAGE):
    """Dotted name of a file below the package; a folder's `__init__` has that of the folder."""
    parts = path.relative_to(package).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def package_of(module):
    """Package of a module: the outermost folder it lies in, or itself where it lies beside the folders."""
    return module.split(".")[0]


@cache  # the copies of the package differ in one file
def imports(source, package):
    """Dotted names, without "apt_evap.", that a source imports, wherever it does: also by name, or for type hints."""
    found = []
    for node in ast.walk(ast.parse(source)):
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


def cython_imports(source):
    """The same for a Cython source."""
    for match in re.finditer(r"^\s*(?:from|cimport|import)\s+apt_evap\.?([\w.]*)", source, re.MULTILINE):
        yield match[1]


def graph_of(package):
    """Modules that each module of a package imports, by dotted name."""
    paths = {module_of(path, package): path for path in sorted(package.rglob("*.py")) if path.parent != package}
    paths |= {module_of(path, package): path for path in package.glob("*.py") if not path.name.startswith("__")}
    compiled = {module_of(path, package) for path in package.rglob("*.p[yx][xd]")}
    graph = {module: set() for module in (*paths, *compiled)}
    for module, path in paths.items():
        inner = ("apt_evap", *path.relative_to(package).parts[:-1])
        for name in imports(path.read_text(), inner):
            graph[module].add(known(name, graph, module))
    for path in package.rglob("*.p[yx][xd]"):
        for name in cython_imports(path.read_text()):
            graph[module_of(path, package)].add(known(name, graph, path.name))
    return {module: names - {module} for module, names in graph.items()}


def known(name, graph, where):
    """The module that holds an imported name."""
    while name and name not in graph:
        name = name.rpartition(".")[0]
    assert name, f"{where} imports the package itself, whose names are for users"
    return name


def check_layers(package):
    """Fail on modules, or packages, that import each other in a circle; return packages from the lowest layer up."""
    graph = graph_of(package)
    packages = {}
    for module, names in graph.items():
        packages.setdefault(package_of(module), set()).update(package_of(name) for name in names)
    packages = {name: below - {name} for name, below in packages.items()}
    for what, each in (("modules", graph), ("packages", packages)):
        try:
            order = list(TopologicalSorter(each).static_order())
        except CycleError as error:
            pytest.fail(f"{what} import each other in a circle: {' <- '.join(error.args[1])}")
    return order


def test_imports_go_down_from_package_to_package():
    order = check_layers(PACKAGE)
    assert len(order) < 24  # with units, warnings and the version
    for low, high in (
        ("_core", "_common"),
        ("_common", "specimen"),
        ("specimen", "evaporation"),
        ("evaporation", "simulation"),
        ("io", "simulation"),
        ("io", "studies"),
        ("maps", "simulation"),
        ("measures", "simulation"),
        ("simulation", "analysis"),
        ("fit", "plot"),
        ("plot", "cli"),
    ):
        assert order.index(low) < order.index(high)


def copy_of(package, target):
    for path in (*package.rglob("*.py"), *package.rglob("*.p[yx][xd]")):
        copy = target / path.relative_to(package)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_text(path.read_text())
    return target


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
def test_an_upward_import_or_a_circle_is_found(tmp_path, module, line, what):
    package = copy_of(PACKAGE, tmp_path / "apt_evap")
    path = package / module
    path.write_text(path.read_text() + f"\n{line}\n")
    with pytest.raises(pytest.fail.Exception, match=f"{what} import each other"):
        check_layers(package)


def test_the_package_itself_is_for_users(tmp_path):
    package = copy_of(PACKAGE, tmp_path / "apt_evap")
    path = package / "specimen" / "shape.py"
    path.write_text(path.read_text() + "\nimport apt_evap\n")
    with pytest.raises(AssertionError, match="for users"):
        check_layers(package)


def test_the_core_knows_nothing_of_the_package():
    for module, names in graph_of(PACKAGE).items():
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
