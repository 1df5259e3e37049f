"""Translations of spherical waves: outgoing ones around a centre as regular ones around another.

Along z by d, waves of an order m stay of this order:

    h_n(kr) Y_nm = sum_l S_lnm j_l(kr') Y_lm,   S_lnm = 4 pi sum_q i^(l + q - n) h_q(kd) Y_q0(z) I_lnqm.

I is the integral of Y_lm^* Y_nm Y_q0 over all directions (Martin, Multiple Scattering (2006), section 3.7).
Any other shift is one along z between two turns. A turn by an angle about y is one about z between two
quarter turns, which are constant. Waves of degree L thus take O(L^3) operations, and no matrix of a pose.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.linalg import block_diag

from autdtorch.analytic.momentum import gradient_by_place, gradient_by_turn
from autdtorch.analytic.spherical_waves import harmonics, mirrored, orders, turns
from autdtorch.utils.array_types import AnyArray

_AT_ONCE = 64
"""Waves of several degrees that are turned by one product, as small ones take long."""


class WaveFrame(NamedTuple):
    """The frame of waves in B poses, and their largest degree."""

    center: torch.Tensor  # (B, 3) [m]
    axes: torch.Tensor  # columns (B, 3, 3), of one handedness
    degree: int


@dataclass(frozen=True, eq=False)
class Translation:
    """The map of outgoing waves in one frame to regular waves in another, with gradients by both frames.

    Attributes:
        wavenumber: k [rad/m].
        here: the frame of the regular waves.
        there: the frame of the outgoing waves.
        is_conjugate: whether radial functions are conjugated, as in the adjoint.
    """

    wavenumber: complex
    here: WaveFrame
    there: WaveFrame
    is_conjugate: bool = False
    _shared: dict[bool, _Factors] = field(default_factory=dict, repr=False)  # with copies of equal frames

    def applied(self, waves: torch.Tensor) -> torch.Tensor:
        """Return the coefficients (N, B, R) of regular waves, from those of outgoing ones (K, B, R)."""
        (center, axes, degree), (other_center, other_axes, _) = self.here, self.there
        regular: torch.Tensor = _Translated.apply(waves, center, axes, other_center, other_axes, self)  # type: ignore[no-untyped-call]
        return regular[: (degree + 1) ** 2]

    @property
    def adjoint(self) -> Translation:
        """The adjoint map: a translation back, with conjugate radial functions, as turns are unitary."""
        return Translation(self.wavenumber, self.there, self.here, not self.is_conjugate, self._shared)

    @property
    def factors(self) -> _Factors:
        """Its factors, up to a degree more here, from which `_Translated` takes the gradient."""
        if self.is_conjugate not in self._shared:
            with torch.no_grad():
                self._shared[self.is_conjugate] = _Factors.of(self)
        return self._shared[self.is_conjugate]


class _Translated(torch.autograd.Function):
    """Regular waves (N, B, R) with a degree more, whose gradient is left out."""

    @staticmethod
    def forward(
        waves: torch.Tensor,
        center: torch.Tensor,
        axes: torch.Tensor,
        other_center: torch.Tensor,
        other_axes: torch.Tensor,
        translation: Translation,
    ) -> torch.Tensor:
        return translation.factors.applied(waves.detach())

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: torch.Tensor) -> None:
        waves, _, _, _, _, ctx.translation = inputs
        ctx.save_for_backward(waves, output)

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        (waves, regular), translation = ctx.saved_tensors, ctx.translation
        here, there = translation.here, translation.there
        gradient = gradient[: (here.degree + 1) ** 2]
        by_waves = translation.adjoint.applied(gradient)
        by_place = by_turn = by_other_place = by_other_turn = None
        _, *needed = ctx.needs_input_grad[:5]
        if any(needed[:3]) and torch.is_grad_enabled():  # for derivatives of the gradient
            more = translation.wavenumber, _with_next_degree(here), there, translation.is_conjugate
            regular = Translation(*more).applied(waves)
        weights = gradient.movedim(0, -2)
        if needed[0] or needed[2]:
            wavenumber = complex(translation.wavenumber)
            wavenumber = wavenumber.conjugate() if translation.is_conjugate else wavenumber
            by_place = gradient_by_place(wavenumber, here.axes, regular.movedim(0, -2), weights)
            by_other_place = -by_place
        if needed[1]:
            by_turn = gradient_by_turn(here.axes, regular.movedim(0, -2), weights)
        if needed[3]:
            by_other_turn = -gradient_by_turn(there.axes, waves.movedim(0, -2), by_waves.movedim(0, -2))
        return by_waves, by_place, by_turn, by_other_place, by_other_turn, None


class _Turn(NamedTuple):
    """The turn to a frame from one whose z has another direction, up to a phase that the way back takes away.

    It is `around` Q `tilt` Q^T with the quarter turns Q, and phases (N, B, 1) of all waves.
    """

    around: torch.Tensor
    tilt: torch.Tensor


class _Factors(NamedTuple):
    """A translation in factors: a turn, a shift along z by blocks (B, C) of all orders, and a turn back."""

    here: _Turn
    there: _Turn  # its conjugate, back
    twist: torch.Tensor  # about z, between both (K, B, 1)
    blocks: torch.Tensor
    degrees: tuple[int, int]
    are_left_handed: tuple[bool, bool]

    @classmethod
    def of(cls, translation: Translation) -> _Factors:
        """Compute the factors of a translation to a frame with a degree more."""
        here, there = _with_next_degree(translation.here), translation.there
        shift = here.center - there.center
        distance = torch.linalg.vector_norm(shift, dim=-1)
        parts = [_turn(frame, shift / distance[:, None]) for frame in (here, there)]
        (turn, across, is_left), (other_turn, other_across, is_other_left) = parts
        twist = torch.einsum("bij,bi->jb", across, other_across[..., 0])
        degrees = here.degree, there.degree
        radial = torch.view_as_real(_outgoing_radial(sum(degrees), translation.wavenumber * distance))
        along = _along_z(*degrees)
        real, imaginary = (part.mT @ along.terms for part in radial.unbind(dim=-1))
        return cls(
            turn,
            _Turn(*(each.conj().resolve_conj() for each in other_turn)),
            _phases(orders(there.degree)[along.others], torch.atan2(twist[1], twist[0])),
            torch.complex(real, -imaginary if translation.is_conjugate else imaginary),
            degrees,
            (is_left, is_other_left),
        )

    def applied(self, waves: torch.Tensor) -> torch.Tensor:
        """Return regular waves (N, B, R) of outgoing ones (K, B, R)."""
        is_left, is_other_left = self.are_left_handed
        waves = (_opposite(waves) if is_other_left else waves).contiguous() * self.there.around
        waves = self._shifted(_tilted(waves, self.there.tilt))
        waves = _tilted(waves, self.here.tilt).mul_(self.here.around)
        return _opposite(waves) if is_left else waves

    def _shifted(self, waves: torch.Tensor) -> torch.Tensor:
        """Return waves after the twist and the shift along z."""
        along, (poses, columns) = _along_z(*self.degrees), waves.shape[1:]
        sorted_waves = (waves[along.others] * self.twist).movedim(1, 0).contiguous()
        parts, begin = [], 0
        for block, (rows, others, sides) in along.orders:
            part = sorted_waves[:, begin : begin + others * sides].reshape(poses, others, -1)
            shifted = self.blocks[:, block].reshape(poses, rows, others) @ part
            parts.append(shifted.reshape(poses, -1, columns))
            begin += others * sides
        parts.append(waves.new_zeros(poses, 1, columns))  # of orders above those of the waves
        return torch.cat(parts, dim=1).movedim(1, 0)[along.rows]


def _with_next_degree(frame: WaveFrame) -> WaveFrame:
    return frame._replace(degree=frame.degree + 1)


def _opposite(waves: torch.Tensor) -> torch.Tensor:
    """Return waves (N, B, R) of opposite orders, as mirrored axes make them."""
    place, sign = mirrored(math.isqrt(len(waves)) - 1)
    return sign[:, None, None] * waves[place]


def _turn(frame: WaveFrame, along: torch.Tensor) -> tuple[_Turn, torch.Tensor, bool]:
    """Return the turn from a frame whose z is `along` (B, 3), its x and y (B, 3, 2), and the handedness."""
    is_left = bool(torch.linalg.det(frame.axes[0]) < 0)
    axes = frame.axes * frame.axes.new_tensor([1.0, -1.0 if is_left else 1.0, 1.0])
    x, y, z = (axes.mT @ along[..., None])[..., 0].unbind(dim=-1)
    around, tilt = torch.atan2(y, x), torch.atan2(torch.hypot(x, y), z)
    none = torch.zeros_like(x)
    first = torch.stack([around.cos() * tilt.cos(), around.sin() * tilt.cos(), -tilt.sin()], dim=-1)
    second = torch.stack([-around.sin(), around.cos(), none], dim=-1)
    across = axes @ torch.stack([first, second], dim=-1)
    every = orders(frame.degree)
    return _Turn(_phases(every, around + math.pi / 2), _phases(every, tilt)), across, is_left


def _phases(order: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """Return e^(-i m angle) (n, B, 1) of orders (n,)."""
    every = torch.arange(-int(order.max()), int(order.max()) + 1, dtype=torch.int64, device="cpu")
    phase = -every[:, None] * angle
    return torch.polar(torch.ones_like(phase), phase)[order - every[0], :, None]


def _tilted(waves: torch.Tensor, tilt: torch.Tensor) -> torch.Tensor:
    """Return Q `tilt` Q^T of waves (N, B, R), with the phases (N, B, 1) of the tilt."""
    middle, result = torch.empty_like(waves), torch.empty_like(waves)
    for rows, quarter in _quarter_turns(math.isqrt(len(waves)) - 1):
        torch.mm(quarter.mT, _real_columns(waves[rows]), out=_real_columns(middle[rows]))
        middle[rows] *= tilt[rows]
        torch.mm(quarter, _real_columns(middle[rows]), out=_real_columns(result[rows]))
    return result


def _real_columns(waves: torch.Tensor) -> torch.Tensor:
    """Return a view of waves (N, B, R) as real numbers (N, 2 B R)."""
    return torch.view_as_real(waves).view(len(waves), -1)


@functools.lru_cache(8)
@torch.inference_mode(False)
@torch.no_grad()
def _quarter_turns(degree: int) -> list[tuple[slice, torch.Tensor]]:
    """Return the rows and the turn Q (n, n) of a few degrees each; it brings z to x about y, and is real."""
    axes = torch.tensor(
        [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]], dtype=torch.float64, device="cpu"
    )
    blocks, result, begin = turns(degree, axes), list[tuple[slice, torch.Tensor]](), 0
    while blocks:
        few = max(1, int((np.cumsum([len(block) for block in blocks]) <= _AT_ONCE).sum()))
        joined = torch.from_numpy(block_diag(*(block.real.numpy() for block in blocks[:few])))
        result.append((slice(begin, begin + len(joined)), joined))
        begin, blocks = begin + len(joined), blocks[few:]
    return result


def _outgoing_radial(degree: int, x: torch.Tensor) -> torch.Tensor:
    """Return h_l(x) (L + 1, B) of the first kind."""
    inverse = 1 / x.to(torch.complex128)
    rows = [torch.exp(1j * x) * inverse / 1j]
    rows.append(rows[0] * (inverse - 1j))
    for n in range(1, degree):
        rows.append((2 * n + 1) * inverse * rows[-1] - rows[-2])
    return torch.stack(rows[: degree + 1])


class _AlongZ(NamedTuple):
    """Shifts along z, of waves sorted by m, l and the sign of m.

    Attributes:
        terms: of h_q in all S_lnm with m >= 0 (Q, C).
        orders: for each m, its part of C, the numbers of l and n, and of signs: 1 or 2.
        rows: place of each wave of the result among those sorted, or behind them, where none comes (N,).
        others: waves in this order (K,).
    """

    terms: torch.Tensor
    orders: list[tuple[slice, tuple[int, int, int]]]
    rows: torch.Tensor
    others: torch.Tensor


@functools.lru_cache(8)
@torch.inference_mode(False)
@torch.no_grad()
def _along_z(degree: int, other: int) -> _AlongZ:
    """Return the shifts of outgoing waves up to the degree `other`."""
    nodes, weights = np.polynomial.legendre.leggauss(degree + other + 1)
    across, most = np.sqrt(1 - nodes**2), degree + other
    values = harmonics(most, torch.from_numpy(np.stack([across, 0 * nodes, nodes], axis=1))).real.numpy()
    q = np.arange(most + 1)
    zonal = 4 * math.pi**1.5 * weights[:, None] * values[:, q * q + q] * np.sqrt(2 * q + 1)
    every, sizes, begin = list[AnyArray](), [], 0
    rows, others = list[AnyArray](), list[AnyArray]()
    for m in range(min(degree, other) + 1):
        n, k = np.arange(m, degree + 1), np.arange(m, other + 1)
        products = values[:, n * n + n + m, None] * values[:, None, k * k + k + m]
        terms = (zonal.T @ products.reshape(len(nodes), -1)).reshape(len(q), len(n), len(k))
        power = q[:, None, None] + n[:, None] - k
        connected = (power % 2 == 0) & (abs(n[:, None] - k) <= q[:, None, None]) & (power <= 2 * n[:, None])
        every.append(np.where(connected, (1 - power % 4) * terms, 0.0).reshape(len(q), -1))
        signs = np.array([m, -m] if m else [0])
        for places, each in ((rows, n), (others, k)):
            places.append(((each * each + each)[:, None] + signs).ravel())
        sizes.append((slice(begin, begin + len(n) * len(k)), (len(n), len(k), len(signs))))
        begin += len(n) * len(k)
    sorted_rows = np.concatenate(rows)
    place = np.full((degree + 1) ** 2, len(sorted_rows))
    place[sorted_rows] = np.arange(len(sorted_rows))
    terms = np.concatenate(every, axis=1)
    return _AlongZ(
        torch.from_numpy(terms), sizes, torch.from_numpy(place), torch.from_numpy(np.concatenate(others))
    )
