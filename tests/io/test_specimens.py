"""Specimens from LAMMPS and ASE; those of TAPSim are in test_tapsim.py."""

import sys
import time

import numpy as np
import pytest
from ion_files import lammps_data, lammps_dump

import apt_evap as ae
from apt_evap._common.files import FileError

PLACES = np.random.default_rng(2).uniform(1, 9, (12, 3))  # [Angstrom]
TYPES = [1] * 8 + [2] * 4
NAMES = {1: "Al", 2: "Cu"}
EXACT = 1e-14  # [nm] Angstrom to nm: one rounding of numbers up to 30


@pytest.fixture
def save(tmp_path):
    def save(text, name="a.lmp"):
        (tmp_path / name).write_text(text)
        return tmp_path / name

    return save


def check(tip, places=PLACES, factor=0.1):
    np.testing.assert_allclose(tip.positions, factor * places, rtol=0, atol=EXACT * factor / 0.1)
    assert [tip.elements[k].name for k in tip.species] == ["Al"] * 8 + ["Cu"] * 4


def test_a_dump(save):
    check(ae.read_tip(save(lammps_dump(PLACES, TYPES)), NAMES))
    check(ae.read_tip(save(lammps_dump(PLACES, TYPES, "id type xu yu zu")), NAMES))
    check(ae.read_tip(save(lammps_dump(PLACES, ["Al"] * 8 + ["Cu"] * 4, "id element x y z"))))
    check(ae.read_tip(save("ITEM: UNITS\nreal\n" + lammps_dump(PLACES, TYPES)), NAMES))


def test_units(save):
    for units, factor in (("real", 0.1), ("nano", 1.0), ("electron", 0.0529177)):
        tip = ae.read_tip(save(lammps_dump(PLACES, TYPES)), NAMES, units=units)
        np.testing.assert_allclose(tip.positions, factor * PLACES, rtol=1e-6)  # digits of the factor here
    check(ae.read_tip(save("ITEM: UNITS\nsi\n" + lammps_dump(PLACES * 1e-10, TYPES)), NAMES))
    data = lammps_data(PLACES, TYPES).replace("a specimen", "LAMMPS data file via write_data, units = nano")
    check(ae.read_tip(save(data), NAMES), factor=1.0)
    for text in ("ITEM: UNITS\nlj\n" + lammps_dump(PLACES, TYPES), data.replace("nano", "lj")):
        with pytest.raises(FileError, match=r"a\.lmp': units must be one of metal, real, .* got 'lj'"):
            ae.read_tip(save(text), NAMES)


def test_frames(save):
    path = save(lammps_dump(PLACES, TYPES, frames=3))
    check(ae.read_tip(path, NAMES), PLACES + 2)  # the last one
    check(ae.read_tip(path, NAMES, frame=0))
    check(ae.read_tip(path, NAMES, frame=-2), PLACES + 1)
    with pytest.raises(FileError, match="has 3 frames, there is no frame 3"):
        ae.read_tip(path, NAMES, frame=3)
    with pytest.raises(ValueError, match="frame"):
        ae.read_tip(path, NAMES, frame="last")
    with pytest.raises(FileError, match="units"):
        ae.read_tip(path, NAMES, units=["metal"])


def test_scaled_coordinates(save):
    bounds = np.array([(-1.0, 11.0), (0.0, 20.0), (2.0, 30.0)])
    scaled = (PLACES - bounds[:, 0]) / (bounds[:, 1] - bounds[:, 0])
    check(ae.read_tip(save(lammps_dump(scaled, TYPES, "id type xs ys zs", bounds)), NAMES))
    # a tilted box: its bounds in the file are those of the box around it
    xy, xz, yz = 3.0, -2.0, 1.0
    cell = np.array([[12.0, 0, 0], [xy, 20, 0], [xz, yz, 28]])
    low = bounds[:, 0]
    scaled = (PLACES - low) @ np.linalg.inv(cell)
    around = [
        (low[0] + min(0, xy, xz, xy + xz), low[0] + 12 + max(0, xy, xz, xy + xz), xy),
        (low[1] + min(0, yz), low[1] + 20 + max(0, yz), xz),
        (low[2], low[2] + 28, yz),
    ]
    check(ae.read_tip(save(lammps_dump(scaled, TYPES, "id type xsu ysu zsu", around, tilt="xy xz yz ")), NAMES))


@pytest.mark.parametrize("style", ["atomic", "charge", "molecular", "full"])
def test_data(save, style):
    check(ae.read_tip(save(lammps_data(PLACES, TYPES, style)), NAMES))
    check(ae.read_tip(save(lammps_data(PLACES, TYPES, style, more=" 0 0 -1")), NAMES))  # periodic images
    text = lammps_data(PLACES, TYPES, style, comment=False)
    check(ae.read_tip(save(text), NAMES, style=style))
    if style != "atomic":
        with pytest.raises(FileError, match=r"does not state the style of its section Atoms \([67] columns\); style="):
            ae.read_tip(save(text), NAMES)
        with pytest.raises(FileError, match="the style atomic has 5 columns or 8, got"):
            ae.read_tip(save(text), NAMES, style="atomic")


def test_type_labels_are_names(save):
    labels = "Atom Type Labels\n\n1 Al\n2 Cu\n3 H\n\n"
    check(ae.read_tip(save(lammps_data(PLACES, TYPES, labels=labels))))
    check(ae.read_tip(save(lammps_data(PLACES, ["Al"] * 8 + ["Cu"] * 4, labels=labels))))
    strong = ae.material("Al", evaporation_field=25.0)
    tip = ae.read_tip(save(lammps_data(PLACES, TYPES, labels=labels)), {"Al": strong})
    assert tip.evaporation_fields.tolist() == [25.0, 30.0]


def test_types_without_a_name_are_refused(save):
    """ASE makes hydrogen of them."""
    for text in (lammps_dump(PLACES, TYPES), lammps_data(PLACES, TYPES)):
        with pytest.raises(
            FileError, match=r"a\.lmp' has types without a name.* types=\{1: 'Al'\}, got none for 1, 2$"
        ):
            ae.read_tip(save(text))
        with pytest.raises(FileError, match="which ASE reads without the names of its types"):
            ae.read_tip(save(text), NAMES, format="ase")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("ATOMS\n12", "ATOMS\n13", "states 13 atoms but contains 12"),
        ("ATOMS\n12", "ATOMS\nmany", "line 4: expected the number of atoms, got 'many'"),
        ("ITEM: BOX", "ITEM: CAR", "no line ITEM: BOX BOUNDS"),
        ("ITEM: ATOMS", "ITEM: THINGS", "no line ITEM: ATOMS"),
        ("type x y z", "type x y", "no columns x y z"),
        ("id type x", "id kind x", "neither a column type nor a column element"),
        ("\n2 1 ", "\n2 1 red ", "expected numbers for the coordinates"),
        ("\n2 1 ", "\n2 1 nan ", "expected finite coordinates"),
    ],
)
def test_dumps_that_are_wrong(save, old, new, message):
    text = lammps_dump(PLACES, TYPES)
    assert old in text
    with pytest.raises(FileError, match=rf"a\.lmp'.*{message}"):
        ae.read_tip(save(text.replace(old, new, 1)), NAMES)


def test_data_that_are_wrong(save):
    text = lammps_data(PLACES, TYPES)
    with pytest.raises(FileError, match="states 13 atoms but contains 12"):
        ae.read_tip(save(text.replace("12 atoms", "13 atoms")), NAMES)
    with pytest.raises(FileError, match="no section Atoms"):
        ae.read_tip(save(text.replace("Atoms", "Things")), NAMES)
    with pytest.raises(FileError, match="takes units, style, got 'frame'"):
        ae.read_tip(save(text), NAMES, frame=0)
    with pytest.raises(ValueError, match=r"style must be one of atomic, .*did you mean 'full'"):
        ae.read_tip(save(text), NAMES, style="ful")
    with pytest.raises(ValueError, match="types"):
        ae.read_tip(save(text), "Al")


def test_what_ase_reads(save, tmp_path):
    ase = pytest.importorskip("ase")
    atoms = ase.Atoms("Al8Cu4", positions=PLACES)
    for name in ("a.xyz", "a.vasp"):
        atoms.set_cell([10, 10, 10])
        atoms.write(tmp_path / name)
        tip = ae.read_tip(tmp_path / name)
        # ASE writes eight decimals of an Angstrom
        np.testing.assert_allclose(tip.positions, 0.1 * PLACES, rtol=0, atol=0.51e-9)
        assert [tip.elements[k].name for k in tip.species] == ["Al"] * 8 + ["Cu"] * 4
    with pytest.raises(FileError, match=r"b\.txt' as a specimen: "):
        ae.read_tip(save("nothing of the kind\n", "b.txt"))
    # both readers of LAMMPS agree with that of ASE
    from ase.io import read, write

    write(tmp_path / "b.lmp", atoms, format="lammps-data", atom_style="full")
    other = read(tmp_path / "b.lmp", format="lammps-data", atom_style="full")
    tip = ae.read_tip(tmp_path / "b.lmp", NAMES)
    np.testing.assert_allclose(tip.positions, other.positions / 10, rtol=0, atol=EXACT)
    text = lammps_dump(PLACES / [10, 20, 30], TYPES, "id type xs ys zs")
    other = read(save(text), format="lammps-dump-text")
    np.testing.assert_allclose(ae.read_tip(save(text), NAMES).positions, other.positions / 10, rtol=0, atol=EXACT)
    assert set(other.get_chemical_symbols()) == {"H", "He"}  # what is refused here


@pytest.mark.parametrize("name", ["a@1.xyz", "a@all.xyz", "-", "a*.xyz"])
def test_names_that_ase_would_interpret(save, tmp_path, monkeypatch, name):
    """With "a@1.xyz", ASE reads a part of the file "a"."""
    ase = pytest.importorskip("ase")
    from ase.io import write

    write(tmp_path / "a", ase.Atoms("Cu12", positions=PLACES), format="xyz")
    write(tmp_path / "other.xyz", ase.Atoms("Al8Cu4", positions=PLACES))
    (tmp_path / "other.xyz").rename(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    tip = ae.read_tip(name)
    assert [tip.elements[k].name for k in tip.species] == ["Al"] * 8 + ["Cu"] * 4


def test_ase_that_is_not_installed(save, monkeypatch):
    for name in ["ase.io", *(name for name in sys.modules if name.startswith("ase."))]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match="reading this specimen needs ase, which is not installed: pip install ase"):
        ae.read_tip(save("1\n\nAl 0 0 0\n", "a.xyz"))


def test_a_coordinate_far_away(save):
    places = PLACES.copy()
    places[3, 1] = 1e308
    with pytest.raises(FileError, match=r"a\.lmp': positions must be"):
        ae.read_tip(save(lammps_dump(places, TYPES)), NAMES)


@pytest.mark.parametrize(
    ("before", "repeated", "after"),
    [
        ("10 atoms\n0 1 xlo xhi\n\nAtoms # x", " ", "y"),
        ("10 atoms\n0 1 xlo xhi\n\nAtoms", " A", "9"),
        ("0 1 xlo xhi\n1", "\n", "atom"),
    ],
)
def test_repeated_spaces_take_no_quadratic_time(save, before, repeated, after):
    path = save(f"LAMMPS\n\n{before}{repeated * 60_000}{after}\n\n1 1 0 0 0\n")
    begin = time.process_time()
    with pytest.raises(FileError, match=r"a\.lmp"):
        ae.read_tip(path, format="lammps-data")
    assert time.process_time() - begin < 1.5  # 0.05 s; quadratic time: 3 s to a minute
