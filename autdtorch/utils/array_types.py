"""Types of NumPy arrays, keywords of tensors on the CPU, and the kind and the device of an argument."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final, TypeAlias, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
ComplexArray: TypeAlias = NDArray[np.complex128]
Index: TypeAlias = NDArray[np.int64]
Bytes: TypeAlias = NDArray[np.uint8]
AnyArray: TypeAlias = NDArray[Any]

MOST_AXES = 16
"""Most axes of an array, or levels of nested lists; some functions of PyTorch take at most 25."""

REAL: Final[dict[str, Any]] = {"dtype": torch.float64, "device": "cpu"}
"""REAL: float64 on the CPU."""

COMPLEX: Final[dict[str, Any]] = {"dtype": torch.complex128, "device": "cpu"}
"""COMPLEX: complex128 on the CPU."""


_T = TypeVar("_T")


def triple(values: Iterable[_T]) -> tuple[_T, _T, _T]:
    """Return three values, such as coordinates, as a tuple."""
    x, y, z = values
    return x, y, z


def device_of(value: object) -> torch.device:
    """Return the device of an argument that may be a tensor; of other numbers, the CPU."""
    return value.device if isinstance(value, torch.Tensor) else torch.device("cpu")


def is_dense(value: torch.Tensor | AnyArray | np.generic) -> bool:
    """Check that an array has few axes and holds unmasked numbers or booleans in memory."""
    if isinstance(value, torch.Tensor):
        plain = value.layout == torch.strided and not (value.is_quantized or value.is_nested or value.is_meta)
    else:
        plain = value.dtype.kind in "biufc" and not np.ma.is_masked(value)
    return plain and value.ndim <= MOST_AXES
