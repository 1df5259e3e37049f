"""Loops over cells and their neighbours, compiled; the order of all sums is fixed."""

from __future__ import annotations

import numpy as np

from autdtorch.utils.compiled import entry


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
