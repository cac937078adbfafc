"""Maps folded about a pole, side by side."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from apt_evap.maps.folded_map import FoldedMap
from apt_evap.plot._figure import OUTSIDE, add_colorbar, new_figure, with_default_settings


@with_default_settings
def folded_maps(maps: Mapping[str, FoldedMap], *, colormap: str = "inferno") -> NDArray[np.object_]:
    """Draw folded maps side by side, with a common colour scale.

    The first map is the measured one: the titles of the others have their correlation with it.

    Parameters
    ----------
    maps : mapping of str to FoldedMap
        Maps by title, of the same pole and reach.
    colormap : str
        Name of a colour map of matplotlib.

    Returns
    -------
    ndarray of matplotlib.axes.Axes
        Shape (n,), one per map.

    Raises
    ------
    ValueError
        If no map is given, or the maps differ in symmetry or reach.
    """
    if not maps:
        raise ValueError("folded_maps needs at least one map, got none")
    first = next(iter(maps.values()))
    titles = [
        title if folded is first else f"{title}: correlation {folded.correlation(first):.2f}"
        for title, folded in maps.items()
    ]
    values = np.concatenate([folded.flattened[np.isfinite(folded.flattened)] for folded in maps.values()])
    low, high = np.percentile(values, [0.5, 99.5])
    figure = new_figure((3.6 * len(maps) + 1.0, 4.0))
    axes = figure.subplots(1, len(maps), squeeze=False, sharey=True).ravel()
    for ax, title, folded in zip(axes, titles, maps.values(), strict=True):
        end = folded.angles[-1]
        ax.imshow(
            folded.flattened, origin="lower", extent=(-end, end, -end, end), cmap=colormap, vmin=low, vmax=high,
        )  # fmt: skip
        ax.set(xlabel="angle from the pole [degrees]", facecolor=OUTSIDE)
        ax.set_title(title, fontsize="medium")
    axes[0].set_ylabel("angle from the pole [degrees]")
    add_colorbar([ax.images[0] for ax in axes], list(axes), label="density / its mean nearby")
    return axes
