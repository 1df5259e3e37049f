"""Execution of a plan: its transfer matrix, simulated or loaded from a cache."""

from __future__ import annotations

import logging
from dataclasses import fields

import torch

from autdtorch.fdtd.spacing import grid_error
from autdtorch.propagators.box import BoxSimulation
from autdtorch.propagators.cache import DiskCache
from autdtorch.propagators.full import DomainSimulation
from autdtorch.propagators.plan import Plan
from autdtorch.propagators.simulation import Simulation, TransferMatrix
from autdtorch.utils.digest import digest_of
from autdtorch.utils.threads import one_torch_thread
from autdtorch.utils.versions import package_versions, source_digest

logger = logging.getLogger(__name__)

_NO_EFFECT = ("control_points", "observation_plane", "name")
"""Scene fields that do not affect the pressure; left out of the cache key."""


def simulation_of(plan: Plan) -> Simulation:
    """Return the simulation of a plan with grids; nothing is computed yet."""
    return DomainSimulation(plan) if plan.method == "full" else BoxSimulation(plan)


@one_torch_thread()
def execute(
    plan: Plan,
    points: torch.Tensor | None = None,
    cache: DiskCache | None = None,
    simulation: Simulation | None = None,
) -> TransferMatrix:
    """Return the transfer matrix of a plan with grids at points (P, 3) [m], simulated or from the cache.

    The points are by default the control points. A matrix that has converged is added to the cache.
    """
    points = plan.scene.control_points if points is None else points
    simulation = simulation or simulation_of(plan)
    if cache is None:
        return simulation.transfer_matrix(points)
    key = cache_key(plan, points)
    if (found := cache.load(key, (len(points), len(plan.scene.array)))) is not None:
        logger.info("transfer matrix of %s loaded from %s", plan.scene.name, cache.folder)
        return TransferMatrix(torch.from_numpy(found[0]), found[1], ())
    result = simulation.transfer_matrix(points)
    if all(run.reached for run in result.runs):
        cache.save(key, result.matrix.numpy(), result.error)
    return result


def with_grid_error(first: TransferMatrix, second: TransferMatrix, coarser: bool) -> TransferMatrix:
    """Return the first matrix with its error, estimated from a second grid that is coarser or finer."""
    error = first.error + grid_error(first.matrix, second.matrix, coarser)
    return TransferMatrix(first.matrix, error, first.runs + second.runs)


def cache_key(plan: Plan, points: torch.Tensor) -> str:
    """Return a digest of everything that affects the transfer matrix of points (P, 3) [m]."""
    scene = {entry.name: getattr(plan.scene, entry.name) for entry in fields(plan.scene)}
    settings = {entry.name: getattr(plan, entry.name) for entry in fields(plan)}
    settings |= {"scene": None, "region": None, "runs": None, "dtype": str(plan.dtype)}
    affecting = {name: part for name, part in scene.items() if name not in _NO_EFFECT}
    return digest_of(source_digest(), package_versions(), settings, affecting, points)
