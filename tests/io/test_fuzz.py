"""Whatever a file holds, a reader gives ions or says in one sentence what is wrong with which file."""

import gzip
import os
import subprocess
import sys
import warnings
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ion_files import (
    ENV,
    RNG,
    epos,
    ions_of,
    lammps_data,
    lammps_dump,
    pos,
    pyccapt_calibrated,
    pyccapt_instrument,
    raw,
    tapsim_nodes,
    tapsim_table,
    usual_apt,
    xrng,
)

import apt_evap as ae
from apt_evap._common.files import FileError
from apt_evap.detection.hits import Hits
from apt_evap.io.formats import FORMATS, RANGE_FORMATS, chunks, read, read_ranges, write
from apt_evap.io.tapsim import SIGNATURE as TAPSIM
from apt_evap.spectra.mass_ranges import Ranges

SILICON = Path(__file__).parents[3] / "shared" / "data" / "Si.epos"
CHUNKED = {entry.suffix for entry in FORMATS if entry.chunks}
READ = tuple(entry.suffix for entry in FORMATS if entry.read and entry.suffix != ".npz")  # maps: test_npz.py
RANGES = b"[Ions]\nNumber=2\nIon1=Si\nIon2=O\n[Ranges]\nNumber=2\nRange1=13,5 14.2 Vol:0.02 Si:1 Color:CCCCCC\n"
RANGES += b"Range2 = 15.8 16.5 Name:oxide Si:1 O:2\n"


def samples():
    """A good file of every format, by suffix."""
    sizes = [1, 3, 2, 1, 1, 2]
    return {
        ".epos": epos(ions_of(sizes)),
        ".pos": pos(10),
        ".raw": raw(np.repeat(np.arange(6) + 4, sizes))[0],
        ".apt": usual_apt(10, ions_of(sizes))[0],
        ".rrng": RANGES,
        ".rng": RNG.encode(),
        ".env": ENV.encode(),
        ".xrng": xrng((13.8, 14.2, 2, 0.02, [14]), (43.8, 44.2, 1, 0, [14, 8])).encode(),
        ".tapsim": tapsim_table(4)[0],
        ".ato": np.array([0, 3], "<u4").tobytes() + np.linspace(1, 60, 56, dtype="<f4").tobytes(),
        ".h5": b"\x89HDF\r\n\x1a\n" + bytes(300),
    }


SAMPLES = samples()


def told(task, path):
    """Result of a task, or None if it raised as it should: the file is named, in one line."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # such as overflows
        warnings.simplefilter("ignore", UserWarning)
        try:
            return task()
        except ValueError as error:
            assert isinstance(error, FileError) or str(error).startswith("rows must"), repr(error)
            assert path.name in str(error) and "\n" not in str(error), str(error)
            assert len(str(error)) < 600
            return None


def check(path, **options):
    """Read a file in every way; what is given is of one piece."""
    if path.suffix in RANGE_FORMATS:
        ranges = told(lambda: read_ranges(path), path)
        assert ranges is None or (isinstance(ranges, Ranges) and len(ranges) == len(ranges.low))
        return ranges
    whole = told(lambda: read(path, **options), path)
    if path.suffix not in CHUNKED or path.read_bytes().startswith(TAPSIM):
        assert whole is None or (isinstance(whole, Hits) and len(whole) > 0)
        return whole
    parts = told(lambda: list(chunks(path, 1000, **options)), path)
    if whole is None or parts is None:
        assert whole is None and parts is None
        return None
    assert isinstance(whole, Hits) and len(whole) > 0
    for name in whole.columns:
        np.testing.assert_array_equal(np.concatenate([getattr(part, name) for part in parts]), getattr(whole, name))
    some = told(lambda: read(path, columns=whole.columns[:1], **options), path) if whole.columns else None
    assert some is None or some.columns == whole.columns[:1]
    return whole


def save(folder, data, suffix):
    path = folder / f"some{suffix}"
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("suffix", [suffix for suffix in SAMPLES if suffix != ".h5"])
def test_the_samples_are_good(tmp_path, suffix):
    assert check(save(tmp_path, SAMPLES[suffix], suffix)) is not None


@pytest.mark.parametrize("suffix", SAMPLES)
@pytest.mark.parametrize("partial", [False, True])
def test_cut_anywhere(tmp_path, suffix, partial):
    data = SAMPLES[suffix]
    options = {"partial": True} if partial and suffix not in (".h5", *RANGE_FORMATS) else {}
    for size in range(0, len(data), 1 if len(data) < 200 else 11):
        check(save(tmp_path, data[:size], suffix), **options)


@given(suffix=st.sampled_from([*READ, *RANGE_FORMATS]), data=st.binary(max_size=400))
def test_random_bytes(tmp_path, suffix, data):
    check(save(tmp_path, data, suffix))


@given(suffix=st.sampled_from([*READ, *RANGE_FORMATS]), of=st.sampled_from(sorted(SAMPLES)), swapped=st.booleans())
def test_renamed_and_swapped(tmp_path, suffix, of, swapped):
    data = SAMPLES[of]
    if swapped:
        words = np.frombuffer(data[: len(data) // 4 * 4], "u4")
        data = words.byteswap().tobytes()
    check(save(tmp_path, data, suffix))


@given(
    suffix=st.sampled_from([".epos", ".pos", ".raw", ".apt", ".tapsim", *RANGE_FORMATS]),
    changes=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=8),
    partial=st.booleans(),
)
def test_changed_bytes(tmp_path, suffix, changes, partial):
    data = bytearray(SAMPLES[suffix])
    for place, value in changes:
        data[int(place * len(data))] = value
    check(save(tmp_path, data, suffix), **({"partial": partial} if suffix not in RANGE_FORMATS else {}))


@given(
    field=st.sampled_from([4, 8, 80, 84, 88, 92, 96, 132, 140]),
    section=st.integers(0, 5),
    value=st.one_of(st.integers(0, 300), st.integers(-(2**63), 2**63 - 1)),
)
def test_changed_headers_of_apt_sections(tmp_path, field, section, value):
    """Sizes and counts of any value are no reason to take all memory."""
    data = bytearray(SAMPLES[".apt"])
    at = 540
    for _ in range(section):
        at += 148 + int.from_bytes(data[at + 140 : at + 148], "little")
    width = 8 if field >= 132 else 4
    data[at + field : at + field + width] = (value % 2 ** (8 * width)).to_bytes(width, "little")
    check(save(tmp_path, data, ".apt"))


@given(
    lines=st.lists(
        st.text(st.sampled_from("Range12=:., \t[]VolSiONameColor#\u00b2\u0660;eE+-_\x00\x85"), max_size=40), max_size=6
    )
)
def test_texts_like_ranges(tmp_path, lines):
    text = "[Ranges]\n" + "\n".join(f"Range{i}=1{i} 2{i} {line}" for i, line in enumerate(lines))
    check(save(tmp_path, text.encode(), ".rrng"))


@given(
    suffix=st.sampled_from([".rng", ".env"]),
    lines=st.lists(st.text(st.sampled_from("01239. ,-\t#CrO\u00b2\u0660eE\x00\x85"), max_size=30), max_size=12),
)
def test_texts_like_tables_of_ranges(tmp_path, suffix, lines):
    check(save(tmp_path, "\n".join(["1 1", *lines]).encode(), suffix))


PLACES = np.random.default_rng(1).uniform(1, 9, (8, 3))
SPECIMENS = {
    "dump": lammps_dump(PLACES, [1] * 8, frames=2).encode(),
    "scaled dump": lammps_dump(PLACES / 10, [1] * 8, "id type xs ys zs").encode(),
    "dump with images": lammps_dump(np.hstack([PLACES, PLACES // 3]), [1] * 8, "id type x y z ix iy iz").encode(),
    "data": lammps_data(PLACES, [1] * 8, "full").encode(),
    "data with images": lammps_data(PLACES, [1] * 8, "atomic", more=" 1 0 -1").encode(),
    "packed dump": gzip.compress(lammps_dump(PLACES, [1] * 8).encode()),
    "xyz": b"8\nProperties=species:S:1:pos:R:3\n" + b"".join(b"1 %.3f %.3f %.3f\n" % (*row,) for row in PLACES),
    "nodes": tapsim_nodes(PLACES * 1e-10, [10] * 7 + [0], numbers=range(8)),
    "binary nodes": tapsim_nodes(PLACES * 1e-10, [10] * 7 + [0], binary=True),
}


@given(
    name=st.sampled_from(sorted(SPECIMENS)),
    changes=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), max_size=6),
    size=st.floats(0, 1),
)
def test_changed_specimens(tmp_path, name, changes, size):
    """Not read by ASE, whose readers are its own: the beginning stays, or the format is given."""
    data = bytearray(SPECIMENS[name])
    for place, value in changes:
        data[int(place * len(data))] = value
    formats = {"nodes": "tapsim", "dump": "lammps-dump", "data": "lammps-data", "xyz": "xyz"}
    format = next(format for word, format in formats.items() if word in name)
    path = save(tmp_path, data[: int(size * len(data))], ".txt")
    types = {10 if "nodes" in name else 1: "Al"}
    tip = told(lambda: ae.read_tip(path, types, format=format), path)
    assert tip is None or len(tip) >= 2


@pytest.fixture(scope="session")
def of_ase(tmp_path_factory):
    """A good file of some formats of ASE, by name."""
    ase = pytest.importorskip("ase")
    from ase.io import write as write_ase

    atoms = ase.Atoms("Al6Cu2", positions=PLACES, cell=[10, 10, 10], pbc=True)
    folder = tmp_path_factory.mktemp("ase")
    for name, format in (("a.xyz", "xyz"), ("b.xyz", "extxyz"), ("c.cif", "cif"), ("POSCAR", "vasp")):
        write_ase(folder / name, atoms, format=format)
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@given(
    name=st.sampled_from(["a.xyz", "b.xyz", "c.cif", "POSCAR"]),
    changes=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), max_size=4),
    removed=st.tuples(st.floats(0, 1), st.integers(0, 30)),
)
def test_changed_files_of_ase(of_ase, tmp_path, name, changes, removed):
    data = bytearray(of_ase[name])
    for place, value in changes:
        data[int(place * len(data))] = value
    start = int(removed[0] * len(data))
    del data[start : start + removed[1]]
    path = tmp_path / name
    path.write_bytes(data)
    tip = told(lambda: ae.read_tip(path), path)
    assert tip is None or (len(tip) >= 2 and np.isfinite(tip.positions).all())


@pytest.mark.parametrize("member", ["none", "format only"])
def test_hdf5_that_is_no_run(tmp_path, member):
    path = tmp_path / "some.h5"
    with h5py.File(path, "w") as file:
        if member == "format only":
            file.attrs["format"] = "apt_evap run 1"
    assert check(path) is None


DAMAGE = """
import random, sys, warnings
import apt_evap as ae
warnings.simplefilter("ignore")
whole = open(sys.argv[1], "rb").read()
for case in range(120):
    draw, data = random.Random(case), bytearray(whole)
    if case % 3 == 0:
        del data[draw.randrange(len(data)) :]
    elif case % 3 == 1:
        for _ in range(draw.choice((1, 5, 50))):
            data[draw.randrange(len(data))] = draw.randrange(256)
    else:
        start = draw.randrange(len(data))
        data[start : start + 512] = bytes(len(data[start : start + 512]))
    open("damaged.h5", "wb").write(data)
    try:
        run = ae.load("damaged.h5") if case % 2 and sys.argv[1] == "run.h5" else ae.read("damaged.h5")
    except ae.FileError as error:
        assert "damaged.h5" in str(error) and chr(10) not in str(error), error
    else:
        assert len(run) == 40 and (sys.argv[1] != "run.h5" or len(run.hits(ae.Unperturbed())) == 40)
    print(case)
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["run.h5", "ions.nxs", "instrument.h5", "calibrated.h5"])
def test_damaged_hdf5_is_read_or_refused(tmp_path, small_tip, name):
    """In a process of its own: HDF5 might take it down."""
    if name == "run.h5":
        ae.Simulation(small_tip, n_threads=1).run(40, progress=False).save(tmp_path / name)
    elif name == "ions.nxs":
        write(tmp_path / name, Hits(x=np.arange(40.0), y=np.ones(40), extra={"a": np.arange(40)}), elements=["Si"])
    elif name == "instrument.h5":
        pyccapt_instrument(tmp_path / name, 40)
    else:
        pyccapt_calibrated(
            tmp_path / name, {"x_det (cm)": np.arange(40.0), "y_det (cm)": np.ones(40), "n": np.ones(40, int)}
        )
    done = subprocess.run(
        [sys.executable, "-c", DAMAGE, name],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=500,
        env=os.environ | {"PYTHONPATH": str(Path(ae.__file__).parents[1])},
    )
    assert done.returncode == 0 and done.stdout.split()[-1] == "119", (done.stdout[-10:], done.stderr[-500:])


@pytest.mark.skipif(not SILICON.exists(), reason="the measured Si.epos is not there")
@given(
    start=st.integers(0, 1999),
    size=st.integers(0, 400),
    what=st.sampled_from(["cut", "zeros", "ones", "swapped", "dropped", "doubled"]),
)
def test_a_measured_file_changed(tmp_path, start, size, what):
    with open(SILICON, "rb") as file:
        data = file.read(2000 * 44)
    start *= 43  # not at the beginnings of rows alone
    part = data[start : start + size]
    swapped = np.frombuffer(part[: size // 4 * 4], "u4").byteswap().tobytes()
    changed = {
        "cut": b"",
        "zeros": bytes(len(part)) + data[start + size :],
        "ones": b"\xff" * len(part) + data[start + size :],
        "swapped": swapped + data[start + len(swapped) :],
        "dropped": data[start + size :],
        "doubled": part + part + data[start + size :],
    }
    hits = check(save(tmp_path, data[:start] + changed[what], ".epos"))
    assert hits is None or len(hits) == (start + len(changed[what])) // 44


@given(data=st.binary(min_size=1, max_size=500), partial=st.booleans(), order=st.sampled_from(["big", "little"]))
def test_any_bytes_in_an_order_that_is_said(tmp_path, data, partial, order):
    for suffix, row in ((".epos", 44), (".pos", 16), (".raw", 32)):
        hits = check(save(tmp_path, data, suffix), format=suffix, partial=partial, byte_order=order)
        whole = len(data) // row
        assert (hits is None) == (whole == 0 or (not partial and len(data) % row > 0))
        assert hits is None or len(hits) == whole
