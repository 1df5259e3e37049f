"""Masses at the vertices of elements that surfaces cut."""

from __future__ import annotations

import numpy as np

from autdtorch.fdtd.assembly.coverage import subcell_means, volume_coverage
from autdtorch.fdtd.assembly.element import SUBCELLS, Materials
from autdtorch.fdtd.assembly.smooth_faces import Surface, fields
from autdtorch.fdtd.assembly.sound_hard import HATS
from autdtorch.utils.array_types import Array, Index

_MOST_TAKEN = 0.8  # Largest share of a vertex's mass that is taken away


def lumped_mass(vertex: Index, volumes: Array, materials: Materials) -> Array:
    """Return masses at the vertices (n, 8).

    Vertices in a material take its mass, except for the share of a flow through the surface which reaches
    other fluids. With one face across the line between two vertices, both standing waves are then exact.
    """
    total = np.zeros(vertex.shape)
    mean = volumes.mean(axis=1) @ materials.density
    for own, mass in enumerate(materials.mass):
        inside = vertex == own
        beside = ~inside & ~materials.sound_hard[vertex]
        beside[~inside.any(axis=1)] = True
        near, far = inside @ HATS.T, beside @ HATS.T
        passed = np.minimum(1, (materials.density[own] / mean)[:, None] * far)
        passed[~inside.any(axis=1)] = 1
        volume = volumes[:, :, own] / SUBCELLS**3
        here = (volume * np.divide(1 - passed, near, out=np.zeros_like(near), where=near > 0)) @ HATS
        there = (volume * np.divide(passed, far, out=np.zeros_like(far), where=far > 0)) @ HATS
        total += mass * (np.where(inside, here, 0) + np.where(beside, there, 0))
    return total


def balanced_mass(surface: Surface, own: Array, mass: Array) -> Array:
    """Return masses (n, 8) with the same sums, and the exact first moment with the kinked local field.

    `own` (n, 2) are the masses of cells of the outer and the inner material. A wave across the surface then
    feels no moment of the masses, as it feels no force.
    """
    middle, inside = subcell_means(surface.level), volume_coverage(surface.level)
    cut = (inside > 0) & (inside < 1)
    half = np.abs(surface.normal).sum(axis=1)[:, None] / SUBCELLS / 2
    moment, density = np.zeros(len(mass)), surface.density * own / SUBCELLS**3
    for side, part in enumerate((1 - inside, inside)):
        end = middle + half if side == 0 else middle - half
        depth = np.where(cut, end / 2, middle)
        moment += density[:, side] * (part * depth).sum(axis=1)
    kinked, whole = fields(surface)[:, :, 2], mass.sum(axis=1)
    mean = np.divide((mass * kinked).sum(axis=1), whole, out=np.zeros_like(whole), where=whole > 0)
    rise = kinked - mean[:, None]
    square = (mass * rise**2).sum(axis=1)
    scale = np.divide(moment - whole * mean, square, out=np.zeros_like(square), where=square > 0)
    change = rise * scale[:, None]
    least = change.min(axis=1, keepdims=True)
    return np.asarray(mass * (1 + change * np.minimum(1, _MOST_TAKEN / np.maximum(-least, 1e-12))))
