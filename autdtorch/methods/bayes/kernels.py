"""Covariances of the intensity at a focus, and of functions of phases."""

from __future__ import annotations

import math
from typing import Any

import torch
from gpytorch.kernels import Kernel

from autdtorch.utils.validation import require_one_of


class PhasorKernel(Kernel):  # type: ignore[misc]
    """The covariance of the intensity |g . q|^2 at a point, over drives q.

    The row g of the transfer matrix is Gaussian, with the mean g0 and independent circular entries of the
    variance s^2. Two drives q and q' with the product b = sum_m q_m conj(q'_m) then have intensities of the
    covariance ``s^4 |b|^2 + 2 s^2 Re(conj(g0 . q) (g0 . q') b)`` and of the mean ``|g0 . q|^2 + s^2 |q|^2``
    (fourth moments of Gaussian variables, Isserlis 1918). No hyperparameter is left to fit. Phases enter with
    their period, and an offset that all phases share changes nothing.
    """

    has_lengthscale = False

    def __init__(
        self,
        inputs: str = "phases",
        rows: torch.Tensor | None = None,
        variance: torch.Tensor | None = None,
        **settings: Any,
    ) -> None:
        """Make the kernel.

        Args:
            inputs: "phases": inputs (..., M - 1) are phases in turns of fully driven transducers; one
                transducer, whichever it is, keeps phase 0, and is the last of a row. "drives": inputs
                (..., 2 M) are the real parts of drives, then their imaginary parts.
            rows: g0 (..., M), complex; the dimensions before are those of a batch. 0 by default.
            variance: s^2 (...); 1 / M by default: intensities are in units of their mean at full drive.
            settings: of `gpytorch.kernels.Kernel`.

        Raises:
            ValueError: unknown inputs.
        """
        require_one_of("inputs", inputs, ("phases", "drives"))
        if rows is not None:
            settings.setdefault("batch_shape", rows.shape[:-1])
        super().__init__(**settings)
        self.inputs, self.rows, self.variance = inputs, rows, variance

    def forward(self, x1: torch.Tensor, x2: torch.Tensor, diag: bool = False, **_: Any) -> torch.Tensor:
        """Return covariances (..., N1, N2) of inputs (..., N1, D) and (..., N2, D); (..., N) with `diag`."""
        if self.inputs == "phases":
            x1, x2 = phasors(x1), phasors(x2)
        real, imaginary = _products(x1, x2, diag)
        variance = self._variance(x1) if diag else self._variance(x1)[..., None]
        covariance = variance**2 * (real.square() + imaginary.square())
        if self.rows is None:
            return covariance
        of_means = _products(_pressures(x1, self.rows), _pressures(x2, self.rows), diag)
        return covariance + 2 * variance * (of_means[0] * real + of_means[1] * imaginary)

    def mean(self, x: torch.Tensor) -> torch.Tensor:
        """Return the mean intensities (..., N) of inputs (..., N, D)."""
        if self.inputs == "phases":
            x = phasors(x)
        mean = self._variance(x) * x.square().sum(dim=-1)
        return mean if self.rows is None else mean + _pressures(x, self.rows).square().sum(dim=-1)

    def _variance(self, x: torch.Tensor) -> torch.Tensor:
        """Return s^2 (..., 1) for drives (..., 2 M)."""
        return x.new_tensor([2 / x.shape[-1]]) if self.variance is None else self.variance[..., None]


def _products(x1: torch.Tensor, x2: torch.Tensor, diag: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """Return real and imaginary parts of the products of x1 and the conjugate of x2, summed over entries.

    Entries (..., N, 2 M) are real parts, then imaginary parts. Products are (..., N1, N2), or (..., N) with
    `diag`.
    """
    entries = x1.shape[-1] // 2
    turned = torch.cat([x1[..., entries:], -x1[..., :entries]], dim=-1)
    if diag:
        return (x1 * x2).sum(dim=-1), (turned * x2).sum(dim=-1)
    return x1 @ x2.mT, turned @ x2.mT


def _pressures(x: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
    """Return g . q (..., N, 2), real and imaginary part, of drives (..., N, 2 M) and rows (..., M)."""
    real, imaginary = rows.real, rows.imag
    by_parts = [torch.cat([real, -imaginary], dim=-1), torch.cat([imaginary, real], dim=-1)]
    return x @ torch.stack(by_parts, dim=-1)


def phasors(points: torch.Tensor) -> torch.Tensor:
    """Return drives (..., 2 M), real and imaginary parts, of phases (..., M - 1) in turns and of phase 0."""
    phases = -2 * math.pi * torch.cat([points, torch.zeros_like(points[..., :1])], dim=-1)
    return torch.cat([phases.cos(), phases.sin()], dim=-1)


def on_circle(points: torch.Tensor) -> torch.Tensor:
    """Return points (..., 2 D) on circles, (cos, sin), of phases (..., D) in turns."""
    angles = 2 * math.pi * points
    return torch.cat([angles.cos(), angles.sin()], dim=-1)
