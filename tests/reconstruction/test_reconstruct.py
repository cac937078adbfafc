"""Reconstruction of hits whose cap is known: closed forms, volumes, thinning, and files."""

import copy
import json
import math
import pickle
from dataclasses import replace

import numpy as np
import pytest

import apt_evap as ae
from apt_evap._common.codec import from_plain, to_plain
from apt_evap.reconstruction import cap_geometry
from apt_evap.reconstruction.density import density_of

DISTANCE = 90.0  # mm
RIM = 38.0  # mm
VOLUME = 0.0166  # nm^3 per atom, of aluminium
XI, FIELD, FACTOR = 1.6, 19.0, 3.3
KNOWN = {"atomic_volume": VOLUME, "distance": DISTANCE, "compression": XI, "detector_radius": RIM}
SHANK = KNOWN | {"radius": "shank", "initial_radius": 30.0, "shank_angle": 6.0}
SLOPE = math.sin(math.radians(6.0)) / (1 - math.sin(math.radians(6.0)))


def angle_of(rho, projection="bas"):
    """Angle on the cap by the geometry of each projection, of a point by a ray from behind the centre."""
    if projection == "equidistant":
        return XI * rho / DISTANCE
    straight = np.arctan2(rho, DISTANCE)
    if projection == "compressed":
        return XI * straight
    # intersection of the ray from (0, -(xi - 1)) with the circle of radius 1 about (0, 0)
    sine, cosine = np.sin(straight), np.cos(straight)
    along = (XI - 1) * cosine + np.sqrt(1 - ((XI - 1) * sine) ** 2)
    return np.arctan2(along * sine, along * cosine - (XI - 1))


def hit_of(theta, projection="bas"):
    """Distance on the detector [mm], the inverse of `angle_of`."""
    if projection == "equidistant":
        return DISTANCE * theta / XI
    if projection == "compressed":
        return DISTANCE * np.tan(theta / XI)
    return DISTANCE * np.sin(theta) / (XI - 1 + np.cos(theta))


def cap_points(rng, n, rim_angle, slope=0.0):
    """Angles on a receding cap, as dense as it recedes there: cos(theta) - slope (1 - cos(theta)); and azimuths."""
    cosine = np.linspace(1, math.cos(rim_angle), 2001)
    swept = (1 - cosine**2) - slope * (1 - cosine) ** 2
    return np.arccos(np.interp(rng.random(n) * swept[-1], swept, cosine)), 2 * np.pi * rng.random(n)


def hits_of(theta, azimuth, projection="bas", **columns):
    rho = hit_of(theta, projection)
    return ae.Hits(x=rho * np.cos(azimuth), y=rho * np.sin(azimuth), **columns)


@pytest.fixture
def cone(rng):
    """Hits of 40,000 ions of a cone of 6 degrees."""
    return hits_of(*cap_points(rng, 40_000, float(angle_of(RIM)), SLOPE))


@pytest.mark.parametrize("projection", ["bas", "equidistant", "compressed"])
def test_a_perfect_projector_is_inverted(rng, projection):
    radius, n = 30.0, 5000
    rim = float(angle_of(RIM, projection))
    theta, azimuth = cap_points(rng, n, rim)
    # a cap of constant radius sweeps the cross-section of its rim
    depth = np.arange(n) * VOLUME / (math.pi * (radius * math.sin(rim)) ** 2)
    x, y = (radius * np.sin(theta) * part(azimuth) for part in (np.cos, np.sin))
    sites = np.column_stack([x, y, depth + radius * (1 - np.cos(theta))])
    hits = hits_of(theta, azimuth, projection)
    result = ae.reconstruct(hits, **KNOWN, projection=projection, radius=radius)
    assert np.abs(result.positions - sites).max() < 1e-9 * radius  # rounding; seen: 1e-14 R
    assert np.degrees(theta) == pytest.approx(result.angles, abs=1e-5)  # arcsin near 90 degrees loses half the digits
    assert depth == pytest.approx(result.depths, abs=1e-9)
    errors = result.errors(sites * [1, 1, -1])
    assert max(errors.lateral_rms, errors.depth_rms) < 1e-9 * radius
    wrong = ae.reconstruct(hits, **KNOWN | {"compression": 1.5}, projection=projection, radius=radius)
    assert wrong.errors(sites * [1, 1, -1], fit=()).lateral_rms > 0.01 * radius


def test_the_volume_of_the_ions_is_that_of_the_cap(cone):
    result = ae.reconstruct(cone, **SHANK, efficiency=0.1)
    rim, last = float(angle_of(RIM)), result.radii[-1]
    # the rim moves along a cone: frustum between the two rims, plus the cap above the first, minus that above the last
    rims = [radius * math.sin(rim) for radius in (30.0, last)]
    height = result.depths[-1] + (last - 30.0) * (1 - math.cos(rim))
    frustum = math.pi / 3 * height * (rims[0] ** 2 + rims[0] * rims[1] + rims[1] ** 2)
    caps = [math.pi / 3 * radius**3 * (1 - math.cos(rim)) ** 2 * (2 + math.cos(rim)) for radius in (30.0, last)]
    assert frustum + caps[0] - caps[1] == pytest.approx((len(cone) - 1) * VOLUME / 0.1, rel=1e-9)  # rounding
    # and the ions fill it evenly: a box inside has its share, with the scatter of a count
    x, y, z = result.positions.T
    box = (np.abs(x) < 8) & (np.abs(y) < 8) & (z > 3) & (z < 5)
    expected = 16 * 16 * 2 * 0.1 / VOLUME
    assert result.depths[-1] > 5 and (30 - math.sqrt(30**2 - 2 * 8**2)) < 3
    assert np.count_nonzero(box) == pytest.approx(expected, abs=4 * math.sqrt(expected))


def test_the_plane_area_makes_the_depth_too_small(cone):
    """With a constant radius, by the ratio of both areas: (xi tan(theta') / sin(theta))^2."""
    exact, plane = (
        ae.reconstruct(cone, **KNOWN, radius=30.0, protocol=protocol).depths[-1] for protocol in ("cap", "bas")
    )
    ratio = (XI * RIM / DISTANCE / math.sin(float(angle_of(RIM)))) ** 2
    assert exact / plane == pytest.approx(ratio, rel=1e-9)
    assert ratio > 1.1
    by_area = ae.reconstruct(cone, **KNOWN | {"detector_radius": None}, area=math.pi * RIM**2, radius=30.0)
    assert by_area.depths[-1] == pytest.approx(exact, rel=1e-9)


def test_bas_is_the_formula_of_the_papers(cone):
    """dz = Omega L^2 k_f^2 F^2 / (eta A xi^2 V^2), with voltages that rise slowly."""
    voltage = np.linspace(2000.0, 2500.0, len(cone))
    hits = ae.Hits(x=cone.x, y=cone.y, voltage=voltage)
    result = ae.reconstruct(hits, **KNOWN, protocol="bas", evaporation_field=FIELD, efficiency=0.57)
    area = math.pi * RIM**2
    steps = VOLUME * (DISTANCE * FACTOR * FIELD) ** 2 / (0.57 * area * (XI * voltage) ** 2)
    # the mean of two neighbouring R^2 here, the first one there: a relative dR / R of 6e-6
    assert result.depths[-1] == pytest.approx(steps[:-1].sum(), rel=2e-5)
    assert result.radii == pytest.approx(voltage / (FACTOR * FIELD))


def test_an_efficiency_changes_the_depth_only(cone):
    whole = ae.reconstruct(cone, **KNOWN, radius=30.0)
    scaled = ae.reconstruct(cone, **KNOWN, radius=30.0, efficiency=0.4)
    assert np.array_equal(scaled.positions[:, :2], whole.positions[:, :2])
    np.testing.assert_allclose(scaled.depths * 0.4, whole.depths, rtol=0, atol=1e-9, equal_nan=False)
    third = ae.reconstruct(cone[::3], **KNOWN, radius=30.0, efficiency=1 / 3)
    np.testing.assert_allclose(third.positions, whole.positions[::3], rtol=0, atol=1e-9, equal_nan=False)


def test_a_random_third_of_the_ions(cone, rng):
    whole = ae.reconstruct(cone, **SHANK)
    chosen = rng.random(len(cone)) < 1 / 3
    third = ae.reconstruct(cone[chosen], **SHANK, efficiency=1 / 3)
    # the number of ions before each is a binomial count: at most sqrt(n (1 - eta) / eta) ions of the depth, four times
    scatter = 4 * math.sqrt(len(cone) * 2) * whole.depths[-1] / len(cone)
    assert np.abs(third.depths - whole.depths[chosen]).max() < scatter
    assert np.abs(third.radii / whole.radii[chosen] - 1).max() < SLOPE * scatter / 30


@pytest.mark.parametrize("protocol", ["cap", pytest.param("bas", marks=pytest.mark.slow)])
def test_the_voltage_of_a_cone_gives_the_shank(cone, protocol):
    shank = ae.reconstruct(cone, **SHANK, protocol=protocol)
    # the same cone ion by ion, the volume of a thin slice at a time
    rim = float(angle_of(RIM))
    area = math.sin(rim) ** 2 - SLOPE * (1 - math.cos(rim)) ** 2
    area = math.pi * (area if protocol == "cap" else (XI * RIM / DISTANCE) ** 2)
    radii = [30.0]
    for _ in range(len(cone) - 1):
        radii.append(radii[-1] + SLOPE * VOLUME / (area * radii[-1] ** 2))
    voltages = FACTOR * FIELD * np.array(radii)
    hits = ae.Hits(x=cone.x, y=cone.y, voltage=voltages / 1.2, pulse_voltage=voltages / 6)
    by_voltage = ae.reconstruct(hits, **KNOWN, evaporation_field=FIELD, protocol=protocol)
    # thin slices are exact to dR / R per ion: 1e-6; 0.5 % of the depth is what a reconstruction needs
    np.testing.assert_allclose(by_voltage.radii, shank.radii, rtol=1e-5, equal_nan=False)
    assert by_voltage.depths[-1] == pytest.approx(shank.depths[-1], rel=1e-5)
    assert np.abs(by_voltage.positions - shank.positions).max() < 0.005 * shank.depths[-1]
    assert shank.radii[-1] - shank.radii[0] == pytest.approx(SLOPE * shank.depths[-1])


def test_radii_of_the_user_and_the_mean_of_the_voltage(cone):
    cone = cone[:3000]
    radii = np.linspace(30.0, 31.0, len(cone))
    given = ae.reconstruct(cone, **KNOWN, radius=radii)
    hits = ae.Hits(x=cone.x, y=cone.y, voltage=FACTOR * FIELD * radii)
    assert ae.reconstruct(hits, **KNOWN, evaporation_field=FIELD).positions == pytest.approx(given.positions)
    smoothed = ae.reconstruct(hits, **KNOWN, evaporation_field=FIELD, smoothing=101).radii
    assert smoothed[1000:] == pytest.approx(radii[950:-50])  # the mean of a line over 101 is 50 ions late
    assert smoothed[2] == pytest.approx(radii[:3].mean())


def test_ions_outside_and_ions_that_missed_are_left_out(cone):
    cone = cone[:1000]
    outcome = np.zeros(1000, int)
    outcome[5] = 1
    hits = ae.Hits(x=cone.x, y=cone.y, ion=np.arange(1000), outcome=outcome)
    result = ae.reconstruct(hits, **KNOWN | {"detector_radius": 20.0}, radius=np.linspace(30, 31, 1000))
    inside = np.hypot(cone.x, cone.y) <= 20
    inside[5] = False
    assert np.array_equal(result.hits.ion, np.flatnonzero(inside))
    assert np.array_equal(result.radii, np.linspace(30, 31, 1000)[inside])


def test_the_frame_with_the_depth_is_a_mirror_image(rng):
    radius, n = 30.0, 500
    theta, azimuth = cap_points(rng, n, float(angle_of(RIM)))
    directions = np.column_stack([np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)])
    result = ae.reconstruct(hits_of(theta, azimuth), **KNOWN, radius=radius)
    sites = radius * directions - result.depths[:, None] * [0, 0, 1]  # z out of the specimen
    assert np.abs(result.specimen_positions + np.array([0, 0, radius]) - sites).max() < 1e-9 * radius
    # no rotation brings the positions with the depth onto the sites
    for positions, handed in ((result.specimen_positions, 1), (result.positions, -1)):
        moments = (positions - positions.mean(axis=0)).T @ (sites - sites.mean(axis=0))
        assert np.sign(np.linalg.det(moments)) == handed
    # a crystal direction that is tilted from the axis shows its planes in the frame of the specimen alone
    a = 0.4
    grid = a * np.stack(np.meshgrid(*[np.arange(-8, 9)] * 3, indexing="ij"), -1).reshape(-1, 3)
    tilt = math.radians(20)
    turn = np.array([[math.cos(tilt), 0, math.sin(tilt)], [0, 1, 0], [-math.sin(tilt), 0, math.cos(tilt)]])
    crystal = replace(result, positions=grid @ turn.T * [1, 1, -1])
    assert ae.reconstruction.distribution_map(
        crystal.specimen_positions, turn[:, 2], lateral=0.2
    ).spacing == pytest.approx(a, rel=1e-3)
    assert abs(ae.reconstruction.distribution_map(crystal.positions, turn[:, 2], lateral=0.2).spacing / a - 1) > 0.1


def test_the_density_of_the_cap(cone, rng):
    result = ae.reconstruct(cone, **SHANK)
    found = result.density_map(24)
    inside = np.isfinite(found.values)
    deviations = (found.ions - found.expected)[inside] / np.sqrt(found.expected[inside])
    # Poisson counts of 100 ions in 350 cells: variance 1, with a standard deviation of sqrt(2 / 350), four times
    assert np.var(deviations) == pytest.approx(1, abs=0.3) and found.contrast < 0.05
    # the expectation of a needle without a shank is even; that of this cone is not
    assert np.nanmax(found.expected) / np.nanmin(found.expected) > 1.01
    # a quarter is detected with half the efficiency
    x, y = cone.x, cone.y
    kept = ~((x > 0) & (y > 0)) | (rng.random(len(x)) < 0.5)
    dark = ae.reconstruct(cone[kept], **SHANK).density_map(24)
    half = len(dark.edges) // 2
    assert np.nanmean(dark.values[half:, half:]) / np.nanmean(dark.values[:half, :half]) == pytest.approx(0.5, abs=0.05)
    # of mean 7/8: deviations of 1/7 in three quarters and 3/7 in one
    assert dark.contrast == pytest.approx(math.sqrt(3) / 7, abs=0.03)


@pytest.mark.parametrize(("widening", "is_right"), [(0.5, True), (-0.5, False)])
def test_the_density_of_a_cap_that_widens_is_that_of_points_between_two_spheres(rng, widening, is_right):
    """Atoms between the cap and the next one, which is lower by dz and wider by dz / 2, drawn in space."""
    step, growth, rim = 1e-3, 0.5, 0.7
    directions = rng.normal(size=(800_000, 3))
    directions = directions[directions[:, 2] > 0]
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    depth = 1.5 * step * rng.random(len(directions))  # in a thin shell, whose volume is even but for 3e-3
    atoms = directions * (1 - depth)[:, None]
    next_centre = [0.0, 0.0, -(step + growth * step)]  # its apex is lower by the step
    gone = np.linalg.norm(atoms - next_centre, axis=1) > 1 + growth * step
    found = density_of(atoms[gone][:, :2], rim, widening, 6)
    inside = np.isfinite(found.expected)
    chi2 = ((found.ions - found.expected)[inside] ** 2 / found.expected[inside]).mean()
    # mean of 24 cells: 1 with a standard deviation of 0.3, four times; the wrong sign changes the cells, of some 2,300
    # ions, by 10 % on average: 23
    assert chi2 < 2.2 if is_right else chi2 > 6


def test_the_wide_angle_protocol_is_that_of_the_cap(cone):
    with pytest.raises(ValueError, match='public descriptions of wide-angle increments are that of "cap"'):
        ae.reconstruct(cone, **SHANK, protocol="geiser")


def test_the_centre_and_a_wide_field_of_view():
    hits = ae.Hits(x=[0.0, 3.0], y=[0.0, 4.0])
    result = ae.reconstruct(hits, atomic_volume=VOLUME, distance=DISTANCE, radius=30.0)
    assert np.array_equal(result.positions[0], [0, 0, 0])
    assert result.geometry.field_of_view == 5.0
    for compression, distance in ((1.5, 2.0), (8.0, 5.0)):
        with pytest.raises(ValueError, match="all angles on the cap must be < 90 degrees, got"):
            ae.reconstruct(hits, atomic_volume=VOLUME, distance=distance, compression=compression, radius=30.0)
    with pytest.raises(ValueError, match="detector_radius or area is needed"):
        ae.reconstruct(hits[:1], atomic_volume=VOLUME, distance=DISTANCE, radius=30.0)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({}, 'radius="voltage" needs evaporation_field, got evaporation_field=None'),
        ({"radius": "shank", "shank_angle": 3.0}, 'radius="shank" needs initial_radius and shank_angle, got init'),
        (
            {"radius": 30.0, "shank_angle": 3.0},
            'shank_angle is for radius="shank", got shank_angle=3.0 and given radii',
        ),
        ({"evaporation_field": FIELD}, "has no column 'voltage'"),
        ({"radius": 30.0, "area": 50.0}, "detector_radius and area exclude each other, got 38.0 mm and 50.0 mm^2"),
        (
            {"distance": 35.0, "radius": "shank", "initial_radius": 9.0, "shank_angle": 44.0},
            "the shank must be narrower than the field",
        ),
    ],
)
def test_choices_that_do_not_fit_together(cone, options, sentence):
    with pytest.raises(ValueError, match=sentence.replace("(", r"\(").replace("^", r"\^")):
        ae.reconstruct(cone[:100], **KNOWN | options)


def test_voltages_that_are_none(cone):
    hits = ae.Hits(x=cone.x[:3], y=cone.y[:3], voltage=[2e3, 0.0, 2e3], pulse_voltage=[4e2, 0.0, 4e2])
    with pytest.raises(ValueError, match="the voltage of every ion must be finite and > 0, got 0 V for ion 1"):
        ae.reconstruct(hits, **KNOWN, evaporation_field=FIELD)


@pytest.mark.filterwarnings("ignore::apt_evap.warnings.DataWarning")
def test_files_of_a_reconstruction(cone, tmp_path):
    cone = cone[:500]
    hits = ae.Hits(x=cone.x, y=cone.y, mass_to_charge=np.full(500, 27.0), positions=np.zeros((500, 3)))
    hits = replace(hits, pulse_id=np.arange(500))
    result = ae.reconstruct(hits, **SHANK)
    assert not result.hits.positions.any()
    assert np.array_equal(result.to_hits().positions, result.positions)
    for suffix in (".pos", ".epos"):
        ae.write(tmp_path / f"a{suffix}", result.to_hits())
        ions = ae.read(tmp_path / f"a{suffix}")
        assert np.array_equal(ions.positions, result.positions.astype(np.float32))
        assert (ions.mass_to_charge == 27.0).all()
    ae.write(tmp_path / "out.pos", result.to_hits("specimen"))
    outwards = ae.read(tmp_path / "out.pos").positions
    assert np.array_equal(outwards, result.specimen_positions.astype(np.float32)) and outwards[:, 2].max() <= 0
    ae.write(tmp_path / "a.xyz", result.to_hits(), species="Al")
    ae.write(tmp_path / "a.vtp", result.to_hits())
    assert (tmp_path / "a.xyz").read_text().startswith("500\n")
    assert repr(result).startswith("<Reconstruction: 500 ions, ") and "cap, bas, R 30.0 to 30.0 nm (shank)" in repr(
        result
    )
    for copied in (pickle.loads(pickle.dumps(result)), copy.deepcopy(result)):
        assert copied.settings == result.settings and np.array_equal(copied.positions, result.positions)


def test_settings_as_an_object_or_as_keywords(cone):
    hits = replace(cone[:2000], voltage=np.linspace(2000.0, 2100.0, 2000))
    settings = ae.reconstruction.ReconstructionSettings(distance=DISTANCE, element="Al", detector_radius=RIM)
    result = ae.reconstruct(hits, settings, compression=XI)
    aluminium = ae.material("Al")
    known = {"atomic_volume": aluminium.a**3 / 4, "evaporation_field": aluminium.evaporation_field}
    by_name = ae.reconstruct(hits, **KNOWN | known)
    assert result.positions == pytest.approx(by_name.positions, rel=1e-12)  # a^3 / 4 against 1 / (4 / a^3)
    assert np.array_equal(
        ae.reconstruct(hits, element="Al", **{**KNOWN, "atomic_volume": None}).positions, result.positions
    )
    # the settings of a result repeat it, and nothing of them depends on defaults
    again = ae.reconstruct(hits, result.settings)
    assert np.array_equal(again.positions, result.positions) and again.settings == result.settings
    used = (result.settings.projection, result.settings.field_factor, result.settings.evaporation_field)
    assert used == ("bas", 3.3, aluminium.evaporation_field)
    assert settings.compression is None  # the object is as it was
    with pytest.raises(ValueError, match=r"has no 'compresion' \(did you mean 'compression'"):
        ae.reconstruct(hits, settings, compresion=1.5)
    with pytest.raises(ValueError, match=r"has no 'compresion' \(did you mean 'compression'"):
        ae.reconstruct(hits, **KNOWN, compresion=1.5)
    with pytest.raises(ValueError, match="must have distance"):
        ae.reconstruct(hits, element="Al")
    with pytest.raises(ValueError, match=r"atomic_volume .* or element must be given, got None"):
        ae.reconstruct(hits, distance=90.0, radius=30.0)


def test_settings_with_radii_of_the_ions_are_compared_and_kept(cone):
    radii = np.linspace(30.0, 31.0, 1000)
    first, same, other = (
        ae.reconstruction.ReconstructionSettings(distance=DISTANCE, atomic_volume=VOLUME, radius=values)
        for values in (radii, radii.copy(), radii + 1)
    )
    assert first == same and first != other and first != replace(first, radius=30.0)
    expected = ae.reconstruct(cone[:1000], first).positions
    radii[:] = 1.0  # of the user, after the settings were made
    assert np.array_equal(ae.reconstruct(cone[:1000], first).positions, expected)
    with pytest.raises(ValueError, match="radius must have shape"):
        ae.reconstruct(cone[:999], first)
    assert from_plain(json.loads(json.dumps(to_plain(first))), type(first)) == first


def test_a_wrong_voltage_is_named_in_any_part(monkeypatch):
    monkeypatch.setattr(cap_geometry, "_PART", 4)
    hits = ae.Hits(x=np.arange(10.0), y=np.ones(10), voltage=np.where(np.arange(10) == 6, -2e3, 1e3))
    with pytest.raises(ValueError, match="got -1500 V for ion 6"):
        ae.reconstruct(replace(hits, pulse_voltage=np.full(10, 500.0)), element="Al", distance=DISTANCE)


def test_the_field_of_view_is_that_of_the_ions_that_hit():
    """Ions beyond an area that is given count for the largest angle."""
    x, outcome = np.array([3.0, 80.0, -20.0]), np.array([0, 1, 0])
    hits = ae.Hits(x=x, y=np.zeros(3), outcome=outcome)
    constants = {"atomic_volume": VOLUME, "distance": DISTANCE, "radius": 30.0}
    assert ae.reconstruct(hits, **constants).geometry.field_of_view == 20.0
    with pytest.raises(ValueError, match="all angles on the cap must be < 90 degrees"):
        ae.reconstruct(ae.Hits(x=10 * x, y=x), area=300.0, **constants)


@pytest.mark.parametrize("compression", [0.7, 1.0, 1.5, 2.0, 2.6])
def test_places_without_arcs_are_those_of_the_angles(rng, compression):
    """Up to a rim of 89 degrees, or a flight length of a third of the radius of the detector."""
    x, y = rng.normal(size=(2, 3000))
    radius = DISTANCE * np.linspace(0, 3, 3000) / np.hypot(x, y)
    hits = ae.Hits(x=radius * x, y=radius * y)
    result = ae.reconstruct(hits[:100], radius=30.0, **KNOWN | {"compression": compression, "detector_radius": 20.0})
    _, angles = result.geometry.places(hits, np.empty(0))
    hits = hits[angles < math.radians(89)]
    places, angles = result.geometry.places(hits, np.empty(0))
    (found_x, found_y), below = result.geometry._projected(hits, slice(None))
    np.testing.assert_allclose(np.column_stack([found_x, found_y]), places, rtol=0, atol=2e-15)  # some roundings
    np.testing.assert_allclose(below, 2 * np.sin(angles / 2) ** 2, rtol=1e-13, atol=1e-15)
    assert np.degrees(angles.max()) > 50
