import json
import tomllib

import pytest
from sweeps import BASE

from apt_evap._common.files import FileError
from apt_evap.simulation.config.simulation_file import key_of
from apt_evap.studies.sweep.planning import plan_sweep
from apt_evap.studies.sweep.study_file import JobSettings, read_study, value_at, with_values


@pytest.fixture
def study(tmp_path):
    """Function of the text of a study that reads it."""
    (tmp_path / "base.toml").write_text(BASE)

    def read(text, base="base.toml"):
        (tmp_path / "study.toml").write_text(f'base = "{base}"\n{text}')
        return read_study(tmp_path / "study.toml")

    return read


def test_all_combinations_and_single_points(study):
    read = study(
        '[sweep]\n"tip.axis" = [[0, 0, 1], [1, 1, 1]]\n"tip.offset_seed" = [1, 2]\n'
        '[[points]]\n"tip.apex_radius" = "9 a"\n[[points]]\n"law" = {name = "Arrhenius", temperature = 50.0}\n'
    )
    values = [point.values for point in read.points]
    assert values[:4] == [
        {"tip.axis": axis, "tip.offset_seed": seed} for axis in ([0, 0, 1], [1, 1, 1]) for seed in (1, 2)
    ]
    assert values[4:] == [{"tip.apex_radius": "9 a"}, {"law": {"name": "Arrhenius", "temperature": 50.0}}]
    assert read.points[2].document["tip"] == {
        "material": "Ni",
        "apex_radius": "8 a",
        "shank_length": "8 a",
        "axis": [1, 1, 1],
        "offset_seed": 1,
    }
    assert read.configs[5].law.temperature == 50.0
    assert len({point.key for point in read.points}) == 6
    assert read.job == JobSettings()


def test_a_point_is_there_once(study):
    read = study('[sweep]\n"tip.offset_seed" = [1, 2, 1]\n[[points]]\n"tip.offset_seed" = 2\n')
    assert [point.values for point in read.points] == [{"tip.offset_seed": 1}, {"tip.offset_seed": 2}]


def test_the_key_is_that_of_the_settings_of_the_simulation():
    document = {"tip": {"material": "Ni", "apex_radius": 3.0}, "simulation": {"ions": 10}}
    key = key_of(document)
    assert key == "137ba01a1ee7"  # as in studies of earlier versions, whose runs would be lost otherwise
    same = {"simulation": {"ions": 10}, "tip": {"apex_radius": 3, "material": "Ni"}, "output": "x.h5"}
    assert key_of(same) == key
    assert key_of(document | {"maps": {"bins": 3}}) == key
    assert key_of(with_values(document, {"tip.apex_radius": 3.1})) != key
    assert key_of(with_values(document, {"simulation.seed": 0})) != key
    flown = with_values(document, {"simulation.responses": False})  # the perturbations of the maps are flown
    assert key_of(flown | {"maps": {"bins": 3}}) != key_of(flown)


def test_with_values_leaves_the_settings_alone():
    document = {"tip": {"axis": [0, 0, 1]}}
    changed = with_values(document, {"tip.axis": [1, 1, 1], "detector.width": 40.0})
    assert changed == {"tip": {"axis": [1, 1, 1]}, "detector": {"width": 40.0}}
    assert document == {"tip": {"axis": [0, 0, 1]}}


def test_entries_of_lists_have_numbers():
    document = {"phases": [{"name": "matrix"}, {"region": {"radius": 1.0, "centre": [0, 0, 5]}}]}
    changed = with_values(document, {"phases.1.region.radius": 2.0, "phases.1.region.centre.2": 6})
    assert changed["phases"][1] == {"region": {"radius": 2.0, "centre": [0, 0, 6]}}
    assert (
        value_at(changed, "phases.1.region.centre") == [0, 0, 6] and value_at(changed, "phases.1.region.centre.2") == 6
    )
    assert (
        value_at(changed, "phases.2") is value_at(changed, "phases.x") is value_at(changed, "phases.0.name.x") is None
    )
    wrong = {"phases.2.name": "2", "phases.name": "name", "phases.-1.name": "-1", "phases.1.region.centre.3": "3"}
    for path, name in wrong.items():
        with pytest.raises(ValueError, match=f"'{name}'"):
            with_values(document, {path: 1})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "a sweep needs a table .sweep. or points"),
        ("[sweep]\ntip.axis = [[0, 0, 1]]", 'write the path in quotes, "tip.axis"'),
        ('[sweep]\n"tip.axis" = 3', "tip.axis must be a list of values, got 3"),
        ('[sweep]\n"tip.axis" = []', "tip.axis must be a list of values"),
        ('[sweep]\n"tip..axis" = [1]', "names joined by dots"),
        ('[sweep]\n"maps.bins" = [32, 64]', "maps.bins is the same for all points: change it in the base"),
        ('[sweep]\n"output" = ["a.h5"]', "output is the same for all points"),
        ('[sweep]\n"tip.axes" = [[0, 0, 1]]', "study.toml', tip.axes = .*axes.*did you mean 'axis'"),
        ('[sweep]\n"tip.apex_radius" = ["8 a", "-8 a"]', 'tip.apex_radius = "-8 a": .*apex_radius must be'),
        ('[sweep]\n"simulation.ions.more" = [1]', "leads through simulation.ions, which is 300"),
        ("[[points]]\ntip.axis = [0, 0, 1]", 'must be a path in quotes, such as "tip.axis"'),
        ("points = 3", r"points must be tables \[\[points\]\], got 3"),
        ('each = {threads = 0}\n[sweep]\n"tip.axis" = [[0, 0, 1]]', "threads must be an integer >= 1, got 0"),
        ('each = {cores = 1}\n[sweep]\n"tip.axis" = [[0, 0, 1]]', "'cores'"),
        ('compare = {measured = "no.epos"}\n[sweep]\n"tip.axis" = [[0, 0, 1]]', "existing file, got .*no.epos"),
        (
            'compare = {measured = "base.toml", mechanism = "rolling"}\n[sweep]\n"tip.axis" = [[0, 0, 1]]',
            "mechanism must be one of roll-up, lateral, combined",
        ),
        (
            'compare = {measured = "base.toml"}\n[sweep]\n"simulation.responses" = [false]',
            "needs responses = true",
        ),
        (f'[sweep]\n"simulation.seed" = {[1] * 1000}\n"tip.offset_seed" = {[1] * 1000}', "at most 100,000"),
    ],
)
def test_mistakes_are_explained(study, text, message):
    with pytest.raises(FileError, match=message):
        study(text)


def test_a_missing_base_is_named(study):
    with pytest.raises(FileError, match=r"cannot read .*other\.toml"):
        study('[sweep]\n"tip.axis" = [[0, 0, 1]]', base="other.toml")


def test_a_name_of_a_file_adds_no_settings(tmp_path):
    name = 'a\noutput = "elsewhere.h5"\n#.toml'
    (tmp_path / name).write_text(BASE)
    (tmp_path / "study.toml").write_text(f"base = {json.dumps(name)}\n[sweep]\n'tip.apex_radius' = ['8 a', '9 a']\n")
    sweep = plan_sweep(tmp_path / "study.toml")
    for key in sweep.keys:
        text = (sweep.folder_of(key) / "settings.toml").read_text()
        assert "output" not in tomllib.loads(text)
