"""A reconstruction by a surface that follows its ions: beside the cap, its field in time, recession and voltage."""

from __future__ import annotations

from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from apt_evap._common.validation import check_kind
from apt_evap.plot._figure import add_colorbar, new_figure, set_title, with_default_settings
from apt_evap.plot.reconstructions import FEWEST, species_of
from apt_evap.reconstruction.evolving import EvolvingReconstruction
from apt_evap.spectra.mass_ranges import Ranges

_TIMES = (0.25, 0.5, 0.75)  # of the depth, at which the field is drawn
_COLORS = ("0.75", "C3", "C0", "C2", "C4", "C5", "C6", "0.4")  # the matrix is grey
_DOTS = 12_000
_CHARACTERS = 150  # of a line of the title


@with_default_settings
def surface_history(
    result: EvolvingReconstruction, ranges: Ranges | None = None, *, title: str | None = None
) -> NDArray[np.object_]:
    """Draw slices by the cap and by the surface, recession and voltage, and the field of the surface at three times.

    Parameters
    ----------
    result : EvolvingReconstruction
        Result of ``reconstruct(..., shape="evolving")`` whose surface was followed.
    ranges : Ranges, optional
        Ranges of mass that give the species of measured ions; simulated ions have theirs.
    title : str, optional
        Title of the figure; by default the verdict.

    Returns
    -------
    ndarray of matplotlib.axes.Axes
        Shape (6,).

    Raises
    ------
    ValueError
        If the cap was used.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> radius, azimuth = 20 * np.sqrt(rng.random(3000)), 2 * np.pi * rng.random(3000)  # mm, uniform
    >>> ions = ae.Hits(x=radius * np.cos(azimuth), y=radius * np.sin(azimuth))
    >>> result = ae.reconstruct(ions, atomic_volume=0.011, distance=90.0, radius=10.0, shape="evolving")
    >>> len(ae.plot.surface_history(result))             # [0].figure.savefig("surface.png")
    6
    """
    check_kind(result, "result", EvolvingReconstruction, "an EvolvingReconstruction, of an evolving shape")
    history = result.history
    if history is None:
        raise ValueError(f"result must have a surface that was followed, got {result.verdict!r}")
    names, species = species_of(result, ranges)
    if "phase" in result.hits.extra and len(names) == 1:
        names, species = ["matrix", "phases"], (result.hits.extra["phase"] > 0).astype(int)
    figure = new_figure((12.0, 7.6))
    figure.set_layout_engine("constrained")
    axes = figure.subplots(2, 3).ravel()
    _slice(axes[0], result.cap_positions, names, species, "by the cap")
    _slice(axes[1], result.positions, names, species, "by the surface")
    # below the label of the axis, where it hides no ion
    axes[0].legend(
        fontsize="small", markerscale=2, ncols=4, loc="upper center", bbox_to_anchor=(0.5, 0), borderaxespad=4.5
    )
    axes[2].plot(history.depths, history.recession, color="C0", label="recession over that of a cap")
    if not np.isnan(history.voltage).all():  # none is measured, or none was followed
        axes[2].plot(history.depths, history.voltage, color="C1", label="voltage, measured")
        axes[2].plot(history.depths, history.model_voltage, color="C3", lw=1, label="voltage, of the surface")
    axes[2].set(xlabel="depth of the apex [nm]", ylabel="relative to the matrix on a sphere")
    axes[2].legend(fontsize="small")
    depths = [part * float(history.depths[-1]) for part in _TIMES]
    maps = [history.map_at(depth) for depth in depths]
    largest = max(float(np.nanmax(np.abs(field - 1))) for _, _, field in maps)
    images = []
    for ax, depth, (edges, _, field) in zip(axes[3:], depths, maps, strict=True):
        bounds = (edges[0], edges[-1], edges[0], edges[-1])
        images.append(
            ax.imshow(field, origin="lower", extent=bounds, cmap="RdBu_r", vmin=1 - largest, vmax=1 + largest)
        )
        ax.set(xlabel="x / R", ylabel="y / R")
        set_title(ax, f"field at a depth of {depth:.1f} nm")
    add_colorbar(images, axes[5], label="field / mean of the sphere")
    figure.suptitle(fill(result.verdict, _CHARACTERS) if title is None else title, parse_math=False, fontsize="medium")
    return np.asarray(axes)


def _slice(ax: Axes, positions, names, species, title):
    """Ions of a slice as thick as a tenth of the width, each species in its colour."""
    x, y, z = positions.T
    near = np.flatnonzero(np.abs(y - np.median(y)) < 0.05 * np.ptp(y))
    near = near[:: max(1, -(-len(near) // _DOTS))]
    size = float(np.clip(_DOTS / max(len(near), FEWEST), 1.5, 8.0))
    for number, name in enumerate(names):
        ions = near[species[near] == number]
        color = _COLORS[number % len(_COLORS)]
        ax.scatter(x[ions], z[ions], s=size, linewidths=0, color=color, label=name, rasterized=True)
    ax.invert_yaxis()  # the apex of the first ion above
    ax.set(aspect="equal", xlabel="x [nm]", ylabel="depth z [nm]")
    set_title(ax, title)
