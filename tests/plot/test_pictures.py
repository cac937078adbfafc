"""What pictures show is what they were given, with its unit; how they look is looked at."""

import os
import subprocess
import sys
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.colors import to_rgba

import apt_evap as ae
from apt_evap import plot
from apt_evap.analysis.profiles import Profile
from apt_evap.analysis.voltage_history import course, evaporation_voltages


@pytest.fixture(scope="module")
def emitter(small_tip):
    return ae.Emitter(small_tip)


@pytest.fixture(scope="module")
def run(small_tip):
    """250 ions with responses."""
    return ae.Simulation(small_tip, voltage=1000.0, seed=2).run(250, progress=False)


def label_of_bar(ax):
    """Label of the colour bar of a picture, the last axes of its figure."""
    return ax.figure.axes[-1].get_ylabel()


def discs_of(ax):
    """The coloured discs of a picture of a specimen."""
    (discs,) = [c for c in ax.collections if isinstance(c, EllipseCollection) and c.get_array() is not None]
    return discs


# ---- maps ----------------------------------------------------------------------------------------------------------


TITLES = (None, "0.75 roll-up + 0.25 lateral velocity, 0.155 ± 0.155 eV")
PICTURES = list(product((100, 150, 1500), TITLES, (0.6, 1.0, 1.1)))


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
        figure.draw_without_rendering()
        boxes = [each.get_tightbbox().transformed(figure.transFigure.inverted()) for each in figure.axes]
        assert min(box.min.min() for box in boxes) > 0 and max(box.max.max() for box in boxes) < 1
    assert len(axes) == 1


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
    flat = ae.Emitter(tip)
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
    with pytest.raises(ValueError, match=r"elevation must be a finite number \[degrees\]"):
        plot.specimen(emitter, elevation=100)


def test_marks_are_around_the_atoms(emitter):
    ax = plot.specimen(emitter, elevation=30, azimuth=-60)
    atoms = np.argsort(-emitter.normals[:, 2], kind="stable")[[0, 7]]  # they face upwards, so are drawn
    plot.mark_atoms(emitter.positions[atoms], ax, colors=["red", "blue"], elevation=30, azimuth=-60)
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
    np.testing.assert_array_equal(lower.lines[0].get_ydata(), course(evaporation_voltages(run), 10).median)


def test_history_of_a_measurement():
    voltage = np.linspace(3000, 4000, 1000)
    (ax,) = plot.history(ae.Hits(voltage=voltage), points=20)
    assert ax.get_ylabel() == "voltage [V]" and ax.get_xlabel() == "ions"
    np.testing.assert_allclose(ax.lines[0].get_ydata(), np.median(voltage.reshape(20, 50), axis=1))
    with pytest.raises(ValueError, match="no column 'voltage'"):
        plot.history(ae.Hits(x=[0.0], y=[0.0]))
    with pytest.raises(ValueError, match="axes must be 1 for"):
        plot.history(ae.Hits(voltage=voltage), [ax, ax])


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
    tracks = ae.lateral_tracks(run, ions, [1.0], np.arange(0, 360, 2))
    farthest = cloud.get_offsets()[cloud.get_array() == 1]
    np.testing.assert_allclose(farthest[:, 0], tracks.x.ravel(), atol=1e-9)
    np.testing.assert_array_equal(dots.get_facecolors(), [to_rgba(color) for color in plot.ion_colors(3)])
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
    tracks = ae.rollup_tracks(run, ions, energies)
    for line, x, y in zip(lines, tracks.x, tracks.y, strict=True):
        segments = np.array([path.vertices for path in line.get_paths()])
        np.testing.assert_allclose(segments[:, 0], np.column_stack([x, y])[:-1])
        np.testing.assert_allclose(segments[:, 1], np.column_stack([x, y])[1:])
        np.testing.assert_allclose(line.get_array(), energies[:-1] + 0.1)
    with pytest.raises(ValueError, match="mechanism must be one of lateral velocity, roll-up, got 'rollup'"):
        plot.response(run, ions, "rollup")
    with pytest.raises(ValueError, match="zoom must be an index from 0 to 1, got 2"):
        plot.response(run, ions, zoom=2)


# ---- profiles ------------------------------------------------------------------------------------------------------


@pytest.fixture
def two_profiles():
    position = np.linspace(-9.5, 9.5, 20)
    random = np.random.default_rng(4)
    counts = random.poisson(200 * (1 + 2 * np.exp(-0.5 * (position / 2) ** 2)), (2, 20))
    return [Profile(position, n / n.mean(), np.sqrt(n) / n.mean()) for n in counts]


def test_profiles_with_their_lines(two_profiles, tmp_path):
    lines = [ae.fit_zone_line(profile) for profile in two_profiles]
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
    compared = ae.compare_profiles(*two_profiles)
    heights = [bar.get_height() for bar in lower.containers[0]]
    np.testing.assert_array_equal(heights, compared.difference)
    assert f"= {compared.chi_square:.0f} for 19" in lower.texts[0].get_text()
    assert lower.get_ylim()[1] > np.abs(compared.difference).max()


def test_rectangles_on_a_map():
    random = np.random.default_rng(1)
    ax = plot.detector_map(ae.Hits(x=random.uniform(-9, 9, 4000), y=random.uniform(-9, 9, 4000)).map(bins=20))
    chosen = ae.Rectangle((1, 2), 30, 6, 4)
    plot.rectangles([chosen, chosen.turned(120)], ax, labels=["a", "b"])
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
