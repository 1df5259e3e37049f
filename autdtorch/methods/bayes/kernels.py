"""Covariances of the intensity at a focus, and of functions of phases."""

from __future__ import annotations

import math
from typing import Any

import torch
from gpytorch.kernels import Kernel

from autdtorch.utils.validation import require_one_of


class PhasorKernel(Kernel):  # type: ignore[misc]
    """The covariance of the intensity |g . q|^2 at a point, over drives q.

    If the row g of the transfer matrix has independent circular Gaussian entries of one variance, then the
    intensities of two drives have the covariance ``|sum_m q_m conj(q'_m)|^2 / M^2`` and the mean
    ``|q|^2 / M``, in units of the mean intensity at full drive (fourth moments of Gaussian variables,
    Isserlis 1918). No hyperparameter is left to fit. Phases enter with their period, and an offset that all
    phases share changes nothing.
    """

    has_lengthscale = False

    def __init__(self, inputs: str = "phases", **settings: Any) -> None:
        """Make the kernel.

        Args:
            inputs: "phases": inputs (..., M - 1) are phases in turns of fully driven transducers; one
                transducer, whichever it is, keeps phase 0. "drives": inputs (..., 2 M) are the real parts of
                drives, then their imaginary parts.
            settings: of `gpytorch.kernels.Kernel`.

        Raises:
            ValueError: unknown inputs.
        """
        super().__init__(**settings)
        require_one_of("inputs", inputs, ("phases", "drives"))
        self.inputs = inputs

    def forward(self, x1: torch.Tensor, x2: torch.Tensor, diag: bool = False, **_: Any) -> torch.Tensor:
        """Return covariances (..., N1, N2) of inputs (..., N1, D) and (..., N2, D); (..., N) with `diag`."""
        if self.inputs == "phases":
            x1, x2 = phasors(x1), phasors(x2)
        transducers = x1.shape[-1] // 2
        turned = torch.cat([x1[..., transducers:], -x1[..., :transducers]], dim=-1)  # -i q
        if diag:
            real, imaginary = (x1 * x2).sum(dim=-1), (turned * x2).sum(dim=-1)
        else:
            real, imaginary = x1 @ x2.mT, turned @ x2.mT
        return (real.square() + imaginary.square()) / transducers**2


def phasors(points: torch.Tensor) -> torch.Tensor:
    """Return drives (..., 2 M), real and imaginary parts, of phases (..., M - 1) in turns and of phase 0."""
    phases = -2 * math.pi * torch.cat([points, torch.zeros_like(points[..., :1])], dim=-1)
    return torch.cat([phases.cos(), phases.sin()], dim=-1)


def on_circle(points: torch.Tensor) -> torch.Tensor:
    """Return points (..., 2 D) on circles, (cos, sin), of phases (..., D) in turns."""
    angles = 2 * math.pi * points
    return torch.cat([angles.cos(), angles.sin()], dim=-1)
