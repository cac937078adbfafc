"""Warnings for a user who has not chosen the settings that they are about."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def advice_as_notes(note: Callable[[str], None]) -> Iterator[None]:
    """Give warnings with an advice as notes without it: the user of a twin has not chosen its settings."""
    show = warnings.showwarning

    def tell(message: Any, category: Any, *where: Any, **options: Any) -> None:
        fact = getattr(message, "fact", "")
        if fact and fact != str(message):
            note(f"note: {fact}")
        else:
            show(message, category, *where, **options)

    warnings.showwarning = tell
    try:
        yield
    finally:
        warnings.showwarning = show
