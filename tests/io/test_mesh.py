"""Surfaces of triangles in .stl and .vtp files, in all their encodings, and damaged ones."""

import base64
import struct
import zlib

import numpy as np
import pytest

import apt_evap as ae

CORNERS = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 2]], np.float32)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int64)


def stl(binary):
    if binary:
        facets = b"".join(
            np.zeros(3, "<f4").tobytes() + CORNERS[face].astype("<f4").tobytes() + b"\0\0" for face in FACES
        )
        return b"solid, says the head".ljust(80) + struct.pack("<I", len(FACES)) + facets
    lines = ["solid a"]
    for face in FACES:
        lines += ["facet normal 0 0 0", " outer loop", *(f"  vertex {x:e} {y} {z}" for x, y, z in CORNERS[face])]
        lines += [" endloop", "endfacet"]
    return "\n".join([*lines, "endsolid a"]).encode()


def vtp(kind):
    arrays = [CORNERS.ravel(), FACES.ravel(), 3 + 3 * np.arange(len(FACES))]
    appended, texts = b"", []
    for values, (name, type_) in zip(
        arrays, [("Points", "Float32"), ("connectivity", "Int64"), ("offsets", "Int64")], strict=True
    ):
        if kind == "zlib":
            raw = values.tobytes()
            parts = [zlib.compress(raw[:20]), zlib.compress(raw[20:])]  # blocks
            sizes = struct.pack("<5I", 2, 20, len(raw) - 20, *map(len, parts))
            inline = (base64.b64encode(sizes) + base64.b64encode(b"".join(parts))).decode()
        else:
            block = struct.pack("<I", values.nbytes) + values.tobytes()
            inline = base64.b64encode(block).decode() if kind == "base64" else " ".join(map(str, values.tolist()))
        if kind.startswith("appended"):
            head = f'format="appended" offset="{len(appended)}"'
            appended += base64.b64encode(block) if kind == "appended base64" else block
            inline = ""
        else:
            head = f'format="{"ascii" if kind == "ascii" else "binary"}"'
        width = 3 if name == "Points" else 1
        texts.append(
            f'<DataArray type="{type_}" Name="{name}" NumberOfComponents="{width}" {head}>{inline}</DataArray>'
        )
    packing = ' compressor="vtkZLibDataCompressor"' if kind == "zlib" else ""
    text = f'<?xml version="1.0"?><VTKFile type="PolyData" byte_order="LittleEndian" header_type="UInt32"{packing}>'
    text += f'<PolyData><Piece NumberOfPoints="4" NumberOfPolys="4"><Points>{texts[0]}</Points>'
    text += f"<Polys>{texts[1]}{texts[2]}</Polys></Piece></PolyData>"
    if appended:
        encoding = "base64" if kind == "appended base64" else "raw"
        text += f'<AppendedData encoding="{encoding}">\n_'
        return text.encode() + appended + b"</AppendedData></VTKFile>"
    return (text + "</VTKFile>").encode()


KINDS = {"a.stl": stl(True), "b.STL": stl(False)} | {
    f"{kind}.vtp": vtp(kind) for kind in ("ascii", "base64", "zlib", "appended raw", "appended base64")
}


@pytest.mark.parametrize("name", KINDS)
def test_a_tetrahedron_in_every_encoding(tmp_path, name):
    (tmp_path / name).write_bytes(KINDS[name])
    mesh = ae.io.read_mesh(tmp_path / name)
    assert mesh.is_closed and mesh.volume == pytest.approx(8 / 6) and len(mesh.vertices) == 4
    assert mesh.distance(np.array([[0.5, 0.5, -1.0]]))[0] == pytest.approx(1.0)


def test_polygons_become_triangles(tmp_path):
    text = vtp("ascii").decode()
    text = text.replace(" ".join(map(str, FACES.ravel().tolist())), "0 1 3 2").replace("3 6 9 12", "4")
    (tmp_path / "quad.vtp").write_text(text)
    assert len(ae.io.read_mesh(tmp_path / "quad.vtp")) == 2


@pytest.mark.parametrize("name", KINDS)
def test_damage_is_one_sentence(tmp_path, name):
    content = KINDS[name]
    for length in (0, 10, len(content) // 2, len(content) - 12):
        (tmp_path / name).write_bytes(content[:length])
        with pytest.raises(ae.FileError, match="is not a surface of triangles") as caught:
            ae.io.read_mesh(tmp_path / name)
        assert "\n" not in str(caught.value)


def test_other_files_are_named(tmp_path):
    with pytest.raises(ae.FileError, match=r"must be \.stl or \.vtp, got '\.obj'"):
        ae.io.read_mesh(tmp_path / "a.obj")
    ions = ae.Hits(positions=np.eye(3))
    ae.write(tmp_path / "ions.vtp", ions)
    with pytest.raises(ae.FileError, match="no polygons"):
        ae.io.read_mesh(tmp_path / "ions.vtp")
