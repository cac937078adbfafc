"""How a specimen from positions stands, and where its apex is."""

import json
import sys
import warnings

import numpy as np
import pytest
import scipy
from scipy.spatial.transform import Rotation

import apt_evap as ae
from apt_evap.cli.main import main
from apt_evap.specimen import orientation_check
from apt_evap.specimen.orientation_check import apex_sphere, bodies, depths, pointing, upright


@pytest.fixture(scope="session")
def needle(nickel):
    """Positions of a tip with a flat base, R = 2.5 nm, 8.5 nm high."""
    return ae.Tip(nickel, apex_radius=2.5, axis=(1, 1, 1), shank_length=6.0, shank_angle=6.0, base="flat").positions


def tip_of(positions):
    return ae.Tip.from_positions(positions, np.zeros(len(positions), int), ["Ni"])


def test_an_upright_specimen_is_silent(needle, small_tip):
    turned = needle @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    dome = needle[needle[:, 2] > 0.5]
    wire = needle[(np.hypot(*needle.T[:2]) < 1.5) & (needle[:, 2] < 1.0)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for positions in (needle, turned, dome, wire, small_tip.positions, needle + 40.0):
            tip_of(positions)


def test_a_specimen_upside_down_or_on_its_side_is_named(needle):
    with pytest.warns(ae.warnings.SpecimenWarning, match="upside down"):
        tip_of(needle * [1, 1, -1])
    for axes, name in (([2, 1, 0], "x"), ([0, 2, 1], "y")):
        with pytest.warns(ae.warnings.SpecimenWarning, match=f"side.* {name}"):
            tip_of(needle[:, axes])


def test_a_specimen_that_leans_is_named(needle):
    cases = (([0.2, 0.1, 1.0], "leans"), ([1.0, 0.5, -0.2], "lies on its side"), ([-0.6, 0.2, -1.0], "upside down"))
    for axis, seen in cases:
        axis = np.array(axis) / np.linalg.norm(axis)
        turned = Rotation.align_vectors([axis], [[0.0, 0.0, 1.0]])[0].apply(needle)
        # the flat base is cut along a plane of the lattice: half an atom in 8.5 nm
        assert pointing(turned) == pytest.approx(axis, abs=0.02)
        with pytest.warns(ae.warnings.SpecimenWarning, match=seen):
            tip_of(turned)
        assert np.ptp(upright(turned)[:, 2]) == pytest.approx(np.ptp(needle[:, 2]), abs=0.15)  # one plane of atoms


def test_the_sphere_of_the_apex_and_depths_below_it(needle):
    centre, radius = apex_sphere(needle + np.array([3.0, -2.0, 7.0]))
    assert radius == pytest.approx(2.5, abs=0.12)  # half a nearest neighbour distance: the surface is of atoms
    assert centre == pytest.approx([3.0, -2.0, 7.0], abs=0.15)
    places = np.array([[0.0, 0.0, 2.0], [1.0, 0.0, np.sqrt(2.5**2 - 1) - 0.7], [2.6, 0.0, 0.0]])
    assert depths(places, np.zeros(3), 2.5) == pytest.approx([0.5, 0.7, np.nan], nan_ok=True)


def test_info_of_a_specimen(needle, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    types = np.where(np.linalg.norm(needle - [0, 0, 1.0], axis=1) < 0.7, 2, 1)  # a particle, 0.8 nm below the apex

    def dump(places):  # Angstrom
        rows = "".join(f"{k + 1} {t} {x} {y} {z}\n" for k, (t, (x, y, z)) in enumerate(zip(types, places, strict=True)))
        (tmp_path / "tip.dump").write_text(
            f"ITEM: TIMESTEP\n0\nITEM: NUMBER OF ATOMS\n{len(needle)}\nITEM: BOX BOUNDS ff ff ff\n"
            f"-100 100\n-100 100\n-100 100\nITEM: ATOMS id type x y z\n{rows}"
        )

    dump(10 * needle)
    assert main(["info", "tip.dump", "--types", "1=Ni,2=Al", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["format"] == "lammps-dump" and told["obstacles_to_a_simulation"] == []
    assert told["atoms"] == len(needle) and told["species"] == {
        "Ni": int((types == 1).sum()),
        "Al": int((types == 2).sum()),
    }
    assert told["height"] == pytest.approx(np.ptp(needle[:, 2]), abs=1e-4) and told["points_along"] == [0, 0, 1]
    assert told["apex_radius"] == pytest.approx(2.5, abs=0.12)
    # caps of a sphere of 2.5 nm that moves down, at 91.4 atoms / nm^3, before the top and the bottom of the particle
    area = np.pi * 2.5**2
    above = told["atoms_above"]["Al"]
    assert above["its_first_atom"] == pytest.approx(91.4 * area * 0.8, rel=0.2)
    assert above["its_first_atom"] < above["a_tenth_of_them"] < above["nine_tenths_of_them"] < 91.4 * area * 2.2
    assert main(["info", "tip.dump", "--types", "1=Ni,2=Al"]) == 0
    text = capsys.readouterr().out
    assert "apex radius [nm]" in text and "height [nm]" in text
    assert main(["info", "tip.dump", "--types", "1"]) == 2 and "--types" in capsys.readouterr().err
    # what does not have names yet, or names that are not known, or lies on its side, is described all the same
    for of_types in ([], ["--types", "1=Ni,2=Kryptonite"]):
        assert main(["info", "tip.dump", "--json", *of_types]) == 0
        unnamed = json.loads(capsys.readouterr().out)
        assert unnamed["apex_radius"] == told["apex_radius"] and len(unnamed["obstacles_to_a_simulation"]) == 1
        assert list(unnamed["atoms_above"].values()) == [above]
    dump(10 * needle[:, [2, 1, 0]])
    assert main(["info", "tip.dump", "--types", "1=Ni,2=Al", "--json"]) == 0
    lying = json.loads(capsys.readouterr().out)
    assert lying["points_along"] == pytest.approx([1, 0, 0], abs=0.02)
    assert lying["apex_radius"] == pytest.approx(told["apex_radius"], abs=0.05)  # turned by up to 0.02
    assert "side" in " ".join(lying["obstacles_to_a_simulation"])


def test_info_of_a_specimen_without_ase(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ase.io", None)
    (tmp_path / "tip.cif").write_text("data_tip\n")
    assert main(["info", str(tmp_path / "tip.cif")]) == 2 and "ase" in capsys.readouterr().err


def test_positions_in_another_unit_are_refused(needle):
    units = ((10, "Angstrom", "nm"), (1 / 0.052917721, "Bohr radii", "nm"), (1e3, "pm", "nm"), (0.1, "nm", "Angstrom"))
    for factor, supposed, read in units:
        with pytest.raises(ValueError, match=f"wrong unit: .*, as if {supposed} had been taken for {read}$"):
            tip_of(factor * needle)


def test_atoms_that_are_too_close_or_too_far_in_any_unit_are_warned_of(needle):
    """Reduced units of LAMMPS, for example: neighbours at 1.1, read in nm or in Angstrom."""
    for distance in (1.1, 0.11):
        with pytest.warns(ae.warnings.SpecimenWarning, match=rf"neighbouring atoms are {distance} nm apart"):
            tip_of(distance / 0.249 * needle)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for factor in (0.7, 1.4):  # oxides and swollen crystals
            tip_of(factor * needle)


def test_several_bodies_are_warned_of_with_their_atoms(needle):
    quarters = np.bincount(2 * (needle[:, 0] < 0) + (needle[:, 1] < 0))
    expected = ", ".join(f"{size:,}" for size in sorted(quarters, reverse=True))
    with pytest.warns(ae.warnings.SpecimenWarning, match=f"not one body but 4 that do not touch, of {expected} atoms"):
        tip_of(np.column_stack([needle[:, :2] % 9.0, needle[:, 2]]))  # as LAMMPS wraps it
    aside = np.vstack([needle, [0.0, 0.0, 3.5]])  # one that has evaporated
    with pytest.warns(ae.warnings.SpecimenWarning, match=f"but 2 that do not touch, of {len(needle):,}, 1 atoms"):
        tip_of(aside)


def test_bodies_are_those_of_the_complete_graph(monkeypatch):
    """Atoms at random near the percolation threshold, in slabs of 300 atoms."""
    monkeypatch.setattr(orientation_check, "_SLAB", 300)
    places = np.random.default_rng(4).uniform(0, 10, (2000, 3))
    for reach in (0.6, 0.8, 1.0):
        near = scipy.spatial.distance.cdist(places, places) <= reach
        n, expected = scipy.sparse.csgraph.connected_components(near)
        pairs = set(zip(bodies(places, reach).tolist(), expected.tolist(), strict=True))
        assert 1 < n == len(pairs)  # a one-to-one relation of both numberings
