"""The field in the whole domain."""

import numpy as np
import pytest
import torch
from small_scenes import small_scene

import autdtorch as at


def test_a_volume_is_the_field_outside_obstacles_and_away_from_transducers():
    ball = at.Sphere((40e-3, 40e-3, 40e-3), 9e-3, rigid=True)
    scene = small_scene((ball,), extent=80e-3)
    propagator = at.make_propagator(scene, method="free_space")
    drive = at.drive_from_phases(torch.linspace(0, 3, 4))
    volume = at.volume_field(propagator, drive, spacing=5e-3)
    assert volume.shape == (16, 16, 16)

    centre = torch.tensor(scene.domain[0], dtype=torch.float64) + 5e-3 * (torch.tensor([12, 3, 7]) + 0.5)
    wanted = propagator.field(drive, centre[None])[0]
    torch.testing.assert_close(volume[12, 3, 7], wanted)

    centres = np.stack(np.meshgrid(*[2.5e-3 + 5e-3 * np.arange(16)] * 3, indexing="ij"), axis=-1)
    near = torch.cdist(torch.from_numpy(centres).reshape(-1, 3), scene.array.positions).amin(dim=1)
    left_out = (near <= scene.wavelength / 2).reshape(16, 16, 16) | ball.contains(centres)
    assert left_out.any()
    assert torch.equal(volume.isnan(), left_out)


def test_a_volume_refuses_several_drives_and_too_many_cells():
    propagator = at.make_propagator(small_scene(extent=80e-3))
    drive = at.drive_from_phases(torch.zeros(4))
    with pytest.raises(ValueError, match=r"drive: shape .* a single drive"):
        at.volume_field(propagator, drive.expand(2, -1))
    with pytest.raises(ValueError, match=r"spacing: 0\.0001 m; gives \[800, 800, 800\] cells"):
        at.volume_field(propagator, drive, spacing=1e-4)
