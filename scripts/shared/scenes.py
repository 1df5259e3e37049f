"""The paper's scenes, also with larger arrays, as scripts simulate them."""

import dataclasses
from pathlib import Path
from typing import Any

import torch

import autdtorch as at
from autdtorch.propagators import SimulatedPropagator
from autdtorch.propagators.store import BODIES

ROOT = Path(__file__).parents[2]
SCENES = ROOT / "configs" / "scene"

PAPER = ("homogeneous", "three_cubes", "two_cubes")

MIDDLE = (1e-3, 50e-3, 50e-3)
"""Centre of the paper's array [m]."""


def paper_scene(name: str) -> at.Scene:
    return at.load_scene(SCENES / f"{name}.yaml")


def objective_of(scene: at.Scene) -> at.SimulatedObjective:
    """Return the undisturbed objective of a scene, simulated at the default spacing."""
    return at.SimulatedObjective(scene, at.make_propagator(scene))


def paper_objectives() -> dict[str, at.SimulatedObjective]:
    """Return undisturbed objectives by scene, simulated at the default spacing."""
    return {name: objective_of(paper_scene(name)) for name in PAPER}


def autd3_array() -> at.TransducerArray:
    """Return an AUTD3 of 249 point sources in the place of the paper's array."""
    return at.TransducerArray.autd3(MIDDLE, source_strength=at.PAPER_SOURCE_STRENGTH, radius=None)


def with_array(scene: at.Scene, array: at.TransducerArray) -> at.Scene:
    """Replace the array, in a domain that holds the old and the new one."""
    corners = torch.cat((array.positions, torch.tensor(scene.domain, dtype=torch.float64)))
    domain = torch.stack((corners.amin(0) - 3e-3, corners.amax(0) + 3e-3))
    return dataclasses.replace(scene, array=array, domain=domain, observation_plane=None)


def cube_shadow(points: int) -> torch.Tensor:
    """Return the transfer matrix of an AUTD3 to random points (P, 249) behind the paper's two cubes."""
    generator = torch.Generator().manual_seed(0)
    lower, upper = torch.tensor([[0.07, 0.03, 0.03], [0.09, 0.07, 0.07]], dtype=torch.float64)
    places = lower + (upper - lower) * torch.rand(points, 3, dtype=torch.float64, generator=generator)
    scene = with_array(paper_scene("two_cubes"), autd3_array())
    matrix = at.make_propagator(scene, "box", 1e-3).transfer_matrix(places)
    return matrix.to(torch.complex128)


def uncached(
    scene: at.Scene, method: str, spacing: float | None, tolerance: float = 1e-3, **settings: Any
) -> SimulatedPropagator:
    """Return a propagator at `spacing` [mm] that reads nothing from disk and reuses no assembly."""
    BODIES.forget()
    spacing = None if spacing is None else 1e-3 * spacing
    propagator = at.make_propagator(scene, method, spacing, tolerance=tolerance, cache=False, **settings)
    assert isinstance(propagator, SimulatedPropagator)
    return propagator


def weakest(matrix: torch.Tensor, drive: torch.Tensor) -> torch.Tensor:
    """Return the weakest focus (N,) [Pa] of drives (N, M) or (M,), for matrices (N, P, M)."""
    return (matrix @ drive[..., None])[..., 0].abs().amin(dim=-1)


def relative_error(value: torch.Tensor, exact: torch.Tensor) -> float:
    """Return the complex relative L2 error."""
    return float((value - exact).norm() / exact.norm())
