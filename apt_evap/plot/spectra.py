"""Mass spectra, with labels at the isotopes."""

import re
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from apt_evap._common.validation import check_array, check_choice, check_kind, check_number, check_sequence
from apt_evap.detection.hits import Hits
from apt_evap.plot._figure import DrawnAxes, ion_label, new_figure, raised_charge, with_default_settings
from apt_evap.plot._labels import label_peaks
from apt_evap.simulation.run import Run
from apt_evap.specimen.isotopes import ISOTOPES
from apt_evap.spectra.candidate_ions import highest_charge
from apt_evap.spectra.mass_ranges import Ranges
from apt_evap.spectra.mass_spectrum import Spectrum

_MOST_BINS = 1_000_000
_CHUNK = 1 << 18  # ions
_MARGIN = 0.04  # of the range of masses, on both sides
_OCCUPIED = 1e-3  # of the ions in 1 Da at the ends of the default range; background is less
_SAME_NAME = 0.05  # of the axes, within which ranges of one name have one label
_SHARP, _SURROUNDINGS = 0.05, 2.0  # half width of a peak, and of the spectrum around it [Da]
_TAIL = 0.004  # of the mass, by which energy deficits may shift the top of a peak
_SIGNIFICANT = 5.0  # standard deviations of a peak above the ions around it
_FEWEST = 4.0  # expected ions of an isotope with a label


@with_default_settings
def spectrum(
    ions: Run | Hits | Spectrum | Sequence[Run | Hits],
    labels: Sequence[str] | None = None,
    ax: Axes | None = None,
    *,
    bin_width: float = 0.02,
    limits: tuple[float, float] | None = None,
    elements: Sequence[str] | None = None,
    ranges: Ranges | None = None,
) -> DrawnAxes:
    """Draw one or more mass spectra with a logarithmic scale, and label the isotopes.

    Parameters
    ----------
    ions : Run or Hits or sequence of them, or a Spectrum
        Detected ions with mass_to_charge. A run has to be in real units (`Run.at_evaporation_field`); the hits of its
        first perturbation are drawn. The result of `apt_evap.spectrum` is drawn with background, ranges and names.
    labels : sequence of str, optional
        One label each.
    ax : matplotlib.axes.Axes, optional
        Where to draw; a new figure by default.
    bin_width : float
        Width of a bin [Da].
    limits : tuple of float, optional
        Lowest and highest mass-to-charge ratio [Da]; by default from the first to the last interval of 1 Da with
        more than 0.1 % of the ions.
    elements : sequence of str, optional
        Elements of `ISOTOPES` to label: peaks of their isotopes with a charge for which the most abundant isotope has a
        peak, up to the highest charge that `composition` tries for the element. By default those of the runs; () for
        none.
    ranges : Ranges, optional
        Drawn with their names in place of the peaks of a Spectrum.

    Returns
    -------
    matplotlib.axes.Axes
        Several spectra are drawn as fractions of the ions per Da, because their numbers of ions differ.

    Raises
    ------
    ValueError
        If there are no ions with mass_to_charge, a run is not in real units, an element is unknown, there are too many
        bins, or the number of labels differs.
    """
    if isinstance(ions, Spectrum):
        return _draw_named(ions, labels, ax, bin_width, limits, ranges)
    spectra = [ions] if isinstance(ions, Run | Hits) else list(check_sequence(ions, "ions", "runs or hits"))
    labels = [None] * len(spectra) if labels is None else list(labels)
    if not spectra or len(labels) != len(spectra):
        raise ValueError(f"spectrum needs ions, with one label each, got {len(spectra)} and {len(labels)}")
    if elements is None:
        names = [name for run in spectra if isinstance(run, Run) for name in run.elements]
        elements = [name for name in dict.fromkeys(names) if name in ISOTOPES]
    else:
        elements = [check_choice(name, "elements", ISOTOPES) for name in elements]
    return _draw([_masses(ions) for ions in spectra], labels, ax, bin_width, limits, elements)[0]


def _draw(masses, labels, ax, bin_width, limits, elements):
    """Draw spectra of m/n; return the axes, and edges and counts of the bins."""
    bin_width = check_number(bin_width, "bin_width", above=0, unit="Da")
    low, high = _default_limits(masses) if limits is None else check_array(limits, "limits", (2,)).tolist()
    if not 0 <= low < high or (high - low) / bin_width > _MOST_BINS:
        raise ValueError(
            f"limits must be 0 <= low < high [Da] with at most {_MOST_BINS:,} bins of {bin_width:g} Da, got {low:g} to "
            f"{high:g}"
        )
    edges = bin_width * np.arange(np.floor(low / bin_width), np.ceil(high / bin_width) + 1)
    counts = [_counts_between(mass, edges) for mass in masses]
    scales = [1.0] if len(masses) == 1 else [1 / (bin_width * len(mass)) for mass in masses]
    if ax is None:
        ax = new_figure((8.0, 4.0)).subplots()
    heights = [scale * count for scale, count in zip(scales, counts, strict=True)]
    base = min(scales) / 2  # half an ion: the base of the lines on a logarithmic scale
    for index, (height, label) in enumerate(zip(heights, labels, strict=True)):
        values = np.maximum(height, base)
        ax.stairs(values, edges, baseline=base, color=f"C{index}", linewidth=0.7, label=label, alpha=0.9, zorder=2)
        if index == 0:
            ax.stairs(values, edges, baseline=base, color="C0", fill=True, alpha=0.2, linewidth=0, zorder=1)
    ylabel = f"ions per {bin_width:g} Da" if len(masses) == 1 else "fraction of the ions [1/Da]"
    top = max(height.max() for height in heights)
    labelled = _label_isotopes(ax, elements, edges, counts, heights)
    # space above the peaks for their labels, and for the legend
    decades = np.log10(max(top / base, 10))
    space = (0.28 if labelled else 0.06) + (0.1 if any(labels) else 0.0)
    ax.set(yscale="log", xlim=(low, high), ylim=(base, base * 10 ** (decades * (1 + space))))
    ax.set(xlabel="mass-to-charge ratio [Da]", ylabel=ylabel)
    ax.grid(alpha=0.3)
    ax.set_axisbelow(True)
    if any(labels):
        ax.legend(loc="upper center", frameon=False, fontsize="small", ncols=min(len(labels), 3))
    return ax, edges, counts


def _draw_named(spectrum_of_ions, labels, ax, bin_width, limits, ranges):
    """Draw a spectrum with its background, its ranges, and the names of its peaks, or of other ranges."""
    if ranges is None:
        named = [
            (ion.formula, _formula_label(ion.formula) + raised_charge(ion.charge), ion.intervals)
            for ion in spectrum_of_ions.ions
            if ion.intervals
        ]
    else:
        rows = zip(ranges.names, ranges.low.tolist(), ranges.high.tolist(), strict=True)
        named = [(name, name.replace("$", r"\$"), [(low, high)]) for name, low, high in rows]
    intervals = [interval for _, _, parts in named for interval in parts]
    labels = [None] if labels is None else list(labels)
    if len(labels) != 1:
        raise ValueError(f"spectrum needs ions, with one label each, got 1 and {len(labels)}")
    mass = _masses(spectrum_of_ions.hits)
    if limits is None:
        low, high = _default_limits([mass])
        ends = np.array(intervals or [(low, high)])
        margin = _MARGIN * (max(high, ends.max()) - min(low, ends.min()))
        limits = max(min(low, ends.min() - margin), 0.0), max(high, ends.max() + margin)
    ax, edges, (count,) = _draw([mass], labels, ax, bin_width, limits, ())
    ax.stairs(
        spectrum_of_ions.background(edges),
        edges,
        baseline=None,
        color="0.25",
        linewidth=1.2,
        label="background",
        zorder=3,
    )
    formulas = list(dict.fromkeys(formula for formula, _, _ in named))
    labels_of_peaks: list[tuple[str, tuple[float, float], str]] = []
    for formula, text, parts in named:
        color = f"C{1 + formulas.index(formula) % 9}"
        for low, high in parts:
            ax.axvspan(low, high, color=color, alpha=0.2, linewidth=0)
        tops = [
            (max(int(inside.max()), 0.5), float(edges[first : first + 2 + int(np.argmax(inside))][-2:].mean()))
            for first, inside in ((bins.start, count[bins]) for bins in (_bins_between(edges, *i) for i in parts))
            if inside.size
        ]
        if tops:
            labels_of_peaks.append((text, max(tops)[::-1], color))
    labels_of_peaks.sort(key=lambda label: -label[1][1])
    near = _SAME_NAME * (limits[1] - limits[0])
    label_peaks(
        ax,
        [
            label
            for number, label in enumerate(labels_of_peaks)
            if not any(label[0] == text and abs(label[1][0] - x) < near for text, (x, _), _ in labels_of_peaks[:number])
        ],
        edges,
        np.maximum(count, 0.5),
    )
    if ranges is None:
        _mark_unexplained(ax, spectrum_of_ions, edges, count)
    bottom, top = ax.get_ylim()
    ax.set_ylim(bottom, top * (top / bottom) ** 0.12)
    ax.legend(loc="upper right", frameon=False, fontsize="small")
    return ax


def _mark_unexplained(ax, spectrum_of_ions, edges, count):
    """Mark the peaks that no ion explains."""
    places = [(peak.mass, count[_bins_of_peak(edges, peak.mass)]) for peak in spectrum_of_ions.unexplained]
    marks = [(mass, 1.6 * max(int(inside.max()), 1)) for mass, inside in places if inside.size]
    if marks:
        label = f"unexplained, {spectrum_of_ions.unexplained_part:.1%} of the ions in peaks"
        ax.plot(*zip(*marks, strict=True), "v", color="k", markersize=5, linestyle="none", label=label, zorder=4)


def _formula_label(formula):
    """A formula with its numbers as subscripts, and that of an isotope before its element as a superscript."""
    text = re.sub(r"(?<=[A-Za-z])(\d+)", r"$_{\1}$", formula)
    return re.sub(r"^(\d+)", r"$^{\1}$", text)


def _masses(ions):
    """Mass-to-charge ratios of the detected ions [Da]."""
    if isinstance(ions, Run):
        ions.require_real_units("a spectrum")
        ions = ions.hits(ions.first_perturbation)
    (mass,) = check_kind(ions, "ions", Hits, "a Run or Hits").require("mass_to_charge")
    if not (inside := ions.detected & np.isfinite(mass)).all():
        mass = mass[inside]
    if not len(mass):
        raise ValueError(f"a spectrum needs detected ions, got none of {ions!r}")
    return mass


def _chunks(mass):
    """The m/n in parts, as float64: all at once would be temporary arrays of many ions."""
    for start in range(0, len(mass), _CHUNK):
        yield mass[start : start + _CHUNK].astype(np.float64)


def _counts_between(mass, edges):
    """Number of m/n in bins between edges in even steps, as `numpy.histogram`, which sorts them."""
    number = len(edges) - 1
    total = np.zeros(number, np.int64)
    for part in _chunks(mass):
        inside = part[(part >= edges[0]) & (part <= edges[-1])]
        at = ((inside - edges[0]) * (number / (edges[-1] - edges[0]))).astype(np.int64)
        np.minimum(at, number - 1, out=at)
        # rounding is less than a bin
        at -= inside < edges[at]
        at += (inside >= edges[at + 1]) & (at < number - 1)
        total += np.bincount(at, minlength=number)
    return total


def _in_daltons(mass):
    """Whole numbers below m/n, increasing, and the number of ions of each."""
    low, high = np.floor(float(mass.min())), np.floor(float(mass.max()))
    if high - low > _MOST_BINS:
        return np.unique(np.floor(mass.astype(np.float64)), return_counts=True)
    counts = np.zeros(int(high - low) + 1, np.int64)
    for part in _chunks(mass):
        counts += np.bincount((np.floor(part) - low).astype(np.int64), minlength=len(counts))
    occupied = np.flatnonzero(counts)
    return low + occupied, counts[occupied]


def _default_limits(masses):
    lows, highs = [], []
    for mass in masses:
        intervals, counts = _in_daltons(mass)
        empty = intervals[-1] - intervals[0] + 1 - len(intervals)
        background = np.median(np.pad(counts, (0, int(empty)))) if empty < len(intervals) else 0.0
        threshold = max(_OCCUPIED * len(mass), background + _SIGNIFICANT * np.sqrt(background))
        occupied = intervals[counts >= threshold]
        first, end = (occupied[0], occupied[-1] + 1) if len(occupied) else (-np.inf, np.inf)
        for part in _chunks(mass):
            if len(chosen := part[(part >= first) & (part < end)]):
                lows.append(chosen.min())
                highs.append(chosen.max())
    low, high = float(min(lows)), float(max(highs))
    margin = max(_MARGIN * (high - low), 0.5)
    return max(low - margin, 0.0), high + margin


def _label_isotopes(ax, elements, edges, counts, heights):
    """Write the isotopes above their peaks: the most abundant of each charge, then the others."""
    highest = np.max(heights, axis=0)
    mains, others = [], []
    for element in elements:
        for charge in range(1, highest_charge(element) + 1):
            isotopes = [
                (highest[_bins_of_peak(edges, mass / charge)].max(), mass / charge, (element, charge, mass))
                for mass, _ in _visible_isotopes(element, charge, counts, edges)
            ]
            mains += isotopes[:1]
            others += isotopes[1:]
    labels = [
        (ion_label(element, charge, round(mass)), (place, top), "k")
        for top, place, (element, charge, mass) in [*sorted(mains, reverse=True), *sorted(others, reverse=True)]
    ]
    label_peaks(ax, labels, edges, highest, rotation=90, fontsize="small")
    return bool(labels)


def _visible_isotopes(element, charge, counts, edges):
    """Isotopes, the most abundant first, if this has a peak, and others that have the expected ions in a spectrum."""
    isotopes = sorted(ISOTOPES[element], key=lambda isotope: -isotope[1])
    visible = set()
    for count in counts:
        main = _ions_of_peak(count, edges, isotopes[0][0] / charge)
        for isotope in isotopes if main > 0 else ():
            expected = main * isotope[1] / isotopes[0][1]
            number = count[_bins_of_peak(edges, isotope[0] / charge)].sum()
            if expected >= _FEWEST and number > expected / 2:
                visible.add(isotope)
    return [isotope for isotope in isotopes if isotope in visible and edges[0] < isotope[0] / charge < edges[-1]]


def _ions_of_peak(count, edges, mass):
    """Number of ions of a peak above the background, 0 if there is no peak."""
    near, around = _bins_of_peak(edges, mass), _bins_between(edges, mass - _SURROUNDINGS, mass + _SURROUNDINGS)
    width = near.stop - near.start
    if width < 1 or around.stop - around.start < width:
        return 0.0
    # a quarter of as many bins elsewhere are between peaks
    background = np.percentile(np.convolve(count[around], np.ones(width), "valid"), 25)
    above = count[near].sum() - background
    return float(above) if above > _SIGNIFICANT * np.sqrt(background + 1) else 0.0


def _bins_of_peak(edges, mass):
    return _bins_between(edges, mass - _SHARP, (1 + _TAIL) * mass + _SHARP)


def _bins_between(edges, low, high):
    first, last = np.searchsorted(edges, [low, high], side="right")
    return slice(max(int(first) - 1, 0), min(int(last), len(edges) - 1))
