"""Options of a command that are made from the declarations of a class of settings."""

import argparse
import re
from collections.abc import Iterable
from dataclasses import MISSING, fields
from typing import Any

from apt_evap._common.codec import declared

_CONVERT = {"float": float, "int": int}


def add_declared(group: Any, cls: type, names: Iterable[str]) -> None:
    """Add an option for each of these fields of a class of settings, with its check, unit and text.

    Parameters
    ----------
    group : argparse group or parser
        Where the options are added.
    cls : type
        The class.
    names : iterable of str
        Names of fields that are numbers or words. The option of ``shank_angle`` is ``--shank-angle``; its value is
        None if it is omitted.
    """
    defaults = {field.name: field.default for field in fields(cls)}
    for name in names:
        setting = declared(cls)[name]
        # without the marks of documentation, as a phrase
        text = setting.text.replace("`", "").replace("%", "%%").removesuffix(".")
        text = text[0].lower() + text[1:] if text[1].islower() else text
        if defaults[name] not in (None, MISSING):
            text += f"; default: {defaults[name]}"
        words = re.findall(r'"(\w+)"', setting.kind)
        metavar = re.sub(r"\W", "", setting.unit).upper() or "X"
        values: dict[str, Any] = {"choices": words} if words else {"type": _type(setting), "metavar": metavar}
        group.add_argument(f"--{name.replace('_', '-')}", help=text, **values)


def declared_values(options: argparse.Namespace, names: Iterable[str]) -> dict[str, Any]:
    """Values of those of these fields whose options are given."""
    return {name: getattr(options, name) for name in names if getattr(options, name) is not None}


def _type(setting):
    """Function of a text that converts and checks it."""

    def value(text):
        try:
            content = _CONVERT[setting.kind](text)
        except ValueError:
            content = text
        try:
            return setting.check(content, "")
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error).strip()) from None

    return value
