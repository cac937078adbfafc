"""Columns as a DataFrame of pandas, an optional package."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from apt_evap._common.optional_imports import optional_import

if TYPE_CHECKING:
    import pandas


def to_dataframe(columns: Mapping[str, NDArray[Any]], **attributes: Any) -> "pandas.DataFrame":
    """Make a pandas DataFrame.

    Parameters
    ----------
    columns : mapping of str to ndarray
        Columns, shape (n,) or (n, k); a column with several values per row becomes name_0, name_1, ...
    **attributes
        Stored in ``attrs`` of the DataFrame.

    Returns
    -------
    pandas.DataFrame

    Raises
    ------
    ImportError
        If pandas is not installed.
    """
    single = {}
    for name, values in columns.items():
        single |= {name: values} if values.ndim == 1 else {f"{name}_{k}": part for k, part in enumerate(values.T)}
    frame = optional_import("pandas", "to_dataframe").DataFrame(single)
    frame.attrs.update(attributes)
    return frame
