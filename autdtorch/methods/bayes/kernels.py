"""Covariances of the intensity at a focus, and of functions of phases."""

from __future__ import annotations

import math
from typing import Any

import torch
from gpytorch.kernels import Kernel

from autdtorch.utils.validation import complex_tensor, invalid, real_tensor, require_one_of


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
            variance: s^2 (...), > 0, with `rows` alone. Without them 1 / M: intensities are in units of their
                mean at full drive.
            settings: of `gpytorch.kernels.Kernel`.

        Raises:
            ValueError: unknown inputs; rows or a variance that are no finite numbers, one without the other,
                or of shapes that do not fit.
        """
        require_one_of("inputs", inputs, ("phases", "drives"))
        if (rows is None) != (variance is None):
            raise invalid("variance", variance, "must be given with rows, and only then")
        if rows is not None and variance is not None:
            rows, variance = complex_tensor("rows", rows), real_tensor("variance", variance)
            if rows.ndim == 0 or variance.shape != rows.shape[:-1] or not bool((variance > 0).all()):
                raise invalid("variance", variance, f"must be > 0, of shape {tuple(rows.shape[:-1])}")
            settings.setdefault("batch_shape", rows.shape[:-1])
        super().__init__(**settings)
        self.inputs = inputs
        # As real numbers: PyTorch's `Module.to` would drop imaginary parts.
        self.register_buffer("_rows", None if rows is None else torch.view_as_real(rows.resolve_conj()))
        self.register_buffer("variance", variance)

    @property
    def rows(self) -> torch.Tensor | None:
        """The rows (..., M), complex, or None."""
        return None if self._rows is None else torch.view_as_complex(self._rows)

    def __getitem__(self, index: Any) -> PhasorKernel:
        """Return the kernel of a part of the batch."""
        if self.rows is None:
            return super().__getitem__(index)  # type: ignore[no-any-return]
        return PhasorKernel(self.inputs, self.rows[index], self.variance[index])

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
        """Return the mean intensities (..., N) of inputs (..., N, D); `ValueError` for other shapes."""
        x = real_tensor("x", x)
        if x.ndim < 2 or x.numel() == 0:
            raise ValueError(f"x: shape {tuple(x.shape)}; must be (..., N, D), not empty")
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
