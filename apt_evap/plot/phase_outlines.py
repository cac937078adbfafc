"""Outlines of the ions of phases over detector maps: where a feature is that is a dark or bright spot."""

from collections.abc import Mapping, Sequence

import numpy as np
import scipy
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke

from apt_evap.detection.detector_map import DetectorMap
from apt_evap.plot._figure import with_default_settings

_PART = 0.9  # of the ions of a phase inside its outline
_LARGEST = 0.5  # of the area of all ions: a larger phase has no place of its own
_ABOVE = 1.0001  # times the level, in a hole
_COLORS = ("#00ffcc", "#ff7bd5", "#ffffff")  # not those of zone lines


@with_default_settings
def phase_outlines(
    axes: Sequence[Axes], maps: Sequence[DetectorMap], phases: Sequence[Mapping[str, DetectorMap]]
) -> None:
    """Draw the outline of 90 % of the ions of each phase over maps, with a label for a legend.

    `phases` has for each map the maps of the ions of phases, by their names, with the same bins. A phase whose ions are
    all over the map, such as layers along the axis, is left out.
    """
    names = list(dict.fromkeys(name for parts in phases for name in parts))
    for ax, whole, parts in zip(axes, maps, phases, strict=True):
        for name, part in parts.items():
            level = _level(part)
            inside = scipy.ndimage.binary_fill_holes(part.values >= level)  # such as the dark pole in its middle
            if np.count_nonzero(inside) > _LARGEST * np.count_nonzero(whole.values >= _level(whole)):
                continue
            color = _COLORS[names.index(name) % len(_COLORS)]
            filled = np.where(inside, np.maximum(part.values, level * _ABOVE), np.where(part.mask, part.values, 0))
            lines = ax.contour(*part.centres, filled, [level], colors=color, linewidths=1.4)
            lines.set_path_effects([withStroke(linewidth=2.6, foreground="black")])
            ax.plot([], [], color=color, label=f"{_PART:.0%} of the ions of the phase {name}")


def _level(map):
    """Value of a map above which most of its ions are."""
    values = np.sort(map.values[map.mask])[::-1]
    total = np.cumsum(values)
    return values[np.searchsorted(total, _PART * total[-1])]
