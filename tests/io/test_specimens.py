"""Specimens from LAMMPS and ASE; those of TAPSim are in test_tapsim.py."""

import bz2
import gzip
import lzma
import sys
import time
import tracemalloc
import warnings

import numpy as np
import pytest
from ion_files import lammps_data, lammps_dump, tapsim_nodes

import apt_evap as ae
from apt_evap._common.files import FileError
from apt_evap.warnings import SpecimenWarning

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
    check(ae.read_tip(save(lammps_data(PLACES, TYPES, style, more=" 0 0 0")), NAMES))  # periodic images
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
    for text in (lammps_dump(PLACES, TYPES), lammps_data(PLACES, TYPES).replace(" # Al", "")):
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
        ("id type x", "id kind x", "no column type, typelabel or element"),
        ("\n2 1 ", "\n2 1 red ", "line 11: expected 5 columns with finite coordinates of an atom, got '2 1 r"),
        ("\n2 1 ", "\n2 1 nan ", "line 11: expected 5 columns with finite coordinates of an atom, got '2 1 n"),
        ("\n2 1 ", "\n2 1 1_0 ", "line 11: expected 5 columns with finite coordinates of an atom, got '2 1 1_0"),
        ("\n2 1 ", "\n\n2 1 ", "line 11: expected 5 columns with finite coordinates of an atom, got ''"),
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


def test_a_poscar_with_more_atoms_than_bytes_is_refused_before_they_are_listed(tmp_path):
    ase = pytest.importorskip("ase")
    path = tmp_path / "POSCAR"
    ase.Atoms("Al8Cu4", positions=PLACES, cell=[10, 10, 10]).write(path, format="vasp")
    lines = path.read_text().splitlines(keepends=True)
    assert lines[6].split() == ["8", "4"]
    path.write_text("".join([*lines[:6], " 8  49976020537\n", *lines[7:]]))
    with pytest.raises(FileError, match=r"POSCAR', line 7: expected the numbers of the atoms, got '8 49976020537' in"):
        ae.read_tip(path)


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
        ae.read_tip(save("data_a\n", "a.cif"))


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


@pytest.mark.parametrize("tilted", [False, True])
@pytest.mark.parametrize(
    "columns", ["x y z ix iy iz", "xs ys zs ix iy iz", "x y z iy", "xu yu zu ix iy iz", "x y z xu yu zu"]
)
def test_atoms_in_other_periodic_images_are_unwrapped(save, columns, tilted):
    """A needle on the edge of a periodic box is one body, not four quarters."""
    low, (xy, xz, yz) = np.array([-1.0, 0.0, 2.0]), (3.0, -2.0, 1.0) if tilted else (0.0, 0.0, 0.0)
    cell = np.array([[12.0, 0, 0], [xy, 20, 0], [xz, yz, 28]])
    around = np.array([(0, 12.0), (0, 20.0), (0, 28.0)]) + low[:, None]
    around += [(min(0, xy, xz, xy + xz), max(0, xy, xz, xy + xz)), (min(0, yz), max(0, yz)), (0, 0)]
    bounds = [(*row, tilt) if tilted else tuple(row) for row, tilt in zip(around, (xy, xz, yz), strict=True)]
    flags = np.random.default_rng(1).integers(-3, 4, (12, 3))
    if columns == "x y z iy":
        flags *= [0, 1, 0]
    wrapped = PLACES - flags @ cell
    values = {
        **dict(zip(("x", "y", "z"), wrapped.T, strict=True)),
        **dict(zip(("xs", "ys", "zs"), ((wrapped - low) @ np.linalg.inv(cell)).T, strict=True)),
        **dict(zip(("xu", "yu", "zu"), PLACES.T, strict=True)),
        **dict(zip(("ix", "iy", "iz"), flags.T, strict=True)),
    }
    rows = np.column_stack([values[name] for name in columns.split()])
    text = lammps_dump(rows, TYPES, f"id type {columns}", bounds, tilt="xy xz yz " if tilted else "")
    tip = ae.read_tip(save(text), NAMES)
    np.testing.assert_allclose(tip.positions, 0.1 * PLACES, rtol=0, atol=1e-13)  # three boxes of 28 Angstrom


@pytest.mark.parametrize("style", ["atomic", "full", "sphere"])
def test_periodic_images_of_a_data_file(save, style):
    cell = np.array([[10.0, 0, 0], [3, 20, 0], [-2, 1, 30]])
    vectors = "10 0 0 avec\n3 20 0 bvec\n-2 1 30 cvec\n0 0 0 abc origin\n"
    flags = np.random.default_rng(1).integers(-3, 4, (12, 3))
    boxes = {"": np.diag(np.diag(cell)), "3 -2 1 xy xz yz\n": cell, vectors: cell}
    for tilt, vectors in boxes.items():
        before = {"atomic": "{k} {t}", "full": "{k} 1 {t} 0.5", "sphere": "{k} {t} 3.0 7.8"}[style]
        rows = [
            f"{before.format(k=k, t=kind)} {' '.join(map(repr, place.tolist()))} {' '.join(map(str, flag))}"
            for k, (kind, place, flag) in enumerate(zip(TYPES, PLACES - flags @ vectors, flags, strict=True), 1)
        ]
        head = "12 atoms\n2 atom types\n0 10 xlo xhi\n0 20 ylo yhi # a box\n0 30 zlo zhi\n"
        text = "\n".join([f"a specimen\n\n{head}{tilt}\nAtoms # {style}\n", *rows, ""])
        tip = ae.read_tip(save(text), NAMES)
        np.testing.assert_allclose(tip.positions, 0.1 * PLACES, rtol=0, atol=1e-13)
    with pytest.raises(FileError, match="periodic images, but not the bounds of its box"):
        ae.read_tip(save(text.replace("bvec", "dvec")), NAMES, format="lammps-data")
    with pytest.raises(FileError, match=r"expected integers for the periodic images, got 0\.5"):
        ae.read_tip(save(text.replace(rows[3], rows[3].rpartition(" ")[0] + " 0.5")), NAMES)


def test_numbers_of_types_are_those_of_the_column_type(save):
    """LAMMPS writes the element C for every atom unless it is told the names."""
    lines = [*lammps_dump(PLACES, TYPES).splitlines()[:8], "ITEM: ATOMS id type element x y z"]
    rows = [
        f"{k} {kind} C {' '.join(map(repr, place.tolist()))}"
        for k, (kind, place) in enumerate(zip(TYPES, PLACES, strict=True), 1)
    ]
    text = "\n".join([*lines, *rows, ""])
    check(ae.read_tip(save(text), NAMES))
    with pytest.raises(FileError, match=r"the element C for all atoms, as LAMMPS writes it .* types=\{1: 'Al'\}"):
        ae.read_tip(save(text))
    carbon = ae.Material("C", "fcc", 0.4, 60.0, 2, 12.0)
    assert ae.read_tip(save(text), {"C": carbon}).elements == (carbon,)
    named = text.replace(" 1 C ", " 1 Al ").replace(" 2 C ", " 2 Cu ")
    check(ae.read_tip(save(named)))
    strong = ae.material("Cu", evaporation_field=25.0)
    tip = ae.read_tip(save(named), {2: strong})  # the other name is that of the file
    assert tip.evaporation_fields.tolist() == [19.0, 25.0]
    with pytest.raises(FileError, match="has no atoms of type '3'"):
        ae.read_tip(save(named), {3: "Cu"})


def test_names_of_types_in_the_file(save):
    check(ae.read_tip(save(lammps_dump(PLACES, ["Al"] * 8 + ["Cu"] * 4, "id typelabel x y z"))))
    masses = lammps_data(PLACES, TYPES).replace("2 63.55", "2 63.55  # (Cu) copper")
    check(ae.read_tip(save(masses)))
    check(ae.read_tip(save(masses), NAMES))
    assert {each.name for each in ae.read_tip(save(masses), {2: "Ni"}).elements} == {"Al", "Ni"}
    with pytest.raises(FileError, match=r"got none for 2$"):
        ae.read_tip(save(lammps_data(PLACES, TYPES).replace("2 63.55", "2 63.55 # the second")))


def test_styles_that_are_not_read_are_named(save):
    text = lammps_data(PLACES, TYPES)
    with pytest.raises(FileError, match="states the style 'hybrid' of its section Atoms, which is not read"):
        ae.read_tip(save(text.replace("# atomic", "# hybrid sphere")), NAMES)


def test_a_frame_that_was_not_finished(save):
    path = save(lammps_dump(PLACES, TYPES, frames=2) + "ITEM: TIMESTEP\n2\n")
    with pytest.raises(FileError, match=r"NUMBER OF in frame 2, as in a LAMMPS dump; the frame before is frame=1"):
        ae.read_tip(path, NAMES)
    check(ae.read_tip(path, NAMES, frame=1), PLACES + 1)


@pytest.mark.parametrize("opener", [gzip.open, bz2.open, lzma.open])
@pytest.mark.parametrize("text", [lammps_dump(PLACES, TYPES), lammps_data(PLACES, TYPES)])
def test_compressed_files(tmp_path, opener, text):
    """ASE would make hydrogen and helium of the types."""
    path = tmp_path / "a.dump.gz"  # the first bytes decide, not the suffix
    with opener(path, "wt") as file:
        file.write(text)
    check(ae.read_tip(path, NAMES))
    data = path.read_bytes()
    for cut in (20, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:cut])
        with pytest.raises(FileError, match=r"a\.dump\.gz'"):
            ae.read_tip(path, NAMES, format="lammps-dump")


def test_compressed_files_of_ase_and_other_compressions(tmp_path):
    ase = pytest.importorskip("ase")
    ase.Atoms("Al8Cu4", positions=PLACES, cell=[10, 10, 10]).write(tmp_path / "a.vasp")
    (tmp_path / "a.vasp.xz").write_bytes(lzma.compress((tmp_path / "a.vasp").read_bytes()))
    np.testing.assert_allclose(ae.read_tip(tmp_path / "a.vasp.xz").positions, 0.1 * PLACES, rtol=0, atol=0.51e-9)
    for name, magic in (("a.dump.zst", b"(\xb5/\xfd"), ("a.zip", b"PK\3\4")):
        (tmp_path / name).write_bytes(magic + bytes(40))
        with pytest.raises(FileError, match=rf"{name}' cannot be decompressed .* only gzip, bzip2, xz are supported"):
            ae.read_tip(tmp_path / name)


@pytest.mark.slow
@pytest.mark.parametrize("compress", [gzip.compress, bz2.compress, lzma.compress])
def test_a_small_file_cannot_fill_the_memory(tmp_path, compress):
    head = lammps_dump(PLACES, TYPES).encode()
    (tmp_path / "bomb.gz").write_bytes(compress(head + b" " * (1 << 26)))
    tracemalloc.start()
    with pytest.raises(FileError, match=r"bomb\.gz' has more than 16,777,216 bytes after decompression"):
        ae.read_tip(tmp_path / "bomb.gz", NAMES)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 26


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32"])
def test_encodings_of_windows(tmp_path, encoding):
    nodes = tapsim_nodes(PLACES * 1e-10, [10] * 8 + [20] * 4).decode()
    for text in (lammps_dump(PLACES, TYPES), lammps_data(PLACES, TYPES), nodes):
        (tmp_path / "a.txt").write_bytes(text.encode(encoding))
        check(ae.read_tip(tmp_path / "a.txt", {10: "Al", 20: "Cu"} if text is nodes else NAMES))


def xyz(types, places=PLACES, comment="", after=""):
    rows = "".join(
        f"{kind} {' '.join(map(repr, place.tolist()))}{after}\n" for kind, place in zip(types, places, strict=True)
    )
    return f"{len(types)}\n{comment}\n{rows}"


def test_xyz_with_any_names_of_types(save):
    """LAMMPS writes the numbers of its types there, and so does OVITO."""
    symbols = ["Al"] * 8 + ["Cu"] * 4
    check(ae.read_tip(save(xyz(symbols), "a.xyz")))
    for text in (xyz(TYPES, comment="Atoms. Timestep: 0"), xyz(TYPES, comment="Properties=species:I:1:pos:R:3")):
        check(ae.read_tip(save(text, "a.xyz"), NAMES))
        with pytest.raises(FileError, match=r"a\.xyz' has types without a name.* got none for 1, 2$"):
            ae.read_tip(save(text, "a.xyz"))
    check(ae.read_tip(save(xyz(["A"] * 8 + ["B"] * 4), "a.xyz"), {"A": "Al", "B": "Cu"}))
    check(ae.read_tip(save(xyz([13] * 8 + [29] * 4, comment='Properties="Z:I:1:pos:R:3"'), "a.extxyz")))
    check(ae.read_tip(save(xyz(symbols) + xyz(symbols, PLACES + 2), "a.xyz"), frame=0))
    check(ae.read_tip(save(xyz(symbols) + xyz(symbols, PLACES + 2) + "\n", "a.xyz")), PLACES + 2)
    check(ae.read_tip(save(xyz(symbols), "a.xyz"), units="nano"), factor=1.0)
    for text, message in (
        (xyz(symbols) + "Al 1 2 3\n", "line 15: expected the number of atoms, got 'Al 1 2 3'"),
        (xyz(symbols).replace("12", "13", 1), "states 13 atoms but contains 12"),
        (xyz(symbols, comment="Properties=species:S:1:force:R:3"), "expected columns species and pos of each atom"),
        (xyz(symbols, comment="Properties=species:S:x"), "expected Properties=species:S:1:pos:R:3"),
        (xyz(symbols).replace("Cu", "Cu x", 1), "line 11: expected 4 columns with finite coordinates"),
        (xyz(["AL"] * 8 + ["Cu"] * 4), r"no chemical symbols: name their elements, such as types=\{'AL': 'Al'\}"),
    ):
        with pytest.raises(FileError, match=rf"a\.xyz'.*{message}"):
            ae.read_tip(save(text, "a.xyz"))


def test_xyz_as_ase_writes_it(tmp_path):
    ase = pytest.importorskip("ase")
    from ase.io import write

    atoms = ase.Atoms("Al8Cu4", positions=PLACES, cell=[10, 10, 10], pbc=True)
    atoms.new_array("evaporable", np.arange(12) > 3)
    atoms.new_array("forces", np.ones((12, 3)))
    write(tmp_path / "a.xyz", [atoms, atoms], format="extxyz")
    tip = ae.read_tip(tmp_path / "a.xyz")
    np.testing.assert_allclose(tip.positions, 0.1 * PLACES, rtol=0, atol=0.51e-9)
    assert tip.evaporable.tolist() == (np.arange(12) > 3).tolist()


def test_frames_of_ase(tmp_path):
    ase = pytest.importorskip("ase")
    from ase.io import write

    symbols = "Al8Cu4"
    write(tmp_path / "a.traj", [ase.Atoms(symbols, positions=PLACES + shift) for shift in (0, 1, 2)])
    check(ae.read_tip(tmp_path / "a.traj", frame=1), PLACES + 1)
    check(ae.read_tip(tmp_path / "a.traj"), PLACES + 2)
    with pytest.raises(FileError, match=r"a\.traj' has no frame 7"):
        ae.read_tip(tmp_path / "a.traj", frame=7)
    with pytest.raises(ValueError, match="frame must be an integer, got ':'"):
        ae.read_tip(tmp_path / "a.traj", frame=":")


def test_what_ase_cannot_read_is_said_in_a_sentence(save):
    pytest.importorskip("ase")
    yaml = (
        "---\ncreator: LAMMPS\ntimestep: 0\nnatoms: 1\nkeywords: [id, type, x, y, z]\ndata:\n  - [1, 1, 0, 0, 0]\n...\n"
    )
    with pytest.raises(FileError, match=r"a\.yaml' is a LAMMPS dump in YAML, expected one of style custom"):
        ae.read_tip(save(yaml, "a.yaml"), {1: "Al"})
    pdb = "ATOM      1  Q1  MOL     1       0.000   0.000   0.000  1.00  0.00          Qq\n"
    for text, name in (("nothing\n", "a.dat"), (pdb, "a.pdb"), ("# 1\n", "a.cfg")):
        with pytest.raises(FileError, match=r"a\.\w+' as a specimen: expected .* says: \w+: ") as caught:
            ae.read_tip(save(text, name))
        assert "\n" not in str(caught.value)
    # ASE finds a dump behind other lines, too, and takes the numbers of its types for atomic numbers
    with pytest.raises(FileError, match="whose types ASE reads as atomic numbers"):
        ae.read_tip(save("a comment\n" + lammps_dump(PLACES, TYPES), "a.txt"), NAMES)


CIF = """data_a
_cell_length_a 4
_cell_length_b 4
_cell_length_c 4
_cell_angle_alpha 90
_cell_angle_beta 90
_cell_angle_gamma 90
_space_group_name_H-M_alt 'P 1'
loop_
_atom_site_label
_atom_site_type_symbol
_atom_site_fract_x
_atom_site_fract_y
_atom_site_fract_z
_atom_site_occupancy
Al1 Al 0 0 0 SHARE
Cu1 Cu 0 0 0 0.25
Al2 Al 0.5 0.5 0.5 1
"""


@pytest.mark.parametrize("share", ["0.75", "0.5"])
def test_partial_occupancy_is_warned_of(save, share):
    pytest.importorskip("ase")
    from ase.io import read

    path = save(CIF.replace("SHARE", share), "a.cif")
    for make in (lambda: ae.read_tip(path), lambda: ae.Tip.from_atoms(read(path))):
        with pytest.warns(SpecimenWarning, match=rf"sites that are occupied partially \(Al {share}, Cu 0.25\)"):
            make()
    ordered = CIF.replace("Cu1 Cu 0 0 0 0.25\n", "").replace("SHARE", "1")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ae.read_tip(save(ordered, "b.cif"))


@pytest.mark.parametrize(
    ("text", "first"), [(lammps_dump(PLACES, TYPES), 10), (lammps_data(PLACES, TYPES), None), (xyz(["Al"] * 12), 3)]
)
def test_one_odd_row_is_named(save, text, first):
    """Before, a number or a word too many moved the coordinates of an atom by a column, without a word."""
    name = "a.xyz" if first == 3 else "a.lmp"
    lines = text.splitlines()
    first = first or next(at for at, line in enumerate(lines, 1) if line.startswith("Atoms")) + 2
    for at in (first, first + 5, first + 11):
        cells = lines[at - 1].split()
        odd = [
            [cells[0], *cells],
            cells[1:],
            [cells[0], "odd", *cells[1:]],
            ["".join(cells[:2]), *cells[2:]],
            ["x"],
            [],
        ]
        for changed in odd if first != 3 else odd[:2]:
            content = "\n".join([*lines[: at - 1], " ".join(changed), *lines[at:]])
            with pytest.raises(FileError, match=rf"{name}'(, line {at}: expected| states 12 atoms but contains 11)"):
                ae.read_tip(save(content, name), NAMES if first != 3 else None)
