"""A map with the poles and zone lines of the orientations that it may show, beside their predicted patterns."""

import textwrap

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.validation import check_count, check_kind
from apt_evap.detection.color_limits import common_limits
from apt_evap.maps.indexing.index_map import SHOWN, Indexing
from apt_evap.plot._figure import add_colorbar, new_figure, with_default_settings
from apt_evap.plot._labels import legend_below
from apt_evap.plot.map_figures import color_limits, detector_map, wrapped
from apt_evap.plot.pole_labels import poles

_CHARACTERS = 12  # of the title of the figure, per inch
_IN_TITLE = 36  # characters in a line of the title of a map


@with_default_settings
def indexing(result: Indexing, *, candidates: int | None = None) -> NDArray[np.object_]:
    """Draw a map with the poles and zone lines of its candidates, each beside its predicted pattern.

    Parameters
    ----------
    result : Indexing
        Result of `index`.
    candidates : int, optional
        Number of candidates; by default one if the map is decided, else three.

    Returns
    -------
    ndarray of matplotlib.axes.Axes
        Shape (2 n + 1,): the map, and of every candidate the map with its poles, and its pattern.

    Raises
    ------
    ValueError
        If the result has no candidate, as of a map that can show no orientation.
    """
    check_kind(result, "result", Indexing, "an Indexing, the result of index")
    if not result.candidates:
        raise ValueError(f"result must have a candidate to draw, got {result!r}: {result.reason}")
    n = (1 if result.decided else SHOWN) if candidates is None else check_count(candidates, "candidates")
    shown = result.candidates[:n]
    if len(shown) == 1:
        width = 13.2
        figure = new_figure((width, 5.2))
        axes = figure.subplots(1, 3)
    else:
        width = 4.4 * (len(shown) + 1)
        figure = new_figure((width, 9.2))
        grid = figure.subplots(2, len(shown) + 1, squeeze=False)
        grid[1, 0].remove()
        axes = np.concatenate([grid[0, :1], grid[:, 1:].T.ravel()])
    lines = [f"{result.verdict}: {result.reason}", *result.deciding_marks]
    figure.suptitle("\n".join(textwrap.fill(line, int(_CHARACTERS * width)) for line in lines), fontsize="medium")
    map = (
        result.map
        if result.map.smoothing or not result.map.is_counts
        else result.map.smoothed(max(result.map.bin_size))
    )
    limits = color_limits(map)
    observed, patterns = [axes[0], *axes[1::2]], axes[2::2]
    for ax in observed:
        detector_map(map, ax, limits=limits, colorbar=False, caption=False)
    predicted = [candidate.predicted(result.map) for candidate in shown]
    limits_of_patterns = common_limits(predicted)
    for number, (ax, below, candidate) in enumerate(zip(observed[1:], patterns, shown, strict=True), 1):
        poles(ax, candidate.orientation, candidate.projection, region=result.map, families=8)
        ax.set_title(f"candidate {number}\n{wrapped(str(candidate), _IN_TITLE)}", fontsize="small")
        detector_map(predicted[number - 1], below, limits=limits_of_patterns, colorbar=False, caption=False)
        below.set_title(f"pattern of candidate {number}", fontsize="small")
    axes[0].set_title("map", fontsize="small")
    add_colorbar([ax.images[0] for ax in observed], observed)
    add_colorbar([ax.images[0] for ax in patterns], list(patterns), "predicted hits per area / mean")
    legend_below(observed)
    return axes
