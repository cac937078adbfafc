"""Measures of point clouds: clusters, and composition about an interface or along an axis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from apt_evap._common.validation import check_choice, check_kind, check_sequence
from apt_evap.measures.interface import CompositionProfile
from apt_evap.measures.point_cloud import Clusters
from apt_evap.plot._figure import DrawnAxes, interval_of_fraction, new_figure, set_title, with_default_settings
from apt_evap.reconstruction.truth_comparison import TruthComparison

_DOTS = 20_000  # solutes from the side: more hide each other
_SIZES = 40  # bars, at most
_FEWEST = 3  # solutes with a distribution of distances


@with_default_settings
def clusters(result: Clusters, *, title: str | None = None) -> NDArray[np.object_]:
    """Draw clusters: solutes from the side, nearest neighbours, the choice of the separation, compositions.

    Parameters
    ----------
    result : Clusters
        Result of `measures.PointCloud.clusters`.
    title : str, optional
        Title of the figure; by default the number of clusters and the settings.

    Returns
    -------
    ndarray of matplotlib.axes.Axes
        Shape (4,).

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> positions = np.r_[10 * rng.random((5000, 3)), 5 + 0.5 * rng.normal(size=(60, 3))]
    >>> species = np.r_[rng.random(5000) < 0.02, np.ones(60, bool)].astype(int)
    >>> found = ae.measures.PointCloud(positions, species, ["Al", "Cu"]).clusters("Cu", envelope=0.3)
    >>> len(ae.plot.clusters(found))                     # axes[0].figure.savefig("clusters.png")
    4
    """
    check_kind(result, "result", Clusters, "Clusters, the result of PointCloud.clusters")
    figure = new_figure((10.0, 8.0))
    axes = figure.subplots(2, 2).ravel()
    _side(axes[0], result)
    _neighbours(axes[1], result)
    _choice(axes[2], result)
    _compositions(axes[3], result)
    one = "cluster" if len(result) == 1 else "clusters"
    figure.suptitle(
        title or f"{len(result)} {one}, d_max {result.settings.d_max:.2f} nm, N_min {result.settings.n_min}"
    )
    return axes


@with_default_settings
def composition_profile(
    profile: CompositionProfile,
    elements: str | Sequence[str] | None = None,
    ax: Axes | None = None,
    *,
    label: str = "distance from the isosurface [nm], negative inside",
    title: str | None = None,
) -> DrawnAxes:
    """Draw a proxigram, or a profile along an axis, with the errors of the counts.

    The bars are intervals of 68 % by the number of atoms in the step. They are those of Wilson, which also have a
    length where all atoms of a step are of one element: from 50 to 100 % for a single atom.

    Parameters
    ----------
    profile : CompositionProfile
        Result of `measures.PointCloud.proxigram` or `measures.PointCloud.profile`.
    elements : str or sequence of str, optional
        Elements that are drawn; by default all.
    ax : matplotlib.axes.Axes, optional
        Axes to draw into; by default new ones.
    label : str
        Label of the coordinate.
    title : str, optional
        Title.

    Returns
    -------
    matplotlib.axes.Axes
    """
    check_kind(profile, "profile", CompositionProfile, "a CompositionProfile, the result of PointCloud.proxigram")
    names = profile.elements if elements is None else elements
    names = (names,) if isinstance(names, str) else check_sequence(names, "elements", "names")
    ax = new_figure((6.0, 4.0)).subplots() if ax is None else ax
    for name in names:
        of_element = profile.of(check_choice(name, "elements", profile.elements))
        low, high = interval_of_fraction(of_element.fraction, of_element.ions)
        errors = 100 * np.array([of_element.fraction - low, high - of_element.fraction])
        ax.errorbar(
            of_element.centres, 100 * of_element.fraction, errors, fmt=".-", capsize=2, label=name.replace("$", r"\$")
        )
    ax.set(xlabel=label, ylabel="atoms [%]", ylim=(0, None))
    ax.legend(fontsize="small")
    set_title(ax, title)
    return ax


@with_default_settings
def truth_comparison(result: TruthComparison, *, title: str | None = None) -> NDArray[np.object_]:
    """Draw each measure of all sites, of the detected ions and of their reconstructions side by side.

    Parameters
    ----------
    result : TruthComparison
        Result of `reconstruction.compare_with_truth`.
    title : str, optional
        Title of the figure.

    Returns
    -------
    ndarray of matplotlib.axes.Axes
        One for each measure.
    """
    check_kind(result, "result", TruthComparison, "a TruthComparison, the result of compare_with_truth")
    figure = new_figure((2.4 + 2.2 * len(result.values), 3.4))
    axes = figure.subplots(1, len(result.values), squeeze=False)[0]
    for ax, (name, row) in zip(axes, result.values.items(), strict=True):
        for place, (value, error) in enumerate(row[cloud] for cloud in result.ions):
            ax.errorbar(place, value, None if np.isnan(error) else error, fmt="o", color=f"C{place}", capsize=3)
        ax.axhline(row["all sites"].value, color="0.6", linewidth=0.8)
        ax.set_xticks(range(len(result.ions)), result.ions, rotation=30, ha="right")
        ax.set_xlim(-0.5, len(result.ions) - 0.5)
        set_title(ax, name, fontsize="medium")
    if title:
        figure.suptitle(title, parse_math=False)
    return axes


def _side(ax: Axes, result) -> None:
    """Solutes from the side, those of clusters in colours."""
    x, _, z = result.cloud.positions[result.solute].T
    labels = result.members[result.solute]
    for inside, size in ((False, 2.0), (True, 5.0)):
        rows = np.flatnonzero((labels >= 0) == inside)
        rows = rows[:: max(1, -(-len(rows) // _DOTS))]
        color = np.array([f"C{one % 10}" for one in labels[rows]]) if inside else "0.75"
        ax.scatter(x[rows], z[rows], s=size, c=color, linewidths=0, rasterized=True)
    ax.set(aspect="equal", xlabel="x [nm]", ylabel="z [nm]")
    set_title(ax, "solutes from the side; grey: in no cluster", fontsize="medium")


def _neighbours(ax: Axes, result) -> None:
    """Distribution of the nearest neighbours beside that of random labels."""
    n = int(np.count_nonzero(result.solute))
    set_title(ax, "nearest solute of each solute", fontsize="medium")
    ax.set(xlabel="distance [nm]", ylabel="solutes")
    order = result.settings.order
    if not max(order, _FEWEST) < n < len(result.solute):
        return
    from apt_evap.measures.clusters import nearest_neighbours

    found = nearest_neighbours(result.cloud.positions, result.solute, order)
    centres = (found.edges[1:] + found.edges[:-1]) / 2
    ax.stairs(found.solutes, found.edges, color="C0", label="these ions", fill=True, alpha=0.4)
    ax.plot(centres, found.random, color="0.3", label="random labels, ± standard deviation")
    low, high = (found.random + sign * found.random_deviations for sign in (-1, 1))
    ax.fill_between(centres, low, high, color="0.3", alpha=0.3, linewidth=0)
    ax.axvline(result.settings.d_max, color="C3", linestyle="dashed", label="d_max")
    ax.set(xlim=(0, None), ylim=(0, None))
    ax.legend(fontsize="small")


def _choice(ax: Axes, result) -> None:
    """Fraction in clusters by the separation if it was chosen, else the number of solutes of the clusters."""
    if (choice := result.choice) is not None:
        ax.plot(choice.separations, 100 * choice.clustered, ".-", color="C0", label="these ions")
        ax.plot(choice.separations, 100 * choice.by_chance, ".-", color="0.3", label="random labels")
        ax.axvline(choice.d_max, color="C3", linestyle="dashed", label="d_max")
        ax.set(xlabel="separation [nm]", ylabel="solutes in clusters [%]", ylim=(0, None))
        ax.legend(fontsize="small")
        set_title(ax, f"choice of the separation, p = {choice.p_value:.2f}", fontsize="medium")
        return
    if len(result):
        least, most = int(result.solutes.min()), int(result.solutes.max())
        step = -(-(most - least + 1) // _SIZES)
        ax.hist(result.solutes, bins=np.arange(least, most + step + 1, step) - 0.5, color="C0")
        ax.set_xlim(least - 2.5 * step, most + 2.5 * step)
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    ax.set(xlabel="solutes of a cluster", ylabel="clusters")
    set_title(ax, "sizes", fontsize="medium")


def _compositions(ax: Axes, result) -> None:
    """Radius of each cluster and its composition."""
    set_title(ax, "composition of each cluster; hollow: at the edge", fontsize="medium")
    ax.set(xlabel="radius [nm]", ylabel="atoms [%]")
    if not len(result):
        return
    radii, edge = result.radii, result.at_edge
    for column, name in enumerate(result.cloud.elements):
        for at, fill in ((~edge, "full"), (edge, "none")):
            ax.errorbar(
                radii[at], 100 * result.compositions[at, column], 100 * result.composition_errors[at, column], fmt="o",
                color=f"C{column}", fillstyle=fill, capsize=2, label=name if fill == "full" else None,
            )  # fmt: skip
    ax.set(ylim=(0, 102))
    ax.legend(fontsize="small")
