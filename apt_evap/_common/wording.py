"""Arguments named in messages: as Python writes them, or as a shell does."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar

_options: ContextVar[Mapping[str, str] | None] = ContextVar("options", default=None)


def argument(name: str, value: object = None) -> str:
    """Return an argument as the user of a message writes it.

    Parameters
    ----------
    name : str
        Name of the argument.
    value : object, optional
        Its value; None leaves it out.

    Returns
    -------
    str
        ``name=value`` in Python; the option, and its value unless that is True, within `options_of_a_shell`.
    """
    options = _options.get()
    if options is None or name not in options:
        return name if value is None else f"{name}={value!r}"
    return options[name] if value is None or value is True else f"{options[name]} {value}"


@contextmanager
def options_of_a_shell(options: Mapping[str, str]) -> Iterator[None]:
    """Let messages name options of a shell, given by argument, in place of arguments of Python."""
    token = _options.set(options)
    try:
        yield
    finally:
        _options.reset(token)
