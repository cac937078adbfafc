"""Image compression from poles, and the spacing of lattice planes in reconstructed crystals."""

import math

import numpy as np
import pytest

import apt_evap as ae

A = 0.405  # nm, of aluminium
RADIUS, DISTANCE, XI, RIM = 30.0, 90.0, 1.5, 15.0  # nm, mm, -, mm
ETA = 0.6


@pytest.fixture(scope="session")
def aluminium():
    """Al along [002], evaporated layer by layer by a cap of 30 nm: true sites with z outwards, and hits."""
    rim = math.atan(RIM / DISTANCE) + math.asin((XI - 1) * math.sin(math.atan(RIM / DISTANCE)))
    width = RADIUS * math.sin(rim)
    cells = np.stack(np.meshgrid(*[np.arange(-25, 26)] * 2, np.arange(-24, 1), indexing="ij"), -1).reshape(-1, 1, 3)
    basis = np.array([[0, 0, 0], [0, 0.5, 0.5], [0.5, 0, 0.5], [0.5, 0.5, 0]])
    sites = (A * (cells + basis)).reshape(-1, 3)
    lateral = np.hypot(sites[:, 0], sites[:, 1])
    # the cap reaches a site when its apex is at this depth
    depth = -sites[:, 2] - RADIUS + np.sqrt(RADIUS**2 - np.minimum(lateral, RADIUS) ** 2)
    leaves = (lateral < width) & (depth > 0) & (depth < 4.0)
    order = np.flatnonzero(leaves)[np.argsort(depth[leaves], kind="stable")]
    sites, theta = sites[order], np.arcsin(lateral[order] / RADIUS)
    rho = DISTANCE * np.sin(theta) / (XI - 1 + np.cos(theta))
    stretch = rho / np.maximum(lateral[order], 1e-12)
    detected = np.random.default_rng(3).random(len(order)) < ETA
    hits = ae.Hits(x=sites[:, 0] * stretch, y=sites[:, 1] * stretch)
    return sites[detected], hits[detected]


@pytest.mark.slow
def test_the_spacing_of_planes(aluminium):
    sites, hits = aluminium
    known = {"atomic_volume": A**3 / 4, "distance": DISTANCE, "compression": XI, "detector_radius": RIM}
    result = ae.reconstruct(hits, **known, radius=RADIUS, efficiency=ETA)
    found = ae.reconstruction.distribution_map(result.positions)
    # Hits are exact; the depth is that of n ions where n (1 - eta) / eta was drawn: 0.3 % of 40,000 ions, three times.
    assert found.spacing == pytest.approx(A / 2, rel=0.01)
    assert found.depth_resolution < 0.03  # terraces leave at once here: the planes are sharp
    assert result.errors(sites).order_correlation > 0.99
    # a wrong efficiency is found by the planes
    wrong = ae.reconstruct(hits, **known, radius=RADIUS, efficiency=0.8 * ETA)
    observed = ae.reconstruction.distribution_map(wrong.positions).spacing
    assert 0.8 * ETA * observed / (A / 2) == pytest.approx(ETA, rel=0.01)
    # and so is a wrong field factor: d is proportional to the square of 1 / R, with the projection
    wide = ae.reconstruct(hits, **known, radius=1.1 * RADIUS, efficiency=ETA)
    assert ae.reconstruction.distribution_map(wide.positions, radius=2.0).spacing * 1.21 == pytest.approx(
        A / 2, rel=0.02
    )


def test_the_spacing_of_a_perfect_crystal(aluminium):
    sites, _ = aluminium
    found = ae.reconstruction.distribution_map(sites, bins=500)
    assert found.spacing == pytest.approx(A / 2, rel=2e-3)  # a bin is 4e-3 nm, the map 2 nm
    assert found.amplitude > 0.97 and found.depth_resolution < 0.006  # of a bin
    assert found.counts.sum() >= 1e6
    fullest = found.centres[np.argmax(found.counts)]
    assert fullest == pytest.approx(round(fullest * 2 / A) * A / 2, abs=4e-3)


@pytest.mark.parametrize(("axis", "planes"), [((1, 1, 1), A / math.sqrt(3)), ((0, 2, 2), A / math.sqrt(8)), (0, A / 2)])
def test_planes_along_a_direction(aluminium, axis, planes):
    sites, _ = aluminium
    found = ae.reconstruction.distribution_map(sites, axis, max_pairs=300_000)
    assert found.spacing == pytest.approx(planes, rel=5e-3)
    assert found.references < len(sites) and found.counts.sum() >= 300_000


@pytest.mark.slow
def test_the_depth_resolution(aluminium, rng):
    sites, _ = aluminium
    for deviation in (0.02, 0.05):
        blurred = sites + rng.normal(size=sites.shape) * [0.2, 0.2, deviation]
        found = ae.reconstruction.distribution_map(blurred)
        assert found.depth_resolution == pytest.approx(deviation, rel=0.05)  # amplitude to 2 %: pairs at the edges
        assert found.spacing == pytest.approx(A / 2, rel=5e-3)


def test_ions_without_planes(rng):
    points = rng.random((20_000, 3)) * [10, 10, 4]
    assert ae.reconstruction.distribution_map(points).amplitude < 0.1
    with pytest.raises(ValueError, match=r"no two ions are within 0\.001 nm across"):
        ae.reconstruction.distribution_map(points[:50], lateral=1e-3)


def test_a_map_counts_the_pairs_of_a_cylinder(rng):
    points = rng.random((300, 3)) * [4, 4, 3]
    inside = points[np.hypot(points[:, 0] - 1, points[:, 1] - 2) <= 1.5]
    difference = inside[:, None] - inside[None]
    close = (np.hypot(difference[..., 0], difference[..., 1]) <= 0.4) & ~np.eye(len(inside), dtype=bool)
    expected = np.histogram(difference[..., 2][close], 20, (-0.9, 0.9))[0]
    found = ae.reconstruction.distribution_map(points, lateral=0.4, reach=0.9, bins=20, centre=(1, 2, 0), radius=1.5)
    assert np.array_equal(found.counts, expected)


def test_the_compression_from_poles():
    assert ae.reconstruction.compression_from_poles([54.74, 35.26], [36.0, 22.0]) == pytest.approx(
        (54.74 / 36 + 35.26 / 22) / 2
    )
    with pytest.raises(ValueError, match="observed_angles"):
        ae.reconstruction.compression_from_poles([54.74], [0.0])


def test_planes_are_found_where_there_are_some_and_not_by_chance():
    rng = np.random.default_rng(4)
    ions = rng.random((600, 3)) * (2, 2, 6)
    chance = [ae.reconstruction.find_planes(rng.random((300, 3)) * (2, 2, 6), widest=0).found for _ in range(4)]
    assert sum(chance) <= 1  # 1 of 20; 6 of 150 and 3 of 60 were counted
    layers = ions.copy()
    layers[:, 2] = 0.2 * rng.integers(0, 30, 600) + 0.05 * rng.standard_normal(600)
    planes = ae.reconstruction.find_planes(layers, widest=0)
    assert planes.found
    # the expected amplitude of a pair is exp(-4 pi² sigma²/d²)
    assert planes.amplitude == pytest.approx(np.exp(-((2 * np.pi * 0.05 / 0.2) ** 2)), abs=0.03)
    assert abs(planes.spacing - 0.2) < 4 * planes.spacing_error < 0.01
