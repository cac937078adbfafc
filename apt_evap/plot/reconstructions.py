"""A reconstruction: from the side, from the tip, its radius along the depth and its composition."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from apt_evap._common.types import Integers
from apt_evap._common.validation import check_kind
from apt_evap.detection.color_limits import color_limits
from apt_evap.detection.hits import Hits
from apt_evap.plot._figure import add_colorbar, new_figure, set_title, with_default_settings
from apt_evap.plot.map_figures import binned
from apt_evap.reconstruction.reconstructed import Reconstruction
from apt_evap.spectra.mass_ranges import Ranges

_COLORS = ("C0", "C1", "C2", "C3", "C4", "C5", "C6", "0.6")
_MOST = 7  # species with a colour of their own
_DOTS = 20_000  # ions from the side: more hide each other
_SECTIONS = 60  # along the depth, of at least FEWEST ions
_POINTS = 1_000_000  # of a line
FEWEST = 50
"""Fewest ions of a picture."""
_CORE = 0.5  # of the field of view, in which profiles are counted
OUTSIDE = "outside every range"


@with_default_settings
def reconstruction(
    result: Reconstruction, ranges: Ranges | None = None, *, title: str | None = None
) -> NDArray[np.object_]:
    """Draw a reconstruction: a slice from the side, the ions per area along the axis, a depth profile, the composition.

    The slice is as thick as a tenth of the width, in the colours of the bars of the composition. The depth profile is
    that of the ions within half the field of view: of several species their fractions, else the number of ions per
    volume beside its expectation, the efficiency divided by the atomic volume. Of a single species the radius of the
    cap is drawn in place of the composition.

    Parameters
    ----------
    result : Reconstruction
        Result of `reconstruct`.
    ranges : Ranges, optional
        Ranges of mass that give the species of measured ions; simulated ions have theirs.
    title : str, optional
        Title of the figure; by default the number of ions and the constants.

    Returns
    -------
    ndarray of matplotlib.axes.Axes
        Shape (4,).

    Raises
    ------
    ValueError
        If it has fewer than 50 ions.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> radius, azimuth = 20 * np.sqrt(rng.random(20_000)), 2 * np.pi * rng.random(20_000)  # mm, uniform
    >>> ions = ae.Hits(x=radius * np.cos(azimuth), y=radius * np.sin(azimuth))
    >>> result = ae.reconstruct(ions, atomic_volume=0.011, distance=90.0, radius=30.0)
    >>> axes = ae.plot.reconstruction(result)            # axes[0].figure.savefig("reconstruction.png")
    >>> len(axes)
    4
    """
    check_kind(result, "result", Reconstruction, "a Reconstruction, the result of reconstruct")
    if len(result) < FEWEST:
        raise ValueError(f"result must have at least {FEWEST} ions for a picture, got {len(result)}")
    names, species = species_of(result, ranges)
    figure = new_figure((11.0, 8.4))
    figure.set_layout_engine("constrained")  # not compressed: the panels stay in their columns
    axes = figure.subplots(2, 2).ravel()
    _side(axes[0], result, names, species)
    _top(axes[1], result)
    if len(names) > 1:
        _fractions(axes[2], result, names, species)
        _composition(axes[3], names, species)
    else:
        _density(axes[2], result)
        every = slice(None, None, -(-len(result) // _POINTS))  # many more than the pixels of the picture
        axes[3].plot(result.depths[every], result.radii[every], color="C0")
        axes[3].set(xlabel="depth of the apex [nm]", ylabel="radius of the cap [nm]")
    if title is None:
        x, y, z = (np.ptp(column) for column in result.positions.T)
        title = f"{len(result):,} ions, {x:.1f} × {y:.1f} × {z:.1f} nm"
    figure.suptitle(title, parse_math=False)
    return axes


def species_of(result: Reconstruction, ranges: Ranges | None) -> tuple[list[str], Integers]:
    """Names of the groups of ions, the most frequent first, and the group of each ion."""
    if ranges is not None:
        labels = check_kind(ranges, "ranges", Ranges, "Ranges, such as ae.io.read_ranges(path)").labels(
            result.hits, OUTSIDE
        )
    elif "element" in result.hits.extra:
        labels = result.hits.extra["element"]
    else:
        return ["ions"], np.zeros(len(result), dtype=int)
    names, group, number = np.unique(labels.astype(str), return_inverse=True, return_counts=True)
    order = np.argsort(-number, kind="stable")
    rank = np.empty(len(order), dtype=int)
    rank[order] = np.arange(len(order))
    sorted_names = names[order].tolist()
    if len(names) <= _MOST + 1:
        return sorted_names, rank[group]
    return [*sorted_names[:_MOST], "other"], np.minimum(rank[group], _MOST)


def _side(ax: Axes, result, names, species):
    x, y, z = result.positions.T
    near = np.flatnonzero(np.abs(y - np.median(y)) < 0.05 * np.ptp(y))
    near = near[:: max(1, -(-len(near) // _DOTS))]
    size = float(np.clip(_DOTS / max(len(near), 1), 1.5, 12.0))
    for number, name in enumerate(names):
        ions = near[species[near] == number]
        ax.scatter(x[ions], z[ions], s=size, linewidths=0, color=_COLORS[number], label=name, rasterized=True)
    ax.invert_yaxis()  # the apex of the first ion above
    ax.set(aspect="equal", xlabel="x [nm]", ylabel="depth z [nm]")
    set_title(ax, f"from the side, {0.1 * np.ptp(y):.1f} nm thick")


def _top(ax: Axes, result):
    shown = binned(Hits(x=result.positions[:, 0], y=result.positions[:, 1]))  # nm in place of mm
    low, high = color_limits(shown)
    image = ax.imshow(
        shown.density, origin="lower", extent=shown.extent, cmap="inferno", vmin=low, vmax=high, interpolation="nearest"
    )
    ax.set(aspect="equal", xlabel="x [nm]", ylabel="y [nm]")
    set_title(ax, "along the axis")
    add_colorbar([image], ax, label="ions per area / mean")


def _core(result):
    """Ions within half the field of view, and its radius [nm]."""
    across = np.hypot(*result.positions[:, :2].T)
    rim = _CORE * float(np.quantile(across, 0.99))
    return across < rim, rim


def _sections(values):
    """Edges of sections of equal width."""
    n = int(np.clip(len(values) // FEWEST, 1, _SECTIONS))
    return np.linspace(values.min(), values.max() * (1 + 1e-12) + 1e-12, n + 1)


def _density(ax: Axes, result):
    near, rim = _core(result)
    depths = result.depths  # from cap to cap, so that the curvature does not matter
    edges = _sections(depths[near])
    ions = np.histogram(depths[near], edges)[0]
    volume = np.pi * rim**2 * np.diff(edges)
    ax.errorbar(
        (edges[1:] + edges[:-1]) / 2, ions / volume, np.sqrt(ions) / volume, fmt=".-", color="C0", label="near the axis"
    )
    expected = result.settings.efficiency / result.settings.atomic_volume
    ax.axhline(expected, color="0.4", linestyle="dashed", label="efficiency / atomic volume")
    ax.set(xlabel="depth of the apex [nm]", ylabel="ions per nm$^3$", ylim=(0, None))
    ax.legend(fontsize="small")


def _fractions(ax: Axes, result, names, species):
    near, _ = _core(result)
    depths = result.positions[near, 2]
    # sections of equally many ions: the first and last ones of equal width have few, because the cap is curved
    edges = np.quantile(depths, np.linspace(0, 1, len(_sections(depths))))
    number = np.stack([np.histogram(depths[species[near] == index], edges)[0] for index in range(len(names))])
    with np.errstate(invalid="ignore", divide="ignore"):
        fraction = number / number.sum(axis=0)
        error = np.sqrt(fraction * (1 - fraction) / number.sum(axis=0))
    for index, _name in enumerate(names):
        ax.errorbar((edges[1:] + edges[:-1]) / 2, fraction[index], error[index], fmt=".-", color=_COLORS[index])
    ax.set(xlabel="depth z [nm]", ylabel="fraction of the ions near the axis", ylim=(0, None))


def _composition(ax: Axes, names, species):
    number = np.bincount(species, minlength=len(names))
    fraction = number / number.sum()
    error = np.sqrt(fraction * (1 - fraction) / number.sum())
    places = np.arange(len(names))
    ax.barh(places, fraction, xerr=error, color=_COLORS[: len(names)])
    for place, value, wide in zip(places, fraction, error, strict=True):
        ax.annotate(
            f"{value:.2%} ± {wide:.2%}", (value, place), xytext=(6, 0), textcoords="offset points", va="center",
            fontsize="small",
        )  # fmt: skip
    ax.set_yticks(places, [name.replace("$", r"\$") for name in names])
    ax.invert_yaxis()
    ax.set(xlabel="fraction of all ions", xlim=(0, 1.6 * fraction.max()))  # with room for the texts
    ax.set_xticks([tick for tick in ax.get_xticks() if tick <= min(1.0, 1.6 * fraction.max())])
