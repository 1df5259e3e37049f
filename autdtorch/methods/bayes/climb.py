"""The search for the point of largest acquisition, for all trials at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch

_SUFFICIENT = 1e-4  # share of the predicted rise that a step must reach
_LARGEST_GROWTH = 4  # of the step's length, where the slope does not bend

Value = Callable[[torch.Tensor], torch.Tensor]
"""A function of points (T, C, D) that gives values (T, C), each of its own point alone."""


class Effort(NamedTuple):
    """The effort of a search: points that are compared, those climbed from, and evaluations of a climb."""

    candidates: int
    starts: int
    steps: int


def candidates(best: torch.Tensor, generators: Sequence[torch.Generator], count: int) -> torch.Tensor:
    """Return points (T, count, D): half of them anywhere, half at all distances around the best (T, D)."""
    found = []
    for point, generator in zip(best, generators, strict=True):
        anywhere, near = _uniform(generator, 2, count // 2, len(point))
        # Normally distributed steps; their lengths are spread evenly in logarithm, from 0.001 to 0.3.
        scale = 10 ** (-3 + 2.5 * _uniform(generator, len(near), 1))
        steps = scale * torch.randn(near.shape, dtype=torch.float64, generator=generator, device="cpu")
        found.append(torch.cat([anywhere, point + steps]))
    return torch.stack(found)


def highest(
    value: Value, points: torch.Tensor, effort: Effort, reach: torch.Tensor, periodic: bool
) -> torch.Tensor:
    """Return the highest point (T, D) that climbs from the best of the points (T, C, D) find.

    It is a spectral projected gradient (Birgin, Martinez and Raydan 2000) within [0, 1], or without bounds
    where the points are periodic.

    Args:
        value: is climbed.
        points: in turns.
        effort: of the climbs.
        reach: length [turns] over which the value varies (T,).
        periodic: whether the points are.
    """
    if not periodic:
        points = points.clamp(0, 1)
    with torch.no_grad():
        order = value(points).topk(effort.starts, dim=1).indices
    point = points.gather(1, order[..., None].expand(-1, -1, points.shape[-1]))
    height, slope = _with_slope(value, point)
    rate = 0.1 * reach[:, None, None] / slope.norm(dim=-1, keepdim=True).clamp_min(1e-300)
    share = torch.ones_like(rate)
    move = _projected(point + rate * slope, periodic) - point
    for _ in range(effort.steps):
        step = share * move
        there, steeper = _with_slope(value, point + step)
        gain, rise = (there - height)[..., None], (step * slope).sum(dim=-1, keepdim=True)
        rises = gain >= _SUFFICIENT * rise
        bend = (step * (slope - steeper)).sum(dim=-1, keepdim=True)
        longer = torch.where(bend > 0, step.square().sum(dim=-1, keepdim=True) / bend, _LARGEST_GROWTH * rate)
        # Where the value does not rise enough: the top of the parabola through what is known of the line.
        shorter = (0.5 * rise / (rise - gain).clamp_min(1e-300)).clamp(0.1, 0.5)
        point = torch.where(rises, point + step, point)
        height, slope = torch.where(rises[..., 0], there, height), torch.where(rises, steeper, slope)
        rate = torch.where(rises, longer, rate)
        move = torch.where(rises, _projected(point + rate * slope, periodic) - point, move)
        share = torch.where(rises, 1.0, share * shorter)
    found = point[torch.arange(len(point), device="cpu"), height.argmax(dim=1)]
    return found % 1 if periodic else found


def _with_slope(value: Value, point: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    point = point.detach().requires_grad_(True)
    height = value(point)
    (slope,) = torch.autograd.grad(height.sum(), point)
    return height.detach(), slope


def _projected(point: torch.Tensor, periodic: bool) -> torch.Tensor:
    return point if periodic else point.clamp(0, 1)


def _uniform(generator: torch.Generator, *shape: int) -> torch.Tensor:
    """Return random numbers in [0, 1)."""
    return torch.rand(shape, dtype=torch.float64, generator=generator, device="cpu")
