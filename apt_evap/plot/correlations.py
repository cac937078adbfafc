"""Correlation of the masses of ions of one pulse."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm

from apt_evap._common.validation import check_kind
from apt_evap.detection.correlation import Correlation, dissociation_line
from apt_evap.plot._figure import DrawnAxes, new_figure, with_default_settings
from apt_evap.spectra.mass_spectrum import Spectrum


@with_default_settings
def correlation(
    pairs: Correlation,
    spectrum: Spectrum | None = None,
    ax: Axes | None = None,
    *,
    bins: int = 400,
    limits: tuple[float, float] | None = None,
    dissociations: Sequence[tuple[float, float, float]] = (),
) -> DrawnAxes:
    """Draw the pairs of ions of one pulse by their masses, with lines of ions that break on their way.

    Parameters
    ----------
    pairs : Correlation
        The result of `Hits.correlation`.
    spectrum : Spectrum, optional
        Named ions: lines are drawn for each of them that breaks into two others of them.
    ax : matplotlib.axes.Axes, optional
        Where to draw; a new figure by default.
    bins : int
        Number of bins along each axis.
    limits : tuple of float, optional
        Lowest and highest m/n [Da].
    dissociations : sequence of tuple of float
        m/n of further ions and of their two fragments [Da].

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    ValueError
        If there are no pairs, or an argument is invalid.
    """
    check_kind(pairs, "pairs", Correlation, "the result of Hits.correlation")
    if not len(pairs):
        raise ValueError(f"a correlation needs pulses with two ions or more, got {pairs!r}")
    counts, edges = pairs.histogram(bins, limits)
    if ax is None:
        ax = new_figure((6.4, 5.6)).subplots()
    shown = np.ma.masked_equal(counts, 0)
    image = ax.pcolormesh(edges, edges, shown.T, norm=LogNorm(1, max(int(counts.max()), 2)), cmap="viridis")
    ax.figure.colorbar(image, ax=ax, label="pairs")
    named = [] if spectrum is None else check_kind(spectrum, "spectrum", Spectrum, "a Spectrum").dissociations()
    lines = [(name, masses) for name, masses in named] + [("", masses) for masses in dissociations]
    for number, (name, masses) in enumerate(lines):
        first, second = dissociation_line(*masses)
        for x, y, label in ((first, second, name or None), (second, first, None)):
            ax.plot(x, y, color=f"C{1 + number % 9}", linewidth=1.0, linestyle="--", label=label)
    if any(name for name, _ in lines):
        ax.legend(loc="upper left", fontsize="small")
    ax.set(xlabel="m/n of one ion [Da]", ylabel="m/n of the other [Da]", aspect="equal")
    ax.set(xlim=(edges[0], edges[-1]), ylim=(edges[0], edges[-1]))
    return ax
