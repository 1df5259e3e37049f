"""Scenes on the grid of a peer: cell densities, and weights of points between cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
import torch
from benchmarks.peer_programs.task import Array, Cells
from numpy.typing import NDArray
from scipy.fft import next_fast_len

import autdtorch as at

SUBCELLS = 6
"""Samples per edge of a cell for its mean density."""

HALF_WIDTH, KAISER = 4, 6.31
"""Half-width [cells] and shape of the windowed sinc for points between cells (Hicks 2002)."""

ON_NODE = 1e-6
"""Distance from a cell centre within which a point lies on it [cells]."""


@dataclass(frozen=True)
class SceneGrid:
    """The domain, focus and transducers of a scene on cells."""

    density: Array  # harmonic mean over each cell (X, Y, Z) [kg/m^3]
    source_cells: Cells  # of the focus (S, 3)
    source_weights: Array  # (S,)
    receiver_cells: Cells  # of the transducers (R, 3)
    receiver_weights: NDArray[np.float64]  # for each transducer (M, R)


def scene_grid(scene: at.Scene, spacing: float, offset: float, layer_cells: int, smooth: bool) -> SceneGrid:
    """Put a scene on cells.

    Args:
        scene: with one focus, and obstacles with the sound speed of air.
        spacing: edge of a cell [m].
        offset: of the cell centres from the focus along each axis [cells].
        layer_cells: of the absorbing layer that the peer adds.
        smooth: whether grid and layer get sides without prime factors over 5, for FFTs.
    """
    focus = scene.control_points[0].numpy()
    origin = focus + offset * spacing
    points = np.concatenate((focus[None], scene.array.positions.numpy()))
    spreads = [spread((point - origin) / spacing) for point in points]

    corners = (np.asarray(scene.domain) - origin) / spacing
    reached = np.concatenate([cells for cells, _ in spreads])
    first = np.minimum(np.ceil(corners[0] - ON_NODE), reached.min(axis=0)).astype(np.int64)
    last = np.maximum(np.floor(corners[1] + ON_NODE), reached.max(axis=0)).astype(np.int64)
    shape = [int(n) for n in last - first + 1]
    if smooth:
        shape = [next_smooth(n + 2 * layer_cells) - 2 * layer_cells for n in shape]

    (source, weights), *receivers = ((cells - first, weights) for cells, weights in spreads)
    cells, inverse = np.unique(np.concatenate([c for c, _ in receivers]), axis=0, return_inverse=True)
    matrix = np.zeros((len(receivers), len(cells)))
    owner = np.repeat(np.arange(len(receivers)), [len(w) for _, w in receivers])
    matrix[owner, inverse.reshape(-1)] = np.concatenate([w for _, w in receivers])
    density = harmonic_density(scene, origin + spacing * first, spacing, shape)
    return SceneGrid(density, source, weights.astype(np.float32), cells, matrix)


def spread(place: NDArray[np.float64]) -> tuple[Cells, NDArray[np.float64]]:
    """Return cells (n, 3) and weights (n,) of a point at `place` (3,) [cells]."""
    axes = [_spread_along(float(x)) for x in place]
    cells = np.stack(np.meshgrid(*(cells for cells, _ in axes), indexing="ij"), axis=-1).reshape(-1, 3)
    return cells, reduce(np.multiply.outer, (weights for _, weights in axes)).reshape(-1)


def _spread_along(place: float) -> tuple[Cells, NDArray[np.float64]]:
    nearest = round(place)
    if abs(place - nearest) < ON_NODE:
        return np.array([nearest]), np.ones(1)
    cells = int(np.floor(place)) + np.arange(1 - HALF_WIDTH, 1 + HALF_WIDTH)
    away = cells - place
    window = np.i0(KAISER * np.sqrt(np.clip(1 - (away / HALF_WIDTH) ** 2, 0, None))) / np.i0(KAISER)
    weights = np.sinc(away) * window
    return cells, weights / weights.sum()


def harmonic_density(
    scene: at.Scene, origin: NDArray[np.float64], spacing: float, shape: Sequence[int]
) -> Array:
    """Return the harmonic mean density of each cell; `origin` (3,) is the centre of the first [m]."""
    inside = (np.arange(SUBCELLS) + 0.5) / SUBCELLS - 0.5
    x, y, z = (
        torch.from_numpy(start + spacing * (np.arange(cells)[:, None] + inside).reshape(-1))
        for start, cells in zip(origin, shape, strict=True)
    )
    lightness = np.full(tuple(shape), 1 / scene.medium.density)
    slabs = x.reshape(-1, SUBCELLS)
    for index, slab in enumerate(slabs):  # plane by plane, to save memory
        if not any(o.lower[0] < float(slab[-1]) and float(slab[0]) < o.upper[0] for o in scene.obstacles):
            continue
        points = torch.cartesian_prod(slab, y, z)
        values = torch.full((len(points),), 1 / scene.medium.density, dtype=torch.float64)
        for obstacle in scene.obstacles:
            assert obstacle.density is not None
            values[obstacle.contains(points)] = 1 / obstacle.density
        parts = values.numpy().reshape(SUBCELLS, shape[1], SUBCELLS, shape[2], SUBCELLS)
        lightness[index] = parts.mean(axis=(0, 2, 4))
    return (1 / lightness).astype(np.float32)


def next_smooth(number: int) -> int:
    """Return the smallest number from `number` on without prime factors over 5."""
    return int(next_fast_len(number, real=True))
