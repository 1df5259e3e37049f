"""Reflection of the absorbing layer, measured against a larger domain.

Prints a Markdown table. A source and receivers lie in a row, all at one distance from a layer. A second run
has that layer so far away that its echo does not return in time; the difference of the two is the echo. It is
compared with the wave of the source's mirror image, with the inner face of the layer as the mirror. Takes a
few seconds on 2 idle cores.
"""

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import torch
from numpy.typing import NDArray
from shared.document import table

from autdtorch.fdtd.kernels.contract import Coefficients, Columns, Receivers, Sources, uniform_state
from autdtorch.fdtd.kernels.cpu import CpuKernel
from autdtorch.fdtd.perfectly_matched_layer import tuned_profile
from autdtorch.fdtd.stability import fewest_steps, whole_steps
from autdtorch.fdtd.stencil import tuned_stencil
from autdtorch.fdtd.stepping import RAMP_PERIODS, drive_dft, drive_signal
from autdtorch.utils.array_types import Array

DEGREES = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0)

SETTLING_PERIODS = 12
"""Periods stepped after the echo has reached the last receiver with its full amplitude."""


OPTIONS = {
    "--cells-per-wavelength": {"type": float, "default": 8.5, "help": "of the grid"},
    "--distance": {"type": int, "default": 9, "help": "cells to the layer"},
    "--aside": {"type": int, "default": 12, "help": "cells to the other layers"},
}


def main(cells_per_wavelength: float, distance: int, aside: int) -> None:
    rows = []
    for cells in (6, 8, 10):
        _, magnitude = measured_reflection(cells_per_wavelength, cells, np.array(DEGREES), distance, aside)
        rows.append([str(cells), *(f"{value:.0f}" for value in 20 * np.log10(magnitude))])
    print(table(["cells", *(f"{angle:g} degrees" for angle in DEGREES)], rows))


def measured_reflection(
    cells_per_wavelength: float, layer_cells: int, degrees: Array, distance: int, aside: int
) -> tuple[Array, Array]:
    """Return the angles (n,) [degrees] at whole cells, and a layer's echo (n,) relative to a mirror's.

    The source and the receivers, at angles of incidence of about `degrees` (n,), are `distance` cells from
    the layer, and `aside` cells from the other layers.
    """
    offsets = np.rint(2 * distance * np.tan(np.radians(degrees))).astype(np.int64)
    path = np.hypot(2 * distance, offsets)
    periods = RAMP_PERIODS + path.max() / cells_per_wavelength + SETTLING_PERIODS
    away = math.ceil(periods * cells_per_wavelength / 2)
    near, far = (
        _pressure(_air(cells_per_wavelength, layer_cells), offsets, cells, aside, periods)
        for cells in (distance, away)
    )
    return np.degrees(np.arctan2(offsets, 2 * distance)), np.abs(near - far) * path


@dataclass(frozen=True)
class Air:
    """Coefficients of uniform air with its layers, the time step and the strength of the source."""

    coefficients: Coefficients
    steps_per_period: Fraction
    force: float


def _air(cells_per_wavelength: float, layer_cells: int) -> Air:
    stencil = tuned_stencil(2 * math.pi / cells_per_wavelength)
    steps_per_period = whole_steps(fewest_steps(stencil, stencil.largest_symbol))
    steps = float(steps_per_period)
    factor, profile = stencil.time_factor(steps), tuned_profile(stencil.kappa, steps, layer_cells)
    coefficients = Coefficients(
        center=2 - factor * stencil.total,
        face=factor * stencil.face,
        edge=factor * stencil.edge,
        corner=factor * stencil.corner,
        keep=1.0,
        heterogeneous_index=torch.zeros(0, dtype=torch.int64),
        heterogeneous_weight=torch.zeros((0, 27), dtype=torch.float64),
        sound_hard_index=torch.zeros(0, dtype=torch.int64),
        layer_decay=torch.from_numpy(profile.decay),
        layer_gain=torch.from_numpy(profile.gain),
        layer_index=torch.zeros(0, dtype=torch.int64),
        layer_scale=torch.zeros(0, dtype=torch.float64),
        columns=Columns.none(layer_cells, torch.float64),
        crossed=Columns.none(layer_cells, torch.float64, width=3),
        crossing=torch.zeros((0, layer_cells + 2), dtype=torch.int64),
    )
    return Air(coefficients, steps_per_period, stencil.source_factor(steps).real)


def _pressure(
    air: Air, offsets: NDArray[np.int64], distance: int, aside: int, periods: float
) -> NDArray[np.complex128]:
    """Return phasors (n,) at `offsets` along y from a source with far field e^{ikr}/r, lengths in cells."""
    rim, steps = air.coefficients.layer_cells + 1, air.steps_per_period
    x, y, z = rim + distance, rim + aside, rim + aside
    shape = x + rim + aside + 1, 2 * y + int(offsets.max()) + 1, 2 * z + 1
    source = int(np.ravel_multi_index((x, y, z), shape))
    index = torch.from_numpy(source + shape[2] * offsets)[:, None]
    blocks = math.ceil(periods / steps.denominator)
    _, recorded = CpuKernel().advance(
        uniform_state(shape, air.coefficients, 0.0),
        air.coefficients,
        Sources(torch.tensor([source]), torch.tensor([[[air.force, 0.0]]], dtype=torch.float64)),
        Receivers(index, torch.ones(index.shape, dtype=torch.float64)),
        drive_signal(steps, 0, blocks * steps.numerator),
    )
    return drive_dft(recorded[0, -steps.numerator :], steps.denominator).numpy()
