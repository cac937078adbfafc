"""Point clouds: selection, molecules, profiles, the proxigram of a blurred ball, columns of clusters."""

import numpy as np
import pytest
from rough import ROUGH
from scipy.special import erf

import apt_evap as ae
from apt_evap.measures.interface import CompositionProfile

RADIUS, BLUR = 2.0, 0.3  # nm


def blurred_ball(seed, ions=100_000, inside=0.8, outside=0.05):
    """Ions in a box: copper within a ball, then all positions with a Gaussian error."""
    rng = np.random.default_rng(seed)
    sites = 9 * rng.random((ions, 3)) - 4.5
    copper = rng.random(ions) < np.where(np.linalg.norm(sites, axis=1) < RADIUS, inside, outside)
    positions = sites + BLUR * rng.normal(size=sites.shape)
    return ae.measures.PointCloud(positions, copper.astype(int), ["Al", "Cu"])


def blurred_fraction(distance):
    """Fraction of what was in the ball, at a distance from its surface: the ball convolved with a Gaussian."""
    r, s = RADIUS + distance, BLUR
    shell = (erf((RADIUS - r) / (np.sqrt(2) * s)) + erf((RADIUS + r) / (np.sqrt(2) * s))) / 2
    tails = np.exp(-((RADIUS - r) ** 2) / (2 * s * s)) - np.exp(-((RADIUS + r) ** 2) / (2 * s * s))
    return shell - s / (r * np.sqrt(2 * np.pi)) * tails


def test_the_proxigram_of_a_ball_is_its_convolution():
    profile = blurred_ball(1).proxigram(surface=ae.specimen.Sphere((0, 0, 0), RADIUS), step=0.1, reach=1.5)
    copper = profile.of("Cu")
    expected = 0.05 + 0.75 * blurred_fraction(copper.centres)
    errors = np.sqrt(expected * (1 - expected) / copper.ions)
    chi2 = (((copper.fraction - expected) / errors) ** 2).sum()
    assert len(copper.ions) == 30 and 12 < chi2 < 57  # 30 degrees of freedom, with probabilities of 0.1 % outside


@pytest.mark.slow
def test_the_proxigram_about_the_isosurface_differs_by_the_shift_of_the_surface():
    cloud = blurred_ball(1, 60_000)
    profile = cloud.proxigram("Cu", 0.425, voxel=0.4, delocalisation=0.4, step=0.1, reach=1.5, largest=True)
    fit = ae.measures.interface_profile(
        profile.coordinates[np.isfinite(profile.coordinates)],
        cloud.mark("Cu")[np.isfinite(profile.coordinates)],
        reach=1.5,
    )
    # delocalisation and voxels move the surface inward by their variance over the radius beyond the blur alone
    assert fit.centre == pytest.approx((0.4**2 + 0.4**2 / 12) / RADIUS, abs=0.05)
    # the surface follows the noise of the counts, by less than the blur
    assert fit.sigma == pytest.approx(BLUR, abs=0.06)
    assert fit.before == pytest.approx(0.8, abs=0.04) and fit.after == pytest.approx(0.05, abs=0.01)
    assert profile.area == pytest.approx(4 * np.pi * (RADIUS - 0.12) ** 2, rel=0.12)


def test_ions_beyond_the_rim_of_a_surface_do_not_count():
    cloud = blurred_ball(4, 20_000)
    square = ae.measures.TriangleMesh([[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]], [[0, 1, 2], [0, 2, 3]])
    profile = cloud.proxigram(surface=square, reach=1.0, step=0.5)
    x, y, z = cloud.positions.T
    above = (np.abs(x) < 2) & (np.abs(y) < 2)
    assert np.array_equal(profile.atoms.sum(axis=1), np.histogram(z[above], profile.edges)[0])
    assert profile.area == pytest.approx(16.0)


def test_selections_by_regions():
    cloud = blurred_ball(2, 5000)
    ball, layer = ae.specimen.Sphere((0, 0, 0), 2.0), ae.specimen.Layer(-1.0, 1.0)
    assert len(cloud.select(ball)) == (np.linalg.norm(cloud.positions, axis=1) <= 2.0).sum()
    assert np.array_equal(cloud.select(layer).positions, cloud.select(np.abs(cloud.positions[:, 2]) <= 1.0).positions)
    assert len(cloud.select(lambda points: points[:, 0] > 0)) == (cloud.positions[:, 0] > 0).sum()
    assert len(cloud.select(slice(10))) == 10 and len(cloud.select([3, 1])) == 2
    assert len(cloud.select(cloud.hull)) == 5000
    assert cloud.select(ball).fractions()["Cu"].value == pytest.approx(
        cloud.mark("Cu")[np.linalg.norm(cloud.positions, axis=1) <= 2.0].mean()
    )


def test_an_open_surface_is_told():
    cloud = blurred_ball(2, 5000)
    corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    faces = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    inside = (cloud.positions >= 0).all(axis=1) & (cloud.positions.sum(axis=1) <= 1)
    assert np.array_equal(cloud.select(ae.measures.TriangleMesh(corners, faces)).positions, cloud.positions[inside])
    with pytest.warns(ae.warnings.DataWarning, match="where is an open surface"):
        cloud.select(ae.measures.TriangleMesh(corners, faces[1:]))


def test_molecules_are_taken_apart():
    cloud = ae.measures.PointCloud(
        np.arange(15.0).reshape(5, 3) ** 1.5,
        [0, 0, 1, 2, -1],
        ["Cr", "CrO2", "N2"],
        [{"Cr": 1}, {"Cr": 1, "O": 2}, {"N": 2}],
    )
    assert cloud.count_atoms() == {"Cr": 3, "O": 2, "N": 2}
    assert cloud.mark("Cr").tolist() == [True, True, True, False, False]
    assert cloud.mark(["CrO2", "N"]).tolist() == [False, False, True, True, False]
    assert cloud.fractions()["O"].value == pytest.approx(2 / 7)
    assert cloud.fractions()["O"].error == pytest.approx(np.sqrt(2 / 7 * 5 / 7 / 7))
    assert cloud.profile(step=100.0).atoms.sum(axis=0).tolist() == [3, 2, 2]
    assert "in no range 1" in repr(cloud)
    field = cloud.field("O", voxel=100.0, delocalisation=0.0)
    assert field.fraction[1, 1, 1] == pytest.approx(2 / 7)


def test_ions_of_files_with_ranges():
    ranges = ae.spectra.Ranges(
        ["CrO", "Cr", "CrO"],
        [67.0, 51.0, 33.0],
        [69.0, 53.0, 35.0],
        composition=[{"Cr": 1, "O": 1}, {"Cr": 1}, {"Cr": 1, "O": 1}],
    )
    ions = ae.Hits(positions=[[0, 0, 0], [0, 0, 1], [0, np.nan, 0], [1, 1, 1.0]], mass_to_charge=[68, 52, 52, 99.0])
    cloud = ae.measures.PointCloud.of(ions, ranges)
    assert len(cloud) == 3 and cloud.species.tolist() == [0, 1, -1]
    assert cloud.count_atoms() == {"Cr": 2, "O": 1}
    assert ae.measures.PointCloud.of(ions).names == ("ion",)
    with pytest.raises(ValueError, match="positions"):
        ae.measures.PointCloud.of(ae.Hits(x=[0.0], y=[1.0]))


def test_a_profile_counts_all_ions_of_a_region():
    cloud = blurred_ball(3, 20_000)
    tube = ae.specimen.Cylinder((0, 0, 0), 1.0, axis=(1, 0, 0))
    profile = cloud.profile((2, 0, 0), step=0.5, region=tube)
    assert profile.atoms.sum() == len(cloud.select(tube))
    assert profile.of("Cu").fraction[len(profile.centres) // 2] > 0.7
    assert profile.fractions.sum(axis=1) == pytest.approx(1.0)


def test_columns_of_clusters():
    rng = np.random.default_rng(5)
    matrix = 10 * rng.random((20_000, 3))
    balls = [
        centre + radius * rng.normal(size=(n, 3)) / np.sqrt(5)
        for centre, radius, n in (([3, 3, 3], 1.0, 300), ([7, 7, 7], 0.8, 150), ([5, 5, 10], 0.8, 150))
    ]
    cloud = ae.measures.PointCloud(
        np.concatenate([matrix, *balls]), np.r_[np.zeros(20_000, int), np.ones(600, int)], ["Al", "Cu"]
    )
    clusters = cloud.clusters("Cu", 0.5, 20)
    assert len(clusters) == 3
    assert np.array_equal(clusters.at_edge, clusters.centres[:, 2] > 9)  # the one cut by the face
    assert clusters.solutes[0] > 290
    np.testing.assert_allclose(clusters.centres[0], [3, 3, 3], atol=0.1)  # 0.45 / sqrt(300) = 0.03 nm
    assert clusters.radii[0] == pytest.approx(1.0, abs=0.12)  # 0.03 nm by counting, and strays beyond 0.5 nm
    density = clusters.number_density(1000.0)
    assert density.value == pytest.approx(2.5e-3) and density.error == pytest.approx(np.sqrt(2.5) / 1000)
    wide = cloud.clusters("Cu", 0.5, 20, envelope=0.3, erosion=0.0)
    assert wide.sizes[0] > clusters.sizes[0] and np.array_equal(wide.solutes, clusters.solutes)
    assert wide.atoms.sum(axis=0)[1] / wide.atoms.sum() == cloud.mark("Cu")[wide.labels >= 0].mean()
    assert wide.atoms.sum() + sum(cloud.select(wide.labels < 0).count_atoms().values()) == len(cloud)
    np.testing.assert_allclose(wide.compositions.sum(axis=1), 1.0)
    assert wide.to_dict()["solutes"] == wide.solutes.tolist()


def balls_of(seed, radius, share, matrix, density):
    """Eight balls with a share of copper in a matrix with another one, in a cube of 9 nm."""
    rng = np.random.default_rng(seed)
    places = 9 * rng.random((int(density * 9**3), 3))
    centres = np.stack(np.meshgrid(*3 * [[2.25, 6.75]]), axis=-1).reshape(-1, 3)
    inside = np.linalg.norm(places[:, None] - centres, axis=2).min(axis=1) < radius
    copper = rng.random(len(places)) < np.where(inside, share, matrix)
    return ae.measures.PointCloud(places, copper.astype(int), ["Al", "Cu"])


@pytest.mark.parametrize(
    ("radius", "share", "matrix", "density", "d_max", "n_min", "bias", "rich"),
    [  # mean differences from the share of 30 other seeds: of these compositions, and of all ions of the clusters
        pytest.param(0.8, 0.25, 0.02, 48, 0.5, 12, 0.028, 0.26, marks=pytest.mark.slow),
        pytest.param(1.0, 0.37, 0.02, 48, 0.5, 18, 0.002, 0.12, marks=pytest.mark.slow),
        (0.8, 0.5, 0.02, 30, 0.5, 10, -0.015, 0.15),
        pytest.param(0.0, 0.03, 0.03, 48, 0.55, 6, 0.060, 0.57, marks=pytest.mark.slow),  # a random alloy
    ],
)
def test_solutes_that_made_a_cluster_do_not_count_in_its_composition(
    radius, share, matrix, density, d_max, n_min, bias, rich
):
    held, counted, errors = [], [], []
    for seed in range(6):
        clusters = balls_of(seed, radius, share, matrix, density).clusters("Cu", d_max, n_min)
        atoms = clusters.atoms.sum(axis=0)
        value, error = clusters.fractions()["Cu"]
        held.append(value - share)
        counted.append(atoms[1] / atoms.sum() - share)
        errors.append(error)
    assert np.mean(counted) == pytest.approx(rich, abs=0.06)
    assert np.mean(held) == pytest.approx(bias, abs=3 * np.mean(errors) / np.sqrt(6))
    assert 0.3 < np.std(np.array(held) / errors) < 1.6  # 0.6 to 1.0 in 30 seeds; of six 0.4 to 1.6 times that


def test_molecules_and_parts_of_a_composition():
    cloud = balls_of(1, 1.0, 0.5, 0.01, 48)
    oxide = ae.measures.PointCloud(cloud.positions, cloud.species, ["Al", "CuO"], [{"Al": 1}, {"Cu": 1, "O": 1}])
    plain, taken_apart = cloud.clusters("Cu", 0.45, 20), oxide.clusters("Cu", 0.45, 20)
    share = plain.compositions[:, 1]
    np.testing.assert_allclose(taken_apart.compositions[:, 1], share / (1 + share))  # two atoms of each solute
    np.testing.assert_allclose(taken_apart.compositions[:, 1], taken_apart.compositions[:, 2])
    assert plain.fractions()["Cu"].value == pytest.approx(share.mean(), abs=0.03)
    assert np.isnan(cloud.clusters("Cu", 0.45, 20, envelope=0.0).compositions).all()  # no ion between solutes
    whole = oxide.clusters("Cu", 2.0, 200, envelope=20.0, erosion=0.0)  # each half counts twice in one of two regions
    every = np.array(list(oxide.fractions().values()))
    np.testing.assert_allclose(whole.compositions[0], every[:, 0])
    np.testing.assert_allclose(whole.composition_errors[0], 1.25 * every[:, 1], rtol=0.01)  # of 35,000 atoms
    assert [error for _, error in whole.fractions().values()] == whole.composition_errors[0].tolist()
    pair = ae.measures.PointCloud(np.eye(4, 3), [1, 1, 1, 1], ["Al", "Cu"]).clusters("Cu", 2.0, 2)
    assert 0.1 < pair.fractions()["Cu"].error == pair.composition_errors[0, 1]  # two atoms of copper count, of two
    wide = cloud.clusters("Cu", 0.45, 20, envelope=0.6, erosion=0.0)
    assert wide.fractions()["Cu"].value < plain.fractions()["Cu"].value - 0.1  # the matrix around counts, too


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda c: c.clusters("Ag"), "solute must be one of Al, Cu, got 'Ag'"),
        (lambda c: c.select(c.species == 0).clusters("Cu"), "solute must mark at least one ion, got no Cu in"),
        (lambda c: c.select(c.species == 0).clusters(["Cu"]), "got no Cu in"),
        (lambda c: c.select([0, 1]).clusters("Al"), "at least 10 of the ions"),
        (lambda c: c.select([0, 1]).proxigram("Al", 0.5), "isovalue must be within|no Al in 2 ions"),
        (lambda c: c.proxigram("Cu", 0.999, delocalisation=1.0), "isovalue must be within the fractions of voxels"),
        (lambda c: c.proxigram("Cu"), "a proxigram needs a solute and an isovalue, or a surface"),
        (lambda c: c.proxigram(surface=lambda p: p), "surface must be a TriangleMesh, or a region"),
        (lambda c: c.profile((0, 0, 0)), "length of axis must be"),
        (lambda c: c.profile(region=ae.specimen.Sphere((99, 0, 0), 1)), "at least one ion in the region, got none"),
        (lambda c: c.select([0.5]), "where must"),
        (lambda c: ae.measures.PointCloud([[0, 0, 0]], [2], ["Al"]), "species must be from -1 to 0, got 2 to 2"),
        (lambda c: ae.measures.PointCloud([[0, 0, np.nan]], [0], ["Al"]), "positions must be finite"),
    ],
)
def test_wrong_arguments_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call(blurred_ball(1, 2000))


def test_sites_of_a_run_and_its_reconstruction():
    """The same measure of both: elements of two phases are one, and a perfect position has the same neighbours."""
    core = ae.specimen.Phase("core", "Ni", ae.specimen.Sphere((0, 0, 2.0), 0.8), solutes={"Al": 0.5})
    tip = ae.Tip(phases=[ae.specimen.Phase("matrix", "Ni", solutes={"Al": 0.05}), core], apex_radius=2.5, seed=1)
    run = ae.Simulation(tip, seed=1, flight_settings=ROUGH["flight_settings"]).run(
        200, [ae.Unperturbed()], responses=False, progress=False
    )
    sites = run.sites()
    assert sites.names == ("Ni", "Al") and len(sites) == 200
    assert sites.mark("Al").sum() == sum(run.elements[k] == "Al" for k in run.species)
    assert np.array_equal(sites.positions, run.emissions.positions)
    hits = run.hits(ae.Unperturbed())
    volume = ae.reconstruct(hits, radius=2.5, atomic_volume=0.011, distance=100.0, detector_radius=80.0)
    cloud = volume.cloud(frame="specimen")
    assert cloud.names == ("Al", "Ni") and np.array_equal(cloud.positions, volume.specimen_positions)
    assert cloud.mark("Al").sum() == (volume.hits.extra["element"] == "Al").sum()
    clusters = volume.clusters("Al", 0.3, 3)
    assert np.array_equal(clusters.members, volume.cloud().clusters("Al", 0.3, 3).members)
    profile = volume.proxigram(surface=ae.specimen.HalfSpace((0, 0, 0.3), (0, 0, 1)), reach=0.5)
    assert 0 < profile.atoms.sum() < len(volume)


def test_pictures():
    cloud = blurred_ball(3, 20_000)
    clusters = cloud.clusters("Cu", 0.4, 50)
    axes = ae.plot.clusters(clusters)
    assert axes[2].get_xlabel() == "solutes of a cluster" and axes[0].get_aspect() == 1
    axes[2].figure.draw_without_rendering()
    bars = [(bar.get_x(), bar.get_x() + bar.get_width(), bar.get_height()) for bar in axes[2].patches]
    for size in clusters.solutes.tolist():  # in the middle of whole numbers
        assert sum(height for left, right, height in bars if left < size < right) >= 1
    assert sum(height for *_, height in bars) == len(clusters)
    assert all(tick == round(tick) for tick in [*axes[2].get_xticks(), *axes[2].get_yticks()])
    ax = ae.plot.composition_profile(cloud.proxigram(surface=ae.specimen.Sphere((0, 0, 0), RADIUS)), "Cu")
    (line,) = (container[0] for container in ax.containers)
    x, y = line.get_data()
    inner = y[(x > -1.2) & (x < -0.6)].mean()
    assert inner == pytest.approx(80 - 3, abs=4)  # per cent; two and more blurs inside, 500 ions: three errors of 1.8
    atoms = np.array([[0, 1], [80, 20], [0, 0]])
    profile = CompositionProfile(np.arange(4.0), ("Al", "Cu"), atoms, np.zeros(101))
    ax = ae.plot.composition_profile(profile, "Cu")
    (segments,) = (container[2][0].get_segments() for container in ax.containers)
    assert segments[0][:, 1].tolist() == [50, 100]  # a single atom
    # (20.5 ± sqrt(16.25)) / 101: of many atoms nearly one standard deviation, 4 %
    np.testing.assert_allclose(segments[1][:, 1], [16.3058, 24.2882], atol=1e-4)
    with pytest.raises(ValueError, match="elements must be one of Al, Cu, got 'Ag'"):
        ae.plot.composition_profile(cloud.profile(), "Ag")
    with pytest.raises(ValueError, match="result must be Clusters"):
        ae.plot.clusters(cloud)
