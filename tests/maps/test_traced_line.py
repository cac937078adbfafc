"""Direction and place of a line: of known lines, with errors that are those of repeated measurements."""

import numpy as np
import pytest

import apt_evap as ae

EDGES = np.linspace(-40, 40, 161)


def density(direction, distance, height=0.8, width=1.5, slope=0.01):
    """A line at a distance to the left of the origin, on a gradient."""
    x, y = np.meshgrid((EDGES[1:] + EDGES[:-1]) / 2, (EDGES[1:] + EDGES[:-1]) / 2)
    away = y * np.cos(np.radians(direction)) - x * np.sin(np.radians(direction)) - distance
    return (1 + slope * x) * (1 + height * np.exp(-((away / width) ** 2)))


def map_of(values, **options):
    return ae.DetectorMap.from_array(values, EDGES, EDGES, **options)


@pytest.mark.parametrize("height", [0.8, -0.6])
@pytest.mark.parametrize(("direction", "distance"), [(3.0, 1.0), (-6.0, 9.5), (5.0, -12.2)])
def test_a_line_that_misses_the_centre_is_found(direction, distance, height):
    near = (5.0, distance, 35.0, distance)  # an arm, in a wrong direction
    line = ae.maps.trace_line(map_of(density(direction, distance, height)), near, width=14.0)
    # as far as the gradient is not that of the model
    assert line.direction == pytest.approx(direction, abs=0.02)
    assert line.distance((0.0, 0.0))[0] == pytest.approx(distance, abs=0.02)
    assert line.width == pytest.approx(2 * np.sqrt(np.log(2)) * 1.5, rel=0.02) and line.height * height > 0
    x0, y0, x1, y1 = line.ends
    assert np.degrees(np.arctan2(y1 - y0, x1 - x0)) == pytest.approx(line.direction)
    assert np.hypot(x1 - x0, y1 - y0) == pytest.approx(30.0)


@pytest.mark.slow
def test_the_errors_are_those_of_repeated_measurements(rng):
    expected = 8.0 * density(4.0, 3.0)
    found, errors = [], []
    for _ in range(40):
        line = ae.maps.trace_line(map_of(rng.poisson(expected), is_counts=True), (5, 3, 35, 5), width=14.0)
        distance, error = line.distance((0.0, 0.0))
        found.append((line.direction, distance))
        errors.append((line.direction_error, error))
    found, errors = np.array(found), np.array(errors)
    # 40 measurements give a standard deviation to 11 %
    assert np.abs(found.mean(axis=0) - (4.0, 3.0)) == pytest.approx(0, abs=4 * np.max(found.std(axis=0)) / np.sqrt(40))
    assert errors.mean(axis=0) == pytest.approx(found.std(axis=0), rel=0.4)


def test_the_errors_do_not_depend_on_the_direction_of_the_ends():
    counts = map_of(np.round(20 * density(0.0, 0.0, slope=0.0)), is_counts=True)

    def traced(turn):
        """With ends whose rectangle contains 36 mm of the line, as does that along the line."""
        cosine, sine = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        x, y = 18 * cosine * cosine, 18 * cosine * sine
        return ae.maps.trace_line(counts, (-x, -y, x, y), width=24.0)

    along, turned = traced(0.0), traced(25.0)
    assert turned.direction == pytest.approx(along.direction, abs=0.01)
    # corners of the rectangles differ; with another power of the cosine of 25 degrees they are 9 % apart
    assert turned.direction_error == pytest.approx(along.direction_error, rel=0.01)
    assert turned.place_error == pytest.approx(along.place_error, rel=0.01)
    assert turned.width == pytest.approx(along.width, rel=0.01)


def test_bad_input_gets_a_sentence():
    map = map_of(density(0.0, 0.0))
    with pytest.raises(ValueError, match="ends must be two different points"):
        ae.maps.trace_line(map, (1, 2, 1, 2), width=10.0)
    with pytest.raises(ValueError, match="no line of at most the width 10 mm near the ends"):
        ae.maps.trace_line(
            map_of(np.random.default_rng(0).poisson(9.0, (160, 160)), is_counts=True), (-30, 10, 30, 10), width=10.0
        )
    with pytest.raises(ValueError, match="ends and width must enclose 50 bins with hits"):
        ae.maps.trace_line(map, (100, 0, 120, 0), width=10.0)
