"""Loops over cells and their neighbours, compiled; the order of all sums is fixed."""

from __future__ import annotations

import numpy as np
from numba import njit

from autdtorch.utils.compiled import INNER, entry

_ROUNDING = 4e-16


@entry()
def add_elements(first, last, cells, kind, tables, numbers, hard, coupling, sums):  # type: ignore[no-untyped-def]
    """Write rows `first` to `last` of the coupling (n, 27) of cells (n,), and sums over their elements.

    Args:
        first: number of the first row.
        last: one past the last row.
        cells: flat indices (n,).
        kind: of the element whose first vertex is a cell, of all cells.
        tables: coupling (k, 28) of the kinds, and two values of each vertex (k, 8).
        numbers: unsigned, offsets of the vertices (8,) and of the neighbours (27,) of a cell; of the pairs of
            a vertex with the seven others the columns in the table and in a row (8, 7).
        hard: mask of the cells that are coupled to none.
        coupling: the rows.
        sums: the two values, and the sum of the magnitudes of a row (3, n).
    """
    (links, one, two), (vertices, neighbours, pair, place) = tables, numbers
    total, values, before = np.zeros(27), np.zeros(2), np.full(8, -1, np.int32)
    for row in range(first, last):
        cell, same = np.uint64(cells[row]), True
        for vertex in range(8):
            here = kind[cell - vertices[vertex]]
            same &= here == before[vertex]
            before[vertex] = here
        if not same:  # at flat faces most cells are as the one before
            total[:], values[:] = 0.0, 0.0
            for vertex in range(8):
                element = np.uint64(before[vertex])
                for other in range(7):
                    total[place[vertex, other]] += links[element, pair[vertex, other]]
                values[0] += one[element, vertex]
                values[1] += two[element, vertex]
        magnitude, closed = 0.0, hard[cell]
        for number in range(27):
            link = 0.0 if closed or hard[cell + neighbours[number]] else total[number]
            coupling[row, number] = link
            magnitude += abs(link)
        sums[0, row], sums[1, row], sums[2, row] = values[0], values[1], magnitude


@entry()
def join_cells(cells, coupling, least, place, free, number, neighbours, region):  # type: ignore[no-untyped-def]
    """Join the regions of cells between which sound passes: write the least that each is joined to.

    Args:
        cells: flat indices (n,).
        coupling: of the cells with their neighbours (n, 27).
        least: coupling up to which nothing passes into a cell (n,).
        place: of each cell of the grid among these, arbitrary for others.
        free: mask of the cells that are not rigid.
        number: the region of each cell of the grid, before.
        neighbours: offsets (27,).
        region: the number of each region, to be overwritten.
    """
    for row in range(len(cells)):
        cell = cells[row]
        if not free[cell]:
            continue
        here = number[cell]
        while region[here] != here:
            region[here] = region[region[here]]
            here = region[here]
        for offset in range(27):
            near = cell + neighbours[offset]
            if not free[near]:
                continue
            there = number[near]
            while region[there] != there:
                region[there] = region[region[there]]
                there = region[there]
            if there == here:
                continue
            blocked, other = least[row], place[near]
            if cells[other] == near:
                blocked = min(blocked, least[other])
            if abs(coupling[row, offset]) > blocked:
                low, high = min(here, there), max(here, there)
                region[high] = here = low
    for each in range(len(region)):
        region[each] = region[region[each]]


@entry()
def symmetric_rows(first, last, rows, place, weight, air, neighbours, values, columns, begin):  # type: ignore[no-untyped-def]
    """Write rows of a symmetric matrix with the eigenvalues of the stencil; return a bound of these.

    Coupling K adds K (p_i - p_j)^2 <= max(K, 0) (1/m_i + 1/m_j) (m_i p_i^2 + m_j p_j^2) to the energy. Summed
    over the neighbours of a cell, this bounds the largest eigenvalue at any contrast.

    Args:
        first: number of the first row.
        last: one past the last row.
        rows: flat indices of the cells (n,).
        place: of each cell of the grid among these, negative for others.
        weight: stencil rows of the cells (n, 27).
        air: stencil row of the others (27,).
        neighbours: offsets (27,).
        values: of the matrix, those that are not zero one after the other, to be written; maybe none.
        columns: of these, to be written.
        begin: of each row among these (last - first + 1,), to be written.
    """
    bound, count = 0.0, 0
    for row in range(first, last):
        total, diagonal = 0.0, 0.0
        for number in range(27):
            diagonal += weight[row, number]
        for number in range(27):
            near, ahead = place[rows[row] + neighbours[number]], weight[row, number]
            back = air[number] if near < 0 else weight[near, 26 - number]
            total += max(ahead + back, 0.0)
            # zeros by rounding may differ in sign
            value = -np.copysign(np.sqrt(max(ahead * back, 0.0)), ahead)
            value = diagonal if number == 13 else value
            if near >= 0 and value != 0.0 and count < len(values):
                values[count], columns[count] = value, near
                count += 1
        bound, begin[row - first + 1] = max(bound, total), count
    return bound


@njit(**INNER)
def _tridiagonalize(matrix, diagonal, beside, vector, image):  # type: ignore[no-untyped-def]
    """Write the diagonal (n,) of a symmetric matrix (n, n) after reflections, and the squares beside (n,).

    `matrix` is overwritten, and so are `vector` and `image` (n,).
    """
    size = len(diagonal)
    for step in range(size - 1):
        square = 0.0
        for row in range(step + 1, size):
            vector[row] = matrix[row, step]
            square += vector[row] * vector[row]
        diagonal[step], beside[step], first = matrix[step, step], square, vector[step + 1]
        length = np.sqrt(square) if first < 0.0 else -np.sqrt(square)
        half = square - first * length  # half the square of the vector of the reflection
        if half <= 0.0:
            continue
        vector[step + 1] = first - length
        product = 0.0
        for row in range(step + 1, size):
            image[row] = 0.0
            for column in range(step + 1, size):
                image[row] += matrix[row, column] * vector[column]
            image[row] /= half
            product += image[row] * vector[row]
        for row in range(step + 1, size):
            image[row] -= product / (2 * half) * vector[row]
        for row in range(step + 1, size):
            for column in range(step + 1, size):
                matrix[row, column] -= vector[row] * image[column] + image[row] * vector[column]
    diagonal[size - 1], beside[size - 1] = matrix[size - 1, size - 1], 0.0


@njit(**INNER)
def _largest_eigenvalue(diagonal, beside):  # type: ignore[no-untyped-def]
    """Return the largest eigenvalue of a tridiagonal matrix, by its diagonal and the squares beside (n,).

    Laguerre's method for the determinant of x less the matrix converges from above.
    """
    size, value, before = len(diagonal), -np.inf, 0.0
    for row in range(size):
        here = np.sqrt(beside[row])
        value, before = max(value, diagonal[row] + before + here), here
    while True:
        # the pivots of the elimination, and their first two derivatives by the value
        pivot, slope, bend, square, first, second = 1.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for row in range(size):
            inverse = 1 / pivot
            share = square * inverse * inverse
            bend = share * (bend - 2 * slope * slope * inverse)
            slope = 1 + share * slope
            pivot = value - diagonal[row] - square * inverse
            if pivot <= 0.0:  # rounding
                return value
            square = beside[row]
            first += slope / pivot
            second += (slope / pivot) ** 2 - bend / pivot
        root = np.sqrt(max((size - 1) * (size * second - first * first), 0.0))
        change = size / (first + root)
        if not change > _ROUNDING * abs(value):
            return value
        value -= change


@njit(**INNER)
def _element_eigenvalue(coupling, ends, mass, alone, matrix, work):  # type: ignore[no-untyped-def]
    """Return the largest eigenvalue of an element with masses (v,), infinite if a stiff vertex has none.

    `alone` (v,) are the stiffnesses of a vertex that moves alone; `matrix` (v, v) and `work` (5, v) are
    overwritten.
    """
    scale = work[4]
    for vertex in range(len(mass)):
        if mass[vertex] <= 0.0 and alone[vertex] > 0.0:
            return np.inf
        scale[vertex] = 1 / np.sqrt(mass[vertex]) if mass[vertex] > 0.0 else 0.0
        matrix[vertex, vertex] = alone[vertex] * scale[vertex] * scale[vertex]
    for pair in range(len(ends)):
        one, other = ends[pair, 0], ends[pair, 1]
        matrix[one, other] = matrix[other, one] = -coupling[pair] * scale[one] * scale[other]
    _tridiagonalize(matrix, work[0], work[1], work[2], work[3])
    return _largest_eigenvalue(work[0], work[1])


@entry()
def least_masses(coupling, mass, ends, largest, least):  # type: ignore[no-untyped-def]
    """Write masses of vertices with which elements have eigenvalues up to `largest`.

    They are in proportion to `mass` if elements with it have no larger eigenvalue, else to the stiffness of a
    vertex that moves alone.

    Args:
        coupling: coefficients of pairs of vertices (k, p).
        mass: of the vertices (k, v), or zero.
        ends: the vertices of the pairs (p, 2).
        largest: the eigenvalue.
        least: (k, v), to be written.
    """
    count, size = mass.shape
    alone, matrix, work = np.empty(size), np.empty((size, size)), np.empty((5, size))
    for row in range(count):
        alone[:] = 0.0
        for pair in range(len(ends)):
            alone[ends[pair, 0]] += coupling[row, pair]
            alone[ends[pair, 1]] += coupling[row, pair]
        for vertex in range(size):
            alone[vertex] = max(alone[vertex], 0.0)
        shape = mass[row]
        reached = _element_eigenvalue(coupling[row], ends, shape, alone, matrix, work)
        if reached > largest:
            shape = alone
            reached = _element_eigenvalue(coupling[row], ends, shape, alone, matrix, work)
        for vertex in range(size):
            least[row, vertex] = shape[vertex] * reached / largest
