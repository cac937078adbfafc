"""Warnings that are shown and also kept."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def recorded_warnings(hidden: tuple[type[Warning], ...] = ()) -> Iterator[list[Any]]:
    """Yield a list that receives every warning; those of other classes than `hidden` are also shown as before."""
    messages: list[Any] = []
    show = warnings.showwarning

    def record(message: Any, *where: Any, **options: Any) -> None:
        messages.append(message)
        if not isinstance(message, hidden):
            show(message, *where, **options)

    warnings.showwarning = record
    try:
        yield messages
    finally:
        warnings.showwarning = show
