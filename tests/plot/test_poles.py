import numpy as np
import pytest

import apt_evap as ae
from apt_evap.maps.crystallography.directions import ZONES, poles, zones
from apt_evap.plot._labels import legend_below


@pytest.fixture
def drawn():
    rng = np.random.default_rng(3)
    map = ae.DetectorMap.from_array(1 + rng.random((40, 50)), np.linspace(-20, 20, 51), np.linspace(-16, 16, 41))
    return map, ae.plot.detector_map(map)


def places(ax):
    return np.asarray(ax.collections[0].get_offsets())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "axis"), [("Ni", (1, 1, 1)), ("W", (0, 1, 1)), ("Si", (0, 0, 1)), ("Ti", (0, 0, 0, 1))]
)
def test_the_pole_of_the_axis_is_at_the_centre_and_zone_lines_go_through_it(drawn, name, axis):
    _, ax = drawn
    limits = ax.axis()
    projection = ae.detection.Projection(30.0, (3.0, -2.0))
    assert ae.plot.poles(ax, ae.Orientation(name, axis), projection, families=5) is ax
    assert ax.axis() == limits
    assert np.linalg.norm(places(ax) - projection.centre, axis=1).min() < 1e-9
    found = zones(ae.material(name))
    assert len(ax.lines) == len(found.axes) and found.families[-1] == len(ZONES[ae.material(name).structure]) - 1
    near = [np.nanmin(np.hypot(*(line.get_xydata() - projection.centre).T), initial=9) for line in ax.lines]
    # the lines are drawn every half degree: 0.26 mm
    assert np.count_nonzero(np.array(near) < 0.14) == np.count_nonzero(
        np.abs(ae.Orientation(name, axis).directions(found.directions)[:, 2]) < 1e-9
    )
    ax.figure.canvas.draw()  # the labels are such as matplotlib can write


def test_only_what_is_inside_the_detector_is_drawn(drawn):
    map, ax = drawn
    x, y = np.meshgrid(*map.centres)
    round_map = ae.DetectorMap.from_array(map.values, map.x_edges, map.y_edges, mask=np.hypot(x, y) < 12)
    ae.plot.poles(ax, ae.Orientation("Ni", (1, 1, 1)), ae.detection.Projection(20.0), families=8, region=round_map)
    radii = np.linalg.norm(places(ax), axis=1)
    assert len(radii) == 10 and radii.max() < 12.6  # half a diagonal of the bins more
    for line in ax.lines:
        assert not (np.hypot(*line.get_xydata().T) > 12.6).any()


@pytest.mark.slow
def test_parts_can_be_left_out_and_names_do_not_overlap(drawn):
    _, ax = drawn
    orientation, projection = ae.Orientation("Ni", (1, 1, 1)), ae.detection.Projection(12.0)
    ae.plot.poles(ax, orientation, projection, families=0, zone_families=[(1, 1, 0)], labels=False)
    assert len(ax.lines) == 6 and not ax.collections
    before = len(ax.texts)
    ae.plot.poles(ax, orientation, projection, families=12, zone_families=())
    names = ax.texts[before:]
    assert len(ax.lines) == 6 and len(names) == len(places(ax))
    ax.figure.draw_without_rendering()
    boxes = [text.get_window_extent() for text in names if text.get_visible()]
    assert len(boxes) > 5
    overlapping = [a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i]]
    assert not any(overlapping)


def test_one_legend_names_the_zone_lines_that_are_seen(drawn):
    map, ax = drawn
    other = ae.plot.detector_map(map, ax.figure.add_subplot())
    for each, families in ((ax, [(1, 1, 0)]), (other, [(1, 1, 0), (1, 0, 0)])):
        ae.plot.poles(each, ae.Orientation("Ni", (1, 1, 1)), ae.detection.Projection(12.0), zone_families=families)
    legend_below([ax, other])
    (legend,) = ax.figure.legends
    names = [text.get_text() for text in legend.get_texts()]
    assert sorted(names) == ["poles", "zone lines of ⟨$100$⟩", "zone lines of ⟨$110$⟩"]
    colors = {handle.get_label(): handle.get_color() for handle in legend.get_lines()}
    assert colors["zone lines of ⟨$110$⟩"] == ax.lines[0].get_color() != colors["zone lines of ⟨$100$⟩"]


def test_a_fit_and_a_run_know_their_orientation_and_projection(drawn, nickel):
    _, ax = drawn
    crystal, orientation = poles(nickel, 6), ae.Orientation(nickel, (2, 3, 7))
    near = orientation.directions(crystal.normals)[:, 2] > 0.75
    projection = ae.detection.Projection(25.0)
    fit = ae.maps.fit_orientation(
        nickel, crystal.planes[near], projection.places(orientation.directions(crystal.normals[near]))
    )
    ae.plot.poles(ax, fit, families=3)
    other = ae.plot.detector_map(drawn[0])
    ae.plot.poles(other, fit.orientation, fit.projection, families=3)
    assert len(places(ax)) > 2 and np.array_equal(places(ax), places(other))
    for wrong in ((fit, fit), (ax, "Ni"), (ax, fit.orientation)):
        with pytest.raises(ValueError, match=r"ax|orientation|projection"):
            ae.plot.poles(*wrong)


@pytest.mark.slow
def test_the_poles_of_a_run(drawn, nickel):
    tip = ae.Tip(nickel, apex_radius=3.5, axis=(1, 1, 1), shank_length=3.5, depth=1.2)
    run = ae.Simulation(tip, seed=1).run(800, [ae.Unperturbed()], responses=False, progress=False)
    ax, other = (ae.plot.detector_map(run.hits(ae.Unperturbed())) for _ in range(2))
    ae.plot.poles(ax, run)
    ae.plot.poles(other, ae.Orientation(nickel, (1, 1, 1)), ae.simulation.image_compression(run).projection)
    assert len(places(ax)) > 3 and np.array_equal(places(ax), places(other))
