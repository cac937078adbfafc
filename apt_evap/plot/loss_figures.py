"""Losses between pulses over temperature and pulse fraction."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, TwoSlopeNorm
from numpy.typing import NDArray

from apt_evap._common.validation import check_choice, check_kind
from apt_evap.evaporation.losses import Conditions
from apt_evap.plot._figure import new_figure, with_default_settings

_LEVELS = (1e-4, 1e-3, 1e-2, 1e-1)  # of the lost share
_LEAST_BIAS = 0.01  # of the colour scale, in units of the true fraction


@with_default_settings
def conditions(
    result: Conditions, element: str | None = None, axes: Sequence[Axes] | None = None
) -> NDArray[np.object_]:
    """Draw the share of an element that is lost between pulses, and the bias of its measured fraction.

    Parameters
    ----------
    result : Conditions
        Result of `evaporation.conditions`, for at least two temperatures and two pulse fractions.
    element : str, optional
        By default the one that is lost most.
    axes : sequence of matplotlib.axes.Axes, optional
        Two axes; a new figure by default.

    Returns
    -------
    ndarray of matplotlib.axes.Axes
        Shape (2,).

    Raises
    ------
    ValueError
        If the element is unknown, or there are too few conditions.

    Examples
    --------
    >>> result = ae.evaporation.conditions({"Al": 0.9, "Cu": 0.1}, law=ae.Arrhenius(50.0, {"Al": 1.0, "Cu": 0.6}))
    >>> lost, bias = ae.plot.conditions(result)
    >>> lost.get_title()
    'Cu that is lost between pulses'
    """
    check_kind(result, "result", Conditions, "Conditions, such as evaporation.conditions(...)")
    if min(len(result.temperatures), len(result.pulse_fractions)) < 2:
        raise ValueError(f"result must have at least two temperatures and two pulse fractions, got {result}")
    if element is None:
        element = result.elements[int(np.argmax(result.lost.max(axis=(1, 2))))]
    index = result.elements.index(check_choice(element, "element", result.elements))
    if axes is None:
        axes = new_figure((9.6, 3.8)).subplots(1, 2)
    lost, bias = np.asarray(axes, dtype=object).ravel()
    horizontal, vertical = result.temperatures, result.pulse_fractions
    shares = np.maximum(result.lost[index].T, _LEVELS[0] / 100)
    norm = LogNorm(_LEVELS[0] / 10, 1.0)
    drawn = lost.pcolormesh(horizontal, vertical, shares, norm=norm, cmap="magma", shading="gouraud")
    lines = lost.contour(horizontal, vertical, shares, levels=_LEVELS, colors="white", linewidths=1.0)
    lost.clabel(lines, fmt=lambda level: f"{100 * level:g} %", fontsize=9)
    lost.figure.colorbar(drawn, ax=lost, label="share that is lost", extend="min")
    lost.set_title(f"{element} that is lost between pulses")
    relative = 100 * result.bias[index].T / result.composition[index]
    most = max(float(np.abs(relative).max()), 100 * _LEAST_BIAS)
    drawn = bias.pcolormesh(
        horizontal, vertical, relative, norm=TwoSlopeNorm(0.0, -most, most), cmap="RdBu_r", shading="gouraud"
    )
    levels = [percent for percent in (-50, -20, -10, -5, -1, 1, 5, 10, 20, 50) if abs(percent) < most]
    lines = bias.contour(horizontal, vertical, relative, levels=levels, colors="black", linewidths=1.0)
    bias.clabel(lines, fmt=lambda level: f"{level:+g} %", fontsize=9)
    bias.figure.colorbar(drawn, ax=bias, label="measured over true fraction, minus 1 [%]")
    bias.set_title(f"measured {element}, {100 * result.composition[index]:.3g} % are true")
    for ax in (lost, bias):
        ax.set(xlabel="temperature [K]", ylabel="pulse fraction")
    return np.array([lost, bias], dtype=object)
