"""Master patterns: folded densities against direct sums, symmetry, files, and maps drawn from them."""

import numpy as np
import pytest
from rough import ROUGH

import apt_evap as ae
from apt_evap.maps.indexing.master_pattern import HALF, MasterPattern, master_patterns, sampled
from apt_evap.specimen.symmetry import point_group


@pytest.fixture(scope="session")
def run_of(nickel, made_once):
    """Function of a number of ions: their run."""
    tip = ae.Tip(nickel, 9 * nickel.a, axis=(0.36, 0.52, 0.775), shank_length=12 * nickel.a, offset_seed=1)
    detector = ae.Detector(distance=100.0, width=500.0, projection="equidistant")
    emissions = [ae.LateralVelocity(0.2), ae.RollUp(0.2), ae.Unperturbed()]
    options = {"responses": False, "seed": 1, "detector": detector, "flight_settings": ROUGH["flight_settings"]}
    return lambda ions: made_once(tip, ions, emissions, **options)


@pytest.fixture(scope="session")
def run(run_of):
    return run_of(3_000)


@pytest.fixture(scope="session")
def few(run_of):
    return run_of(1_500)


def random_directions(rng, n):
    vectors = rng.normal(size=(n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("structure", ["fcc", "bcc", "diamond", "hcp"])
def test_the_patterns_of_the_package_have_the_symmetry_of_their_crystal(structure, rng):
    directions = random_directions(rng, 400)
    for pattern in master_patterns(structure):
        assert pattern.structure == structure
        smooth = pattern.at(directions, sigma=2.0)
        for member in point_group(structure)[::5]:
            # pixels of the disc are sheared towards the equator: interpolation changes noise, not structure
            assert np.abs(pattern.at(directions @ member.T, sigma=2.0) - smooth).mean() < 0.03
        assert np.allclose(
            pattern.at(np.concatenate([directions, -directions])).reshape(2, 2, -1)[:, 0], pattern.at(directions)
        )
        # uniform directions: the mean over the sphere is 1 by definition
        assert pattern.at(random_directions(rng, 20_000)).mean(axis=1) == pytest.approx([1, 1], abs=0.02)


def test_large_tips_have_narrow_poles():
    around = np.radians(np.arange(0.0, 15.0, 0.25))
    towards = np.array([1.0, 0.7, 0.1])
    pole = np.ones(3) / np.sqrt(3)
    towards -= pole * (pole @ towards)
    towards /= np.linalg.norm(towards)
    small, _, large = (
        pattern.at(np.cos(around)[:, None] * pole + np.sin(around)[:, None] * towards, sigma=0.7)[0]
        for pattern in master_patterns("fcc")
    )
    # a facet of height d is sqrt(2 d / R) wide: half as wide for four times the radius
    edges = [np.interp(0.5, each[: np.argmax(each > 0.8)], around[: np.argmax(each > 0.8)]) for each in (small, large)]
    assert 0.35 < edges[1] / edges[0] < 0.75


@pytest.mark.slow
def test_a_pattern_is_the_direct_sum_over_the_point_group(run):
    pattern = ae.fit.master_pattern(run)
    assert pattern.structure == "fcc" and pattern.apex_radius == 9 and pattern.ions == 3_000
    orientation = ae.Orientation.from_settings(run.settings["tip"])
    projection = ae.simulation.image_compression(run).projection
    hits = run.hits(run.perturbations[0])
    directions = projection.directions(np.column_stack([hits.x, hits.y])[hits.detected])
    crystal = directions[directions[:, 2] > np.cos(np.radians(50))] @ orientation.matrix
    group = point_group("fcc")

    def density(centre):
        """Counts over exposure within 6 degrees, with a decrease that is constant."""
        near = np.cos(np.radians(6.0))
        counts = sum(np.count_nonzero(crystal @ (member @ centre) > near) for member in group)
        around = random_directions(np.random.default_rng(2), 200_000)
        around = around[around @ centre > near]
        seen = sum(
            np.mean((around @ member.T) @ orientation.matrix.T[:, 2] > np.cos(np.radians(50))) for member in group
        )
        return counts / seen

    def mean(centre):
        around = random_directions(np.random.default_rng(3), 200_000)
        return pattern.at(around[around @ centre > np.cos(np.radians(6.0))])[0].mean()

    centres = [np.array(each) / np.linalg.norm(each) for each in ((1, 1, 1), (1, 2, 4), (1, 1, 3), (0, 2, 5))]
    direct, folded = (np.array([each(centre) for centre in centres]) for each in (density, mean))
    # some thousand counts each, some hundred in the dark pole; the decrease over 50 degrees is a few per cent
    assert folded / folded.mean() == pytest.approx(direct / direct.mean(), rel=0.1, abs=0.06)


def test_a_saved_pattern_is_read_back(few, tmp_path):
    pattern = ae.fit.master_pattern([few])
    pattern.save(tmp_path / "mine.npz")
    again = MasterPattern.load(tmp_path / "mine.npz")
    assert (again.structure, again.apex_radius, again.ions) == ("fcc", 9.0, 1_500)
    # 255 levels of the square root up to 8
    clipped = np.minimum(pattern.densities, 8.0)
    assert np.abs(np.sqrt(again.densities) - np.sqrt(clipped)).max() <= 0.5 * np.sqrt(8) / 255 + 1e-9
    again.save(tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == (tmp_path / "mine.npz").read_bytes()


def test_a_part_of_a_pattern_ends_with_its_last_pixels():
    part = np.arange(16.0).reshape(1, 4, 4)
    towards_x, towards_y = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    found = sampled(part, np.stack([towards_x, towards_y, towards_x + towards_y]), (HALF, HALF))[0]
    assert found == pytest.approx([3.0, 12.0, 15.0])


def test_a_map_has_the_ions_and_the_poles_of_its_pattern():
    pattern = master_patterns("bcc")[0]
    orientation = ae.Orientation("W", axis=(0, 1, 1))
    projection = ae.detection.Projection(50.0)
    made = pattern.map(orientation, projection, 60.0, ions=200_000, seed=3)
    assert made.ions == pytest.approx(200_000, abs=4 * np.sqrt(200_000))
    x, y = np.meshgrid(*made.centres)
    r = np.hypot(x, y)
    assert made.values[r < 2].mean() < 0.3 * made.values[(r > 8) & (r < 20)].mean()  # the pole on the axis is dark
    assert not made.mask[r > 30.5].any()
    assert np.array_equal(made.values, pattern.map(orientation, projection, 60.0, ions=200_000, seed=3).values)


def test_bad_arguments_are_named(few):
    pattern = master_patterns("fcc")[0]
    with pytest.raises(ValueError, match="sc"):
        master_patterns("sc")
    with pytest.raises(ValueError, match="emissions"):
        ae.fit.master_pattern(few, [ae.Unperturbed()])
    with pytest.raises(ValueError, match="runs"):
        ae.fit.master_pattern([3])
    with pytest.raises(ValueError, match="rolled"):
        pattern.map(ae.Orientation("Ni"), ae.detection.Projection(50.0), 60.0, ions=10, rolled=2.0)
    with pytest.raises(ValueError, match="densities"):
        MasterPattern("fcc", 20.0, np.zeros((2, 3, 3)), 10)
