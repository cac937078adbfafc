"""Settings that are declared once: name, type, bounds, unit, default and text of each field.

A class of settings is a frozen dataclass whose fields are made by `number`, `count`, `switch`, `choice`, `vector`,
`part` or `checked`. These declarations give the check of every argument, the section Parameters of the docstring, the
plain form for HDF5, TOML and JSON (`to_plain`, `from_plain`), and the Python text (`to_python`)::

    @settings
    class Pulse:
        '''Voltage pulses.'''

        width: float = number("Standard deviation of the top", default=0.5, above=0, unit="ns")

Conditions on several fields are in a method ``_check``. It may return a dict of fields to replace. A frozen dataclass
that is not one of settings, such as one of arrays, has the same by ``check_itself`` in its ``__post_init__``.
"""

import math
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass, replace
from typing import Any, ClassVar, TypeVar, dataclass_transform

import numpy as np

from apt_evap._common.validation import (
    check_array,
    check_choice,
    check_count,
    check_kind,
    check_number,
    check_switch,
    did_you_mean,
    short_text,
)

_SETTING = "setting"
_LONG = 10  # characters of a number that is written out
T = TypeVar("T", bound=type)
U = TypeVar("U")


@dataclass(frozen=True)
class _Setting:
    """Declaration of a field: its check, how it is read from its plain form, and its description."""

    text: str
    check: Callable[[Any, str], Any]
    read: Callable[[Any, str], Any] | None
    kind: str
    unit: str
    bounds: str

    def described(self, name: str, default: Any) -> list[str]:
        """Entry of the section Parameters."""
        optional = "" if default is MISSING else ", optional" if default is None else f", default {_python(default)}"
        kind = " ".join(filter(None, (self.kind, self.unit and f"[{self.unit}]", self.bounds)))
        return [
            f"{name} : {kind}{optional}",
            *(f"    {line}" for line in textwrap.wrap(self.text, 110)),
        ]


@contextmanager
def _converting(value: Any, name: str, kind: str) -> Iterator[None]:
    """Name the field and its value if a value of another type stops a conversion, such as a loop over a number."""
    try:
        yield
    except (TypeError, AttributeError, LookupError, OverflowError, RecursionError) as error:
        article = "an" if kind[0] in "aeiou" else "a"
        raise ValueError(f"{name} must be {article} {kind}, got {short_text(value)}") from error


def _field(text, check, default, kind, *, read=None, unit="", bounds="", **options):
    def optional(value, name):
        if value is None and default is None:
            return None
        with _converting(value, name, kind):
            return check(value, name)

    def converted(plain, name):
        with _converting(plain, name, kind):
            return read(plain, name)

    if isinstance(default, list | dict) or callable(default):
        factory = default if callable(default) else default.copy
        options["default_factory"] = factory
        default = factory()
    else:
        options["default"] = default
    return field(metadata={_SETTING: _Setting(text, optional, read and converted, kind, unit, bounds)}, **options)


def _bounds(above=None, at_least=None, at_most=None, below=None):
    if at_least is not None and at_most is not None:
        return f"from {at_least:g} to {at_most:g}"
    signs = ((">", above), (">=", at_least), ("<=", at_most), ("<", below))
    return " and ".join(f"{sign} {bound:g}" for sign, bound in signs if bound is not None)


def number(text: str, *, default: Any = MISSING, unit: str = "", why: str = "", **bounds: float) -> Any:
    """Declare a finite number; bounds as of `check_number`. With the default None, None is allowed."""

    def check(value, name):
        return check_number(value, name, unit=unit, why=why, **bounds)

    return _field(text, check, default, "float", unit=unit, bounds=_bounds(**bounds))


def count(text: str, *, default: Any = MISSING, unit: str = "", **bounds: int) -> Any:
    """Declare an integer; bounds as of `check_count`. With the default None, None is allowed."""

    def check(value, name):
        return check_count(value, name, **bounds)

    return _field(text, check, default, "int", unit=unit, bounds=_bounds(**{"at_least": 0, **bounds}))


def switch(text: str, *, default: Any = MISSING) -> Any:
    """Declare a boolean."""
    return _field(text, check_switch, default, "bool")


def choice(text: str, known: Iterable[str], *, default: Any = MISSING) -> Any:
    """Declare one of several words."""

    def check(value, name):
        return check_choice(value, name, known)

    return _field(text, check, default, "{" + ", ".join(f'"{word}"' for word in known) + "}")


def vector(
    text: str, length: int, *, default: Any = MISSING, unit: str = "", check: Any = None, **bounds: float
) -> Any:
    """Declare a tuple of numbers of a fixed length, each within the bounds; `check` is a further check of the tuple."""

    def check_all(value, name):
        numbers = tuple(check_array(value, name, (length,)).tolist())
        if bounds:
            numbers = tuple(check_number(value, name, unit=unit, **bounds) for value in numbers)
        return numbers if check is None else check(numbers, name)

    kind = f"sequence of float, shape ({length},)"
    return _field(text, check_all, default, kind, unit=unit, bounds=_bounds(**bounds))


def part(text: str, *kinds: type, default: Any = MISSING, check: Any = None, kind: str = "") -> Any:
    """Declare an object of one of several classes of settings.

    Parameters
    ----------
    text : str
        Description.
    *kinds : type
        Classes that a file can contain.
    default : object
        Default; a function is called for it.
    check : callable, optional
        Check of the value, for an interface that other classes may have, too. By default the value must be of `kinds`.
    kind : str
        Type for the docstring, if it is not the names of `kinds`.
    """
    names = " or ".join(kind.__name__ for kind in kinds)

    def of_kinds(value, name):
        return check_kind(value, name, kinds, f"a {names}" + (" or None" if default is None else ""))

    def read(plain, name):
        return from_plain(plain, *kinds, what=name) if isinstance(plain, Mapping) else plain

    return _field(text, check or of_kinds, default, kind or names, read=read)


def checked(
    text: str,
    kind: str,
    check: Callable[[Any, str], Any],
    *,
    default: Any = MISSING,
    read: Any = None,
    unit: str = "",
    **options: Any,
) -> Any:
    """Declare anything else.

    Parameters
    ----------
    text, kind : str
        Description, and type for the docstring.
    check : callable
        Takes a value and its name, returns the checked value.
    default : object
        Default; a function is called for it.
    read : callable, optional
        Takes a plain form and its name, returns the value; by default the plain form is the value.
    unit : str
        Unit for the docstring.
    **options
        Of `dataclasses.field`, such as ``hash=False``.
    """
    return _field(text, check, default, kind, read=read, unit=unit, **options)


@dataclass_transform(frozen_default=True, field_specifiers=(number, count, switch, choice, vector, part, checked))
def settings(cls: T) -> T:
    """Make a class of settings: a frozen dataclass that checks its fields, with its parameters in the docstring."""
    cls.__post_init__ = _check_all  # type: ignore[attr-defined]
    if cls.__repr__ is object.__repr__:
        cls.__repr__ = _short  # type: ignore[method-assign, assignment]
    dataclass(frozen=True, repr=False)(cls)
    cls.__doc__ = _documented(cls)
    cls._settings_class = cls  # type: ignore[attr-defined]
    return cls


def is_settings(thing: Any) -> bool:
    """Whether an object is of a class of settings itself, not of a user's class that inherits from one."""
    return getattr(type(thing), "_settings_class", None) is type(thing)


def _check_all(self):
    for item, setting in declared(type(self)).items():
        object.__setattr__(self, item, setting.check(getattr(self, item), item))
    if hasattr(self, "_check"):
        check_itself(self)


def check_itself(frozen: Any) -> None:
    """Call the method ``_check`` of a new frozen object, and replace the fields that it returns."""
    for item, better in (frozen._check() or {}).items():
        object.__setattr__(frozen, item, better)


def _documented(cls):
    """Docstring with the section Parameters before the first other section."""
    lines = (cls.__doc__ or "").rstrip().split("\n")
    indent = min((len(line) - len(line.lstrip()) for line in lines[1:] if line.strip()), default=4)
    ends = [at for at, line in enumerate(lines) if at and line.strip() and set(line.strip()) == {"-"}]
    first = ends[0] - 1 if ends else len(lines)
    if ends and lines[first].strip() == "Parameters":
        return cls.__doc__
    entries = [
        line
        for item in fields(cls)
        if item.init and _SETTING in item.metadata
        for line in item.metadata[_SETTING].described(item.name, _default(item))
    ]
    section = ["", "Parameters", "----------", *entries, *([""] if ends else [])]
    before = "\n".join(lines[:first]).rstrip().split("\n")
    return "\n".join([*before, *(f"{' ' * indent}{line}".rstrip() for line in section), *lines[first:], " " * indent])


def _default(item: Field) -> Any:
    return item.default if item.default_factory is MISSING else item.default_factory()


def declared(cls: type) -> dict[str, _Setting]:
    """Declarations of the fields of a class of settings by name; empty for other classes."""
    if not is_dataclass(cls):
        return {}
    return {item.name: item.metadata[_SETTING] for item in fields(cls) if _SETTING in item.metadata}


# ---- plain form ----------------------------------------------------------------------------------------------------


def to_plain(thing: Any, *, short: bool = False) -> Any:
    """Object in the plain types of JSON and TOML: texts, numbers, booleans, None, lists and dicts.

    Parameters
    ----------
    thing : object
        Settings become a dict of all fields, with the name of the class under "name" unless a field has this name. Of
        other objects, these are the result of a method ``settings``, the fields of a dataclass or a named tuple, or the
        attributes without a leading underscore. A function becomes its name. A mapping whose keys are objects becomes a
        list of pairs, a complex number a list of two.
    short : bool
        Whether fields with their default are left out, for texts of a user.

    Returns
    -------
    object
        `from_plain` rebuilds settings from it.
    """

    def plain(item):
        return to_plain(item, short=short)

    if thing is None or isinstance(thing, bool | int | float | str):
        return thing
    if isinstance(thing, complex):
        return [thing.real, thing.imag]
    if isinstance(thing, np.generic | np.ndarray):
        return plain(thing.tolist())
    if isinstance(thing, Mapping):
        if all(isinstance(key, str | int | np.integer) for key in thing):
            return {str(key): plain(item) for key, item in thing.items()}
        return [[plain(key), plain(item)] for key, item in thing.items()]
    if isinstance(thing, tuple) and hasattr(thing, "_fields"):
        return {name: plain(item) for name, item in zip(thing._fields, thing, strict=True)}
    if isinstance(thing, list | tuple | set | frozenset):
        return [plain(item) for item in thing]
    if callable(thing) and hasattr(thing, "__qualname__"):
        return f"{thing.__module__}.{thing.__qualname__}"
    return {"name": type(thing).__name__} | {
        name: plain(value)
        for name, (value, default) in _parameters(thing).items()
        if not (short and _same(value, default))
    }


def _parameters(thing):
    """Values and defaults of the parameters of an object by name."""
    if callable(getattr(thing, "settings", None)):
        return {name: (value, MISSING) for name, value in thing.settings().items()}
    if is_dataclass(thing):
        return {item.name: (getattr(thing, item.name), _default(item)) for item in fields(thing) if item.init}
    return {
        name: (value, MISSING) for name, value in getattr(thing, "__dict__", {}).items() if not name.startswith("_")
    }


def _same(content, default):
    return content is default or (type(content) is type(default) and bool(content == default))


def for_json(thing: Any) -> Any:
    """Object in plain types, with None in place of NaN and infinities, which JSON does not have."""
    plain = to_plain(thing)
    if isinstance(plain, float):
        return plain if math.isfinite(plain) else None
    if isinstance(plain, dict):
        return {name: for_json(item) for name, item in plain.items()}
    return [for_json(item) for item in plain] if isinstance(plain, list) else plain


class ForJson:
    """Results with a `to_dict` of the attributes that `_in_json` names, by default of all fields."""

    _in_json: ClassVar[tuple[str, ...]] = ()

    def to_dict(self) -> dict[str, Any]:
        """Results as numbers, texts and lists, None for NaN, for JSON; without arrays that have a row for each ion.

        Returns
        -------
        dict
        """
        names = self._in_json or [item.name for item in fields(self)]  # type: ignore[arg-type]
        return for_json({name: getattr(self, name) for name in names})


def from_plain(plain: Any, *kinds: type, what: str = "settings") -> Any:
    """Rebuild settings from their plain form, or a table of a file, which may lack fields with a default.

    The name of the class is under "name"; it may be missing if there is only one. ValueError for a name or a field that
    is unknown, missing or outside its range.
    """
    check_kind(plain, what, Mapping, "a table")
    by_name = {kind.__name__: kind for kind in kinds}
    kind, values = kinds[0], dict(plain)
    if "name" not in declared(kind):
        name = values.pop("name", None if len(kinds) > 1 else kind.__name__)
        if not isinstance(name, str) or name not in by_name:
            known = ", ".join(by_name)
            raise ValueError(f"{what} must have a name of {known}, got {short_text(name)}{did_you_mean(name, by_name)}")
        kind = by_name[name]
    known = {item.name: item for item in fields(kind) if item.init}  # type: ignore[arg-type]
    for key in values:
        if key not in known:
            hint = did_you_mean(key, known)
            raise ValueError(f"{what} has no {short_text(key)}{hint}; known are {', '.join(known) or 'none'}")
    for key, item in known.items():
        if key not in values and item.default is MISSING and item.default_factory is MISSING:
            raise ValueError(f"{what} must have {key}, got {', '.join(map(str, values)) or 'nothing'}")
    for key, setting in declared(kind).items():
        if key in values and setting.read is not None and values[key] is not None:
            values[key] = setting.read(values[key], key)
    return kind(**values)


def is_plain(thing: Any) -> bool:
    """Whether an object is of the plain types, and not one that has been made already."""
    return thing is None or isinstance(thing, bool | int | float | str | list | tuple | Mapping)


def changed(thing: U, values: Mapping[str, Any]) -> U:
    """Settings with other values of some fields; ValueError for an unknown field."""
    known = declared(type(thing))
    for key in values:
        if key not in known:
            hint = did_you_mean(key, known)
            raise ValueError(f"{type(thing).__name__} has no {short_text(key)}{hint}; known are {', '.join(known)}")
    return replace(thing, **values)  # type: ignore[type-var]


# ---- text ----------------------------------------------------------------------------------------------------------


def to_python(thing: Any, package: str = "ae.", text_of: Callable[[Any], str] = repr) -> str:
    """Python expression of settings, with this prefix of classes (str); fields with their default are left out.

    After a prefix, a class that is not a top-level name is written with its package: ``ae.emission.Thermal``. Values
    that are not settings are written by `text_of`, all digits by default.
    """
    return _python(thing, package, text_of)


def few_digits(value: Any) -> str:
    """Representation of a value with at most six digits of each number that needs more (str)."""
    if isinstance(value, float) and len(repr(value)) > _LONG:
        return f"{value:.6g}"
    if type(value) in (tuple, list):
        inner = ", ".join(map(few_digits, value)) + "," * (type(value) is tuple and len(value) == 1)
        return f"({inner})" if type(value) is tuple else f"[{inner}]"
    return repr(value)


def _short(self):
    """`__repr__` of settings: all fields, with few digits."""
    parts = [f"{item.name}={few_digits(getattr(self, item.name))}" for item in fields(self) if item.repr]
    return f"{type(self).__qualname__}({', '.join(parts)})"


def _python(thing, package="", text_of=repr):
    if not declared(type(thing)):
        if isinstance(thing, tuple | list) and any(declared(type(item)) for item in thing):
            inner = ", ".join(_python(item, package, text_of) for item in thing)
            return f"({inner},)" if len(thing) == 1 else f"({inner})"
        return text_of(thing)
    parts, by_name = [], False
    for item in fields(thing):
        if not (item.init and item.repr):
            continue
        content, default = getattr(thing, item.name), _default(item)
        same = _same(content, default)
        by_name = by_name or bool(item.kw_only) or same
        if not same:
            text = _python(content, package, text_of)
            parts.append(f"{item.name}={text}" if by_name else text)
    return f"{_name(type(thing), package)}({', '.join(parts)})"


def _name(kind, package):
    """Name of a class in a Python expression."""
    package_name, *folders = kind.__module__.split(".")[:2]
    if package and package_name == "apt_evap" and kind.__name__ not in sys.modules[package_name].__all__:
        return f"{package}{folders[0]}.{kind.__name__}"
    return f"{package}{kind.__name__}"
