import numpy as np
import pytest

import apt_evap as ae
from apt_evap import plot
from apt_evap.plot._labels import legend_below
from apt_evap.plot.phase_outlines import phase_outlines
from apt_evap.simulation.config.map_panels import MapSettings, Panel
from apt_evap.workflows.maps_of_run import phase_maps, run_maps


@pytest.fixture
def maps(rng):
    """Ions of a field of view, of a spot in it with a dark middle, and of a phase all over it."""
    radius, azimuth = 20 * np.sqrt(rng.random(20_000)), 2 * np.pi * rng.random(20_000)
    whole = ae.Hits(x=radius * np.cos(azimuth), y=radius * np.sin(azimuth)).map(80, extent=(-25, 25, -25, 25))
    radius, azimuth = rng.uniform(2, 4, 600), 2 * np.pi * rng.random(600)
    x, y = 7 + radius * np.cos(azimuth), -5 + radius * np.sin(azimuth)
    spot = ae.Hits(x=x, y=y).map(like=whole, position_step=None).smoothed(1.0)
    return whole.smoothed(1.0), spot, np.column_stack([x, y])


def lines_of(ax):
    return [path for collection in ax.collections for path in collection.get_paths() if len(path.vertices)]


def test_an_outline_holds_nine_of_ten_ions_and_is_named(maps):
    whole, spot, places = maps
    axes = list(plot.detector_maps([whole, whole]))
    phase_outlines(axes, [whole, whole], [{"particle": spot, "matrix": whole}, {"particle": spot}])
    legend_below(axes)
    (legend,) = axes[0].figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["90% of the ions of the phase particle"]
    for ax in axes:
        (outline,) = lines_of(ax)  # around the dark middle, too, and none of the phase that is everywhere
        assert 0.85 < outline.contains_points(places).mean() <= 1
        assert outline.contains_point((7, -5))
        assert np.abs(outline.vertices - (7, -5)).max() < 7
    figure = axes[0].figure
    figure.draw_without_rendering()
    box = legend.get_window_extent()
    assert box.x0 >= 0 and box.x1 <= figure.bbox.width
    assert not any(box.overlaps(ax.get_tightbbox()) for ax in axes)


def test_without_phases_there_is_no_legend(maps):
    whole, _, _ = maps
    axes = list(plot.detector_maps([whole]))
    phase_outlines(axes, [whole], [{"matrix": whole}])
    legend_below(axes)
    assert not axes[0].figure.legends and not lines_of(axes[0])


def test_maps_of_the_phases_of_a_run(small_tip, made_once):
    sphere = ae.specimen.Sphere((0.4, 0.0, 1.4), 0.6)
    phases = [
        ae.specimen.Phase("matrix", "Ni"),
        ae.specimen.Phase("particle", "Ni", region=sphere, evaporation_field=30.0),
    ]
    tip = ae.Tip(phases=phases, apex_radius=2.0, axis=(0, 0, 1))
    run = ae.Simulation(tip, seed=1).run(300, [ae.Unperturbed()], responses=False, progress=False)
    settings = MapSettings((Panel(ae.Unperturbed()),), bins=24)
    maps, _ = run_maps(run, settings)
    (parts,) = phase_maps(run, maps, settings)
    number = np.count_nonzero(run.hits(ae.Unperturbed()).detected & (run.phase == 1))
    assert list(parts) == ["particle"] and parts["particle"].ions == number > 20
    assert parts["particle"].smoothing == maps[0].smoothing
    assert parts["particle"].values.sum() == pytest.approx(number, rel=0.05)
    chosen = phase_maps(run, maps, settings, lambda hits: hits[:10])
    assert chosen == [{}]  # too few
    pure = made_once(small_tip, 250, voltage=1000.0, seed=2)
    assert phase_maps(pure, run_maps(pure, settings)[0], settings) == []
