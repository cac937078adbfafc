"""Surfaces of triangles from .stl files and from the .vtp files of VTK and ParaView."""

from __future__ import annotations

import base64
import re
import struct
import zlib
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from apt_evap._common.files import FileError, check_path, open_for_reading
from apt_evap._common.types import AnyPath
from apt_evap._common.validation import short_text
from apt_evap.measures.triangle_mesh import TriangleMesh

_STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_STL_HEAD = 84  # bytes
_MOST = 4_000_000_000  # bytes of a file: all of it is read at once
_NAMES = {"Float": "f", "Int": "i", "UInt": "u"}


def read_mesh(path: AnyPath) -> TriangleMesh:
    r"""Read a surface of triangles, such as an isosurface of another program, as a region.

    Parameters
    ----------
    path : str or path-like
        An .stl file, binary or text, or a .vtp file of polygons: text, base64 or raw, also compressed by zlib. Lengths
        are in nm. Polygons of more than three corners are divided into triangles.

    Returns
    -------
    TriangleMesh

    Raises
    ------
    FileError
        If it cannot be read, or contains no triangle.

    Examples
    --------
    >>> lines = ["facet normal 0 0 1", "outer loop", "vertex 0 0 0", "vertex 1 0 0", "vertex 0 1 0", "endloop"]
    >>> with open("triangle.stl", "w") as file:
    ...     _ = file.write("\n".join(["solid one", *lines, "endfacet", "endsolid one"]))
    >>> ae.io.read_mesh("triangle.stl")
    <TriangleMesh: 1 triangles, 0.5 nm^2, open>
    """
    path = check_path(path)
    suffix = Path(path).suffix.lower()
    if suffix not in (".stl", ".vtp"):
        raise FileError(f"format of {str(path)!r} must be .stl or .vtp, got {suffix!r}")
    with open_for_reading(path) as file:
        content = file.read(_MOST)
    try:
        corners, faces = _of_stl(content) if suffix == ".stl" else _of_vtp(content)
        return TriangleMesh(corners, faces)
    except FileError:
        raise
    except Exception as error:  # every kind of damage has its own errors
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise FileError(f"{str(path)!r} is not a surface of triangles: {reason}") from error


def _of_stl(content: bytes) -> tuple[NDArray, NDArray]:
    """Corners and faces of an .stl file; a binary one has the length that its number of triangles says."""
    number = struct.unpack_from("<I", content, 80)[0] if len(content) >= _STL_HEAD else 0
    if len(content) >= _STL_HEAD and len(content) == _STL_HEAD + number * _STL.itemsize:
        corners = np.frombuffer(content, _STL, number, _STL_HEAD)["corners"].reshape(-1, 3).astype(np.float64)
    else:
        if not content.lstrip()[:5].lower() == b"solid":
            raise ValueError(f"neither text nor {number:,} triangles in {len(content):,} bytes")
        if b"endsolid" not in content.lower():
            raise ValueError("it ends without endsolid")
        rows = re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", content, re.IGNORECASE)
        corners = np.array(rows, dtype="S64").astype(np.float64).reshape(-1, 3)
    if len(corners) == 0 or len(corners) % 3:
        raise ValueError(f"{len(corners)} corners are no triangles")
    return corners, np.arange(len(corners)).reshape(-1, 3)


def _of_vtp(content: bytes) -> tuple[NDArray, NDArray]:
    """Points and triangles of all pieces of a .vtp file."""
    appended = b""
    start = content.find(b"<AppendedData")
    if start >= 0:
        begin = content.index(b"_", content.index(b">", start)) + 1
        end = content.rindex(b"</AppendedData>")
        appended = content[begin:end]
        # raw bytes are no XML
        content = content[:begin] + content[end:]
    root = ElementTree.fromstring(content)
    node = root.find("AppendedData")
    encoded = node is not None and node.get("encoding", "base64") == "base64"
    if root.get("type") != "PolyData":
        raise ValueError(f"VTKFile of type {short_text(root.get('type'))}, not PolyData")
    corners, faces, before = [], [], 0
    for piece in root.iter("Piece"):
        array = piece.find("Points/DataArray")
        if array is None:
            continue
        points = _array(array, root, appended, encoded).reshape(-1, 3).astype(np.float64)
        polygons = {
            node.get("Name"): _array(node, root, appended, encoded).astype(np.int64)
            for node in piece.findall("Polys/DataArray")
        }
        if len(polygons.get("offsets", ())):
            faces.append(_triangles(polygons["connectivity"], polygons["offsets"]) + before)
        corners.append(points)
        before += len(points)
    if not faces:
        raise ValueError("it has no polygons (Polys)")
    return np.concatenate(corners), np.concatenate(faces)


def _array(node, root, appended, encoded):
    """Numbers of a DataArray."""
    kind = re.fullmatch(r"(Float|Int|UInt)(\d+)", node.get("type", ""))
    if kind is None:
        raise ValueError(f"an array of type {short_text(node.get('type'))}")
    order = "<" if root.get("byte_order", "LittleEndian") == "LittleEndian" else ">"
    dtype = np.dtype(f"{order}{_NAMES[kind[1]]}{int(kind[2]) // 8}")
    if node.get("format") == "ascii":
        return np.array((node.text or "").split(), dtype="S64").astype(dtype)
    head = np.dtype(f"{order}u{8 if root.get('header_type') == 'UInt64' else 4}")
    compressed = root.get("compressor")
    if compressed not in (None, "vtkZLibDataCompressor"):
        raise ValueError(f"compressed by {compressed}: only zlib is read")
    if node.get("format") == "appended":
        data = appended[int(node.get("offset", 0)) :]
        data = data.lstrip() if encoded else data
    else:
        data, encoded = (node.text or "").strip().encode(), True

    def take(count, offset):
        """Bytes of the data at an offset of their encoded or raw form, and where they end."""
        if not encoded:
            return data[offset : offset + count], offset + count
        length = -(-count // 3) * 4
        return base64.b64decode(data[offset : offset + length])[:count], offset + length

    if compressed is None:
        # head and values are encoded together
        size = int(np.frombuffer(take(head.itemsize, 0)[0], head)[0])
        return np.frombuffer(take(head.itemsize + size, 0)[0][head.itemsize :], dtype)
    blocks = int(np.frombuffer(take(head.itemsize, 0)[0], head)[0])
    table, offset = take((3 + blocks) * head.itemsize, 0)
    sizes = np.frombuffer(table, head)[3:].astype(int)
    packed, _ = take(int(sizes.sum()), offset)
    ends = np.cumsum(sizes)
    parts = [zlib.decompress(packed[end - size : end]) for size, end in zip(sizes, ends, strict=True)]
    return np.frombuffer(b"".join(parts), dtype)


def _triangles(connectivity, offsets):
    """Triangles of polygons, each a fan about its first corner."""
    starts = np.concatenate([[0], offsets[:-1]])
    lengths = offsets - starts
    fans = []
    for length in np.unique(lengths[lengths >= 3]):
        rows = connectivity[starts[lengths == length][:, None] + np.arange(length)]
        fans += [rows[:, [0, k, k + 1]] for k in range(1, length - 1)]
    return np.concatenate(fans) if fans else np.empty((0, 3), np.int64)
