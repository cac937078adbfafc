"""The .vtp format of VTK and ParaView: points [nm] with data, XML with appended binary data."""

import numpy as np

from apt_evap._common.files import replace_file
from apt_evap._common.types import AnyPath
from apt_evap.detection.hits import Hits
from apt_evap.io._points import distinct, numbered, points_and_data

_CHUNK = 1 << 20
_TYPES = {"f": "Float", "i": "Int", "u": "UInt"}


def write_vtp(path: AnyPath, hits: Hits) -> None:
    """Write ions as VTK points with one vertex each, and all other columns as point data.

    Positions are in nm, all other columns in the units of `Hits`. A column of texts, such as the elements of simulated
    ions, is an array of strings, with an array of its numbers in alphabetical order (element_number), because ParaView
    colours by numbers only. Ions whose positions are not finite are left out. Ions that missed the detector are
    written, with NaN for missing values.
    """
    _, positions, data = points_and_data(path, hits)
    for name, texts in [(name, values) for name, values in data.items() if values.dtype.kind == "U"]:
        data[distinct(f"{name}_number", data)] = numbered(texts)[1]
    n = len(positions)
    index = np.arange(n + 1, dtype=np.int32 if n < 2**31 - 1 else np.int64)
    blocks = []
    written = 0

    def array(name, values):
        nonlocal written
        if values.dtype.kind == "U":
            names, numbers = numbered(values)
            texts = np.array([name.encode() + b"\0" for name in names], object)[numbers]
            blocks.append(np.frombuffer(b"".join(texts), np.uint8))
            offset, written = written, written + 8 + blocks[-1].nbytes
            return (
                f'<DataArray type="String" Name="{name}" NumberOfTuples="{n}" format="appended" offset="{offset}"/>\n'
            )
        if values.dtype.kind == "f" and values.dtype.itemsize not in (4, 8):
            values = values.astype(np.float64)
        blocks.append(values)
        kind = f"{_TYPES[values.dtype.kind]}{8 * values.dtype.itemsize}"
        width = 1 if values.ndim == 1 else values.shape[1]
        offset, written = written, written + 8 + values.nbytes
        return (
            f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="{width}" '
            f'format="appended" offset="{offset}"/>\n'
        )

    head = (
        '<?xml version="1.0"?>\n<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" '
        'header_type="UInt64">\n<PolyData>\n'
        f'<Piece NumberOfPoints="{n}" NumberOfVerts="{n}" NumberOfLines="0" NumberOfStrips="0" NumberOfPolys="0">\n'
        f"<PointData>\n{''.join(array(name, values) for name, values in data.items())}</PointData>\n"
        f"<Points>\n{array('positions', positions)}</Points>\n"
        f"<Verts>\n{array('connectivity', index[:-1])}{array('offsets', index[1:])}</Verts>\n"
        '</Piece>\n</PolyData>\n<AppendedData encoding="raw">\n_'
    )
    with replace_file(path) as file:
        file.write(head.encode())
        for values in blocks:
            file.write(np.array(values.nbytes, "<u8").tobytes())
            for start in range(0, len(values), _CHUNK):
                part = values[start : start + _CHUNK]
                file.write(np.ascontiguousarray(part, part.dtype.newbyteorder("<")).data)
        file.write(b"\n</AppendedData>\n</VTKFile>\n")
