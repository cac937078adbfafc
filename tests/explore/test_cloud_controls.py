"""Region and isosurface that are chosen in the explorer, of ions whose ball is known."""

from types import SimpleNamespace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.explore.cloud_controls import CloudControls, words
from apt_evap.explore.reconstruction_panel import _SURFACE_COLOR, ReconstructionPanel
from apt_evap.explore.specimen_view import SpecimenView, pixel_color


def test_the_isosurface_of_a_ball_and_its_region():
    rng = np.random.default_rng(1)
    places = 6 * rng.random((40_000, 3))
    inside = np.linalg.norm(places - (2.0, 3.0, 4.0), axis=1) < 1.5
    cloud = ae.measures.PointCloud(places, inside.astype(int), ["Al", "Cu"])
    changes = []
    controls = CloudControls(lambda: changes.append(1))
    controls.offer(cloud)
    assert controls.row.visible and controls.centre.value == "3.0, 3.0, 3.0" and controls.region() is None
    assert len(controls.surface(cloud)) == 0 and not controls.used
    controls.element.value, controls.fraction.value = "Cu", 50.0
    away = np.linalg.norm(controls.surface(cloud) - (2.0, 3.0, 4.0), axis=1)
    assert controls.used and len(away) > 200
    # a Gaussian of 0.5 nm moves it inwards by 0.25 / 1.5 nm
    assert away.mean() == pytest.approx(1.5 - 0.17, abs=0.06) and np.ptp(away) < 0.4
    controls.centre.value, controls.kind.value, controls.size.value = "2, 3, 4", "sphere", 1.4
    assert words(cloud.select(controls.region())).endswith("ions, Al 0.0 ± 0.0 %, Cu 100.0 ± 0.0 %")
    controls.kind.value = "cylinder"
    assert np.all(np.hypot(*(cloud.select(controls.region()).positions[:, :2] - (2, 3)).T) <= 1.4)
    assert controls.size.title == "radius [nm]" and controls.centre.visible
    controls.kind.value = "layer"
    assert np.all(np.abs(cloud.select(controls.region()).positions[:, 2] - 4) <= 0.7)
    assert controls.size.title == "thickness [nm]" and len(changes) >= 6
    view = SpecimenView()
    panel = SimpleNamespace(controls=controls, species=SimpleNamespace(active=[1]), _order=[0, 1])
    told = ReconstructionPanel._put_cloud(panel, view, cloud)
    part, dots = cloud.select(controls.region()), view.points.data["color"] == pixel_color(_SURFACE_COLOR)
    assert told == words(part) and np.count_nonzero(~dots) == part.mark("Cu").sum()
    assert 20 < np.count_nonzero(dots) < len(away) / 2  # of the isosurface, in the layer only
    heights = view.points.data["z"][dots] + view.centre[2]
    assert np.abs(heights - 4).max() <= 0.7 and np.ptp(heights) > 1.2
    assert view.points.data["radius"][dots].max() < view.points.data["radius"][~dots].min()
    controls.offer(cloud)
    assert controls.centre.value == "2, 3, 4" and controls.element.value == "Cu"  # what was typed stays
    controls.size.value = None
    with pytest.raises(ValueError, match=r"thickness \[nm\] must be"):
        controls.region()
    controls.fraction.value = 100.0
    with pytest.raises(ValueError, match="isovalue"):
        controls.surface(cloud.select(np.flatnonzero(inside)[:5]))
    assert words(cloud.select(slice(0))) == "no ions"
