"""Figures for papers: their width, letters, scale bar and no titles."""

import numpy as np
import pytest
from matplotlib.image import imread

import apt_evap as ae
from apt_evap.plot.paper_figures import FONT, add_scale_bar
from apt_evap.workflows.written_pictures import DPI, save_picture

EDGES = np.linspace(-35, 35, 65)


@pytest.fixture
def maps():
    rng = np.random.default_rng(1)
    return [ae.DetectorMap.from_array(rng.poisson(9, (64, 64)), EDGES, EDGES, is_counts=True) for _ in range(3)]


@pytest.mark.slow
@pytest.mark.parametrize("number, width", [(1, 85.0), (2, 85.0), (3, 85.0), (3, 170.0)])
def test_a_figure_has_its_width_and_no_titles(maps, number, width, tmp_path):
    axes = ae.plot.paper_maps(maps[:number], width)
    figure = axes[0].figure
    save_picture(tmp_path / "f.png", maps[:number], ["a title"] * number, "another", width=width)
    height, across = imread(tmp_path / "f.png").shape[:2]
    assert across == pytest.approx(width / 25.4 * DPI, abs=1)
    assert height < 1.6 * across
    for letter, ax in zip("abc", axes, strict=False):
        assert ax.get_title() == ax.get_xlabel() == "" and not ax.child_axes
        texts = [text.get_text() for text in ax.texts]
        assert ([letter] if number > 1 else []) + ["20 mm"] == texts
        assert {text.get_fontsize() for text in ax.texts} == {FONT}
    figure.draw_without_rendering()
    boxes = [ax.get_window_extent() for ax in axes]
    assert all(box.x0 >= 0 and box.x1 <= figure.bbox.x1 and box.y0 >= 0 for box in boxes)
    assert sum(box.width for box in boxes[: 2 if width == 85.0 else 3]) > 0.7 * figure.bbox.width * min(number, 2) / 2


def test_more_maps_than_letters(maps):
    axes = ae.plot.paper_maps(maps * 10, 170.0)
    assert len(axes) == 30 and all([text.get_text() for text in ax.texts] == ["20 mm"] for ax in axes)


@pytest.mark.parametrize("extent, length", [(70.0, 20.0), (4.0, 1.0), (300.0, 50.0), (0.9, 0.2)])
def test_a_scale_bar_is_a_round_number(extent, length):
    edges = np.linspace(0, extent, 33)
    ax = ae.plot.detector_map(ae.DetectorMap.from_array(np.ones((32, 32)), edges, edges))
    assert add_scale_bar(ax) == pytest.approx(length)
    (line,) = ax.lines
    assert np.ptp(line.get_xdata()) == pytest.approx(length) and np.ptp(line.get_ydata()) == 0


@pytest.mark.parametrize("width", [0.0, 1.0, 1e6, float("nan")])
def test_a_width_that_is_none(maps, width):
    with pytest.raises(ValueError, match="width must be"):
        ae.plot.paper_maps(maps, width)
    with pytest.raises(ValueError, match="maps must contain"):
        ae.plot.paper_maps([], 85.0)
