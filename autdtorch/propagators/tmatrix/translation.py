"""Translations of spherical waves: outgoing ones around a centre as regular ones around another.

Along z by d, waves of an order m stay of this order:

    h_n(kr) Y_nm = sum_l S_lnm j_l(kr') Y_lm,   S_lnm = 4 pi sum_q i^(l + q - n) h_q(kd) Y_q0(z) I_lnqm.

I is the integral of Y_lm^* Y_nm Y_q0 over all directions (Martin, Multiple Scattering (2006), section 3.7).
Any other shift is one along z between two turns. A turn by an angle about y is one about z between two
quarter turns, which are constant. Waves of degree L thus take O(L^3) operations, and no matrix of a pose.
Each column of waves passes all of them in `translation_kernel`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch

from autdtorch.analytic.momentum import gradient_by_place, gradient_by_turn
from autdtorch.analytic.spherical_waves import harmonics, mirrored, outgoing_radial, turns
from autdtorch.utils.array_types import REAL
from autdtorch.utils.process import cached_tensors


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
        weight: factor of all, as of an image.
        is_conjugate: whether radial functions are conjugated, as in the adjoint.
    """

    wavenumber: complex
    here: WaveFrame
    there: WaveFrame
    weight: complex = 1.0
    is_conjugate: bool = False
    _shared: dict[bool, _Factors] = field(default_factory=dict, repr=False)  # with copies of equal frames

    def applied(self, waves: torch.Tensor) -> torch.Tensor:
        """Return the coefficients (N, B, R) of regular waves, from those of outgoing ones (K, B, R)."""
        (center, axes, degree), (other_center, other_axes, _) = self.here, self.there
        tensors = waves, center, axes, other_center, other_axes
        regular: torch.Tensor
        if torch.is_grad_enabled() or any(map(_has_tangent, tensors)):
            alone = replace(self, weight=1.0)
            regular = _Translated.apply(*tensors, alone)  # type: ignore[no-untyped-call]
        else:  # much quicker for few waves
            regular = self.factors.applied(waves)
        regular = regular[: (degree + 1) ** 2]
        return regular if self.weight == 1 else self.weight * regular

    @property
    def adjoint(self) -> Translation:
        """The adjoint map: a translation back, with conjugate radial functions, as turns are unitary."""
        weight, is_conjugate = complex(self.weight).conjugate(), not self.is_conjugate
        return Translation(self.wavenumber, self.there, self.here, weight, is_conjugate, self._shared)

    @property
    def factors(self) -> _Factors:
        """Its factors, up to a degree more here, from which `_Translated` takes the gradient."""
        if self.is_conjugate not in self._shared:
            with torch.no_grad():
                self._shared[self.is_conjugate] = _Factors.of(self)
        return self._shared[self.is_conjugate]


def _has_tangent(tensor: torch.Tensor) -> bool:
    return torch.autograd.forward_ad.unpack_dual(tensor).tangent is not None  # type: ignore[no-untyped-call]


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
            more = translation.wavenumber, _with_next_degree(here), there, 1.0, translation.is_conjugate
            regular = Translation(*more).applied(waves)
        if needed[0] or needed[2]:
            wavenumber = complex(translation.wavenumber)
            wavenumber = wavenumber.conjugate() if translation.is_conjugate else wavenumber
            by_place = gradient_by_place(wavenumber, here.axes, regular, gradient, dim=0)
            by_other_place = -by_place
        if needed[1]:
            by_turn = gradient_by_turn(here.axes, regular, gradient, dim=0)
        if needed[3]:
            by_other_turn = -gradient_by_turn(there.axes, waves, by_waves, dim=0)
        return by_waves, by_place, by_turn, by_other_place, by_other_turn, None


class _Factors(NamedTuple):
    """A translation in factors: a turn, a shift along z, and a turn back; see `translate`.

    Attributes:
        turns: numbers of five turns about z (2, 5, M + 1, P) in P poses.
        shifts: along z (2, C, P).
        size: N, of the waves that come out.
        are_left_handed: whether the frames of the regular and of the outgoing waves are.
    """

    turns: torch.Tensor
    shifts: torch.Tensor
    size: int
    are_left_handed: tuple[bool, bool]

    @classmethod
    def of(cls, translation: Translation) -> _Factors:
        """Compute the factors of a translation to a frame with a degree more."""
        here, there = _with_next_degree(translation.here), translation.there
        shift = here.center - there.center
        distance = torch.linalg.vector_norm(shift, dim=-1)
        parts = [_turn(frame, shift / distance[:, None]) for frame in (here, there)]
        (around, tilt, across, is_left), (other_around, other_tilt, other_across, is_other_left) = parts
        twist = torch.einsum("bij,bi->jb", across, other_across[..., 0])
        angles = torch.stack([-other_around, -other_tilt, torch.atan2(twist[1], twist[0]), tilt, around])
        angles[:-1] += math.pi  # a quarter turn back is one between two half turns about z
        degrees = here.degree, there.degree
        every = torch.arange(max(degrees) + 1, **REAL)[:, None] * _padded(angles)[:, None]
        radial = torch.view_as_real(outgoing_radial(sum(degrees), translation.wavenumber * distance))
        shifts = _shifts_along_z(*degrees) @ _padded(radial.movedim(-1, 0).contiguous())
        if translation.is_conjugate:
            shifts[1].neg_()
        turns = torch.stack([every.cos(), -every.sin()])
        return cls(turns, shifts, (here.degree + 1) ** 2, (is_left, is_other_left))

    def applied(self, waves: torch.Tensor) -> torch.Tensor:
        """Return regular waves (N, B, R) of outgoing ones (K, B, R)."""
        from autdtorch.propagators.tmatrix.translation_kernel import translate  # loads numba

        is_left, is_other_left = self.are_left_handed
        columns = waves.shape[1:]
        lanes = (columns[1], 1) if columns[0] == 1 else columns  # columns of one pose make vectors, too
        waves = _opposite(waves) if is_other_left else waves
        waves = waves.reshape(len(waves), *lanes).contiguous().resolve_conj()
        regular = waves.new_empty(self.size, *lanes)
        quarters = _quarters(self.turns.shape[2] - 1)
        factors = (each.numpy() for each in (self.turns, self.shifts, quarters))
        translate(torch.view_as_real(waves).numpy(), *factors, torch.view_as_real(regular).numpy())
        regular = regular.reshape(self.size, *columns)
        return _opposite(regular) if is_left else regular


def _padded(values: torch.Tensor) -> torch.Tensor:
    """Return values (..., P) of whole vectors of poses, of values (..., B); the last pose is repeated."""
    from autdtorch.propagators.tmatrix.translation_kernel import LANES  # loads numba

    more = -values.shape[-1] % LANES
    return torch.cat([values, values[..., -1:].expand(*values.shape[:-1], more)], dim=-1)


def _with_next_degree(frame: WaveFrame) -> WaveFrame:
    return frame._replace(degree=frame.degree + 1)


def _opposite(waves: torch.Tensor) -> torch.Tensor:
    """Return waves (N, B, R) of opposite orders, as mirrored axes make them."""
    place, sign = mirrored(math.isqrt(len(waves)) - 1)
    return sign[:, None, None] * waves[place]


def _turn(frame: WaveFrame, along: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, bool]:
    """Return the turn to a frame from one whose z is `along` (B, 3).

    Its angles (B,) about z and between quarter turns, the x and y (B, 3, 2) of the latter, and whether the
    frame is left-handed.
    """
    is_left = bool(torch.linalg.det(frame.axes[0]) < 0)
    axes = frame.axes * frame.axes.new_tensor([1.0, -1.0 if is_left else 1.0, 1.0])
    x, y, z = (axes.mT @ along[..., None])[..., 0].unbind(dim=-1)
    around, tilt = torch.atan2(y, x), torch.atan2(torch.hypot(x, y), z)
    none = torch.zeros_like(x)
    first = torch.stack([around.cos() * tilt.cos(), around.sin() * tilt.cos(), -tilt.sin()], dim=-1)
    second = torch.stack([-around.sin(), around.cos(), none], dim=-1)
    return around + math.pi / 2, tilt, axes @ torch.stack([first, second], dim=-1), is_left


@cached_tensors(8)
def _quarters(degree: int) -> torch.Tensor:
    """Return a quarter of the real turn that brings z to x about y, flat: of each degree l, (l + 1, l + 1).

    Entries at the orders (m, -n) are (-1)^(l + m) times those at (m, n), and those at (-m, n) are
    (-1)^(l + n) times them. So columns are for sums and differences of opposite orders, even l + n first.
    """
    axes = torch.tensor(
        [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]], dtype=torch.float64, device="cpu"
    )
    parts = []
    for n, each in enumerate(turns(degree, axes)):
        upper = each.real[n:, n:].clone()
        upper[:, 0] /= 2  # as the order 0 is added to itself
        parts.append(torch.cat([upper.flip(1)[:, side::2] for side in (0, 1)], dim=1).flatten())
    return torch.cat(parts)


@cached_tensors(8)
def _shifts_along_z(degree: int, other: int) -> torch.Tensor:
    """Return the terms (C, Q) of h_q in S_lnm by m, l and n, for outgoing waves up to the degree `other`."""
    nodes, weights = np.polynomial.legendre.leggauss(degree + other + 1)
    across, most = np.sqrt(1 - nodes**2), degree + other
    values = harmonics(most, torch.from_numpy(np.stack([across, 0 * nodes, nodes], axis=1))).real.numpy()
    q = np.arange(most + 1)
    zonal = 4 * math.pi**1.5 * weights[:, None] * values[:, q * q + q] * np.sqrt(2 * q + 1)
    every = []
    for m in range(min(degree, other) + 1):
        n, k = np.arange(m, degree + 1)[:, None], np.arange(m, other + 1)
        products = values[:, n * n + n + m] * values[:, None, k * k + k + m]
        terms = np.tensordot(products, zonal, axes=(0, 0))
        power = q + (n - k)[..., None]
        connected = (power % 2 == 0) & (abs(n - k)[..., None] <= q) & (power <= 2 * n[..., None])
        every.append(np.where(connected, (1 - power % 4) * terms, 0.0).reshape(-1, len(q)))
    return torch.from_numpy(np.concatenate(every))
