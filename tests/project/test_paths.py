"""Files and names of the package that texts and scripts outside it name do exist."""

import ast
import importlib
import importlib.util
import inspect
import re
import sys
from pathlib import Path

import pytest
from source_trees import nodes_of

import apt_evap as ae

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "apt_evap"
FOLDERS = sorted(path.name for path in PACKAGE.iterdir() if path.is_dir() and path.name != "__pycache__")
PLACES = ("docs", "articles", "examples", "benchmarks", "tools", "packaging", "paper", ".github", ".ci")
TEXTS = sorted(
    path
    for folder, pattern in ((ROOT, "*.md"), (ROOT, "*.toml"), *((ROOT / name, "**/*") for name in PLACES))
    for path in folder.glob(pattern)
    if (path.suffix in (".rst", ".md", ".py", ".toml", ".sh", ".yml", ".yaml") or path.name == "run")
    and path.is_file()
    and not {"_build", "generated", "_templates"} & set(path.relative_to(ROOT).parts)
)
_FILE = r"[\w/]+\.(?:pyi|py|pyx|pxd|h|npz)\b"


def missing_files(text, folder):
    """Files and folders that a text names and that are not there: of the package, its tests, and beside the text."""
    whole = rf"\b((?:apt_evap|tests)/{_FILE})", r"(?<![\w/.-])((?:apt_evap|tests)/\w+(?:/\w+)*)/?(?![\w/.*<])"
    inner = rf"(?<![\w/.])((?:{'|'.join(FOLDERS)})/{_FILE})"
    named = {(name, (ROOT,)) for pattern in whole for name in re.findall(pattern, text)}
    named |= {(name, (ROOT, PACKAGE, ROOT / "tests", folder)) for name in re.findall(inner, text)}
    return sorted(name for name, places in named if not any((place / name).exists() for place in places))


def exists(name):
    """Whether a dotted name below ``apt_evap`` is a module, or a name in one; its attributes are not checked."""
    at = ae
    for part in name.split("."):
        if not inspect.ismodule(at):
            return True
        try:
            at = getattr(at, part)
        except AttributeError:
            if importlib.util.find_spec(f"{at.__name__}.{part}") is None:
                return False
            at = importlib.import_module(f"{at.__name__}.{part}")
    return True


def missing_names(text):
    """Dotted names ``apt_evap.x`` and ``ae.x`` of a text that the package does not have."""
    named = re.findall(r"(?<![\w./@+-])(?:apt_evap|ae)\.([A-Za-z_][\w.]*\w)", text)
    return sorted({name for name in named if not exists(name)})


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_what_a_text_names_exists(path):
    text = path.read_text()
    assert missing_files(text, path.parent) == []
    assert missing_names(text) == []
    if path.suffix == ".py":
        for node in nodes_of(text):
            if isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] == "apt_evap":
                for item in node.names:
                    assert exists(f"{node.module}.{item.name}".removeprefix("apt_evap.")), (node.module, item.name)


# fields of the nodes of a syntax tree that hold names
NAMES = {ast.Name: ("id",), ast.Attribute: ("attr",), ast.arg: ("arg",), ast.keyword: ("arg",)}
NAMES |= {ast.FunctionDef: ("name",), ast.ClassDef: ("name",), ast.ExceptHandler: ("name",)}
NAMES |= {ast.alias: ("name", "asname"), ast.ImportFrom: ("module",)}


def names_and_texts(path):
    """Names of the code of a file, which words of its texts and comments are not, and its texts."""
    names, texts = set(), []
    for node in nodes_of(path.read_text()):
        if type(node) is ast.Constant:
            if isinstance(node.value, str):
                texts.append(node.value)
        else:
            names.update(getattr(node, name) or "" for name in NAMES.get(type(node), ()))
    return {part for name in names for part in name.split(".")}, texts


def test_names_in_backticks_exist():
    """A name of the package in a page or a docstring occurs in its code, so none is left of an earlier version."""
    texts = {path: [path.read_text()] for path in TEXTS if path.suffix == ".rst"}
    words = set(sys.stdlib_module_names) | {"apt_evap", "scipy"}
    for path in PACKAGE.rglob("*"):
        words.add(path.stem)
        if path.suffix in (".py", ".pyi"):
            names, strings = names_and_texts(path)
            words |= names
            if path.suffix == ".py":
                texts[path] = strings
        elif path.suffix in (".pyx", ".pxd"):
            words |= set(re.findall(r"\w+", path.read_text()))
    assert len(words) > 3_000
    for path, parts in texts.items():
        for name in re.findall(r"(?<![`\w:])`([A-Za-z_][\w.]*)`(?![`_])", "\n".join(parts)):
            assert set(name.strip(".").split(".")) <= words, f"{path.relative_to(ROOT)}: {name}"
