"""Evaporation fields by the bonds of an atom: their counts during the events, and the fields that follow."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial import cKDTree

import apt_evap as ae
from apt_evap.specimen.materials import MATERIALS
from apt_evap.units import BOLTZMANN

BULK = {"fcc": (12, 6), "hcp": (12, 6), "bcc": (8, 6), "diamond": (4, 12)}
# [d_nn]: second neighbours are closer than this, third ones are not
SECOND = {"fcc": 1.57, "bcc": 1.39}
# summands of a few eV, at most 20,000 of them
ROUNDING = 20_000 * 2.0**-53


def pair_of(name):
    """The smallest specimen of an element: two atoms."""
    distance = ae.material(name).nearest_neighbour_distance
    return ae.Tip.from_positions([[0, 0, 0], [0, 0, distance]], [0, 0], [name])


def field_of(bonds, name, nearest, second=0):
    """Evaporation fields of an element by numbers of bonds."""
    nearest = np.atleast_1d(nearest)[:, None]
    return bonds.fields(pair_of(name), 0, nearest, np.broadcast_to(second, nearest.shape))


def counted(tip, left, atoms):
    """Slow twin: numbers of nearest and of second neighbours of some atoms among those left, by species."""
    tree = cKDTree(tip.positions[left])
    shells = (tip.bond_length, SECOND[tip.elements[0].structure] * tip.nearest_neighbour_distance)
    counts = np.zeros((2, len(atoms), len(tip.elements)), int)
    for row, atom in enumerate(atoms):
        inner, outer = (
            np.bincount(tip.species[left[tree.query_ball_point(tip.positions[atom], reach)]], minlength=counts.shape[2])
            for reach in shells
        )
        counts[0, row], counts[1, row] = inner, outer - inner
        counts[0, row, tip.species[atom]] -= 1  # itself
    return counts


def decoded(codes, n_species, second):
    """Numbers of neighbours from the codes: four bits each."""
    counts = np.array([(codes >> 4 * k) & 15 for k in range(n_species * (1 + second))]).T
    return counts[:, :n_species], counts[:, n_species:] if second else np.zeros((len(codes), n_species), int)


def evaporated(tip, bonds, events=250, law=ae.Extremal, **options):
    emitter = ae.evaporation.Emitter(tip, law=law(bonds=bonds, **options), n_threads=1, seed=1)
    sites = np.concatenate([batch.site for batch in emitter.advance(events)])
    assert len(sites) == events
    return emitter, sites, np.setdiff1d(np.arange(len(tip)), sites)


@pytest.fixture(scope="session")
def aluminium_copper():
    return ae.Tip("Al", apex_radius=3.0, axis=(1, 1, 1), shank_length=3.0, solutes={"Cu": 0.2}, seed=1)


@pytest.fixture(scope="session")
def iron_tungsten():
    return ae.Tip("Fe", apex_radius=2.5, axis=(1, 1, 0), shank_length=2.5, solutes={"W": 0.1}, seed=2)


@dataclass(frozen=True)
class Constant:
    """The evaporation field of the species, whatever the bonds are."""

    by_species: bool = False
    second_shell: bool = False

    def fields(self, tip, species, nearest, second):
        return np.full(len(nearest), tip.elements[species].evaporation_field)


# ---- counts during the events --------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "weight"), [("aluminium_copper", 0.0), ("aluminium_copper", 0.4), ("iron_tungsten", 0.5)]
)
def test_bonds_by_species_are_those_of_the_atoms_left(request, name, weight):
    tip = request.getfixturevalue(name)
    emitter, _, left = evaporated(tip, ae.evaporation.PairEnergies(second_weight=weight), 500)
    nearest, second = counted(tip, left, left)
    found = decoded(emitter._core.atoms.bond_codes[left], 2, weight > 0)
    assert np.array_equal(found[0], nearest)
    assert np.array_equal(found[1], second if weight else np.zeros_like(second))
    assert np.array_equal(emitter.bonds, nearest[np.searchsorted(left, emitter.atoms)].sum(axis=1))


def test_without_species_all_bonds_are_counted_together(iron_tungsten):
    emitter, _, left = evaporated(iron_tungsten, Constant(second_shell=True), 200)
    nearest, second = counted(iron_tungsten, left, left)
    codes = emitter._core.atoms.bond_codes[left]
    assert np.array_equal(codes, nearest.sum(axis=1) + 16 * second.sum(axis=1))


def test_bonds_of_a_shell_that_is_deepened_are_those_of_the_whole_specimen():
    options = {"solutes": {"Cu": 0.2}, "seed": 1}
    tip = ae.Tip("Al", apex_radius=2.5, axis=(1, 1, 1), depth=1.4, **options)
    emitter, _, left = evaporated(tip, ae.evaporation.PairEnergies(), 500)
    deep = emitter.tip
    assert len(deep) > len(tip)
    left = np.union1d(left, np.arange(len(tip), len(deep)))
    nearest, _ = counted(deep, left, emitter.atoms)
    assert np.array_equal(decoded(emitter._core.atoms.bond_codes[emitter.atoms], 2, False)[0], nearest)


# ---- the law -------------------------------------------------------------------------------------------------------


def slow_fields(tip, atoms, nearest, second, weight=0.0, ordering=0.0):
    """Twin of the evaporation field from pair energies, written out for two species [V/nm]."""
    cohesive, work = {"Al": 3.39, "Cu": 3.49, "Fe": 4.28, "W": 8.90}, {"Al": 1.7, "Cu": 3.1, "Fe": 15.1, "W": 36.6}
    names = [element.name for element in tip.elements]
    near, far = BULK[tip.elements[0].structure]
    like = np.array([2 * cohesive[name] / (near + weight * far) for name in names])
    energies = (like[:, None] + like) / 2 + ordering * (1 - np.eye(2))
    own = tip.species[atoms]
    total = ((nearest + weight * second) * energies[own]).sum(axis=1)
    e, s = (np.array([values[name] for name in names])[own] for values in (cohesive, work))
    return tip.evaporation_fields[own] * ((total + s) / (e + s)) ** 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "weight", "ordering"),
    [("aluminium_copper", 0.0, 0.05), ("aluminium_copper", 0.0, -0.1), ("iron_tungsten", 0.5, 0.0)],
)
@pytest.mark.parametrize("temperature", [0.0, 60.0])
def test_keys_are_those_of_the_fields_of_all_remaining_bonds(request, name, weight, ordering, temperature):
    tip = request.getfixturevalue(name)
    pair = "-".join(element.name for element in reversed(tip.elements))  # the order of the two does not matter
    bonds = ae.evaporation.PairEnergies(second_weight=weight, ordering={pair: ordering})
    emitter, _, left = evaporated(tip, bonds, law=lambda bonds: ae.Arrhenius(temperature, bonds=bonds))
    atoms, fields = emitter.atoms, emitter.fields
    field = slow_fields(tip, atoms, *counted(tip, left, atoms), weight, ordering)
    codes = emitter._core.atoms.bond_codes[atoms]
    may = tip.evaporable[atoms]
    found = emitter.law.kernel(tip).evaluate(fields, atoms, codes)
    if temperature == 0:
        keys = np.where(may, fields / field, 0.0)
        assert emitter.evaporate(1).site[0] == atoms[np.argmax(keys)]
    else:
        keys = np.where(may, np.log(1e13) - (1 - fields / field) / (BOLTZMANN * temperature), -np.inf)
    # a table that rounds the factor once, and a twin of about ten operations; keys of a temperature are up to 200 / x
    assert found[may] == pytest.approx(keys[may], rel=1e-13, abs=1e-10 if temperature else 0.0)
    assert (found[~may] == (-np.inf if temperature else 0.0)).all()


def test_atoms_with_few_bonds_leave_before_atoms_with_many(aluminium_copper):
    """The mean number of bonds at the removal is lower than without the law of bonds."""
    means = []
    for bonds in (None, ae.evaporation.CoordinationTable({name: {0: 5.0, 12: 60.0} for name in ("Al", "Cu")})):
        emitter = ae.evaporation.Emitter(aluminium_copper, law=ae.Extremal(bonds), n_threads=1)
        counts, done = [], 0
        while done < 300:
            before = dict(zip(emitter.atoms.tolist(), emitter.bonds.tolist(), strict=True))
            batch = emitter.evaporate(1)
            done += len(batch)
            counts += [before[site] for site in batch.site.tolist()]
            if len(batch) == 0:
                emitter.relax()
        means.append(np.mean(counts))
    assert means[1] < means[0] - 0.15  # measured 6.00 and 5.76; the standard deviation of such a mean is 0.04


def test_constant_fields_leave_the_bits_of_the_law(aluminium_copper):
    """The factor of the table is exactly 1."""

    def columns(bonds):
        emitter = ae.evaporation.Emitter(aluminium_copper, law=ae.Extremal(bonds), n_threads=1)
        sites = np.concatenate([batch.site for batch in emitter.advance(150)])
        return sites, emitter.charges

    expected = columns(None)
    for bonds in (Constant(), Constant(second_shell=True), Constant(True), Constant(True, True)):
        found = columns(bonds)
        assert np.array_equal(found[0], expected[0]) and np.array_equal(found[1], expected[1])


# ---- pair energies -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("weight", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("name", sorted(MATERIALS))
def test_an_atom_at_a_kink_has_the_evaporation_field_of_its_species(name, weight):
    near, far = BULK[ae.material(name).structure]
    (field,) = field_of(ae.evaporation.PairEnergies(second_weight=weight), name, near // 2, far // 2)
    assert field == pytest.approx(ae.material(name).evaporation_field, rel=1e-14)  # a few roundings


@pytest.mark.parametrize(
    ("name", "per_bond"),  # 2 (2 E / Z) / (E + S): the physics notes of this law, to two digits
    [
        ("Al", 0.22),
        ("Ni", 0.21),
        ("Cu", 0.18),
        ("Fe", 0.11),
        ("W", 0.098),
        ("Pt", 0.088),
        ("Ti", 0.097),
        ("Au", 0.16),
    ],
)
def test_change_of_the_field_per_bond_at_a_kink(name, per_bond):
    kink = BULK[ae.material(name).structure][0] // 2
    low, middle, high = field_of(ae.evaporation.PairEnergies(), name, [kink - 1, kink, kink + 1])
    # the field is a square, whose central difference is exact; half of the last digit
    assert (high - low) / (2 * middle) == pytest.approx(per_bond, abs=0.0005 if per_bond < 0.1 else 0.005)
    assert 0 < low < middle < high


@pytest.mark.parametrize(
    ("name", "weight", "ordering"),
    [("aluminium_copper", 0.0, {}), ("aluminium_copper", 0.3, {"Al-Cu": 0.08}), ("iron_tungsten", 0.5, {"W-Fe": -0.1})],
)
def test_bond_energies_of_the_atoms_add_up_to_that_of_the_specimen(request, name, weight, ordering):
    """Each bond is broken once: the energy of an atom at its removal, summed, is that of all bonds that are gone."""
    tip = request.getfixturevalue(name)
    bonds = ae.evaporation.PairEnergies(second_weight=weight, ordering=ordering)
    emitter, sites, left = evaporated(tip, bonds, 300)
    # the code of an atom does not change after its removal
    nearest, second = decoded(emitter._core.atoms.bond_codes[sites], 2, weight > 0)
    removed = sum(
        bonds.energies(tip, species, nearest[of], second[of]).sum()
        for species, of in ((k, tip.species[sites] == k) for k in (0, 1))
    )
    energies = np.array([[bonds.pair_energy(tip, i, j) for j in (0, 1)] for i in (0, 1)])
    assert energies[0, 1] == energies[1, 0] != (energies[0, 0] + energies[1, 1]) / 2 or not ordering

    def of_pairs(atoms, reach):
        pairs = cKDTree(tip.positions[atoms]).query_pairs(reach, output_type="ndarray")
        return energies[tuple(tip.species[atoms][pairs].T)].sum()

    def total(atoms):
        inner = of_pairs(atoms, tip.bond_length)
        outer = of_pairs(atoms, SECOND[tip.elements[0].structure] * tip.nearest_neighbour_distance)
        return inner + weight * (outer - inner)

    everything = total(np.arange(len(tip)))
    assert removed == pytest.approx(everything - total(left), abs=everything * ROUNDING)
    assert 0 < removed < everything


def test_cohesive_energies_are_the_energy_of_a_crystal():
    """Half of the bonds of an atom in the bulk: the cohesive energy."""
    tip = pair_of("Cu")
    for weight in (0.0, 0.7):
        bonds = ae.evaporation.PairEnergies(second_weight=weight)
        (energy,) = bonds.energies(tip, 0, np.array([[12]]), np.array([[6]]))
        assert energy / 2 == pytest.approx(3.49, rel=1e-15)


def test_energies_and_works_of_a_users_own():
    own = ae.evaporation.PairEnergies({"Cu": 4.0}, {"Cu": 2.0})
    low, high = field_of(own, "Cu", [5, 6])
    assert low / high == pytest.approx(((4.0 * 5 / 6 + 2.0) / 6.0) ** 2, rel=1e-14)  # a few roundings
    assert np.array_equal(field_of(own, "Ni", [3, 9]), field_of(ae.evaporation.PairEnergies(), "Ni", [3, 9]))
    magnesium = ae.Material("Mg", "hcp", 0.321, 21.0, 2, 24.305, c=0.521)
    tip = ae.Tip.from_positions([[0, 0, 0], [0, 0, 0.32]], [0, 0], [magnesium])
    given = ae.evaporation.PairEnergies({"Mg": 1.51}, {"Mg": 15.3})
    assert given.fields(tip, 0, np.array([[6]]), np.zeros((1, 1), int)) == pytest.approx(21.0, rel=1e-14)
    with pytest.raises(ValueError, match="cohesive_energies"):
        ae.evaporation.PairEnergies().fields(tip, 0, np.array([[6]]), np.zeros((1, 1), int))
    # the known number is for Mg+
    with pytest.raises(ValueError, match="ionisation_works must have a value for Mg with a charge of 2 e"):
        ae.evaporation.PairEnergies({"Mg": 1.51}).fields(tip, 0, np.array([[6]]), np.zeros((1, 1), int))


def test_the_cohesive_energy_is_that_of_the_material():
    strong = ae.material("Cu", cohesive_energy=4.0)
    tip = ae.Tip.from_positions([[0, 0, 0], [0, 0, 0.26]], [0, 0], [strong])
    fields = ae.evaporation.PairEnergies().fields(tip, 0, np.array([[5]]), np.zeros((1, 1), int))
    assert fields == pytest.approx(30.0 * ((4.0 * 5 / 6 + 3.1) / (4.0 + 3.1)) ** 2, rel=1e-14)  # a few roundings


# ---- tables --------------------------------------------------------------------------------------------------------


def test_fields_of_a_table_are_interpolated():
    table = ae.evaporation.CoordinationTable({"Ni": {4: 20.0, 8: 40.0, 9: 100.0}})
    assert field_of(table, "Ni", [0, 4, 5, 7, 8, 9, 15]).tolist() == [20, 20, 25, 35, 40, 100, 100]
    assert field_of(table, "Cu", [0, 6, 12]).tolist() == [ae.material("Cu").evaporation_field] * 3
    assert not table.by_species and not table.second_shell


def test_the_table_of_tungsten():
    # 10 V/nm per bond from 27 for one bond, and 57 without any
    assert field_of(ae.evaporation.TUNGSTEN_TABLE, "W", range(10)).tolist() == [57, 27, 37, 47, 57, 67, 77, 87, 97, 107]


def test_a_table_in_the_law():
    tip = ae.Tip("W", apex_radius=2.0, axis=(1, 1, 0), shank_length=2.0)
    emitter, _, left = evaporated(tip, ae.evaporation.TUNGSTEN_TABLE, 200)
    atoms, fields = emitter.atoms, emitter.fields
    nearest = counted(tip, left, atoms)[0].sum(axis=1)
    assert np.array_equal(emitter._core.atoms.bond_codes[atoms], nearest)
    keys = np.where(tip.evaporable[atoms], fields / np.where(nearest == 0, 57.0, 17.0 + 10.0 * nearest), 0.0)
    found = emitter._core.law.evaluate(fields, atoms, nearest.astype(np.int32))
    assert found == pytest.approx(keys, rel=1e-15, abs=0)  # three roundings


# ---- a class of a user's own ---------------------------------------------------------------------------------------


def test_a_class_of_a_users_own_is_called_once_for_each_element(aluminium_copper):
    calls = []

    class Own:
        by_species, second_shell = True, False

        def fields(self, tip, species, nearest, second):
            calls.append((species, nearest.shape, second.any()))
            return 20.0 + nearest[:, 0] + 2.0 * nearest[:, 1] + 5.0 * species

    emitter, _, left = evaporated(aluminium_copper, Own(), 120)
    assert calls == [(0, (256, 2), False), (1, (256, 2), False)]
    atoms, fields = emitter.atoms, emitter.fields
    counts = counted(aluminium_copper, left, atoms)[0]
    own = 20.0 + counts @ [1.0, 2.0] + 5.0 * aluminium_copper.species[atoms]
    keys = np.where(aluminium_copper.evaporable[atoms], fields / own, 0.0)
    found = emitter._core.law.evaluate(fields, atoms, emitter._core.atoms.bond_codes[atoms])
    assert found == pytest.approx(keys, rel=1e-15, abs=0)  # three roundings


@pytest.mark.parametrize(
    ("bonds", "settings"),
    [
        (
            ae.evaporation.PairEnergies({"Al": 3.4}, ordering={"Al-Cu": 0.05}),
            {
                "cohesive_energies": {"Al": 3.4},
                "ionisation_works": None,
                "ordering": {"Al-Cu": 0.05},
                "second_weight": 0.0,
            },
        ),
        (ae.evaporation.CoordinationTable({"Al": {3: 15.0, 9: 25.0}}), {"table": {"Al": {"3": 15.0, "9": 25.0}}}),
    ],
    ids=["PairEnergies", "CoordinationTable"],
)
def test_a_run_with_bonds_is_saved_resumed_and_described(aluminium_copper, tmp_path, bonds, settings):
    def run(n_ions, path=None):
        simulation = ae.Simulation(
            aluminium_copper,
            seed=2,
            n_threads=1,
            law=ae.Extremal(bonds),
            charge_settings=ae.evaporation.ChargeSettings(sweep_interval=30),
        )
        checkpoint = None if path is None else ae.simulation.Checkpoint(path, resume=True)
        return simulation.run(n_ions, responses=False, progress=False, checkpoint=checkpoint)

    run(50, tmp_path / "run.h5")
    assert run(80, tmp_path / "run.h5").fingerprint() == run(80).fingerprint()
    law = ae.load(tmp_path / "run.h5").settings["law"]
    assert law == {"name": "Extremal", "bonds": {"name": type(bonds).__name__} | settings, "hop": None}


# ---- bad input -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: ae.Extremal(bonds=3),
            "bonds must be an evaporation field by bonds with by_species, .* a method fields, .*, got 3",
        ),
        (lambda: ae.Extremal(ae.evaporation.PairEnergies), "bonds must be an evaporation field by bonds"),
        (lambda: ae.Extremal({"Al": {3: 20.0}}), "bonds must be an evaporation field by bonds"),
        (
            lambda: ae.evaporation.CoordinationTable({}),
            "table must be fields by element and number of bonds, .*, got {}",
        ),
        (
            lambda: ae.evaporation.CoordinationTable(57.0),
            "table must be fields by element and number of bonds, .*, got 57.0",
        ),
        (
            lambda: ae.evaporation.CoordinationTable({"W": 57.0}),
            "table of W must be fields by number of bonds, got 57.0",
        ),
        (
            lambda: ae.evaporation.CoordinationTable({"W": {16: 57.0}}),
            "bonds in the table of W must be an integer from 0 to 15, got 16",
        ),
        (
            lambda: ae.evaporation.CoordinationTable({"W": {-1: 57.0}}),
            "bonds in the table of W must be an integer from 0 to 15, got -1",
        ),
        (
            lambda: ae.evaporation.CoordinationTable({"W": {4: 0.0}}),
            "field in the table of W must be a finite number .V/nm. > 0",
        ),
        (lambda: ae.evaporation.PairEnergies(second_weight=1.5), "second_weight must be .* >= 0 and <= 1, got 1.5"),
        (lambda: ae.evaporation.PairEnergies({"Al": -3.0}), "cohesive_energies of Al must be a finite number .eV. > 0"),
        (lambda: ae.evaporation.PairEnergies(3.4), "cohesive_energies must be numbers .eV. by element, got 3.4"),
        (
            lambda: ae.evaporation.PairEnergies(None, {"Al": 0.0}),
            "ionisation_works of Al must be a finite number .eV. > 0",
        ),
        (
            lambda: ae.evaporation.PairEnergies(ordering={"AlCu": 0.1}),
            "ordering must be by pair such as 'Al-Cu', got 'AlCu'",
        ),
        (lambda: ae.evaporation.PairEnergies(ordering={"Al-Cu": 20.0}), "ordering of Al-Cu must be .* <= 10, got 20.0"),
        (lambda: ae.evaporation.PairEnergies(ordering=0.1), "ordering must be energies .eV. by pair .*, got 0.1"),
    ],
)
def test_bad_bonds_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@dataclass(frozen=True)
class Returning:
    value: object
    by_species = False
    second_shell = False

    def fields(self, tip, species, nearest, second):
        return self.value


@pytest.mark.parametrize("value", [np.zeros(16), np.full(16, np.nan), [30.0, 40.0], np.full(16, -1.0), 30.0])
def test_fields_that_are_no_fields_are_refused(small_tip, value):
    message = r"fields of Returning must be 16 numbers > 0 \[V/nm\] for Ni, got "
    with pytest.raises(ValueError, match=message):
        ae.evaporation.Emitter(small_tip, law=ae.Extremal(Returning(value)))


@pytest.mark.parametrize(("solutes", "weight", "n"), [(2, 0.5, 3), (4, 0.0, 5)])
def test_too_many_species_are_refused(solutes, weight, n):
    names = ("Cu", "Ni", "Au", "Pt")[:solutes]
    tip = ae.Tip("Al", apex_radius=1.5, shank_length=1.5, solutes=dict.fromkeys(names, 0.1), seed=1)
    with pytest.raises(ValueError, match=rf"up to 4 species \(half with second neighbours\), got {n}"):
        ae.evaporation.Emitter(tip, law=ae.Extremal(ae.evaporation.PairEnergies(second_weight=weight)))
    # their number alone is always possible
    emitter = ae.evaporation.Emitter(tip, law=ae.Extremal(Constant(second_shell=True)))
    assert sum(map(len, emitter.advance(5))) == 5


@pytest.mark.parametrize("number", ["a", None, 4.5])
def test_numbers_of_bonds_in_a_table_are_integers(number):
    with pytest.raises(ValueError, match="bonds in the table of W must be"):
        ae.evaporation.CoordinationTable({"W": {number: 57.0}})


@pytest.mark.filterwarnings("ignore::apt_evap.warnings.SpecimenWarning")
def test_more_neighbours_than_can_be_counted_are_refused(nickel):
    """Two spheres, one of them compressed: with the bond length of the larger, its atoms have 18 neighbours."""
    grid = np.arange(-8, 9)
    cells = np.stack(np.meshgrid(grid, grid, grid), axis=-1).reshape(-1, 1, 3)
    crystal = (cells + np.array([[0, 0, 0], [0.5, 0.5, 0], [0.5, 0, 0.5], [0, 0.5, 0.5]])).reshape(-1, 3) * nickel.a
    radius = np.linalg.norm(crystal, axis=1)
    compressed = 0.8 * crystal[radius < 1.7] + [0, 0, 4.2]
    positions = np.concatenate([crystal[radius < 2.4], compressed])
    tip = ae.Tip.from_positions(positions, np.zeros(len(positions), int), [nickel])
    assert max(map(len, cKDTree(positions).query_ball_point(compressed, tip.bond_length))) == 19  # with itself
    with pytest.raises(ValueError, match="15"):
        ae.evaporation.Emitter(tip, law=ae.Extremal(Constant()))
