"""The table of origins: a known field of shifts is found, and the errors of a twin run become smaller."""

import math
from dataclasses import replace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.reconstruction.origins import OriginTable


def shift_of(places):
    """A smooth field, a few hundredths of the radius."""
    x, y = places.T
    return np.column_stack([0.03 * np.sin(3 * x) * np.cos(2 * y), 0.02 * np.cos(4 * y)])


NOISE = np.array([[4e-4, 1e-4], [1e-4, 2e-4]])


@pytest.fixture(scope="session")
def table():
    rng = np.random.default_rng(8)
    places = 1.6 * rng.random((60_000, 2)) - 0.8
    shifts = shift_of(places) + rng.multivariate_normal([0, 0], NOISE, len(places))
    return OriginTable(places, shifts, neighbours=40, compression=1.1)


def test_mean_and_covariance_of_a_known_field(table, rng):
    places = rng.random((4000, 2)) - 0.5
    shifts, covariances = table.shifts_at(places)
    # the error of a mean of 40 is sqrt(variance / 40); within the 40 nearest, 0.015 wide, the field is a line
    deviations = (shifts - shift_of(places)) / np.sqrt(np.diag(NOISE) / 40)
    assert np.abs(deviations.mean(axis=0)).max() < 0.2  # means share ions: 60,000 * 0.39 / 40 = 590 independent ones
    assert deviations.std(axis=0) == pytest.approx([1, 1], rel=0.15)
    assert covariances.mean(axis=0) == pytest.approx(NOISE * (1 + 1 / 40), rel=0.15)
    # the true places of new ions are within the ellipses of the covariance, as often as those of a normal distribution
    true = shift_of(places) + rng.multivariate_normal([0, 0], NOISE, len(places))
    distances = np.einsum("ni,nij,nj->n", true - shifts, np.linalg.inv(covariances), true - shifts)
    # 1 - exp(-1/2), less as a covariance of 40 ions is itself uncertain; 4 / sqrt(4000 / 4)
    assert np.mean(distances < 1) == pytest.approx(1 - math.exp(-0.5), abs=0.04)


def test_a_rotated_table(table):
    places = np.array([[0.3, 0.1], [0.0, -0.4]])
    turned, covariances = table.rotated(90.0).shifts_at(places @ [[0, 1], [-1, 0]])
    shifts, before = table.shifts_at(places)
    assert turned == pytest.approx(shifts @ [[0, 1], [-1, 0]])
    assert covariances[:, 0, 0] == pytest.approx(before[:, 1, 1])
    assert covariances[:, 0, 1] == pytest.approx(-before[:, 0, 1])


def test_a_table_is_saved(table, tmp_path):
    path = tmp_path / "ni.npz"
    table.save(path)
    copy = OriginTable.load(path)
    assert np.array_equal(copy.places, table.places) and np.array_equal(copy.shifts, table.shifts)
    assert (copy.neighbours, copy.compression, copy.symmetry) == (40, 1.1, 1)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ae.FileError, match="is not a table of origins"):
        OriginTable.load(path)


def test_what_a_table_does_not_cover(table):
    with pytest.raises(ValueError, match="places"):
        table.shifts_at([[1.2, 0.0]])
    with pytest.raises(ValueError, match="a table needs at least 16 ions, got 15"):
        OriginTable(table.places[:15], table.shifts[:15])
    with pytest.raises(ValueError, match="places"):
        OriginTable(table.places[:20], table.shifts[:21])
    with pytest.raises(ValueError, match="runs must contain at least one run"):
        ae.reconstruction.origin_table([])


def test_a_shift_is_added_on_the_cap(table):
    """Lateral positions are those of the hits plus R times the shift, on the same cap."""
    hits = ae.Hits(x=[0.0, 20.0, -10.0], y=[5.0, 3.0, 30.0])
    known = {"atomic_volume": 0.01, "distance": 90.0, "detector_radius": 38.0, "radius": [30.0, 30.5, 31.0]}
    plain, corrected = (ae.reconstruct(hits, **known, origins=origins) for origins in (None, table))
    places = plain.positions[:, :2] / plain.radii[:, None]
    shifts, covariances = table.shifts_at(places)
    assert corrected.positions[:, :2] == pytest.approx((places + shifts) * plain.radii[:, None])
    assert corrected.depths == pytest.approx(plain.depths, abs=1e-12)
    assert corrected.covariances == pytest.approx(covariances * plain.radii[:, None, None] ** 2)
    assert plain.covariances is None
    with pytest.raises(ValueError, match="origins"):
        ae.reconstruct(hits, **known, origins=shifts)


@pytest.fixture(scope="session")
def twins(nickel, made_once):
    """Runs of Ni[111], R = 12 a, that differ by the origin of the lattice and the seed."""
    flight = ae.simulation.FlightSettings(opening_angle=0.6, tolerance=1e-2)

    def make(seed):
        tip = ae.Tip(nickel, apex_radius=12 * nickel.a, axis=(1, 1, 1), shank_length=12 * nickel.a, offset_seed=seed)
        return made_once(tip, 4000, [ae.Unperturbed()], responses=False, seed=seed, flight_settings=flight)

    return [make(21), make(22)]


def reconstructed(run, nickel, origins=None):
    caps = ae.simulation.fit_caps(run)
    radii = np.concatenate([np.full(cap.last - cap.first, cap.radius) for cap in caps])
    compression = ae.simulation.image_compression(run, caps).compression
    hits = run.hits(ae.Unperturbed())
    known = {"atomic_volume": nickel.a**3 / 4, "distance": 100.0, "detector_radius": 90.0, "radius": radii}
    return ae.reconstruct(hits, **known, projection="compressed", compression=compression, origins=origins)


@pytest.mark.slow
def test_the_errors_of_a_twin_run(twins, nickel):
    first, second = twins
    plain = reconstructed(second, nickel).errors(second)
    alone = ae.reconstruction.origin_table(first, symmetry=False)
    table = ae.reconstruction.origin_table(first)
    assert table.symmetry == 6 and len(table) == 6 * len(alone) and repr(table).startswith("<OriginTable: ")
    result = reconstructed(second, nickel, table)
    corrected = result.errors(second)
    without = reconstructed(second, nickel, alone).errors(second)
    # measured: 0.173 nm becomes 0.041 nm; 0.055 nm without the symmetry of the crystal, 0.079 nm turned by 60 degrees
    assert corrected.lateral_rms < 0.45 * plain.lateral_rms
    assert corrected.lateral_rms < without.lateral_rms < 0.6 * plain.lateral_rms
    # the artefacts of the density disappear with the aberrations
    assert result.density_map(12).contrast < 0.5 * reconstructed(second, nickel).density_map(12).contrast
    # the error bars are those of the other run
    predicted = math.sqrt(np.trace(result.covariances, axis1=1, axis2=2).mean())
    assert corrected.lateral_rms == pytest.approx(predicted, rel=0.25)
    # a table of a crystal that is turned has the right pole, but wrong zone lines
    assert reconstructed(second, nickel, table.rotated(60.0)).errors(second).lateral_rms > 1.5 * corrected.lateral_rms
    with pytest.raises(ValueError, match="runs must have the same crystal and orientation"):
        tip = {**first.settings["tip"], "axis": [0, 0, 1]}
        other = replace(first, settings={**first.settings, "tip": tip})
        ae.reconstruction.origin_table([first, other])


def test_symmetric_copies(few20):
    """Every symmetry of the crystal maps the table onto itself."""
    table = ae.reconstruction.origin_table(few20)
    turned = table.rotated(120.0)
    order, other = (np.lexsort(np.round(each.places, 9).T) for each in (table, turned))
    np.testing.assert_allclose(turned.places[other], table.places[order], rtol=0, atol=1e-9, equal_nan=False)
    np.testing.assert_allclose(turned.shifts[other], table.shifts[order], rtol=0, atol=1e-8, equal_nan=False)
