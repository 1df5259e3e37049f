"""Simulate and search in this process, then in others of each kind; print what differs. A program.

With an empty `NUMBA_CACHE_DIR`, this process compiles the kernels; loky's new ones load them from there.
"""

import logging
import multiprocessing
import sys

import torch
from joblib.externals.loky import get_reusable_executor
from small_scenes import CUBE, small_scene
from torch.utils.data import DataLoader

import autdtorch as at
from autdtorch.utils.compiled import _entries


def numbers(seed: int) -> list[float]:
    """Numbers of a simulation, and of methods that work on threads of PyTorch and of methods."""
    logging.disable()
    objective = at.SimulatedObjective(
        scene := small_scene((CUBE,)), at.make_propagator(scene, "box", 2e-3, cache=False)
    )
    assert objective.transfer_matrix is not None
    scores = [at.gabs(objective, trials=4, seed=seed), at.identify(objective, 12, seed=seed)]
    return [objective.transfer_matrix.abs().sum().item(), *(each.score.sum().item() for each in scores)]


def kernels_compiled() -> int:
    """Return the number of kernels that this process compiled."""
    return sum(sum(kernel.stats.cache_misses.values()) for kernel in _entries)


def numbers_of_loaded_kernels(seed: int) -> list[float]:
    """`numbers`; a kernel that is compiled and not loaded makes them differ."""
    before = kernels_compiled()
    return [*numbers(seed), *[float("nan")] * (kernels_compiled() - before)]


def in_processes(kind: str) -> list[list[float]]:
    """`numbers` of seeds 0 and 1, in two processes; new ones share nothing, so that one is enough."""
    if kind == "dataloader":
        loader = DataLoader([0, 1], batch_size=None, num_workers=2, collate_fn=numbers_of_loaded_kernels)
        return list(loader)
    if kind == "loky":
        with get_reusable_executor(1) as workers:
            return list(workers.map(numbers_of_loaded_kernels, (0, 1)))
    with multiprocessing.get_context(kind).Pool(2) as pool:
        return pool.map_async(numbers_of_loaded_kernels, (0, 1), chunksize=1).get(timeout=300)


if __name__ == "__main__":
    torch.set_num_threads(4)  # on any machine
    torch.randn(1500, 1500).matmul(torch.randn(1500, 1500))  # starts PyTorch's threads
    expected = [numbers(0), numbers(1)]
    print("compiled", kernels_compiled())
    for kind in sys.argv[1:]:
        print(kind, sum(one != other for one, other in zip(in_processes(kind), expected, strict=True)))
