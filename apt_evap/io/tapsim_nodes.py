"""Node files of TAPSim: the points of a specimen and their types, as text or binary; and its file of the types.

Oberdorfer, Eich and Schmitz, Ultramicroscopy 128, 55 (2013). A header ``ASCII`` or ``BINARY``, the number of nodes, and
whether numbers and potentials follow. Each node has a position [m], the id of its type and perhaps a number and a
potential [V]. Binary nodes are float32, int16, uint32 and float32 without padding, in the byte order of the machine,
here little-endian.
"""

import re
from collections.abc import Mapping

import numpy as np

from apt_evap._common.files import FileError, TruncatedFile, replace_file
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import check_kind, check_number, check_switch, short_text
from apt_evap.io._texts import read_bytes, read_head
from apt_evap.io.lammps import Atoms
from apt_evap.specimen.tip import Tip

_MAX_BYTES = 1 << 32
_NM_PER_M = 1e9
_HEADER = re.compile(rb"(?:#[^\n]*\n|\r?\n)*(ASCII|BINARY)[ \t]+([0-9]{1,10})[ \t]+([01])[ \t]+([01])[ \t]*\r?\n")
_BOUNDARIES = {0: "Vacuum", 1: "Top", 2: "Bottom", 3: "Sides"}
_FIRST_ID = 10
_EPSILON = 1e6  # of a metal, in the examples of TAPSim
_ROW = "%.8e\t%.8e\t%.8e\t%d\n"
_SPECIMEN, _CHUNK = 1000.0, 1 << 14


def is_nodes(path: AnyPath) -> bool:
    """Whether a file begins like a node file of TAPSim."""
    return _HEADER.match(read_head(path, 1 << 12)) is not None


def read_nodes(path: AnyPath) -> Atoms:
    """Read the atoms of a node file of TAPSim.

    Returns
    -------
    Atoms
        Without the nodes of the vacuum and the boundaries (ids 0 to 3); the name of a type is its id.
    """
    data = read_bytes(path, "a node file of TAPSim", _MAX_BYTES)
    match = _HEADER.match(data[: 1 << 12])
    if match is None:
        raise FileError(f"{str(path)!r} does not begin like a node file of TAPSim, such as b'ASCII 1000 0 0'")
    n, columns = int(match[2]), [match[3] == b"1", match[4] == b"1"]
    positions, ids = (_text if match[1] == b"ASCII" else _binary)(data, match.end(), n, columns, path)
    if not np.isfinite(positions).all():
        raise FileError(f"{str(path)!r} has nodes whose positions are not finite")
    if len(ids) and ids.min() < 0:
        raise FileError(f"{str(path)!r} has nodes with the invalid id {ids.min()}")
    atoms = ids > max(_BOUNDARIES)
    if not atoms.any():
        raise FileError(f"{str(path)!r} has no atoms among its {n} nodes: all ids are 0 to {max(_BOUNDARIES)}")
    return Atoms(positions[atoms] * _NM_PER_M, [str(number) for number in ids[atoms].tolist()])


def _truncated(path, n, complete):
    return TruncatedFile(f"{str(path)!r} states {n} nodes but ends after {complete}")


def _text(data, start, n, columns, path):
    width = 4 + sum(columns)
    lines = [line for line in data[start:].splitlines() if line.strip() and not line.startswith(b"#")]
    if len(lines) < n:
        raise _truncated(path, n, len(lines))
    rows = [line.split() for line in lines[:n]]
    try:
        if any(len(row) < width for row in rows):
            raise ValueError("too few values")
        positions = np.array([row[:3] for row in rows], float).reshape(-1, 3)
        ids = np.array([int(row[3]) for row in rows], np.int64)
    except (ValueError, OverflowError) as error:
        wrong = next((row for row in rows if len(row) < width), rows[0])
        raise FileError(
            f"{str(path)!r}: expected {width} numbers for each node, the fourth one an integer, such as in "
            f"{b' '.join(wrong)[:60]!r}"
        ) from error
    return positions, ids


def _binary(data, start, n, columns, path):
    kinds = [("position", "<f4", 3), ("id", "<i2")]
    optional = (("number", "<u4"), ("potential", "<f4"))
    kinds += [column for column, is_present in zip(optional, columns, strict=True) if is_present]
    row = np.dtype(kinds)  # type: ignore[arg-type]
    if len(data) - start < n * row.itemsize:
        raise _truncated(path, n, (len(data) - start) // row.itemsize)
    nodes = np.frombuffer(data, row, n, start)
    return nodes["position"].astype(float), nodes["id"].astype(np.int64)


def write_nodes(path: AnyPath, tip: Tip, *, binary: bool = False) -> None:
    """Write the atoms of a specimen as a node file of TAPSim.

    The file has the atoms only; ``meshgen`` of TAPSim adds the vacuum and the boundaries. The ids are 10, 20, ... in
    the order of the elements of the tip, as in the file of `write_types`.

    Parameters
    ----------
    path : str or path-like
        The file; an existing one is replaced when the new one is complete.
    tip : Tip
        The specimen, with all its atoms (without ``depth``).
    binary : bool
        Write binary nodes (float32) instead of text.

    Raises
    ------
    ValueError
        If the tip is a shell.
    FileError
        If the file cannot be written.
    """
    check_kind(tip, "tip", Tip, "a Tip")
    check_switch(binary, "binary")
    if tip.support.any():
        raise ValueError("tip must be a complete specimen, got a shell: make it without depth")
    positions, ids = tip.positions / _NM_PER_M, _FIRST_ID * (tip.species.astype(np.int64) + 1)
    with replace_file(path) as file:
        file.write(f"{'BINARY' if binary else 'ASCII'} {len(tip)} 0 0\n".encode())
        for start in range(0, len(tip), _CHUNK):
            part = slice(start, start + _CHUNK)
            if binary:
                rows = np.zeros(len(ids[part]), np.dtype([("position", "<f4", 3), ("id", "<i2")]))
                rows["position"], rows["id"] = positions[part], ids[part]
                file.write(rows.tobytes())
            else:
                columns = (*positions[part].T.tolist(), ids[part].tolist())
                file.write("".join([_ROW % values for values in zip(*columns, strict=True)]).encode())


def write_types(
    path: AnyPath,
    tip: Tip,
    *,
    temperature: float = 0.0,
    activation_energies: float | Mapping[str, float] = 1.0,
    voltage: float = _SPECIMEN,
) -> None:
    """Write the types of the nodes of a specimen, the configuration of TAPSim.

    In TAPSim the barrier is half the activation energy times (1 - field / evaporation field). The activation energies
    that correspond to `Arrhenius` are therefore twice its sensitivities C. TAPSim's field is that of its own mesh at
    the node, and not relative to the largest one, so that probabilities of the two programs differ.

    Parameters
    ----------
    path : str or path-like
        The file; an existing one is replaced when the new one is complete.
    tip : Tip
        The specimen.
    temperature : float
        Temperature of the specimen [K].
    activation_energies : float or mapping
        Activation energy of all elements [eV], or of each by its name.
    voltage : float
        Potential of the specimen [V].

    Raises
    ------
    ValueError
        If an argument is invalid.
    FileError
        If the file cannot be written.
    """
    check_kind(tip, "tip", Tip, "a Tip")
    check_number(voltage, "voltage", above=0, unit="V")
    check_number(temperature, "temperature", at_least=0, unit="K")
    energies = _energies(activation_energies, [element.name for element in tip.elements])
    blocks = [
        _block(
            ID=number,
            NAME=name,
            NEUMANN_BOUNDARY=int(name == "Bottom"),
            DIRICHLET_BOUNDARY=int(name in ("Top", "Sides")),
            POTENTIAL=voltage if name == "Bottom" else 0.0,
        )
        for number, name in _BOUNDARIES.items()
    ]
    for k, (element, energy) in enumerate(zip(tip.elements, energies, strict=True)):
        blocks.append(
            _block(
                ID=_FIRST_ID * (k + 1),
                NAME="_".join(element.name.split()),
                DIELECTRICITY=_EPSILON,
                REMOVABLE=1,
                DIRICHLET_BOUNDARY=1,
                POTENTIAL=voltage,
                MASS=element.mass,
                EVAPORATION_CHARGE_STATE=element.charge_state,
                EVAPORATION_FIELD_STRENGTH=element.evaporation_field * 1e9,
                EVAPORATION_ACTIVATION_ENERGY=float(energy),
            )
        )
    with replace_file(path) as file:
        file.write("\n".join(["ASCII", "", f"TEMPERATURE = {temperature:.8g}", "", *blocks]).encode())


def _energies(energies, names):
    """Activation energy of each element [eV]."""
    if not isinstance(energies, Mapping):
        return [check_number(energies, "activation_energies", at_least=0, unit="eV")] * len(names)
    for name in energies:
        if name not in names:
            raise ValueError(f"activation_energies must be of {', '.join(names)}, got {short_text(name)}")
    for name in names:
        if name not in energies:
            raise ValueError(f"activation_energies must have a value for {name}, got {short_text(dict(energies))}")
    return [check_number(energies[name], f"activation energy of {name}", at_least=0, unit="eV") for name in names]


_EMPTY = {
    "ID": 0,
    "NAME": "",
    "CHARGE_DENSITY": 0.0,
    "DIELECTRICITY": 1.0,
    "REMOVABLE": 0,
    "NEUMANN_BOUNDARY": 0,
    "DIRICHLET_BOUNDARY": 0,
    "POTENTIAL": 0.0,
    "MASS": 0.0,
    "EVAPORATION_CHARGE_STATE": 0,
    "EVAPORATION_FIELD_STRENGTH": 0.0,
    "EVAPORATION_ACTIVATION_ENERGY": 0.0,
}
"""Values of a block, unless it has others."""


def _block(**values):
    """One kind of node, by the names of the values in the file."""
    return "".join(
        f"{key} = {value if isinstance(value, (int, str)) else format(value, '.8g')}\n"
        for key, value in (_EMPTY | values).items()
    )
