"""How much the boundary layer sends back, measured against a larger domain; prints a Markdown table.

    python scripts/measure_boundary.py        a few seconds on 2 idle cores

A source and receivers stand in a row, all at the same distance from one layer. The same is stepped again with
that layer so far away that its echo does not return in time, and the rest in place: what differs is the echo.
It is set against the wave of the source's mirror image, with the layer's inner face as the mirror.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import torch
from numpy.typing import NDArray

from autdtorch.fdtd.boundary import tuned_profile
from autdtorch.fdtd.kernels.contract import Coefficients, Columns, Receivers, Sources, uniform_state
from autdtorch.fdtd.kernels.cpu import CpuKernel
from autdtorch.fdtd.stability import fewest_steps, whole_steps
from autdtorch.fdtd.stencil import tuned_stencil
from autdtorch.fdtd.stepping import RAMP_PERIODS, drive_dft, drive_signal
from autdtorch.utils.arrays import Array

DEGREES = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0)

SETTLING_PERIODS = 12
"""Stepped on after the echo of the full amplitude has reached the last receiver."""


def measured_reflection(
    cells_per_wavelength: float, layer_cells: int, degrees: Array, distance: int, aside: int
) -> tuple[Array, Array]:
    """Magnitude of a layer's echo relative to the wave of the mirror image.

    Args:
        cells_per_wavelength: of the grid.
        layer_cells: thickness of the layer.
        degrees: angles of incidence (n,) wanted, in [0, 90).
        distance: cells from the layer to the source and the receivers.
        aside: cells from them to the other layers.

    Returns:
        The angles (n,) [degrees] that whole cells allow, and the magnitudes (n,).
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
    """Uniform air with its layers, and how it is stepped and driven."""

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
    """Phasors (n,) at `offsets` along y from a source of far field e^{ikr}/r, lengths in cells."""
    rim, steps = air.coefficients.layer_cells + 1, air.steps_per_period
    x, y, z = rim + distance, rim + aside, rim + aside
    shape = x + rim + aside + 1, 2 * y + int(offsets.max()) + 1, 2 * z + 1
    source = int(np.ravel_multi_index((x, y, z), shape))
    index = torch.from_numpy(source + shape[2] * offsets)[:, None]
    blocks = math.ceil(periods / steps.denominator)
    _, recorded = CpuKernel().advance(
        uniform_state(shape, air.coefficients, 0.0),
        air.coefficients,
        Sources(torch.tensor([source]), torch.tensor([[air.force, 0.0]], dtype=torch.float64)),
        Receivers(index, torch.ones(index.shape, dtype=torch.float64)),
        drive_signal(steps, 0, blocks * steps.numerator),
    )
    return drive_dft(recorded[-steps.numerator :], steps.denominator).numpy()


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cells-per-wavelength", type=float, default=8.5)
    parser.add_argument("--distance", type=int, default=9, help="cells to the layer")
    parser.add_argument("--aside", type=int, default=12, help="cells to the other layers")
    given = parser.parse_args()
    print("| cells | " + " | ".join(f"{angle:g} degrees" for angle in DEGREES) + " |")
    print("| --- |" + " --- |" * len(DEGREES))
    for cells in (6, 8, 10):
        _, magnitude = measured_reflection(
            given.cells_per_wavelength, cells, np.array(DEGREES), given.distance, given.aside
        )
        decibels = " | ".join(f"{value:.0f}" for value in 20 * np.log10(magnitude))
        print(f"| {cells} | {decibels} |", flush=True)


if __name__ == "__main__":
    main()
