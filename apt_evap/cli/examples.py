"""`apt-evap examples`: list the examples of the package, or copy them."""

import argparse
import ast

from apt_evap.cli._options import add_speech
from apt_evap.cli._output import tell, tell_json
from apt_evap.cli._shipped import shipped


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = "List the examples of the package: settings files and Python scripts. With --to, copy them."
    parser.epilog = (
        "example:\n"
        "  apt-evap run precipitate               an example by its name: copies precipitate.toml to this folder\n"
        "  apt-evap examples --to apt_examples    all of them"
    )
    parser.add_argument("--to", metavar="FOLDER", help="copy the examples to this folder")
    parser.add_argument("--force", action="store_true", help="overwrite files that differ from the examples")
    add_speech(parser)


def execute(options: argparse.Namespace) -> int:
    """Run the command."""
    from apt_evap._common.files import FileError, check_path, replace_file

    examples = {path.name: path.read_bytes() for path in shipped()}
    titles = {name: _title(name, content.decode()) for name, content in examples.items()}
    if options.to is None:
        for name, title in titles.items():
            tell(options, f"{name:<{max(map(len, titles))}}  {title}")
        tell(
            options, "\napt-evap run NAME runs the example NAME.toml; apt-evap examples --to FOLDER copies these files"
        )
        tell_json(options, {"examples": titles})
        return 0
    folder = check_path(options.to)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(f"cannot write to {str(folder)!r}: {error.strerror or error}") from error
    for name, content in examples.items():
        if not options.force:
            _check_own(folder / name, content)
    for name, content in examples.items():
        with replace_file(folder / name) as file:
            file.write(content)
    tell(options, f"wrote {len(examples)} files to {folder}")
    tell_json(options, {"folder": str(folder), "files": list(examples)})
    return 0


def _check_own(path, content):
    """Check that a file that would be overwritten is an unchanged example."""
    from apt_evap._common.files import FileError, open_for_reading

    if not path.exists():
        return
    with open_for_reading(path) as file:
        if file.read(len(content) + 1) != content:
            raise FileError(f"{str(path)!r} exists and differs from the example: --force overwrites it")


def _title(name, text):
    """First sentence of an example."""
    if name.endswith(".py"):
        return (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0]
    return text.lstrip("# ").partition("\n")[0].partition(". ")[0]
