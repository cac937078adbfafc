"""Kernels of the steps of a bundle against plain NumPy, with numbers of flights that do not fill vector lanes."""

import numpy as np
import pytest

from apt_evap._core.flights import ball_of_flights, lengths_in_steps, places_of_stage, sum_of_rows
from apt_evap._core.sources import parted

SIZES = (1, 3, 7, 8, 9, 31, 33, 67, 143)
EPSILON = np.finfo(float).eps


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize("n_rows", [1, 2, 9, 72])
def test_weighted_sum_of_rows(rng, n, n_rows):
    weights, rows = rng.normal(size=n_rows), rng.normal(size=(n_rows, n))
    bound = n_rows * EPSILON * (np.abs(weights) @ np.abs(rows))  # a rounding of each product and of each sum
    assert (np.abs(sum_of_rows(weights, rows) - weights @ rows) <= bound).all()
    integers = np.arange(n_rows * n).reshape(n_rows, n) % 1000  # exact
    assert np.array_equal(sum_of_rows(np.arange(n_rows) - 4.0, integers * 1.0), (np.arange(n_rows) - 4) @ integers)


@pytest.mark.parametrize("n", SIZES)
def test_places_of_a_stage(rng, n):
    x, v, sums = rng.normal(size=(3, n))
    dt, node = 0.37, 0.7
    # the same operations in the same order
    assert np.array_equal(places_of_stage(dt, node, x, v, sums), x + dt * (node * v + dt * sums))
    # a parabola: with half the acceleration and node 1, the place after the time dt
    assert places_of_stage(2.0, 1.0, x, v, np.full(n, -9.5)) == pytest.approx(x + 2 * v - 19 * 2.0**2 / 2, abs=1e-14)


@pytest.mark.parametrize("n", SIZES)
@pytest.mark.parametrize(("begin", "end"), [(0.0, 0.8), (0.3, 0.5), (0.0, 0.0)])
def test_ball_around_flights(rng, n, begin, end):
    x, v, a = rng.normal(size=(3, 3, n)) + np.array([5.0, -3.0, 40.0])[:, None]
    ball = ball_of_flights(x, v, a, begin, end)
    places = np.array([x + time * v + time**2 / 2 * a for time in (begin, end)])
    centre = places.mean(axis=(0, 2))
    assert ball[:3] == pytest.approx(centre, rel=1e-14)
    assert ball[3] == pytest.approx(np.linalg.norm(places - centre[:, None], axis=1).max(), rel=1e-12, abs=1e-13)


@pytest.mark.parametrize("place", range(11))
def test_the_farthest_flight_determines_the_ball(place):
    x, v, nothing = np.zeros((3, 3, 11))
    x[2, place] = 11.0  # at rest
    assert ball_of_flights(x, nothing, nothing, 0.0, 7.0) == pytest.approx([0, 0, 1, 10], rel=1e-15)
    v[1, place] = -22.0  # from the origin
    assert ball_of_flights(nothing, v, nothing, 0.0, 1.0) == pytest.approx([0, -1, 0, 21], rel=1e-15)
    assert ball_of_flights(nothing, v, nothing, 1.0, 0.0) == pytest.approx([0, -1, 0, 21], rel=1e-15)


@pytest.mark.parametrize("n", SIZES)
def test_lengths_relative_to_those_of_steps(rng, n):
    sums, p, q = rng.normal(size=(3, 3, n))
    expected = 0.3 * np.linalg.norm(sums, axis=0) / (np.linalg.norm(p - q, axis=0) + 0.02)
    assert lengths_in_steps(0.3, 0.02, sums, p, q) == pytest.approx(expected, rel=1e-14)
    sums[:] = np.array([2.0, -3.0, 6.0])[:, None]
    found = lengths_in_steps(4.0, 5.0, sums, p, p + np.array([4.0, 4.0, -7.0])[:, None])
    assert found == pytest.approx(np.full(n, 4 * 7 / (9 + 5.0)), rel=1e-14)


@pytest.mark.parametrize(("n_atoms", "n_cells"), [(0, 5), (1, 0), (17, 33), (250, 131)])
def test_sources_in_a_ball_and_the_others(rng, n_atoms, n_cells):
    columns = [rng.uniform(-1, 1, (rows, n)).astype(np.float32) for rows, n in ((4, n_atoms), (10, n_cells))]
    ball, origin = np.array([0.2, -0.1, 0.3, 0.8]), np.array([7.0, 8.0, 9.0])
    parts = parted(*columns, ball, origin)
    for kind, sources in enumerate(columns):
        distances = np.linalg.norm(sources[:3].astype(float) - ball[:3, None], axis=0)
        assert (np.abs(distances - 0.8) > 1e-6).all()  # none so close to the surface that rounding decides
        for part, chosen in zip(parts, (distances < 0.8, distances > 0.8), strict=True):
            assert np.array_equal(part[kind], sources[:, chosen])  # in their order
            assert part[2] == origin.tolist()
    if n_atoms > 100:
        assert min(part[kind].shape[1] for part in parts for kind in (0, 1)) > 20
