import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apt_evap import Detector
from apt_evap._core.elementary import arctangent
from apt_evap.detection import Projection
from apt_evap.detection.projection import along_axis, polar_angles, stereographic, stereographic_stretch

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


@pytest.mark.parametrize("compression", [None, 0.8, 1.0, 1.6])
def test_angles_of_places(compression):
    projection = Projection(40.0, (3.0, -2.0), compression=compression)
    angles = np.radians([0.0, 5.0, 30.0, 65.0])
    directions = np.column_stack([np.zeros(4), np.sin(angles), np.cos(angles)])
    np.testing.assert_allclose(projection.angles(projection.places(directions)), angles, atol=1e-15)
    assert np.isnan(projection.angles([[np.nan, 0.0]]))


@pytest.mark.parametrize("compression", [None, 0.8, 1.0, 1.6])
def test_stereographic_directions_appear_where_the_others_do(compression):
    directions = np.random.default_rng(1).normal(size=(500, 3)) * (1, 1, 3)
    last = math.pi / 2 if compression is None else min(1.0, compression) * math.pi / 2
    directions = directions[polar_angles(directions) < last - 0.01]
    flat = stereographic(directions)
    angle = polar_angles(directions)
    s2 = (flat**2).sum(axis=1)
    np.testing.assert_allclose(np.sqrt(s2), np.tan(angle / 2), rtol=1e-12)
    places = 40.0 * flat * stereographic_stretch(s2, compression)[:, None]
    np.testing.assert_allclose(places, Projection(40.0, compression=compression).places(directions), rtol=1e-11)
    np.testing.assert_allclose(along_axis(np.full(len(s2), 3.0), s2), 3.0 * np.cos(angle), rtol=1e-12, atol=1e-15)
    with np.errstate(invalid="ignore"):
        assert stereographic_stretch(np.zeros(1), compression) == 2.0


def test_the_rim():
    for compression in (None, 1.2, 1.6):
        projection = Projection(40.0, compression=compression)
        edge = math.pi / 2 - 1e-9
        (place,) = projection.places([[math.sin(edge), 0.0, math.cos(edge)]])
        assert place[0] == pytest.approx(projection.rim, rel=1e-7)
    assert Projection(40.0, compression=1.0).rim == Projection(40.0, compression=0.7).rim == math.inf


@pytest.mark.parametrize(("name", "own"), [("plane", 1.0), ("equidistant", None)])
def test_a_detector_sees_a_compressed_specimen(name, own):
    """Where the specimen has the polar angle 1.4 theta, the detector sees the ion at theta."""
    seen = Detector(90.0, 300.0, name).seen_from_apex
    assert seen == Projection(90.0, compression=own)
    angles = np.radians([3.0, 20.0, 40.0])
    on_detector = np.column_stack([np.sin(angles), np.zeros(3), np.cos(angles)])
    on_specimen = np.column_stack([np.sin(1.4 * angles), np.zeros(3), np.cos(1.4 * angles)])
    np.testing.assert_allclose(seen.compressed(1.4).places(on_specimen), seen.places(on_detector), rtol=1e-12)


def test_bits_of_impacts_are_those_of_their_formulae():
    """Runs depend on the last bits of places and times, so on the order of the operations."""
    random = np.random.default_rng(3)
    s = np.concatenate([random.normal(size=(5000, 2)) * 0.6, [[0, 0], [1, 0], [np.nan, 0], [0.6, 0.8]]])
    times = random.random(len(s)) * 1e3
    s2 = np.einsum("ij,ij->i", s, s)
    ahead = s2 < 1
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.sqrt(s2)
        plane, curved = 2.0 / (1.0 - s2), np.where(root > 0, 2.0 * arctangent(root) / root, 2.0)
        shorter = np.where(ahead, times * (1.0 - s2) / (1.0 + s2), times)
        for name, stretch, expected in (("plane", plane, times), ("equidistant", curved, shorter)):
            scale = np.where(ahead, 97.3 * stretch, np.nan)
            x, y, flown, _ = Detector(97.3, 250.0, name).impacts(s, times)
            assert x.tobytes() == (s[:, 0] * scale).tobytes() and y.tobytes() == (s[:, 1] * scale).tobytes()
            assert flown.tobytes() == expected.tobytes()


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
        ({"scale": 0}, r"scale must be a finite number \[mm/rad\] > 0, got 0"),
        ({"scale": 3, "centre": (1, 2, 3)}, r"centre must have shape \(2,\)"),
        ({"scale": 3, "compression": -1}, "compression must be a finite number > 0"),
        ({"scale": 3, "mirror": "x"}, "mirror must be True or False"),
    ],
)
def test_what_is_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        Projection(**settings)


@pytest.mark.parametrize("barrel", [0.3, -0.4])
def test_a_barrel_term_is_its_polynomial_and_back(barrel):
    lens = Projection(50.0, (1.0, -2.0), barrel=barrel)
    angle = np.array([0.0, 0.1, 0.4, 0.8])
    directions = np.column_stack([np.sin(angle), np.zeros(4), np.cos(angle)])
    places = lens.places(directions)
    assert places[:, 0] - 1.0 == pytest.approx(50 * angle * (1 - barrel * angle**2), abs=1e-12)
    assert lens.directions(places) == pytest.approx(directions, abs=1e-12)
    assert lens.angles(places) == pytest.approx(angle, abs=1e-12)
    # angles in the specimen twice as large are at the same places
    assert lens.compressed(2.0).angles(places) == pytest.approx(2 * angle)


def test_a_barrel_ends_where_it_folds_the_image():
    lens = Projection(50.0, barrel=0.3)
    last = 1 / np.sqrt(0.9)  # where the derivative 1 - 3 b t^2 is 0
    assert lens.last_angle == pytest.approx(last) and lens.rim == pytest.approx(50 * last * (1 - 0.3 * last**2))
    beyond = lens.places([[np.sin(last + 0.1), 0.0, np.cos(last + 0.1)]])
    assert np.isnan(beyond).all()
    with pytest.raises(ValueError, match="not both"):
        Projection(50.0, compression=1.5, barrel=0.1)
