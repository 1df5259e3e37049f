"""Types of NumPy arrays, keywords of tensors on the CPU, and the device of an argument."""

from __future__ import annotations

from typing import Any, Final, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
ComplexArray: TypeAlias = NDArray[np.complex128]
Index: TypeAlias = NDArray[np.int64]
Bytes: TypeAlias = NDArray[np.uint8]
AnyArray: TypeAlias = NDArray[Any]


REAL: Final[dict[str, Any]] = {"dtype": torch.float64, "device": "cpu"}
"""REAL: float64 on the CPU."""

COMPLEX: Final[dict[str, Any]] = {"dtype": torch.complex128, "device": "cpu"}
"""COMPLEX: complex128 on the CPU."""


def device_of(value: object) -> torch.device:
    """Return the device of an argument that may be a tensor; of other numbers, the CPU."""
    return value.device if isinstance(value, torch.Tensor) else torch.device("cpu")
