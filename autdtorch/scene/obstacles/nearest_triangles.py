"""The nearest of many triangles to points, compiled: a tree of boxes, searched for eight points at a time.

A search begins at the leaf that was nearest to the points before, and climbs to the root. On the way it
enters what may be nearer than the nearest triangle so far.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from autdtorch.utils.compiled import INNER, entry

_LANES = np.uint64(8)  # Points searched for together
_WIDEST = 4.0  # Width of the box around them, over the distance of points that follow each other
_X, _Y, _Z, _SQUARE, _TRIANGLE = (np.uint64(8 * row) for row in range(5))  # rows of a block of lanes
_DEEPEST = 128  # Twice the levels of a tree of more triangles than memory holds
_ON_SIDE = 1e-9  # Barycentric coordinate of a nearest point that lies on a side of its triangle
_AT_CORNER = 1e-9  # Share of a side up to which a nearest point lies at its corner
_ZERO, _ONE, _NOWHERE = np.uint64(0), np.uint64(1), np.uint64(0)


@njit(**INNER)
def _gap(lower, upper, low, high):  # type: ignore[no-untyped-def]
    gap = lower - high if lower - high > low - upper else low - upper
    return gap if gap > 0.0 else 0.0


@njit(**INNER)
def _square_gap(boxes, node, around):  # type: ignore[no-untyped-def]
    """Return the squared distance between the box of a node and another one (6,)."""
    x = _gap(boxes[node, 0], boxes[node, 3], around[0], around[3])
    y = _gap(boxes[node, 1], boxes[node, 4], around[1], around[4])
    z = _gap(boxes[node, 2], boxes[node, 5], around[2], around[5])
    return x * x + y * y + z * z


@njit(**INNER)
def _is_near(boxes, node, lanes):  # type: ignore[no-untyped-def]
    """Return whether the box of a node is nearer to a point than the point's nearest triangle so far."""
    a, b, c = boxes[node, 0], boxes[node, 1], boxes[node, 2]
    d, e, f = boxes[node, 3], boxes[node, 4], boxes[node, 5]
    count = 0
    for lane in range(_ZERO, _LANES):
        x = _gap(a, d, lanes[_X + lane], lanes[_X + lane])
        y = _gap(b, e, lanes[_Y + lane], lanes[_Y + lane])
        z = _gap(c, f, lanes[_Z + lane], lanes[_Z + lane])
        count += 1 if x * x + y * y + z * z < lanes[_SQUARE + lane] else 0
    return count > 0


@njit(**INNER, forceinline=True)
def _dot(a, b, c, x, y, z):  # type: ignore[no-untyped-def]
    return a * x + b * y + c * z


@njit(**INNER, forceinline=True)
def _beyond(x, y, z, a, b, c, per_square):  # type: ignore[no-untyped-def]
    """Return the share of a side at its point nearest to a place, and the way from there to the place."""
    share = _dot(a, b, c, x, y, z) * per_square
    share = share if share > 0.0 else 0.0
    share = share if share < 1.0 else 1.0
    return share, x - share * a, y - share * b, z - share * c


@njit(**INNER, forceinline=True)
def _ways(x, y, z, triangle):  # type: ignore[no-untyped-def]
    """Return how far inside the sides a place is, by barycentric coordinates, and the way from the plane.

    Then, for the two sides from the first corner and the third, what `_beyond` returns.
    """
    (ax, ay, az, ux, uy, uz, vx, vy, vz, fx, fy, fz, gx, gy, gz, per_uu, per_vv, per_ww) = triangle
    x, y, z = x - ax, y - ay, z - az
    u, v = _dot(fx, fy, fz, x, y, z), _dot(gx, gy, gz, x, y, z)
    inside = u if u < v else v
    inside = inside if inside < 1.0 - u - v else 1.0 - u - v
    return (
        (inside, x - u * ux - v * vx, y - u * uy - v * vy, z - u * uz - v * vz),
        _beyond(x, y, z, ux, uy, uz, per_uu),
        _beyond(x, y, z, vx, vy, vz, per_vv),
        _beyond(x - ux, y - uy, z - uz, vx - ux, vy - uy, vz - uz, per_ww),
    )


@njit(**INNER, forceinline=True)
def _square(way):  # type: ignore[no-untyped-def]
    return way[1] * way[1] + way[2] * way[2] + way[3] * way[3]


@njit(**INNER, forceinline=True)
def _row(table, number):  # type: ignore[no-untyped-def]
    # fmt: off
    t = table[number]
    return (
        t[0], t[1], t[2], t[3], t[4], t[5], t[6], t[7], t[8],
        t[9], t[10], t[11], t[12], t[13], t[14], t[15], t[16], t[17],
    )
    # fmt: on


@njit(**INNER)
def _measure(triangles, number, lanes):  # type: ignore[no-untyped-def]
    """Note a triangle for the points to which it is nearer than all before; branches would not be vectors."""
    triangle, name = _row(triangles, number), float(number)
    for lane in range(_ZERO, _LANES):
        plane, first, second, third = _ways(lanes[_X + lane], lanes[_Y + lane], lanes[_Z + lane], triangle)
        one, other, last = _square(first), _square(second), _square(third)
        square = one if one < other else other
        square = square if square < last else last
        # shares of slivers are inaccurate, and a place of theirs in the plane may be far from the nearest one
        square = _square(plane) if plane[0] > 0.0 and _square(plane) < square else square
        before = lanes[_SQUARE + lane]
        lanes[_TRIANGLE + lane] = name if square < before else lanes[_TRIANGLE + lane]
        lanes[_SQUARE + lane] = square if square < before else before


@njit(**INNER)
def _search(node, bound, boxes, triangles, around, lanes, waiting, gaps):  # type: ignore[no-untyped-def]
    """Look for nearer triangles below a node; return the largest squared distance of a point so far."""
    first_leaf = np.uint64(len(boxes)) >> _ONE
    in_leaf = np.uint64(len(triangles)) // first_leaf
    waiting[0], gaps[0], count = node, 0.0, 1
    while count:
        count -= 1
        node = waiting[count]
        if gaps[count] >= bound:
            continue
        while node < first_leaf and node != _NOWHERE:
            near, far = node + node, node + node + _ONE
            gap, farther = _square_gap(boxes, near, around), _square_gap(boxes, far, around)
            if farther < gap:
                near, far, gap, farther = far, near, farther, gap
            if farther < bound:
                waiting[count], gaps[count] = far, farther
                count += 1
            node = near if gap < bound else _NOWHERE
        if node == _NOWHERE or not _is_near(boxes, node, lanes):
            continue
        first = (node - first_leaf) * in_leaf
        for number in range(first, first + in_leaf):
            _measure(triangles, number, lanes)
        bound = 0.0
        for lane in range(_ZERO, _LANES):
            bound = max(bound, lanes[_SQUARE + lane])
    return bound


@njit(**INNER)
def _spacing(points):  # type: ignore[no-untyped-def]
    """Return the least distance between points (N, 3) that follow each other and differ."""
    least = np.inf
    for number in range(1, len(points)):
        square = 0.0
        for axis in range(3):
            square += (points[number, axis] - points[number - 1, axis]) ** 2
        least = square if 0.0 < square < least else least
    return np.sqrt(least)


@njit(**INNER)
def _joins(points, number, around, widest):  # type: ignore[no-untyped-def]
    """Return whether a box (6,) with a further point is at most so wide, and if it is, extend it."""
    for axis in range(3):
        place = points[number, axis]
        if max(around[axis + 3], place) - min(around[axis], place) > widest:
            return False
    for axis in range(3):
        place = points[number, axis]
        around[axis], around[axis + 3] = min(around[axis], place), max(around[axis + 3], place)
    return True


@njit(**INNER)
def _side_of(x, y, z, triangle, features, normals):  # type: ignore[no-untyped-def]
    """Return the distance of a point from a triangle, and from the tangent plane of the surface there."""
    plane, first, second, third = _ways(x, y, z, triangle)
    one, other, last = _square(first), _square(second), _square(third)
    way, opposite, begin, end = first, 2, 0, 1
    if other < one and other <= last:
        way, opposite, begin, end = second, 1, 0, 2
    elif last < one:
        way, opposite, begin, end = third, 0, 1, 2
    place = 1 + opposite
    if way[0] < _AT_CORNER:
        place = 4 + begin
    elif way[0] > 1.0 - _AT_CORNER:
        place = 4 + end
    if plane[0] > 0.0 and _square(plane) < _square(way):
        way = plane
        if plane[0] > _ON_SIDE:
            place = 0
    normal = normals[features[place]]
    return np.sqrt(_square(way)), _dot(way[1], way[2], way[3], normal[0], normal[1], normal[2])


@entry()
def nearest_triangles(points, boxes, triangles, features, normals, distance, above):  # type: ignore[no-untyped-def]
    """Write the distance of points (N, 3) from the nearest triangle, and from the tangent plane there (N,).

    Args:
        points: neighbours should follow each other.
        boxes: of the nodes (2 L, 6), lower and upper corners. Node i has the children 2 i and 2 i + 1, the
            root is 1, and the L leaves are last.
        triangles: rows (F, 18) of the first corner, both sides from it, two vectors, and the inverse squares
            of the three sides. The product of such a vector and a way from the corner is the share of a side.
            All leaves have as many triangles.
        features: rows in `normals` of the face, its sides opposite each corner, and its corners (F, 7).
        normals: of the faces, edges and vertices (n, 3).
        distance: of the points, to be written.
        above: the distance from the plane, to be written; negative inside.
    """
    lanes, around = np.zeros(np.uint64(5) * _LANES), np.empty(6)
    waiting, gaps = np.empty(_DEEPEST, np.uint64), np.empty(_DEEPEST)
    home, count = np.uint64(len(boxes)) >> _ONE, np.uint64(len(points))
    in_leaf = np.uint64(len(triangles)) // home
    widest, begin, end = _WIDEST * _spacing(points), _ZERO, _ZERO
    while end < count:
        begin, around[:3], around[3:] = end, np.inf, -np.inf
        while end < count and end < begin + _LANES and _joins(points, end, around, widest):
            end += _ONE
        for lane in range(_ZERO, _LANES):
            place = points[min(begin + lane, end - _ONE)]
            lanes[_X + lane], lanes[_Y + lane], lanes[_Z + lane] = place[0], place[1], place[2]
            lanes[_SQUARE + lane] = np.inf
        node, beside, bound = home, home, np.inf
        while node > _NOWHERE:
            if _square_gap(boxes, beside, around) < bound:
                bound = _search(beside, bound, boxes, triangles, around, lanes, waiting, gaps)
            node, beside = node >> _ONE, node ^ _ONE
        for lane in range(_ZERO, end - begin):
            nearest = np.uint64(lanes[_TRIANGLE + lane])
            x, y, z = lanes[_X + lane], lanes[_Y + lane], lanes[_Z + lane]
            distance[begin + lane], above[begin + lane] = _side_of(
                x, y, z, _row(triangles, nearest), features[nearest], normals
            )
        home = (np.uint64(len(boxes)) >> _ONE) + np.uint64(lanes[_TRIANGLE]) // in_leaf
