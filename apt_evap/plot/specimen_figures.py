"""Surface atoms of a specimen, seen from any direction, and slices of a specimen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike

from apt_evap._common.validation import check_array, check_choice, check_kind, check_number, short_text
from apt_evap.evaporation.emitter import Emitter
from apt_evap.plot._figure import DrawnAxes, add_colorbar, new_figure, set_title, with_default_settings
from apt_evap.simulation.simulation import Simulation
from apt_evap.specimen.tip import Tip

_SMALL = 0.75  # diameter of a disc [d_nn], so that atoms in the second plane are visible
_VOLTAGE = 1000.0  # [V] of a tip without a simulation
COLORED_BY = {"fields": "field [V/nm]", "charges": "charge [e]"}


@with_default_settings
def specimen(
    emitter: Emitter | Simulation | Tip,
    color: str | ArrayLike = "fields",
    ax: Axes | None = None,
    *,
    elevation: float = 90.0,
    azimuth: float = -90.0,
    label: str | None = None,
    limits: tuple[float, ...] | None = None,
    colormap: str = "viridis",
    colorbar: bool = True,
    title: str | None = None,
) -> DrawnAxes:
    """Draw the surface atoms of a specimen as discs, front atoms over back atoms.

    Parameters
    ----------
    emitter : Emitter or Simulation or Tip
        The charged surface; of a simulation its current one. The surface of a tip is charged at 1000 V by Robin's
        equation, which takes seconds for a large tip.
    color : str or array_like
        "fields", "charges", or one number per surface atom, shape (n,).
    ax : matplotlib.axes.Axes, optional
        Where to draw; a new figure by default.
    elevation, azimuth : float
        Position of the viewer [degrees]: above the x-y plane, and around z from x towards y. By default above the apex,
        with x to the right and y upwards; 25 and -60 give a side view.
    label : str, optional
        Quantity of the colours, with its unit, if `color` is an array.
    limits : tuple of float, optional
        Values at the ends of the colour scale; by default the 1 and 99.5 percentiles of the visible evaporable atoms,
        without the rim of the base.
    colormap : str
        Name of a colour map of matplotlib.
    colorbar : bool
        Whether to draw a colour bar.
    title : str, optional
        Title above the picture.

    Returns
    -------
    matplotlib.axes.Axes
        Its ``figure.savefig`` writes the picture.

    Raises
    ------
    ValueError
        If `color` is neither of these names nor one number per surface atom.
    """
    emitter = _emitter_of(emitter)
    if isinstance(color, str):
        if color not in COLORED_BY:
            raise ValueError(f"color must be one of {', '.join(COLORED_BY)}, or numbers, got {short_text(color)}")
        values, label = getattr(emitter, color), label or COLORED_BY[color]
    else:
        values = check_array(color, "color", (len(emitter),), finite=False)
    right, up, towards = _viewed_from(elevation, azimuth)
    facing = np.flatnonzero(emitter.normals @ towards > 1e-9)  # 1e-9: perpendicular normals do not count
    positions = emitter.positions[facing]
    facing = facing[np.argsort(positions @ towards, kind="stable")]  # front atoms are drawn last
    positions, values = emitter.positions[facing], values[facing]
    if limits is None:
        evaporable = values[emitter.tip.evaporable[emitter.atoms[facing]]]
        limits = np.nanpercentile(evaporable if len(evaporable) else values, [1, 99.5])
    diameter = emitter.tip.nearest_neighbour_distance
    places = np.column_stack([positions @ right, positions @ up])
    low, high = places.min(axis=0) - diameter, places.max(axis=0) + diameter
    if ax is None:
        width, height = (high - low) * (4.5 / max(high - low))
        figure = new_figure((width + 1.2, height + 0.5))
        figure.set_layout_engine("compressed")  # for axes with a fixed aspect ratio
        ax = figure.subplots()
    _discs(ax, places, 2 * diameter, color="0.2")  # background in the gaps of the surface, and outline
    atoms = _discs(ax, places, diameter, array=values, cmap=colormap, clim=tuple(limits))
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    set_title(ax, title)
    if abs(elevation) == 90 and azimuth == -90:
        ax.set(xlabel="x [nm]", ylabel="y [nm]" if elevation > 0 else "-y [nm]")
    else:
        _scale_instead_of_axes(ax, right, up, low, high)
    if colorbar:
        add_colorbar([atoms], ax, label or "")
    return ax


def _emitter_of(specimen):
    """The charged surface of a specimen."""
    if isinstance(specimen, Simulation):
        return specimen.emitter
    if isinstance(specimen, Tip):
        return Emitter(specimen, _VOLTAGE)
    return check_kind(specimen, "emitter", Emitter, "an Emitter, a Simulation or a Tip")


def _discs(ax, places, diameter, **colors):
    """Draw discs with a diameter [nm] that scales with the axes."""
    sizes = np.full(len(places), diameter)
    discs = EllipseCollection(
        sizes, sizes, np.zeros(len(places)), units="xy", offsets=places, offset_transform=ax.transData,
        linewidths=0, rasterized=True, **colors,
    )  # fmt: skip
    ax.add_collection(discs, autolim=False)
    return discs


@with_default_settings
def cut(
    tip: Tip,
    color: str = "phase",
    ax: Axes | None = None,
    *,
    point: ArrayLike = (0.0, 0.0, 0.0),
    normal: ArrayLike = (0.0, 1.0, 0.0),
    thickness: float | None = None,
    left: ArrayLike | None = None,
    colors: Mapping[str, Any] | None = None,
    legend: bool = True,
    title: str | None = None,
) -> DrawnAxes:
    """Draw the atoms of a thin slice of a specimen, coloured by phase or by species; rare species on top.

    Parameters
    ----------
    tip : Tip
        The specimen, or a shell of it.
    color : {"phase", "species"}
        What the colours show.
    ax : matplotlib.axes.Axes, optional
        Where to draw; a new figure by default.
    point : array_like
        A point in the middle of the slice [nm], shape (3,).
    normal : array_like
        Normal of the slice, shape (3,). By default the slice contains the axis of the tip, with x to the right and z
        upwards; (0, 0, 1) is a slice across the axis, seen from above.
    thickness : float, optional
        Thickness of the slice [nm]; by default two nearest neighbour distances of the matrix.
    left : array_like of bool, optional
        Atoms that are left in the specimen, shape (n,); by default all.
    colors : mapping, optional
        Colours by name of the phase or of the element; by default those of matplotlib's "tab10".
    legend : bool
        Whether to draw a legend with the names.
    title : str, optional
        Title above the picture.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    ValueError
        If `color` is another word, or no atom is in the slice.
    """
    check_choice(color, "color", ("phase", "species"))
    point = check_array(point, "point", (3,))
    across = check_array(normal, "normal", (3,))
    length = float(np.linalg.norm(across))
    if length == 0:
        raise ValueError(f"normal must not be zero, got {short_text(normal)}")
    across = across / length
    diameter = tip.nearest_neighbour_distance
    thickness = 2 * diameter if thickness is None else check_number(thickness, "thickness", above=0, unit="nm")
    inside = np.abs((tip.positions - point) @ across) <= 0.5 * thickness
    if left is not None:
        inside &= check_array(left, "left", (len(tip),), dtype=bool)
    atoms = np.flatnonzero(inside)
    if not len(atoms):
        raise ValueError(f"no atom is in the slice of {thickness:g} nm at {point.tolist()}")
    right, up = _axes_of_slice(across)
    places = np.column_stack([tip.positions[atoms] @ right, tip.positions[atoms] @ up])
    names = tip.phase_names if color == "phase" else tuple(element.name for element in tip.elements)
    numbers = tip.phase[atoms] if color == "phase" else tip.species[atoms]
    towards = (tip.positions[atoms] - point) @ np.cross(right, up)
    # rare species are drawn over frequent ones, and front atoms over back atoms
    counts = np.bincount(numbers, minlength=len(names)) if color == "species" else np.zeros(len(names))
    order = np.lexsort((towards, -counts[numbers]))
    distinct = list(dict.fromkeys(names))  # species of one element may differ in their evaporation fields
    palette = {name: f"C{number % 10}" for number, name in enumerate(distinct)} | dict(colors or {})
    low, high = places.min(axis=0) - diameter, places.max(axis=0) + diameter
    if ax is None:
        width, height = (high - low) * (4.5 / max(high - low))
        figure = new_figure((width + 1.6, height + 0.7))
        figure.set_layout_engine("compressed")  # for axes with a fixed aspect ratio
        ax = figure.subplots()
    shades = np.array([to_rgba(palette[name]) for name in names])[numbers[order]]
    _discs(ax, places[order], diameter if color == "phase" else _SMALL * diameter, facecolors=shades)
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    ax.set(xlabel=f"{_direction(right)} [nm]", ylabel=f"{_direction(up)} [nm]")
    set_title(ax, title)
    if legend:
        shown = [name for name in distinct if any(names[number] == name for number in np.unique(numbers))]
        handles = [Line2D([], [], marker="o", linestyle="", color=palette[name], label=name) for name in shown]
        ax.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, handletextpad=0.2)
    return ax


def _axes_of_slice(across):
    """Unit vectors to the right and upwards: z upwards if the slice contains it, otherwise x to the right."""
    up = np.array([0.0, 0.0, 1.0]) - across[2] * across
    if np.linalg.norm(up) < 1e-6:
        up = np.array([0.0, np.sign(across[2]), 0.0])
    up = up / np.linalg.norm(up)
    right = np.cross(across, -up) if abs(across[2]) < 1 - 1e-6 else np.array([1.0, 0.0, 0.0])
    return (-right if right[np.argmax(np.abs(right))] < 0 else right), up


def _direction(vector):
    """Name of an axis, or "along (x, y, z)"."""
    for name, unit in zip("xyz", np.eye(3), strict=True):
        if np.allclose(vector, unit):
            return name
    return "along (" + ", ".join(f"{component:.2g}" for component in vector) + ")"


@with_default_settings
def mark_atoms(
    positions: ArrayLike,
    ax: Axes,
    *,
    colors: Any = "black",
    elevation: float = 90.0,
    azimuth: float = -90.0,
) -> DrawnAxes:
    """Draw dashed circles around atoms [nm], shape (n, 3), in a plot of the specimen with these angles [degrees]."""
    positions = check_array(positions, "positions", ("n", 3))
    right, up, _ = _viewed_from(elevation, azimuth)
    ax.scatter(
        positions @ right, positions @ up, s=14.0**2, facecolors="none", edgecolors="white", linewidths=3.2, zorder=3
    )
    ax.scatter(
        positions @ right, positions @ up, s=14.0**2, facecolors="none", edgecolors=colors, linewidths=1.8,
        linestyles=(0, (2.5, 1)), zorder=4,
    )  # fmt: skip
    return ax


def _viewed_from(elevation, azimuth):
    """Unit vectors to the right, upwards and towards the viewer."""
    elevation = np.radians(check_number(elevation, "elevation", at_least=-90, at_most=90, unit="degrees"))
    azimuth = np.radians(check_number(azimuth, "azimuth", unit="degrees"))
    along = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    upwards = np.array([0.0, 0.0, 1.0])
    towards = np.cos(elevation) * along + np.sin(elevation) * upwards
    return np.cross(upwards, along), np.cos(elevation) * upwards - np.sin(elevation) * along, towards


def _scale_instead_of_axes(ax, right, up, low, high):
    """Draw a scale bar and arrows along x, y and z, for views that are not along an axis."""
    ax.axis("off")
    width = high[0] - low[0]
    length = max(length for power in range(-1, 5) for length in (10**power * np.array([1, 2, 5])) if length < width / 3)
    margin = 0.1 * (high[1] - low[1])
    ax.set_ylim(low[1] - 1.6 * margin, high[1])
    base = low[1] - margin
    ax.plot([low[0], low[0] + length], [base, base], color="black", linewidth=2.5, solid_capstyle="butt")
    ax.annotate(
        f"{length:g} nm", (low[0] + length / 2, base), xytext=(0, -4), textcoords="offset points", ha="center", va="top"
    )
    reach = 0.8 * margin
    origin = np.array([high[0] - 1.5 * reach, base])
    for name, along in zip("xyz", np.stack([right, up], axis=1), strict=True):
        if np.hypot(*along) > 0.1:
            ax.annotate(
                name, origin, xytext=origin + reach * along, ha="center", va="center",
                arrowprops={"arrowstyle": "<-", "shrinkA": 1, "shrinkB": 0, "linewidth": 1.1},
            )  # fmt: skip
