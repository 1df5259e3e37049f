"""STL, OBJ and PLY files as other programs write them; scans with faults, which become bodies."""

import itertools
import logging
import struct
from pathlib import Path

import igl
import numpy as np
import pytest
import torch
from small_meshes import CUBE, ball, inverted, merged, tube, volume

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


BALL = ball(np.zeros(3), 1.0, 3)
SHEET = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
PARTS = {"cube": CUBE, "ball": BALL}


def rods() -> tuple[np.ndarray, np.ndarray]:
    """A palm and fingers, open at the wrist, as a depth camera leaves a hand."""
    axis = np.linspace(-1.6, 1.6, 48)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    distance = np.hypot(np.hypot(x / 1.2, (y + 0.4) / 1.2), z / 0.5) - 0.5
    for place in (-0.4, 0.0, 0.4):
        along = np.clip(y, 0, 1.2)
        distance = np.minimum(distance, np.sqrt((x - place) ** 2 + (y - along) ** 2 + z**2) - 0.16)
    wrist = np.sqrt(x**2 + (y - np.clip(y, -3, -0.8)) ** 2 + z**2) - 0.3
    places = np.stack([x, y, z], axis=-1).transpose(2, 1, 0, 3).reshape(-1, 3)
    field = np.minimum(distance, wrist).transpose(2, 1, 0).ravel()
    vertices, faces, _ = igl.marching_cubes(field, places, 48, 48, 48, 0.0)
    return vertices, faces[:, ::-1]


def apart(part, noise, random):
    vertices = part[0][part[1]].reshape(-1, 3)
    moved = vertices + noise * random.uniform(-1, 1, vertices.shape)
    return moved, np.arange(len(vertices)).reshape(-1, 3)


def turned(part, share, random):
    faces = part[1].copy()
    some = np.arange(len(faces)) < max(1, share * len(faces))
    random.shuffle(some)
    faces[some] = faces[some, ::-1]
    return part[0], faces


def with_holes(part, count, random):
    return part[0], np.delete(part[1], random.choice(len(part[1]), count, replace=False), axis=0)


def with_strays(part, count, random):
    places = random.uniform(2, 3, (count, 1, 3)) + 0.01 * random.normal(size=(count, 3, 3))
    return merged(part, (places.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)))


def doubled(part, count, random):
    return part[0], np.vstack([part[1], part[1][random.choice(len(part[1]), count)]])


def split(part, count, _):
    vertices, faces = part
    for number in range(count):
        a, b, c = faces[number]
        new = len(vertices)
        vertices = np.vstack([vertices, (vertices[a] + vertices[b]) / 2])
        faces = np.vstack([faces[:number], [[a, new, c]], faces[number + 1 :], [[new, b, c]]])
    return vertices, faces


FAULTS = {
    "joined": [(apart, size) for size in (3e-5, 1e-4, 3e-4)],
    "turned": [(turned, size) for size in (0.01, 0.2, 0.45)],
    "closed": [(with_holes, size) for size in (1, 2)] + [(split, size) for size in (1, 2, 3)],
    "stray": [(with_strays, size) for size in (1, 5, 30)],
    "twice": [(doubled, size) for size in (1, 4, 12)],
}
CASES = [
    (said, *fault, part)
    for said, faults in FAULTS.items()
    for fault, part in itertools.product(faults, PARTS)
]


@pytest.mark.parametrize(("said", "fault", "size", "part"), CASES)
def test_a_fault_is_mended_and_said(said, fault, size, part, caplog):
    surface = fault(PARTS[part], size, np.random.default_rng(1))
    with pytest.raises(ValueError, match="repair=True may mend it"):
        Mesh.from_surface(surface, rigid=True)
    mesh = Mesh.from_surface(surface, repair=True, rigid=True)
    assert said in caplog.text
    assert volume(mesh) == pytest.approx(volume(Mesh.from_surface(PARTS[part], rigid=True)), rel=0.01)
    edge = Mesh.from_surface(mesh.surface(), rigid=True)  # whole now
    assert torch.equal(edge.faces, mesh.faces)


def test_what_is_right_stays_as_it_is_and_parts_inside_out_become_their_union(caplog):
    with caplog.at_level(logging.DEBUG):
        mesh = Mesh.from_surface(BALL, repair=True, rigid=True)
    assert "repaired" not in caplog.text
    assert mesh == Mesh.from_surface(BALL, rigid=True)
    other = ball(np.array([0.7, 0.0, 0.0]), 1.0, 3)
    right, wrong = (
        Mesh.from_surface(merged(BALL, part), repair=True, rigid=True) for part in (other, inverted(other))
    )
    assert volume(wrong) == pytest.approx(volume(right), rel=1e-6)


def test_a_scan_of_a_hand_becomes_a_body_in_one_call(caplog):
    """Open at the wrist, with holes, turned triangles and strays: the volume within 1 % of the capped one."""
    random, whole = np.random.default_rng(0), rods()
    capped = Mesh.from_surface(whole, repair=True, rigid=True)
    scan = with_strays(turned(with_holes(whole, 12, random), 0.1, random), 20, random)
    mesh = Mesh.from_surface(scan, repair=True, rigid=True)
    assert all(said in caplog.text for said in ("stray", "turned", "closed "))
    assert volume(mesh) == pytest.approx(volume(capped), rel=0.01)
    assert mesh.contains([[0.0, -0.4, 0.0], [0.4, 1.1, 0.0], [0.0, -1.4, 0.0]]).all()
    assert not mesh.contains([[0.2, 1.0, 0.0], [0.0, -0.4, 0.9], [2.5, 2.5, 2.5]]).any()


def test_a_surface_that_crosses_itself_is_made_anew(caplog):
    turn = np.linspace(0, 2 * np.pi, 61)[:-1] + 0.02
    path = np.stack([2 * np.sin(turn), np.sin(2 * turn), 0 * turn], axis=1)
    mesh = Mesh.from_surface(tube(path), repair=True, rigid=True)
    assert "made the surface anew" in caplog.text
    assert mesh.contains(path).all()
    length = np.linalg.norm(np.diff(path, axis=0, append=path[:1]), axis=1).sum()
    around = np.pi * 0.2**2 * length
    assert 0.9 * around < volume(mesh) < around  # less what both strands share
    # As smooth as the tube, whose sides turn by 30 degrees; those of steps would be along the axes
    vertices, faces = mesh.surface()
    corners = vertices[faces]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    middle = corners.mean(dim=1).numpy()
    nearest = path[np.linalg.norm(middle[:, None] - path, axis=2).argmin(axis=1)]
    ahead = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1)[:, None]
    along = ahead[np.linalg.norm(middle[:, None] - path, axis=2).argmin(axis=1)]
    outwards = middle - nearest
    outwards -= (outwards * along).sum(axis=1)[:, None] * along
    cosine = (normals.numpy() * outwards).sum(axis=1) / np.linalg.norm(outwards, axis=1)
    assert cosine.sum() > 0.95 * float(normals.norm(dim=1).sum())


OF_TRIANGLES = BALL[0][BALL[1]]
APART = (
    (0.2 * OF_TRIANGLES.mean(axis=1, keepdims=True) + 0.8 * OF_TRIANGLES).reshape(-1, 3),
    np.arange(OF_TRIANGLES.size // 3).reshape(-1, 3),
)


@pytest.mark.parametrize(
    ("surface", "reason"),
    [
        ((SHEET, np.array([[0, 1, 2], [0, 2, 3]])), "100%"),
        ((BALL[0], BALL[1][BALL[0][BALL[1]].mean(axis=1)[:, 2] > 0]), "of all area; must be at most 30%"),
        ((BALL[0], np.zeros((4, 3))), "no triangle has an area"),
        (APART, "must be triangles with common edges"),
    ],
    ids=["a sheet", "half a ball", "a point", "triangles apart"],
)
def test_what_would_be_guessed_is_refused(surface, reason):
    with pytest.raises(ValueError, match=reason):
        Mesh.from_surface(surface, repair=True, rigid=True)
