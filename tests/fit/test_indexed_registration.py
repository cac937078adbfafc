"""Registration of a run of any specimen on an indexed map."""

from dataclasses import replace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.fit.indexed_registration import (
    HEIGHT,
    emission_of_pattern,
    index_as_run,
    indexed_start,
    register_near,
)
from apt_evap.maps.crystallography.orientation import Orientation
from apt_evap.maps.indexing.index_map import Candidate, Indexing
from apt_evap.maps.indexing.master_pattern import master_patterns
from apt_evap.simulation.apex import image_compression
from apt_evap.specimen.symmetry import point_group
from apt_evap.workflows import compare_maps

PROJECTION = ae.detection.Projection(60.0, centre=(3.0, -2.0), compression=1.5)
NEAR_111 = (0.35, 0.53, 0.77)  # 16 degrees from [111]


def indexed(axis, rotation, ions=20_000, rolled=0.5):
    """A map with (111) near its centre or not, and its true indexing."""
    truth = ae.Orientation("Ni", axis=axis, rotation=rotation)
    pattern = master_patterns("fcc")[0]
    measured = pattern.map(truth, PROJECTION, 70.0, ions=ions, rolled=rolled, seed=1)
    best = Candidate(truth, PROJECTION, 0.9, 1.0, rolled, 1.0, 0.1, pattern)
    return Indexing(measured, (best,), True, "known")


@pytest.mark.parametrize("rotation", [77.0, *(pytest.param(turn, marks=pytest.mark.slow) for turn in (0.0, -140.0))])
@pytest.mark.parametrize("member", [0, 5, 17, 30, 47])
def test_directions_of_the_run_are_where_the_map_has_them(few20, rotation, member):
    """Whichever of its equal orientations the indexing has, and whichever handedness."""
    indexing = indexed(NEAR_111, rotation)
    best = indexing.best
    equal = best.orientation.matrix @ point_group("fcc")[member]
    equal[0] *= np.sign(np.linalg.det(equal))  # of the other handedness for an improper operation
    turned = replace(best, orientation=Orientation.from_matrix(best.orientation.material, equal))
    start = indexed_start(few20, replace(indexing, candidates=(turned,)))["start"]

    crystal = Orientation.known(few20.settings["tip"])
    directions = crystal.matrix.T @ np.array([[0.0, 0.0, 1.0], [0.1, 0.0, 0.99], [0.0, 0.2, 0.97]]).T
    simulated = image_compression(few20).projection.places((crystal.matrix @ directions).T)
    found = np.stack(start.points(*simulated.T), axis=-1)
    distances = []
    for operation in point_group("fcc"):
        seen = turned.orientation.matrix @ operation @ directions
        if seen[2].min() > 0.5:
            distances.append(np.abs(turned.projection.places(seen.T) - found).max())
    assert min(distances) < 0.5  # mm, of 60 mm/rad: image compressions differ


def test_bounds_are_about_the_start(few20):
    bounds = indexed_start(few20, indexed(NEAR_111, 20.0))
    start = bounds["start"]
    assert bounds["rotations"] == (start.rotation - 5, start.rotation + 5) and not start.mirror
    assert bounds["scales"] == pytest.approx((0.92 * start.scale, 1.08 * start.scale))
    assert bounds["tolerance"] == pytest.approx(np.radians(3) * 60.0)


def test_an_axis_that_is_not_on_the_map_is_named(few20):
    with pytest.raises(ValueError, match=r"the axis of the run is 5[0-9] degrees from the centre of the map"):
        indexed_start(few20, indexed((0.02, 0.05, 1.0), 10.0))


def test_what_cannot_decide_is_not_indexed(few20):
    few = indexed(NEAR_111, 0.0, ions=1_000).map
    assert index_as_run(few, Orientation.known(few20.settings["tip"])) is None
    assert index_as_run(indexed(NEAR_111, 0.0).map, None) is None


def test_the_emission_is_that_of_the_patterns():
    assert emission_of_pattern(0.5) == ae.RollUp(0.35, 0.5, 0.4, HEIGHT)
    assert emission_of_pattern(0.05, height=0.0) == ae.LateralVelocity(0.35, 0.0)


@pytest.mark.slow
def test_a_run_is_registered_where_the_pattern_has_its_axis(run20):
    """Also if the map shows the axis far from its centre, and a search alone finds another place."""
    indexing = indexed(NEAR_111, 77.0)
    bounds = indexed_start(run20, indexing)
    hits = run20.hits(emission_of_pattern(0.5, run20.response_settings.height))
    registration = register_near(hits, indexing.map, bounds)
    axis, place = np.array([[0.0, 0.0, 1.0]]), np.array(registration.points(0.0, 0.0))
    matrices = indexing.best.orientation.matrix @ point_group("fcc") @ Orientation.known(run20.settings["tip"]).matrix.T
    places = [PROJECTION.places(axis @ matrix.T)[0] for matrix in matrices if matrix[2, 2] > 0.7]
    assert min(np.hypot(*(each - place)) for each in places) < np.radians(2) * 60.0
    assert registration.method == "start" and not registration.doubtful


class _Registered(Exception):
    """Ends a comparison after its registration."""


@pytest.fixture
def registered(few20, monkeypatch):
    """Function of an indexing: the lines and the registration of a comparison of `few20` with its map."""

    def compared(indexing):
        monkeypatch.setattr(compare_maps, "index_as_run", lambda measured, crystal, distance: indexing)
        lines = []
        with pytest.raises(_Registered) as reached:
            ae.compare(few20, indexing.map, note=lines.append)
        return lines, reached.value.args[0]

    def fit(*_, registration, **__):
        raise _Registered(registration)

    monkeypatch.setattr(compare_maps, "fit_energies", fit)
    return compared


@pytest.mark.slow
def test_a_comparison_registers_by_the_indexing(registered):
    lines, registration = registered(indexed(NEAR_111, 77.0))
    assert registration.method == "start"
    scale = "60.0 mm/rad in the centre and at the rim"
    assert lines == [f"the map shows [0.35 0.53 0.77], rotation 77.0°, {scale}, where the run is registered"]


def test_a_comparison_searches_if_the_map_does_not_decide(registered):
    indexing = indexed((0.02, 0.05, 1.0), 10.0)
    with pytest.warns(ae.warnings.MapWarning, match="degrees from the centre of the map.*registered by a search"):
        assert registered(indexing) == ([], None)
    assert registered(replace(indexing, decided=False)) == ([], None)
