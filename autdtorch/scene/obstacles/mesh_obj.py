"""OBJ files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from autdtorch.scene.obstacles.mesh_polygons import Polygons


def read_obj(path: str) -> Polygons:
    """Read the vertices and polygons of an OBJ file; texture, normals, groups and materials are ignored.

    Raises:
        ValueError: a line that is no vertex or face; the message names it.
    """
    vertices: list[list[float]] = []
    lengths: list[int] = []
    corners: list[int] = []
    with Path(path).open(encoding="utf-8-sig", errors="replace") as lines:
        for number, line in _joined(lines):
            kind, *words = line.split() or [""]
            try:
                if kind == "v":
                    x, y, z = map(float, words[:3])
                    vertices.append([x, y, z])
                elif kind == "f":
                    if len(words) < 3:
                        raise ValueError(f"a face of {len(words)} vertices; must be at least 3")
                    corners += [_index(word, len(vertices)) for word in words]
                    lengths.append(len(words))
            except ValueError as error:
                raise ValueError(f"line {number}: {error}") from error
    places = np.array(vertices, np.float64).reshape(-1, 3)
    return Polygons(places, np.array(lengths, np.int64), np.array(corners, np.int64))


def _joined(lines: Iterable[str]) -> Iterator[tuple[int, str]]:
    r"""Return lines and their numbers from 1; a line that ends with \ goes on in the next one."""
    begun = ""
    number = 0
    for number, line in enumerate(lines, 1):
        text = line.partition("#")[0].rstrip()
        if text.endswith("\\"):
            begun += text[:-1] + " "
            continue
        yield number, begun + text
        begun = ""
    if begun:
        yield number, begun


def _index(word: str, count: int) -> int:
    """Return an index from 0; the file counts from 1, or backwards from the last of `count` vertices."""
    index = int(word.partition("/")[0])
    if index == 0:
        raise ValueError("vertex 0; vertices are counted from 1")
    return index - 1 if index > 0 else count + index
