"""Time-stepping kernels under one contract: a readable specification, fast versions, and their choice."""

from __future__ import annotations

import logging
from importlib.util import find_spec

import torch

from autdtorch.fdtd.kernels.contract import Kernel
from autdtorch.utils.hints import with_extra
from autdtorch.utils.validation import ON_CPU, device_type, invalid, require_one_of

logger = logging.getLogger(__name__)


def available_kernel(name: str, device: torch.device | str | None = None) -> str:
    """Return the checked name of a kernel, for "auto" the one of the device or the fastest available."""
    require_one_of("kernel", name, ("auto", "cpu", "cuda", "reference"))
    has_triton, kind = find_spec("triton") is not None, device_type("device", device)
    if name != "auto" and kind not in (None, "cuda" if name == "cuda" else "cpu"):
        raise invalid("device", str(device), f"must fit kernel {name!r}, or one of them be left out")
    if name == "auto" and kind is None:
        has_cuda = torch.cuda.is_available()
        name = "cuda" if has_cuda and has_triton else "cpu"
        logger.debug("kernel auto: %s (CUDA device: %s, Triton: %s)", name, has_cuda, has_triton)
    elif name == "auto":
        name = str(kind)
    if name == "cuda" and not has_triton:
        field, value = ("kernel", name) if device is None else ("device", str(device))
        raise invalid(field, value, f"needs Triton: {with_extra('cuda')}; {ON_CPU}")
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
    """Return the precision of the fields, float32 or float64, after checking it."""
    name = str(dtype).removeprefix("torch.") if isinstance(dtype, torch.dtype) else dtype
    require_one_of("dtype", name, ("float32", "float64"))
    return torch.float32 if name == "float32" else torch.float64
