"""The examples of the package, and how a command finds one by its name."""

import argparse
import re
from pathlib import Path

from apt_evap.cli._output import tell

# in a wheel inside the package, in the repository beside it
_PACKAGE = Path(__file__).parents[1]
_PLACES = (_PACKAGE / "examples", _PACKAGE.parent / "examples")
_SUFFIXES = (".py", ".toml")
_OF_COMMANDS = {"dataset": r"^\[dataset\]", "sweep": r"^\[sweep\]", "visible": r"^\[visibility\]", "run": ""}

NAMED = "The name of a shipped example, such as `{}`, also does: its files are copied to this folder."
"""Sentence for the help of a command that takes a settings file."""


def shipped() -> list[Path]:
    """Files of the examples, sorted."""
    from apt_evap._common.files import FileError

    for place in _PLACES:
        paths = sorted(path for path in place.glob("*") if path.suffix in _SUFFIXES)
        if paths:
            return paths
    raise FileError(f"the examples are not in {str(_PLACES[0])!r}: reinstall the package")


def examples_of(command: str) -> dict[str, Path]:
    """Settings files that a command takes, by name."""
    return {path.stem: path for path in shipped() if path.suffix == ".toml" and _command_of(path) == command}


def _command_of(path):
    text = path.read_text(encoding="utf-8")
    return next(name for name, table in _OF_COMMANDS.items() if re.search(table, text, re.MULTILINE))


def settings_file(options: argparse.Namespace, name: str) -> str:
    """Path of a settings file that a user names, by its path or as an example.

    A file or folder of this path wins. An example is copied to the working folder, with the files that it reads, so
    that all output is beside it and its numbers can be changed; what is in this folder already is left as it is.
    """
    from apt_evap._common.files import FileError, replace_file
    from apt_evap._common.validation import did_you_mean

    path = Path(name)
    if path.is_file() or (path.is_dir() and options.command in ("sweep", "dataset")) or path.name != name or not name:
        return name
    examples = examples_of(options.command)
    stem = name.removesuffix(".toml")
    if stem not in examples:
        if path.suffix:
            return name  # the command says what is wrong with a file
        raise FileError(
            f"{name!r} is neither a file nor an example of apt-evap {options.command}{did_you_mean(name, examples)}; "
            f"its examples are {', '.join(examples)}"
        )
    copied = []
    for source in _with_what_it_reads(examples[stem]):
        target = Path(source.name)
        if not target.exists():
            with replace_file(target) as file:
                file.write(source.read_bytes())
            copied.append(target.name)
    copies = f"copied {' and '.join(copied)} to this folder" if copied else f"{stem}.toml is in this folder already"
    tell(options, f"example {stem}: {copies}; its first lines say which commands show what it is for")
    return f"{stem}.toml"


def _with_what_it_reads(path):
    """The file, and the examples that are named in it between quotes."""
    text = path.read_text(encoding="utf-8")
    return [path, *(other for other in shipped() if other != path and f'"{other.name}' in text)]
