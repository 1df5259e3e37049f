"""The kernel and the precision of a simulation, by name."""

from __future__ import annotations

import logging
from importlib.util import find_spec

import torch

from autdtorch.fdtd.kernels.contract import Kernel
from autdtorch.utils.validation import invalid, require_one_of

logger = logging.getLogger(__name__)

KERNELS = ("auto", "cpu", "cuda", "reference")


def available_kernel(name: str) -> str:
    """Return the kernel of a name, the fastest available for "auto".

    Raises:
        ValueError: unknown name, or the kernel needs a package that is not installed.
    """
    require_one_of("kernel", name, KERNELS)
    has_triton = find_spec("triton") is not None
    if name == "auto":
        has_cuda = torch.cuda.is_available()
        name = "cuda" if has_cuda and has_triton else "cpu"
        logger.debug("kernel auto: %s (CUDA device: %s, Triton: %s)", name, has_cuda, has_triton)
    if name == "cuda" and not has_triton:
        raise invalid("kernel", name, "needs Triton: pip install 'autdtorch[cuda]'")
    return name


def make_kernel(name: str) -> Kernel:
    """Make the kernel that `available_kernel` returned."""
    if name == "reference":
        from autdtorch.fdtd.kernels.reference import ReferenceKernel

        return ReferenceKernel()
    if name == "cuda":
        from autdtorch.fdtd.kernels.cuda import CudaKernel

        return CudaKernel()
    from autdtorch.fdtd.kernels.cpu import CpuKernel

    return CpuKernel()


def precision_of(dtype: str | torch.dtype) -> torch.dtype:
    """Return the precision of the fields, float32 or float64.

    Raises:
        ValueError: another precision.
    """
    name = str(dtype).removeprefix("torch.") if isinstance(dtype, torch.dtype) else dtype
    require_one_of("dtype", name, ("float32", "float64"))
    return torch.float32 if name == "float32" else torch.float64
