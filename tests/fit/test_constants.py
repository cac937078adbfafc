"""Constants of a measurement that was made with known ones."""

import math

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.plot.report.measurement_report import measurement_section

SCALE, FIELD, VOLUME = 60.0, 35.0, 0.352**3 / 4  # mm/rad, V/nm, nm^3


@pytest.fixture(scope="session")
def measured(indexed_nickel):
    """Map and candidate of nickel at a scale of 60 mm/rad."""
    _, indexing = indexed_nickel
    return indexing.map, indexing.best


def ions_of(detector_map, angle, factor, n=30_000, first=30.0):
    """Ions on a cap of known radius that recedes on a shank of an angle [degrees], with V = factor F R."""
    rng = np.random.default_rng(2)
    rows, columns = np.nonzero(detector_map.counts)
    counts = detector_map.counts[rows, columns]
    x, y = (np.repeat(each, counts) for each in (detector_map.centres[0][columns], detector_map.centres[1][rows]))
    order = rng.permutation(len(x))[:n]
    rim = np.hypot(x, y).max() / SCALE
    slope = math.sin(math.radians(angle)) / (1 - math.sin(math.radians(angle)))
    # volume of the ions = that which the cap sweeps: R^2 dz (pi sin^2 - slope pi (1 - cos)^2)
    swept = math.pi * (math.sin(rim) ** 2 - slope * (1 - math.cos(rim)) ** 2)
    radii = np.cbrt(first**3 + 3 * slope * VOLUME / 0.01 / swept * np.arange(len(order)))
    return ae.Hits(x=x[order], y=y[order], voltage=factor * FIELD * radii), radii


@pytest.mark.slow
def test_constants_are_those_that_the_measurement_was_made_with(measured):
    detector_map, best = measured
    hits, radii = ions_of(detector_map, angle=5.0, factor=3.0)
    found = ae.fit.constants_of(detector_map, best, hits, field_factor=3.0, distance=90.0, efficiency=0.01)
    by_name = {each.name.partition(" [")[0]: each for each in found.constants}
    scale = by_name["scale of the map"]
    assert abs(scale.value - SCALE) < 4 * scale.error and 0 < scale.error < 0.05 * SCALE
    assert by_name["image compression"].value == pytest.approx(90.0 / scale.value)
    assert by_name["radius at the first ions"].value == pytest.approx(np.median(radii[:1000]))
    assert by_name["radius at the last ions"].value == pytest.approx(np.median(radii[-1000:]))
    shank = by_name["angle of the shank"]
    # its degenerate part: the angle at the rim is that of the fitted scale, to the error of the scale
    assert shank.value == pytest.approx(5.0, rel=4 * scale.error / SCALE + 0.02)
    # three times the efficiency is three times the slope, as the table says
    other = ae.fit.constants_of(detector_map, best, hits, field_factor=3.0, efficiency=0.03).constants[-1]
    slopes = [np.sin(np.radians(each)) / (1 - np.sin(np.radians(each))) for each in (shank.value, other.value)]
    assert slopes[1] / slopes[0] == pytest.approx(3.0, rel=0.05)  # but for the widening of the cap
    assert found.arguments["field_factor"] == 3.0 and found.arguments["projection"] == "equidistant"
    reconstructed = ae.reconstruct(hits, **found.arguments)
    # some ions in the corners of the map are left out
    assert 0.8 * len(hits) < len(reconstructed) < len(hits)
    assert reconstructed.radii == pytest.approx(reconstructed.hits.voltage / (3.0 * FIELD))


def test_checks_see_a_change_and_no_change(measured):
    detector_map, best = measured
    hits, _ = ions_of(detector_map, angle=5.0, factor=3.0)

    def deviations(change):
        n = len(hits)
        rng = np.random.default_rng(3)
        late = np.arange(n) >= n // 2
        stretch = np.where(late & change, 1.1, 1.0)
        several = 1 + (rng.random(n) < np.where(late & change, 0.2, 0.1))
        columns = {"x": hits.x * stretch, "y": hits.y * stretch, "voltage": hits.voltage, "multiplicity": several}
        changed = ae.Hits(**columns)
        found = ae.fit.constants_of(detector_map, best, changed)
        return {each.name.split()[0]: each.z for each in found.checks}

    same, other = deviations(False), deviations(True)
    assert abs(same["scale"]) < 4 and abs(same["share"]) < 4
    assert other["scale"] > 2 and other["share"] > 10


@pytest.mark.slow
def test_a_lens_gives_radius_field_factor_and_compression(measured):
    detector_map, best = measured
    lens = ae.detection.LocalElectrode(distance=40e3, aperture=20e3, shank_angle=5.0)
    radii = np.linspace(30.0, 30.2, 12_000)
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-20, 20, (2, len(radii)))
    hits = ae.Hits(x=x, y=y, voltage=lens.field_factor(radii) * FIELD * radii)
    found = ae.fit.constants_of(detector_map, best, hits, lens=lens, distance=90.0, efficiency=1.0)
    by_name = {each.name.partition(" [")[0]: each for each in found.constants}
    first = by_name["radius at the first ions"].value
    assert first == pytest.approx(np.median(radii[:1000]), rel=1e-4)
    assert by_name["field factor at the first ions"].value == pytest.approx(lens.field_factor(first))
    compression = next(each for each in found.checks if each.name.startswith("image compression"))
    assert compression.expected == pytest.approx(lens.compression(30.1), rel=1e-3)
    assert found.arguments["lens"] == lens and "field_factor" not in found.arguments
    # the cap recedes by a fraction of a nanometre only: no angle
    assert math.isnan(by_name["angle of the shank"].value)
    section = measurement_section(found.constants, found.checks, "apt-evap reconstruct <file>")
    assert "&lt;file&gt;" in section and all(each.name in section for each in found.constants)


def test_charge_states_and_a_map_without_ions(measured):
    detector_map, best = measured
    assert ae.fit.constants_of(detector_map, best).arguments == {}
    hits, _ = ions_of(detector_map, angle=5.0, factor=3.0)
    rng = np.random.default_rng(4)
    mass = np.where(rng.random(len(hits)) < 0.2, 58.0, 29.0)
    charged = ae.Hits(x=hits.x, y=hits.y, voltage=hits.voltage, mass_to_charge=mass)
    ranges = ae.spectra.Ranges(names=("Ni", "Ni"), low=[57.5, 28.7], high=[58.5, 29.3])
    checks = ae.fit.constants_of(detector_map, best, charged, ranges=ranges).checks
    ratio, field = checks[-2:]
    assert abs(ratio.z) < 4 and ratio.expected == pytest.approx(np.log(4), abs=4 * ratio.error)
    assert field.value == pytest.approx(ae.emission.field_of_ratio("Ni", 1, 4.0), rel=0.01)
    for wrong, name in (
        ({"efficiency": 0.0}, "efficiency"),
        ({"distance": -1.0}, "distance"),
        ({"lens": 1}, "lens"),
        ({"field_factor": 0}, "field_factor"),
    ):
        with pytest.raises(ValueError, match=name):
            ae.fit.constants_of(detector_map, best, **wrong)
