"""Shape, overlap and composition of a precipitate, for a compression that is known in closed form."""

import math
from dataclasses import replace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.reconstruction.cap_geometry import CapGeometry
from apt_evap.reconstruction.reconstructed import Reconstruction
from apt_evap.reconstruction.reconstruction_settings import ReconstructionSettings

RADIUS, DENSITY = 3.0, 60.0  # nm, ions / nm^3
HALF = 8.0  # nm: the matrix is a cube of this half width


def reconstruction_of(positions):
    """Reconstructed ions at given positions, with z as the depth."""
    hits = ae.Hits(x=np.zeros(len(positions)), y=np.zeros(len(positions)))
    settings = ReconstructionSettings(distance=90.0, atomic_volume=0.01, radius=100.0).resolved()
    geometry = CapGeometry.of(settings, field_of_view=38.0)
    return Reconstruction(positions, hits, np.full(len(positions), 100.0), settings, geometry)


@pytest.fixture(scope="session")
def alloy():
    """Sites of a sphere at the origin in a matrix, z out of the specimen; whether each is in the sphere; species."""
    rng = np.random.default_rng(5)
    sites = (2 * rng.random((int(DENSITY * (2 * HALF) ** 3), 3)) - 1) * HALF
    inside = (sites**2).sum(axis=1) <= RADIUS**2
    species = np.where(inside, rng.random(len(sites)) < 0.8, rng.random(len(sites)) < 0.05).astype(np.int64)
    return sites, inside, species


def test_a_perfect_reconstruction(alloy):
    sites, inside, species = alloy
    found = ae.reconstruction.precipitate_errors(reconstruction_of(sites * [1, 1, -1]), inside, sites, species)
    n = np.count_nonzero(inside)
    # moments of n uniform deviates: the standard deviation of a semi-axis is 0.33 / sqrt(n), times four
    assert found.true.lateral == pytest.approx(RADIUS, rel=1.3 / math.sqrt(n))
    assert (found.magnification, found.depth_magnification) == pytest.approx((1, 1), abs=1e-12)
    assert found.density_ratio == pytest.approx(1.0) and found.apparent.ratio == found.true.ratio
    # ions between the sphere and its ellipsoid: 3 times the relative error of a semi-axis
    assert max(found.overlap, found.lost) < 4 / math.sqrt(n)
    assert found.overlap == found.true_overlap and found.lost == found.true_lost
    assert found.true_composition == pytest.approx([np.mean(species[inside] == kind) for kind in (0, 1)])
    assert found.apparent_composition == pytest.approx(found.true_composition, abs=4 * found.composition_errors.max())


@pytest.mark.parametrize("squeeze", [0.6, 0.8, 1.25])
def test_a_compressed_precipitate(alloy, squeeze):
    """The lateral positions of the sphere alone are multiplied, as by a local magnification."""
    sites, inside, species = alloy
    moved = np.where(inside[:, None], sites * [squeeze, squeeze, 1], sites)
    found = ae.reconstruction.precipitate_errors(reconstruction_of(moved * [1, 1, -1]), inside, sites, species)
    assert found.magnification == pytest.approx(squeeze, rel=1e-12)
    assert found.depth_magnification == pytest.approx(1, rel=1e-12)
    assert found.apparent.ratio == pytest.approx(squeeze, rel=0.02)
    # where the ellipsoid is outside the sphere it holds the ions of the matrix, at their own density
    wide = 4 / 3 * math.pi * squeeze**2 * RADIUS**3 * DENSITY
    outside = wide * (1 - _common_part(squeeze))
    n = np.count_nonzero(inside)
    assert found.overlap == pytest.approx(outside / (outside + n), abs=4 / math.sqrt(n))
    # all ions of the sphere and those of the matrix, in the smaller or larger volume
    assert found.density_ratio == pytest.approx((n + outside) / n / squeeze**2, rel=4 / math.sqrt(n))


def _common_part(squeeze, steps=20_001):
    """Volume of the ellipsoid (squeeze, squeeze, 1) inside the unit sphere, over that of the ellipsoid."""
    z = np.linspace(-1, 1, steps)
    areas = min(squeeze, 1.0) ** 2 * (1 - z * z)
    return float(areas.mean() * 2 / (4 / 3 * squeeze**2))


def test_an_overlap_with_the_matrix(alloy):
    """Ions of the matrix above and below the sphere are focused into it: the overlap is their share of the volume."""
    sites, inside, species = alloy
    rng = np.random.default_rng(6)
    n = np.count_nonzero(inside)
    strangers = rng.choice(np.flatnonzero(~inside & (np.abs(sites).max(axis=1) > 4)), n // 3, replace=False)
    moved = sites.copy()
    places = rng.normal(size=(len(strangers), 3))
    places *= (RADIUS * rng.random(len(strangers)) ** (1 / 3) / np.linalg.norm(places, axis=1))[:, None]
    moved[strangers] = places
    found = ae.reconstruction.precipitate_errors(reconstruction_of(moved * [1, 1, -1]), inside, sites, species)
    share = len(strangers) / (len(strangers) + n)
    assert found.overlap == pytest.approx(share, abs=4 / math.sqrt(n))
    # 80 % in the sphere, 5 % in the matrix: the composition is that of the mixture
    expected = 0.8 * (1 - share) + 0.05 * share
    assert found.apparent_composition[1] == pytest.approx(expected, abs=5 * found.composition_errors[1])
    assert found.true_composition[1] == pytest.approx(0.8, abs=4 * math.sqrt(0.16 / n))
    assert found.density_ratio == pytest.approx(1 + len(strangers) / n, rel=0.03)
    told = found.to_dict()
    assert told["ions"] == n and told["apparent"]["ratio"] == found.apparent.ratio
    assert told["apparent_composition"] == found.apparent_composition.tolist()


def test_without_species_the_matrix_is_the_second(alloy):
    sites, inside, _ = alloy
    found = ae.reconstruction.precipitate_errors(reconstruction_of(sites * [1, 1, -1]), inside, sites)
    assert found.species.tolist() == [0, 1] and found.true_composition.tolist() == [0.0, 1.0]
    assert found.apparent_composition[0] == pytest.approx(found.overlap)


def test_what_is_no_precipitate(alloy):
    sites, inside, _ = alloy
    few = np.zeros(len(sites), bool)
    few[:9] = True
    with pytest.raises(ValueError, match="inside"):
        ae.reconstruction.precipitate_errors(reconstruction_of(sites), few, sites)
    with pytest.raises(ValueError, match="inside"):
        ae.reconstruction.precipitate_errors(reconstruction_of(sites), inside[:-1], sites)
    with pytest.raises(ValueError, match="must have an extent in all directions"):
        ae.reconstruction.precipitate_errors(reconstruction_of(sites * [1, 1, 0]), inside, sites)


@pytest.mark.slow
def test_constants_are_fitted_before(alloy):
    """A reconstruction with a wrong scale of the depth is right after the fit of this scale."""
    sites, inside, species = alloy
    wrong = replace(reconstruction_of((sites + 1) * [1, 1, -1.3]), settings={"compression": 1.0})
    as_it_is = ae.reconstruction.precipitate_errors(wrong, inside, sites, species)
    assert as_it_is.depth_magnification == pytest.approx(1.3)
    other = ae.reconstruction.precipitate_errors(wrong, inside, sites, species, fit=("shift", "lateral_scale"))
    assert other.depth_magnification == pytest.approx(1.3)
    # the cap with R = 100 nm is nearly a plane: the fit leaves the depth below its apex, up to r^2 / 2R = 0.7 nm
    fitted = ae.reconstruction.precipitate_errors(wrong, inside, sites, species, fit=("shift", "depth_scale"))
    assert fitted.depth_magnification == pytest.approx(1, rel=0.02)
