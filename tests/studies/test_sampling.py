"""Samples of a study: the same points for the same text, and the first ones for more samples."""

import numpy as np
import pytest

import apt_evap as ae
from apt_evap._common.files import FileError
from apt_evap.studies.sweep.sampling import RandomAxis, drawn, has_options, option_of, sobol
from apt_evap.studies.sweep.study_file import read_study

BASE = '[tip]\nmaterial = "Ni"\napex_radius = "8 a"\nseed = 7\n[simulation]\nions = 100\nseed = 7\n'
STUDY = """
base = "base.toml"
sample = 5
seed = 3
[sweep]
"tip.axis" = "random"
"tip.material" = { choice = ["Ni", "Al", "Ti"] }
"tip.apex_radius" = { uniform = ["8 a", "10 a"] }
"tip.solutes.Si" = { log_uniform = [1e-3, 0.1] }
"simulation.ions" = { integer = [2, 5] }
"""


@pytest.fixture
def study(tmp_path):
    """Function of the text of a study that reads it."""

    def read(text, base=BASE):
        (tmp_path / "base.toml").write_text(base)
        (tmp_path / "study.toml").write_text(text)
        return read_study(tmp_path / "study.toml")

    return read


def test_more_samples_keep_the_first_ones(study):
    few = study(STUDY)
    many = study(STUDY.replace("sample = 5", "sample = 11"))
    assert len(few.points) == 5 and len(many.points) == 11
    assert [point.key for point in many.points[:5]] == [point.key for point in few.points]
    other = study(STUDY.replace("seed = 3", "seed = 4"))
    assert not {point.key for point in other.points} & {point.key for point in few.points}


def test_points_are_the_same_everywhere(study):
    """Key of the first point, as on the machine where the test was written: data sets would change otherwise."""
    first = study(STUDY).points[0]
    assert first.values["tip.apex_radius"] == "8.75647 a"
    assert first.values["tip.axis"] == [1.14652, 0.53713, 0.07136]  # titanium
    assert first.key == "e947a9d47b59"


def test_values_are_in_their_ranges(study):
    points = study(STUDY.replace("sample = 5", "sample = 64")).points
    values = {path: [point.values[path] for point in points] for path in points[0].values}
    radii = [float(text.removesuffix(" a")) for text in values["tip.apex_radius"]]
    assert 8 <= min(radii) and max(radii) <= 10
    # Sobol' points: one in each 64th of every coordinate
    assert sorted(int((radius - 8) * 32) for radius in radii) == list(range(64))
    solutes = np.log10(values["tip.solutes.Si"])
    assert sorted((32 * (solutes + 3)).astype(int)) == list(range(64))
    assert {number: values["simulation.ions"].count(number) for number in range(2, 6)} == dict.fromkeys(range(2, 6), 16)
    assert set(values["tip.material"]) == {"Ni", "Al", "Ti"}
    assert len(set(values["simulation.seed"])) == len(set(values["tip.seed"])) == 64
    for point, config in zip(points, study(STUDY.replace("sample = 5", "sample = 64")).configs, strict=True):
        radius = float(point.values["tip.apex_radius"].removesuffix(" a"))
        assert config.tip["apex_radius"] == radius * ae.material(point.values["tip.material"]).a


def test_lists_are_combined_with_each_sample(study):
    text = 'base = "base.toml"\nsample = 3\n[sweep]\n"tip.axis" = [[0, 0, 1], [1, 1, 1]]\n'
    points = study(text).points
    assert [point.values["tip.axis"] for point in points] == [[0, 0, 1], [1, 1, 1]] * 3
    seeds = [point.values["simulation.seed"] for point in points]
    assert seeds[0::2] == seeds[1::2] and len(set(seeds)) == 3
    own = study(text + '"tip.offset_seed" = [1]\n"simulation.seed" = [2]\n').points
    assert {point.values["tip.offset_seed"] for point in own} == {1}
    assert {point.values["simulation.seed"] for point in own} == {2}
    at = study(text, BASE.replace("seed = 7", "origin = [0.1, 0.0, 0.0]", 1)).points
    assert all("tip.offset_seed" not in point.values for point in at)


def test_random_axes_are_uniform_in_the_standard_triangle():
    u = np.random.default_rng(1).random((4000, 2))
    cubic = np.array([RandomAxis(*pair).of(ae.material("W")) for pair in u])
    assert (cubic[:, 0] >= 0).all() and (np.diff(cubic, axis=1) >= 0).all()
    # the mean of the largest of the components of a random direction is that of |n|: 48 triangles of equal area
    directions = np.random.default_rng(2).normal(size=(100_000, 3))
    largest = np.abs(directions / np.linalg.norm(directions, axis=1)[:, None]).max(axis=1)
    # five standard errors of 4,000
    assert cubic[:, 2].mean() == pytest.approx(largest.mean(), abs=5 * largest.std() / np.sqrt(4000))
    titanium = ae.material("Ti")
    vectors = [ae.Orientation(titanium, axis=RandomAxis(*pair).of(titanium)) for pair in u[:300]]
    along = np.array([each.matrix[2] for each in vectors])  # the axis in the frame of the crystal
    azimuth = np.degrees(np.arctan2(along[:, 1], along[:, 0]))
    assert azimuth.min() > -0.01 and azimuth.max() < 30.01  # rounding of the indices
    assert along[:, 2].mean() == pytest.approx(0.5, abs=5 * np.sqrt(1 / 12 / 300))  # z of a sphere is uniform


def test_sobol_points_are_a_sequence():
    assert np.array_equal(sobol(300, 4, 1), sobol(600, 4, 1)[:300])
    assert sobol(3, 0, 1).shape == (3, 0)


def test_ranges_in_a_table_are_drawn():
    table = {"name": "RollUp", "energy": {"uniform": [0.1, 0.2]}, "more": [{"choice": [3]}, 4]}
    assert has_options(table) and not has_options({"uniform": [1, 2], "name": "a"})
    one, other = (drawn(table, np.random.default_rng(seed), "emission") for seed in (1, 1))
    assert one == other and 0.1 <= one["energy"] <= 0.2
    assert one["more"] == [3, 4]


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ('sample = 0\n[sweep]\n"tip.axis" = "random"', "sample"),
        ('[sweep]\n"tip.axis" = "random"', "tip.axis"),
        ('[sweep]\n"tip.shank_angle" = { uniform = [1, 2] }', "sample"),
        ('seed = 1\n[sweep]\n"tip.axis" = [[0, 0, 1]]', "seed"),
        ('sample = 2\nseed = -1\n[sweep]\n"tip.axis" = "random"', "seed"),
        ('sample = 2\n[sweep]\n"tip.axis" = "any"', "tip.axis"),
        ('sample = 2\n[sweep]\n"tip.rotation" = "random"', "tip.rotation"),
        ('sample = 2\n[sweep]\n"tip.shank_angle" = { unifrom = [1, 2] }', "uniform"),
        ('sample = 2\n[sweep]\n"tip.shank_angle" = { uniform = [2, 1] }', "tip.shank_angle"),
        ('sample = 2\n[sweep]\n"tip.apex_radius" = { uniform = ["8 a", "3 nm"] }', "tip.apex_radius"),
        ('sample = 2\n[sweep]\n"tip.apex_radius" = { uniform = ["8 a", 9] }', "tip.apex_radius"),
        ('sample = 2\n[sweep]\n"tip.shank_angle" = { log_uniform = [0, 1] }', "tip.shank_angle"),
        ('sample = 2\n[sweep]\n"simulation.ions" = { integer = [1, 2.5] }', "simulation.ions"),
        ('sample = 2\n[sweep]\n"tip.material" = { choice = [] }', "tip.material"),
        ('sample = 60_000\n[sweep]\n"tip.axis" = [[0, 0, 1], [1, 1, 1]]', "100,000"),
    ],
)
def test_mistakes_name_the_setting(study, text, name):
    with pytest.raises(FileError, match=name):
        study(f'base = "base.toml"\n{text}\n')


def test_an_option_keeps_to_its_bounds():
    option = option_of({"integer": [1, 2]}, "n")
    assert (option.value([0.0]), option.value([1 - 2**-30])) == (1, 2)
    assert option_of({"uniform": [0.1, 0.3]}, "x").value([0.0]) == 0.1
