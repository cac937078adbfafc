"""Progress bars of long computations."""

import warnings
from typing import Any


def progress_bar(**options: Any) -> Any:
    """Return a progress bar of tqdm, which is imported at the first call."""
    from tqdm import TqdmWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TqdmWarning)  # in a notebook without ipywidgets, where it is a line of text
        from tqdm.auto import tqdm  # 0.1 s, half of it asyncio

    return tqdm(**options)
