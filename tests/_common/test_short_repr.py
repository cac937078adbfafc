import numpy as np
import pytest

import apt_evap as ae
from apt_evap.emission.emissions import TangentialLaunches
from apt_evap.explore.specimen_surface import SurfaceAtoms
from apt_evap.fit.structure import StructureScores
from apt_evap.maps.crystallography.directions import Poles, Zones, poles
from apt_evap.maps.crystallography.orientation import FittedOrientation
from apt_evap.maps.profiles import Profile, ProfileComparison
from apt_evap.reconstruction.errors import ErrorBins, GroupErrors
from apt_evap.simulation.apex import FittedCap, ImageCompression
from apt_evap.simulation.history import CapHistory, History
from apt_evap.simulation.response_tracks import Tracks
from apt_evap.simulation.voltage_history import SmoothedHistory

WITH_ARRAYS = (
    FittedCap, ImageCompression, Profile, ProfileComparison, Tracks, SmoothedHistory, FittedOrientation, Poles, Zones,
    TangentialLaunches, StructureScores, SurfaceAtoms, ErrorBins, GroupErrors, CapHistory, History,
)  # fmt: skip


def is_short(text):
    return text.count("\n") < 5 and len(text) < 1000


@pytest.mark.parametrize("kind", WITH_ARRAYS)
def test_results_with_large_arrays_print_at_most_five_lines(kind):
    names = getattr(kind, "_fields", None) or tuple(kind.__dataclass_fields__)
    result = kind(*[np.linspace(-1, 1, 3000).reshape(1000, 3)] * len(names))
    assert is_short(repr(result)) and is_short(str(result))
    assert all(f"{name}=" in repr(result) for name in names)


def test_a_short_repr_shows_shape_and_range_and_few_numbers_completely(nickel):
    text = repr(poles(nickel, 2))
    assert "(14, 3)" in text and "0.176 to 0.2032" in text  # planes; spacings of 002 and 111 [nm]
    few = History(*[np.array([0.25, np.nan])] * 7)
    assert "0.25, " in repr(few) and "nan" in repr(few)
    assert "(20,)" in repr(History(*[np.full(20, np.nan)] * 7))


def test_the_repr_of_a_fitted_orientation_is_short(nickel):
    crystal = poles(nickel, 8)
    tilt = ae.Orientation(nickel, (2, 3, 7))
    near = tilt.directions(crystal.normals)[:, 2] > 0.7
    places = np.column_stack(tilt.directions(crystal.normals[near]).T[:2])
    fit = ae.maps.fit_orientation(nickel, crystal.planes[near], places)
    assert is_short(repr(fit)) and "rms=" in repr(fit)
