"""Grids of points that reach behind a reflector: pictures, which are silent there."""

from dataclasses import replace

import pytest
import torch

import autdtorch as at
from autdtorch.plot.explore.display import refusal
from autdtorch.plot.explore.situation import Situation
from autdtorch.propagators.propagator import are_shown
from autdtorch.study.report.tables import room_rows

ARRAY = at.TransducerArray.grid((2, 2), 10e-3, (0, 0, 0), (0, 0, 1), radius=4e-3)
DRIVE = at.drive_from_phases(torch.tensor([[0.0, 1.0, 2.0, 3.0], [0.5, 0.5, 0.0, 0.0]]))
GRID = at.Plane((0, 0, 2e-3), (1, 0, 0), (20e-3, 24e-3)).points(4e-3)
BEHIND = GRID[..., 2] < 0


def scene(*obstacles, **changes):
    panel = at.Reflector.behind(ARRAY)
    parts = {"control_points": [(0, 0, 20e-3)], "obstacles": obstacles, "reflectors": [panel]} | changes
    return at.Scene(ARRAY, at.Medium.air(), 40e3, **parts)


@pytest.mark.parametrize("method", ["free_space", "full", "tmatrix"])
def test_a_picture_is_silent_behind_a_panel_and_equal_in_front(method):
    bodies = () if method != "tmatrix" else (at.Sphere((0, 0, 12e-3), 3e-3, rigid=True),)
    propagator = at.make_propagator(scene(*bodies), method=method, spacing=2e-3)
    drive = DRIVE.clone().requires_grad_()
    field = propagator.field(drive, GRID)
    assert field.shape == (2, *GRID.shape[:2])
    assert (field[:, BEHIND] == 0).all()
    front = propagator.field(DRIVE, GRID[~BEHIND][None])[:, 0]
    torch.testing.assert_close(field[:, ~BEHIND].detach(), front, rtol=1e-9, atol=1e-9)
    assert torch.autograd.grad(field.abs().sum(), drive)[0].abs().min() > 0
    assert (propagator.field(DRIVE, GRID - torch.tensor([0, 0, 11e-3]))[:, :, 0] == 0).all()
    with pytest.raises(ValueError, match=r"points\[.*mm behind reflector 0, must be in front of it"):
        propagator.field(DRIVE, GRID.reshape(-1, 3))


def test_a_volume_is_unknown_behind_and_the_plane_itself_is_in_front():
    place = scene()
    volume = at.volume_field(at.make_propagator(place), DRIVE[0], 3e-3)
    lower, upper = place.domain[0][2], place.domain[1][2]
    heights = lower + (upper - lower) * (torch.arange(volume.shape[2]) + 0.5) / volume.shape[2]
    assert volume[:, :, heights < 0].isnan().all()
    assert not volume[:, :, heights > 6e-3].isnan().any()
    on_plane = torch.tensor([[0.5, 0.0, 0.0], [0.5, 0.0, -1e-6]], dtype=torch.float64)
    assert are_shown(place, on_plane).tolist() == [True, False]


def test_obstacles_move_in_front_of_reflectors_that_stay():
    place = scene(at.Sphere((0, 0, 12e-3), 3e-3, rigid=True))
    moved = place.moved((0, 0, 3e-3))
    assert moved.reflectors == place.reflectors
    assert not replace(place, reflectors=()).equals(place)
    situation = Situation.of(place, DRIVE[0])
    cut = situation.with_body(0, (20e-3, 0, 1e-3), (0, 0, 0))
    assert cut.scene.obstacles[0].lower[2] < 0
    with pytest.raises(ValueError, match="wholly behind") as caught:
        situation.with_body(0, (20e-3, 0, -4e-3), (0, 0, 0))
    told = refusal(caught.value)
    assert told.startswith(
        "obstacle 0: (17.0, -3.0, -7.0) mm to (23.0, 3.0, -1.0) mm; is wholly behind reflector 0"
    )


def test_a_report_lists_what_reflects_and_absorbs():
    felt = at.Sphere((0, 0, 12e-3), 3e-3, density=20.0, sound_speed=300.0, absorption=100.0)
    soft = [at.Reflector.behind(ARRAY, -1), at.Reflector((0, -0.1, 0), (0, 1, 0), 0.5 + 0.25j)]
    rows = room_rows({"felt": scene(felt, reflectors=soft), "bare": scene(reflectors=())})
    assert rows[1] == [
        "felt",
        "1 x Sphere (20 kg/m³, 300 m/s, 100 dB/m)",
        "1 x soft, 1 x reflection 0.5+0.25j",
    ]
    assert rows[2] == ["bare", "none", "none"]
    assert room_rows({"bare": scene(reflectors=())}) == []
    assert "1 x soft" in scene(reflectors=soft)._repr_html_()
