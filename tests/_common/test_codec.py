"""Settings that are declared once: checks, plain form, texts and documentation follow from the declaration."""

import copy
import doctest
import inspect
import json
import pickle
from dataclasses import FrozenInstanceError

import numpy as np
import pytest

import apt_evap as ae
from apt_evap._common.codec import (
    changed,
    checked,
    choice,
    count,
    declared,
    for_json,
    from_plain,
    is_settings,
    number,
    part,
    settings,
    switch,
    to_plain,
    to_python,
    vector,
)
from apt_evap.maps.registration.polynomial import Distortion

NICKEL = ae.material("Ni")
EXAMPLES = [
    ae.TruncatedNormal(0.1, 0.2),
    ae.emission.Thermal(50.0),
    ae.Unperturbed(0.1),
    ae.LateralVelocity(0.2),
    ae.RollUp(ae.emission.Thermal(20.0), ae.emission.ChargeRatio(0.9, 0.05), others=0.1),
    ae.RollUp(0.2, ae.emission.Migration(4.44, 35.0, temperature=60.0)),
    ae.Combined(0.2, 0.75, sharpness=0.4),
    ae.evaporation.ChargeSettings(tolerance=1e-3, sweep_interval=50),
    ae.simulation.FlightSettings(reach=2000.0),
    ae.ResponseSettings(),
    ae.ResponseSettings(height=0.15, shells=2),
    ae.simulation.Monitor(interval=20),
    ae.Detector(90.0, 80.0, "equidistant"),
    ae.Instrument(dead_time=3.0, quantisation=(0.1, 0.2), timing=ae.detection.Timing(0.3, 50.0)),
    ae.emission.PostIonisation(0.74),
    ae.Robin(window=3),
    ae.ConstantPotential(15.0, "gaussian", "others"),
    ae.evaporation.VoltageControl(0.02, memory=100),
    ae.Extremal(ae.evaporation.CoordinationTable({"W": {3: 47.0, 4: 57.0}})),
    ae.Arrhenius(
        50.0,
        {"Al": 0.8},
        laser=ae.evaporation.Laser(150.0, direction=(0, 1)),
        bonds=ae.evaporation.PairEnergies(ordering={"A-B": 1}),
    ),
    NICKEL,
    ae.Orientation(NICKEL, (1, 1, 1), 10.0),
    ae.specimen.Ellipsoid((0, 0, 1), (1, 2, 3)),
    ae.specimen.CoreShell(ae.specimen.Union((ae.specimen.Sphere((0, 0, 2), 1.2), ae.specimen.Layer(0.0, 1.0))), 0.5),
    ae.specimen.Segregation(0.01, 0.2, 0.4, ae.specimen.HalfSpace((2, 0, 0), (1, 0, 0))),
    ae.specimen.Superlattice("L1_2", {"Al": 0.8, "Ti": 0.2}),
    ae.specimen.UnitCell(("Al", None, {"Al": 0.5, "Ti": 0.5}, None)),
    ae.specimen.Phase(
        "ball",
        NICKEL,
        ae.specimen.Sphere((0, 0, 2), 1.2),
        (1, 1, 1),
        3.0,
        ae.specimen.Superlattice("L1_2", "Al"),
        {"Cu": 0.1},
    ),
    Distortion(2, (0.0, 1.0), 20.0, (1j, 0.1, 0.2 + 1j, 0.3)),
    ae.Registration(10.0, 0.5, (1.0, 2.0), True, ties=(ae.Registration(0.0, 1.0, (0, 0)),)),
]


def name_of(example):
    return type(example).__name__


@pytest.mark.parametrize("example", EXAMPLES, ids=name_of)
def test_settings_come_back_from_json(example):
    plain = for_json(example)
    again = from_plain(json.loads(json.dumps(plain, allow_nan=False)), type(example))
    assert type(again) is type(example) and for_json(again) == plain
    assert is_settings(again) and pickle.loads(pickle.dumps(example)).__class__ is type(example)
    assert for_json(copy.deepcopy(example)) == plain


@pytest.mark.parametrize("example", EXAMPLES, ids=name_of)
def test_every_field_is_documented_with_its_unit(example):
    for name, setting in declared(type(example)).items():
        (line,) = [line for line in type(example).__doc__.splitlines() if line.strip().startswith(f"{name} : ")]
        assert not setting.unit or f"[{setting.unit}]" in line
        assert setting.text.split()[0] in type(example).__doc__


@pytest.mark.parametrize("example", EXAMPLES[:20], ids=name_of)
def test_python_text_is_the_same_object(example):
    assert eval(to_python(example), {"ae": ae}) == example


def test_numbers_of_a_representation_are_short():
    """Not so those of `to_python`, which gives the same settings."""
    third = 1 / 3
    emission = ae.RollUp(ae.TruncatedNormal(third, 0.1))
    assert repr(emission) == "RollUp(TruncatedNormal(0.333333, 0.1))" and repr(third) in to_python(emission)
    registration = ae.Registration(third, 0.25, (third, 2.0))
    assert repr(registration).startswith("Registration(rotation=0.333333, scale=0.25, shift=(0.333333, 2.0), ")


@settings
class Pulse:
    """Pulses.

    Notes
    -----
    A note.
    """

    width: float = number("Standard deviation. Of the top.", above=0, below=5, unit="ns")
    shots: int | None = count("Number.", default=None, at_least=1)
    on: bool = switch("Whether.", default=True)
    form: str = choice("Form.", ("round", "flat"), default="round")
    place: tuple = vector("Where.", 2, default=(0.0, 1.0), at_least=0, unit="nm")
    inner: ae.emission.Thermal | None = part("Another.", ae.emission.Thermal, default=None)
    names: dict = checked("Names.", "mapping", lambda names, name: dict(names), default={})

    def _check(self):
        if self.shots == 13:
            raise ValueError("shots must not be 13")
        return {"names": {**self.names, "checked": 1}}


def test_the_docstring_gains_the_parameters_before_the_notes():
    lines = [line.strip() for line in Pulse.__doc__.splitlines()]
    assert lines.index("Parameters") < lines.index("width : float [ns] > 0 and < 5") < lines.index("Notes")
    assert 'form : {"round", "flat"}, default \'round\'' in lines and "shots : int >= 1, optional" in lines


def test_examples_stay_after_the_parameters():
    @settings
    class Shot:
        """One pulse.

        Examples
        --------
        >>> Shot(width=2.0).width  # ns
        2.0
        """

        width: float = number("Standard deviation.", above=0, unit="ns")

    lines = inspect.getdoc(Shot).splitlines()
    assert lines[:3] == ["One pulse.", "", "Parameters"]
    assert lines.index("width : float [ns] > 0") < lines.index("Examples")
    (test,) = doctest.DocTestFinder().find(Shot, "Shot", globs={"Shot": Shot})
    assert doctest.DocTestRunner().run(test) == (0, 1)


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ({"width": 0.0}, "width"),
        ({"width": 5.0}, "width"),
        ({"width": "1"}, "width"),
        ({"width": np.nan}, "width"),
        ({"width": 1, "shots": 0}, "shots"),
        ({"width": 1, "shots": 13}, "13"),
        ({"width": 1, "on": 1}, "on"),
        ({"width": 1, "form": "square"}, "form"),
        ({"width": 1, "place": (1, 2, 3)}, "place"),
        ({"width": 1, "place": (1, -2)}, "place"),
        ({"width": 1, "inner": 3}, "inner"),
        ({"width": None}, "width"),
    ],
)
def test_each_field_is_checked_with_its_name(values, word):
    for make in (lambda: Pulse(**values), lambda: from_plain(values, Pulse)):
        with pytest.raises(ValueError, match=word) as caught:
            make()
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "plain", [None, 3, {}, {"width": 1, "hight": 2}, {"name": "Laser", "width": 1}, {"name": "Pulse"}]
)
def test_a_plain_form_that_does_not_fit_is_refused(plain):
    with pytest.raises(ValueError):
        from_plain(plain, Pulse)


DEEP: list = []
for _ in range(2_000):
    DEEP = [DEEP]
ODD = (
    5,
    -1.5,
    "x",
    "x" * 100_000,
    True,
    [],
    [1, 2],
    [[1]],
    [[1, 2, 3]],
    {},
    {"a": 1},
    [None] * 3,
    10**400,
    [10**400] * 3,
)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: type(example).__name__)
def test_no_value_of_a_field_escapes_the_checks(example):
    """A value is taken, or refused in a short sentence; whatever its type."""
    plain = to_plain(example)
    for name in declared(type(example)):
        for odd in (*ODD, DEEP, {"name": name, "x": DEEP}, None):
            try:
                from_plain({**plain, name: odd}, type(example))
            except ValueError as error:
                assert 0 < len(str(error)) < 1_000 and "\n" not in str(error)


@pytest.mark.parametrize(
    ("kind", "plain", "field"),
    [
        (ae.emission.Mixture, {"perturbations": 5}, "perturbations"),
        (ae.specimen.Phase, {"name": "m", "material": "Ni", "solutes": [1, 2]}, "solutes"),
        (ae.specimen.Phase, {"name": "m", "material": "Ni", "solutes": [["Al"]]}, "solutes"),
        (ae.specimen.Phase, {"name": "m", "material": "Ni", "solutes": [["Al", 0.1], ["Al", 0.2]]}, "solutes"),
        (ae.specimen.Superlattice, {"prototype": "L1_2", "second": [0, 0, 0]}, "second"),
        (ae.specimen.Superlattice, {"prototype": "L1_2", "second": [["Al", 0.5], ["Al", 0.5]]}, "second"),
        (ae.specimen.Union, {"regions": None}, "regions"),
        (ae.Registration, {"rotation": 0.0, "scale": 1.0, "shift": [0, 0], "ties": 3}, "ties"),
        (ae.Registration, {"rotation": 0.0, "scale": 1.0, "shift": [0, 0], "ties": [3]}, "ties"),
        (ae.Registration, {"rotation": 0.0, "scale": 1.0, "shift": [0, 0], "score": "high"}, "score"),
        (ae.Registration, {"rotation": 0.0, "scale": 1.0, "shift": [0, 0], "score": 10**400}, "score"),
        (ae.Registration, {"rotation": 0.0, "scale": 1.0, "shift": [0, 0], "method": 3}, "method"),
        (ae.studies.DatasetSettings, {"instrument": {"integer": [0, 10]}}, "instrument"),
        (ae.studies.DatasetSettings, {"instrument": {"uniform": [0, 10]}}, "instrument"),
    ],
)
def test_the_field_is_named_also_if_its_conversion_stops(kind, plain, field):
    with pytest.raises(ValueError, match=field):
        from_plain(plain, kind)


def test_an_element_occurs_once():
    for solutes in ({"Al": 0.1, ae.material("Al"): 0.2}, {ae.material("Al"): 0.1, "Al": 0.1}):
        with pytest.raises(ValueError, match="Al"):
            ae.Tip(NICKEL, apex_radius=2.0, solutes=solutes)
    again = from_plain(to_plain(ae.specimen.Phase("m", NICKEL, solutes={"Al": 0.1, "Cu": 0.2})), ae.specimen.Phase)
    assert {element.name: fraction for element, fraction in again.solutes.items()} == {"Al": 0.1, "Cu": 0.2}


def test_values_are_converted_defaults_are_not_shared_and_nothing_can_be_set():
    pulse = Pulse(np.float32(1.5), np.int64(3), place=[1, 2])
    assert type(pulse.width) is float and type(pulse.shots) is int and pulse.place == (1.0, 2.0)
    assert pulse.names == {"checked": 1} and Pulse(1).names is not Pulse(2).names
    with pytest.raises(FrozenInstanceError):
        pulse.width = 2.0


def test_short_forms_leave_defaults_out():
    assert to_plain(ae.RollUp(0.2), short=True) == {"name": "RollUp", "energy": 0.2}
    assert to_python(ae.RollUp(0.2, sharpness=0.4)) == "ae.RollUp(0.2, sharpness=0.4)"
    assert changed(ae.Detector(), {"width": 80.0}) == ae.Detector(100.0, 80.0)
    with pytest.raises(ValueError, match="width"):
        changed(ae.Detector(), {"widht": 80.0})


def test_plain_forms_of_other_objects():
    class Law:
        def __init__(self):
            self.power, self._hidden = np.float64(2.0), 3

    assert to_plain(Law()) == {"name": "Law", "power": 2.0}
    assert to_plain({1: np.arange(2), "a": 1 + 2j, "f": len}) == {"1": [0, 1], "a": [1.0, 2.0], "f": "builtins.len"}
    assert for_json([np.nan, np.inf, 1.0]) == [None, None, 1.0]
    assert to_plain({ae.emission.Thermal(1.0): 0.5}) == [[{"name": "Thermal", "temperature": 1.0}, 0.5]]
    assert not is_settings(type("Mine", (ae.Unperturbed,), {})())
