"""The documentation: its Python runs, its commands and links are right, and every public name is described."""

import argparse
import ast
import dataclasses
import enum
import inspect
import pkgutil
import re
import runpy
import sys
import textwrap
import tomllib
from itertools import pairwise
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.simulation.config.simulation_file import read_config

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
PAGES = sorted(
    page
    for page in (ROOT / "docs").rglob("*.rst")
    if not {"generated", "_build", "_templates"} & set(page.relative_to(ROOT / "docs").parts)
)


def name_of(page):
    """Name of a page as in a toctree: its path in docs without the suffix."""
    return page.relative_to(ROOT / "docs").with_suffix("").as_posix()


SMALLER = {"15_000": "300"}  # ions of the README's simulation: minutes on a slow machine, and no less true


def python_blocks(path):
    """The Python blocks of a page, each in front of as many empty lines as put it where it is in the page."""
    text = path.read_text()
    if path.suffix == ".md":
        found = re.finditer(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    else:
        found = re.finditer(r"^\.\. code-block:: python\n\n((?:(?: {4}.*)?\n)+)", text, re.MULTILINE)
    return ["\n" * text.count("\n", 0, block.start(1)) + textwrap.dedent(block[1]) for block in found]


@pytest.fixture
def folder(tmp_path, monkeypatch, rough_layout):
    """A folder to work in, with a measured file as the pages name it: hits on a comb, two in every fifth pulse."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(1)
    n = 20_000
    comb = np.array([0.02725, 0.02602])  # mm, of a delay line detector
    sine, azimuth = np.sin(np.radians(32.0)) * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    radius = 90.0 * sine / (0.5 + np.sqrt(1 - sine**2))  # an even flux with the default projection
    x, y = (np.rint(radius * part(azimuth) / step) * step for part, step in zip((np.cos, np.sin), comb, strict=True))
    measured = ae.Hits(
        x=x,
        y=y,
        positions=rng.normal(size=(n, 3)),
        mass_to_charge=rng.choice([29.0, 58.0], n),
        time_of_flight=rng.normal(600.0, 5.0, n),
        voltage=np.full(n, 5000.0),
        pulse_id=np.cumsum(rng.random(n) > 1 / 6),
    )
    ae.write("R5083.epos", measured)
    composition = [{"Mg": 1}, {"Zn": 1}]
    ae.io.write_rrng("R5083.rrng", ae.spectra.Ranges(("Mg", "Zn"), [28.5, 57.5], [29.5, 58.5], composition=composition))
    return tmp_path


def test_blocks_are_found():
    assert sum(len(python_blocks(page)) for page in PAGES) >= 10
    # none is written in a way that is not found
    assert README.read_text().count("```python") == len(python_blocks(README)) > 0
    for page in PAGES:
        assert page.read_text().count("code-block:: python") == len(python_blocks(page)), page.name


@pytest.mark.docs
@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")  # of small specimens, and ions that missed
@pytest.mark.parametrize("path", [p for p in PAGES if python_blocks(p)], ids=name_of)
def test_python_blocks_run(path, folder, monkeypatch):
    """All blocks of a page, one after the other, as a reader would; those of the README run below."""
    run_blocks(path, monkeypatch)


def run_blocks(path, monkeypatch):
    page = type(sys)("__page__")  # dataclasses look up the module of their class
    monkeypatch.setitem(sys.modules, "__page__", page)
    for block in python_blocks(path):
        for large, small in SMALLER.items():
            block = block.replace(large, small)
        exec(compile(block, str(path), "exec"), page.__dict__)


@pytest.mark.docs
@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")  # of small specimens, and ions that missed
def test_what_the_readme_makes(folder, monkeypatch):
    """Its blocks run, and the files it names are written."""
    run_blocks(README, monkeypatch)
    for name in ("ni111.h5", "ni.epos", "rolled.png", "R5083.png"):
        assert (folder / name).stat().st_size > 0


@pytest.mark.docs
def test_the_perturbation_of_the_extending_page(folder, monkeypatch):
    run_blocks(ROOT / "docs" / "extending.rst", monkeypatch)
    page = sys.modules["__page__"]
    run = ae.Simulation(ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1)), seed=1).run(
        30, emissions=[page.FromAbove(0.3), ae.Unperturbed()], progress=False
    )
    above, plain = run.hits(page.FromAbove(0.3)), run.hits(ae.Unperturbed())
    assert (np.hypot(above.x - plain.x, above.y - plain.y)[plain.detected & above.detected] > 0).all()


@pytest.mark.slow
def test_the_command_of_the_extending_page(folder, monkeypatch, capsys):
    run_blocks(ROOT / "docs" / "extending.rst", monkeypatch)
    page = sys.modules["__page__"]
    ae.Simulation(ae.Tip("Ni", apex_radius=2.0, axis=(1, 1, 1))).run(20, progress=False).save("few.h5")
    parser = argparse.ArgumentParser()
    page.arguments(parser)
    capsys.readouterr()
    assert page.execute(parser.parse_args(["few.h5"])) == 0
    assert capsys.readouterr().out == "wrote charges.png\n"
    assert (folder / "charges.png").stat().st_size > 5_000


TUTORIALS = sorted(path.name for path in (ROOT / "examples").glob("tutorial_*.py"))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")  # of small specimens, and ions that missed
@pytest.mark.parametrize("name", TUTORIALS)
def test_examples_run(name, folder, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [name, "200"])
    runpy.run_path(str(ROOT / "examples" / name), run_name="__main__")
    out = capsys.readouterr().out
    assert re.search(r"\d ions", out)
    if name == "tutorial_4_own_perturbation.py":
        largest = float(re.search(r"largest ([\d.]+) mm", out)[1])
        assert 0 < largest < ae.ResponseSettings().bound  # above it an ion would have been marked
    if name == "tutorial_3_fit_energies.py":
        rotation, scale = re.search(r"^rotated by (\S+)°, scaled by ([\d.]+)", out, re.MULTILINE).groups()
        # of the hidden transform, or one that [111] makes equal; a bin of 1.5 mm at the rim of 18 mm is 5 degrees
        assert float(rotation) % 120 == pytest.approx(17, abs=5)
        assert float(scale) == pytest.approx(0.3, rel=1.5 / 18)
        low, high = re.search(
            r"mean of the energies \S+ \((?:at most )?(\S+) to (?:at least )?(\S+)\) eV, hidden 0.2 eV", out
        ).groups()
        assert float(low) < 0.2 < float(high)
        assert "in 100% of the resamples" in out


@pytest.mark.docs
def test_a_measured_file_of_ones_own(folder, monkeypatch, capsys):
    """Not every export has voltages, nor a detector about (0, 0)."""
    held = ae.read("R5083.epos")
    ae.write("R5084.epos", ae.Hits(x=held.x - 2, y=held.y + 1, positions=held.positions, pulse_id=held.pulse_id))
    for name, voltage in (("R5083.epos", True), ("R5084.epos", False)):
        monkeypatch.setattr(sys, "argv", ["tutorial_2_own_measurement.py", name])
        runpy.run_path(str(ROOT / "examples" / sys.argv[0]), run_name="__main__")
        out = capsys.readouterr().out
        assert ("20,000 ions above 4.5 kV" in out) == voltage and f"from '{name}'" in out
        inside = np.count_nonzero(np.hypot(held.x[10_000:], held.y[10_000:]) <= 10)
        assert int(re.search(r"(\d+) of them within 10 mm", out)[1]) == pytest.approx(inside, rel=0.03)  # of 800


def run_article(name, monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", [Path(name).name, *arguments])
    runpy.run_path(str(ROOT / "articles" / name), run_name="__main__")


@pytest.mark.slow
def test_temperatures_are_compared(folder, monkeypatch, capsys):
    run_article("temperature/temperature.py", monkeypatch, "--radius", "8", "--ions", "1500", "--temperatures", "300")
    lines = capsys.readouterr().out.splitlines()
    assert [line[:18] for line in lines[-2:]] == ["300 K, unperturbed", "300 K, roll-up    "]
    assert len(re.findall(r"\d\.\d\d ± \d\.\d\d", lines[-1])) == 3


def test_commands_of_the_readme():
    """Its first command runs a file that is there; its second installs all that pytest is told to use."""
    (name,) = re.findall(r"^ +pip install \. && apt-evap run (\S+)$", README.read_text(), re.MULTILINE)
    assert read_config(ROOT / name).n_ions == 15_000
    (extra,) = re.findall(r"^ +pip install '\.\[(\w+)\]' && pytest$", README.read_text(), re.MULTILINE)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    needed = " ".join(project["project"]["optional-dependencies"][extra])
    assert all(name in needed for name in ("pytest>", "pytest-xdist>", "hypothesis>", "ruff>", "mypy>"))


def test_command_lines_are_understood():
    """Every command line in the pages that is written out is one that the parser takes."""
    from apt_evap.cli.parser import make_parser

    found = set()
    for page in (README, *PAGES):
        text = re.sub(r" \\\n +", " ", page.read_text())  # a command goes on after a backslash
        for line in re.findall(r"`{1,2}(apt-evap [^`]+)`|^ {4}(?:\$ )?(apt-evap [^&|\n]*)$", text, re.MULTILINE):
            found.add(" ".join("".join(line).split()))
    assert len(found) >= 5
    for command in found:
        words = command.split()[1:]
        if len(words) > 1 and not {"--help", "--version"} & set(words):  # one word is the name of a command
            make_parser(words[0]).parse_args(words)


def test_every_option_is_named_in_a_page():
    """Besides the list that is made from the commands."""
    from apt_evap.cli.parser import COMMANDS, make_parser

    text = "\n".join(page.read_text() for page in (README, *PAGES))
    named = set(re.findall(r"--[a-z][a-z0-9-]*", text))
    options = set()
    for command in COMMANDS:
        (commands,) = (action for action in make_parser(command)._actions if isinstance(action.choices, dict))
        options |= {word for action in commands.choices[command]._actions for word in action.option_strings}
    assert len(options) > 100
    assert {option for option in options if option.startswith("--")} - named == set()


def test_methods_of_laws_and_rules_have_the_arguments_of_the_code():
    """``name(arguments)`` of the text: a function of the package has the same ones."""
    text = (ROOT / "docs" / "extending_physics.rst").read_text()
    described = {
        (name, *re.split(r",\s+", names)) for name, names in re.findall(r"``(\w+)\((\w+(?:,\s+\w+)*)\)``", text)
    }
    sources = [path.read_text() for end in ("py", "pyx") for path in (ROOT / "apt_evap").rglob(f"*.{end}")]
    written = set()
    for source in sources:
        for name, names in re.findall(r"def (?:[\w.]+ )*(\w+)\(([^()]*)\)", source):
            arguments = re.sub(r"\[[^]]*\]", "", names).split(",")
            words = [re.split(r"[:=]", argument)[0].split() for argument in arguments]
            written.add((name, *(word[-1] for word in words if word and word[-1] != "self")))
    assert len(described) >= 8
    assert described - written == set()


def test_tables_of_the_settings_page_have_classes():
    tables = tomllib.loads((ROOT / "docs" / "settings.toml").read_text())["table"]
    assert len(tables) > 20
    assert all(inspect.isclass(pkgutil.resolve_name(f"apt_evap.{table['object']}")) for table in tables)


def test_links_lead_somewhere():
    for target in re.findall(r"\]\(([^)]+)\)", README.read_text()):
        assert target.startswith("https://") or (ROOT / target).exists(), target
    # every page is reached from the front page
    found, new = set(), ["index"]
    while new:
        page = new.pop()
        if page not in found and not page.startswith("generated/"):  # made when the pages are built
            found.add(page)
            trees = re.findall(
                r"toctree::\n(?: +:.*\n)*\n((?: +[\w/]+\n)+)", (ROOT / "docs" / f"{page}.rst").read_text()
            )
            folder = page.rpartition("/")[0]
            new += [f"{folder}/{name}".lstrip("/") for name in " ".join(trees).split()]
    assert found == {name_of(page) for page in PAGES}
    # files, modules and folders that pages name in ``double quotes``
    of_the_reader = {"mine.toml", "base.toml", "study.toml"}
    for page in PAGES:
        text = page.read_text()
        for name in set(re.findall(r"``((?:\w+/)*\w+\.(?:py|pyx|pxd|pyi|h|toml))``", text)) - of_the_reader:
            inside = [*(ROOT / "apt_evap").rglob(name), *(ROOT / "articles").rglob(name)]
            assert (ROOT / name).exists() or inside, f"{page.name}: {name}"
        for name in re.findall(r"``(articles/\w+)``", text):
            assert (ROOT / name / "README.md").exists(), f"{page.name}: {name}"
    # the articles: links to other files, and to pages
    for article in (ROOT / "articles").rglob("README.md"):
        for target in re.findall(r"\]\((?!https:)([^)#]+)\)", article.read_text()):
            assert (article.parent / target).exists(), f"{article.parent.name}: {target}"


def test_the_tests_of_the_accuracy_page_exist():
    named = re.findall(r" (\w+/test_\w+)$", (ROOT / "docs" / "accuracy_and_speed.rst").read_text(), re.MULTILINE)
    assert len(named) >= 10
    for name in named:
        assert (ROOT / "tests" / f"{name}.py").exists(), name


# ---- names ---------------------------------------------------------------------------------------------------------

SPACES = [name for name in ae.__all__ if inspect.ismodule(getattr(ae, name))]
NAMES = sorted(set(ae.__all__) - {"__version__", *SPACES})
NAMES += [f"{space}.{name}" for space in SPACES for name in getattr(getattr(ae, space), "__all__", ())]


def sections(documented):
    """Sections of a numpydoc docstring by title."""
    parts = re.split(r"^(\w[\w ]*)\n-{3,}$", inspect.getdoc(documented) or "", flags=re.MULTILINE)
    return {"": parts[0]} | dict(zip(parts[1::2], parts[2::2], strict=True))


def named(section):
    """Names that a section describes."""
    lines = re.findall(r"^(\*{0,2}\w[\w, *]*)(?: :.*)?$", section, re.MULTILINE)
    return {name.strip(" *") for line in lines for name in line.split(",")}


def parameters(documented):
    """Names of the parameters to describe; an error and an enumeration have none of their own."""
    if isinstance(documented, type) and issubclass(documented, Exception | enum.Enum):
        return []
    if not callable(documented):  # a table, such as TUNGSTEN_TABLE
        return []
    if getattr(documented, "_is_protocol", False):
        return []
    if dataclasses.is_dataclass(documented):
        return [field.name for field in dataclasses.fields(documented) if field.init]
    return [name for name in inspect.signature(documented).parameters if name != "self"]


def commented(documented):
    """Fields of a class that have a text below them in its source."""
    if not isinstance(documented, type):
        return set()
    body = ast.parse(textwrap.dedent(inspect.getsource(documented))).body[0].body
    return {
        field.target.id
        for field, text in pairwise(body)
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant)
    }


@pytest.mark.parametrize("name", NAMES)
def test_public_names_are_documented(name):
    documented = attrgetter(name)(ae)
    found = sections(documented)
    assert len(found[""].strip()) > 20
    assert set(parameters(documented)) <= named(found.get("Parameters", "")) | commented(documented)
    if inspect.isfunction(documented) and re.search(r"^    return \S", inspect.getsource(documented), re.MULTILINE):
        assert "Returns" in found
    if isinstance(documented, type):
        for member, value in vars(documented).items():
            if not member.startswith("_") and (callable(value) or isinstance(value, property | classmethod)):
                assert inspect.getdoc(getattr(documented, member)), f"{name}.{member} has no docstring"


def test_the_reader_of_docstrings():
    def f(a, b, *c):
        """Sum.

        Parameters
        ----------
        a, b : float
            Two numbers.
        *c
            More.

        Returns
        -------
        float
        """

    assert set(sections(f)) == {"", "Parameters", "Returns"}
    assert {"a", "b", "c"} <= named(sections(f)["Parameters"])
    assert parameters(f) == ["a", "b", "c"]


def test_a_public_name_stands_in_one_place():
    """One name per thing; what a namespace calls as one of its modules is called would be hidden by it."""
    things = [attrgetter(name)(ae) for name in NAMES]
    assert len({id(thing) for thing in things}) == len(NAMES)
    for space in SPACES:
        folder = ROOT / "apt_evap" / space
        assert not {path.stem for path in folder.glob("*.py")} & set(getattr(getattr(ae, space), "__all__", ())), space
