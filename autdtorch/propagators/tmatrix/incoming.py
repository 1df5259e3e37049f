"""The regular waves of an array around a body, with their derivatives by the body's pose."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from autdtorch.analytic.mean_waves import MeanWaves, powers_needed
from autdtorch.analytic.momentum import gradient_by_place, gradient_by_turn
from autdtorch.analytic.spherical_waves import outgoing_waves
from autdtorch.propagators.tmatrix.body_matrix import BodyMatrix
from autdtorch.scene.arrays import TransducerArray, apertures_of, complex_strengths_of, radii_of
from autdtorch.utils.array_types import COMPLEX
from autdtorch.utils.mirror_images import Image, distinct

_ALIKE = 4
"""Discs of one radius and direction from which on their means are `MeanWaves`, and not those over nodes."""


def incoming_waves(
    body: BodyMatrix, array: TransducerArray, images: Sequence[Image], drive: torch.Tensor
) -> torch.Tensor:
    """Return the coefficients (..., N, R) [Pa] of regular waves around a body, under drives (..., R, M).

    Gradients by the pose take sums over N waves, not over those of each transducer.
    """
    setting = replace(body, center=body.center.detach(), axes=body.axes.detach()), array, images, body.degree
    waves: torch.Tensor = _DrivenWaves.apply(body.center, body.axes, drive, *setting)  # type: ignore[no-untyped-call]
    return waves[..., : len(body.matrix)].mT


class _DrivenWaves(torch.autograd.Function):
    """Waves (..., R, K) with a degree more, whose gradient is left out."""

    @staticmethod
    def forward(
        center: torch.Tensor,
        axes: torch.Tensor,
        drive: torch.Tensor,
        body: BodyMatrix,
        array: TransducerArray,
        images: Sequence[Image],
        degree: int,
    ) -> torch.Tensor:
        if body.center.ndim > 1 and not any(each.stride(0) for each in (body.center, body.axes)):
            body = replace(body, center=body.center[:1], axes=body.axes[:1])  # at rest in all poses
        return IncomingWaves.of(body, array, images, degree + 1).driven(drive.detach())

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: torch.Tensor) -> None:
        center, axes, drive, *ctx.setting = inputs
        ctx.save_for_backward(center, axes, drive, output)

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        (center, axes, drive, waves), (body, array, images, degree) = ctx.saved_tensors, ctx.setting
        if torch.is_grad_enabled():  # for derivatives of the gradient
            waves = _DrivenWaves.apply(center, axes, drive, body, array, images, degree + 1)  # type: ignore[no-untyped-call]
        by_place = by_turn = by_drive = None
        count = (degree + 1) ** 2
        if ctx.needs_input_grad[0]:
            by_place = gradient_by_place(body.wavenumber, axes, waves.mT, gradient[..., :count].mT)
        if ctx.needs_input_grad[1]:
            by_turn = gradient_by_turn(axes, waves.mT, gradient[..., :count].mT)
        if ctx.needs_input_grad[2]:
            placed = replace(body, center=center, axes=axes)
            each = IncomingWaves.of(placed, array, images, degree).matrix
            by_drive = (gradient[..., :count] @ each.conj()).sum_to_size(drive.shape)
        return by_place, by_turn, by_drive, None, None, None, None


@dataclass(frozen=True)
class IncomingWaves:
    """The coefficients of regular waves around a body, of unit drives of M transducers.

    Attributes:
        parts: for transducers alike and an image of them, their places in the array, and their waves: the
            means over discs, or (..., M, N).
        strengths: factors (M,) of all.
    """

    parts: list[tuple[torch.Tensor, complex, MeanWaves | torch.Tensor]]
    strengths: torch.Tensor

    @classmethod
    def of(
        cls, body: BodyMatrix, array: TransducerArray, images: Sequence[Image], degree: int | None = None
    ) -> IncomingWaves:
        """Return the waves of an array around a body, by default up to its degree.

        An array inside its sphere raises.
        """
        body.offsets("array.positions", array.positions)
        degree = body.degree if degree is None else degree
        parts = [
            (index, image.weight, _incoming_from(body, degree, array, index, image))
            for index in _alike(array)
            for image in distinct(images, array.positions[index])
        ]
        return cls(parts, 4j * math.pi * body.wavenumber * complex_strengths_of(array))

    @property
    def matrix(self) -> torch.Tensor:
        """The coefficients (..., N, M) [Pa]."""
        each = [
            (index, weight, (waves.matrix if isinstance(waves, MeanWaves) else waves).mT)
            for index, weight, waves in self.parts
        ]
        return self._summed(each)

    def driven(self, drive: torch.Tensor) -> torch.Tensor:
        """Return the coefficients (..., R, N) [Pa] under drives (..., R, M)."""
        every, each = self.strengths * drive, []
        for index, weight, waves in self.parts:
            strong = every[..., index]
            each.append(weight * (waves.driven(strong) if isinstance(waves, MeanWaves) else strong @ waves))
        return torch.stack(each).sum(dim=0)

    def weighted(self, weights: torch.Tensor) -> torch.Tensor:
        """Return the sums (..., P, M) of the coefficients with weights (..., P, N)."""
        each = [
            (index, weight, waves.weighted(weights) if isinstance(waves, MeanWaves) else weights @ waves.mT)
            for index, weight, waves in self.parts
        ]
        return self._summed(each)

    def _summed(self, parts: Sequence[tuple[torch.Tensor, complex, torch.Tensor]]) -> torch.Tensor:
        total = torch.zeros((*parts[0][2].shape[:-1], len(self.strengths)), **COMPLEX)
        for index, weight, part in parts:
            total = total.index_add(-1, index, weight * part)
        return self.strengths * total


def _alike(array: TransducerArray) -> list[torch.Tensor]:
    """Return the indices (n,) of the transducers of each direction and radius; points are all alike."""
    radii = radii_of(array)
    if not radii.any():
        return [torch.arange(len(array), dtype=torch.int64, device="cpu")]
    kinds = torch.cat([array.normals, radii[:, None]], dim=1)
    _, kind = torch.unique(kinds, dim=0, return_inverse=True)
    return [torch.nonzero(kind == number)[:, 0] for number in range(int(kind.max()) + 1)]


def _incoming_from(
    body: BodyMatrix, degree: int, array: TransducerArray, index: torch.Tensor, image: Image
) -> MeanWaves | torch.Tensor:
    """Return the waves around a body of images of transducers alike, by unit strengths over 4 pi i k."""
    centers, radius = image.of(array.positions[index]), float(radii_of(array)[index[0]])
    offsets = centers - body.center[..., None, :]
    if radius and len(index) >= _ALIKE:
        normal = image.matrix @ array.normals[index[0]]
        nearest = float(offsets.detach().norm(dim=-1).min()) - radius
        powers = powers_needed(degree, body.wavenumber, nearest, radius)
        if powers is not None:
            return MeanWaves.of(degree, body.wavenumber, offsets, normal, radius, body.axes, powers)
    if not radius:
        return outgoing_waves(degree, body.wavenumber, offsets @ body.axes, conjugate=True)
    nodes = apertures_of(array, abs(body.wavenumber)).chosen(index)
    body.offsets("array.positions", image.of(nodes.positions.reshape(-1, 3)))
    means = []
    for node in nodes.positions.unbind(dim=1):
        each = (image.of(node) - body.center[..., None, :]) @ body.axes
        means.append(outgoing_waves(degree, body.wavenumber, each, conjugate=True))
    return torch.einsum("q...,q->...", torch.stack(means), nodes.weights.to(torch.complex128))
