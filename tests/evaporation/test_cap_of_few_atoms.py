"""A cap of fewer than 12 atoms is none, and is refused before the simulation."""

import math

import numpy as np
import pytest

import apt_evap as ae
from apt_evap.evaporation.cap import FEWEST, measure_cap
from apt_evap.evaporation.emitter import Emitter
from apt_evap.simulation.config.simulation_file import read_config

TIP = """
[tip]
material = "Ti"
axis = [0, 0, 1]
apex_radius = "6 a"
shank_length = "6 a"
shank_angle = 1.5
[simulation]
ions = 100
[real_units]
field_reference = "{}"
"""


@pytest.mark.parametrize(("name", "radius"), [
    ("Ti", 5.0), ("Be", 6.0),
    *(pytest.param(*case, marks=pytest.mark.slow) for case in (("Zr", 5.0), ("Mg", 5.0), ("Ti", 6.0))),
])  # fmt: skip
def test_a_facet_is_no_cap(name, radius):
    """The rounds end with 0 to 11 atoms on the facet: before, a field of 0, or 747 V/nm and a radius of 0.43 nm."""
    metal = ae.material(name)
    tip = ae.Tip(metal, apex_radius=radius * metal.a, axis=(0, 0, 1), shank_length=6 * metal.a, shank_angle=1.5)
    assert all(map(math.isnan, Emitter(tip).cap))


def test_the_result_of_the_rounds_is_checked(rng):
    """The fit moves so far down that fewer atoms are around the axis than before."""
    angle = np.linspace(0, 2 * np.pi, FEWEST, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(FEWEST)], axis=1) + 1e-3 * rng.normal(size=(FEWEST, 3))
    normals = np.tile([0.0, 0.0, 1.0], (FEWEST, 1))
    assert math.isnan(measure_cap(ring, normals, np.ones(FEWEST), np.ones(FEWEST)).ratio)


def test_a_tip_without_a_cap_is_refused_before_the_simulation(tmp_path):
    path = tmp_path / "t.toml"
    path.write_text(TIP.format("cap"))
    with pytest.raises(ae.FileError, match=r"t\.toml', \[real_units\]: field_reference = .cap. needs at least 12"):
        read_config(path).simulation(n_threads=1)
    path.write_text(TIP.format("cap").replace('"Ti"', '"Mg"'))
    with pytest.raises(
        ae.FileError, match=r"cap of at least 0\.6 of the apex_radius 1\.93 nm, got 0\.65 nm, on a facet"
    ):
        read_config(path).simulation(n_threads=1)
    path.write_text(TIP.format("cap").replace('"6 a"', '"7 a"').replace('"Ti"', '"Mg"'))
    read_config(path).simulation(n_threads=1)
    path.write_text(TIP.format("site"))
    read_config(path).simulation(n_threads=1)


def test_a_run_of_a_tip_whose_cap_is_on_a_facet_has_no_real_units():
    metal = ae.material("Mg")
    tip = ae.Tip(metal, apex_radius=6 * metal.a, axis=(0, 0, 1), shank_length=6 * metal.a, shank_angle=1.5)
    run = ae.Simulation(tip, seed=1, n_threads=1).run(5, responses=False, progress=False)
    with pytest.raises(ValueError, match=r"apex_radius 1\.93 nm, got 0\.65 nm, on a facet: use a larger apex_radius"):
        run.at_evaporation_field(field_reference="cap")
    assert run.at_evaporation_field(field_reference="site").voltage > 0
