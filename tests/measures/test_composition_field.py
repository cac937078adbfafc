"""Voxels against a plain loop, their errors against repeated draws, and isosurfaces."""

import numpy as np
import pytest

import apt_evap as ae

Field = ae.measures.CompositionField


def ball(seed, ions=60_000, size=4.0, radius=2.0):
    positions = 2 * size * np.random.default_rng(seed).random((ions, 3)) - size
    return positions, np.linalg.norm(positions, axis=1) < radius


def test_a_voxel_is_the_mean_over_a_gaussian():
    rng = np.random.default_rng(1)
    positions, solute = 3 * rng.random((50, 3)), rng.random(50) < 0.4
    result = Field.of(positions, solute, voxel=0.5, delocalisation=0.4)
    assert (result.fraction[np.isfinite(result.fraction)] <= 1 + 1e-12).all()
    places = np.rint(np.floor(positions / 0.5) + 0.5 - result.origin / 0.5).astype(int)  # voxel of each ion
    for voxel in ((2, 3, 4), (4, 4, 1), (1, 1, 1)):
        steps = places - voxel
        weights = np.exp(-0.5 * ((0.5 * steps / 0.4) ** 2).sum(axis=1)) * (np.abs(steps).max(axis=1) <= 4)
        assert result.fraction[voxel] == pytest.approx(weights @ solute / weights.sum(), rel=1e-9)
        assert result.effective_ions[voxel] == pytest.approx(weights.sum() ** 2 / (weights**2).sum(), rel=1e-9)


def test_without_delocalisation_ions_are_counted():
    positions = np.array([[0.1, 0.1, 0.1], [0.2, 0.3, 0.4], [0.9, 0.1, 0.1]])
    result = Field.of(positions, [True, False, False], voxel=0.5, delocalisation=0.0)
    assert result.fraction[1, 1, 1] == 0.5 and result.effective_ions[1, 1, 1] == 2
    assert result.fraction[2, 1, 1] == 0.0 and np.isnan(result.fraction[0, 0, 0])
    assert np.isnan(result.errors[0, 0, 0]) and result.errors[1, 1, 1] == pytest.approx(np.sqrt(1 / 8))


def test_the_error_is_the_scatter_of_repeated_draws():
    values, errors = [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        positions = np.concatenate([[[0.0] * 3, [4.0] * 3], 4 * rng.random((3000, 3))])
        result = Field.of(positions, rng.random(3002) < 0.2, voxel=0.5, delocalisation=0.4)
        values.append(result.fraction[5, 5, 5])
        errors.append(result.errors[5, 5, 5])
    assert np.std(values) == pytest.approx(np.mean(errors), rel=0.16)  # three errors of a scatter of 200 draws
    assert np.mean(values) == pytest.approx(0.2, abs=3 * np.mean(errors) / np.sqrt(200))


def test_molecules_count_with_their_atoms():
    positions = np.full((3, 3), 0.1)
    result = Field.of(positions, [2, 0, 0], 0.5, 0.0, weights=[3, 1, 1])
    assert result.fraction[1, 1, 1] == pytest.approx(2 / 5)
    assert result.effective_ions[1, 1, 1] == pytest.approx(25 / 11)


def test_the_isosurface_of_a_ball():
    positions, inside = ball(1)
    surface = Field.of(positions, inside, voxel=0.25, delocalisation=0.25).isosurface(0.5)
    assert surface.is_closed
    # the Gaussian moves it inward by sigma^2 / R = 0.03 nm; 20 ions in the Gaussian scatter it by sigma / 4 at most
    radius = (3 * surface.volume / (4 * np.pi)) ** (1 / 3)
    assert radius == pytest.approx(2.0 - 0.25**2 / 2, abs=0.03)
    assert np.linalg.norm(surface.vertices, axis=1).std() < 0.07
    assert surface.distance(np.zeros((1, 3)))[0] < 0  # the larger fraction is inside


def test_a_surface_stays_open_where_the_ions_end():
    positions, _ = ball(2)
    surface = Field.of(positions, positions[:, 2] > 0).isosurface(0.5)
    assert not surface.is_closed
    assert np.abs(surface.vertices[:, 2]).max() < 0.15
    inside = surface.within(ae.specimen.Box((-4, -4, -4), (4, 4, 4)))
    # the cross section is 64 nm^2; the noise of the counts, 0.05 nm over 0.5 nm, makes a rough surface of more
    assert inside.area == pytest.approx(64.0, rel=0.04)
    assert surface.nearest(np.array([[0.0, 0.0, 1.0]]))[0][0] < 0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p, s: Field.of(p, s & False), "solute must mark at least one ion, got none of 60,000"),
        (lambda p, s: Field.of(p, s).isosurface(1.5), "isovalue must be a finite number >= 0 and <= 1, got 1.5"),
        (lambda p, s: Field.of(p, p[:, 2] > 3.9).isosurface(0.95), "isovalue must be within the fractions of voxels"),
        (lambda p, s: Field.of(p[:2], [True, False]).isosurface(0.5), "in no voxel, got 0.5"),
        (lambda p, s: Field.of(p, s, voxel=0.001), "voxel must be larger"),
        (lambda p, s: Field.of(p, s, voxel=0), "voxel must be a finite number"),
    ],
)
def test_wrong_arguments_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call(*ball(1))
