"""A simulated bench that differs from its simulation: gains and phases, and a noisy microphone."""

import math

import torch

import autdtorch as at

GAIN, PHASE, NOISE = 0.1, 0.5, 0.03  # of the bench; noise relative to the rms pressure


def array(shape=(4, 4)):
    return at.TransducerArray.grid(shape, 10e-3, (0.0, 0.0, 0.0), source_strength=2.0, radius=4.5e-3)


def scene(points=3, shape=(4, 4), **fields):
    places = [[80e-3, 12e-3 * (number - 1), 3e-3 * number] for number in range(points)]
    return at.Scene(array(shape), at.Medium(1.2, 340.0), 40e3, control_points=places, **fields)


class Bench:
    """Transducers with gains and phases that differ, and a noisy microphone."""

    def __init__(self, matrix, seed, gain=GAIN, phase=PHASE, noise=NOISE, unit=1.0):
        self.draws = torch.Generator().manual_seed(seed)
        log_gain, angle = torch.randn(2, matrix.shape[1], dtype=torch.float64, generator=self.draws)
        self.log_gain, self.phase = gain * log_gain, phase * angle
        self.matrix = unit * matrix * torch.polar(self.log_gain.exp(), self.phase)
        self.noise = noise * float(self.matrix.abs().square().sum(dim=1).mean().sqrt())

    def drives(self, count):
        phases = (
            2 * math.pi * torch.rand(count, self.matrix.shape[1], dtype=torch.float64, generator=self.draws)
        )
        return torch.polar(torch.ones_like(phases), phases)

    def pressure(self, drives):
        pressure = drives @ self.matrix.T
        return pressure + self.noise * torch.randn(
            pressure.shape, dtype=torch.complex128, generator=self.draws
        )

    def readings(self, count, phase=False, **fields):
        drives = self.drives(count)
        pressure = self.pressure(drives)
        return at.Readings(drives, pressure.abs(), phase=pressure.angle() if phase else None, **fields)


def error(calibration, matrix):
    """Relative error of the calibrated matrix (P, M), up to a phase of each row."""
    turn = (calibration.transfer_matrix.conj() * matrix).sum(dim=1, keepdim=True).sgn()
    return float((calibration.transfer_matrix * turn - matrix).norm() / matrix.norm())
