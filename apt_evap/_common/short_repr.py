"""Short representation of results with arrays: shape and range of each array instead of the numbers."""

from typing import Any

import numpy as np

_SHOWN = 6  # values of an array or of a sequence that are written out
_WIDEST = 120  # characters of a value


def short_repr(thing: Any) -> str:
    """Class and fields of a named tuple or a dataclass, as its ``__repr__`` (str)."""
    names = getattr(thing, "_fields", None) or thing.__dataclass_fields__
    return f"{type(thing).__name__}({', '.join(f'{name}={_text(getattr(thing, name))}' for name in names)})"


def _text(value):
    if isinstance(value, np.ndarray):
        return _of_array(value)
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple | dict) and not hasattr(value, "_fields") and len(value) > _SHOWN:
        return f"<{len(value):,} entries>"
    text = repr(value)
    return text if len(text) <= _WIDEST else f"{text[:_WIDEST].rstrip()}..."


def _of_array(values):
    if values.size <= _SHOWN:
        return np.array2string(values, precision=4, separator=", ", max_line_width=10**6).replace("\n", "")
    between = ""
    if values.dtype.kind in "iuf" and np.isfinite(values).any():
        finite = values[np.isfinite(values)]
        between = f", {finite.min():.4g} to {finite.max():.4g}"
    return f"<array of shape {values.shape}{between}>"
