"""Imports go down, by floors; modules stay short."""

import ast
import re
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from statistics import median

import pytest

PACKAGE = Path(__file__).parents[1] / "apt_evap"

FLOORS = (
    {"units", "_arrays", "_threads", "_memory", "_files", "_types", "_version"},
    {"_core"},
    {"lattice", "ranges", "shape", "material", "alloy", "interchange", "projection", "poles", "orientation", "tip"}
    | {"detector", "hits"},
    {
        "ion_random",
        "energy",
        "emission",
        "perturbation",
        "law",
        "charge_settings",
        "emitter_state",
        "emitter",
        "flights",
        "response",
    },
    {"watch", "run_file", "run", "checkpoint", "run_parts", "simulation"},
    {"binning", "maps", "cap", "profiles", "zone_line", "tracks", "alignment", "register", "compare"}
    | {"energy_grid", "resample", "study", "energy_search", "fit", "config", "info", "io"},
    {"plot", "cli"},
)
FLOOR = {module: number for number, floor in enumerate(FLOORS) for module in floor}

UPWARD = {("hits", "maps")}  # Hits.map, a shorthand: inside the method, never when the module is loaded
MOST_LINES = 400
LONGER = {}


def sources():
    """Top-level module (a folder counts as one) of every Python file of the package, by path."""
    return {
        path: path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        for path in sorted(PACKAGE.rglob("*.py"))
        if path != PACKAGE / "__init__.py"
    }


def imports(source, package):
    """Modules of the package that a source imports: (top-level name, whether at the top of the file)."""
    tree = ast.parse(source)
    at_top = set()
    level = list(tree.body)
    hints = set()
    while level:  # what runs when the module is loaded: all but the bodies of functions
        node = level.pop()
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
            continue
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            hints |= set(ast.walk(node))  # never run: names for type hints
            continue
        at_top.add(node)
        level += ast.iter_child_nodes(node)
    for node in set(ast.walk(tree)) - hints:
        names = []
        if isinstance(node, ast.Import):
            names = [item.name for item in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level:
            inner = package[: len(package) - node.level + 1]
            start = ".".join([*inner, node.module] if node.module else inner)
            names = [f"{start}.{item.name}" for item in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{item.name}" for item in node.names]
        for name in names:
            parts = name.split(".")
            if parts[0] == "apt_evap" and len(parts) > 1:
                yield parts[1], node in at_top
            elif parts[0] == "apt_evap":
                yield "__init__", node in at_top


def all_imports():
    """(importing module, imported module, whether at the top) for the whole package."""
    found = set()
    for path, module in sources().items():
        package = ("apt_evap", *path.relative_to(PACKAGE).parts[:-1])
        for name, at_top in imports(path.read_text(), package):
            if name != module:
                found.add((module, name, at_top))
    return sorted(found)


def test_the_reader_of_imports():
    source = "import apt_evap.units\nfrom apt_evap import maps\nfrom . import run\nfrom .io import pos\nimport numpy\n"
    source += "def f():\n    from apt_evap.plot import show\nclass C:\n    import apt_evap.cli\nimport apt_evap\n"
    source += "if TYPE_CHECKING:\n    from apt_evap.study import Study\n"
    assert set(imports(source, ("apt_evap",))) == {
        ("units", True),
        ("maps", True),
        ("run", True),
        ("io", True),
        ("plot", False),
        ("cli", True),
        ("__init__", True),
    }
    assert set(imports("from ..units import X\nfrom ._records import Y", ("apt_evap", "io"))) == {
        ("units", True),
        ("io", True),
    }


def test_every_module_has_a_floor():
    assert set(sources().values()) - set(FLOOR) == set()


def test_imports_go_down():
    found = all_imports()
    assert len(found) > 40
    for module, name, at_top in found:
        assert name in FLOOR, f"{module} imports {name}, which has no floor (the package itself is for users)"
        if (module, name) in UPWARD and not at_top:
            continue
        assert FLOOR[name] <= FLOOR[module], f"{module} (floor {FLOOR[module]}) imports {name} (floor {FLOOR[name]})"


def test_the_upward_imports_are_still_there():
    assert {(module, name, False) for module, name in UPWARD} <= set(all_imports())


def test_no_cycles():
    graph = {module: set() for module in FLOOR}
    for module, name, _ in all_imports():
        if (module, name) not in UPWARD:
            graph[module].add(name)
    try:
        order = list(TopologicalSorter(graph).static_order())
    except CycleError as error:
        pytest.fail(f"modules import each other in a circle: {' <- '.join(error.args[1])}")
    assert set(order) == set(FLOOR)


def test_the_core_knows_nothing_of_the_package():
    cython = sorted((PACKAGE / "_core").glob("*.p[yx][xd]"))
    assert len(cython) >= 5
    for path in (*cython, *(PACKAGE / "_core").glob("*.py")):
        for line in path.read_text().splitlines():
            match = re.match(r"\s*(?:from\s+(\S+)\s+c?import|c?import\s+(\S+))", line)
            if match:
                name = match[1] or match[2]
                assert not name.startswith("apt_evap") or name.startswith("apt_evap._core."), f"{path.name}: {line}"


def test_the_core_has_no_cycles():
    graph = {}
    for path in (PACKAGE / "_core").glob("*.p[yx][xd]"):
        graph.setdefault(path.stem, set()).update(
            name for name in re.findall(r"from apt_evap\._core\.(\w+) c?import", path.read_text()) if name != path.stem
        )
    list(TopologicalSorter(graph).static_order())
    assert graph["flight"] >= {"octree", "journal"}


MODULES = sorted(
    path.relative_to(PACKAGE).as_posix() for end in ("py", "pyx", "pxd", "h") for path in PACKAGE.rglob(f"*.{end}")
)


@pytest.mark.parametrize("path", MODULES)
def test_modules_are_short(path):
    assert len((PACKAGE / path).read_text().splitlines()) <= LONGER.get(path, MOST_LINES)


def test_half_of_the_modules_have_less_than_200_lines():
    assert median(len((PACKAGE / path).read_text().splitlines()) for path in MODULES if path.endswith(".py")) < 200
