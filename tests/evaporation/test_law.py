"""Laws: the built-in one, and one of a user's own in Python, behind one contract."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

import apt_evap as ae
from apt_evap._core.law import PythonLaw, WeightedField
from apt_evap.emission import Migration

# the charges are those of Robin's rule, whose computation is shorter, though the law of the hop is for another rule
pytestmark = pytest.mark.filterwarnings("ignore:Migration holds:apt_evap.warnings.EmissionWarning")


def sequence(emitter, events=60):
    return np.concatenate([batch.site for batch in emitter.advance(events)])


class InPython:
    """The extremal law, but in Python."""

    def keys(self, tip, atoms, fields, bonds):
        return ae.Extremal().keys(tip, atoms, fields, bonds)


@dataclass(frozen=True)
class WeaklyBound:
    """An evaporation field that grows by a fraction with every bond."""

    per_bond: float

    def keys(self, tip, atoms, fields, bonds):
        return ae.Extremal().keys(tip, atoms, fields, bonds) / (1 + self.per_bond * bonds)


def test_a_law_in_python_gives_the_sequence_of_the_compiled_one(tip12):
    compiled, slow = ae.evaporation.Emitter(tip12), ae.evaporation.Emitter(tip12, law=InPython())
    assert isinstance(compiled._core.law, WeightedField) and isinstance(slow._core.law, PythonLaw)
    assert np.array_equal(sequence(compiled), sequence(slow))


def test_the_kernel_and_the_method_in_python_agree(tip12, rng):
    atoms = rng.integers(0, len(tip12), 200)
    fields, bonds = rng.uniform(1, 50, 200), rng.integers(0, 13, 200).astype(np.int32)
    kernel = ae.Extremal().kernel(tip12).evaluate(fields, atoms, bonds)
    assert kernel == pytest.approx(ae.Extremal().keys(tip12, atoms, fields, bonds), rel=1e-15)
    assert (kernel[~tip12.evaporable[atoms]] == 0).all()


def test_a_law_sees_field_and_bonds_of_the_atoms_around_every_hole(tip12):
    seen = {}

    class Seeing(InPython):
        def keys(self, tip, atoms, fields, bonds):
            seen.update(zip(atoms.tolist(), zip(fields.tolist(), bonds.tolist(), strict=True), strict=True))
            return super().keys(tip, atoms, fields, bonds)

    emitter = ae.evaporation.Emitter(tip12, law=Seeing())
    sequence(emitter, 40)
    assert len(emitter) > 4000
    for atom, field, bonds in zip(emitter.atoms, emitter.fields, emitter.bonds, strict=True):
        assert seen[atom] == (pytest.approx(field, rel=1e-14), bonds)


def test_bonds_change_the_order(tip12):
    plain, bound = ae.evaporation.Emitter(tip12), ae.evaporation.Emitter(tip12, law=WeaklyBound(0.2))
    first = int(np.argmax(WeaklyBound(0.2).keys(tip12, bound.atoms, bound.fields, bound.bonds)))
    first = bound.atoms[first]
    assert bound.evaporate(1).site[0] == first
    assert not np.array_equal(sequence(plain), sequence(bound))


def test_parameters_of_a_law_are_in_the_settings(small_tip):
    run = ae.Simulation(small_tip, law=WeaklyBound(0.2)).run(5, responses=False, progress=False)
    assert run.settings["law"] == {"name": "WeaklyBound", "per_bond": 0.2}
    assert run.settings["rule"] == {"name": "Robin", "tolerance": 1e-4, "window": 8}


def test_the_field_at_which_an_atom_hops(tip12):
    """The gain of a hop is alpha F^2 (phi^2 - 1)/2: it is enough where the field is lower by the root."""
    law = Migration.of("Ni")
    kernel = ae.Extremal(hop=law).kernel(tip12)
    double = ((2 * law.gain_needed + 1) ** 0.5 - 1.27) / 1.54  # charge ratio at which phi^2 - 1 is twice as large
    ratios = np.array([0.0, 0.0, law.threshold, double])
    ratios[1] = ((0.81 * law.gain_needed + 1) ** 0.5 - 1.27) / 1.54  # 0.81 times as large
    hop = 0.7 * np.array([0.0, 0.9, 1.0, 2.0**0.5])
    # ratios of the field to that of evaporation: of a kink, of an atom that is bound more, of one that cannot evaporate
    for key, expected in ((0.7, np.maximum(hop, 0.7)), (0.6, np.maximum(hop, 0.6)), (0.0, 0 * hop)):
        keys = kernel.evaluate_hopping(np.full(4, key), np.full(4, 0.7 * 35.0), ratios)
        assert keys == pytest.approx(expected, rel=1e-12)
    # hotter or less bound atoms hop at lower fields, and those of aluminium do not hop at all
    assert Migration.of("Ni", 150.0).gain_needed < law.gain_needed < Migration.of("Al").gain_needed
    assert kernel.hop_bonds == 6 and ae.Extremal().kernel(tip12).hop_bonds == -1


def hopping_keys(emitter, law, every=False):
    """Keys of all surface atoms of pure nickel by the law with a hop, written in NumPy.

    With `every`, no atom leaves without a hop that it can do at some field.
    """
    tip, charges = emitter.tip, emitter.charges
    pairs = cKDTree(emitter.positions).query_pairs(1.2 * tip.nearest_neighbour_distance, output_type="ndarray")
    strongest = np.zeros(len(emitter))
    np.maximum.at(strongest, pairs[:, 0], charges[pairs[:, 1]])
    np.maximum.at(strongest, pairs[:, 1], charges[pairs[:, 0]])
    gain = (1.27 + 1.54 * strongest / np.maximum(charges, 1e-9)) ** 2 - 1
    hops = (emitter.bonds <= 6) & (strongest > 0) & (charges > 0)
    keys = ae.Extremal().keys(tip, emitter.atoms, emitter.fields, emitter.bonds)
    factor = np.where(hops, np.sqrt(gain / law.gain_needed), 0.0)
    return keys * (factor if every else np.maximum(factor, 1.0))


@pytest.mark.slow
@pytest.mark.parametrize("rule", [ae.Robin(), ae.ConstantPotential()])
def test_the_next_atom_of_the_law_with_a_hop(tip12, rule):
    """Against keys of all atoms in NumPy; keys beyond the patch around a hole are those before the event.

    Measured over 60 events: the same atoms by Robin, at a constant potential one key that is 6e-5 below the largest.
    """
    law = Migration.of("Ni", 150.0)
    emitter = ae.evaporation.Emitter(tip12, law=ae.Extremal(hop=law), rule=rule)
    for _ in range(2):
        atoms, keys = emitter.atoms, hopping_keys(emitter, law)
        assert emitter.evaporate(1).site[0] == atoms[np.argmax(keys)]
        for _ in range(30):
            atoms, keys = emitter.atoms, hopping_keys(emitter, law)
            assert keys[atoms == emitter.evaporate(1).site[0]] > (1 - 5e-4) * keys.max()
        emitter.relax()
    plain = ae.evaporation.Emitter(tip12, rule=rule)
    assert not np.array_equal(sequence(plain), sequence(ae.evaporation.Emitter(tip12, law=emitter.law, rule=rule)))


@pytest.mark.slow
def test_a_hop_does_not_depend_on_threads_and_batches(nickel):
    size, law = 30 * nickel.a, ae.Extremal(hop=Migration.of("Ni"))
    tip = ae.Tip(nickel, size, axis=(1, 1, 1), shank_length=size, depth=6 * nickel.a, offset_seed=1)
    one, three = (ae.evaporation.Emitter(tip, law=law, n_threads=n) for n in (1, 3))
    assert len(one) > 16_384  # keys of fewer atoms are computed by one thread
    assert np.array_equal(sequence(one), np.concatenate([b.site for b in three.advance(60, batch_size=7)]))


def test_a_run_with_hops_is_resumed_bit_by_bit(small_tip, tmp_path):
    def run(n_ions, path=None):
        law, charges = ae.Extremal(hop=Migration.of("Ni")), ae.evaporation.ChargeSettings(sweep_interval=10)
        simulation = ae.Simulation(small_tip, seed=2, law=law, charge_settings=charges)
        checkpoint = None if path is None else ae.simulation.Checkpoint(path, resume=True)
        return simulation.run(n_ions, responses=False, progress=False, checkpoint=checkpoint)

    run(16, tmp_path / "run.h5")
    assert run(26, tmp_path / "run.h5").fingerprint() == run(26).fingerprint()


@pytest.mark.slow
def test_atoms_that_cannot_hop_leave_as_without_the_law():
    """Aluminium's barrier is above all gains."""
    tip = ae.Tip("Al", apex_radius=3.0, axis=(1, 1, 1), offset_seed=1)
    without, with_hop = (ae.evaporation.Emitter(tip, law=ae.Extremal(hop=each)) for each in (None, Migration.of("Al")))
    assert np.array_equal(sequence(without), sequence(with_hop))


@pytest.mark.parametrize(("metal", "bonds"), [("W", 4), ("Ni", 6), ("Ti", 6), ("Si", 2)])
def test_kink_atoms_hop(metal, bonds):
    """Half of the bonds of the bulk are those of a kink."""
    material = replace(ae.material(metal), cohesive_energy=4.0)
    tip = ae.Tip(material, apex_radius=1.5)
    assert ae.Extremal(hop=Migration.of(material)).kernel(tip).hop_bonds == bonds


def test_a_hop_does_not_depend_on_where_ions_can_roll(tip12):
    """phi was solved for nearest neighbours; the second shell is for the responses of ions only."""
    first, second = (
        ae.evaporation.Emitter(tip12, law=ae.Extremal(hop=Migration.of("Ni")), target_shells=shells)
        for shells in (1, 2)
    )
    assert np.array_equal(sequence(first), sequence(second))


@pytest.mark.slow
def test_bonds_change_the_field_of_evaporation_and_not_that_of_the_hop(tip12):
    """With fields that bonds raise out of reach, all atoms leave by a hop; with low ones none does."""
    law = Migration.of("Ni")

    def keys_of(field, hop):
        bonds = ae.evaporation.CoordinationTable({"Ni": dict.fromkeys(range(13), field)})
        return ae.evaporation.Emitter(tip12, law=ae.Extremal(bonds=bonds, hop=hop))

    assert np.array_equal(sequence(keys_of(1.0, law)), sequence(keys_of(1.0, None)))
    high = keys_of(1e3, law)
    atoms, plain = high.atoms, ae.Extremal().keys(tip12, high.atoms, high.fields, high.bonds)
    hopping = hopping_keys(high, law, every=True)
    assert not np.array_equal(hopping, plain) and high.evaporate(1).site[0] == atoms[np.argmax(hopping)]


@pytest.mark.parametrize(
    ("material", "options", "message"),
    [
        ("Ni", {"solutes": {"Al": 0.3}, "seed": 1}, "one metal, but atoms of Ni, Al can evaporate"),
        ("Al", {}, "evaporation field of Al, 19 V/nm, got 35 V/nm"),
    ],
)
def test_a_hop_of_another_metal_is_refused(material, options, message):
    tip = ae.Tip(material, apex_radius=1.5, **options)
    with pytest.raises(ValueError, match=message):
        ae.evaporation.Emitter(tip, law=ae.Extremal(hop=Migration.of("Ni")))


class Bad:
    def __init__(self, value):
        self.value = value

    def keys(self, tip, atoms, fields, bonds):
        return np.full(len(atoms) if np.ndim(self.value) == 0 else 3, self.value)


@pytest.mark.parametrize(
    ("law", "message"),
    [
        (3, "law must be an evaporation law with a method keys"),
        (Bad(np.nan), "keys of Bad must be numbers, got NaN"),
        (Bad(np.ones(3)), "keys of Bad must return .* values, one per atom, got 3"),
        (Bad(-1.0), "law Bad gives no surface atom of .* a key > 0"),
        (Bad(0.0), "law Bad gives no surface atom of .* a key > 0"),
    ],
)
def test_bad_laws_are_refused(small_tip, law, message):
    with pytest.raises(ValueError, match=message):
        ae.evaporation.Emitter(small_tip, law=law)


def test_a_hop_without_a_barrier_is_refused():
    with pytest.raises(ValueError, match="hop must have a barrier above that of evaporation, got Migration"):
        ae.Extremal(hop=Migration(0.1, 20.0, temperature=1000.0))
    with pytest.raises(ValueError, match="hop must be a Migration or None"):
        ae.Extremal(hop=0.66)
