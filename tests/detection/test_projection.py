import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apt_evap import Detector, Projection

PROJECTIONS = st.builds(
    Projection,
    scale=st.floats(5, 200),
    centre=st.tuples(st.floats(-30, 30), st.floats(-30, 30)),
    mirror=st.booleans(),
    compression=st.none() | st.floats(0.8, 2.0),
)


@given(PROJECTIONS, st.floats(0, 1.2), st.floats(-4, 4))
def test_there_and_back(projection, angle, azimuth):
    direction = np.array([[math.sin(angle) * math.cos(azimuth), math.sin(angle) * math.sin(azimuth), math.cos(angle)]])
    place = projection.places(3.7 * direction)
    np.testing.assert_allclose(projection.directions(place), direction, atol=1e-12)


def test_equidistant_means_equidistant():
    angles = np.radians([0.0, 10.0, 40.0, 80.0])
    directions = np.column_stack([np.zeros(4), np.sin(angles), np.cos(angles)])
    np.testing.assert_allclose(Projection(30.0, (1.0, 2.0)).places(directions), [[1, 2 + 30 * a] for a in angles])


def test_a_compression_of_1_is_a_straight_flight_from_the_apex():
    detector, curved = Detector(distance=90.0, width=300.0), Detector(90.0, 300.0, projection="equidistant")
    direction = np.array([[0.3, -0.4, 1.2]])
    flown = detector.directions(direction * 1e9, direction, 0.0)[0]  # no matter how far the field has reached
    x, y, *_ = detector.impacts(flown, np.zeros(1))
    np.testing.assert_allclose(Projection(90.0, compression=1.0).places(direction)[0], [x[0], y[0]], rtol=1e-12)
    x, y, *_ = curved.impacts(flown, np.zeros(1))
    np.testing.assert_allclose(Projection(90.0).places(direction)[0], [x[0], y[0]], rtol=1e-12)


def test_near_the_centre_all_compressions_have_the_same_scale():
    direction = [[1e-4, 0, 1]]
    places = [Projection(50.0, compression=compression).places(direction)[0, 0] for compression in (None, 1, 1.6)]
    np.testing.assert_allclose(places, 50e-4, rtol=1e-7)  # the next term is the square of the angle, 1e-8


def test_mirror_is_that_of_x():
    direction, centre = np.array([[0.3, 0.2, 0.9]]), (4.0, 5.0)
    x, y = Projection(40.0, centre).places(direction)[0]
    np.testing.assert_allclose(Projection(40.0, centre, mirror=True).places(direction)[0], [8.0 - x, y])


def test_what_points_away_has_no_place():
    places = Projection(40.0).places([[0, 0, -1], [1, 0, -0.01], [1, 0, 0.01]])
    assert np.isnan(places[:2]).all() and np.isfinite(places[2]).all()
    assert np.isnan(Projection(40.0, compression=0.9).places([[1, 0, 0.1]])).all()  # seen behind the plane


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"scale": 0}, r"scale must be a finite number \[mm/rad\] above 0, got 0"),
        ({"scale": 3, "centre": (1, 2, 3)}, r"centre must have shape \(2,\)"),
        ({"scale": 3, "compression": -1}, "compression must be a finite number above 0"),
        ({"scale": 3, "mirror": "x"}, "mirror must be True or False"),
    ],
)
def test_what_is_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        Projection(**settings)
