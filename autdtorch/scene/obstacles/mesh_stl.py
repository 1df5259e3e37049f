"""STL files, of text or binary."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from autdtorch.scene.obstacles.mesh_polygons import Polygons

_HEAD, _FACET = 84, 50  # bytes of the head of a binary file, and of each triangle
_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_VERTEX = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)
_FACET_BEGIN, _FACET_END = (
    re.compile(pattern, re.IGNORECASE) for pattern in (rb"(?<!end)\bfacet\b", rb"\bend\s*facet\b")
)
_MARK = b"\xef\xbb\xbf"  # of UTF-8, which editors put before text


def read_stl(path: str) -> Polygons:
    """Read the triangles of an STL file.

    Both kinds may begin with "solid". The length tells a binary file; more bytes at its end are ignored.

    Raises:
        ValueError: neither text nor binary, or one that ends too early.
    """
    content = Path(path).read_bytes()
    begin = content[:_HEAD].removeprefix(_MARK).lstrip()[:5].lower()
    count = int.from_bytes(content[_HEAD - 4 : _HEAD], "little")
    exact = len(content) == _HEAD + _FACET * count
    if begin == b"solid" and not exact and _VERTEX.search(content):
        return _text(content)
    if len(content) < _HEAD:
        raise ValueError("neither text with facets nor a binary STL file")
    if len(content) < _HEAD + _FACET * count:
        fit = (len(content) - _HEAD) // _FACET
        told = f"its head tells of {count} triangles, {fit} fit"
        raise ValueError(f"neither text with facets nor a whole binary STL file: {told}")
    records = np.frombuffer(content, _RECORD, count, _HEAD)
    return _separate(records["corners"].astype(np.float64))


def _text(content: bytes) -> Polygons:
    found = _VERTEX.findall(content)
    begun, ended = (len(each.findall(content)) for each in (_FACET_BEGIN, _FACET_END))
    if not 3 * begun == 3 * ended == len(found):
        many = f"{begun} facets begin and {ended} end, with {len(found)} vertices in all"
        raise ValueError(f"{many}; must be three vertices a facet")
    try:
        corners = np.array(found).astype(np.float64)
    except ValueError as error:
        raise ValueError(f"a vertex without three numbers ({error})") from error
    return _separate(corners)


def _separate(corners: np.ndarray) -> Polygons:
    """Return triangles without common vertices."""
    vertices = corners.reshape(-1, 3)
    return Polygons(vertices, np.full(len(vertices) // 3, 3), np.arange(len(vertices)))
