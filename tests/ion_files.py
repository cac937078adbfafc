"""Bytes of ion files, written from the layouts of the formats and not with the package."""

import struct

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
