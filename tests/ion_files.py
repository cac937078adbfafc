"""Bytes of ion files, written from the layouts of the formats and not with the package."""

import struct

import h5py
import numpy as np


def apt_header(ions, size=540, version=2, signature=b"APT\0"):
    name = "R5083_00001.apt".encode("utf-16-le").ljust(512, b"\0")
    return struct.pack("<4sii512sQQ", signature, size, version, name, 132_000_000_000_000_000, ions) + bytes(size - 540)


def apt_section(
    name,
    values,
    unit="",
    relationship=1,
    record_type=1,
    kind=None,
    bits=None,
    record_size=None,
    records=None,
    length=None,
    extra_header=b"",
    padding=0,
    signature=b"SEC\0",
):
    """A section with the values of an array, and whatever of its header is to be wrong."""
    values = np.asarray(values)
    data = values.astype(values.dtype.newbyteorder("<")).tobytes() + bytes(padding)
    width = 1 if values.ndim == 1 else values.shape[1]
    header = struct.pack(
        "<4sii64siIIIii32sqq",
        signature,
        148 + len(extra_header),
        2,
        name.encode("utf-16-le").ljust(64, b"\0"),
        1,
        relationship,
        record_type,
        {"i": 1, "u": 2, "f": 3, "S": 4}[values.dtype.kind] if kind is None else kind,
        (8 if values.dtype.kind == "S" else 8 * values.dtype.itemsize) if bits is None else bits,
        width * values.dtype.itemsize if record_size is None else record_size,
        unit.encode("utf-16-le").ljust(32, b"\0"),
        len(values) if records is None else records,
        len(data) if length is None else length,
    )
    assert len(header) == 148
    return header + extra_header + data


def position_section(positions, **options):
    """The Position section, whose header holds six extents of 24 bytes more."""
    positions = np.asarray(positions, "f4")
    extents = np.column_stack([positions.min(axis=0), positions.max(axis=0)]).astype("<f4").tobytes()
    return apt_section("Position", positions, "nm", extra_header=extents, **options)


def apt(sections, ions):
    return apt_header(ions) + b"".join(sections)


def usual_apt(n=6, multiplicity=(1, 3, 0, 0, 2, 0), seed=5):
    """An .apt as instruments write it, and its columns."""
    rng = np.random.default_rng(seed)
    columns = {
        "time_of_flight": rng.uniform(300, 900, n).astype("f4"),
        "mass_to_charge": rng.uniform(1, 90, n).astype("f4"),
        "x": rng.uniform(-30, 30, n).astype("f4"),
        "y": rng.uniform(-30, 30, n).astype("f4"),
        "positions": rng.uniform(-30, 30, (n, 3)).astype("f4"),
    }
    sections = [
        apt_section("tofc", columns["time_of_flight"], "ns"),
        apt_section("Mass", columns["mass_to_charge"], "Da"),
        apt_section("XDet_mm", columns["x"], "mm"),
        apt_section("YDet_mm", columns["y"], "mm"),
        apt_section("Multiplicity", np.asarray(multiplicity, "i4")),
        position_section(columns["positions"]),
    ]
    return apt(sections, n), columns


def raw(pulse_number, seed=6):
    """A Stuttgart .raw with these pulse numbers, and its columns."""
    n = len(pulse_number)
    kind = np.dtype(
        [(name, "<f4") for name in ("voltage", "pulse_voltage", "reflectron_voltage", "x", "y", "time_of_flight")]
        + [("epoch", "<i4"), ("pulse_number", "<u4")]
    )
    rng = np.random.default_rng(seed)
    rows = np.zeros(n, kind)
    for name in kind.names[:6]:
        rows[name] = rng.uniform(1, 50, n)
    rows["epoch"] = np.arange(n) - 2
    rows["pulse_number"] = pulse_number
    return rows.tobytes(), rows


def epos(ions, seed=7):
    """An .epos with this last column."""
    n = len(ions)
    rows = np.zeros((n, 11), ">u4")
    rows.view(">f4")[:, :9] = np.random.default_rng(seed).uniform(1, 50, (n, 9))
    rows.view(">f4")[:, 5] += 5000
    rows[:, 9] = np.arange(n)
    rows[:, 10] = ions
    return rows.tobytes()


def pos(n, seed=8):
    return np.random.default_rng(seed).uniform(1, 50, (n, 4)).astype(">f4").tobytes()


def ions_of(sizes):
    """The last column of an .epos for pulses of these sizes."""
    return np.concatenate([[size] + [0] * (size - 1) for size in sizes])


RNG = """3 4
Chromium
Cr 1.00 0.50 0.00
Silicon
Si 0.80 0.80 0.80
Oxygen
O 0,0 0,0 1,0
--------------- Cr Si O
. 25.9 26.3 1 0 0
. 13.8 14.2 0 1 0
. 67.5 68.4 1 0 1
. 83.5 84.4 1 0 2

--- polyatomic extension
1 1
CrO2
CrO2 0.00 1.00 0.00
------- CrO2
. 83.5 84.4 1
"""
ENV = """# Rev 2.0 : Environment file
Rev_2.0

# Number of elements / Number of mass ranges
3 3
# List of Element and Color components
Mn	0.0	0.5	1.0
Mn2O	0.0	0.0	0.0
Hyd	1.0	0.0	0.0
# Definition of  Mass ranges
Mn	27,33	27,95	11.66	1.0
Mn2O	62.85	63.13	20.0	1.0
Hyd	0.93	3.18	11.66	1.0
# Atom probe definition
# Flight length (m)
0.1005
"""


def pyccapt_instrument(path, n=8, **changes):
    """A file as the control module of PyCCAPT writes it, and its columns."""
    rng = np.random.default_rng(9)
    columns = {
        "x": rng.uniform(-3, 3, n),
        "y": rng.uniform(-3, 3, n),
        "t": rng.uniform(300, 900, n),
        "high_voltage": rng.uniform(3e3, 5e3, n),
        "voltage_pulse": rng.uniform(300, 500, n),
        "laser_pulse": np.zeros(n),
        "start_counter": np.arange(n, dtype="u8") // 2 + 100,
    } | changes
    with h5py.File(path, "w") as file:
        file["apt/temperature"] = np.full(3, 50.0)
        for name, values in columns.items():
            if values is not None:
                file[f"dld/{name}"] = values
        file["tdc/channel"] = np.zeros(4 * n, "u4")
    return columns


def pyccapt_calibrated(path, columns):
    """The columns as pandas writes a DataFrame with this name: blocks of columns of the same type."""
    kinds = {}
    for name, values in columns.items():
        kinds.setdefault(np.asarray(values).dtype.str, []).append(name)
    with h5py.File(path, "w") as file:
        n = len(next(iter(columns.values())))
        file.create_group("df").attrs["pandas_type"] = np.bytes_(b"frame")
        file["df/axis0"], file["df/axis1"] = np.array([name.encode() for name in columns]), np.arange(n)
        for k, names in enumerate(kinds.values()):
            file[f"df/block{k}_items"] = np.array([name.encode() for name in names])
            file[f"df/block{k}_values"] = np.stack([columns[name] for name in names], axis=1)


TAPSIM_COLUMNS = ["index", "id", "number", "voltage", "startX", "startY", "startZ", "stopX", "stopY", "stopZ", "tof"]
TAPSIM_COLUMNS += ["probability", "potentialBefore", "fieldBeforeX", "fieldBeforeY", "fieldBeforeZ", "potentialAfter"]
TAPSIM_COLUMNS += ["fieldAfterX", "fieldAfterY", "fieldAfterZ", "normalX", "normalY", "normalZ"]
TAPSIM_COLUMNS += ["apexX", "apexY", "apexZ"]


def tapsim_table(n=5, binary=False):
    """A result table of TAPSim, and its rows in the units of the table."""
    rng = np.random.default_rng(10)
    rows = rng.uniform(-1, 1, (n, 26)).astype("f4")
    rows[:, 0], rows[:, 1], rows[:, 2] = np.arange(n), 10, 7 + np.arange(n)
    rows[:, 3], rows[:, 4:7], rows[:, 10] = 1000, rows[:, 4:7] * 1e-8, 4e-7
    kind = "BINARY" if binary else "ASCII"
    lines = ["TAPSIM RESULTS DATA", "VERSION 1.0", *(f"# {name} [1]" for name in TAPSIM_COLUMNS), kind, ""]
    if binary:
        data = b"".join(struct.pack("<IhI23f", *map(int, row[:3]), *row[3:]) for row in rows)
    else:
        cells = [[*(str(int(value)) for value in row[:3]), *(f"{value:.8e}" for value in row[3:])] for row in rows]
        data = "".join("\t".join(row) + "\n" for row in cells).encode()
    return "\n".join(lines).encode() + data, rows


def tapsim_nodes(positions, ids, binary=False, numbers=None, potentials=None):
    """A node file of TAPSim with these positions [m]."""
    flags = f"{int(numbers is not None)} {int(potentials is not None)}"
    head = f"{'BINARY' if binary else 'ASCII'} {len(ids)} {flags}\n".encode()
    more = [(values, kind) for values, kind in ((numbers, "I"), (potentials, "f")) if values is not None]
    rows = []
    for k, (place, number) in enumerate(zip(positions, ids, strict=True)):
        values = [*place, number, *(values[k] for values, _ in more)]
        if binary:
            rows.append(struct.pack("<3fh" + "".join(kind for _, kind in more), *values))
        else:
            rows.append(("\t".join(map(str, values)) + "\n").encode())
    return head + b"".join(rows)


def lammps_dump(positions, types, columns="id type x y z", bounds=((0, 10), (0, 20), (0, 30)), frames=1, tilt=""):
    """A text dump of LAMMPS; the first two columns are the number and the type of each atom."""
    text = ""
    for frame in range(frames):
        text += f"ITEM: TIMESTEP\n{frame}\nITEM: NUMBER OF ATOMS\n{len(types)}\nITEM: BOX BOUNDS {tilt}pp pp pp\n"
        text += "".join(" ".join(map(str, row)) + "\n" for row in bounds) + f"ITEM: ATOMS {columns}\n"
        for k, (place, kind) in enumerate(zip(positions, types, strict=True), 1):
            text += f"{k} {kind} " + " ".join(repr(float(value) + frame) for value in place) + "\n"
    return text


def lammps_data(positions, types, style="atomic", comment=True, more="", labels=""):
    """A data file of LAMMPS."""
    text = f"a specimen\n\n{len(types)} atoms\n3 atom types\n0 10 xlo xhi\n0 20 ylo yhi\n0 30 zlo zhi\n\nMasses\n\n"
    text += f"1 26.98 # Al\n2 63.55\n3 1.0\n\n{labels}Atoms{f'  # {style}' if comment else ''}\n\n"
    before = {"atomic": "{k} {t}", "charge": "{k} {t} 0.5", "molecular": "{k} 1 {t}", "full": "{k} 1 {t} 0.5"}[style]
    for k, (place, kind) in enumerate(zip(positions, types, strict=True), 1):
        text += before.format(k=k, t=kind) + " " + " ".join(repr(float(value)) for value in place) + more + "\n"
    return text + "\nVelocities\n\n1 0 0 0\n"


def xrng(*ranges):
    """Text of an .xrng file, of (low, high, charge, volume, atomic numbers)."""
    items = []
    for low, high, charge, volume, numbers in ranges:
        atoms = "".join(f"<item><atomicnumber>{z}</atomicnumber></item>\n" for z in numbers)
        items.append(
            f"<item>\n<masstochargebegin>{low}</masstochargebegin>\n<masstochargeend>{high}</masstochargeend>\n<ions>\n"
            f"<item>\n<chargestate>{charge}</chargestate>\n<volume>{volume}</volume>\n<atoms>\n{atoms}</atoms>\n</item>"
            "\n</ions>\n</item>\n"
        )
    body = "".join(items)
    return f'<?xml version="1.0" encoding="utf-8"?>\n<rangefile version="1">\n<ranges>\n{body}</ranges>\n</rangefile>\n'
