"""Distinct rows of arrays, and distinct numbers of cells: quicker than `numpy.unique` for very many."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from autdtorch.utils.array_types import AnyArray, Index

_MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)  # odd, of the golden ratio: digests of rows
_HALF = np.uint64(32)
_TOGETHER = 4096  # Rows that stay in the cache while columns are added


def distinct_rows(rows: AnyArray) -> tuple[Index, Index]:
    """Return the places (k,) of the distinct of n rows, and the number (n,) of each row among these.

    Rows are compared bit by bit. All count as distinct where two of them have the same digest.
    """
    rows = np.ascontiguousarray(rows)
    digest, bits = np.zeros(len(rows), np.uint64), rows.view(np.dtype(f"u{rows.itemsize}"))
    for first_row in range(0, len(rows), _TOGETHER):
        some = slice(first_row, first_row + _TOGETHER)
        for column in bits[some].T:
            mixed = (digest[some] ^ column) * _MULTIPLIER
            digest[some] = mixed ^ (mixed >> _HALF)  # the upper bits, where those of numbers differ, count
    _, first, kind = np.unique(digest, return_index=True, return_inverse=True)
    distinct = rows[first]
    for first_row in range(0, len(rows), _TOGETHER):
        some = slice(first_row, first_row + _TOGETHER)
        if (distinct[kind[some]] != rows[some]).any():
            return np.arange(len(rows)), np.arange(len(rows))
    return first, kind


def distinct_cells(cells: Index, count: int) -> Index:
    """Return the distinct of flat indices (...) below `count`, ascending (n,)."""
    mask = np.zeros(count, bool)
    mask[cells] = True
    return np.flatnonzero(mask)


def places_among(distinct: Index, count: int) -> NDArray[np.int32]:
    """Return the place of each of `count` flat indices among `distinct` ones (n,); 0 of others."""
    place = np.zeros(count, np.int32)
    place[distinct] = np.arange(len(distinct), dtype=np.int32)
    return place
