"""Laws: the built-in one, and one of a user's own in Python, behind one contract."""

from dataclasses import dataclass

import numpy as np
import pytest

import apt_evap as ae
from apt_evap._core.law import PythonLaw, WeightedField


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
    assert run.settings["rule"] == {"name": "Robin", "tolerance": 1e-5, "window": 8}


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
