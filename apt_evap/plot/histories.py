"""Field, voltage, rate and charges during a run."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from apt_evap._common.validation import check_choice, check_count, check_kind
from apt_evap.detection.hits import Hits
from apt_evap.plot._figure import ion_label, new_figure, set_log_ticks, with_default_settings
from apt_evap.simulation.run import Run
from apt_evap.simulation.voltage_history import evaporation_voltages, smoothed_history
from apt_evap.spectra.charge_states import LEAST, charge_history, ion_charges
from apt_evap.spectra.mass_ranges import Ranges

_PER_SECTION = 100  # ions of a section in which they are counted: an error of 10 %
_LEAST_RANGE = 4.0  # of a logarithmic axis, highest over lowest value


@with_default_settings
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
    axes = _stacked(axes, len(panels), run, 2.3)
    for ax, (label, values) in zip(axes, panels, strict=True):
        _draw_history(ax, values, points)
        ax.set(ylabel=label, xlim=(0, len(values)))
        ax.grid(alpha=0.3)
    axes[0].legend(loc="best", frameon=False, ncols=2)
    _label_ions(axes[-1])
    return axes


@with_default_settings
def voltage_curve(
    run: Run | Hits,
    axes: Sequence[Axes] | None = None,
    *,
    points: int = 200,
    element: str | None = None,
    ranges: Ranges | None = None,
) -> NDArray[np.object_]:
    """Draw the history of a run or of a measurement against the ions: voltage, field, rate and charges.

    There are up to four panels, those for which there are data:

    * the voltage [V]: of a run the total one, at the top of a pulse; of ions the standing one, `Hits.voltage`;
    * for a run, the mean field of the cap at this voltage [V/nm];
    * the rate: ions per pulse, or per second without pulses;
    * the ratio of the two neighbouring charges that are most frequent, with its error.

    Rate and ratio are averaged over sections of at least 100 ions.

    Parameters
    ----------
    run : Run or Hits
        A run in real units (`Run.at_evaporation_field`) or with a temperature, or ions with a voltage. The rate needs
        `pulses`, and all ions of a measurement.
    axes : sequence of matplotlib.axes.Axes, optional
        One per panel; a new figure by default.
    points : int
        Largest number of points along each line.
    element : str, optional
        Element of the charges. By default the first one of a run, and all ions of `Hits` with charges.
    ranges : Ranges, optional
        Ranges of the mass-to-charge ratio, for the charges of measured ions of the element.

    Returns
    -------
    ndarray of matplotlib.axes.Axes
        One per panel, from top to bottom.

    Raises
    ------
    ValueError
        If the voltage of a run is constant, there are no ions or no voltages, the element is missing or unknown, or the
        number of axes is wrong.
    """
    points = check_count(points, "points", at_least=1)
    if not len(check_kind(run, "run", Run | Hits, "a Run or Hits")):
        raise ValueError(f"a curve needs ions, got {run!r}")
    if isinstance(run, Hits):
        if ranges is not None and element is None:
            raise ValueError("ranges need the element of the charges, such as element='Ni'")
        panels = _panels_of_hits(run, points, element, ranges)
    else:
        panels = _panels_of_run(run, points, element)
    axes = _stacked(axes, len(panels), run, 1.7)
    for ax, (draw, *values) in zip(axes, panels, strict=True):
        draw(ax, *values)
        ax.set_xlim(0, len(run))
        ax.grid(alpha=0.3)
    _label_ions(axes[-1])
    axes[0].figure.align_ylabels(list(axes))
    return axes


def _stacked(axes, n, run, height):
    """The given axes, or those of a new figure below each other."""
    if axes is None:
        axes = new_figure((6.4, 0.6 + height * n)).subplots(n, 1, sharex=True, squeeze=False)
    axes = np.atleast_1d(np.asarray(axes, dtype=object)).ravel()
    if len(axes) != n:
        raise ValueError(f"axes must be {n} for {run!r}, got {len(axes)}")
    return axes


def _label_ions(ax):
    ax.set_xlabel("ions")
    ax.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")


def _draw_history(ax, values, points):
    ions, low, median, high = smoothed_history(values, points)
    ax.fill_between(ions, low, high, color="C0", alpha=0.25, linewidth=0, label="90 % of the ions")
    ax.plot(ions, median, color="C0", linewidth=1.3, label="median")


def _panels(run):
    """Label and values of each panel."""
    if isinstance(run, Hits):
        (voltage,) = run.require("voltage")
        return [("voltage [V]", voltage)]
    voltages = evaporation_voltages(run)
    return [(f"field at {run.voltage:g} V [V/nm]", run.fields), ("voltage of evaporation [V]", voltages)]


def _panels_of_run(run, points, element):
    """Function that draws each panel of a run, with its arguments."""
    operating = run.observation.operating
    if operating.is_constant:
        raise ValueError(
            f"the voltage of {run!r} is constant: use the run in real units, run.at_evaporation_field(), or `history`"
        )
    label = "voltage with\npulse [V]" if operating.control.pulse_fraction > 0 else "voltage [V]"
    panels = [(_draw_voltage, operating.instrument_voltages, points, label)]
    ions = run.emissions.ions
    known = np.isfinite(run.cap.fields) & (run.cap.ions >= ions[0]) & (run.cap.ions <= ions[-1])
    if known.any():
        at = run.cap.ions[known]
        fields = run.cap.fields[known] * np.interp(at, ions, run.voltages) / run.voltage
        panels.append((_draw_field, at - ions[0], fields, operating.cap_field))
    edges = _sections(len(run), points)
    if rates := operating.ion_rates(edges):
        panels.append((_draw_rate, edges, rates.values, f"ions per {rates.per}", rates.goal))
    if "charge_state" in (columns := operating.truth()):
        element = run.elements[0] if element is None else check_choice(element, "element", run.elements)
        names = np.array(run.elements)[run.species]
        panels += _charges(np.where(names == element, columns["charge_state"], 0), element, points)
    return panels


def _panels_of_hits(hits, points, element, ranges):
    (voltage,) = hits.require("voltage")
    pulsed = hits.pulse_voltage is not None and hits.pulse_voltage.any()
    panels = [(_draw_voltage, voltage, points, "standing\nvoltage [V]" if pulsed else "voltage [V]")]
    if hits.pulses is not None and hits.pulses.any():
        edges = _sections(len(hits), points)
        detected, pulses = (np.add.reduceat(column, edges[:-1], dtype=float) for column in (hits.detected, hits.pulses))
        panels.append((_draw_rate, edges, detected / np.maximum(pulses, 1), "ions per pulse", None))
    if ranges is not None or "charge_state" in hits.extra:
        charges = hits.extra["charge_state"] if element is None else ion_charges(hits, element, ranges)
        panels += _charges(np.where(hits.detected, charges, 0), element, points)
    return panels


def _charges(charges, element, points):
    """Panel with the charge state ratio; none without enough ions of two neighbouring charges."""
    numbers = np.bincount(charges)
    if len(numbers) < 3 or np.minimum(numbers[1:-1], numbers[2:]).max() < LEAST:
        return []
    ratios = charge_history(charges, element or "")
    if len(ratios.middles) > points:
        ratios = charge_history(charges, element or "", sections=points)
    return [(_draw_ratio, ratios)]


def _sections(n, points):
    """Edges of sections of at least 100 ions."""
    return np.linspace(0, n, min(points, max(n // _PER_SECTION, 1)) + 1).astype(int)


def _draw_voltage(ax, voltages, points, label):
    _draw_history(ax, voltages, points)
    ax.set_ylabel(label)


def _draw_field(ax, ions, fields, goal):
    ax.plot(ions, fields, color="C0", linewidth=1.3, marker="o", markersize=2.5)
    if goal is not None:
        _draw_goal(ax, goal, "operating field")
    ax.set_ylabel("field at the\ncap [V/nm]")


def _draw_rate(ax, edges, rates, label, goal):
    ax.stairs(rates, edges, color="C0", linewidth=1.3, baseline=None)
    if goal is not None:
        _draw_goal(ax, goal, "control")
    ax.set_yscale("log")
    set_log_ticks(ax.yaxis, _LEAST_RANGE)
    ax.set_ylabel(label)


def _draw_ratio(ax, ratios):
    n, errors = ratios.charge, np.exp(ratios.ratio_error)
    ax.fill_between(ratios.middles, ratios.ratio / errors, ratios.ratio * errors, color="C0", alpha=0.25, linewidth=0)
    ax.plot(ratios.middles, ratios.ratio, color="C0", linewidth=1.3)
    ax.set_yscale("log")
    set_log_ticks(ax.yaxis, _LEAST_RANGE)
    if ratios.element:
        ax.set_ylabel(f"{ion_label(ratios.element, n + 1)} / {ion_label(ratios.element, n)}")
    else:
        ax.set_ylabel(f"ions {n + 1}+ / {n}+")


def _draw_goal(ax, value, label):
    ax.axhline(value, color="0.35", linewidth=0.9, linestyle=(0, (4, 3)), label=label)
    ax.legend(loc="best", frameon=False, fontsize="small")
