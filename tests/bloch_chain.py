"""Reflection of a plane wave by a tilted half-space: the exact solution of the assembled scheme.

On a plane of integer normal n all cells with equal n . x have equal stencil rows. A wave along the surface
multiplies them by known phases, which leaves one unknown for each value of n . x: a chain.
"""

import cmath
import itertools
import math
from dataclasses import dataclass

import numpy as np
import torch

from autdtorch.fdtd.assembly.elements import elements_of
from autdtorch.fdtd.assembly.heterogeneous import heterogeneous_cells
from autdtorch.fdtd.grid import Grid
from autdtorch.fdtd.region import Body, Fluid, Region
from autdtorch.fdtd.stencil import OFFSETS, tuned_stencil

AIR = Fluid(1.2, 343.0)
FREQUENCY = 40e3
DEPTH = 8  # of the chain on either side of the surface [cells]
REACH = 14  # largest coordinate of a cell that stands for a value of n . x [cells]


@dataclass(frozen=True)
class HalfSpace:
    """A shape that fills one side of a plane."""

    normal: np.ndarray  # unit vector, out of the body (3,)
    place: float  # distance of the plane from the origin along the normal [m]
    lower = (-1.0, -1.0, -1.0)
    upper = (1.0, 1.0, 1.0)

    def signed_distance(self, points):
        return points @ torch.from_numpy(self.normal) - self.place

    def surface(self):
        first = np.cross(self.normal, np.eye(3)[np.abs(self.normal).argmin()])
        second = np.cross(self.normal, first)
        corners = self.place * self.normal + np.stack((np.zeros(3), first, second))
        return torch.from_numpy(corners), torch.tensor([[0, 1, 2]])


def reflection(normal, offset, spacing, incidence, azimuth=0.0, fluid=None, impedance=None):
    """The reflection coefficient of a half-space: rigid (1 in theory), of a fluid, or with an impedance.

    The surface is `offset` cells from a cell centre. The wave comes at an angle `incidence` [rad] from the
    normal.
    """
    kappa = 2 * math.pi * FREQUENCY / AIR.sound_speed * spacing
    stencil, grid = tuned_stencil(kappa), Grid(spacing, (2 * REACH,) * 3, (0.0, 0.0, 0.0), kappa, 6, 1)
    length, middle = float(np.linalg.norm(normal)), np.array(grid.shape) // 2
    unit = np.array(normal) / length
    shape = HalfSpace(unit, spacing * float(unit @ middle + offset))
    body = Body(shape, fluid, impedance=impedance)
    region = Region(AIR, 0.0, FREQUENCY, (body,), ((0.0,) * 3, (1.0,) * 3), np.zeros((1, 3)))
    cells = heterogeneous_cells(elements_of(region, grid, stencil), stencil)

    tangent = np.cross(unit, (math.cos(azimuth), math.sin(azimuth), 0.4))
    across, inner = kappa * math.cos(incidence), kappa * _inner_wavenumber(incidence, fluid)
    along = kappa * math.sin(incidence) * tangent / np.linalg.norm(tangent)
    rows = _rows(cells, stencil, grid, middle, np.array(normal))
    reach = int(np.abs(normal).sum())
    top, bottom = max(rows) - reach, min(rows) + reach if fluid else -math.inf
    unknown = {place: number for number, place in enumerate(sorted(p for p in rows if bottom < p < top))}
    size = len(unknown) + (2 if fluid else 1)
    matrix, right = np.zeros((size, size), complex), np.zeros(size, complex)

    def add(equation, place, value):
        distance = place / length - offset
        if place >= top:  # far from the surface: the incident wave and the reflected one
            phase = np.exp(1j * across * distance)
            matrix[equation, -1] += value * phase
            right[equation] -= value / phase
        elif place <= bottom:  # the transmitted one
            matrix[equation, -2] += value * np.exp(-1j * inner * distance)
        else:
            matrix[equation, unknown[place]] += value

    for equation, place in enumerate([*unknown, bottom, top] if fluid else [*unknown, top]):
        row, itself = rows[place]
        add(equation, place, itself)
        for step, weight in zip(np.array(OFFSETS), row, strict=True):
            if weight:
                add(equation, place + int(step @ normal), weight * np.exp(1j * along @ step))
                add(equation, place, -weight)
    return complex(np.linalg.solve(matrix, right)[-1])


def _inner_wavenumber(incidence, fluid):
    """The wavenumber across the surface inside a fluid, relative to air."""
    speed = fluid.sound_speed / AIR.sound_speed if fluid else 1.0
    return cmath.sqrt(1 / speed**2 - math.sin(incidence) ** 2)


def exact_reflection(incidence, fluid):
    """The reflection coefficient of a half-space of a fluid."""
    inner = fluid.density / AIR.density * math.cos(incidence)
    outer = _inner_wavenumber(incidence, fluid)
    return (inner - outer) / (inner + outer)


def _rows(cells, stencil, grid, middle, normal):
    """The stencil rows (27,) and the factors of the cell itself, both complex where it absorbs.

    They are by the value of n . x, of cells near the middle that are not rigid.
    """
    around = np.array(list(itertools.product(range(-REACH, REACH + 1), repeat=3)))
    values = around @ normal
    aside = np.linalg.norm(around - values[:, None] * normal / (normal @ normal), axis=1)
    most = math.ceil(DEPTH * np.linalg.norm(normal))
    index = {int(flat): place for place, flat in enumerate(cells.index)}
    losses = cells.loss_rows / cells.mass[:, None]
    changed = cells.weight - 1j * losses[:, :27], stencil.symbol + 1j * losses[:, 27] - losses[:, 28]
    rows = {}
    for number in np.argsort(aside, kind="stable"):
        place = int(values[number])
        if abs(place) <= most and place not in rows:
            flat = int(np.ravel_multi_index(tuple(middle + around[number]), grid.shape))
            row = stencil.weights, stencil.symbol
            rows[place] = tuple(part[index[flat]] for part in changed) if flat in index else row
            if flat in cells.rigid:
                rows[place] = None
    return {place: row for place, row in rows.items() if row is not None}
