"""What pictures show is what they were given, with its unit; how they look is looked at."""

import io
import os
import subprocess
import sys
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Circle
from matplotlib.text import Text

import apt_evap as ae
from apt_evap import plot
from apt_evap.detection import ion_blocks
from apt_evap.maps.profiles import Profile
from apt_evap.plot._figure import _Layout, set_log_ticks
from apt_evap.plot.map_figures import binned, specimen_title
from apt_evap.plot.profile_figures import rectangles
from apt_evap.plot.responses import ion_colors
from apt_evap.plot.specimen_figures import mark_atoms
from apt_evap.reconstruction.consistency import density_near_axis
from apt_evap.simulation.voltage_history import evaporation_voltages, smoothed_history
from apt_evap.spectra.charge_states import charge_history, charge_state_ratio_map, ion_charges


@pytest.fixture(scope="session")
def emitter(small_tip):
    return ae.evaporation.Emitter(small_tip)


@pytest.fixture(scope="session")
def run(small_tip, made_once):
    """250 ions with responses."""
    return made_once(small_tip, 250, voltage=1000.0, seed=2)


def label_of_bar(ax):
    """Label of the colour bar of a picture, the last axes of its figure."""
    return ax.figure.axes[-1].get_ylabel()


def assert_nothing_cut_off(figure):
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # it is laid out; to save it does not do so again
    boxes = [ax.get_tightbbox().transformed(figure.transFigure.inverted()) for ax in figure.axes]
    assert min(box.min.min() for box in boxes) > 0 and max(box.max.max() for box in boxes) < 1


def discs_of(ax):
    """The coloured discs of a picture of a specimen."""
    (discs,) = [c for c in ax.collections if isinstance(c, EllipseCollection) and c.get_array() is not None]
    return discs


# ---- maps ----------------------------------------------------------------------------------------------------------


TITLES = (None, "0.75 roll-up + 0.25 lateral velocity, 0.155 ± 0.155 eV")
PICTURES = list(product((100, 150, 1500), TITLES, (0.6, 1.0, 1.1)))


@pytest.mark.slow
@pytest.mark.parametrize(
    "half, title, height",
    # every other one: each half with each height, each with and without a title
    [*PICTURES[::2], *(pytest.param(*picture, marks=pytest.mark.slow) for picture in PICTURES[1::2])],
)
def test_nothing_of_a_map_is_cut_off(half, title, height):
    random = np.random.default_rng(0)
    edges = np.linspace(-half, half, 21)
    map = ae.DetectorMap.from_array(random.random((20, 20)), edges, height * edges)
    (ax,) = axes = plot.detector_maps([map], [title])
    alone = plot.detector_map(map, title=title)
    for figure in (ax.figure, alone.figure):
        assert_nothing_cut_off(figure)
    assert len(axes) == 1


@pytest.mark.parametrize(("changes", "passes"), [(0, 1), (1, 2), (5, 3)])
def test_a_layout_is_repeated_while_it_changes_ticks(monkeypatch, changes, passes):
    figure = plot.new_figure((3.0, 3.0))
    ax = figure.subplots()
    done = []

    def lay_out(self, figure):
        ax.set_xticks(range(2 + min(len(done), changes - 1)) if changes else ax.get_xticks())
        done.append(1)

    monkeypatch.setattr(ConstrainedLayoutEngine, "execute", lay_out)
    figure.get_layout_engine().execute(figure)
    assert len(done) == passes


@pytest.mark.parametrize("form", ["png", "svg", "pdf"])
def test_a_file_is_drawn_once_after_its_layout(monkeypatch, form):
    figure = plot.new_figure((5, 3))
    ax = figure.subplots()
    ax.set(xlabel="x [mm]", ylabel="hits per area / mean", title="a map")
    drawn, draw = [], type(ax).draw
    monkeypatch.setattr(type(ax), "draw", lambda self, renderer: drawn.append(self) or draw(self, renderer))
    once = io.BytesIO()
    figure.savefig(once, format=form)
    assert drawn == [ax]
    position = ax.get_position().bounds
    # as by Matplotlib, which draws everything for the layout, too
    figure = Figure((5, 3), dpi=150, layout=_Layout(compress=True, h_pad=0.08, w_pad=0.06))
    ax = figure.subplots()
    ax.set(xlabel="x [mm]", ylabel="hits per area / mean", title="a map")
    twice = io.BytesIO()
    figure.savefig(twice, format=form)
    assert ax.get_position().bounds == position
    if form == "png":
        assert twice.getvalue() == once.getvalue()


def test_titles_are_broken_at_commas():
    map = ae.DetectorMap.from_array(np.ones((4, 4)), np.arange(5.0), np.arange(5.0))
    for title, lines in (
        ("roll-up, 0.3 ± 0.1 eV", ["roll-up, 0.3 ± 0.1 eV"]),
        ("0.75 roll-up + 0.25 lateral, 0.155 ± 0.155 eV", ["0.75 roll-up + 0.25 lateral,", "0.155 ± 0.155 eV"]),
        ("two\nlines", ["two", "lines"]),
        ("no comma in a title that is too long for one line", ["no comma in a title that is too long", "for one line"]),
        ("x" * 50, ["x" * 36, "x" * 14]),
    ):
        assert plot.detector_map(map, title=title).get_title().splitlines() == lines


def text_with(ax, words):
    """The only text of the axes, or of an axis of theirs, with some words."""
    (text,) = (text for text in ax.findobj(Text) if words in text.get_text())
    return text


@pytest.mark.slow
def test_a_later_title_is_above_the_caption(ratios, rough_layout):
    map = ae.DetectorMap.from_array(np.random.default_rng(0).random((40, 40)), np.arange(41.0), np.arange(41.0))
    here = ae.Registration(0.0, 1.0, (0.0, 0.0))
    for ax, words in (
        (plot.detector_map(map), "mm bins"),
        (plot.detector_map(map, title="first"), "mm bins"),
        (plot.overlay(map, map, here), "as given"),
        (plot.charge_states(ratios[0])[0], "ratio"),
    ):
        ax.set_title("a title in\ntwo lines")
        ax.figure.draw_without_rendering()
        caption = text_with(ax, words).get_window_extent()
        assert ax.title.get_window_extent().y0 >= caption.y1 and caption.y0 > ax.get_window_extent().y1


def test_lines_of_an_overlay_are_those_of_its_legend():
    map = ae.DetectorMap.from_array(np.random.default_rng(0).random((40, 40)), np.arange(41.0), np.arange(41.0))
    for own in (None, Figure().subplots()):
        ax = plot.overlay(map, map, ae.Registration(0.0, 0.5, (0.0, 0.0)), own)
        (legend,) = ax.figure.legends if own is None else [ax.get_legend()]
        drawn = {tuple(each.get_edgecolor()[0]) for each in ax.collections}
        assert {to_rgba(line.get_color()) for line in legend.get_lines()} == drawn and len(drawn) == 3
        assert np.mean(legend.get_frame().get_facecolor()[:3]) < 0.5  # one line is white


@pytest.mark.slow
def test_titles_are_names_of_files(run, emitter):
    """Dollar signs are no formula, and a byte that is not text is a mark of its own."""
    map = ae.DetectorMap.from_array(np.random.default_rng(0).random((40, 40)), np.arange(41.0), np.arange(41.0))
    here = ae.Registration(0.0, 1.0, (0.0, 0.0))
    for title, written in (
        ("x$_$.epos", "x$_$.epos"),
        (os.fsdecode(b"caf\xe9.epos"), "caf\N{REPLACEMENT CHARACTER}.epos"),
    ):
        for ax in (
            plot.detector_map(map, title=title),
            *plot.detector_maps([map], [title]),
            plot.overlay(map, map, here, title=title),
            plot.specimen(emitter, title=title),
            plot.response(run, [3], title=title),
        ):
            assert ax.get_title() == written
            ax.title.get_window_extent()  # its letters are laid out


def test_a_round_field_of_view_is_a_circle_and_a_run_has_a_title(run):
    edges = np.linspace(-20, 20, 101)
    x, y = np.meshgrid(*2 * [(edges[1:] + edges[:-1]) / 2])
    for mask, circles in ((np.hypot(x - 2, y + 1) < 15, 1), (abs(x) + abs(y) < 15, 0), (np.isfinite(x), 0)):
        ax = plot.detector_map(ae.DetectorMap.from_array(np.ones(x.shape), edges, edges, mask))
        drawn = [each for each in ax.patches if isinstance(each, Circle)]
        assert len(drawn) == circles
        for circle in drawn:  # the mean of 4,400 bins of 0.4 mm
            assert circle.center == pytest.approx((2, -1), abs=0.02) and circle.radius == pytest.approx(15, abs=0.02)
    (ax,) = plot.detector_maps([run.hits(ae.Unperturbed())], ["own"], title=specimen_title(run))
    assert ax.get_title() == "own" and ax.figure.get_suptitle() == "Ni, axis [111], R = 2.1 nm"
    assert_nothing_cut_off(ax.figure)


@pytest.mark.parametrize("n, shape", [(1, (1, 1)), (3, (1, 3)), (4, (2, 2)), (5, (2, 3)), (7, (3, 3))])
def test_maps_in_rows(n, shape):
    map = ae.DetectorMap.from_array(np.ones((4, 4)), np.arange(5.0), np.arange(5.0))
    axes = plot.detector_maps([map] * n)
    assert len(axes) == n and axes[0].get_gridspec().get_geometry() == shape


# ---- specimen ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("color, label", [("fields", "field [V/nm]"), ("charges", "charge [e]")])
def test_specimen_from_above(emitter, color, label, tmp_path):
    ax = plot.specimen(emitter, color)
    ax.figure.savefig(tmp_path / "a.png")
    assert (ax.get_xlabel(), ax.get_ylabel(), label_of_bar(ax)) == ("x [nm]", "y [nm]", label)
    discs = discs_of(ax)
    facing = emitter.normals[:, 2] > 1e-9  # below it, rounding would decide
    assert len(discs.get_offsets()) == facing.sum()
    rows = np.column_stack([discs.get_offsets(), discs.get_array()]).round(9)  # rounding must not sort
    expected = np.column_stack([emitter.positions[:, :2], getattr(emitter, color)])[facing].round(9)
    np.testing.assert_array_equal(rows[np.lexsort(rows.T)], expected[np.lexsort(expected.T)])
    assert discs.get_rasterized() and discs._units == "xy"
    assert np.unique(discs.get_widths()).tolist() == [emitter.tip.nearest_neighbour_distance]


def test_the_rim_of_the_foot_does_not_set_the_colours(small_tip, nickel):
    tip = ae.Tip(nickel, apex_radius=6 * nickel.a, axis=(1, 1, 1), shank_length=6 * nickel.a, base="flat")
    flat = ae.evaporation.Emitter(tip)
    low, high = discs_of(plot.specimen(flat, elevation=10, azimuth=-60)).get_clim()
    shown = flat.normals @ [
        np.cos(np.radians(10)) * 0.5,
        -np.cos(np.radians(10)) * np.sqrt(0.75),
        np.sin(np.radians(10)),
    ]
    leaving = flat.fields[(shown > 1e-9) & tip.evaporable[flat.atoms]]
    assert (low, high) == pytest.approx(tuple(np.percentile(leaving, [1, 99.5])))
    assert flat.fields.max() > high


def test_specimen_from_the_side_has_a_scale(emitter, tmp_path):
    ax = plot.specimen(emitter, elevation=0, azimuth=-90)  # x to the right, z upwards, seen from -y
    ax.figure.savefig(tmp_path / "a.png")
    places = discs_of(ax).get_offsets()
    expected = emitter.positions[emitter.normals[:, 1] < -1e-9][:, [0, 2]]
    for column in (0, 1):
        np.testing.assert_allclose(np.sort(places[:, column]), np.sort(expected[:, column]), atol=1e-12)
    texts = [text.get_text() for text in ax.texts]
    assert "1 nm" in texts and {"x", "z"} <= set(texts) and "y" not in texts
    (bar,) = ax.lines
    assert np.ptp(bar.get_xdata()) == pytest.approx(1.0)  # the bar is as long as it says
    assert ax.get_aspect() == 1


def test_what_is_in_front_is_drawn_last(emitter):
    # numbers that say how near an atom is to a viewer at an elevation of 30 and an azimuth of 90 degrees
    nearness = emitter.positions @ [0, np.cos(np.pi / 6), np.sin(np.pi / 6)]
    drawn = discs_of(plot.specimen(emitter, nearness, elevation=30, azimuth=90)).get_array()
    assert 500 < len(drawn) < len(emitter)
    assert np.diff(drawn).min() > -1e-9  # atoms of one depth may go either way by their rounding


def test_specimen_by_numbers_of_ones_own(emitter):
    ax = plot.specimen(emitter, emitter.positions[:, 2], label="height [nm]", limits=(0, 2), colorbar=True)
    assert label_of_bar(ax) == "height [nm]" and discs_of(ax).get_clim() == (0, 2)
    for wrong, message in (("heights", "color must be one of fields, charges"), ([1.0, 2.0], "color must have shape")):
        with pytest.raises(ValueError, match=message):
            plot.specimen(emitter, wrong)
    with pytest.raises(ValueError, match="elevation"):
        plot.specimen(emitter, elevation=100)


def test_a_slice_shows_the_atoms_of_each_phase(tmp_path):
    ball = ae.specimen.Phase("ball", "Cu", region=ae.specimen.Sphere((0, 0, 1), 1.0))
    gamma = ae.specimen.Phase("matrix", "Ni", order=ae.specimen.Superlattice("L1_2", "Al"))
    tip = ae.Tip(phases=[gamma, ball], apex_radius=2.5, shank_length=2.0)
    for color, names in (("phase", ["matrix", "ball"]), ("species", ["Ni", "Al", "Cu"])):
        ax = plot.cut(tip, color, thickness=0.4, colors={"ball": "red", "Cu": "red"})
        (discs,) = [c for c in ax.collections if isinstance(c, EllipseCollection)]
        inside = np.abs(tip.positions[:, 1]) <= 0.2
        assert len(discs.get_offsets()) == inside.sum()
        red = (discs.get_facecolors() == to_rgba("red")).all(axis=1)
        assert red.sum() == (inside & (tip.phase == 1)).sum() > 0
        drawn = {tuple(place) for place in np.round(discs.get_offsets()[red], 9)}
        assert drawn == {tuple(place) for place in np.round(tip.positions[inside & (tip.phase == 1)][:, [0, 2]], 9)}
        assert [text.get_text() for text in ax.get_legend().get_texts()] == names
        assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [nm]", "z [nm]")
        assert_nothing_cut_off(ax.figure)
    above = plot.cut(tip, normal=(0, 0, 1), point=(0, 0, 1), left=tip.phase == 1, legend=False)
    assert (above.get_xlabel(), above.get_ylabel()) == ("x [nm]", "y [nm]") and above.get_legend() is None
    assert plot.cut(tip, normal=(1, 0, 0)).get_xlabel() == "y [nm]"
    with pytest.raises(ValueError, match="no atom is in the slice"):
        plot.cut(tip, point=(0, 99, 0))
    with pytest.raises(ValueError, match="color"):
        plot.cut(tip, "fields")


def test_marks_are_around_the_atoms(emitter):
    ax = plot.specimen(emitter, elevation=30, azimuth=-60)
    atoms = np.argsort(-emitter.normals[:, 2], kind="stable")[[0, 7]]  # they face upwards, so are drawn
    mark_atoms(emitter.positions[atoms], ax, colors=["red", "blue"], elevation=30, azimuth=-60)
    marks = ax.collections[-1]
    drawn = discs_of(ax).get_offsets()
    for place in marks.get_offsets():
        assert np.abs(drawn - place).max(axis=1).min() < 1e-9
    np.testing.assert_array_equal(marks.get_edgecolors(), [to_rgba("red"), to_rgba("blue")])


# ---- history -------------------------------------------------------------------------------------------------------


def test_history_of_a_run(run, tmp_path):
    upper, lower = plot.history(run, points=10)
    upper.figure.savefig(tmp_path / "a.png")
    assert upper.get_ylabel() == "field at 1000 V [V/nm]" and lower.get_ylabel() == "voltage of evaporation [V]"
    ions, fields = upper.lines[0].get_data()
    np.testing.assert_allclose(fields, np.median(run.fields.reshape(10, 25), axis=1))
    np.testing.assert_allclose(ions, 12.5 + 25 * np.arange(10), atol=0.5)
    band = upper.collections[0].get_paths()[0].vertices
    at_first = band[np.isclose(band[:, 0], ions[0]), 1]
    assert [at_first.min(), at_first.max()] == pytest.approx(np.percentile(run.fields[:25], [5, 95]))
    np.testing.assert_array_equal(lower.lines[0].get_ydata(), smoothed_history(evaporation_voltages(run), 10).median)


def test_history_of_a_measurement():
    voltage = np.linspace(3000, 4000, 1000)
    (ax,) = plot.history(ae.Hits(voltage=voltage), points=20)
    assert ax.get_ylabel() == "voltage [V]" and ax.get_xlabel() == "ions"
    np.testing.assert_allclose(ax.lines[0].get_ydata(), np.median(voltage.reshape(20, 50), axis=1))
    with pytest.raises(ValueError, match="no column 'voltage'"):
        plot.history(ae.Hits(x=[0.0], y=[0.0]))
    with pytest.raises(ValueError, match="axes"):
        plot.history(ae.Hits(voltage=voltage), [ax, ax])


# ---- voltage, rate and charges -------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def real(run):
    """The run in real units, with ions of two charges."""
    return run.at_evaporation_field(
        timing=ae.detection.Timing(temperature=50.0), flight_charges=ae.emission.PostIonisation(0.7)
    )


def labels_of(axes):
    return [" ".join(ax.get_ylabel().split()) for ax in axes]


def test_voltage_curve_of_a_run(real, tmp_path):
    axes = plot.voltage_curve(real, points=10)
    assert_nothing_cut_off(axes[0].figure)
    axes[0].figure.savefig(tmp_path / "a.png")
    labels = ["voltage with pulse [V]", "field at the cap [V/nm]", "ions per pulse", "Ni$^{2{+}}$ / Ni$^{{+}}$"]
    assert labels_of(axes) == labels and axes[-1].get_xlabel() == "ions"
    voltage, cap, rate, ratio = axes
    np.testing.assert_array_equal(voltage.lines[0].get_ydata(), smoothed_history(real.voltages, 10).median)
    ions, fields = cap.lines[0].get_data()
    assert ions.tolist() == real.cap.ions[real.cap.ions < 250].tolist()
    np.testing.assert_allclose(fields, (real.cap.fields / 1000)[: len(ions)] * real.voltages[ions])
    assert cap.lines[1].get_ydata()[0] == 35.0  # the operating field
    pulses = np.diff(real.real.pulse_ids[[124, 249]], prepend=0)
    np.testing.assert_allclose(rate.patches[0].get_data().values, 125 / pulses)
    assert rate.lines[0].get_ydata()[0] == 0.01
    expected = charge_history(real.flight_charges, "Ni")
    np.testing.assert_array_equal(ratio.lines[0].get_ydata(), expected.ratio)


def test_voltages_of_an_instrument(run):
    real = run.at_evaporation_field(field_factor=3.3)  # a single charge, 2: no panel of a ratio
    axes = plot.voltage_curve(real, points=5)
    assert labels_of(axes) == ["voltage with pulse [V]", "field at the cap [V/nm]", "ions per pulse"]
    total = real.instrument_voltages
    np.testing.assert_allclose(axes[0].lines[0].get_ydata(), smoothed_history(total, 5).median)


def test_voltage_curve_of_a_run_with_a_temperature(small_tip):
    run = ae.Simulation(small_tip, seed=2, law=ae.Arrhenius(50.0)).run(220, responses=False, progress=False)
    axes = plot.voltage_curve(run, points=2)
    assert labels_of(axes) == ["voltage with pulse [V]", "field at the cap [V/nm]", "ions per pulse"]
    np.testing.assert_array_equal(axes[0].lines[0].get_ydata(), smoothed_history(run.clock.voltages, 2).median)
    pulses = run.clock.waits.reshape(2, 110).sum(axis=1) / run.settings["pulse_length"]
    np.testing.assert_allclose(axes[2].patches[0].get_data().values, 110 / pulses)


def test_voltage_curve_of_ions(real):
    hits = real.hits(ae.Unperturbed())
    axes = plot.voltage_curve(hits, points=4)
    assert labels_of(axes) == ["standing voltage [V]", "ions per pulse", "ions 2+ / 1+"]
    np.testing.assert_allclose(axes[0].lines[0].get_ydata(), smoothed_history(real.voltages / 1.2, 4).median)
    expected = hits.detected[125:].sum() / hits.pulses[125:].sum()
    assert axes[1].patches[0].get_data().values[-1] == pytest.approx(expected)
    ranges = ae.spectra.Ranges(["Ni", "Ni"], [28.9, 57.8], [32.2, 64.4])
    measured = ae.Hits(voltage=hits.voltage, mass_to_charge=hits.mass_to_charge)
    axes = plot.voltage_curve(measured, element="Ni", ranges=ranges)
    assert labels_of(axes) == ["voltage [V]", "Ni$^{2{+}}$ / Ni$^{{+}}$"]
    expected = charge_history(ion_charges(measured, "Ni", ranges), "Ni")
    np.testing.assert_array_equal(axes[1].lines[0].get_ydata(), expected.ratio)


def test_voltage_curves_that_cannot_be_drawn(run, real):
    with pytest.raises(ValueError, match=r"constant: use the run in real units, run.at_evaporation_field\(\), or"):
        plot.voltage_curve(run)
    with pytest.raises(ValueError, match="axes"):
        plot.voltage_curve(real, [plot.new_figure((3, 2)).subplots()])
    with pytest.raises(ValueError, match="ranges"):
        plot.voltage_curve(ae.Hits(voltage=[1.0]), ranges=ae.spectra.Ranges(["Ni"], [28.9], [32.2]))
    with pytest.raises(ValueError, match="no column 'voltage'"):
        plot.voltage_curve(ae.Hits(x=[0.0], y=[0.0]))
    with pytest.raises(ValueError, match="run must be a Run or Hits"):
        plot.voltage_curve(3)
    with pytest.raises(ValueError, match="a curve needs ions, got <Hits: 0 ions"):
        plot.voltage_curve(ae.Hits(voltage=[]))
    with pytest.raises(ValueError, match="element"):
        plot.voltage_curve(real, element="Fe")


@pytest.mark.parametrize("low, high", [(0.9, 1.1), (0.5, 4.5), (0.7, 30.0), (1e-4, 0.5), (2.0, 3e7)])
def test_logarithmic_axes_have_round_numbers(low, high):
    ax = plot.new_figure((4, 2)).subplots()
    ax.plot([0, 1], [low, high])
    ax.set_yscale("log")
    set_log_ticks(ax.yaxis, 1.5)
    ax.figure.draw_without_rendering()
    bottom, top = ax.get_ylim()
    ticks = [tick for tick in ax.get_yticks() if bottom <= tick <= top]
    assert bottom <= low < high <= top and top / bottom > 1.4999
    assert 3 <= len(ticks) <= 9
    assert all(float(f"{tick:.2e}") == pytest.approx(tick, rel=1e-9) for tick in ticks)


# ---- spectrum ------------------------------------------------------------------------------------------------------


def test_spectrum_of_a_run(real, tmp_path):
    ax = plot.spectrum(real)
    assert_nothing_cut_off(ax.figure)
    ax.figure.savefig(tmp_path / "a.png")
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("mass-to-charge ratio [Da]", "ions per 0.02 Da")
    hits = real.hits(ae.Unperturbed())
    mass = hits.mass_to_charge[hits.detected]
    values, edges, _ = ax.patches[0].get_data()
    np.testing.assert_array_equal(np.where(values > 0.5, values, 0), np.histogram(mass, edges)[0])
    low, high = ax.get_xlim()
    assert low < mass.min() and mass.max() < high
    texts = {text.get_text() for text in ax.texts}
    assert {"$^{58}$Ni$^{2{+}}$", "$^{60}$Ni$^{2{+}}$", "$^{58}$Ni$^{{+}}$"} <= texts
    assert all("Ni" in text for text in texts)


def test_spectra_compared(real):
    hits = real.hits(ae.Unperturbed())
    ax = plot.spectrum([hits, hits[:100]], ["all", "first"], bin_width=0.5, limits=(20, 70))
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["all", "first"]
    assert ax.get_ylabel() == "fraction of the ions [1/Da]" and not ax.texts  # hits do not know their elements
    for patch in (ax.patches[0], ax.patches[2]):  # the second is the filled area of the first
        values, edges, floor = patch.get_data()
        assert 0.5 * values[values > floor].sum() == pytest.approx(1)
        np.testing.assert_allclose(edges, np.arange(20, 70.1, 0.5))


def test_isotopes_are_labelled_where_there_are_peaks():
    rng = np.random.default_rng(1)
    peaks = np.repeat([13.99, 14.49, 18.0], [5000, 300, 200]) + rng.normal(0, 0.01, 5500)
    hits = ae.Hits(mass_to_charge=np.concatenate([peaks, rng.uniform(10, 300, 400)]))
    ax = plot.spectrum(hits, elements=["Si", "Cr"], limits=(10, 30))
    # at 18 Da is 54Cr3+, but no 52Cr3+: it is not chromium
    assert {text.get_text() for text in ax.texts} == {"$^{28}$Si$^{2{+}}$", "$^{29}$Si$^{2{+}}$"}
    assert not plot.spectrum(hits, limits=(10, 30)).texts
    low, high = plot.spectrum(hits).get_xlim()
    assert 12 < low < 14 and 18 < high < 20  # without the background
    # 58Ni4+ and 60Ni4+ would be at 14.48 and 14.98 Da, but nickel has no more than two charges
    hits = ae.Hits(mass_to_charge=np.repeat([13.99, 14.48, 14.98, 28.97, 29.97], [90_000, 5000, 3000, 700, 300]))
    texts = {text.get_text() for text in plot.spectrum(hits, elements=["Si", "Ni"], limits=(10, 32)).texts}
    assert texts == {f"$^{{{mass}}}$Si$^{{2{{+}}}}$" for mass in (28, 29, 30)} | {
        f"$^{{{mass}}}$Ni$^{{2{{+}}}}$" for mass in (58, 60)
    }


def overlapping(texts):
    """Pairs of visible texts whose boxes overlap, in pixels."""
    boxes = [Text.get_window_extent(text) for text in texts if text.get_visible()]
    boxes = [box.padded(-0.01) for box in boxes]  # those that touch are apart, to rounding
    return [(a, b) for number, a in enumerate(boxes) for b in boxes[:number] if a.overlaps(b)]


@pytest.mark.usefixtures("spectra_once")
def test_labels_of_near_peaks_are_apart_and_those_of_the_largest_are_there(rng):
    peaks = {"H": 1.0, "H2": 2.0, "C": 12.0, "Si": 14.0, "O": 16.0, "OH": 17.0, "H2O": 18.0, "Si+": 28.0, "CO": 28.6}
    number = dict(zip(peaks, (9000, 6000, 150, 40_000, 220, 40, 160, 2500, 30), strict=True))
    mass = np.concatenate([rng.normal(peaks[name], 0.01, number[name]) for name in peaks])
    ions = ae.Hits(mass_to_charge=np.concatenate([mass, rng.uniform(0.5, 110, 2000)]))
    at = np.array(list(peaks.values()))
    ranges = ae.spectra.Ranges(names=tuple(peaks), low=at - 0.1, high=at + 0.1)
    ax = plot.spectrum(ae.spectrum(ions, elements=["Si"]), ranges=ranges)
    ax.figure.draw_without_rendering()
    visible = {text.get_text() for text in ax.texts if text.get_visible()}
    assert {"H", "H2", "C", "Si", "O", "H2O", "Si+"} <= visible
    assert not overlapping([*ax.texts, *ax.get_legend().get_texts()])
    frame = ax.get_window_extent()
    counts, edges, _ = ax.patches[0].get_data()
    for text in ax.texts:
        box = Text.get_window_extent(text)
        assert frame.x0 <= box.x0 and box.x1 <= frame.x1 and box.y1 <= frame.y1
        left, right = ax.transData.inverted().transform([(box.x0, 1), (box.x1, 1)])[:, 0]
        below = counts[(edges[1:] > left) & (edges[:-1] < right)].max()
        assert box.y0 > ax.transData.transform((left, below))[1]  # above the curve
    # in a small picture, too
    small = plot.new_figure((3.4, 2.2)).subplots()
    plot.spectrum(ae.spectrum(ions, elements=["Si"]), ax=small, ranges=ranges)
    small.figure.draw_without_rendering()
    shown = [text.get_text() for text in small.texts if text.get_visible()]
    assert {"Si", "H", "H2"} <= set(shown)
    assert not overlapping(small.texts)


def test_near_ranges_of_one_name_have_one_label_and_hydrogen_one_charge(rng):
    mass = np.concatenate([rng.normal(at, 0.01, 900) for at in (1.008, 58.0, 60.0)])
    hits = ae.Hits(mass_to_charge=np.concatenate([mass, rng.uniform(0.1, 90, 3000), np.full(40, 0.252)]))
    ranges = ae.spectra.Ranges(names=("Ni", "Ni", "H"), low=[57.9, 59.9, 0.9], high=[58.1, 60.1, 1.1])
    ax = plot.spectrum(ae.spectrum(hits, elements=["Ni"]), ranges=ranges)
    assert sorted(text.get_text() for text in ax.texts) == ["H", "Ni"]
    assert {text.get_text() for text in plot.spectrum(hits, elements=["H"]).texts} == {"$^{1}$H$^{{+}}$"}


def test_spectra_that_cannot_be_drawn(run, real):
    hits = real.hits(ae.Unperturbed())
    for ions, options, message in (
        (run, {}, "needs a run in real units"),
        ([], {}, "spectrum needs ions, with one label each, got 0 and 0"),
        ([hits], {"labels": ["a", "b"]}, "got 1 and 2"),
        (hits, {"bin_width": 0.0}, "bin_width must be"),
        (hits, {"limits": (30, 20)}, "limits must be 0 <= low < high"),
        (hits, {"bin_width": 1e-9}, "with at most 1,000,000 bins"),
        (hits, {"elements": ["Xx"]}, "elements must be one of"),
        (ae.Hits(mass_to_charge=[np.nan]), {}, "needs detected ions, got none"),
        (ae.Hits(x=[0.0], y=[0.0]), {}, "no column 'mass_to_charge'"),
        (3, {}, "ions must be a sequence of runs or hits"),
    ):
        with pytest.raises(ValueError, match=message):
            plot.spectrum(ions, **options)


# ---- charge states -------------------------------------------------------------------------------------------------


def charged(n, slope, seed, half=30.0):
    """Ions of Ni in a field that rises along x."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-half, half, (2, n))
    fields = 24.4 * (1 + slope * x / half)
    charges = ae.emission.PostIonisation().draw(["Ni"], np.zeros(n, int), [1], fields, rng.random(n))
    return ae.Hits(x=x, y=y, extra={"charge_state": charges})


@pytest.fixture(scope="session")
def ratios():
    first = charge_state_ratio_map(charged(20_000, 0.02, 1), "Ni", 1)
    return first, charge_state_ratio_map(charged(20_000, 0.01, 2), "Ni", 1, like=first)


@pytest.mark.slow
def test_charge_states_side_by_side(ratios, tmp_path):
    for quantity, label in (("ratio", ""), ("field", "field from ")):
        axes = plot.charge_states(*ratios, quantity=quantity)
        assert_nothing_cut_off(axes[0].figure)
        axes[0].figure.savefig(tmp_path / "a.png")
        assert [ax.get_title() for ax in axes] == ["simulated", "measured"]
        unit = " [V/nm]" if quantity == "field" else ""
        assert label_of_bar(axes[0]) == f"{label}Ni$^{{2{{+}}}}$ / Ni$^{{{{+}}}}${unit}"
        assert axes[0].images[0].norm is axes[1].images[0].norm
        for ax, map in zip(axes, ratios, strict=True):
            np.testing.assert_array_equal(ax.images[0].get_array().filled(np.nan), getattr(map, quantity))
        values = np.concatenate([getattr(map, quantity)[np.isfinite(map.ratio)] for map in ratios])
        assert axes[0].images[0].get_clim() == pytest.approx(tuple(np.percentile(values, [1, 99])))
        assert axes[0].get_xlim() == axes[1].get_xlim() and axes[0].get_ylim() == axes[1].get_ylim()
        assert text_with(axes[1], f"ratio {ratios[1].total:.3g}").get_visible()


def test_charge_states_of_a_single_map(ratios):
    figure = plot.new_figure((5, 4))
    (ax,) = plot.charge_states(ratios[0], axes=[figure.subplots()], titles=["a$b"], limits=(0.5, 2.0))
    assert ax.figure is figure and ax.get_title() == "a$b" and ax.images[0].get_clim() == (0.5, 2.0)
    assert plot.charge_states(ratios[0])[0].get_title() == ""


def test_charge_states_that_cannot_be_drawn(ratios):
    other = charge_state_ratio_map(charged(1000, 0.0, 3), "Co", 1)
    with pytest.raises(ValueError, match=r"same element and charges, got Ni2\+/Ni1\+ and Co2\+/Co1\+"):
        plot.charge_states(ratios[0], other)
    for options, message in (
        ({"quantity": "fields"}, "quantity must be one of ratio, field"),
        ({"titles": ["a", "b"]}, "axes and titles must be 1, one per map, got 1 and 2"),
        ({"limits": (2, 1)}, "limits must be low < high"),
        ({"limits": (0, 1)}, "and > 0 for ratios"),
        ({"measured": 3}, "measured must be a ChargeStateMap"),
    ):
        with pytest.raises(ValueError, match=message):
            plot.charge_states(ratios[0], **options)


# ---- response ------------------------------------------------------------------------------------------------------


def test_response_to_lateral_velocities(run, tmp_path):
    ions = [3, 50, 120]
    ax = plot.response(run, ions, energies=[0.0, 0.5, 1.0], zoom=1, title="three")
    ax.figure.savefig(tmp_path / "a.png")
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [mm]", "y [mm]")
    assert label_of_bar(ax) == "launch energy [eV]"
    cloud, dots = ax.collections[:2]
    np.testing.assert_array_equal(np.unique(cloud.get_array()), [0, 0.5, 1])
    still = run.hits(ae.Unperturbed())[ions]
    np.testing.assert_allclose(dots.get_offsets(), np.column_stack([still.x, still.y]), atol=1e-9)
    tracks = ae.simulation.lateral_tracks(run, ions, [1.0], np.arange(0, 360, 2))
    farthest = cloud.get_offsets()[cloud.get_array() == 1]
    np.testing.assert_allclose(farthest[:, 0], tracks.x.ravel(), atol=1e-9)
    np.testing.assert_array_equal(dots.get_facecolors(), [to_rgba(color) for color in ion_colors(3)])
    (inset,) = ax.child_axes
    assert np.all(
        np.abs(np.subtract(dots.get_offsets()[1], [np.mean(inset.get_xlim()), np.mean(inset.get_ylim())])) < 10
    )


def test_response_to_rollup(run, tmp_path):
    ions = [3, 50]
    energies = np.linspace(0, 1, 6)
    ax = plot.response(run, ions, "roll-up", energies=energies, colorbar=False)
    ax.figure.savefig(tmp_path / "a.png")
    lines = [c for c in ax.collections if isinstance(c, LineCollection)]
    assert len(lines) == 2
    tracks = ae.simulation.rollup_tracks(run, ions, energies)
    for line, x, y in zip(lines, tracks.x, tracks.y, strict=True):
        segments = np.array([path.vertices for path in line.get_paths()])
        np.testing.assert_allclose(segments[:, 0], np.column_stack([x, y])[:-1])
        np.testing.assert_allclose(segments[:, 1], np.column_stack([x, y])[1:])
        np.testing.assert_allclose(line.get_array(), energies[:-1] + 0.1)
    with pytest.raises(ValueError, match="mechanism"):
        plot.response(run, ions, "rollup")
    with pytest.raises(ValueError, match="zoom"):
        plot.response(run, ions, zoom=2)


# ---- profiles ------------------------------------------------------------------------------------------------------


@pytest.fixture
def two_profiles():
    position = np.linspace(-9.5, 9.5, 20)
    random = np.random.default_rng(4)
    counts = random.poisson(200 * (1 + 2 * np.exp(-0.5 * (position / 2) ** 2)), (2, 20))
    return [Profile(position, n / n.mean(), np.sqrt(n) / n.mean()) for n in counts]


def test_profiles_with_their_lines(two_profiles, tmp_path):
    lines = [ae.maps.fit_zone_line(profile) for profile in two_profiles]
    ax = plot.profile(two_profiles, ["first", "second"], lines=lines)
    ax.figure.savefig(tmp_path / "a.png")
    texts = [text.get_text() for text in ax.get_legend().get_texts()]
    assert texts[0] == f"first: {lines[0].width:.2f} ± {lines[0].width_error:.2f} mm"
    assert ax.get_xlabel() == "distance from the line [mm]" and ax.get_ylim()[0] == 0
    fine, density = ax.lines[0].get_data()
    np.testing.assert_array_equal(density, lines[0].density(fine))
    alone = plot.profile(two_profiles[0], xlabel="azimuth [degrees]")
    assert alone.get_xlabel() == "azimuth [degrees]" and alone.get_legend() is None
    for wrong in ({"labels": ["a"]}, {"lines": lines[:1]}):
        with pytest.raises(ValueError, match="one label and line each"):
            plot.profile(two_profiles, **wrong)


def test_profiles_compared(two_profiles, tmp_path):
    upper, lower = plot.profile_comparison(*two_profiles, ["first", "second"])
    upper.figure.savefig(tmp_path / "a.png")
    compared = ae.maps.compare_profiles(*two_profiles)
    heights = [bar.get_height() for bar in lower.containers[0]]
    np.testing.assert_array_equal(heights, compared.difference)
    assert f"= {compared.chi_square:.0f} for 19" in lower.texts[0].get_text()
    assert lower.get_ylim()[1] > np.abs(compared.difference).max()


def test_rectangles_on_a_map():
    random = np.random.default_rng(1)
    ax = plot.detector_map(ae.Hits(x=random.uniform(-9, 9, 4000), y=random.uniform(-9, 9, 4000)).map(bins=20))
    chosen = ae.maps.Rectangle((1, 2), 30, 6, 4)
    rectangles([chosen, chosen.turned(120)], ax, labels=["a", "b"])
    assert [text.get_text() for text in ax.texts[-2:]] == ["a", "b"]
    np.testing.assert_allclose(ax.patches[-2].get_xy()[:4], chosen.corners)


def test_a_notebook_shows_its_pictures():
    """Kernels of notebooks have imported ipykernel; they show what pyplot has made."""
    code = (
        "import sys, types; sys.modules['ipykernel'] = types.ModuleType('ipykernel'); import apt_evap as ae; "
        "made = ae.plot.new_figure((3, 2)); import matplotlib.pyplot as plt; assert plt.gcf() is made"
    )
    package = str(Path(ae.__file__).parents[1])
    environment = os.environ | {"PYTHONPATH": package, "MPLBACKEND": "agg"}
    done = subprocess.run([sys.executable, "-P", "-c", code], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_maps_of_ions_are_binned_by_themselves(run):
    hits = run.hits(ae.Unperturbed())
    ax = plot.detector_map(hits)
    expected = hits.map(128)
    expected = expected.smoothed(4 * max(expected.bin_size))  # as in 32 bins: 250 ions
    assert np.array_equal(ax.images[0].get_array()[expected.mask], expected.density[expected.mask])
    assert ax.images[0].get_extent() == list(expected.extent)
    both = plot.detector_maps([hits, expected])
    assert np.array_equal(both[0].images[0].get_array(), both[1].images[0].get_array(), equal_nan=True)
    with pytest.raises(ValueError, match="map"):
        plot.detector_map(run)
    with pytest.raises(ValueError, match="maps"):
        plot.detector_maps([hits, "x"])


def test_a_specimen_is_a_surface_a_simulation_or_a_tip(small_tip, emitter):
    simulation = ae.Simulation(small_tip, seed=1)
    drawn = [discs_of(plot.specimen(each)).get_array() for each in (emitter, simulation, small_tip)]
    assert len(drawn[0]) > 100
    assert np.array_equal(drawn[0], drawn[1]) and np.array_equal(drawn[0], drawn[2])
    with pytest.raises(ValueError, match="emitter"):
        plot.specimen("Ni")


# ---- reconstructions -------------------------------------------------------------------------------------------------


def test_a_reconstruction_from_two_sides_with_its_profile(rng):
    radius, azimuth = 20 * np.sqrt(rng.random(9000)), 2 * np.pi * rng.random(9000)
    mass = np.where(np.arange(9000) < 3000, 27.0, np.where(rng.random(9000) < 0.25, 63.0, 90.0))
    ions = ae.Hits(x=radius * np.cos(azimuth), y=radius * np.sin(azimuth), mass_to_charge=mass)
    found = ae.reconstruct(ions, atomic_volume=0.011, distance=90.0, radius=30.0, efficiency=0.5)
    side, top, density, radii = plot.reconstruction(found)
    assert side.yaxis_inverted() and len(top.images) == 1
    # a line for what is expected, 45.5 per nm^3, and the ions within 4 standard deviations of counts
    expected = density.lines[-1].get_ydata()[0]
    assert expected == pytest.approx(0.5 / 0.011)
    counted = density.lines[0].get_ydata()
    assert counted.mean() == pytest.approx(expected, rel=4 / np.sqrt(len(ions) / 4))
    assert set(radii.lines[0].get_ydata()) == {30.0} and radii.get_ylim()[0] == 0
    ranges = ae.spectra.Ranges(names=("Al", "Cu"), low=[26, 62], high=[28, 64])
    with pytest.warns(ae.warnings.DataWarning, match="outside every range"):
        side, _, fractions, bars = plot.reconstruction(found, ranges, title="a$b")
    names, numbers = zip(*(text.get_text().split("\n") for text in bars.get_yticklabels()), strict=True)
    assert names == ("outside every range", "Al", "Cu") and side.figure.get_suptitle().startswith("a$b: 9,000 ions, ")
    (legend,) = side.figure.legends
    assert [text.get_text() for text in legend.get_texts()] == list(names)
    colors = [handle.get_facecolor() for handle in legend.legend_handles]
    np.testing.assert_array_equal(np.squeeze(colors), [bar.get_facecolor() for bar in bars.patches])
    # percent with as many digits as the error of the counts allows, on an axis without empty space
    al = np.mean(mass == 27)
    value, error = (float(part) for part in numbers[1].rstrip(" %").split(" ± "))
    assert value == pytest.approx(100 * al, abs=error / 10) and error == pytest.approx(0.50, abs=0.005)
    assert max(bar.get_width() for bar in bars.patches) < bars.get_xlim()[1] <= 1
    widths = [bar.get_width() for bar in bars.patches]
    assert widths == [np.mean(mass == each) for each in (90, 27, 63)]
    steps = fractions.lines[names.index("Al")].get_ydata()  # in the first third only
    assert steps[0] > 0.99 and steps[-1] < 0.01
    # every section has enough ions, also where the cap is curved: errors of counts of at least 49
    errors = [np.ptp(bar[:, 1]) / 2 for bars in fractions.collections for bar in bars.get_segments()]
    assert 0.004 < min(errors) and max(errors) < 0.5 / 7  # also of 0 and 100 %
    assert_nothing_cut_off(side.figure)


def test_a_long_reconstruction_lies_along_its_depth(rng):
    n = 40_000
    radius, azimuth = 20 * np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    ions = ae.Hits(x=radius * np.cos(azimuth), y=radius * np.sin(azimuth), mass_to_charge=np.full(n, 27.0))
    found = ae.reconstruct(ions, atomic_volume=0.011, distance=90.0, radius=15.0, efficiency=0.1, compression=2.0)
    assert np.ptp(found.positions[:, 2]) > 2 * np.ptp(found.positions[:, 0])
    side, *_ = plot.reconstruction(found, title="R5083.epos")
    assert (side.get_xlabel(), side.get_ylabel()) == ("depth z [nm]", "x [nm]") and not side.yaxis_inverted()
    assert_nothing_cut_off(side.figure)
    box = side.get_window_extent()
    assert box.width > 0.75 * side.figure.bbox.width and box.width > 2 * box.height
    ticks = [label.get_window_extent() for label in side.get_yticklabels() if label.get_text()]
    assert not any(a.overlaps(b) for number, a in enumerate(ticks) for b in ticks[:number])
    # the title has the density near the axis, as `checks` has it
    check = density_near_axis(found)
    name, density, *_ = side.figure.get_suptitle().split("\n")
    assert name.startswith("R5083.epos: 40,000 ions, ")
    assert density == (
        f"near the axis {check.found:.3g} ions per nm³, {check.found / check.expected:.2f} × efficiency / atomic volume"
    )
    assert side.figure.get_suptitle().count("\n") == 1 + (not check.good)


def test_places_along_the_axis_are_counted_in_blocks_as_at_once(monkeypatch):
    monkeypatch.setattr(ion_blocks, "ROWS", 700)
    random = np.random.default_rng(4)
    positions = random.uniform((-30, -20, 0), (30, 20, 50), (5000, 3))
    result = ae.reconstruct(
        ae.Hits(x=np.arange(5000.0), y=np.ones(5000)), radius=50.0, atomic_volume=0.01, distance=1e4
    )
    drawn = plot.reconstruction(replace(result, positions=positions))[1].images[0]
    expected = binned(ae.Hits(x=positions[:, 0], y=positions[:, 1]))
    np.testing.assert_array_equal(drawn.get_array().filled(np.nan), expected.density)
    assert drawn.get_extent() == list(expected.extent)
