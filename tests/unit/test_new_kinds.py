"""A new shape is one class and one entry of a table, a new array form one function and one entry."""

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import pytest
import torch

import autdtorch as at
from autdtorch.io.scene_file import scene_lines
from autdtorch.scene.arrays import FORMS, flat_array
from autdtorch.scene.geometry import rotation_matrix
from autdtorch.scene.obstacles import KINDS
from autdtorch.scene.obstacles.moving import circumscribed
from autdtorch.scene.obstacles.primitives import revolved

SCENE = """
frequency: 40e3
medium: {density: 1.2, sound_speed: 343.0}
array: {type: ring, count: 6, width: 30e-3, center: [0, 0, 0]}
control_points: {type: points, positions: [[45e-3, 0, 0], [45e-3, 6e-3, 0]]}
obstacles:
  - {type: cone, tip: [14e-3, 0, 0], axis: [1, 0, 0.2], radius: 7e-3, height: 12e-3, rigid: true}
"""


@dataclass(frozen=True)
class Cone(at.Obstacle):
    """A circular cone, from its tip along its axis."""

    position_field: ClassVar[str] = "tip"
    orientation_field: ClassVar[str | None] = "axis"

    tip: tuple[float, float, float]
    axis: tuple[float, float, float]
    radius: float
    height: float

    def __post_init__(self):
        super().__post_init__()
        object.__setattr__(self, "tip", tuple(self.tip))
        object.__setattr__(self, "axis", tuple(entry / math.hypot(*self.axis) for entry in self.axis))

    @property
    def _ends(self):
        disc = [self.radius * math.sqrt(1 - entry**2) for entry in self.axis]
        base = [place + self.height * entry for place, entry in zip(self.tip, self.axis, strict=True)]
        return list(zip(self.tip, base, disc, strict=True))

    @property
    def lower(self):
        return tuple(min(tip, base - disc) for tip, base, disc in self._ends)

    @property
    def upper(self):
        return tuple(max(tip, base + disc) for tip, base, disc in self._ends)

    def surface(self):
        profile = torch.tensor([(0.0, 0.0), (self.radius, self.height), (0.0, self.height)])
        return revolved(profile.double(), self.tip, self.axis)

    def _distance(self, points):
        inner, axis = points - points.new_tensor(self.tip), points.new_tensor(self.axis)
        along = inner @ axis
        across = torch.linalg.vector_norm(inner - along[:, None] * axis, dim=1)
        place, rim = torch.stack((across, along), 1), points.new_tensor((self.radius, self.height))
        side = (place @ rim / (rim @ rim)).clamp(0, 1)[:, None] * rim
        base = torch.stack((across.clamp(max=self.radius), torch.full_like(along, self.height)), 1)
        distance = torch.minimum((place - side).norm(dim=1), (place - base).norm(dim=1))
        inside = (along < self.height) & (across * self.height < along * self.radius)
        return torch.where(inside, -distance, distance)


def ring(count, width, center, normal=(1.0, 0.0, 0.0), angle=0.0, source_strength=1.0, radius=None):
    turns = 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
    places = width / 2 * torch.stack((turns.cos(), turns.sin()), dim=1)
    return flat_array(
        "ring", places, center, normal, angle, source_strength, radius, count=count, width=width
    )


@pytest.fixture
def scene(tmp_path, monkeypatch):
    monkeypatch.setitem(KINDS, "cone", Cone)
    monkeypatch.setitem(FORMS, "ring", ring)
    (tmp_path / "scene.yaml").write_text(SCENE)
    return at.load_scene(tmp_path / "scene.yaml")


def test_they_are_loaded_saved_and_written_as_python(scene, tmp_path):
    assert type(scene.obstacles[0]) is Cone
    assert len(scene.array) == 6
    at.save_scene(tmp_path / "saved.yaml", scene)
    assert at.load_scene(tmp_path / "saved.yaml").equals(scene)
    text = (tmp_path / "saved.yaml").read_text()
    assert "type: cone" in text
    assert "type: ring" in text
    names = {}
    exec(scene_lines(scene, torch.ones(6, dtype=torch.complex128), "scene"), names)
    assert names["scene"].equals(scene)


def test_the_shape_moves_and_turns(scene):
    (cone,) = scene.obstacles
    offset, angles = (1e-3, 2e-3, 0.0), (0.3, -0.2, 0.5)
    (moved,) = scene.moved(offset, angles).obstacles
    points = 20e-3 * torch.rand(50, 3, dtype=torch.float64)
    center, _ = circumscribed((cone,))
    there = center + (points - center) @ rotation_matrix(angles).T + torch.tensor(offset)
    torch.testing.assert_close(moved.signed_distance(there), cone.signed_distance(points), rtol=0, atol=1e-9)
    assert not torch.allclose(moved.signed_distance(points), cone.signed_distance(points), rtol=0, atol=1e-4)


def test_the_shape_scatters_as_its_mesh_does(scene):
    (cone,) = scene.obstacles
    mesh = at.Mesh.from_surface(cone.surface(), rigid=True)
    cones, meshes, nothing = (
        at.make_propagator(replace(scene, obstacles=bodies, domain=None), spacing=1.5e-3).transfer_matrix()
        for bodies in ([cone], [mesh], [])
    )
    assert (cones - nothing).abs().max() > 0.2 * nothing.abs().max()
    # 5.7 cells to a wavelength, where the surfaces of a shape and of its mesh differ by 1 %
    assert (cones - meshes).abs().max() < 0.03 * cones.abs().max()
