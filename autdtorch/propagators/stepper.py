"""What steps, and in what precision, by the names that users give."""

from __future__ import annotations

import logging
from importlib.util import find_spec

import torch

from autdtorch.fdtd.kernels.contract import Kernel
from autdtorch.utils.validation import invalid, positive, require_one_of

logger = logging.getLogger(__name__)

KERNELS = ("auto", "cpu", "cuda", "reference")
DTYPES = {"float32": torch.float32, "float64": torch.float64}


def make_kernel(name: str) -> Kernel:
    """The kernel of a name, one of `KERNELS`; "auto" takes the fastest there is.

    Raises:
        ValueError: what it needs is missing.
    """
    if name == "reference":
        from autdtorch.fdtd.kernels.reference import ReferenceKernel

        return ReferenceKernel()
    has_triton = find_spec("triton") is not None
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() and has_triton else "cpu"
        found = f"CUDA device: {torch.cuda.is_available()}, Triton: {has_triton}"
        logger.info("kernel auto: %s (%s)", name, found)
    if name == "cuda":
        if not has_triton:
            raise invalid("kernel", name, "needs Triton: pip install 'autdtorch[cuda]'")
        from autdtorch.fdtd.kernels.cuda import CudaKernel

        return CudaKernel()
    from autdtorch.fdtd.kernels.cpu import CpuKernel

    return CpuKernel()


def precision_of(dtype: str | torch.dtype) -> torch.dtype:
    """Precision of the fields, float32 or float64.

    Raises:
        ValueError: another.
    """
    name = str(dtype).removeprefix("torch.") if isinstance(dtype, torch.dtype) else dtype
    require_one_of("dtype", name, tuple(DTYPES))
    return DTYPES[name]


def relative_tolerance(value: float) -> float:
    """Return a relative error that is aimed at, after checking it.

    Raises:
        ValueError: it is not in (0, 1).
    """
    tolerance = positive("tolerance", value)
    if tolerance >= 1:
        raise invalid("tolerance", tolerance, "must be in (0, 1)")
    return tolerance
