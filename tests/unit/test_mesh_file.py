"""OBJ and PLY files as other programs write them."""

import struct
from pathlib import Path

import numpy as np
import pytest

from autdtorch.scene.obstacles.mesh_file import read_obj, read_ply

CORNERS = [(0.0, 0.0, 0.0), (1.5, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -2.0)]
FACES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
VERTICES = "# made by hand\n" + "".join(f"v {x} {y} {z} 1.0\n" for x, y, z in CORNERS) + "vn 0 0 1\nvt 0 0\n"

OBJ = {
    "plain": VERTICES + "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in FACES),
    "with normals": VERTICES + "".join(f"f {a + 1}/1/1 {b + 1}//1 {c + 1}/1\n" for a, b, c in FACES),
    "counted backwards": VERTICES + "".join(f"f {a - 4} {b - 4} {c - 4}\n" for a, b, c in FACES),
    "faces first": "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in FACES) + VERTICES,
    "groups and CRLF": "o body\r\ng side\r\nusemtl x\r\n"
    + (VERTICES + "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in FACES)).replace("\n", "\r\n"),
}


@pytest.mark.parametrize("text", OBJ.values(), ids=OBJ.keys())
def test_obj(tmp_path: Path, text: str) -> None:
    path = tmp_path / "body.obj"
    path.write_bytes(text.encode())
    vertices, faces = read_obj(str(path))
    assert vertices.tolist() == [list(corner) for corner in CORNERS]
    assert faces.tolist() == [list(face) for face in FACES]


def test_a_polygon_of_an_obj_file_is_a_fan_of_triangles(tmp_path: Path) -> None:
    (tmp_path / "body.obj").write_text(VERTICES + "f 1 2 3 4\n", encoding="utf-8")
    assert read_obj(str(tmp_path / "body.obj"))[1].tolist() == [[0, 1, 2], [0, 2, 3]]


def ply(kind: str, corners: str = "vertex_indices") -> bytes:
    """Return a file with a colour at each vertex and with edges, which readers ignore."""
    head = f"""ply
format {kind} 1.0
comment element vertex 7
element vertex 4
property double x
property float y
property double z
property uchar red
element face 4
property list uchar int {corners}
property short flag
element edge 1
property int vertex1
property int vertex2
end_header
"""
    if kind == "ascii":
        rows = [f"{x} {y} {z} 9" for x, y, z in CORNERS]
        rows += [f"3 {a} {b} {c} 5" for a, b, c in FACES] + ["0 1"]
        return (head + "\n".join(rows)).encode()
    order = "<" if "little" in kind else ">"
    blocks = [struct.pack(f"{order}dfdB", *corner, 9) for corner in CORNERS]
    blocks += [struct.pack(f"{order}Biiih", 3, *face, 5) for face in FACES]
    return head.encode() + b"".join(blocks) + struct.pack(f"{order}ii", 0, 1)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("corners", ["vertex_indices", "vertex_index"])
def test_ply(tmp_path: Path, kind: str, corners: str) -> None:
    (tmp_path / "body.ply").write_bytes(ply(kind, corners))
    vertices, faces = read_ply(str(tmp_path / "body.ply"))
    assert (vertices.dtype, faces.dtype) == (np.float64, np.int64)
    assert vertices.tolist() == [list(corner) for corner in CORNERS]
    assert faces.tolist() == [list(face) for face in FACES]


@pytest.mark.parametrize("index", ["nan", "inf", "2.5"])
def test_a_float_index_that_is_not_a_whole_number_is_refused(tmp_path: Path, index: str) -> None:
    content = ply("binary_little_endian").replace(b"uchar int vertex", b"uchar float vertex")
    head, _, body = content.partition(b"end_header\n")
    faces = b"".join(struct.pack("<Bfffh", 3, *face[:2], float(index), 5) for face in FACES)
    (tmp_path / "body.ply").write_bytes(
        head + b"end_header\n" + body[: 4 * 21] + faces + struct.pack("<ii", 0, 1)
    )
    with pytest.raises(ValueError, match="not whole numbers"):
        read_ply(str(tmp_path / "body.ply"))
