"""Profiles, fitted lines and the comparison of two profiles; rectangles on a map."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from apt_evap.maps.profiles import Profile, Rectangle, compare_profiles
from apt_evap.maps.zone_line import ZoneLine
from apt_evap.plot._figure import DrawnAxes, new_figure, with_default_settings


@with_default_settings
def profile(
    profiles: Profile | Sequence[Profile],
    labels: Sequence[str] | None = None,
    ax: Axes | None = None,
    *,
    lines: Sequence[ZoneLine] | None = None,
    xlabel: str = "distance from the line [mm]",
) -> DrawnAxes:
    """Draw profiles with their errors, and fitted lines.

    Parameters
    ----------
    profiles : Profile or sequence of Profile
        The profiles.
    labels : sequence of str, optional
        One label each.
    ax : matplotlib.axes.Axes, optional
        Where to draw; a new figure by default.
    lines : sequence of ZoneLine, optional
        Results of `fit_zone_line`; None for a profile without.
    xlabel : str
        Quantity of the positions, with its unit.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    ValueError
        If there is no profile, or the numbers of profiles, labels and lines differ.
    """
    profiles = [profiles] if isinstance(profiles, Profile) else list(profiles)
    n = len(profiles)
    labels = [None] * n if labels is None else list(labels)
    lines = [None] * n if lines is None else list(lines)
    if not n or len(labels) != n or len(lines) != n:
        raise ValueError(
            f"a plot needs profiles, with one label and line each, got {n}, {len(labels)} and {len(lines)}"
        )
    if ax is None:
        ax = new_figure((5.6, 4.0)).subplots()
    for index, (one, label, line) in enumerate(zip(profiles, labels, lines, strict=True)):
        color = f"C{index}"
        errors = one.error if np.isfinite(one.error).any() else None
        if line is not None:
            label = f"{label or line.kind}: {line.width:.2f} ± {line.width_error:.2f} {line.unit}"
            fine = np.linspace(one.position[0], one.position[-1], 400)
            ax.plot(fine, line.density(fine), color=color, linewidth=1.5, alpha=0.85)
        ax.errorbar(
            one.position, one.density, errors, color=color, fmt="os"[index % 2], markersize=3.5, elinewidth=0.9,
            linestyle="none" if line is not None else "-", linewidth=1.0, label=label,
        )  # fmt: skip
    ax.set(xlabel=xlabel, ylabel="hits per area / mean", ylim=(0, None))
    ax.grid(alpha=0.3)
    if any(label or line for label, line in zip(labels, lines, strict=True)):
        ax.set_ylim(0, 1.25 * ax.get_ylim()[1])  # space for the legend
        ax.legend(loc="upper center", frameon=False, fontsize="small")
    return ax


@with_default_settings
def profile_comparison(
    first: Profile,
    second: Profile,
    labels: Sequence[str] | None = None,
    axes: Sequence[Axes] | None = None,
    *,
    lines: Sequence[ZoneLine] | None = None,
) -> NDArray[np.object_]:
    """Draw two profiles of the same rectangle, and below them their difference in units of the error.

    Parameters
    ----------
    first, second : Profile
        Profiles with the same bins and with errors.
    labels : sequence of str, optional
        One label each.
    axes : sequence of matplotlib.axes.Axes, optional
        Two axes, for the profiles and for the difference; a new figure by default.
    lines : sequence of ZoneLine, optional
        Fitted line of each profile.

    Returns
    -------
    ndarray of matplotlib.axes.Axes
        Shape (2,).

    Raises
    ------
    ValueError
        If bins differ, or a profile has no errors.
    """
    comparison = compare_profiles(first, second)
    if axes is None:
        axes = new_figure((5.6, 5.2)).subplots(2, 1, sharex=True, height_ratios=(3, 1))
    upper, lower = axes
    profile([first, second], labels, upper, lines=lines)
    upper.set_xlabel("")
    upper.tick_params(labelbottom=False)
    bin_width = comparison.position[1] - comparison.position[0] if len(comparison.position) > 1 else 1.0
    lower.axhspan(-1, 1, color="0.9", linewidth=0)
    lower.axhline(0, color="0.4", linewidth=0.8)
    lower.bar(comparison.position, comparison.difference, 0.8 * bin_width, color="0.35")
    reach = max(4.0, 1.6 * np.nanmax(np.abs(comparison.difference)))  # space for the text above the bars
    lower.set(ylim=(-reach, reach), xlabel="distance from the line [mm]", ylabel="difference\n/ error")
    lower.annotate(
        f"$\\chi^2$ = {comparison.chi_square:.0f} for {comparison.degrees_of_freedom}", (0.02, 0.95),
        xycoords="axes fraction", va="top", fontsize="small",
    )  # fmt: skip
    return np.array([upper, lower])


@with_default_settings
def rectangles(
    chosen: Rectangle | Sequence[Rectangle], ax: Axes, *, colors: Any = "cyan", labels: Sequence[str] | None = None
) -> DrawnAxes:
    """Draw one or several rectangles on a detector map, with a thin line at the zero of the profile."""
    chosen = [chosen] if isinstance(chosen, Rectangle) else list(chosen)
    colors = [colors] * len(chosen) if isinstance(colors, str) else list(colors)
    for index, (rectangle, color) in enumerate(zip(chosen, colors, strict=True)):
        corners = rectangle.corners
        ax.add_patch(Polygon(corners, fill=False, edgecolor=color, linewidth=1.6))
        ends = (corners[[0, 1]] + corners[[3, 2]]) / 2
        ax.plot(*ends.T, color=color, linewidth=0.7, linestyle=(0, (4, 4)))
        if labels is not None:
            place = max(corners, key=lambda corner: corner.sum())
            ax.annotate(labels[index], place, xytext=(3, 3), textcoords="offset points", color=color, fontweight="bold")
    return ax
