"""The choice and construction of a propagator for a scene."""

from __future__ import annotations

import functools
import logging
import os
from typing import Literal

import torch

from autdtorch.propagators.free_space import FreeSpacePropagator
from autdtorch.propagators.notices import warn_of_scene
from autdtorch.propagators.plan import Budget, plan
from autdtorch.propagators.simulated import SimulatedPropagator, refined
from autdtorch.propagators.store import store_in
from autdtorch.propagators.tmatrix.propagator import TMatrixPropagator
from autdtorch.scene.scene import Scene
from autdtorch.utils.process import one_library_thread
from autdtorch.utils.validation import invalid, positive

logger = logging.getLogger(__name__)


@one_library_thread()
def make_propagator(
    scene: Scene,
    method: str = "auto",
    spacing: float | None = 1e-3,
    tolerance: float = 2e-3,
    *,
    device: torch.device | str | None = None,
    kernel: str = "auto",
    dtype: str | torch.dtype = "float32",
    max_periods: int = 600,
    time_step: float | None = None,
    seconds: float | None = None,
    memory: float | None = None,
    cache: str | os.PathLike[str] | Literal[False] | None = None,
) -> FreeSpacePropagator | TMatrixPropagator | SimulatedPropagator:
    """Make the propagator of a scene. Nothing is simulated before its first use, unless `spacing` is None.

    Args:
        scene: the scene.
        method: "free_space": exact, without obstacles. "full": FDTD on the whole domain. "box": FDTD of the
            scattered field in a box around the obstacles, exact elsewhere, also outside the domain. Distant
            obstacles get boxes of their own, coupled by a multiple-scattering iteration, where that is
            cheaper. Obstacles are simulated as a whole, including parts outside the domain. The grid of a
            box turns with tilted flat faces. "tmatrix": T-matrices of the obstacles, each
            simulated once for all poses, arrays and points, and known for spheres; see
            `TMatrix`. "auto": free space without obstacles; full where a wall continues through
            the absorbing layer; tmatrix where it takes fewer simulations (up to three spheres take none); box
            where other obstacles leave the domain or are tilted; otherwise the cheaper of box and full. The
            propagator's `method` is the one chosen; the reason is logged at level DEBUG.
        spacing: edge of a cell [m], at most a third of the wavelength. The error falls with its square, or
            faster along the grid (docs/decisions/error-bars.md). None: the scene is simulated on finer and
            finer grids, until the estimated error of the transfer matrix is within `tolerance`.
        tolerance: relative error, in (0, 1): the distance to the steady state at which a simulation ends,
            or the estimated error where the spacing is chosen; a warning tells where voxels are too coarse
            for it. Hard obstacles are simulated as rigid where the difference is smaller.
        device: where simulations run, and fields of many points are summed: "cpu", "cuda" (an NVIDIA GPU,
            the current one) or a `torch.device`; by default a GPU if there is one. Results are equal to
            rounding wherever they come from, and on the device of the drive or the points, by default the
            CPU.
        kernel: "cpu" (numba), "cuda" (Triton, on an NVIDIA GPU), "reference" (torch, slow, readable), or
            "auto" for the fastest available on the device.
        dtype: precision of the fields, float32 or float64.
        max_periods: periods of the drive after which a simulation ends in any case, with a
            `SteadyStateWarning`. Periods are stepped in blocks of a few; the last block is completed.
        time_step: upper limit of the time step [s]; the step used is within 3 % of it. By default the
            largest stable one.
        seconds: time for the choice of a spacing [s], about; the finest grid that fits is taken.
        memory: most memory for it [bytes].
        cache: folder for simulated transfer matrices, which are used again for the same scene, points,
            settings and version of this package. By default the environment variable AUTDTORCH_CACHE_DIR,
            or no cache if it is not set; False: no cache. Several processes may share the folder. Matrices
            used last are kept, up to about 1 GB, or as many GB as AUTDTORCH_CACHE_GB says.

    Returns:
        A propagator of the scene.

    Raises:
        ValueError: an argument is out of range, the device or kernel needs a GPU or a package that is not
            there, or the simulation needs more memory than available.
    """
    seconds = None if seconds is None else positive("seconds", seconds, "s")
    memory = None if memory is None else positive("memory", memory, "bytes")
    planned = plan(scene, method, spacing, tolerance, kernel, dtype, max_periods, time_step, device)
    if spacing is not None and (seconds, memory) != (None, None):
        raise invalid("spacing", spacing, "must be None where seconds or memory limit its choice", "m")
    store = store_in(cache)

    @functools.cache  # T-matrices need it for some points only; its time begins then
    def on_grids() -> SimulatedPropagator:
        if spacing is None:
            return refined(planned.on_grids, Budget(seconds, memory), store)
        return SimulatedPropagator(planned.on_grids, store)

    if not planned.runs:
        return TMatrixPropagator(planned, store, on_grids)
    propagator: TMatrixPropagator | SimulatedPropagator
    if planned.method == "tmatrix":
        settled = planned if spacing else planned.by_waves(on_grids().spacing, time_step)
        propagator = TMatrixPropagator(settled, store, on_grids)
    elif planned.method == "free_space":
        return FreeSpacePropagator(scene, planned.device)
    else:
        propagator = on_grids()
    if time_step is not None:
        logger.debug("time step %.4g us", 1e6 * propagator.time_step)  # refuses one that is not stable
    warn_of_scene(propagator.plan)
    return propagator
