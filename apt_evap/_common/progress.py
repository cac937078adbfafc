"""Progress bars of long computations."""

from typing import Any


def progress_bar(**options: Any) -> Any:
    """Return a progress bar of tqdm, which is imported at the first call.

    Parameters
    ----------
    **options
        Arguments of `tqdm.tqdm`.

    Returns
    -------
    tqdm.tqdm
    """
    from tqdm.auto import tqdm  # 0.1 s, half of it asyncio

    return tqdm(**options)
