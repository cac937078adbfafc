"""Maps of charge state ratios, or of the fields from them, side by side."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from numpy.typing import NDArray

from apt_evap._common.validation import check_array, check_choice, check_kind
from apt_evap.plot._figure import (
    OUTSIDE,
    add_colorbar,
    ion_label,
    new_figure,
    set_caption,
    set_log_ticks,
    set_title,
    with_default_settings,
)
from apt_evap.plot.map_figures import describe
from apt_evap.spectra.charge_states import ChargeStateMap

_LEAST_RANGE = {
    "ratio": 1.5,
    "field": 1.005,
}  # high over low end of a scale, to which noise would otherwise be stretched


@with_default_settings
def charge_states(
    simulated: ChargeStateMap,
    measured: ChargeStateMap | None = None,
    axes: Sequence[Axes] | None = None,
    *,
    titles: Sequence[str] | None = None,
    quantity: str = "ratio",
    limits: tuple[float, float] | None = None,
    colormap: str = "viridis",
) -> NDArray[np.object_]:
    """Draw maps of charge state ratios side by side with a common colour scale, or a single one.

    Parameters
    ----------
    simulated, measured : ChargeStateMap
        Results of `charge_state_ratio_map` for the same element and charges. Bins with too few ions are grey.
    axes : sequence of matplotlib.axes.Axes, optional
        One per map; a new figure by default.
    titles : sequence of str, optional
        One title per map; "simulated" and "measured" by default.
    quantity : {"ratio", "field"}
        Ratio of the numbers of ions on a logarithmic scale, or the field that follows from it [V/nm].
    limits : tuple of float, optional
        Ends of the colour scale; by default the 1 and 99 percentiles of all bins.
    colormap : str
        Name of a colour map of matplotlib.

    Returns
    -------
    ndarray of matplotlib.axes.Axes
        One per map.

    Raises
    ------
    ValueError
        If the maps are of different ions, or an argument is invalid.
    """
    check_choice(quantity, "quantity", tuple(_LEAST_RANGE))
    maps = [check_kind(simulated, "simulated", ChargeStateMap, "a ChargeStateMap")]
    if measured is not None:
        maps.append(check_kind(measured, "measured", ChargeStateMap, "a ChargeStateMap"))
    ions = [(map.element, map.charge) for map in maps]
    if len(set(ions)) > 1:
        named = " and ".join(f"{element}{charge + 1}+/{element}{charge}+" for element, charge in ions)
        raise ValueError(f"the maps must be of the same element and charges, got {named}")
    if titles is None:
        titles = ("simulated", "measured") if len(maps) == 2 else ("",)
    if axes is None:
        axes = new_figure((4.1 * len(maps) + 1.1, 4.3)).subplots(1, len(maps), squeeze=False)
    axes = np.atleast_1d(np.asarray(axes, dtype=object)).ravel()
    if len(axes) != len(maps) or len(titles) != len(maps):
        raise ValueError(f"axes and titles must be {len(maps)}, one per map, got {len(axes)} and {len(titles)}")
    values = [getattr(map, quantity) for map in maps]
    ends = [_ends(map, value) for map, value in zip(maps, values, strict=True)]
    if all(np.array_equal(map.counts.extent, maps[0].counts.extent) for map in maps):
        low_ends, high_ends = np.min(ends, axis=(0, 2)), np.max(ends, axis=(0, 2))
        ends = [np.column_stack([low_ends, high_ends])] * len(maps)
    low, high = _limits(values, quantity) if limits is None else check_array(limits, "limits", (2,)).tolist()
    if not (low < high and (low > 0 or quantity == "field")):
        raise ValueError(f"limits must be low < high, and > 0 for ratios, got {low:g} and {high:g}")
    scale = (LogNorm if quantity == "ratio" else Normalize)(low, high)
    for ax, map, value, (xlim, ylim), title in zip(axes, maps, values, ends, titles, strict=True):
        ax.imshow(value, origin="lower", extent=map.counts.extent, cmap=colormap, norm=scale, interpolation="nearest")
        ax.set(facecolor=OUTSIDE, aspect="equal", xlabel="x [mm]", ylabel="y [mm]", xlim=xlim, ylim=ylim)
        set_title(ax, title, pad=8)
        set_caption(ax, f"{describe(map.to_map('ratio'))}, ratio {map.total:.3g}")
    element, charge = ions[0]
    label = f"{ion_label(element, charge + 1)} / {ion_label(element, charge)}"
    if quantity == "field":
        label = f"field from {label} [V/nm]"
    bar = add_colorbar([ax.images[0] for ax in axes], list(axes), label=label)
    if quantity == "ratio":
        set_log_ticks(bar.ax.yaxis)
    return axes


def _limits(values, quantity):
    """Ends of a common colour scale that noise alone does not stretch."""
    finite = np.concatenate([value[np.isfinite(value)] for value in values])
    low, high = np.percentile(finite, [1, 99])
    wider = max(np.sqrt(_LEAST_RANGE[quantity] * low / high), 1.0)
    return float(low / wider), float(high * wider)


def _ends(map, values):
    """Limits of the axes around the bins with enough ions, with a margin of half a bin, shape (2, 2)."""
    ends = []
    for edges, axis in ((map.counts.x_edges, 0), (map.counts.y_edges, 1)):
        index = np.flatnonzero(np.isfinite(values).any(axis=axis))
        margin = (edges[1] - edges[0]) / 2
        ends.append((edges[index[0]] - margin, edges[index[-1] + 1] + margin))
    return ends
