"""Files for package indexes and journals: they agree with the package."""

import re
import runpy
import sys
import tomllib
import types
from pathlib import Path

import pytest
from setuptools import Distribution

from apt_evap import __version__

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
RECIPE = (ROOT / "packaging" / "conda" / "recipe.yaml").read_text()
PAPER = (ROOT / "paper" / "paper.md").read_text()


def listed(section, text):
    """Names and versions of a list of a YAML file, below a key that is indented by two spaces."""
    block = re.search(rf"^  {section}:\n((?:    .*\n)+)", text, re.MULTILINE)[1]
    return {name: version for name, version in re.findall(r"^ +- ([a-z][\w-]*) *(\S*)$", block, re.MULTILINE)}


def needed(requirements):
    """The same of a list of pyproject.toml."""
    return {
        name.lower(): version for name, version in (re.match(r"([\w-]+)(.*)", each).groups() for each in requirements)
    }


def test_the_recipe_needs_what_the_package_needs():
    run = listed("run", RECIPE)
    assert run.pop("python") == ""
    run["matplotlib"] = run.pop("matplotlib-base")  # without Qt
    assert run == needed(PROJECT["dependencies"])
    host = listed("host", RECIPE)
    build = needed(tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"])
    assert {name: host[name] for name in build} == build


def test_the_recipe_has_the_version_and_the_files():
    assert f'version: "{__version__}"' in RECIPE
    named = re.findall(r"tests/[\w/]+\.py", RECIPE)
    assert len(named) == 3 and all((ROOT / name).exists() for name in named)
    for module in re.findall(r"^        - (apt_evap[\w.]*)$", RECIPE, re.MULTILINE):
        assert list(ROOT.glob(module.replace(".", "/") + "*")), module


def test_the_citation_has_the_version():
    citation = (ROOT / "CITATION.cff").read_text()
    assert re.search(r"^version: (\S+)$", citation, re.MULTILINE)[1] == __version__
    assert all(
        re.search(rf"^{key}: ?\S?", citation, re.MULTILINE) for key in ("cff-version", "message", "title", "authors")
    )
    assert f"license: {PROJECT['license']}" in citation


def test_the_paper_has_the_sections_of_the_journal():
    """https://joss.readthedocs.io: paper.md of 750 to 1750 words."""
    _, head, text = PAPER.split("---\n", 2)
    assert all(
        f"\n{key}:" in f"\n{head}" for key in ("title", "tags", "authors", "affiliations", "date", "bibliography")
    )
    sections = re.findall(r"^# (.*)$", text, re.MULTILINE)
    wanted = ["Summary", "Statement of need", "State of the field", "Software design", "Research impact statement"]
    wanted += ["AI usage disclosure", "Acknowledgements", "References"]
    assert [section for section in sections if section in wanted] == wanted
    assert 750 <= len(text.split()) <= 1750


def test_the_paper_cites_what_is_in_its_bibliography():
    entries = re.findall(r"^@\w+\{(\w+),", (ROOT / "paper" / "paper.bib").read_text(), re.MULTILINE)
    cited = set(re.findall(r"@(\w+)", PAPER.split("---\n", 2)[2]))
    assert cited == set(entries) and len(entries) == len(set(entries))


def test_the_numbers_of_the_paper_are_those_of_the_documentation():
    """Rates, and the commands that measure them."""
    documented = (ROOT / "docs" / "accuracy_and_speed.rst").read_text()
    rates = re.findall(
        r"\b\d,\d{3}\b|\b\d{3}\b(?= per second)", PAPER.partition("# Performance and accuracy")[2].partition("\n# ")[0]
    )
    assert len(rates) == 4 and all(rate in documented for rate in rates)
    commands = re.findall(r"`python\s+(benchmarks/\w+\.py)\s+(\w+)`", PAPER)
    assert {part for _, part in commands} == {"rates", "fields"}
    for script, part in commands:
        assert f'"{part}": ' in (ROOT / script).read_text()


@pytest.mark.parametrize("name", ["packaging/conda/recipe.yaml", "CITATION.cff", ".pre-commit-config.yaml"])
def test_yaml_is_valid(name):
    yaml = pytest.importorskip("yaml")
    assert isinstance(yaml.safe_load((ROOT / name).read_text()), dict)


def test_the_compiler_of_microsoft_is_refused(monkeypatch):
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "argv", ["setup.py"])
    monkeypatch.setattr("setuptools.setup", lambda **options: None)
    monkeypatch.setattr("Cython.Build.cythonize", lambda extensions, **options: extensions)
    command = runpy.run_path("setup.py")["BuildCore"](Distribution())
    command.compiler = types.SimpleNamespace(compiler_type="msvc")
    with pytest.raises(SystemExit, match=r"must be GCC, .* got Microsoft's$"):
        command.build_extensions()
