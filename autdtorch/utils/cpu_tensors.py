"""Keywords of tensors on the CPU, whatever `torch.set_default_device` says: `torch.zeros(3, **REAL)`."""

from __future__ import annotations

from typing import Any, Final

import torch

REAL: Final[dict[str, Any]] = {"dtype": torch.float64, "device": "cpu"}
"""REAL: float64 on the CPU."""

COMPLEX: Final[dict[str, Any]] = {"dtype": torch.complex128, "device": "cpu"}
"""COMPLEX: complex128 on the CPU."""
