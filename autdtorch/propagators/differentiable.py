"""The field of a scene, differentiable with respect to the drive and the medium."""

from __future__ import annotations

import math

import torch

from autdtorch.fdtd.adjoint import recorded
from autdtorch.fdtd.grid import make_grid
from autdtorch.fdtd.kernels import available_kernel, make_kernel, precision_of
from autdtorch.fdtd.material_gradients import cells_of_maps, cells_of_obstacles, domain_cells
from autdtorch.fdtd.region import Region, require_fine, warn_if_coarse
from autdtorch.fdtd.steady_state import SILENCE, block_of, blocks_needed, fewest_periods
from autdtorch.fdtd.stepping import drive_dft, drive_signal
from autdtorch.propagators.notices import warn_of_ending_walls, warn_of_near_points, warn_of_no_steady_state
from autdtorch.propagators.plan import region_of
from autdtorch.scene.arrays import apertures_of, complex_strengths_of
from autdtorch.scene.checks import require_inside
from autdtorch.scene.drive import validate_drive
from autdtorch.scene.reflectors import require_in_front
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import COMPLEX, device_of
from autdtorch.utils.validation import (
    ArrayLike,
    integer_at_least,
    invalid,
    points_tensor,
    positive,
    real_tensor,
    require_kind,
)

_STEADY = 2e-3  # estimated relative distance to the steady state that is tolerated, as by `make_propagator`


def differentiable_field(
    scene: Scene,
    drive: torch.Tensor,
    points: ArrayLike | None = None,
    *,
    density: ArrayLike | None = None,
    sound_speed: ArrayLike | None = None,
    spacing: float = 1e-3,
    periods: int | None = None,
    device: torch.device | str | None = None,
    kernel: str = "auto",
    dtype: str | torch.dtype = "float32",
    time_step: float | None = None,
) -> torch.Tensor:
    """Return the pressure of drives at points, differentiable by every tensor given, on the whole domain.

    The gradient is computed by an adjoint run of the same kernel, in bounded memory. Density and sound speed
    are those of the scene's K obstacles or, in a scene without obstacles and reflectors, maps of the domain's
    cells at `cell_centers`. Maps have no surfaces between cells and are less accurate. The field changes
    smoothly with a map that changes smoothly, but not with an obstacle that is moved across the grid
    (docs/decisions/gradients.md).

    Args:
        scene: array, medium, domain and obstacles.
        drive: (..., M) complex, |q| <= 1; each takes a run, and its gradient one or two more.
        points: (P, 3) [m] inside the domain; by default the scene's control points.
        density: (K,) or (nx, ny, nz) [kg/m^3], > 0; of no effect for rigid obstacles.
        sound_speed: (K,) or (nx, ny, nz) [m/s], > 0; of no effect for rigid obstacles.
        spacing: edge of a cell [m], at most a third of the wavelength.
        periods: periods of the drive that are stepped, in blocks of a few; the phasors are those of the last
            block. By default sound crosses the domain twice; resonances need more, and bring a
            `SteadyStateWarning` with the number that is expected to do.
        device: as in `make_propagator`, as is `kernel`; gradients pass to tensors on any.
        kernel: the kernel.
        dtype: precision of the fields, float32 or float64.
        time_step: upper limit [s], as in `make_propagator`. The default, the largest stable one, may change
            with the medium from call to call, and the field slightly with it.

    Returns:
        complex128 (..., P) [Pa], on the device of the drive.

    Raises:
        ValueError: an argument has another shape or is out of range, or maps are given in a scene with
            obstacles or reflectors. A reflector is neither rigid nor soft, or not along an axis. A
            differentiated obstacle reaches into the absorbing layers.
    """
    require_kind("scene", scene, Scene)
    kernel, precision = available_kernel(kernel, device), precision_of(dtype)
    drive = validate_drive(drive, len(scene.array))
    targets = scene.control_points if points is None else points_tensor("points", points).cpu()
    require_inside(scene.domain, "points", targets)
    require_in_front(scene.reflectors, "points", targets)
    materials = _material("density", density, scene), _material("sound_speed", sound_speed, scene)
    region, sound_speed = region_of(scene), materials[1]
    if region.mirrors:
        region.require_domain("scene", scene.name)
        region = region.whole
        materials = _of_images(materials[0], region), _of_images(materials[1], region)
    grid = make_grid(region, positive("spacing", spacing, "m"))
    speeds = region.sound_speeds
    if sound_speed is not None:
        rigid = torch.tensor(
            [obstacle.sound_speed is None for obstacle in scene.obstacles], dtype=torch.bool, device="cpu"
        )
        effective = sound_speed.detach() if sound_speed.ndim == 3 else sound_speed.detach()[~rigid]
        speeds = speeds | ({"the medium given": float(effective.min())} if effective.numel() else {})
    require_fine(speeds, scene.frequency, spacing)
    warn_if_coarse(speeds, scene.frequency, spacing)
    warn_of_ending_walls(scene)
    warn_of_near_points(scene, "points", targets, grid.spacing)
    usual = fewest_periods(2 * grid.crossing)
    periods = usual if periods is None else integer_at_least("periods", periods, 1)
    time_step = None if time_step is None else positive("time_step", time_step, "s")
    by_maps = any(values is not None and values.ndim == 3 for values in materials)
    cells = (cells_of_maps if by_maps else cells_of_obstacles)(region, grid, *materials)
    assembly = cells.assembly(grid, region, precision, time_step)
    receivers, stepper = assembly.receivers(targets), make_kernel(kernel)
    nodes, weights = apertures_of(scene.array, scene.wavenumber).with_images(scene.images)
    images = len(weights) // len(scene.array)
    steps, block = block_of(assembly.steps_per_period)
    blocks = math.ceil(periods / block)
    signal = drive_signal(assembly.steps_per_period, 0, steps * blocks).to(precision)
    arrived = blocks * block >= fewest_periods(grid.crossing)
    fields, needs = [torch.zeros((0, len(targets)), **COMPLEX)], [(0.0 if arrived else 1.0, blocks)]
    for row in drive.reshape(-1, drive.shape[-1]):
        strength = weights * (complex_strengths_of(scene.array) * row.cpu()).repeat(images)
        sources = cells.driven(assembly.sources(nodes.positions, strength, nodes.weights), assembly)
        record = recorded(stepper, assembly, sources, receivers, signal)
        fields.append(drive_dft(record[-steps:], block)[None])  # the last block
        phasors = drive_dft(record.detach().reshape(blocks, steps, -1), block)
        floor = SILENCE * nodes.loudest(targets, strength.detach(), grid.spacing / 2)
        needs.append(blocks_needed(phasors, floor, _STEADY))
    residual, enough = max(needs)
    if residual > _STEADY:
        advice = f"periods to about {max(enough * block, usual)}"
        warn_of_no_steady_state(f"after {blocks * block} periods", residual, _STEADY, advice)
    return torch.cat(fields).reshape(*drive.shape[:-1], len(targets)).to(device_of(drive))


def cell_centers(scene: Scene, spacing: float = 1e-3) -> torch.Tensor:
    """Return the centres (nx, ny, nz, 3) [m] of the domain's cells, for maps of the medium.

    Args:
        scene: a scene without obstacles.
        spacing: edge of a cell [m].

    Raises:
        ValueError: the spacing is too coarse for the frequency.
    """
    require_kind("scene", scene, Scene)
    region = region_of(scene)
    grid = make_grid(region, positive("spacing", spacing, "m"))
    inside = zip(grid.centers, domain_cells(region, grid), strict=True)
    axes = torch.meshgrid(*(torch.from_numpy(axis[part]) for axis, part in inside), indexing="ij")
    return torch.stack(axes, dim=-1)


def _of_images(values: torch.Tensor | None, region: Region) -> torch.Tensor | None:
    """Return values (K,) of obstacles for these and their images, as a region has them."""
    return None if values is None else values[[body.number for body in region.bodies]]


def _material(name: str, values: ArrayLike | None, scene: Scene) -> torch.Tensor | None:
    """Return values (K,) of the obstacles or (nx, ny, nz) of the cells, after checking them."""
    if values is None:
        return None
    values, count = real_tensor(name, values).cpu(), len(scene.obstacles)
    if values.shape != (count,) and (values.ndim != 3 or count > 0):
        accepted = f"must be ({count},)" if count else "must be (nx, ny, nz), in a scene without obstacles"
        raise ValueError(f"{name}: shape {tuple(values.shape)}; {accepted}")
    if values.ndim == 3 and scene.reflectors:
        accepted = "maps must be of a scene without reflectors"
        raise ValueError(
            f"{name}: shape {tuple(values.shape)}, {len(scene.reflectors)} reflectors; {accepted}"
        )
    if values.numel() and values.detach().min() <= 0:
        raise invalid(name, float(values.detach().min()), "every entry must be > 0")
    return values
