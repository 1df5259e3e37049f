"""Spherical waves: regular j_l(kr) Y_lm, and outgoing h_l(kr) Y_lm, with e^(-i w t).

The N = (L + 1)^2 waves up to the degree L are in the order (l, m), m from -l to l. With them,

    e^(ik|r - s|) / |r - s| = 4 pi i k sum j_l(kr) Y_lm(r) h_l(ks) Y_lm(s)*,    |r| < |s|

(Martin, Multiple Scattering (2006), chapter 3). A turn of the axes maps the harmonics of each degree onto
themselves; the map is fitted to their values at a few directions.
"""

from __future__ import annotations

import cmath
import math
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.special import spherical_jn, spherical_yn

from autdtorch.scene.geometry import sphere_points
from autdtorch.utils.array_types import COMPLEX, REAL, AnyArray, ComplexArray
from autdtorch.utils.process import cached_tensors

_TINY = 1e-12  # distance from the centre [m] below which a point has the direction z

_SAMPLES = 2
"""Directions for each harmonic of the highest degree, by which a turn is found."""


def degrees(degree: int) -> torch.Tensor:
    """Return the degree l of each wave (N,), int64."""
    every = torch.arange(degree + 1, dtype=torch.int64, device="cpu")
    return every.repeat_interleave(2 * every + 1)


def orders(degree: int) -> torch.Tensor:
    """Return the order m of each wave (N,), int64."""
    every = degrees(degree)
    return torch.arange(len(every), dtype=torch.int64, device="cpu") - every.square() - every


def mirrored(degree: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the place of each wave (l, m) at (l, -m), and the sign (-1)^m, (N,) each."""
    every, order = degrees(degree), orders(degree)
    return every.square() + every - order, 1.0 - 2.0 * (order % 2)


def real_waves(degree: int) -> torch.Tensor:
    """Return the unitary matrix (N, N) from waves with real harmonics, one a column, to waves.

    For m > 0, column (l, m) has cos(m phi), and column (l, -m) has sin(m phi).
    """
    order, (place, sign) = orders(degree), mirrored(degree)
    mixing = torch.zeros(len(order), len(order), **COMPLEX)
    for wave, m in enumerate(order.tolist()):
        half = torch.tensor(math.sqrt(0.5) * (1 if m > 0 else 1j), dtype=mixing.dtype, device="cpu")
        mixing[wave, wave] = half if m else 1.0
        if m:
            mixing[place[wave], wave] = sign[wave] * half.conj()
    return mixing


def parities(degree: int) -> torch.Tensor:
    """Return whether each of the `real_waves` is odd in x, y and z: 0 or 1 (N, 3), int64."""
    order = orders(degree)
    sine = (order < 0).to(torch.int64)
    return torch.stack([(order.abs() + sine) % 2, sine, (degrees(degree) + order) % 2], dim=1)


def harmonics(degree: int, directions: torch.Tensor) -> torch.Tensor:
    """Return the spherical harmonics Y_lm (..., N) of unit vectors (..., 3), differentiable in these.

    Orthonormal, with the phase of Condon and Shortley. P_lm / sin^m and (x + iy)^m have no singular angles.
    """
    table = _recurrence(degree)
    z = directions[..., 2, None]
    turn = torch.complex(directions[..., 0], directions[..., 1])[..., None]
    powers = torch.cumprod(
        torch.cat([torch.ones_like(turn), turn.expand(*turn.shape[:-1], degree)], dim=-1), dim=-1
    )
    rows = [z.new_full(z.shape, table.tops[0])]  # P_lm / sin^m of m = 0 to l
    for n in range(1, degree + 1):
        above = z * rows[-1]
        if n > 1:
            above = torch.cat([above[..., :-1] - table.back[n] * rows[-2], above[..., -1:]], dim=-1)
        rows.append(torch.cat([table.factor[n] * above, z.new_full(z.shape, table.tops[n])], dim=-1))
    upper = torch.cat(rows, dim=-1) * powers[..., table.order]
    return torch.cat([upper, upper.conj()], dim=-1)[..., table.place] * table.sign


@cached_tensors(8)
def sphere_rule(rings: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return nodes (S, 3) on the unit sphere and weights (S,) that integrate waves up to 2 * rings - 1."""
    z, weight = np.polynomial.legendre.leggauss(rings)
    angle = math.pi / rings * np.arange(2 * rings)
    across = np.sqrt(1 - z**2)[:, None]
    nodes = np.stack(np.broadcast_arrays(across * np.cos(angle), across * np.sin(angle), z[:, None]), axis=-1)
    weights = np.repeat(weight * math.pi / rings, 2 * rings)
    return torch.from_numpy(nodes.reshape(-1, 3)), torch.from_numpy(weights)


@cached_tensors(4)  # of a body of 0.1 m each takes 100 MB
def to_harmonics(degree: int, rings: int) -> torch.Tensor:
    """Return the map (S, N) from values at the nodes of a `sphere_rule` to coefficients of harmonics."""
    nodes, weights = sphere_rule(rings)
    return weights[:, None] * harmonics(degree, nodes).conj()


class _Recurrence(NamedTuple):
    """Factors of P_lm / sin^m, and the places of the harmonics of all m among those of m >= 0."""

    factor: list[torch.Tensor]  # of z P_(l-1)m, for m = 0 to l - 1
    back: list[torch.Tensor]  # of P_(l-2)m before that factor, for m = 0 to l - 2
    tops: list[float]  # P_ll / sin^l
    order: torch.Tensor  # m of each pair l, m >= 0
    place: torch.Tensor  # (N,) among these pairs, then their conjugates
    sign: torch.Tensor  # (N,)


@cached_tensors(8)
def _recurrence(degree: int) -> _Recurrence:
    none = torch.zeros(0, **REAL)
    factor, back, tops = [none], [none], [math.sqrt(1 / (4 * math.pi))]
    for n in range(1, degree + 1):
        m = torch.arange(n, **REAL)
        factor.append(((4 * n * n - 1) / (n * n - m * m)).sqrt())
        m = m[:-1]
        back.append((((n - 1) ** 2 - m * m) / (4 * (n - 1) ** 2 - 1)).sqrt())
        tops.append(-tops[-1] * math.sqrt((2 * n + 1) / (2 * n)))
    pairs = (degree + 1) * (degree + 2) // 2
    every, m = degrees(degree), orders(degree)
    place = every * (every + 1) // 2 + m.abs()
    order = torch.cat([torch.arange(n + 1, dtype=torch.int64, device="cpu") for n in range(degree + 1)])
    sign = torch.where(m < 0, mirrored(degree)[1], 1.0).to(torch.float64)
    return _Recurrence(factor, back, tops, order, torch.where(m < 0, place + pairs, place), sign)


def outgoing_waves(
    degree: int, wavenumber: complex, offsets: torch.Tensor, conjugate: bool = False
) -> torch.Tensor:
    """Return h_l(kr) Y_lm (..., N) at offsets (..., 3) [m] from the centre, differentiable in these.

    With `conjugate`, Y_lm is conjugated and h_l is not.
    """
    settings = degree, complex(wavenumber), conjugate
    waves: torch.Tensor = _Outgoing.apply(offsets.reshape(-1, 3), *settings)  # type: ignore[no-untyped-call]
    return waves.mT.reshape(*offsets.shape[:-1], -1)


class _Outgoing(torch.autograd.Function):
    """Outgoing waves (N, P), whose derivatives are waves of the neighbouring degrees."""

    @staticmethod
    def forward(offsets: torch.Tensor, degree: int, wavenumber: complex, conjugate: bool) -> torch.Tensor:
        return torch.from_numpy(_outgoing(degree, wavenumber, offsets.detach().numpy(), conjugate))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: torch.Tensor) -> None:
        offsets, *ctx.settings = inputs
        ctx.save_for_backward(offsets)
        ctx.save_for_forward(offsets)

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        slopes = _slopes(ctx.saved_tensors[0], *ctx.settings)
        parts = [(gradient.mT.conj() * slope).sum(dim=1).real for slope in slopes]
        return torch.stack(parts, dim=1), None, None, None

    @staticmethod
    def jvp(ctx: Any, tangent: torch.Tensor, *_: None) -> torch.Tensor:
        slopes = _slopes(ctx.saved_tensors[0], *ctx.settings)
        parts = zip(tangent.unbind(dim=1), slopes, strict=True)
        return torch.stack([(part[:, None] * slope).mT for part, slope in parts]).sum(dim=0)

    @staticmethod
    def vmap(
        _: Any, dims: tuple[int | None, ...], offsets: torch.Tensor, *settings: Any
    ) -> tuple[torch.Tensor, int | None]:
        if dims[0] is None:
            return _Outgoing.apply(offsets, *settings), None  # type: ignore[no-untyped-call]
        batch = offsets.movedim(dims[0], 0)
        waves = _Outgoing.apply(batch.reshape(-1, 3), *settings)  # type: ignore[no-untyped-call]
        return waves.reshape(len(waves), *batch.shape[:2]), 1


def _outgoing(degree: int, wavenumber: complex, offsets: AnyArray, conjugate: bool) -> ComplexArray:
    """Return the waves (N, P) at offsets (P, 3); the recurrences are those of `harmonics`."""
    table = _recurrence(degree)
    distance = np.sqrt(np.einsum("pc,pc->p", offsets, offsets))
    x, y, z = offsets.T / distance
    turn = np.ones((degree + 1, len(z)), np.complex128)
    turn[1:] = x - 1j * y if conjugate else x + 1j * y
    np.cumprod(turn, axis=0, out=turn)
    inverse = 1 / (wavenumber * distance)
    before, radial = 0.0 * turn[0], np.exp(1j * wavenumber * distance) * inverse / 1j
    waves = np.empty(((degree + 1) ** 2, len(z)), np.complex128)
    last = legendre = np.zeros((0, len(z)))  # P_lm / sin^m of m = 0 to l
    for n in range(degree + 1):
        above = z * legendre
        above[: n - 1] -= table.back[n].numpy()[:, None] * last
        above *= table.factor[n].numpy()[:, None]
        last, legendre = legendre, np.concatenate([above, np.full((1, len(z)), table.tops[n])])
        upper = legendre * turn[: n + 1]
        middle = n * n + n
        np.multiply(upper, radial, out=waves[middle : middle + n + 1])
        lower = waves[n * n : middle][::-1]
        np.multiply(upper[1:].conj(), radial, out=lower)
        np.negative(lower[::2], out=lower[::2])
        rising = (2 * n + 1) * inverse * radial - before if n else radial * (inverse - 1j)
        before, radial = radial, rising
    return waves


def _slopes(
    offsets: torch.Tensor, degree: int, wavenumber: complex, conjugate: bool
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return the derivatives (P, N) of outgoing waves by x, y and z, of the waves with a degree more."""
    waves = outgoing_waves(degree + 1, wavenumber, offsets, conjugate)
    up, down, along = (
        (factor[:, 0] * waves[:, place[:, 0]] + factor[:, 1] * waves[:, place[:, 1]]) * wavenumber
        for place, factor in ladder(degree)
    )
    if conjugate:  # d/dx - i d/dy of Y_lm^* are neighbours of m + 1
        up, down = down, up
    return (up + down) / 2, (up - down) / 2j, along


@cached_tensors(8)
def ladder(degree: int) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Return the places (N, 2) of neighbours and their factors, for d/dx + i d/dy, d/dx - i d/dy and d/dz.

    Martin, Multiple Scattering (2006), section 3.7. Factors over k.
    """
    n, m = degrees(degree).to(torch.float64), orders(degree).to(torch.float64)
    upward, downward = 1 / ((2 * n + 1) * (2 * n + 3)), 1 / (4 * n * n - 1).abs()
    rise = [(n + m + 2) * (n + m + 1), (n - m + 2) * (n - m + 1), (n + 1) ** 2 - m * m]
    fall = [(n - m) * (n - m - 1), (n + m) * (n + m - 1), n * n - m * m]
    signs = ((1, 1), (-1, -1), (-1, 1))
    result = []
    for step, above, below, (one, other) in zip((1, -1, 0), rise, fall, signs, strict=True):
        factor = torch.stack([one * (above * upward).sqrt(), other * (below * downward).sqrt()], dim=1)
        order = orders(degree) + step
        neighbours = [degrees(degree) + 1, degrees(degree) - 1]
        place = torch.stack([each * each + each + order for each in neighbours], dim=1)
        result.append((torch.where(factor != 0, place, 0), factor))
    return result


def regular_waves(degree: int, wavenumber: complex, offsets: torch.Tensor) -> torch.Tensor:
    """Return j_l(kr) Y_lm (P, N) at offsets (P, 3) [m] from the centre."""
    distance = torch.linalg.vector_norm(offsets, dim=-1, keepdim=True)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=offsets.dtype, device="cpu")
    angular = harmonics(degree, torch.where(distance > _TINY, offsets / distance.clamp_min(_TINY), up))
    return regular_radial(degree, wavenumber * distance) * angular


def regular_radial(degree: int, x: torch.Tensor) -> torch.Tensor:
    """Return j_l(x) (P, N) of all waves at x = k r (P, 1)."""
    return torch.from_numpy(spherical_jn(np.arange(degree + 1), x.numpy()))[:, degrees(degree)]


def outgoing_radial(degree: int, x: torch.Tensor) -> torch.Tensor:
    """Return h_l(x) (L + 1, B) of the first kind."""
    inverse = 1 / x.to(torch.complex128)
    rows = [torch.exp(1j * x) * inverse / 1j]
    rows.append(rows[0] * (inverse - 1j))
    for n in range(1, degree):
        rows.append((2 * n + 1) * inverse * rows[-1] - rows[-2])
    return torch.stack(rows[: degree + 1])


def sphere_coefficients(
    degree: int,
    size: complex,
    density_ratio: complex = math.inf,
    speed_ratio: complex = 1.0,
    impedance: complex | None = None,
) -> ComplexArray:
    """Return b_l / d_l (L + 1,) of a sphere of size ka, for incoming d_l j_l Y_lm and outgoing b_l h_l Y_lm.

    Args:
        degree: L.
        size: k a, complex in a medium that absorbs.
        density_ratio: density ratio, sphere over medium; infinite if rigid.
        speed_ratio: ratio of sound speeds, sphere over medium: k over the wavenumber inside.
        impedance: of the surface, as a ratio to w density / k of the medium, in place of both ratios.
    """
    order = np.arange(degree + 1)
    regular, slope = spherical_jn(order, size), spherical_jn(order, size, derivative=True)
    out = regular + 1j * spherical_yn(order, size)
    out_slope = slope + 1j * spherical_yn(order, size, derivative=True)
    inner: AnyArray = np.zeros(degree + 1)  # dp/d(kr) over p on the surface
    if impedance is not None:  # the velocity into the surface is p / impedance
        inner = inner - 1j / impedance
    elif not cmath.isinf(density_ratio):
        inner = bessel_slopes(torch.from_numpy(np.asarray(size / speed_ratio)), degree).numpy()
        inner = inner / (density_ratio * speed_ratio)
    return np.asarray(-(slope - regular * inner) / (out_slope - out * inner), np.complex128)


def bessel_slopes(x: torch.Tensor, orders: int) -> torch.Tensor:
    """Return j_n'(x) / j_n(x), (orders + 1, *x.shape), by downward recurrence of j_{n-1} / j_n."""
    largest = float(x.abs().max())
    start = math.ceil(max(orders, largest) + 8 * math.cbrt(largest)) + 32
    ratio = (2 * start + 1) / x
    ratios = []
    for n in range(start - 1, -1, -1):
        ratio = (2 * n + 1) / x - 1 / ratio
        if n <= orders:
            ratios.append(ratio)
    return torch.stack(ratios[::-1]) - (order_column(x, orders) + 1) / x


def order_column(x: torch.Tensor, orders: int) -> torch.Tensor:
    """Return the orders 0 to `orders`, (orders + 1, 1, ...), for broadcasting with x."""
    return torch.arange(orders + 1, dtype=torch.float64, device=x.device).reshape(-1, *[1] * x.ndim)


def turns(degree: int, turn: torch.Tensor) -> list[torch.Tensor]:
    """Return the map R (..., 2 l + 1, 2 l + 1) of the harmonics of each degree, Y' = Y R, differentiable.

    Y' are those along other axes, the columns of `turn` (..., 3, 3) in the coordinates of Y. Their
    handedness may differ.
    """
    directions, inverses = _directions(degree)
    after = harmonics(degree, directions @ turn)
    return [inverse @ after[..., n * n : (n + 1) ** 2] for n, inverse in enumerate(inverses)]


def turned(waves: torch.Tensor, maps: list[torch.Tensor]) -> torch.Tensor:
    """Return waves (..., M, N), in rows, times the map of each degree."""
    return torch.cat([waves[..., n * n : (n + 1) ** 2] @ each for n, each in enumerate(maps)], dim=-1)


@cached_tensors(8)
def _directions(degree: int) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Return directions (n, 3), and the inverse (2 l + 1, n) of the harmonics of each degree at these."""
    directions = sphere_points((0.0, 0.0, 0.0), 1.0, _SAMPLES * (2 * degree + 1))
    values = harmonics(degree, directions)
    return directions, [torch.linalg.pinv(values[:, n * n : (n + 1) ** 2]) for n in range(degree + 1)]
