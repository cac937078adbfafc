"""Laws, rules, control and real units from the tables of a TOML file."""

import tomllib

import pytest

import apt_evap as ae
from apt_evap._common.codec import from_plain
from apt_evap.simulation.real_units import OperatingPoint

LAWS, RULES = (ae.Extremal, ae.Arrhenius), (ae.Robin, ae.ConstantPotential)


def read(text, *kinds):
    return from_plain(tomllib.loads(text), *kinds)


def test_laws():
    assert read('name = "Extremal"\nbonds = "TUNGSTEN_TABLE"', *LAWS) == ae.Extremal(ae.evaporation.TUNGSTEN_TABLE)
    text = """
    name = "Arrhenius"
    temperature = 25
    sensitivity = { Al = 0.8, Cu = 1.2 }
    barrier = "parabolic"
    laser = { temperature_rise = 150, direction = [0, 1], asymmetry = 0.4 }
    bonds = { name = "PairEnergies", ordering = { "Al-Cu" = 0.05 } }
    """
    assert read(text, *LAWS) == ae.Arrhenius(
        25.0,
        {"Al": 0.8, "Cu": 1.2},
        barrier="parabolic",
        laser=ae.evaporation.Laser(150.0, direction=(0.0, 1.0), asymmetry=0.4),
        bonds=ae.evaporation.PairEnergies(ordering={"Al-Cu": 0.05}),
    )
    bonds = 'name = "Extremal"\nbonds = { name = "CoordinationTable", table = { W = { 3 = 47, 4 = 57.0 } } }'
    assert read(bonds, *LAWS) == ae.Extremal(ae.evaporation.CoordinationTable({"W": {3: 47.0, 4: 57.0}}))


def test_rules():
    assert read('name = "Robin"', *RULES) == ae.Robin()
    text = 'name = "ConstantPotential"\nself_term = 15\ncharges = "gaussian"\nlaw_field = "others"'
    assert read(text, *RULES) == ae.ConstantPotential(15.0, "gaussian", "others")


def test_control_and_real_units():
    assert read("pulse_fraction = 0\nrate = 2", ae.evaporation.VoltageControl) == ae.evaporation.VoltageControl(
        rate=2.0, pulse_fraction=0.0
    )
    text = """
    field_reference = "site"
    operating_field = 33.0
    flight_charges = { name = "PostIonisation", field_scale = 0.74 }
    timing = { temperature = 50 }
    smoothing = 100
    """
    assert read(text, OperatingPoint) == OperatingPoint(
        "site", 33.0, ae.emission.PostIonisation(0.74), timing=ae.detection.Timing(temperature=50.0), smoothing=100
    )
    assert read("flight_charges = { Ni = 2 }", OperatingPoint).flight_charges == {"Ni": 2}


@pytest.mark.parametrize(
    ("kinds", "text", "word"),
    [
        (RULES, 'name = "Potential"', "Potential"),
        (LAWS, 'name = "Extremal"\nbonds = { name = "Pairs" }', "bonds"),
        (LAWS, 'name = "Extremal"\nbonds = 3', "bonds"),
        (LAWS, 'name = "Extremal"\ntemperature = 3', "temperature"),
        (LAWS, 'name = "Arrhenius"\ntemperature = 3\nlaser = {}', "temperature_rise"),
        (LAWS, 'name = "Extremal"\nbonds = { name = "CoordinationTable", table = { W = { few = 1.0 } } }', "few"),
        ((ae.evaporation.VoltageControl,), "rates = 1", "rate"),
        ((OperatingPoint,), "pole = 1", "pole"),
        ((OperatingPoint,), "flight_charges = 0", "flight_charges"),
        ((OperatingPoint,), "timing = 3", "timing"),
        ((OperatingPoint,), 'flight_charges = { name = "Kingham" }', "flight_charges"),
        ((OperatingPoint,), "field_factor = 0", "field_factor"),
    ],
)
def test_wrong_tables_name_the_key(kinds, text, word):
    with pytest.raises(ValueError, match=word):
        read(text, *kinds)
