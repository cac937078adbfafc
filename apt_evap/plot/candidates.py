"""A map with the poles and zone lines of the orientations that it may show."""

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.validation import check_count, check_kind
from apt_evap.maps.indexing.index_map import Indexing
from apt_evap.plot._figure import new_figure
from apt_evap.plot.map_figures import color_limits, detector_map
from apt_evap.plot.pole_labels import poles


def indexing(result: Indexing, *, candidates: int | None = None) -> NDArray[np.object_]:
    """Draw a map, and beside it the same map with the poles and zone lines of its candidates.

    Parameters
    ----------
    result : Indexing
        Result of `index`.
    candidates : int, optional
        Number of candidates; by default one if the map is decided, else all.

    Returns
    -------
    ndarray of matplotlib.axes.Axes
        Shape (n + 1,).
    """
    check_kind(result, "result", Indexing, "an Indexing, the result of index")
    n = (
        (1 if result.decided else len(result.candidates))
        if candidates is None
        else check_count(candidates, "candidates")
    )
    shown = result.candidates[:n]
    columns = min(len(shown) + 1, 3)
    rows = -(-(len(shown) + 1) // columns)
    figure = new_figure((4.4 * columns, 4.8 * rows))
    figure.suptitle(f"{result.verdict}: {result.reason}", fontsize="medium")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax in axes[len(shown) + 1 :]:
        ax.remove()
    axes = axes[: len(shown) + 1]
    map = (
        result.map
        if result.map.smoothing or not result.map.is_counts
        else result.map.smoothed(max(result.map.bin_size))
    )
    limits = color_limits(map)
    for ax in axes:
        detector_map(map, ax, limits=limits, colorbar=False, caption=False)
    for ax, candidate in zip(axes[1:], shown, strict=True):
        poles(ax, candidate.orientation, candidate.projection, region=result.map, families=8)
        ax.set_title(f"{candidate.confidence:.0%}  score {candidate.score:.2f}\n{candidate}", fontsize="small")
    return axes
