"""Reconstruction with a lens: field factor and image compression that follow the radius of each ion."""

import math
from dataclasses import replace

import numpy as np
import pytest

import apt_evap as ae

FIELD, VOLUME, EFFICIENCY, LENGTH, SHANK = 35.0, 0.011, 0.5, 90.0, 6.0  # V/nm, nm^3, -, mm, degrees
RIM = 20.0  # mm


@pytest.fixture(
    scope="session",
    params=[
        pytest.param(0.0, id="field-free drift", marks=pytest.mark.slow),
        pytest.param(4300.0, id="potential of the detector"),
    ],
)
def lens(request):
    return ae.detection.LocalElectrode(40e3, 20e3, SHANK, detector_potential=request.param)


@pytest.fixture(scope="session")
def receding(lens):
    """Ions of a cap that recedes from a radius of 20 to 40 nm on its shank, seen through the lens, and their sites."""
    rng = np.random.default_rng(1)
    n = 40_000
    sine = math.sin(math.radians(SHANK))
    radii = np.linspace(20.0, 40.0, 2000)
    voltages = lens.field_factor(radii) * FIELD * radii
    rims = np.radians(lens.cap_angle(RIM, radii, voltages, LENGTH))
    slope = sine / (1 - sine)  # of the radius with the depth
    per_radius = math.pi * radii**2 * (np.sin(rims) ** 2 / slope - (1 - np.cos(rims)) ** 2) * EFFICIENCY / VOLUME
    number = np.concatenate([[0.0], np.cumsum((per_radius[1:] + per_radius[:-1]) / 2 * np.diff(radii))])
    radius = np.interp(np.linspace(0.0, number[-1], n), number, radii)
    voltage = lens.field_factor(radius) * FIELD * radius
    rim = np.radians(lens.cap_angle(RIM, radius, voltage, LENGTH))
    theta = np.arccos(1 - rng.random(n) * (1 - np.cos(rim)))
    azimuth = 2 * np.pi * rng.random(n)
    distance = lens.distance_from_axis(np.degrees(theta), radius, voltage, LENGTH)
    hits = ae.Hits(x=distance * np.cos(azimuth), y=distance * np.sin(azimuth), voltage=voltage)
    depth = (radius - radius[0]) / slope
    across = radius * np.sin(theta)
    sites = np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), depth + radius * (1 - np.cos(theta))])
    return hits, sites, number[-1] / n


@pytest.mark.slow
def test_a_shank_whose_radius_doubles_comes_back(lens, receding):
    """With the lens the places are exact and the depth is that of the volume; constants of either end are not."""
    hits, sites, share = receding
    known = {"atomic_volume": VOLUME * share, "efficiency": EFFICIENCY, "distance": LENGTH, "detector_radius": RIM}
    found = ae.reconstruct(hits, **known, evaporation_field=FIELD, lens=lens)
    # the table of the radii from voltages is exact within 1e-7
    assert np.abs(found.positions[:, :2] - sites[:, :2]).max() < 1e-4
    depth = found.positions[:, 2] - sites[:, 2]
    assert np.abs(depth).max() < 1e-3 * np.ptp(sites[:, 2])
    errors, widths = [], []
    for radius in (20.0, 28.3, 40.0):
        constants = {"field_factor": lens.field_factor(radius), "compression": lens.compression(radius)}
        constant = ae.reconstruct(hits, **known, evaporation_field=FIELD, projection="compressed", **constants)
        errors.append(np.ptp(constant.positions[:, 2]) / np.ptp(sites[:, 2]) - 1)
        wide, true = (np.hypot(*each[:, :2].T) for each in (constant.positions, sites))
        widths.append([wide[part].mean() / true[part].mean() - 1 for part in (slice(4000), slice(-4000, None))])
    if not lens.detector_potential:  # the table of docs/microscope.rst
        assert errors == pytest.approx([0.096, 0.009, -0.072], abs=2e-3)
        assert np.ravel(widths) == pytest.approx([-0.009, -0.077, 0.034, -0.037, 0.078, 0.004], abs=2e-3)
    assert max(np.abs(errors)) > 0.05


@pytest.mark.slow
def test_the_free_constants_are_fitted_with_a_lens(lens, receding):
    hits, sites, share = receding
    known = {"atomic_volume": VOLUME * share, "efficiency": EFFICIENCY, "distance": LENGTH, "detector_radius": RIM}
    found = ae.reconstruct(hits, **known, evaporation_field=1.03 * FIELD, lens=lens)
    errors = found.errors(sites * (1, 1, -1))
    assert errors.radius_factor == pytest.approx(1.0, abs=0.1)
    assert errors.lateral_rms < 0.1 < np.sqrt(np.mean((found.positions[:, :2] - sites[:, :2]) ** 2))


def test_the_protocol_of_bas_with_a_lens(lens, receding):
    """Its area is a little larger than that of the cap, and no shank is subtracted."""
    hits, _, share = receding
    known = {"atomic_volume": VOLUME * share, "efficiency": EFFICIENCY, "distance": LENGTH, "detector_radius": RIM}
    cap, bas = (
        ae.reconstruct(hits, protocol=name, **known, evaporation_field=FIELD, lens=lens) for name in ("cap", "bas")
    )
    assert np.allclose(cap.positions[:, :2], bas.positions[:, :2])
    assert 0.8 < np.ptp(bas.depths) / np.ptp(cap.depths) < 1.0


def test_radii_can_be_given_with_a_lens():
    lens = ae.detection.LocalElectrode(40e3, 20e3, SHANK)
    hits = ae.Hits(x=np.array([0.0, 10.0]), y=np.zeros(2))
    known = {"atomic_volume": VOLUME, "distance": LENGTH, "detector_radius": RIM}
    found = ae.reconstruct(hits, **known, radius=[20.0, 40.0], lens=lens)
    assert found.positions[1, 0] == pytest.approx(40 * math.sin(math.radians(lens.cap_angle(10.0, 40.0, 1.0, LENGTH))))
    assert found.angles[1] == pytest.approx(lens.cap_angle(10.0, 40.0, 1.0, LENGTH))
    assert found.settings.lens is lens and "lens" in repr(found)


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ({"projection": "bas"}, "projection"),
        ({"compression": 1.5}, "compression"),
        ({"field_factor": 3.3}, "field_factor"),
        ({"radius": "shank", "evaporation_field": None, "initial_radius": 20.0, "shank_angle": 5.0}, "radius"),
        ({"lens": "local electrode"}, "lens"),
        ({"detector_radius": 300.0}, "detector_radius"),
    ],
)
def test_what_does_not_fit_a_lens_is_refused(arguments, name):
    given = {"atomic_volume": VOLUME, "distance": LENGTH, "evaporation_field": FIELD, "detector_radius": RIM}
    given |= {"lens": ae.detection.LocalElectrode(40e3, 20e3, SHANK)}
    hits = ae.Hits(x=np.array([0.0, 200.0]), y=np.zeros(2), voltage=np.full(2, 3000.0))
    with pytest.raises(ValueError, match=name):
        ae.reconstruct(hits, **(given | arguments))


def test_the_place_on_the_detector_and_the_angle_are_inverse(lens):
    angles, voltages = np.array([0.0, 3.0, 20.0, 35.0]), np.array([[2200.0], [9000.0]])
    distance = lens.distance_from_axis(angles, 40.0, voltages, LENGTH)
    assert lens.cap_angle(distance, 40.0, voltages, LENGTH) == pytest.approx(np.broadcast_to(angles, (2, 4)), abs=1e-9)
    assert np.isnan(lens.cap_angle(1e4, 40.0, 5000.0, LENGTH))


# ---- the shank -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_shank_angle_follows_from_the_voltages(lens, receding):
    if lens.detector_potential:
        pytest.skip("the other lens suffices")
    hits, _, share = receding
    known = {"atomic_volume": VOLUME * share, "efficiency": EFFICIENCY, "distance": LENGTH, "detector_radius": RIM}
    start = replace(lens, shank_angle=9.0)
    fit = ae.reconstruction.fit_shank(hits, start, **known, evaporation_field=FIELD)
    # 40 sections of a curve without noise; the second order of the radius in the depth is left
    assert fit.angle == pytest.approx(SHANK, abs=0.05) and fit.error < 0.05
    assert fit.radii[0] == pytest.approx(20.0, rel=0.03) and fit.radii[-1] == pytest.approx(40.0, rel=0.03)
    # a wrong field: the voltage alone does not tell
    other = ae.reconstruction.fit_shank(hits, start, **known, evaporation_field=1.02 * FIELD)
    assert other.angle - fit.angle == pytest.approx(2 * fit.per_cent["evaporation field"], rel=0.2)
    assert abs(fit.per_cent["evaporation field"]) > 0.02


@pytest.mark.slow
def test_voltages_without_a_shank_are_refused(lens, receding):
    hits, _, share = receding
    known = {"atomic_volume": VOLUME * share, "efficiency": EFFICIENCY, "distance": LENGTH, "detector_radius": RIM}
    falling = replace(hits, voltage=hits.voltage[::-1].copy())
    with pytest.raises(ValueError, match="hits"):
        ae.reconstruction.fit_shank(falling, lens, **known, evaporation_field=FIELD)
    with pytest.raises(ValueError, match="profile"):
        profiled = replace(lens, profile=((0.0, 20.0), (100.0, 40.0)))
        ae.reconstruction.fit_shank(hits, profiled, **known, evaporation_field=FIELD)


# ---- checks ----------------------------------------------------------------------------------------------------------


def test_checks_find_wrong_constants(nickel):
    """Lattice planes across the axis and a uniform density, seen through right and wrong constants."""
    rng, spacing, radius = np.random.default_rng(2), 0.203, 25.0
    sites = np.column_stack([rng.uniform(-6, 6, (20_000, 2)), spacing * rng.integers(0, 40, 20_000)])
    below = radius - np.sqrt(radius**2 - (sites[:, :2] ** 2).sum(axis=1))
    sites = sites[np.argsort(sites[:, 2] - below, kind="stable")]
    rim = 6.0
    sites = sites[np.hypot(*sites[:, :2].T) < rim]
    angles = np.arcsin(np.hypot(*sites[:, :2].T) / radius)
    azimuth = np.arctan2(sites[:, 1], sites[:, 0])
    across = LENGTH * np.tan(angles / 1.5)
    hits = ae.Hits(x=across * np.cos(azimuth), y=across * np.sin(azimuth))
    volume = math.pi * rim**2 * (np.ptp(sites[:, 2]) + spacing) / len(sites)
    constants = {
        "distance": LENGTH,
        "projection": "compressed",
        "detector_radius": LENGTH * math.tan(math.asin(rim / radius) / 1.5),
    }
    poles = {"111": ((0.0, 0.0), spacing)}
    right = ae.reconstruct(hits, **constants, atomic_volume=volume, radius=radius)
    planes, density = ae.reconstruction.checks(right, poles)
    assert planes.good and planes.found == pytest.approx(spacing, rel=0.03)
    assert density.good and density.expected == pytest.approx(1 / volume)
    wrong = ae.reconstruct(hits, **constants, atomic_volume=1.3 * volume, radius=radius)
    assert not density._replace(found=0.9 * density.expected).good  # too few are as bad as too many
    planes, _ = ae.reconstruction.checks(wrong, poles)
    assert planes.found == pytest.approx(1.3 * spacing, rel=0.03) and not planes.good
    assert "efficiency" in repr(planes)
    with pytest.raises(ValueError, match="spacing of 111"):
        ae.reconstruction.checks(right, {"111": ((0.0, 0.0), 0.0)})
