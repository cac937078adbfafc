"""A reconstruction: from the side, from the tip, its radius along the depth and its composition."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from apt_evap._common.digits import rounded_text
from apt_evap._common.quantiles import quantile
from apt_evap._common.types import Floats, Integers
from apt_evap._common.validation import check_kind
from apt_evap.detection.color_limits import color_limits
from apt_evap.detection.hits import Hits
from apt_evap.detection.ion_blocks import ROWS, Field, IonBlocks
from apt_evap.plot._figure import add_colorbar, interval_of_fraction, new_figure, set_title, with_default_settings
from apt_evap.plot.map_figures import binned_blocks
from apt_evap.reconstruction.cap_geometry import parts_of
from apt_evap.reconstruction.consistency import density_near_axis
from apt_evap.reconstruction.reconstructed import Reconstruction
from apt_evap.spectra.mass_ranges import Ranges

_COLORS = ("C0", "C1", "C2", "C3", "C4", "C5", "C6", "0.6")
_MOST = 7  # species with a colour of their own
_DOTS = 20_000  # ions from the side: more hide each other
_SECTIONS = 60  # along the depth, of at least FEWEST ions
_POINTS = 1_000_000  # of a line
FEWEST = 50
"""Fewest ions of a picture."""
_LONG = 2.0  # depth over width of a reconstruction that is drawn with its depth from left to right
_IN_LEGEND = 25  # points^2, of a dot
OUTSIDE = "outside every range"


@with_default_settings
def reconstruction(
    result: Reconstruction, ranges: Ranges | None = None, *, title: str | None = None
) -> NDArray[np.object_]:
    """Draw a reconstruction: a slice from the side, the ions per area along the axis, a depth profile, the composition.

    The slice is as thick as a tenth of the width, in the colours of the species. Of a reconstruction that is more than
    twice as deep as wide, slice and profile have the depth from left to right. The depth profile is that of the ions
    within half the field of view: of several species their fractions, else the number of ions per volume beside its
    expectation, the efficiency divided by the atomic volume. Of a single species the radius of the cap is drawn in
    place of the composition.

    Parameters
    ----------
    result : Reconstruction
        Result of `reconstruct`.
    ranges : Ranges, optional
        Ranges of mass that give the species of measured ions; simulated ions have theirs.
    title : str, optional
        Such as the name of the file, written before the number of ions, the size, and the ions per volume near the
        axis.

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
    width, _, depth = result.extents
    is_long = depth > _LONG * width
    if is_long:
        heights = max(1.0, 9.5 * width / depth) + 0.8, 2.8, 3.6  # inch, each with its labels
        figure = new_figure((11.0, sum(heights) + 1.2))
        panels = figure.subplot_mosaic("AA;CC;BD", height_ratios=heights)
    else:
        figure = new_figure((11.0, 9.0))
        panels = figure.subplot_mosaic("AB;CD")
    figure.set_layout_engine("constrained")  # not compressed: the panels stay in their columns
    side, top, profile, last = (panels[name] for name in "ABCD")
    _side(side, result, names, species, is_long)
    _top(top, result)
    if len(names) > 1:
        _fractions(profile, result, names, species)
        _composition(last, names, species)
        legend = figure.legend(*side.get_legend_handles_labels(), loc="outside lower center", ncols=5)
        for handle in legend.legend_handles:
            handle.set_sizes([_IN_LEGEND])
    else:
        _density(profile, result)
        every = slice(None, None, -(-len(result) // _POINTS))  # many more than the pixels of the picture
        last.plot(result.depths_of(every), result.radii[every], color="C0")
        last.set(xlabel="depth of the apex [nm]", ylabel="radius of the cap [nm]", ylim=(0, None))
    lines = _description(result)
    if title is not None:
        lines[0] = f"{title}: {lines[0]}"
    figure.suptitle("\n".join(lines), parse_math=False, fontsize="medium")
    return np.array([side, top, profile, last])


def _description(result):
    """Number of ions, size, and ions per volume near the axis."""
    x, y, z = result.extents
    density = density_near_axis(result)
    lines = [f"{len(result):,} ions, {x:.1f} × {y:.1f} × {z:.1f} nm"]
    if np.isfinite(density.found):
        ratio = density.found / density.expected
        lines.append(f"near the axis {density.found:.3g} ions per nm³, {ratio:.2f} × efficiency / atomic volume")
        if not density.good:
            lines.append(density.meaning)
    return lines


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


def _side(ax: Axes, result, names, species, is_long):
    x, y, z = result.positions.T
    height, parts = result.extents[1], list(parts_of(len(y)))
    middle = quantile(lambda: (y[rows] for rows in parts), float(y.min()), float(y.max()), 0.5)
    near = [rows.start + np.flatnonzero(np.abs(y[rows] - middle) < 0.05 * height) for rows in parts]
    near = np.concatenate(near)
    near = near[:: max(1, -(-len(near) // _DOTS))]
    size = float(np.clip(_DOTS / max(len(near), 1), 1.5, 12.0))
    for number, name in enumerate(names):
        ions = near[species[near] == number]
        places = (z[ions], x[ions]) if is_long else (x[ions], z[ions])
        label = name.replace("$", r"\$")
        ax.scatter(*places, s=size, linewidths=0, color=_COLORS[number], label=label, rasterized=True)
    if is_long:
        ax.set(aspect="equal", xlabel="depth z [nm]", ylabel="x [nm]")
        ax.yaxis.set_major_locator(MaxNLocator(3))
    else:
        ax.invert_yaxis()  # the apex of the first ion above
        ax.set(aspect="equal", xlabel="x [nm]", ylabel="depth z [nm]")
    set_title(ax, f"from the side, {0.1 * height:.1f} nm thick")


def _top(ax: Axes, result):
    places = _Places(result.positions)
    shown = binned_blocks(IonBlocks(places, places.field, "", lambda *sizes: None))
    low, high = color_limits(shown)
    image = ax.imshow(
        shown.density, origin="lower", extent=shown.extent, cmap="inferno", vmin=low, vmax=high, interpolation="nearest"
    )
    ax.set(aspect="equal", xlabel="x [nm]", ylabel="y [nm]")
    set_title(ax, "along the axis")
    add_colorbar([image], ax, label="ions per area / mean")


class _Places:
    """Places seen along the axis as blocks of ions, nm in place of mm: kept together they would be a second array."""

    available: tuple[str, ...] = ("x", "y")
    columns = available
    largest = 0

    def __init__(self, positions: Floats) -> None:
        self.n, self._positions, self.field = len(positions), positions, Field(len(positions))
        for block in self.blocks(self.columns, ROWS):
            self.field.add(block.x, block.y)

    def blocks(self, columns: tuple[str, ...], rows: int) -> Iterator[Hits]:
        """Blocks of so many ions."""
        for start in range(0, self.n, rows):
            yield Hits(x=self._positions[start : start + rows, 0], y=self._positions[start : start + rows, 1])


def _sections(values):
    """Edges of sections of equal width."""
    n = int(np.clip(len(values) // FEWEST, 1, _SECTIONS))
    return np.linspace(values.min(), values.max() * (1 + 1e-12) + 1e-12, n + 1)


def _density(ax: Axes, result):
    near, rim = result.core
    # from cap to cap, so that the curvature does not matter
    depths = np.concatenate([result.depths_of(rows)[near[rows]] for rows in parts_of(len(near))])
    edges = _sections(depths)
    ions = np.histogram(depths, len(edges) - 1, (edges[0], edges[-1]))[0]  # equal widths: without a search
    volume = np.pi * rim**2 * np.diff(edges)
    ax.errorbar(
        (edges[1:] + edges[:-1]) / 2, ions / volume, np.sqrt(ions) / volume, fmt=".-", color="C0", label="near the axis"
    )
    expected = result.settings.efficiency / result.settings.atomic_volume
    ax.axhline(expected, color="0.4", linestyle="dashed", label="efficiency / atomic volume")
    ax.set(xlabel="depth of the apex [nm]", ylabel="ions per nm$^3$", ylim=(0, None))
    ax.legend(fontsize="small")


def _fractions(ax: Axes, result, names, species):
    near, _ = result.core
    depths = result.positions[near, 2]
    # sections of equally many ions: the first and last ones of equal width have few, because the cap is curved
    edges = np.quantile(depths, np.linspace(0, 1, len(_sections(depths))))
    number = np.stack([np.histogram(depths[species[near] == index], edges)[0] for index in range(len(names))])
    with np.errstate(invalid="ignore", divide="ignore"):
        fraction = number / number.sum(axis=0)
        low, high = interval_of_fraction(fraction, number.sum(axis=0))
    for index, _name in enumerate(names):
        errors = fraction[index] - low[index], high[index] - fraction[index]
        ax.errorbar((edges[1:] + edges[:-1]) / 2, fraction[index], errors, fmt=".-", color=_COLORS[index])
    ax.set(xlabel="depth z [nm]", ylabel="fraction of the ions near the axis", ylim=(0, None))


def _composition(ax: Axes, names, species):
    number = np.bincount(species, minlength=len(names))
    fraction = number / number.sum()
    error = np.sqrt(fraction * (1 - fraction) / number.sum())
    places = np.arange(len(names))
    ax.barh(places, fraction, xerr=error, color=_COLORS[: len(names)])
    ax.set_yticks(
        places,
        [
            name.replace("$", r"\$") + f"\n{rounded_text(value, wide)} ± {rounded_text(wide, wide)} %"
            for name, value, wide in zip(names, 100 * fraction, 100 * error, strict=True)
        ],
        fontsize="small",
    )
    ax.invert_yaxis()
    ax.set(xlabel="fraction of all ions", xlim=(0, min(1.0, 1.05 * (fraction + error).max())))
