import copy
import math
import os
import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from apt_evap._common.codec import from_plain, to_plain
from apt_evap._common.files import FileError
from apt_evap.detection.detector import Detector
from apt_evap.detection.microscope.local_electrode import LocalElectrode
from apt_evap.emission.energies import Thermal, TruncatedNormal
from apt_evap.emission.perturbations import Combined, LateralVelocity, Mixture, RollUp, Unperturbed
from apt_evap.evaporation.charge_settings import ChargeSettings
from apt_evap.io.tapsim_nodes import write_nodes
from apt_evap.simulation.config.map_panels import MapSettings, Panel
from apt_evap.simulation.config.perturbation_text import read_perturbation, title_of
from apt_evap.simulation.config.simulation_file import config_of, read_config, read_document
from apt_evap.simulation.flight.flight_pool import FlightSettings
from apt_evap.simulation.simulation import Simulation
from apt_evap.specimen.materials import material
from apt_evap.specimen.tip import Tip

EXAMPLE = Path(__file__).parents[2] / "examples" / "ni111.toml"
MINIMAL = {"tip": {"material": "Ni", "apex_radius": "6 a"}, "simulation": {"ions": 60}}
EVERY_KEY = {
    "output": "run.h5",
    "tip": {
        "material": {"name": "Ni", "evaporation_field": 36.0},
        "apex_radius": "6 a",
        "axis": [0, 1, 2],
        "shank_angle": 2,
        "shank_length": 2.5,
        "base": "flat",
        "rotation": 10,
        "origin": ["0.25 a", 0.0, 0.1],
        "offset_seed": 4,
        "depth": "1.7 nm",
        "solutes": {"Cu": 0.25},
        "seed": 3,
    },
    "simulation": {"ions": 60, "voltage": 800, "seed": 7, "responses": False},
    "detector": {"distance": 90, "width": 80.0},
    "charges": {
        "opening_angle": 0.5,
        "patch_radius": 6.0,
        "update_radius": 10.0,
        "sweep_interval": 50,
        "whole_interval": 4,
        "tolerance": 1e-3,
        "start_tolerance": 1e-6,
    },
    "flights": {"opening_angle": 0.4, "tolerance": 1e-2, "reach": 5000.0, "max_steps": 400},
    "responses": {"energy_limit": 1.0, "bound": 0.1, "height": 0.1, "shells": 2},
    "maps": {
        "bins": 40,
        "smoothing": 2,
        "panels": [
            {"title": "none", "perturbation": "Unperturbed"},
            {"perturbation": {"name": "RollUp", "energy": 0.2}},
        ],
    },
}


def toml(value):
    """Value as TOML writes it in one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f'"{key}" = {toml(item)}' for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(toml(item) for item in value) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"' if isinstance(value, str) else repr(value)


def written(folder, document):
    path = folder / "sim.toml"
    path.write_text("".join(f'"{key}" = {toml(value)}\n' for key, value in document.items()), encoding="utf-8")
    return path


def message(folder, document, build=False):
    with pytest.raises(FileError) as caught:
        config = read_config(written(folder, document))
        if build:
            config.simulation(n_threads=1)
    text = str(caught.value)
    assert "sim.toml" in text and "\n" not in text
    return text


def changed(table, key, value):
    document = copy.deepcopy(EVERY_KEY)
    document[table][key] = value
    return document


def test_the_example_is_the_simulation_of_the_readme():
    config = read_config(EXAMPLE)
    nickel = material("Ni")
    assert config.tip["material"] == nickel and config.tip["axis"] == [1, 1, 1] and config.tip["shank_angle"] == 1.5
    assert config.tip["apex_radius"] == config.tip["shank_length"] == 20 * nickel.a
    assert (config.n_ions, config.voltage, config.seed, config.output) == (15_000, 1000.0, 1, "ni111.h5")
    assert config.detector == Detector(100.0, 300.0) and config.responses and config.emissions == ()
    drawn = [panel.perturbation for panel in config.maps.panels]
    assert drawn == [Unperturbed(), RollUp(TruncatedNormal(0.1, 0.1))]
    assert config.real_units.field_reference == "cap" and config.real_units.flight_charges == {"Ni": 2}


def test_a_file_builds_the_same_simulation_as_python(tmp_path):
    config = read_config(written(tmp_path, EVERY_KEY))
    a = material("Ni").a
    tip = Tip(
        material("Ni", evaporation_field=36.0),
        6 * a,
        axis=(0, 1, 2),
        shank_angle=2,
        shank_length=2.5,
        base="flat",
        rotation=10,
        origin=(0.25 * a, 0.0, 0.1),
        offset_seed=4,
        depth=1.7,
        solutes={"Cu": 0.25},
        seed=3,
    )
    same = Simulation(
        tip,
        voltage=800,
        seed=7,
        detector=Detector(90, 80),
        charge_settings=ChargeSettings(0.5, 6.0, 10.0, 50, 1e-3, 1e-6, whole_interval=4),
        flight_settings=FlightSettings(0.4, 1e-2, 5000.0, 400),
        response_settings=config.response_settings,
        n_threads=1,
    )
    simulation = config.simulation(n_threads=1)
    assert simulation.settings == same.settings
    assert (simulation.tip.positions == tip.positions).all() and (simulation.tip.species == tip.species).all()
    assert (config.response_settings.energy_limit, config.response_settings.bound) == (1.0, 0.1)
    assert config.response_settings.shells == 2
    # without responses the maps are of perturbations flown in the run
    assert config.emissions == (Unperturbed(), RollUp(0.2))
    assert [panel.title for panel in config.maps.panels] == ["none", "roll-up, 0.2 eV"]


def test_what_is_not_given_is_as_in_python(tmp_path):
    config = read_config(written(tmp_path, MINIMAL))
    tip = Tip("Ni", 6 * material("Ni").a)
    assert config.simulation(n_threads=1).settings == Simulation(tip, n_threads=1).settings
    assert config.maps == MapSettings() and config.output is None


@pytest.mark.parametrize(("text", "length"), [("20 a", 20 * 0.352), ("1.5e1a", 15 * 0.352), (" 7 nm ", 7.0), (7, 7.0)])
def test_lengths_are_in_lattice_constants_or_nm(tmp_path, text, length):
    config = read_config(written(tmp_path, MINIMAL | {"tip": {"material": "Ni", "apex_radius": text}}))
    # one rounding of the product
    assert math.isclose(config.tip["apex_radius"], length, rel_tol=1e-15)


def test_an_axis_of_any_numbers(tmp_path):
    axis = [0.3015441344842630, 0.5403229287126988, 0.7855713001793464]
    table = {"material": "Ni", "apex_radius": "6 a", "axis": axis, "rotation": 157.2870473268672}
    tip = read_config(written(tmp_path, MINIMAL | {"tip": table})).simulation(n_threads=1).tip
    assert tip.settings["axis"] == axis
    np.testing.assert_array_equal(
        tip.positions, Tip("Ni", 6 * material("Ni").a, axis, rotation=157.2870473268672).positions
    )


def test_a_material_of_ones_own(tmp_path):
    own = {"name": "X", "structure": "bcc", "a": 0.3, "evaporation_field": 20, "charge_state": 2, "mass": 50}
    tip = read_config(written(tmp_path, MINIMAL | {"tip": {"material": own, "apex_radius": "6 a"}})).tip
    assert tip["material"].structure == "bcc" and tip["apex_radius"] == 6 * 0.3
    del own["mass"]
    assert "[tip]: material must have mass" in message(tmp_path, MINIMAL | {"tip": {"material": own, "apex_radius": 3}})


@pytest.mark.parametrize(
    ("table", "wrong", "meant"),
    [
        ("tip", "apex_radis", "apex_radius"),
        ("simulation", "ion", "ions"),
        ("detector", "widht", "width"),
        ("charges", "patch", "patch_radius"),
        ("flights", "tolerence", "tolerance"),
        ("responses", "energy", "energy_limit"),
        ("maps", "panel", "panels"),
    ],
)
def test_an_unknown_key_is_named_with_the_nearest_known_one(tmp_path, table, wrong, meant):
    text = message(tmp_path, changed(table, wrong, 1))
    assert f"[{table}]: " in text and f"'{wrong}' (did you mean '{meant}'?)" in text


def test_an_unknown_table_and_a_missing_one(tmp_path):
    assert "no key is named 'detectors' (did you mean 'detector'?)" in message(tmp_path, EVERY_KEY | {"detectors": {}})
    assert "simulation is missing" in message(tmp_path, {"tip": MINIMAL["tip"]})
    assert "[tip]: apex_radius is missing" in message(tmp_path, MINIMAL | {"tip": {"material": "Ni"}})
    assert "[simulation]: ions is missing" in message(tmp_path, MINIMAL | {"simulation": {}})
    assert "[detector] must be a table, got 3" in message(tmp_path, EVERY_KEY | {"detector": 3})
    assert "output must be a file name" in message(tmp_path, EVERY_KEY | {"output": 3})


@pytest.mark.parametrize(
    ("table", "key", "value", "expected"),
    [
        ("tip", "material", "Nickel", "no material is named 'Nickel'"),
        ("tip", "material", 28, "material must be"),
        ("tip", "material", {"name": "Ni", "field": 1.0}, "'field'"),
        (
            "tip",
            "apex_radius",
            "20 b",
            "apex_radius must be a number [nm] or text such as '20 a' or '7 nm', got '20 b'",
        ),
        ("tip", "apex_radius", "x a", "got 'x a'"),
        ("tip", "apex_radius", "1 a", "apex_radius must be a finite number [nm] >= 0.7"),
        ("tip", "apex_radius", "nan a", "apex_radius must be a finite number"),
        ("tip", "apex_radius", -3, "got -3"),
        ("tip", "depth", True, "depth must be a finite number [nm], got True"),
        ("tip", "axis", [0, 0, 0], "axis"),
        ("tip", "axis", "111", "axis"),
        ("tip", "base", "round", "base must be one of rounded, flat, got 'round' (did you mean 'rounded'?)"),
        ("tip", "shank_angle", 60, "shank_angle must be a finite number [degrees] >= 0 and < 45, got 60"),
        ("tip", "solutes", 0.1, "solutes must be a table, got 0.1"),
        ("tip", "solutes", {"Cu": "half"}, "fraction of Cu"),
        ("simulation", "ions", 0, "ions must be an integer >= 1, got 0"),
        ("simulation", "ions", 1.5, "got 1.5"),
        ("simulation", "voltage", "1 kV", "voltage must be a finite number [V] > 0 and <= 1e+06, got '1 kV'"),
        ("simulation", "seed", -1, "seed must be an integer >= 0, got -1"),
        ("simulation", "responses", "yes", "responses must be true or false, got 'yes'"),
        ("detector", "width", 0, "width must be a finite number [mm] > 0 and <= 1e+06, got 0"),
        (
            "charges",
            "opening_angle",
            3,
            "opening_angle must be a finite number [rad] >= 0 and <= 1.5, got 3",
        ),
        ("flights", "max_steps", 0.5, "max_steps must be an integer"),
        ("responses", "bound", 0, "bound must be a finite number [mm] > 0, got 0"),
        ("maps", "bins", 0, "bins must be an integer from 1 to 16,384, got 0"),
        ("maps", "bins", 10**9, "bins must be an integer from 1 to 16,384, got 1000000000"),
        ("maps", "smoothing", -1, "smoothing must be a finite number [mm] >= 0, got -1"),
        ("maps", "panels", [], "panels must"),
        ("maps", "panels", [{"title": "x"}], "panel 1: "),
        ("maps", "panels", [{"perturbation": "Rollup"}], "panel 1: perturbation 'Rollup'"),
        (
            "maps",
            "panels",
            [{"perturbation": "Unperturbed", "title": 1}],
            "panel 1: title must be printable text, got 1",
        ),
        (
            "maps",
            "panels",
            [{"perturbation": "Unperturbed", "title": "\u200b"}],
            "panel 1: title must be printable text",
        ),
        (
            "maps",
            "smoothing",
            80.1,
            "smoothing must be a finite number [mm] <= 80 (the width of the detector), got 80.1",
        ),
        ("maps", "panels", [{"perturbation": {"energy": 1}}], "must have a name"),
        ("maps", "panels", [{"perturbation": {"name": "Fixed", "energy": 1}}], "panel 1: perturbation"),
    ],
)
def test_a_wrong_value_is_named_with_what_was_expected(tmp_path, table, key, value, expected):
    text = message(tmp_path, changed(table, key, value), build=True)
    assert f"[{table}]: " in text and expected in text


PLACES = [(table, key) for table, keys in EVERY_KEY.items() if isinstance(keys, dict) for key in keys]
JUNK = st.recursive(
    st.booleans() | st.integers(-3, 3) | st.floats(-2, 2) | st.sampled_from(["", "x", "1 a", "inf a"]),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["name", "a", "Cu"]), inner, max_size=2)
    ),
    max_leaves=4,
)


@given(st.sampled_from(PLACES), JUNK)
def test_no_value_gives_anything_but_a_config_or_one_sentence(tmp_path, place, value):
    document = changed(*place, value)
    try:
        config = read_config(written(tmp_path, document))
        Tip(**config.tip)
    except FileError as error:
        # a detector of 1 mm is good, but not for maps that are smoothed by 2 mm
        table = "maps" if place == ("detector", "width") and "[maps]: smoothing" in str(error) else place[0]
        assert f"[{table}]: " in str(error)
    except ValueError:
        with pytest.raises(FileError, match=r"sim\.toml', \[tip\]: "):
            config.simulation(n_threads=1)


@pytest.mark.parametrize(
    "content",
    [
        b"ions = = 3",
        b"\x89HDF\r\n\x1a\n\xff\x00",
        b"[tip]\n[tip]\n",
        b"x" + b".a" * 1_500 + b" = 1",
        b"[x" + b".a" * 1_500 + b"]",
        b"x = " + b"[" * 1_500 + b"]" * 1_500,
        b"x = " + b"[" * 70 + b"]" * 70,
        b"x = " + b"9" * 5_000,
    ],
)
def test_what_is_not_toml_is_called_so(tmp_path, content):
    path = tmp_path / "a.toml"
    path.write_bytes(content)
    with pytest.raises(FileError, match=r"a\.toml' is not a TOML file: "):
        read_config(path)


def test_deep_tables_of_python_are_refused_too():
    deep: dict = {}
    for _ in range(2_000):
        deep = {"a": deep}
    for document in ({**MINIMAL, "law": deep}, {**MINIMAL, "tip": {**MINIMAL["tip"], "solutes": deep}}):
        with pytest.raises(FileError, match=r"made\.toml'.*levels"):
            config_of(document, Path("made.toml"))


def test_a_byte_order_mark_is_no_content(tmp_path):
    plain, marked = written(tmp_path, MINIMAL), tmp_path / "marked.toml"
    marked.write_bytes(b"\xef\xbb\xbf" + plain.read_bytes().replace(b"\n", b"\r\n"))
    assert read_config(marked).key == read_config(plain).key


def test_what_is_too_large_or_a_pipe_is_not_read(tmp_path):
    with open(tmp_path / "large.toml", "wb") as file:
        file.truncate(6 << 30)
    with pytest.raises(FileError, match=r"large\.toml' has more than \d+ bytes, expected a TOML file"):
        read_config(tmp_path / "large.toml")
    os.mkfifo(tmp_path / "pipe.toml")
    with pytest.raises(FileError, match=r"cannot read .*pipe\.toml': Not a regular file"):
        read_config(tmp_path / "pipe.toml")


def test_a_missing_file(tmp_path):
    with pytest.raises(FileError, match=r"cannot read .*none\.toml': No such file"):
        read_config(tmp_path / "none.toml")


PERTURBATIONS = {
    "Unperturbed": Unperturbed(),
    "RollUp:0.2": RollUp(0.2),
    "LateralVelocity:0.3,0.1": LateralVelocity(TruncatedNormal(0.3, 0.1)),
    "Combined:0.2,0.75": Combined(0.2, 0.75),
    "Combined:0.3,0.1,0.75": Combined(TruncatedNormal(0.3, 0.1), 0.75),
    '{name = "RollUp", energy = {name = "Thermal", temperature = 50}}': RollUp(Thermal(50)),
    '{name = "Mixture", perturbations = [{name = "RollUp", energy = 0.4}, {name = "Unperturbed"}], weights = [7, 3]}': (
        Mixture((RollUp(0.4), Unperturbed()), (7, 3))
    ),
}


@pytest.mark.parametrize("text", PERTURBATIONS)
def test_a_perturbation_is_text_or_a_table(text):
    assert read_perturbation(text) == PERTURBATIONS[text]
    assert read_perturbation(to_plain(PERTURBATIONS[text])) == PERTURBATIONS[text]


@pytest.mark.parametrize(
    "text", ["", "RollUp", "RollUp:", "RollUp:a", "RollUp:1,2,3", "RollUp:-1", "Combined:0.3", "{"]
)
def test_a_perturbation_that_is_none_is_named(text):
    with pytest.raises(ValueError, match=r"^perturbation "):
        read_perturbation(text)


def test_titles_tell_perturbations_apart():
    titles = {title_of(each) for each in PERTURBATIONS.values()}
    assert len(titles) == len(PERTURBATIONS) and "roll-up, 50 K" in titles


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"maps": None}, "maps must be of type MapSettings, got None"),
        ({"n_ions": 0}, "n_ions must be an integer >= 1, got 0"),
        ({"voltage": -1.0}, "voltage must be"),
        ({"seed": 0.5}, "seed must be"),
        ({"responses": "no"}, "responses must be True or False, got 'no'"),
        ({"detector": 100.0}, "detector must be of type Detector, got 100.0"),
        ({"detector": Detector(width=1.0)}, "smoothing must be a finite number [mm] <= 1 (the width of"),
        ({"output": ""}, "output must be a file name"),
    ],
)
def test_a_config_made_in_python_is_checked(change, sentence):
    with pytest.raises(ValueError, match=re.escape(sentence)):
        replace(read_config(EXAMPLE), **change)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"panels": ()}, "panels must contain at least one Panel, got none"),
        ({"panels": ("RollUp:0.1",)}, "panels must be Panels, got 'RollUp:0.1'"),
        ({"panels": None}, "panels must be a sequence of Panels, got None"),
        ({"bins": 0}, "bins must be an integer"),
        ({"smoothing": math.nan}, "smoothing must be a finite number [mm] >= 0, got nan"),
    ],
)
def test_map_settings_made_in_python_are_checked(arguments, sentence):
    with pytest.raises(ValueError, match=re.escape(sentence)):
        MapSettings(**{"panels": (Panel(Unperturbed(), "none"),)} | arguments)
    with pytest.raises(ValueError, match="perturbation"):
        Panel("Unperturbed", "none")


def test_maps_round_trip():
    maps = from_plain({"bins": 64, "panels": [{"perturbation": text} for text in PERTURBATIONS]}, MapSettings)
    assert from_plain(to_plain(maps), MapSettings) == maps


def test_the_tables_commented_out_in_the_example_are_the_defaults(tmp_path):
    lines = EXAMPLE.read_text().splitlines()
    begin = next(number for number, line in enumerate(lines) if line.startswith("# [charges]"))
    end = next(number for number, line in enumerate(lines) if line.startswith("[maps]"))
    shown = [line.removeprefix("#").strip() for line in lines[begin:end]]
    (tmp_path / "all.toml").write_text("\n".join([*lines[:begin], *shown, *lines[end:]]))
    shown, usual = read_config(tmp_path / "all.toml"), read_config(EXAMPLE)
    for name in ("charge_settings", "flight_settings", "response_settings"):
        assert getattr(shown, name) == getattr(usual, name)
    for kind in (ChargeSettings, FlightSettings):
        for item in fields(kind):
            assert f"# {item.name} = " in "\n".join(lines[begin:end])


def test_a_specimen_from_a_file(tmp_path):
    tip = Tip("Al", apex_radius=1.5, shank_length=1.5, solutes={"Cu": 0.2}, seed=1)
    write_nodes(tmp_path / "nodes.txt", tip)
    text = """
    [tip]
    file = "nodes.txt"
    types = {10 = "Al", 20 = {name = "Cu", evaporation_field = 28.0}}
    potential_point = [0.0, 0.0, 0.0]
    [simulation]
    ions = 10
    """
    (tmp_path / "a.toml").write_text(text)
    config = read_config(tmp_path / "a.toml")
    assert "10 ions from " in repr(config) and "nodes.txt" in repr(config)
    simulation = config.simulation(n_threads=1)
    assert np.allclose(simulation.tip.positions, tip.positions, rtol=0, atol=1e-7)  # [nm] digits in the file
    assert simulation.tip.evaporation_fields.tolist() == [19.0, 28.0]
    assert len(simulation.run(10, responses=False, progress=False)) == 10
    for old, new, message in (
        ('10 = "Al", ', "", r"\[tip\]: .*types without a name.* got none for 10"),
        ("nodes.txt", "none.txt", r"\[tip\]: cannot read .*none\.txt"),
        ('"Al"', "5", r"\[tip\]: types\.10 .*got 5"),
        ("potential_point", "apex_radius", r"\[tip\]: no key is named 'apex_radius'"),
        ('"nodes.txt"', "5", r"\[tip\]: file must be a file name such as 'tip\.lmp', got 5"),
    ):
        (tmp_path / "a.toml").write_text(text.replace(old, new))
        with pytest.raises(FileError, match=message):
            read_config(tmp_path / "a.toml").simulation(n_threads=1)


def test_a_microscope_by_its_preset_or_its_fields(tmp_path):
    base = '[tip]\nmaterial = "Ni"\napex_radius = "6 a"\n[simulation]\nions = 10\n[microscope]\n'
    path = tmp_path / "lens.toml"
    path.write_text(base + "distance = 40e3\naperture = 20e3\nshank_angle = 5.0\n")
    lens = read_config(path).microscope
    path.write_text(base + 'preset = "local electrode"\n')
    assert read_config(path).microscope == lens == LocalElectrode(40e3, 20e3, 5.0)
    for wrong, name in (('preset = "remote"', "preset"), ("distance = 40e3", "aperture"), ("preset = 3", "preset")):
        path.write_text(base + wrong)
        with pytest.raises(FileError, match=name):
            read_config(path)


def test_a_settings_file_may_have_a_byte_order_mark(tmp_path):
    """Editors of Windows write it."""
    path = tmp_path / "a.toml"
    path.write_text('[tip]\nmaterial = "Ni"\napex_radius = 2.0\n', encoding="utf-8-sig")
    assert read_document(path)["tip"]["apex_radius"] == 2.0


def test_energies_in_real_units_need_responses(tmp_path):
    """Flights are at the simulated voltage: this was refused only after the simulation."""
    text = '[tip]\nmaterial = "Ni"\napex_radius = 3.0\n[simulation]\nions = 10\nresponses = false\n[real_units]\n'
    path = tmp_path / "a.toml"
    for perturbation in ("RollUp:0.1", "Unperturbed"):
        path.write_text(f'{text}[[maps.panels]]\ntitle = "a"\nperturbation = "{perturbation}"\n')
        if perturbation == "Unperturbed":
            assert read_config(path).emissions
        else:
            with pytest.raises(ValueError, match="responses must be true for maps of RollUp"):
                read_config(path)
