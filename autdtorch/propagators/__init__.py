"""Propagators: from drives to pressures, by exact sums, by FDTD in a box or by FDTD on the whole domain."""

from __future__ import annotations

import logging
import math
import os
from typing import Literal

import torch

from autdtorch.fdtd.grid import warn_if_coarse
from autdtorch.fdtd.kernels.contract import Kernel
from autdtorch.fdtd.spacing import coarsest_spacing, pilot_spacing, spacing_for
from autdtorch.propagators.auto import method_for
from autdtorch.propagators.base import Propagator, Run, SimulatedPropagator, SteadyStateWarning
from autdtorch.propagators.box import BoxPropagator
from autdtorch.propagators.cache import DiskCache
from autdtorch.propagators.differentiable import cell_centers, differentiable_field
from autdtorch.propagators.free_space import FreeSpacePropagator
from autdtorch.propagators.full import FullPropagator
from autdtorch.propagators.scene_region import region_of, warn_of_ending_walls
from autdtorch.propagators.stepper import KERNELS, make_kernel, precision_of, relative_tolerance
from autdtorch.propagators.volume import volume_field
from autdtorch.propagators.workload import memory_for
from autdtorch.scene.scene import Scene
from autdtorch.utils.memory import require_memory
from autdtorch.utils.validation import (
    integer_at_least,
    invalid,
    path_of,
    positive,
    require_kind,
    require_one_of,
)

__all__ = [
    "BoxPropagator",
    "FreeSpacePropagator",
    "FullPropagator",
    "Propagator",
    "Run",
    "SimulatedPropagator",
    "SteadyStateWarning",
    "cell_centers",
    "differentiable_field",
    "make_propagator",
    "volume_field",
]

logger = logging.getLogger(__name__)

SIMULATED = {kind.method: kind for kind in (BoxPropagator, FullPropagator)}
CACHE_VARIABLE = "AUTDTORCH_CACHE_DIR"


def make_propagator(
    scene: Scene,
    method: str = "auto",
    spacing: float | None = 1e-3,
    tolerance: float = 2e-3,
    *,
    kernel: str = "auto",
    dtype: str | torch.dtype = "float32",
    max_periods: int = 600,
    time_step: float | None = None,
    cache: str | os.PathLike[str] | Literal[False] | None = None,
) -> FreeSpacePropagator | SimulatedPropagator:
    """Choose and prepare a propagator.

    Args:
        scene: what is simulated.
        method: "free_space": exact, without obstacles. "full": FDTD on the whole domain. "box": FDTD of the
            scattered field in a box around the obstacles, exact elsewhere, points outside the domain
            included; obstacles far apart get a box each where that is cheaper, and are coupled; they are
            simulated whole, also what of them reaches out of the domain. "auto": free space where the scene
            has no obstacles, full where a wall goes on without end, box where other obstacles reach out of
            the domain, else the cheaper of the two. What was chosen is the propagator's `method`; why, and
            what that skips, is logged.
        spacing: edge of a cell [m], at most a third of the wavelength. The error falls with it; see
            docs/numerics.md. None: two coarse grids are simulated, and the spacing is chosen with which the
            error of the transfer matrix should stay below `tolerance`.
        tolerance: relative error, in (0, 1): the distance to the steady state at which a simulation ends;
            half of that where the spacing is chosen, the other half being the grid's.
        kernel: "cpu" (numba), "cuda" (Triton, on an NVIDIA GPU), "reference" (torch, slow, readable), "auto":
            the fastest there is.
        dtype: precision of the fields, float32 or float64.
        max_periods: periods of the drive after which a simulation ends in any case, with a
            `SteadyStateWarning`. They are stepped in blocks of a few, and the last block is finished.
        time_step: at most this [s], and at least 97 % of it; by default the largest stable one.
        cache: folder where simulated transfer matrices are kept, to be used again for the same scene, points
            and settings by the same version of this package. By default that of the environment variable
            AUTDTORCH_CACHE_DIR, and nowhere if that is not set; False: nowhere. It may be shared by any
            number of processes.

    Returns:
        A propagator for the scene.

    Raises:
        ValueError: an argument out of range, what a kernel needs is missing, or more memory would be needed
            than there is; the message names it.
    """
    require_kind("scene", scene, Scene)
    require_one_of("kernel", kernel, KERNELS)
    precision = precision_of(dtype)
    if spacing is not None:
        spacing = positive("spacing", spacing, "m")
    tolerance = relative_tolerance(tolerance)
    max_periods = integer_at_least("max_periods", max_periods, 1)
    if time_step is not None:
        time_step = positive("time_step", time_step, "s")
    disk_cache = _disk_cache(cache)
    method = method_for(
        scene, method, pilot_spacing(region_of(scene)) if spacing is None else spacing, tolerance
    )
    if method == "free_space":
        return FreeSpacePropagator(scene)
    kind = SIMULATED[method]
    settings = make_kernel(kernel), precision, max_periods, disk_cache
    if spacing is None:
        tolerance /= 2
        spacing = _chosen_spacing(kind, scene, tolerance, *settings)
    propagator = kind(scene, spacing, tolerance, *settings, time_step)
    warn_if_coarse(region_of(scene).sound_speeds, scene.frequency, spacing)
    warn_of_ending_walls(scene)
    return propagator


def _chosen_spacing(
    kind: type[BoxPropagator | FullPropagator],
    scene: Scene,
    tolerance: float,
    kernel: Kernel,
    dtype: torch.dtype,
    max_periods: int,
    cache: DiskCache | None,
) -> float:
    """Spacing [m] at which the grid's error should be `tolerance`, told from two coarse grids."""
    pilot = pilot_spacing(region_of(scene))
    near_steady = max(tolerance, 1e-3)
    propagator = kind(scene, pilot, near_steady, kernel, dtype, max_periods, cache, None)
    _, error, _ = propagator._estimated()
    if not math.isfinite(error):
        accepted = f"too few to choose a spacing: at {pilot:.3g} m no run came near its steady state"
        raise invalid("max_periods", max_periods, accepted)
    spacing = min(spacing_for(tolerance, error, pilot), coarsest_spacing(region_of(scene)))
    needed = memory_for(scene, kind.method, spacing, tolerance, dtype, kernel)
    require_memory("tolerance", 2 * tolerance, needed)
    logger.info("spacing %.3g mm: the error at %.3g mm is about %.2g", 1e3 * spacing, 1e3 * pilot, error)
    return spacing


def _disk_cache(folder: str | os.PathLike[str] | Literal[False] | None) -> DiskCache | None:
    name = "cache"
    if folder is None:
        name, folder = CACHE_VARIABLE, os.environ.get(CACHE_VARIABLE) or False
    if folder is False:
        return None
    path = path_of(name, folder, "a folder, or False")
    try:
        return DiskCache(path)
    except OSError as error:
        raise invalid(name, str(path), f"must be a folder, or one that can be made ({error})") from error
