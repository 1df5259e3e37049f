"""The field of points and discs, differentiable: the mean over each of e^{ikR} / R.

From 1.5 radii on it is a sum of even outgoing waves. Nearer it is an integral along the rim, at the height z
and the distance o from the axis (see `piston_field`):

    1 / (pi a) oint (a - o cos u) / (R + z) sinc(k (R - z) / 2) e^{ik (R + z) / 2} du.

`fdtd.kernels.cpu_waves` has the compiled form. On a GPU, this one sums waves.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from autdtorch.utils.apertures import (
    RIM_DIGITS,
    RIM_LEAST,
    RIM_STRIP,
    RIM_TURNS,
    Discs,
    EvenWaves,
    even_waves,
)
from autdtorch.utils.array_types import COMPLEX, REAL
from autdtorch.utils.validation import LENGTH_TOLERANCE

_AT_ONCE = 1 << 18
"""Pairs of a place and a node on a rim in memory at a time; gradients need all."""

_SMALL = 1e-3
"""Argument up to which a sine is the first two terms of its series: the next one is below 1e-14."""


def waves_of(points: torch.Tensor, sources: torch.Tensor | Discs, wavenumber: complex) -> torch.Tensor:
    """Return the waves (P, N) at points (P, 3) [m] of points (N, 3) or discs of strength 1 Pa m."""
    if not isinstance(sources, Discs):
        apart = (points[:, None] - sources.to(points)).norm(dim=-1)
        return _wave(apart.clamp(min=LENGTH_TOLERANCE), wavenumber)
    radii, kind = sources.kinds()
    series = even_waves(wavenumber, radii)
    between, normals = points[:, None] - sources.centers.to(points), sources.normals.to(points)
    normals, place = normals.expand_as(between), torch.from_numpy(kind)
    apart = between.detach().norm(dim=-1)
    near = apart < torch.from_numpy(series.reaches[:, 0]).to(points)[place]
    if not near.any():
        return _series(between, normals, place, series, wavenumber)
    place, radius = place.expand(apart.shape), sources.radii.to(points).expand(apart.shape)
    waves = torch.zeros(apart.shape, **COMPLEX).to(points.device)
    if not near.all():
        far = _series(between[~near], normals[~near], place[~near.cpu()], series, wavenumber)
        waves = waves.index_put((~near,), far)
    return waves.index_put((near,), along_rim(between[near], normals[near], radius[near], wavenumber))


def _wave(r: torch.Tensor, wavenumber: complex) -> torch.Tensor:
    """Return e^{i k r} / r."""
    return torch.polar(torch.exp(-wavenumber.imag * r) / r, wavenumber.real * r)


def _series(
    between: torch.Tensor, normals: torch.Tensor, kind: torch.Tensor, series: EvenWaves, wavenumber: complex
) -> torch.Tensor:
    """Return sums of even waves (...) of kinds (...) at places (..., 3) from centres; see `EvenWaves`."""
    r = between.norm(dim=-1)
    nearness = 1 / r
    square, cosine = nearness**2, ((between * normals).sum(dim=-1) * nearness) ** 2
    before, wave = -1 - 1j / wavenumber * nearness, torch.ones_like(r).to(torch.complex128)
    lower, legendre = torch.zeros_like(r), torch.ones_like(r)
    total = torch.from_numpy(series.first).to(r.device)[kind] * wave
    far = series.reaches <= float(r.detach().min())
    count = int(np.take_along_axis(series.counts, np.maximum(far.sum(axis=1)[:, None] - 1, 0), axis=1).max())
    steps = torch.from_numpy(series.steps.transpose(1, 2, 0).copy()).to(r.device)
    for step in steps[:count]:
        re, im, beta, gamma, a, b, c, c_re, c_im = step[:, kind] if len(series.first) > 1 else step
        before, wave = wave, (torch.complex(re, im) * square - beta) * wave - gamma * before
        lower, legendre = legendre, (a * cosine - b) * legendre - c * lower
        total = total + torch.complex(c_re, c_im) * (legendre * wave)
    return total * _wave(r, wavenumber)


def along_rim(
    between: torch.Tensor, normals: torch.Tensor, radius: torch.Tensor, wavenumber: complex
) -> torch.Tensor:
    """Return the integral (Q,) along the rim at places (Q, 3) from the centre.

    With tan(u / 2) = e tan(v / 2), e <= 1, equal steps of v are closest next to the place. Their error falls
    as e^(-n s), where the integrand is analytic and moderate for |Im v| < s: up to the nearest point of the
    rim, and up to |Im u| = 1 on the far side.
    """
    place = between.detach()
    height = (place * normals).sum(dim=-1)
    offset = (place - height[:, None] * normals).norm(dim=-1)
    ratio = torch.hypot(height, offset - radius) / torch.hypot(height, offset + radius)
    squeeze = (RIM_STRIP * ratio.clamp(min=RIM_LEAST)).clamp(max=1).sqrt()
    turns = RIM_DIGITS + RIM_TURNS * abs(wavenumber) * torch.minimum(offset, radius)
    levels = torch.log2(turns / (2 * torch.atanh(squeeze / RIM_STRIP))).ceil().to(torch.int64)
    waves = torch.zeros(len(between), **COMPLEX).to(between.device)
    for level in torch.unique(levels).tolist():  # places with as many nodes
        for index in torch.split((levels == level).nonzero()[:, 0], max(1, _AT_ONCE >> level)):
            part = between[index], normals[index], squeeze[index, None], radius[index, None]
            waves = waves.index_put((index,), _by_nodes(*part, 2**level, wavenumber))
    return waves


def _by_nodes(
    between: torch.Tensor,
    normals: torch.Tensor,
    squeeze: torch.Tensor,
    radius: torch.Tensor,
    count: int,
    wavenumber: complex,
) -> torch.Tensor:
    """Return the integral of `along_rim` by so many nodes, which stand still in derivatives."""
    along = (between * normals).sum(dim=-1, keepdim=True)
    aside = between - along * normals
    across = torch.linalg.cross(normals, torch.eye(3, **REAL).to(normals)[normals.abs().argmin(dim=1)])
    off_axis = aside.detach().norm(dim=1, keepdim=True) > LENGTH_TOLERANCE
    towards = torch.where(off_axis, aside.detach(), across)
    towards = towards / towards.norm(dim=1, keepdim=True)
    sideways = torch.linalg.cross(normals, towards)
    angle = math.pi * ((torch.arange(count, **REAL).to(between) + 0.5) / count - 0.5)  # v / 2
    sine, cosine = squeeze * torch.sin(angle), torch.cos(angle)
    size = sine**2 + cosine**2
    weight = squeeze / size * 2 / (count * radius)
    first, second = (cosine**2 - sine**2) / size, 2 * sine * cosine / size
    rim = first[..., None] * towards[:, None] + second[..., None] * sideways[:, None]
    ahead = (aside[:, None] * rim).sum(dim=-1)
    z = along.abs()
    path = (aside**2).sum(dim=-1, keepdim=True) + radius**2 - 2 * radius * ahead  # R^2 - z^2
    both = torch.sqrt(z**2 + path) + z
    half = wavenumber / 2 * path / both
    small = half.abs() < _SMALL
    safe = torch.where(small, 1.0, half)
    sinc = torch.where(small, 1 - half**2 / 6, torch.sin(safe) / safe)
    waves: torch.Tensor = weight * (radius - ahead) / both * sinc * torch.exp(0.5j * wavenumber * both)
    return waves.sum(dim=1)
