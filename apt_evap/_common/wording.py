"""Names of arguments in messages, in the syntax of Python or of the shell."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar

_options: ContextVar[Mapping[str, str] | None] = ContextVar("options", default=None)


def argument(name: str, value: object = None) -> str:
    """Return an argument in the syntax that the user writes.

    Parameters
    ----------
    name : str
        Name of the argument.
    value : object, optional
        Its value; omitted if None.

    Returns
    -------
    str
        ``name=value`` in Python; within `options_of_a_shell` the option and, unless it is True, its value.
    """
    options = _options.get()
    if options is None or name not in options:
        return name if value is None else f"{name}={value!r}"
    return options[name] if value is None or value is True else f"{options[name]} {value}"


@contextmanager
def options_of_a_shell(options: Mapping[str, str]) -> Iterator[None]:
    """Let messages name the options of the shell, a mapping by argument, instead of the arguments of Python."""
    token = _options.set(options)
    try:
        yield
    finally:
        _options.reset(token)
