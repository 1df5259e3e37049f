"""Memory and time of gradients, beside a simulation without.

The paper's two cubes at 1 mm, 100^3 cells and their absorbing layers, in 1008 steps; gradients by the drive,
also by the materials of the cubes, and also by density and sound speed of every cell. Each case has a new
process, which compiles the kernel first. Takes 5 minutes on 2 idle cores.
"""

import warnings
from typing import NamedTuple

import torch
from shared.document import printed
from shared.scenes import paper_scene
from shared.timing import in_new_process, peak_memory, timed

import autdtorch as at

STEPS_PER_PERIOD, PERIODS = 14, 72
CASES = {"drive": "drive", "cubes": "drive, cubes' materials", "maps": "drive, maps of 100^3 cells"}
OPTIONS = {"--cases": {"nargs": "+", "choices": CASES, "default": list(CASES), "help": "measured cases"}}


def main(cases: list[str]) -> None:
    """Measure and print: run without, times that with, largest resident set."""
    printed(map(row, cases))


def row(case: str) -> list[str]:
    cost = in_new_process(measure, case)
    return [
        CASES[case],
        f"{cost.forward:.1f} s",
        f"{cost.gradient / cost.forward:.2f}",
        f"{cost.most / 2**30:.2f} GiB",
    ]


class Cost(NamedTuple):
    """Seconds without and with gradients; largest resident set [byte]."""

    forward: float
    gradient: float
    most: int


def medium(case: str, spacing: float) -> tuple[at.Scene, dict[str, torch.Tensor]]:
    """Return the scene of a case, and the material parameters that get gradients."""
    scene = paper_scene("two_cubes")
    cubes = scene.obstacles
    if case == "drive":
        return scene, {}
    if case == "cubes":
        values = torch.tensor([(cube.density, cube.sound_speed) for cube in cubes], dtype=torch.float64).T
        return scene, {"density": values[0].clone(), "sound_speed": values[1].clone()}
    air = at.Scene(scene.array, scene.medium, scene.frequency, scene.control_points, domain=scene.domain)
    centers = at.cell_centers(air, spacing)
    inside = torch.stack([cube.contains(centers) for cube in cubes]).any(dim=0)
    density = torch.where(inside, 100.0, 1.293).double()
    return air, {"density": density, "sound_speed": torch.full_like(density, 340.0)}


def gradient(case: str, spacing: float, periods: int) -> Cost:
    scene, materials = medium(case, spacing)
    drive = torch.ones(len(scene.array), dtype=torch.complex128)
    settings = {"spacing": spacing, "periods": periods, "time_step": 1 / (scene.frequency * STEPS_PER_PERIOD)}

    warnings.simplefilter("ignore", at.SteadyStateWarning)  # costs are those of any field

    def field() -> torch.Tensor:
        return at.differentiable_field(scene, drive, **materials, **settings)

    _, forward = timed(field)
    for parameter in (drive, *materials.values()):
        parameter.requires_grad_()
    _, both = timed(lambda: field().abs().min().backward())
    return Cost(forward, both, peak_memory())


def measure(case: str) -> Cost:
    gradient("cubes", 2e-3, 9)
    return gradient(case, 1e-3, PERIODS)
