"""Nodes on the faces of a Huygens surface radiate like its cells, and receivers next to it get the cells."""

from functools import cache

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

import autdtorch as at
from autdtorch.analytic.green import green
from autdtorch.fdtd.scattered_field import ScatteredField


def box_of(size, spacing, rotation=(0.2, 0.3, 0.1), dtype="float32"):
    """The box of a rigid body; its drive is of no account."""
    array = at.TransducerArray.grid((1, 1), 10e-3, (0, 0, -80e-3))
    body = at.Box((0, 0, 0), size, rotation, rigid=True)
    scene = at.Scene(array, at.Medium.air(), 40e3, [[0, 0, 0.1]], (body,))
    return at.make_propagator(scene, method="box", spacing=spacing, dtype=dtype).simulation.boxes[0]


SIZES = {"plate": ((60e-3, 40e-3, 3e-3), 1e-3), "cube": ((20e-3,) * 3, 0.7e-3)}


@cache
def box_named(name):
    return box_of(*SIZES[name])


@cache
def passed_on(name):
    """Amplitudes (n, 1) of a box's surface for a source inside the body."""
    box = box_named(name)
    inside = torch.zeros((1, 3), dtype=torch.float64)
    return box.surface.of_phasors(green(box.radiating, inside, box.wavenumber))


@given(st.sampled_from(list(SIZES)), st.integers(0, 5), st.floats(0.2, 10.0), st.integers(0, 2**32 - 1))
def test_nodes_radiate_like_the_cells_of_the_surface(name, face, gap, seed):
    """To points 0.2 to 10 wavelengths from a face: cells up to 1.5, then nodes.

    Most of random amplitudes does not radiate, so that their error is 1e-4 of what does.
    """
    box, draw = box_named(name), np.random.default_rng(seed)
    lower, upper = box._nodes.bounds
    apart = gap * 8.6e-3
    places = draw.uniform(lower - apart, upper + apart, (20, 3))
    places[:, face % 3] = (lower - apart, upper + apart)[face // 3][face % 3]
    points, surface = torch.from_numpy(places @ box.axes), box.radiating
    drawn = torch.from_numpy(draw.normal(size=(len(surface), 2)).view(np.complex128))
    for amplitude, tolerance in ((passed_on(name), 2e-5), (drawn, 1e-4)):
        exact = box.waves(points, surface, amplitude)
        assert (box.radiated(amplitude, points) - exact).norm() <= tolerance * exact.norm()


def test_large_faces_take_fewer_nodes_and_double_precision_none():
    plate = box_named("plate")
    assert len(plate._nodes.positions) < len(plate.radiating) / 2
    assert box_of((4e-3,) * 3, 1e-3)._nodes is None  # as many as cells
    assert box_of((60e-3, 40e-3, 3e-3), 1e-3, dtype="float64")._nodes is None


def test_images_radiate_through_nodes_too():
    array = at.TransducerArray.grid((2, 2), 10e-3, (0, 0, 0), normal=(0, 0, 1))
    body = at.Box((0, 0, 60e-3), (60e-3, 40e-3, 3e-3), (0.2, 0.3, 0.1), rigid=True)
    walls = (at.Reflector((-40e-3, 0, 0), (1, 0, 0)),)
    scene = at.Scene(array, at.Medium.air(), 40e3, [[0, 0, 0.1]], (body,), reflectors=walls)
    (box,) = at.make_propagator(scene, method="box").simulation.boxes
    assert isinstance(box, ScatteredField)
    assert len(box.images) == 2
    points = torch.tensor([[0, 0, 0.15], [-0.038, 0, 0.06]], dtype=torch.float64)
    assert box._far(points, box.images).tolist() == [True, False]  # the other is next to body and image
    amplitude = torch.ones((len(box.radiating), 1), dtype=torch.complex128)
    exact = box.waves(points, box.radiating, amplitude, images=box.images)
    torch.testing.assert_close(box.radiated(amplitude, points), exact, rtol=1e-4, atol=0)
