"""Laws, control and real units from the tables of a TOML file."""

import tomllib

import pytest

import apt_evap as ae
from apt_evap.config.physics import read_control, read_law, read_real_units, read_rule


def table(text):
    return tomllib.loads(text)


def test_laws():
    assert read_law({}) == ae.Extremal()
    assert read_law(table('name = "Extremal"\nbonds = "TUNGSTEN_TABLE"')) == ae.Extremal(ae.TUNGSTEN_TABLE)
    text = """
    name = "Arrhenius"
    temperature = 25
    sensitivity = { Al = 0.8, Cu = 1.2 }
    barrier = "parabolic"
    laser = { temperature_rise = 150, direction = [0, 1], asymmetry = 0.4 }
    bonds = { name = "PairEnergies", ordering = { "Al-Cu" = 0.05 } }
    """
    assert read_law(table(text)) == ae.Arrhenius(
        25.0,
        {"Al": 0.8, "Cu": 1.2},
        barrier="parabolic",
        laser=ae.Laser(150.0, direction=(0.0, 1.0), asymmetry=0.4),
        bonds=ae.PairEnergies(ordering={"Al-Cu": 0.05}),
    )
    bonds = 'name = "Extremal"\nbonds = { name = "CoordinationTable", table = { W = { 3 = 47, 4 = 57.0 } } }'
    assert read_law(table(bonds)) == ae.Extremal(ae.CoordinationTable({"W": {3: 47.0, 4: 57.0}}))


def test_rules():
    assert read_rule({}) == read_rule({"name": "Robin"}) == ae.Robin()
    text = 'name = "ConstantPotential"\nself_term = 15\ncharges = "gaussian"\nlaw_sees = "others"'
    assert read_rule(table(text)) == ae.ConstantPotential(15.0, "gaussian", "others")
    with pytest.raises(ValueError, match="rule must have a name of Robin, ConstantPotential, got 'Potential'"):
        read_rule({"name": "Potential"})


def test_control_and_real_units():
    assert read_control({}) is None
    assert read_control(table("pulse_fraction = 0\nrate = 2")) == ae.VoltageControl(rate=2.0, pulse_fraction=0.0)
    text = """
    field_reference = "site"
    operating_field = 33.0
    flight_charges = { name = "PostIonisation", field_scale = 0.74 }
    timing = { temperature = 50 }
    smoothing = 100
    """
    assert read_real_units(table(text)) == {
        "field_reference": "site",
        "operating_field": 33.0,
        "flight_charges": ae.PostIonisation(0.74),
        "timing": ae.Timing(temperature=50.0),
        "smoothing": 100,
    }
    assert read_real_units({"flight_charges": {"Ni": 2}}) == {"flight_charges": {"Ni": 2}}


@pytest.mark.parametrize(
    ("read", "text", "sentence"),
    [
        (
            read_law,
            'name = "Extremal"\nbonds = { name = "Pairs" }',
            "bonds must have a name of Coordination",
        ),
        (read_law, 'name = "Extremal"\nbonds = 3', "bonds must be a table, got 3"),
        (read_law, 'name = "Extremal"\ntemperature = 3', "no key is named 'temperature'"),
        (read_law, 'name = "Arrhenius"\ntemperature = 3\nlaser = {}', "temperature_rise is missing"),
        (
            read_law,
            'name = "Extremal"\nbonds = { name = "CoordinationTable", table = { W = { few = 1.0 } } }',
            "keys in the table of W must be numbers of bonds, got 'few'",
        ),
        (read_control, "rates = 1", "no key is named 'rates' (did you mean 'rate'?)"),
        (read_real_units, "control = 1", "no key is named 'control'"),
        (read_real_units, "flight_charges = 0", "flight_charges must be an integer >= 1, got 0"),
        (read_real_units, "timing = 3", "timing must be a table, got 3"),
        (read_real_units, 'flight_charges = { name = "Kingham" }', "flight_charges must have a name of PostIonisation"),
        (read_real_units, "field_factor = 0", "field_factor must be"),
    ],
)
def test_wrong_tables_name_the_key(read, text, sentence):
    with pytest.raises(ValueError) as caught:
        read(table(text))
    assert sentence in str(caught.value)
