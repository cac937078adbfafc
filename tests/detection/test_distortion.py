"""Calibration grids: a known distortion is removed, exactly where it is affine, and bad grids are refused."""

import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import apt_evap as ae
from apt_evap.detection.distortion import DistortionGrid

SIDE = 0.28  # of the squares of the grid [mm]
MAGNIFICATION = 11.0


def crossings(n=15):
    """Crossings of a square grid within a circle, shape (n, 2) [mm]."""
    u = (np.arange(n) - n // 2) * SIDE
    places = np.stack(np.meshgrid(u, u), axis=-1).reshape(-1, 2)
    return places[np.hypot(*places.T) <= u[-1] * 1.01]


def distorted(grid, strength=0.004):
    """Places on the detector: rotated, magnified, moved, and with terms of second order."""
    w = MAGNIFICATION * np.exp(0.3j) * (grid @ [1, 1j])
    z = w + strength * (w**2 + 0.5 * np.abs(w) ** 2 - 0.7 * w.conj() ** 2) + (1.5 - 0.8j)
    return np.column_stack([z.real, z.imag])


def similar(grid):
    """The same without distortion."""
    return distorted(grid, 0.0)


def similarity(first, second):
    """Registration without polynomial terms, which the distortion calls for."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ae.warnings.RegistrationWarning)
        return ae.maps.register_points(first, second, mirror=False)


def test_a_distortion_is_removed(rng):
    """Places between the crossings: within what a piecewise affine map leaves, an eighth of h^2 f'' (0.03 mm)."""
    grid = crossings()
    distortion = DistortionGrid(distorted(grid), grid)
    inside = rng.uniform(-1.2, 1.2, (2000, 2))
    x, y = distortion.undistorted(*distorted(inside).T)
    # up to the similarity transform that fits the crossings best
    fit = similarity(similar(inside), np.column_stack([x, y]))
    assert fit.residual < 0.04 and abs(fit.scale - 1) < 0.02 and abs(fit.rotation) < 1
    before = similarity(similar(inside), distorted(inside))
    assert before.residual > 0.2
    assert distortion.residual == pytest.approx(similarity(grid, distorted(grid)).residual, rel=1e-9)


@given(st.integers(0, 100), st.booleans())
def test_crossings_stay_crossings(seed, mirror):
    """Exact at the corners of the triangles, for either handedness, and the identity without distortion."""
    grid = crossings(7)
    flipped = grid * [1, -1 if mirror else 1]
    places = distorted(grid, 0.002)
    distortion = DistortionGrid(places, flipped)
    rng = np.random.default_rng(seed)
    middle = places[np.hypot(*grid.T) < 0.6]
    x, y = distortion.undistorted(*middle.T)
    assert ae.maps.register_points(grid[np.hypot(*grid.T) < 0.6], np.column_stack([x, y])).residual < 1e-12
    straight = DistortionGrid(similar(grid), flipped)
    some = similar(rng.uniform(-0.5, 0.5, (20, 2)))
    assert np.column_stack(straight.undistorted(*some.T)) == pytest.approx(some, abs=1e-12)
    assert straight.residual < 1e-12


def test_ions_outside_are_counted(rng):
    grid = crossings()
    distortion = DistortionGrid(distorted(grid), grid)
    places = distorted(rng.uniform(-1.9, 1.9, (1000, 2)))
    far = np.hypot(*(places - [1.5, -0.8]).T) > 24
    hits = ae.Hits(x=places[:, 0], y=places[:, 1], voltage=np.arange(1000.0))
    with pytest.warns(ae.warnings.DataWarning, match=r"(\d+) of 1,000 ions are outside the calibration grid") as caught:
        corrected = hits.undistorted(distortion)
    number = int(str(caught[0].message).split()[0])
    assert number == 1000 - np.count_nonzero(corrected.detected) >= np.count_nonzero(far) > 50
    assert not corrected.detected[far].any()
    assert np.array_equal(corrected.voltage, hits.voltage)
    with pytest.raises(ValueError, match="grid"):
        ae.Hits(x=[90.0, 100.0], y=[90.0, 0.0]).undistorted(distortion)
    with pytest.raises(ValueError, match="grid"):
        hits.undistorted("grid.csv")
    with pytest.raises(ValueError, match="has no column 'x'"):
        ae.Hits(voltage=[1.0]).undistorted(distortion)


def test_quantised_coordinates_become_continuous(rng):
    """With steps of 0.1 mm: no steps and no empty bins afterwards, the same for the same seed."""
    grid = crossings()
    distortion = DistortionGrid(distorted(grid), grid)
    x, y = (np.round(rng.uniform(-8, 8, 100_000) / 0.1) * 0.1 for _ in "xy")
    hits = ae.Hits(x=x, y=y)
    assert hits.map(64).position_step == pytest.approx((0.1, 0.1))
    one, two, other = (hits.undistorted(distortion, dither_seed=seed) for seed in (0, 0, 1))
    assert one.map(64).position_step is None
    assert np.array_equal(one.x, two.x) and not np.array_equal(one.x, other.x)
    assert np.hypot(one.x - other.x, one.y - other.y).max() < 0.2


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda d, g: (d[:5], g[:5]), "at least 6 crossings, got 5"),
        (lambda d, g: (np.vstack([d, d[:1]]), np.vstack([g, g[:1] + 1])), "different crossings on the detector, got"),
        (lambda d, g: (np.vstack([d, d[:1] + 1]), np.vstack([g, g[:1]])), "different crossings in the plane"),
        (lambda d, g: (d * [1, 0], g), "must not have all crossings on one line on the detector"),
        (lambda d, g: (d, np.where(np.arange(len(g))[:, None] == 80, g - 3.3 * SIDE, g)), "must not be folded"),
        (lambda d, g: (d, g[:-1]), r"grid must have shape \(149, 2\), got \(148, 2\)"),
        (lambda d, g: (np.where(d == d[0], np.nan, d), g), "detector must be finite"),
    ],
)
def test_bad_grids_are_refused(change, words):
    with pytest.raises(ValueError, match=words):
        DistortionGrid(*change(distorted(crossings()), crossings()))
