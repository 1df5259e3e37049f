"""Radiation forces against series, stress around bodies and a finer grid; poses a second; force on a palm.

Series are those of plane and standing waves (Hasegawa and Yosioka 1969, Hasegawa 1979), and Gor'kov's limit
of small spheres. Takes about two minutes on 2 idle cores.
"""

import math
import time
from collections.abc import Callable, Iterator

import numpy as np
import torch
from shared.document import Page, printed, table
from shared.scenes import relative_error
from shared.timing import timed

import autdtorch as at
from autdtorch.analytic.spherical_waves import sphere_rule
from autdtorch.propagators import Propagator
from autdtorch.utils.process import one_library_thread

DOCUMENT = "force.md"

AIR = at.Medium(density=1.2, sound_speed=343.0)
FREQUENCY = 40e3
WAVENUMBER = 2 * math.pi * FREQUENCY / AIR.sound_speed
MATERIALS = {
    "rigid": {"rigid": True},
    "EPS": {"density": 29.0, "sound_speed": 900.0},
    "water": {"density": 1000.0, "sound_speed": 1480.0},
}
SIZES = 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0, 8.0
FAR, FARTHER = 1e6, 1e10
"""Distances [m] of points that send plane waves: from FAR, the fall of 1 / r counts for small spheres."""
CUBE = at.Box((0.0, 0.0, 60e-3), (10e-3,) * 3, rigid=True)
SPACING, FINE = 1e-3, 0.6e-3  # [m]
POSES, TURNS = 1000, 50
FOCUS, PALM = 150e-3, 60e-3  # [m]
WINDOWS = 6e-3, 18e-3, 60e-3, 300e-3  # [m]


def main(page: Page) -> None:
    plane, standing, *limits = np.max([from_series(material) for material in MATERIALS], axis=0)
    gorkov = ", ".join(
        f"{100 * limit:.2g} % at ka {size:g}" for limit, size in zip(limits, SIZES[:3], strict=True)
    )
    page.write(
        f"Spheres of ka {SIZES[0]:g} to {SIZES[-1]:g} ({', '.join(MATERIALS)}) differ from the series by at "
        f"most {plane:.1e} in a plane wave and {standing:.1e} in a standing one; from Gor'kov by {gorkov}.",
        "Beside other bodies, against an integral of the stress on a sphere around the body:",
        table(["case", "force", "torque"], printed(around_bodies())),
        of_a_cube(),
        rates(),
        on_a_palm(),
    )


def from_series(material: str) -> list[float]:
    """Return the largest relative differences of two waves from the series, and those from Gor'kov's."""
    heights = torch.tensor([-FARTHER, -FAR, FAR])
    places = torch.stack([0 * heights, 0 * heights, heights], dim=1)
    array = at.TransducerArray(places, [0.0, 0.0, 1.0], source_strength=heights.abs(), radius=0)
    drives = torch.tensor([[1, 0, 0], [0, np.exp(0.4j) / 2, np.exp(-0.4j) / 2]])  # one, and cos(kz + 0.4)
    density = 1 / (2 * AIR.density * AIR.sound_speed**2)
    worst, limits = np.zeros(2), []
    for size in SIZES:
        radius = size / WAVENUMBER
        body = at.TMatrix.of(at.Sphere((0, 0, 0), radius, **MATERIALS[material]), AIR, FREQUENCY, error=1e-8)
        force = at.radiation_force(body, drives, array=array, medium=AIR)[:, 2].numpy()
        force /= math.pi * radius**2 * density
        coefficient = body.matrix.diagonal().numpy()[[n * n for n in range(body.degree + 1)]]
        exact = np.array(series(coefficient, size)) * [1, math.sin(0.8)]
        worst = np.maximum(worst, abs(force / exact - 1))
        limits.append(abs(force[1] / (2 * size * contrast(material) * math.sin(0.8)) - 1))
    return [*worst, *limits[:3]]


def series(coefficient: np.ndarray, size: float) -> tuple[float, float]:
    """Return the radiation force functions of plane and standing waves."""
    real, imag, n = coefficient.real, coefficient.imag, np.arange(len(coefficient) - 1)
    products = real[:-1] * real[1:] + imag[:-1] * imag[1:]
    plane = -4 / size**2 * ((n + 1) * (real[:-1] + real[1:] + 2 * products)).sum()
    pairs = imag[:-1] * (1 + 2 * real[1:]) - imag[1:] * (1 + 2 * real[:-1])
    return plane, 2 / size**2 * ((n + 1) * (-1) ** (n + 1) * pairs).sum()


def contrast(material: str) -> float:
    """Return Gor'kov's f_1 / 3 + f_2 / 2."""
    density, speed = (MATERIALS[material].get(name, math.inf) for name in ("density", "sound_speed"))
    ratio = density / AIR.density
    second = 1.0 if math.isinf(ratio) else 2 * (ratio - 1) / (2 * ratio + 1)
    return (1 - 1 / (ratio * (speed / AIR.sound_speed) ** 2)) / 3 + second / 2


def sphere_array() -> at.TransducerArray:
    return at.TransducerArray.grid((4, 4), 10e-3, (0, 0, 0), (0, 0, 1.0), radius=4.5e-3)


def focused(array: at.TransducerArray, focus: tuple[float, float, float]) -> torch.Tensor:
    return at.drive_from_phases(at.focus_phases(array.positions, focus, WAVENUMBER))


def around_bodies() -> Iterator[list[str]]:
    array, center = sphere_array(), (4e-3, -3e-3, 60e-3)
    body = at.Sphere(center, 5e-3, density=5.0, sound_speed=600.0, absorption=300.0)
    other = at.Sphere((-12e-3, 6e-3, 63e-3), 6e-3, rigid=True)
    wall = at.Reflector((0, 0, 72e-3), (0, 0, -1.0))
    cases = {
        "absorbing sphere off axis, focus": ((body,), ()),
        "beside a rigid sphere": ((body, other), ()),
        "also before a plane": ((body, other), (wall,)),
    }
    for name, (bodies, walls) in cases.items():
        scene = at.Scene(array, AIR, FREQUENCY, [(0, 0, 50e-3)], bodies, reflectors=walls)
        propagator, drive = (
            at.make_propagator(scene, "tmatrix", tolerance=1e-6),
            focused(array, (0, 0, 60e-3)),
        )
        force, torque = stress_around(propagator, drive, center, 8.3e-3)
        errors = (
            relative_error(at.radiation_force(propagator, drive), force),
            relative_error(at.radiation_torque(propagator, drive), torque),
        )
        yield [name, *(f"{error:.1e}" for error in errors)]


def stress_around(
    propagator: Propagator, drive: torch.Tensor, center: tuple[float, ...], radius: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return force and torque about the centre by the stress on a sphere."""
    normals, angles = sphere_rule(18)
    points = torch.tensor(center, dtype=torch.float64) + radius * normals
    force = radius**2 * angles[:, None] * at.radiation_stress(propagator, drive, points, normals)
    return force.sum(dim=0), radius * torch.linalg.cross(normals, force).sum(dim=0)


def of_a_cube() -> str:
    """Compare forces by two grids in many turns; return this in words."""
    array, setting = sphere_array(), {"medium": AIR}
    coarse, fine = (
        at.TMatrix.of(CUBE, AIR, FREQUENCY, spacing, error=1e-3, cache=False) for spacing in (SPACING, FINE)
    )
    generator = torch.Generator().manual_seed(0)
    offsets = 5e-3 * torch.rand(TURNS, 3, generator=generator, dtype=torch.float64)
    angles = 6 * torch.rand(TURNS, 3, generator=generator, dtype=torch.float64)
    drive = focused(array, (0, 0, 60e-3))
    forces, exact = (
        at.radiation_force(body.moved(offsets, angles), drive, array=array, **setting)
        for body in (coarse, fine)
    )
    errors = (forces - exact).norm(dim=1) / exact.norm(dim=1)
    return (
        f"A rigid cube of 10 mm near a focus in {TURNS} poses, T at {1e3 * SPACING:g} mm against"
        f" {1e3 * FINE:g} mm: {100 * float(errors.median()):.2g} % in the median,"
        f" {100 * float(errors.max()):.2g} % at most."
    )


@one_library_thread()
def rates() -> str:
    """Return the poses of two cubes a second in words."""
    array = at.TransducerArray.grid((4, 4), 10e-3, (0, 0, 0), (0, 0, 1.0), radius=0)
    cube = at.TMatrix.of(CUBE, AIR, FREQUENCY, SPACING, error=1e-3, cache=False)
    pair, drive = at.TMatrixCluster([cube, cube.moved((22e-3, 0, 3e-3))]), focused(array, (0, 0, 60e-3))

    def pushed(count: int, move: Callable[[torch.Tensor, torch.Tensor], at.TMatrixCluster]) -> None:
        offsets = (1e-3 * torch.rand(count, 3, dtype=torch.float64)).requires_grad_(True)
        angles = torch.rand(count, 3, dtype=torch.float64).requires_grad_(True)
        force = at.radiation_force(move(offsets, angles), drive, array=array, medium=AIR)
        force.square().sum().backward()

    def rate(count: int, move: Callable[[torch.Tensor, torch.Tensor], at.TMatrixCluster]) -> float:
        pushed(count, move)
        return count / timed(lambda: pushed(count, move), time.process_time)[1]

    as_one = rate(POSES, pair.moved)
    alone = rate(POSES // 4, lambda *pose: at.TMatrixCluster([cube.moved(*pose), pair.bodies[1]]))
    return (
        f"Forces with gradients by the pose, two cubes of 10 mm ({len(cube.matrix)} waves each) and\n"
        f"16 transducers: {as_one:,.0f} poses a second of a core where both move as one,\n"
        f"{alone:.0f} where one of them moves."
    )


def on_a_palm() -> str:
    """Return a table of forces at the focus of an AUTD3: by pressure, by momentum, and on a plate."""
    array = at.TransducerArray.autd3((0, 0, 0), (0, 0, 1.0))
    drive = focused(array, (0, 0, FOCUS))
    free = at.make_propagator(at.Scene(array, AIR, FREQUENCY, [(0, 0, FOCUS)]), "free_space")
    spacing = 3e-3
    points = at.Plane((0, 0, FOCUS), (0, 0, 1), (WINDOWS[-1],) * 2).points(spacing)
    pressure = free.field(drive, points).abs().square() / (AIR.density * AIR.sound_speed**2)
    momentum = 2 * at.radiation_stress(free, drive, points, (0, 0, -1.0))[..., 2]
    aside = points[..., :2].abs().amax(dim=-1)
    rows = []
    for window in WINDOWS:
        inside = aside <= window / 2
        sums = [1e3 * spacing**2 * float(each[inside].sum()) for each in (pressure, momentum)]
        rows.append([f"{1e3 * window:g} mm", *(f"{value:.1f}" for value in sums)])
    thickness = 4e-3
    plate = at.Box((0, 0, FOCUS + thickness / 2), (PALM, PALM, thickness), rigid=True)
    scene = at.Scene(array, AIR, FREQUENCY, [(0, 0, FOCUS - 5e-3)], [plate])
    box = at.make_propagator(scene, "box", 2e-3, cache=False)
    forces = [1e3 * float(stress_on_box(box, drive, plate, aside)) for aside in (12e-3, 15e-3)]
    return (
        f"An AUTD3 (249 discs) focuses at {1e3 * FOCUS:g} mm. Force [mN] on squares of the plane through\n"
        "the focus:\n\n"
        + table(["square", "p^2 / (rho c^2)", "twice the momentum"], rows)
        + f"\n\nA rigid plate of {1e3 * PALM:g} mm there takes up {forces[0]:.1f} mN ({forces[1]:.1f} mN by a"
        " wider surface around it)."
    )


def stress_on_box(propagator: Propagator, drive: torch.Tensor, box: at.Box, aside: float) -> torch.Tensor:
    """Return the force along z on what is within a box, by the stress on a box that is larger by a margin."""
    half = np.array(box.size) / 2 + aside
    total = torch.zeros((), dtype=torch.float64)
    for axis in range(3):
        others = [other for other in range(3) if other != axis]
        rules = [np.polynomial.legendre.leggauss(max(6, math.ceil(half[other] / 2.5e-3))) for other in others]
        grids = np.meshgrid(*(rule[0] * half[other] for rule, other in zip(rules, others, strict=True)))
        areas = np.outer(rules[1][1], rules[0][1]) * half[others[0]] * half[others[1]]
        for sign in (-1, 1):
            points = np.zeros((*grids[0].shape, 3))
            points[..., others[0]], points[..., others[1]] = grids
            points[..., axis] = sign * half[axis]
            normal = [float(sign * (other == axis)) for other in range(3)]
            stress = at.radiation_stress(propagator, drive, points + np.array(box.center), normal)
            total = total + (torch.from_numpy(areas) * stress[..., 2]).sum()
    return total
