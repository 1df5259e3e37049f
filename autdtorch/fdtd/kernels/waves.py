"""The fields of many sources in free space, on the device that sums them soonest."""

from __future__ import annotations

from importlib.util import find_spec

import torch
from torch import Tensor

from autdtorch.analytic.discs import waves_of
from autdtorch.utils.apertures import Discs, centers_of

WORTH_A_GPU = 1 << 22
"""Pairs of a point and a source from which on a GPU takes less time than the cores beside it."""

AT_ONCE = 1 << 22
"""Pairs whose waves are in memory at a time, with all that they are made of 1 to 2 GB."""


def superposition(
    points: Tensor | Discs,
    sources: Tensor | Discs,
    amplitude: Tensor,
    wavenumber: complex,
    dtype: torch.dtype = torch.float64,
    device: str = "cpu",
) -> Tensor:
    """Return R fields (P, R) complex128 [Pa] of N sources, with amplitudes (N, R) [Pa m], on the CPU.

    See `cpu_waves.superposition`. The device "cuda" serves sums of many waves, in double precision.
    """
    if device == "cuda" and len(centers_of(points)) * len(centers_of(sources)) >= WORTH_A_GPU:
        return superposition_on(device, points, sources, amplitude, wavenumber).cpu()
    from autdtorch.fdtd.kernels.cpu_waves import superposition as compiled  # loads numba

    return compiled(points, sources, amplitude.cpu(), wavenumber, dtype)


def superposition_on(
    device: torch.device | str,
    points: Tensor | Discs,
    sources: Tensor | Discs,
    amplitude: Tensor,
    wavenumber: complex,
) -> Tensor:
    """Return the fields (P, R) on a device, a few points at a time; differentiable.

    There is a point and a source at least; either may be discs.
    """
    amplitude, parts = amplitude.to(device), []
    sources, rows = _moved(sources, device), max(1, AT_ONCE // len(amplitude))
    for first in range(0, len(centers_of(points)), rows):
        some = slice(first, first + rows)
        if isinstance(points, Discs):  # reciprocity
            discs = _moved(Discs(*(part[some] for part in points)), device)
            waves = waves_on_device(centers_of(sources), discs, wavenumber).mT
        else:
            waves = waves_on_device(points[some].to(device), sources, wavenumber)
        parts.append(waves @ amplitude)
    return torch.cat(parts)


def waves_on_device(points: Tensor, sources: Tensor | Discs, wavenumber: complex) -> Tensor:
    """Return the waves (P, N) at points (P, 3) [m] on their device; see `waves_of`."""
    if points.is_cuda and find_spec("triton") is not None and not is_differentiated(points):
        from autdtorch.fdtd.kernels.cuda_waves import waves_on_gpu

        return waves_on_gpu(points, sources, complex(wavenumber))
    return waves_of(points, sources, complex(wavenumber))


def is_differentiated(points: Tensor) -> bool:
    """Return whether derivatives by the points may be asked for, backward or forward."""
    forward = torch.autograd.forward_ad.unpack_dual(points).tangent is not None  # type: ignore[no-untyped-call]
    return points.requires_grad or forward or torch._C._functorch.is_functorch_wrapped_tensor(points)


def _moved(places: Tensor | Discs, device: torch.device | str) -> Tensor | Discs:
    return Discs(*(part.to(device) for part in places)) if isinstance(places, Discs) else places.to(device)
