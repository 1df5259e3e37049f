"""STL, OBJ and PLY files as other programs write them."""

import struct
from pathlib import Path

import numpy as np
import pytest
from small_meshes import volume

from autdtorch.scene.obstacles import Mesh
from autdtorch.scene.obstacles.mesh_file import read_mesh

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
    _, (vertices, faces) = read_mesh(path)
    assert vertices.tolist() == [list(corner) for corner in CORNERS]
    assert faces.tolist() == [list(face) for face in FACES]


OUTLINE = [(0, 0), (20, 0), (20, 10), (10, 10), (10, 20), (0, 20)]
AREA, HEIGHT = 300.0, 5.0


def prism(first: int) -> tuple[list[tuple[float, float, float]], list[list[int]]]:
    """Return an L with caps of six corners, the first of them given: no fan covers it from everywhere."""
    ring = OUTLINE[first:] + OUTLINE[:first]
    sides = [[i, (i + 1) % 6, (i + 1) % 6 + 6, i + 6] for i in range(6)]
    return [(x, y, z) for z in (0.0, HEIGHT) for x, y in ring], [[5, 4, 3, 2, 1, 0], [*range(6, 12)], *sides]


@pytest.mark.parametrize("first", range(6))
@pytest.mark.parametrize("kind", ["obj", "ascii", "binary_little_endian"])
def test_polygons_need_not_be_convex(tmp_path: Path, kind: str, first: int) -> None:
    """Files mix lengths, and faces carry texture coordinates."""
    vertices, faces = prism(first)
    path = tmp_path / ("body.obj" if kind == "obj" else "body.ply")
    if kind == "obj":
        lines = [f"v {x} {y} \\\n {z}" for x, y, z in vertices]
        lines += ["f " + " ".join(f"{corner + 1}/1" for corner in face) for face in faces]
        path.write_bytes(b"\xef\xbb\xbf" + "\n".join(lines).encode())
    else:
        head = f"ply\nformat {kind} 1.0\nelement vertex {len(vertices)}\n"
        head += "".join(f"property float {axis}\n" for axis in "xyz") + f"element face {len(faces)}\n"
        head += "property list uchar int vertex_indices\nproperty list uchar float texcoord\nend_header\n"
        rows = [[*corner] for corner in vertices]
        lists = [[len(face), *face, 2 * len(face), *[0.5] * (2 * len(face))] for face in faces]
        if kind == "ascii":
            body = "\n".join(" ".join(map(str, row)) for row in [*rows, *lists]).encode()
        else:
            body = b"".join(struct.pack("<3f", *row) for row in rows)
            for face in faces:
                count = len(face)
                texture = struct.pack(f"<B{2 * count}f", 2 * count, *[0.5] * (2 * count))
                body += struct.pack(f"<B{count}i", count, *face) + texture
        path.write_bytes(head.encode() + body)
    assert volume(Mesh(path, rigid=True)) == pytest.approx(AREA * HEIGHT)


def stl_text(change: str = "") -> str:
    corners = np.array(CORNERS)[np.array(FACES)]
    lines = ["solid body"]
    for triangle in corners:
        lines += ["facet normal 0 0 0", " outer loop"]
        lines += [f"  vertex {x} {y} {z}" for x, y, z in triangle] + [" endloop", "endfacet"]
    text = "\n".join([*lines, "endsolid body", ""])
    return text.upper() if change == "capitals" else text


def stl_binary(name: bytes = b"body", count: int = len(FACES)) -> bytes:
    corners = np.array(CORNERS, "<f4")[np.array(FACES)]
    records = b"".join(struct.pack("<12fH", 0, 0, 0, *triangle.ravel(), 0) for triangle in corners)
    return name.ljust(80) + struct.pack("<I", count) + records


STL = {
    "text": stl_text().encode(),
    "capitals": stl_text("capitals").encode(),
    "a byte order mark": b"\xef\xbb\xbf" + stl_text().encode(),
    "blank lines first": b"\n  \n " + stl_text().encode(),
    "line ends of Windows": stl_text().replace("\n", "\r\n").encode(),
    "binary": stl_binary(),
    "binary, solid": stl_binary(b"solid body"),
    "binary, solid, a byte more": stl_binary(b"solid body") + b"\n",
    "binary, solid, many bytes more": stl_binary(b"solid body") + b"solid facet" * 40,
}


@pytest.mark.timeout(20)
@pytest.mark.parametrize("content", STL.values(), ids=STL.keys())
def test_stl(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "body.stl").write_bytes(content)
    assert volume(Mesh(tmp_path / "body.stl", rigid=True)) == pytest.approx(0.5)


NO_MESH = {
    "a.stl": (b"", "it is empty"),
    "b.stl": (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "Git LFS pointer"),
    "c.obj": (b"\n<!DOCTYPE html><html></html>", "page of HTML"),
    "d.ply": (ply_head := b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
              b"property float z\nend_header\n0 0 0\n", "no faces, only points"),
    "e.obj": (b"v 0 0 0\nv 1 0 0\n", "2 points and no faces"),
    "f.stl": (stl_binary()[:-10], "its head tells of 4 triangles, 3 fit"),
    "g.stl": (stl_text().replace("endfacet", "", 1).encode(), "4 facets begin and 3 end"),
    "h.stl": (b"some other text", "neither text with facets nor a binary STL file"),
    "j.obj": (b"v 0 0 0\nv 1 0 0\nf 1 2 7\n", "face 0 has vertex 6; must be one of the 2 vertices"),
    "k.obj": (b"v 0 0 0\nv 1e200 0 0\nv 1 1 0\nv 0 nan 0\nf 1 2 3 4\n", "finite, none beyond 1e+50"),
    "l.obj": (b"v 0 0 0\nv 1 1 0\nv 1 0 0\nv 0 2 0\nf 1 2 3 4\n", "face 0 of 4 vertices crosses itself"),
    "m.ply": (b"hello", "no header of a PLY file"),
    "i.ply": (ply_head.replace(b"float z", b"real z"), "type 'real'"),
}  # fmt: skip


def declaring(kind: str, vertices: int, faces: int, rows: str = "") -> bytes:
    """Return a PLY file; readers of libigl end the process or take all memory where it declares too much."""
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat {kind} 1.0\nelement vertex {vertices}\n{axes}element face {faces}\n"
    rows = f"0 0 0\n1 0 0\n0 1 0\n0 0 1\n{rows}" if kind == "ascii" else ""
    return (head + "property list uchar int vertex_indices\nend_header\n" + rows).encode("ascii")


THREE = "3 0 1 3\n3 0 3 2\n"
NO_MESH |= {
    "large.ply": (declaring("binary_little_endian", 4_000_000_000, 4_000_000_000), ""),
    "large text.ply": (declaring("ascii", 10**12, 10**12), ""),
    "beyond integers.ply": (declaring("binary_little_endian", 10**30, 1), ""),
    "less than nothing.ply": (declaring("binary_little_endian", -1, 0), ""),
    "quads.ply": (declaring("ascii", 4, 4, f"3 0 2 1\n{THREE}4 1 2 3 0\n"), ""),
    "halves.ply": (declaring("ascii", 4, 4, f"3 0 2.5 1\n{THREE}3 1 2 3\n"), ""),
    "no numbers.ply": (declaring("ascii", 4, 4, f"3 0 nan 1\n{THREE}3 1 2 3\n"), ""),
    "nothing.ply": (b"ply\nformat ascii 1.0\nend_header\n", ""),
    "one corner.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1\n", ""),
    "beyond integers.obj": (f"v 0 0 0\nf 1 1 {10**30}\n".encode(), ""),
    "large.stl": (b"\0" * 80 + b"\x7f" * 4 + b"\0" * 50, ""),
}


@pytest.mark.parametrize("name", NO_MESH)
def test_what_is_no_mesh_is_named(tmp_path: Path, name: str) -> None:
    content, reason = NO_MESH[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=rf"^Mesh\.path: .*{name}") as caught:
        Mesh(tmp_path / name, rigid=True)
    assert reason in str(caught.value)
    assert "\n" not in str(caught.value)


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
    _, (vertices, faces) = read_mesh(tmp_path / "body.ply")
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
        read_mesh(tmp_path / "body.ply")
