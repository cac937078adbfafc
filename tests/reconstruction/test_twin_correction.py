"""The correction by a twin: a known field of errors is found, a wrong twin is refused, and a simulated one helps."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from fluxes import even_flux

import apt_evap as ae
from apt_evap.reconstruction.twin_correction import NEIGHBOURS, TwinErrors

RIM = 0.54  # rad
SCATTER = (0.1, 0.03)  # nm, along the surface and across it


def error_field(directions):
    """A smooth field along the surface, 0.1 nm in the mean square of each direction in it."""
    along = np.cross(directions, [0.0, 0.0, 1.0]) + 0.3 * np.cross(directions, [1.0, 0.0, 0.0])
    return 0.1 * along / np.sqrt((along**2).sum(axis=1).mean() / 2)


def patterned(n, rng, turn=0.0):
    """Directions with a density of 1 + 0.4 cos(3 azimuth) at the rim."""
    flux = even_flux(4 * n, RIM)
    azimuth = np.arctan2(flux[:, 1], flux[:, 0]) - turn
    density = 1 + 0.4 * np.hypot(flux[:, 0], flux[:, 1]) / math.sin(RIM) * np.cos(3 * azimuth)
    return flux[rng.random(len(flux)) < density / 2]


def two_grains(rng):
    """Directions with this density, and with the opposite pattern in a sixth of the view."""
    right, other = patterned(5000, rng), patterned(5000, rng, math.pi / 3)
    across = 0.6 * math.sin(RIM)
    return rng.permutation(np.concatenate([right[right[:, 0] < across], other[other[:, 0] > across]]))


@pytest.fixture(scope="session")
def twin():
    rng = np.random.default_rng(5)
    directions = patterned(12_000, rng)
    noise = SCATTER[0] * rng.normal(size=directions.shape)
    noise += ((SCATTER[1] / SCATTER[0] - 1) * (noise * directions).sum(axis=1))[:, None] * directions
    return TwinErrors(directions, error_field(directions) + noise, 10.0, RIM)


def test_the_mean_error_of_a_place_is_found(twin):
    places = even_flux(500, 0.9 * RIM)
    found = twin.shifts_at(places, np.full(500, 10.0))
    # the error of a mean of 100; the field is a line within them
    noise = SCATTER[0] / math.sqrt(NEIGHBOURS)
    assert np.sqrt(((found - error_field(places)) ** 2).mean()) == pytest.approx(noise * math.sqrt(2.1 / 3), rel=0.15)
    # four times the radius: terraces twice as wide
    np.testing.assert_allclose(twin.shifts_at(places, np.full(500, 40.0)), 2 * found)


def test_what_is_left_is_the_scatter_and_half_of_the_mean(twin):
    along, across = twin.scatter(10.0)
    # the scatter of one ion, less that part of it which its own mean has, and half of 0.1 nm
    assert along == pytest.approx(math.hypot(SCATTER[0], 0.05), rel=0.02)
    assert across == pytest.approx(SCATTER[1], rel=0.03)
    assert twin.scatter(40.0) == pytest.approx((2 * along, 2 * across))


def test_the_gain_is_that_of_the_densities(twin):
    rng = np.random.default_rng(6)
    # half the variance of the density, 0.4^2 / 4, to first order; less what the Gaussian of 3 degrees takes
    whole, worst = twin.gains(patterned(5000, rng))
    assert whole == pytest.approx(0.4**2 / 8, abs=0.004) and 0 < worst < whole
    assert twin.gains(even_flux(5000, RIM))[0] == pytest.approx(-(0.4**2) / 8, abs=0.004)
    assert max(twin.gains(patterned(5000, rng, math.pi / 3))) < -0.04
    # the opposite pattern in a sixth of the view
    whole, worst = twin.gains(two_grains(rng))
    assert whole > 0.003 and worst < -0.005  # 0.001 to 0.008 and -0.017 to -0.009 along four directions


def test_positions_are_corrected_or_the_verdict_refuses(twin, monkeypatch):
    ways = []
    monkeypatch.setattr(TwinErrors, "of", lambda run, rim, way="ring": ways.append(way) or twin)
    run = object.__new__(ae.Run)
    known = {
        "atomic_volume": 0.0166, "efficiency": 0.5, "distance": 100.0, "radius": 40.0, "projection": "compressed",
        "compression": 1.0, "detector_radius": 100 * math.tan(RIM),
    }  # fmt: skip

    def evolving(directions, **more):
        elements = np.where(np.random.default_rng(3).random(len(directions)) < 0.05, "Mg", "Al")
        x, y = (100 * directions[:, side] / directions[:, 2] for side in (0, 1))
        return ae.reconstruct(ae.Hits(x=x, y=y, extra={"element": elements}), shape="evolving", **known, **more)

    directions = patterned(5000, np.random.default_rng(6))
    plain, found = evolving(directions), evolving(directions, twin=run)
    assert ways == [found.followed_by] == ["volume"]
    # of a solute without a contrast this is not known before
    assert "no solute has a contrast" in evolving(directions, twin=run, solutes=("Mg",)).verdict
    assert ways[1:] == ["ring", "volume"]
    # exp(0.019): the gain of the test above
    assert found.verdict == plain.verdict + (
        "; the twin is used: by its density the ions are 1.019 times as likely as by an even one, 1.015 times in the "
        "worst half of the view"
    )
    shifts = twin.shifts_at(directions, np.full(len(directions), 40.0))
    np.testing.assert_allclose(found.specimen_positions - plain.specimen_positions, shifts, atol=1e-12)
    exact = dict.fromkeys(("compression", "radius", "efficiency"), 0.0)
    covariances, parts = (
        ae.reconstruction.position_covariances(found, exact, local) for local in (None, twin.scatter(40.0))
    )
    np.testing.assert_array_equal(covariances, parts)
    np.testing.assert_array_equal(
        ae.reconstruction.position_covariances(plain, exact),
        ae.reconstruction.position_covariances(found, exact, (0.174, 0.057)),
    )
    flat = even_flux(5000, RIM)
    plain, refused = evolving(flat), evolving(flat, twin=run)
    assert "; the twin is not used: by its density the ions are 0.9" in refused.verdict
    assert refused.twin_errors is None
    np.testing.assert_array_equal(refused.positions, plain.positions)
    assert "; the twin is not used" in evolving(two_grains(np.random.default_rng(6)), twin=run).verdict
    # the cap in place of the surface: nothing to correct
    few = evolving(flat[:50], twin=run)
    assert few.verdict == "cap: 50 ions, fewer than 2,000"

    def refuse(run, rim, way):
        raise ValueError("twin must be another one")

    # before the passes, which take seconds
    monkeypatch.setattr(TwinErrors, "of", refuse)
    monkeypatch.setattr("apt_evap.reconstruction.evolving._fixed_point", None)
    with pytest.raises(ValueError, match="twin must be another one"):
        evolving(flat, twin=run)
    with pytest.raises(ValueError, match='twin is for shape="evolving"'):
        ae.reconstruct(few.hits, twin=run, **known)
    with pytest.raises(ValueError, match="twin must be a Run"):
        ae.reconstruct(few.hits, shape="evolving", twin="pure.h5", **known)


def simulated(n=10_000, widest=0.6, radius=6.0, twist=0.1, **settings):
    """What `TwinErrors.of` reads of a run: a sphere that recedes, seen with a compression of 1.05 and a twist."""
    directions = even_flux(n, widest)
    volume = ae.material("Al").a ** 3 / 4
    depths = np.arange(n) * volume / (math.pi * radius**2 * math.sin(widest) ** 2)
    sites = radius * directions - depths[:, None] * [0.0, 0.0, 1.0]
    polar = np.arccos(directions[:, 2])
    azimuth = np.arctan2(directions[:, 1], directions[:, 0]) + twist * np.cos(6 * polar)  # without divergence
    across = 100.0 * np.tan(polar / 1.05)
    hits = ae.Hits(x=across * np.cos(azimuth), y=across * np.sin(azimuth))
    material = {"structure": "fcc", "a": ae.material("Al").a, "c": None}
    return SimpleNamespace(
        hits=lambda perturbation: hits, first_perturbation=None, detector=SimpleNamespace(distance=100.0),
        settings={"tip": {"apex_radius": 1.1 * radius, "material": material} | settings},
        emissions=SimpleNamespace(positions=sites),
    )  # fmt: skip


def test_constants_and_errors_of_a_twin_are_those_put_in():
    found = TwinErrors.of(simulated(), RIM)
    assert found.radius == pytest.approx(6.0, rel=0.01)
    polar = np.arccos(found.directions[:, 2])
    # the twist moves ions along the circle, and leaves the density and the shape as they are
    around = np.cross([0.0, 0.0, 1.0], found.directions)
    expected = -6.0 * 0.1 * np.cos(6 * polar)[:, None] * around
    left = found.errors - expected
    assert np.sqrt((expected**2).sum(axis=1).mean()) > 0.1
    assert np.sqrt((left**2).sum(axis=1).mean()) < 0.3 * np.sqrt((expected**2).sum(axis=1).mean())
    # nothing of the first fifth of the radius, of 4.6 nm
    assert len(found.errors) == pytest.approx(10_000 * (math.sin(RIM) / math.sin(0.6)) ** 2 * (1 - 1.2 / 4.6), rel=0.02)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"n": 2200}, "twin must have at least 2,000 ions in the field of view, got 1"),
        ({"widest": 0.45}, "twin must cover the field of view of 31 degrees on the cap, got ions to 2"),
        ({"radius": 20.0}, "twin must be deeper than 0.2 of its radius, got 0.0"),
        ({"phases": [{}, {}]}, "twin must be a run of a pure crystal, got 2 phases"),
    ],
)
def test_a_twin_that_does_not_do_is_one_sentence(changes, sentence):
    with pytest.raises(ValueError, match=sentence):
        TwinErrors.of(simulated(**changes), RIM)


def test_a_twin_whose_ions_scatter_as_far_as_its_radius_is_refused(monkeypatch):
    monkeypatch.setattr(TwinErrors, "scatter", lambda self, radius: (0.3 * radius, 0.0))
    with pytest.raises(ValueError, match="twin must be larger or its field of view narrower"):
        TwinErrors.of(simulated(), RIM)
