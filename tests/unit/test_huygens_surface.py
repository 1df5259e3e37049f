"""A Huygens surface radiates the field of sources within it."""

import numpy as np
import pytest
import torch

import autdtorch as at
from autdtorch.analytic.green import green
from autdtorch.fdtd.huygens_surface import face_symbol, face_weights
from autdtorch.fdtd.stencil import tuned_stencil

# Plane waves are radiated within this by a face: six weights, and terms of the order kappa^8
FACE_ERROR = {0.5: 1e-7, 0.7: 5e-7, 1.0: 5e-6, 1.5: 2e-4}


@pytest.mark.parametrize("kappa", FACE_ERROR)
def test_faces_radiate_plane_waves_of_all_directions(kappa):
    stencil = tuned_stencil(kappa)
    draw = np.random.default_rng(0)
    across, turn = np.sqrt(draw.uniform(0, 1, 500)), draw.uniform(0, 2 * np.pi, 500)
    along = np.sqrt(1 - across**2)
    x, y, z = kappa * along * np.cos(turn), kappa * along * np.sin(turn), kappa * across
    symbols = [face_symbol(place, x, y) for place in [(0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (3, 0)]]
    symbol = face_weights(stencil) @ symbols
    radiated = symbol * np.sinc(z / np.pi) * 2 * kappa / stencil.slope.real
    assert np.abs(radiated - 1).max() < FACE_ERROR[kappa]


@pytest.mark.parametrize(("spacing", "tolerance"), [(1e-3, 1e-4), (1.5e-3, 4e-4)])
def test_radiates_the_field_of_sources_within(spacing, tolerance):
    """The rest is due to edges; with the stencil's weights on faces too it is four times as large."""
    array = at.TransducerArray.grid((1, 1), 10e-3, (0, 0, -80e-3))
    body = at.Box((0, 0, 0), (80e-3, 80e-3, 3e-3), (0.2, 0.3, 0.1), rigid=True)
    scene = at.Scene(array, at.Medium.air(), 40e3, [[0, 0, 0.1]], (body,))
    (box,) = at.make_propagator(scene, method="box", spacing=spacing, dtype="float64").simulation.boxes
    draw = np.random.default_rng(1)
    half = spacing * (np.array(box.assembly.grid.interior) / 2 - 6)  # of the plate, about
    sources = torch.from_numpy(draw.uniform(-1, 1, (20, 3)) * half @ box.axes)
    points = torch.from_numpy(draw.uniform(-1, 1, (50, 3)) * (0.1, 0.1, 0.02) + (0, 0, 0.1))
    strength = torch.from_numpy(draw.normal(size=(20, 2)).view(np.complex128))
    amplitude = box.surface.of_phasors(green(box.radiating, sources, box.wavenumber) @ strength)
    exact = green(points, sources, box.wavenumber) @ strength
    missed = 4 * np.pi * green(points, box.radiating, box.wavenumber) @ amplitude - exact
    assert missed.norm() < tolerance * exact.norm()
