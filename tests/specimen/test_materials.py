import math

import pytest

from apt_evap.specimen.materials import MATERIALS, Material, material, polarization_energy
from apt_evap.units import DALTON

# kg/m^3 at room temperature, CRC Handbook of Chemistry and Physics, 97th ed., section 12
DENSITIES = {
    "Al": 2700,
    "Si": 2330,
    "Ti": 4506,
    "Fe": 7870,
    "Ni": 8900,
    "Cu": 8960,
    "W": 19300,
    "Pt": 21500,
    "Au": 19300,
}
ATOMS = {"fcc": 4, "bcc": 2, "diamond": 8, "hcp": 2}


@pytest.mark.parametrize("name", DENSITIES)
def test_mass_density_follows_from_lattice_and_mass(name):
    # lattice constants to three digits: 3 x 0.2 % each, and the handbook's own rounding
    entry = MATERIALS[name]
    volume = entry.a**3 if entry.c is None else math.sqrt(3) / 2 * entry.a**2 * entry.c
    density = ATOMS[entry.structure] * entry.mass * DALTON / (volume * 1e-27)
    assert density == pytest.approx(DENSITIES[name], rel=0.012)


@pytest.mark.parametrize("entry", MATERIALS.values(), ids=lambda entry: entry.name)
def test_every_number_has_its_source(entry):
    numbers = {"a", "evaporation_field", "charge_state", "mass", "structure"}
    numbers |= {name for name in ("c", "polarizability", "cohesive_energy") if getattr(entry, name) is not None}
    assert set(entry.sources) == numbers
    assert all(any(character.isdigit() for character in source) for source in entry.sources.values())


def test_nickel_is_that_of_the_paper():
    nickel = material("Ni")
    assert (nickel.structure, nickel.a, nickel.evaporation_field) == ("fcc", 0.352, 35.0)
    assert nickel.nearest_neighbour_distance == pytest.approx(0.352 / math.sqrt(2), rel=1e-15)


def test_polarization_energies_of_the_paper():
    # the paper prints two significant digits, and its radii and steps to two as well
    nickel = polarization_energy(material("Ni").polarizability, 1000.0, 1.0, 28.0, 0.35)
    aluminium = polarization_energy(material("Al").polarizability, 1000.0, 1.0, 32.0, 0.40)
    assert round(nickel, 3) == 0.068
    assert round(aluminium, 3) == 0.075


def test_polarization_energy_scales():
    one = polarization_energy(1e-39, 1000.0, 2.0, 30.0, 0.3)
    assert polarization_energy(1e-39, 2000.0, 4.0, 30.0, 0.3) == pytest.approx(one, rel=1e-14)
    assert polarization_energy(1e-39, 1000.0, 2.0, 60.0, 0.3) == pytest.approx(one / 8, rel=1e-14)


def test_change_says_who_gave_it_and_leaves_the_table_alone():
    changed = material("Ni", evaporation_field=36)
    assert changed.evaporation_field == 36.0
    assert changed.sources["evaporation_field"] == "given by the user"
    assert changed.sources["a"] == material("Ni").sources["a"]
    assert material("Ni").evaporation_field == 35.0
    assert material("Ni").sources["evaporation_field"] != "given by the user"


def test_unknown_name_lists_the_known_and_the_nearest():
    with pytest.raises(ValueError, match=r"'ni' \(did you mean 'Ni'\?\); known are Al, .*Au"):
        material("ni")
    with pytest.raises(ValueError, match="known are"):
        material(17)


def test_unknown_field_names_the_nearest():
    with pytest.raises(ValueError, match=r"'evaporation_feild' \(did you mean 'evaporation_field'\?\)"):
        material("Ni", evaporation_feild=36.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"a": -0.3}, r"a must be .*> 0 and <= 2, got -0.3"),
        ({"a": math.nan}, "a must be a finite number"),
        ({"evaporation_field": 0}, "evaporation_field must be"),
        ({"charge_state": 1.5}, "charge_state must be an integer from 1 to 118, got 1.5"),
        ({"mass": "58"}, "mass must be"),
        ({"structure": "cubic"}, "structure must be one of fcc, bcc, sc, diamond, hcp, got 'cubic'"),
        ({"structure": "hcp"}, "c must be a number for hcp"),
        ({"c": 0.5}, "c must be None for fcc, got 0.5"),
        ({"polarizability": -1.0}, "polarizability must be"),
    ],
)
def test_bad_numbers_are_refused_in_one_sentence(changes, message):
    with pytest.raises(ValueError, match=message) as caught:
        material("Ni", **changes)
    assert "\n" not in str(caught.value)


def test_materials_are_values():
    assert material("Ni") == material("Ni")
    assert hash(material("Ni")) == hash(material("Ni"))
    assert Material("X", "sc", 0.3, 30, 1, 50).sources == {}
