"""Field and voltage during a run."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from apt_evap._common.validation import check_count
from apt_evap.analysis.voltage_history import course, evaporation_voltages
from apt_evap.detection.hits import Hits
from apt_evap.plot._figure import new_figure
from apt_evap.simulation.run import Run


def history(run: Run | Hits, axes: Sequence[Axes] | None = None, *, points: int = 200) -> NDArray[np.object_]:
    """Draw field and voltage of the evaporation of a run, or the voltage of a measurement, against the ions.

    The line is the median of successive ions, the band contains 90 % of them.

    Parameters
    ----------
    run : Run or Hits
        A run, or measured ions with a voltage.
    axes : sequence of matplotlib.axes.Axes, optional
        Two axes for a run, one for measured ions; a new figure by default.
    points : int
        Number of points along each line.

    Returns
    -------
    ndarray of matplotlib.axes.Axes
        Shape (2,) for a run, (1,) for measured ions.

    Raises
    ------
    ValueError
        If measured ions have no voltage, or the number of axes is wrong.

    Notes
    -----
    The voltage of a run is from `evaporation_voltages`.
    """
    points = check_count(points, "points", at_least=1)
    panels = _panels(run)
    if axes is None:
        axes = new_figure((6.4, 0.6 + 2.3 * len(panels))).subplots(len(panels), 1, sharex=True, squeeze=False)
    axes = np.atleast_1d(np.asarray(axes, dtype=object)).ravel()
    if len(axes) != len(panels):
        raise ValueError(f"axes must be {len(panels)} for {run!r}, got {len(axes)}")
    for ax, (label, values) in zip(axes, panels, strict=True):
        ions, low, median, high = course(values, points)
        ax.fill_between(ions, low, high, color="C0", alpha=0.25, linewidth=0, label="90 % of the ions")
        ax.plot(ions, median, color="C0", linewidth=1.3, label="median")
        ax.set(ylabel=label, xlim=(0, len(values)))
        ax.grid(alpha=0.3)
    axes[0].legend(loc="best", frameon=False, ncols=2)
    axes[-1].set_xlabel("ions")
    axes[-1].xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
    return axes


def _panels(run):
    """Label and values of each panel."""
    if isinstance(run, Hits):
        (voltage,) = run.require("voltage")
        return [("voltage [V]", voltage)]
    voltages = evaporation_voltages(run)
    return [(f"field at {run.voltage:g} V [V/nm]", run.fields), ("voltage of evaporation [V]", voltages)]
