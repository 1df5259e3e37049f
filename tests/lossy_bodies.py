"""Lossy bodies that several tests share: their scattered field in a box, and the series of a sphere."""

import math

import numpy as np
import torch
from scipy.special import eval_legendre, spherical_jn, spherical_yn

from autdtorch.fdtd.grid import make_box
from autdtorch.fdtd.kernels.cpu import CpuKernel
from autdtorch.fdtd.region import Fluid, Region
from autdtorch.fdtd.scattered_field import ScatteredField
from autdtorch.fdtd.steady_state import run_to_steady_state
from autdtorch.fdtd.stepping import assemble_on
from autdtorch.utils.apertures import Apertures

AIR = Fluid(1.2, 340.0)
FREQUENCY = 40e3
WAVENUMBER = 2 * math.pi * FREQUENCY / 340.0
SOURCE = np.array([-0.05, 0.01, 0.006])
"""A point source of 1 Pa m [m]."""


def region_of_bodies(*bodies):
    """Bodies in air without absorption."""
    return Region(AIR, 0.0, FREQUENCY, bodies, ((-0.06,) * 3, (0.06,) * 3), SOURCE[None])


class BoxRun:
    """The steady state of bodies in a box, driven by the source."""

    def __init__(self, region, spacing, extra=lambda assembly: np.zeros(0, np.int64)):
        """Run until the field at a sphere around them has settled; `extra` are more cells to read."""
        self.region = region
        self.assembly = assembly = assemble_on(make_box(region, spacing), region, torch.float32, None)
        self.box = box = ScatteredField(assembly, complex(WAVENUMBER), np.eye(3))
        self.source = Apertures(torch.from_numpy(SOURCE[None]))
        force = box.driving([(self.source, torch.ones(1, dtype=torch.complex128))])
        self.transform = box.near_to_far(Apertures(torch.from_numpy(sphere(0.03))))
        self.cells = np.unique(np.concatenate((self.transform.cells, extra(assembly))))
        place = torch.from_numpy(np.searchsorted(self.cells, self.transform.cells))
        (state,) = run_to_steady_state(
            assembly, CpuKernel(), lambda runs: box.sources(force), self.cells, [1e-5], 200,
            lambda phasors, runs: [self.transform.field(phasors[place])], lambda periods: None,
            torch.zeros((1, 1), dtype=torch.float64),
        )  # fmt: skip
        self.phasors = state.pressure
        self.amplitudes = self.transform.amplitudes(self.phasors[place, None])

    def scattered(self, points):
        """Return the scattered field (P,) at points (P, 3) outside the box."""
        return self.box.radiated(self.amplitudes, torch.from_numpy(points))[:, 0].numpy()


def sphere(radius, count=60):
    """Return places (n, 3) that share a sphere evenly."""
    turn = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1 - 2 * turn / count), np.pi * (1 + 5**0.5) * turn
    along = np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)
    return radius * np.stack(along, axis=1)


def incident(points):
    """Return the field (P,) of the source at points (P, 3)."""
    distance = np.linalg.norm(points - SOURCE, axis=1)
    return np.exp(1j * WAVENUMBER * distance) / distance


def sphere_series(radius, center, points, fluid=None, impedance=None):
    """Return the field (P,) that a sphere of a lossy fluid, or with an impedance, scatters: its series."""
    source, points = SOURCE - center, points - center
    r, far = np.linalg.norm(points, axis=1), np.linalg.norm(source)
    cosine, x, total = points @ source / r / far, WAVENUMBER * radius, np.zeros(len(r), complex)
    for n in range(int(2 * x) + 25):
        j, slope = spherical_jn(n, x), spherical_jn(n, x, True)
        h, h_slope = _hankel(n, x), _hankel(n, x, True)
        if fluid is None:
            reaction = 1j / impedance
            ratio = -(slope + reaction * j) / (h_slope + reaction * h)
        else:
            density, slowness = fluid.density / AIR.density, AIR.sound_speed / fluid.sound_speed
            inner, inner_slope = spherical_jn(n, x * slowness), spherical_jn(n, x * slowness, True)
            numerator = density * slope * inner - slowness * inner_slope * j
            ratio = numerator / (slowness * inner_slope * h - density * h_slope * inner)
        wave = _hankel(n, WAVENUMBER * far) * _hankel(n, WAVENUMBER * r)
        total += 1j * WAVENUMBER * (2 * n + 1) * ratio * wave * eval_legendre(n, cosine)
    return total


def _hankel(n, x, derivative=False):
    return spherical_jn(n, x, derivative) + 1j * spherical_yn(n, x, derivative)
