"""Options that set the fields of a class of settings, made from its declarations.

They are read off the source, as help must not wait for NumPy, which the module of the class imports.
"""

import ast
import re
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from apt_evap.cli._options import integer_type, number_type, numbers_type

_PACKAGE = Path(__file__).parents[1]


class _Declaration(NamedTuple):
    """A field of a class of settings: what it is declared by, such as "number", and the arguments."""

    by: str
    text: str
    words: tuple[str, ...]
    kind: str
    options: Mapping[str, Any]


def add_declared(
    parser: Any, module: str, settings: str, fields: Iterable[str], flags: Mapping[str, str] | None = None
) -> None:
    """Add the options that set fields of a class of settings; None unless they are used."""
    declared = declarations(module, settings)
    for field in fields:
        flag = (flags or {}).get(field) or _flag(field)
        declaration = declared[field]
        parser.add_argument(flag, dest=field, help=_help(declaration, declared), **_argument(declaration))


@cache
def declarations(module: str, settings: str) -> dict[str, _Declaration]:
    """Declarations of a class of settings by field, from the source of its module below the package."""
    tree = _tree(module)
    (body,) = (node.body for node in tree.body if isinstance(node, ast.ClassDef) and node.name == settings)
    declared = {}
    for node in body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.value, ast.Call):
            call: Any = node.value
            options = {item.arg: _value(item.value, tree) for item in call.keywords}
            text, *rest = (_value(argument, tree) for argument in call.args)
            kind = rest[0] if call.func.id == "checked" else ""
            words = rest[0] if call.func.id == "choice" else re.findall(r'"([^"]+)"', kind)
            declared[node.target.id] = _Declaration(call.func.id, text, tuple(words), kind, options)  # type: ignore
    return declared


@cache
def _tree(module):
    return ast.parse(_PACKAGE.joinpath(*module.split(".")).with_suffix(".py").read_text(encoding="utf-8"))


def _value(node, tree):
    """Value of a literal or a constant, also of another module; None for anything else, such as a function."""
    if not isinstance(node, ast.Name):
        try:
            return ast.literal_eval(node)
        except ValueError:
            return None
    for line in tree.body:
        if isinstance(line, ast.Assign) and getattr(line.targets[0], "id", "") == node.id:
            return _value(line.value, tree)
        if isinstance(line, ast.ImportFrom) and node.id in [item.name for item in line.names]:
            return _value(node, _tree(line.module.removeprefix("apt_evap.")))
    return None


def _flag(field):
    return f"--{field.replace('_', '-')}"


def _argument(declaration: _Declaration) -> dict[str, Any]:
    """Arguments of `argparse.ArgumentParser.add_argument` for the values of a field."""
    by, options = declaration.by, declaration.options
    unit = options.get("unit") or ""
    if by == "switch":
        return {"action": "store_const", "const": True}
    if declaration.words:
        return {"choices": declaration.words}
    if by == "count" or declaration.kind == "int":
        return {"type": integer_type(options.get("at_least", 0), options.get("at_most")), "metavar": "N"}
    if by == "number":
        type_ = number_type(unit or "1") if options.get("at_least") == 0 else float
        return {"type": type_, "metavar": unit.replace("^", "").upper() or "X"}
    return {"type": numbers_type, "metavar": "N,N,..."}


def _help(declaration: _Declaration, declared: Mapping[str, Any]) -> str:
    """First sentence of the text, with its unit, and the default."""
    first, *others = re.split(r"(?<=\.) (?=[A-Z])", declaration.text)
    first = first.removeprefix("Whether ").rstrip(".")
    unit, default = declaration.options.get("unit"), declaration.options.get("default")
    parts = [f"{first} [{unit}]" if unit else first]
    parts += [sentence.rstrip(".") for sentence in others if sentence.startswith("By default")]
    if default is not None and default is not False:
        shown = ",".join(map(str, default)) if isinstance(default, tuple) else default
        parts.append(f"default: {shown:g}" if isinstance(default, float) else f"default: {shown}")
    text = "; ".join(part[0].lower() + part[1:] if part[1:2].islower() else part for part in parts)
    text = re.sub(r"`+([^`]+)`+", lambda match: _flag(match[1]) if match[1] in declared else match[1], text)
    return text.replace("%", "%%")
