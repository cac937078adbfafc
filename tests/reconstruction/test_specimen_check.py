"""The specimen that a reconstruction has found, and the comparison of its simulation with the measurement."""

from types import SimpleNamespace

import numpy as np
import pytest
from fluxes import even_flux

import apt_evap as ae
from apt_evap.reconstruction.beyond_view import Feature
from apt_evap.reconstruction.found_region import FoundRegion
from apt_evap.reconstruction.specimen_check import _compared, _densities, _simulated
from apt_evap.specimen.regions import contains

KNOWN = {"element": "Al", "efficiency": 0.5, "distance": 100.0, "projection": "compressed", "compression": 1.0}


def test_a_ball_is_found_where_it_was_and_a_layer_goes_on_beyond_the_view():
    rng = np.random.default_rng(1)
    ions = rng.uniform((-5, -5, 3), (5, 5, 13), (30_000, 3))
    volume = 1000 / 30_000
    in_ring = np.hypot(ions[:, 0], ions[:, 1]) > 4.5
    points = rng.uniform((-4, -4, 4), (4, 4, 12), (5000, 3))
    distance = np.linalg.norm(points - (1, 0, 8), axis=1) - 2.0
    ball = np.linalg.norm(ions - (1, 0, 8), axis=1) < 2.0
    region = FoundRegion(ions, Feature(ball.astype(float), ball, 0.0, 1.0, 0.8), in_ring, volume)
    assert np.mean(contains(region, points) == (distance < 0)) > 0.98
    clear = np.abs(distance) > 0.4
    assert (contains(region, points[clear]) == (distance[clear] < 0)).all()
    half = FoundRegion(ions, Feature(ball.astype(float), ball, 0.0, 1.0, 0.8), in_ring, volume, factor=0.5)
    np.testing.assert_array_equal(half(points / 2), region(points))
    assert not region(np.array([[9.0, 0.0, 8.0]])).any()
    layer = np.abs(ions[:, 2] - 8) < 1
    region = FoundRegion(ions, Feature(layer.astype(float), layer, 0.0, 1.0, 1.1), in_ring, volume)
    np.testing.assert_array_equal(region(np.array([[9.0, 0.0, 8.0], [9.0, 0.0, 10.0]])), [True, False])


def maps_of(strength, seed, ions=20_000):
    """Densities of places with a static pattern, and a spot whose strength is that of a phase."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-0.5, 0.5, (4 * ions, 2))
    spot = np.exp(-((places - (0.1, 0.05)) ** 2).sum(axis=1) / 0.05)
    rate = 1 + 0.2 * np.cos(15 * places[:, 0]) + strength * spot
    kept = (np.hypot(*places.T) < 0.5) & (2 * rng.random(len(places)) < rate)
    return _densities(places[kept], 0.5, 4)


def test_the_right_specimen_explains_all_and_a_wrong_one_nothing():
    pure, found, reversed_ = maps_of(0.0, 2, 5000), maps_of(0.6, 3, 5000), maps_of(-0.6, 4, 5000)
    right = _compared(maps_of(0.6, 1), found, pure, 5000)
    assert right.explained == pytest.approx(0.85, abs=0.25) and right.error < 0.2
    assert right.is_confirmed and "confirms its phases" in str(right)
    nothing = _compared(maps_of(0.0, 5), found, pure, 5000)
    assert nothing.explained == pytest.approx(0.0, abs=0.15)
    opposite = _compared(maps_of(0.6, 1), reversed_, pure, 5000)
    assert opposite.explained < -0.2 and not opposite.is_confirmed and "does not confirm" in str(opposite)


def test_the_specimen_has_the_phases_and_fields_that_were_found():
    n = 4000
    directions = even_flux(n, 0.54)
    voltage = 3000.0 + 10 * np.sin(np.arange(n) / 300)
    hits = ae.Hits(
        x=100 * directions[:, 0] / directions[:, 2], y=100 * directions[:, 1] / directions[:, 2], voltage=voltage
    )
    share = np.arange(n) / n
    labels = ((share > 0.3) & (share < 0.75)).astype(int)
    found = ae.reconstruct(hits, shape="evolving", radius=13.0, labels=labels, **KNOWN)
    tip = found.specimen(radius=3.0)
    assert [phase.name for phase in tip.phases] == ["matrix", "label 1"]
    field = tip.phases[1].evaporation_field / ae.material("Al").evaporation_field
    assert field == pytest.approx(found.phases[0].ratio)
    # in the scale of the specimen, its ions are inside but for those at its blurred interfaces
    places = (found.specimen_positions + np.array([0.0, 0.0, 13.0])) * 3 / 13
    assert np.mean(contains(tip.phases[1].region, places) == labels) > 0.85
    assert len(found.specimen(radius=3.0, phases=False).phases) == 1
    plain = ae.reconstruct(hits, shape="evolving", radius=13.0, **KNOWN)
    with pytest.raises(ValueError, match="must have found evaporation fields by voltage and phases, got 'followed"):
        plain.specimen()


@pytest.mark.slow
def test_as_many_simulated_ions_as_the_measured_part_has_atoms():
    matrix = ae.specimen.Phase("matrix", "Ni")
    tip = ae.Tip(phases=[matrix], apex_radius=2.5, axis=(1, 1, 1), seed=1)
    # 400 ions of the measurement, each the volume of an atom of nickel, at the scale of the simulation
    sequence = SimpleNamespace(directions=np.zeros((400, 3)), volume=0.352**3 / 4, radius=2.5, rim=0.6)
    places, again = _simulated([tip, tip], sequence)
    assert len(places) in (399, 400) and np.hypot(*places.T).max() < np.sin(0.6)
    np.testing.assert_array_equal(places, again)
    # at rest ions spread over the cap: half of them beyond half of the area of its image
    assert np.mean(np.hypot(*places.T) > np.sin(0.6) / np.sqrt(2)) == pytest.approx(0.5, abs=0.15)
