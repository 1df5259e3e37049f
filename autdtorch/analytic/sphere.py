"""Point sources outside a sphere: rigid, soft, of a fluid, or with an impedance.

The partial-wave series of Anderson (1950, JASA 22, 426; also Morse & Ingard, Theoretical Acoustics (1968),
chapter 8) is written with ratios of Hankel functions and logarithmic derivatives, which overflow at no order.
With x = ka, k_1 = k / speed_ratio, distances s and r of source and point from the centre, and the angle gamma
between them,

    scattered outside: (ik/4pi) sum (2n+1) [A_n h_n(x)^2] [h_n(ks) / h_n(x)] [h_n(kr) / h_n(x)] P_n(cos gamma)
    total inside:      (ik/4pi) sum (2n+1) [B_n h_n(x)] [h_n(ks) / h_n(x)] j_n(k_1 r) P_n(cos gamma).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import torch

from autdtorch.analytic.green import green
from autdtorch.analytic.spherical_waves import bessel_slopes, order_column
from autdtorch.utils.array_types import COMPLEX
from autdtorch.utils.fluids import fluid_ratios, passive_impedance
from autdtorch.utils.units import real_wavenumber
from autdtorch.utils.validation import (
    LENGTH_TOLERANCE,
    ArrayLike,
    Vector,
    boolean,
    finite_vector,
    points_tensor,
    positive,
)

# Condition dp/d(kr) + admittance * p = 0: from N to the admittances of the orders 0 to N
Boundary: TypeAlias = Callable[[int], torch.Tensor | float]
# Radial functions: from k r (P,) and N to the orders 0 to N, complex (N + 1, P)
Radial: TypeAlias = Callable[[torch.Tensor, int], torch.Tensor]

_BLOCK = 256  # points summed at a time, to limit memory
_NEGLIGIBLE = 1e-17  # fraction of the largest term at which a series ends
_MOST_ORDERS = 2**16  # enough for a point on the surface and a source 6e-4 radii off it
_SOFT = 1e20  # admittance of a surface without pressure
_CENTER = 1e-100  # replacement for k r = 0, where the field has a limit but its factors do not


def rigid_sphere(
    points: ArrayLike,
    sources: ArrayLike,
    wavenumber: float,
    center: Vector,
    radius: float,
    *,
    scattered: bool = False,
) -> torch.Tensor:
    """Return the field of point sources outside a rigid sphere.

    Args:
        points: (P, 3) [m], outside the sphere or on it.
        sources: (M, 3) [m], outside the sphere.
        wavenumber: k [rad/m], > 0.
        center: of the sphere (3,) [m].
        radius: of the sphere [m], > 0.
        scattered: return the scattered wave alone, which is finite at the sources.

    Returns:
        complex128 (P, M) [1/m], in units of `green`.

    Raises:
        ValueError: not finite, wrong shape, out of the ranges above, a point on a source, or points and
            sources so near the surface that the series does not converge in `_MOST_ORDERS` orders.

    Source: Morse & Ingard, Theoretical Acoustics (1968), chapter 8; Anderson (1950), JASA 22, 426, for
        rho_1 -> infinity.
    """
    setup = _setup(points, sources, wavenumber, center, radius)
    return _field_outside(setup, lambda _: 0.0, boolean("scattered", scattered))


def soft_sphere(
    points: ArrayLike,
    sources: ArrayLike,
    wavenumber: float,
    center: Vector,
    radius: float,
    *,
    scattered: bool = False,
) -> torch.Tensor:
    """Return the field of point sources outside a pressure-release sphere.

    Arguments, returns and errors as for `rigid_sphere`.

    Source: Anderson (1950), JASA 22, 426, for rho_1 -> 0.
    """
    setup = _setup(points, sources, wavenumber, center, radius)
    return _field_outside(setup, lambda _: _SOFT, boolean("scattered", scattered))


def impedance_sphere(
    points: ArrayLike,
    sources: ArrayLike,
    wavenumber: float,
    center: Vector,
    radius: float,
    impedance: complex,
    *,
    scattered: bool = False,
) -> torch.Tensor:
    """Return the field of point sources outside a sphere whose surface has an impedance.

    Arguments, returns and errors as for `rigid_sphere`, with the `impedance` of the surface as a ratio to
    rho c of the medium: pressure over the velocity into it, with a real part >= 0, and not 0. The surface is
    locally reacting, dp/dr = -i k p / impedance.

    Source: Morse & Ingard, Theoretical Acoustics (1968), section 8.2.
    """
    ratio = passive_impedance("impedance", impedance)
    setup = _setup(points, sources, wavenumber, center, radius)
    admittance = torch.tensor(1j / ratio, **COMPLEX).to(setup.points.device)
    return _field_outside(setup, lambda _: admittance, boolean("scattered", scattered))


def fluid_sphere(
    points: ArrayLike,
    sources: ArrayLike,
    wavenumber: float,
    center: Vector,
    radius: float,
    density_ratio: complex,
    speed_ratio: complex,
    *,
    scattered: bool = False,
) -> torch.Tensor:
    """Return the field of point sources outside a fluid sphere, outside and inside it.

    Arguments, returns and errors as for `rigid_sphere`, with the ratios rho_1 / rho > 0 and c_1 / c > 0, both
    complex in a sphere that absorbs, as of an `Obstacle`; points may be anywhere. With `scattered`, the field
    of the sources in the infinite medium is subtracted.

    Source: Anderson (1950), JASA 22, 426, with the partial waves of a point source for those of a plane wave.
    """
    density_ratio, speed_ratio = fluid_ratios(density_ratio, speed_ratio)
    scattered = boolean("scattered", scattered)
    setup = _setup(points, sources, wavenumber, center, radius)
    inside = setup.point_distances < setup.radius
    field = torch.empty(setup.cosines.shape, dtype=torch.complex128, device=setup.points.device)
    if inside.any():
        field[inside] = _field_inside(setup.at(inside), density_ratio, speed_ratio, scattered)
    if not inside.all():
        boundary = _fluid_boundary(setup.size, density_ratio, speed_ratio)
        inner_size = float(setup.size) / abs(speed_ratio)
        field[~inside] = _field_outside(setup.at(~inside), boundary, scattered, inner_size)
    return field


@dataclass(frozen=True)
class _Setup:
    """Checked points and sources, with distances and angles from the centre of the sphere."""

    points: torch.Tensor
    sources: torch.Tensor
    wavenumber: float
    radius: float
    point_distances: torch.Tensor
    source_distances: torch.Tensor
    cosines: torch.Tensor

    @property
    def size(self) -> torch.Tensor:
        """The argument ka on the surface, as a scalar tensor."""
        return self.point_distances.new_tensor(self.wavenumber * self.radius)

    def at(self, rows: torch.Tensor) -> _Setup:
        """Select points by `rows`, with all sources."""
        chosen = {name: getattr(self, name)[rows] for name in ("points", "point_distances", "cosines")}
        return replace(self, **chosen)


def _setup(points: ArrayLike, sources: ArrayLike, wavenumber: float, center: Vector, radius: float) -> _Setup:
    targets = points_tensor("points", points)
    origins = points_tensor("sources", sources).to(targets.device)
    wavenumber, radius = real_wavenumber(wavenumber), positive("radius", radius, "m")
    middle = targets.new_tensor(finite_vector("center", center))
    from_center = targets - middle
    sources_from_center = origins - middle
    source_distances = sources_from_center.norm(dim=1)
    _require_outside("sources", origins, source_distances, radius + LENGTH_TOLERANCE)
    directions = torch.nn.functional.normalize(from_center, dim=1)
    cosines = directions @ torch.nn.functional.normalize(sources_from_center, dim=1).T
    distances = from_center.norm(dim=1)
    # Points within rounding of the surface are moved onto it.
    distances = torch.where((distances - radius).abs() < LENGTH_TOLERANCE, radius, distances)
    return _Setup(targets, origins, wavenumber, radius, distances, source_distances, cosines.clamp(-1, 1))


def _field_outside(
    setup: _Setup, boundary: Boundary, scattered: bool, inner_size: float = 0.0
) -> torch.Tensor:
    _require_outside("points", setup.points, setup.point_distances, setup.radius)
    x = setup.size

    def radial(kr: torch.Tensor, orders: int) -> torch.Tensor:
        admittance, bessel, hankel = boundary(orders), bessel_slopes(x, orders), _hankel_slopes(x, orders)
        # A_n h_n(x)^2, with the Wronskian j_n h_n (h_n'/h_n - j_n'/j_n) = i / x^2.
        modes = (admittance + bessel) / ((bessel - hankel) * (admittance + hankel))
        return (1j / x**2 * modes)[:, None] * _hankel_fall(x, kr, orders)

    field = _series(setup, setup.wavenumber * setup.point_distances, radial, inner_size)
    return field if scattered else field + green(setup.points, setup.sources, setup.wavenumber)


def _field_inside(
    setup: _Setup, density_ratio: complex, speed_ratio: complex, scattered: bool
) -> torch.Tensor:
    x, inner_size = setup.size, setup.size / speed_ratio
    boundary = _fluid_boundary(x, density_ratio, speed_ratio)

    def radial(kr: torch.Tensor, orders: int) -> torch.Tensor:
        # B_n h_n(x) j_n(x_1), times j_n(k_1 r) / j_n(x_1) with j_n = (j_n h_n) / h_n: j_n may be zero.
        modes = 1j / x**2 / (boundary(orders) + _hankel_slopes(x, orders)) / _product(inner_size, orders)
        return modes[:, None] * _product(kr, orders) * _hankel_fall(kr, inner_size, orders)

    inner_wavenumber = setup.wavenumber / speed_ratio
    kr = inner_wavenumber * setup.point_distances.clamp(min=_CENTER)
    field = _series(setup, kr, radial, float(inner_size.abs()))
    return field - green(setup.points, setup.sources, setup.wavenumber) if scattered else field


def _fluid_boundary(x: torch.Tensor, density_ratio: complex, speed_ratio: complex) -> Boundary:
    """Return the condition that p and (1/rho) dp/dr are continuous."""
    return lambda orders: -bessel_slopes(x / speed_ratio, orders) / (density_ratio * speed_ratio)


def _series(setup: _Setup, kr: torch.Tensor, radial: Radial, inner_size: float) -> torch.Tensor:
    """Return (ik / 4 pi) times the sum over orders of (2n + 1) radial_n(kr) [h_n(ks) / h_n(x)] P_n."""
    blocks = [
        _block(setup.at(rows), kr[rows], radial, inner_size)
        for rows in torch.split(torch.arange(len(kr), device=kr.device), _BLOCK)
    ]
    return 1j * setup.wavenumber / (4 * math.pi) * torch.cat(blocks)


def _block(setup: _Setup, kr: torch.Tensor, radial: Radial, inner_size: float) -> torch.Tensor:
    orders = _enough_orders(setup, inner_size)
    weights = 2 * order_column(setup.size, orders) + 1
    at_points = weights[:, None] * radial(kr, orders)
    at_sources = _hankel_fall(setup.size, setup.wavenumber * setup.source_distances, orders)
    bound = at_points.abs().amax(dim=1) * at_sources.abs().amax(dim=1)
    total = torch.zeros_like(setup.cosines, dtype=torch.complex128)
    before, legendre = torch.zeros_like(setup.cosines), torch.ones_like(setup.cosines)
    for n, counts in enumerate((bound > _NEGLIGIBLE * bound.max()).tolist()):
        if counts:
            total += at_points[n, :, None] * at_sources[n] * legendre
        before, legendre = legendre, ((2 * n + 1) * setup.cosines * legendre - n * before) / (n + 1)
    return total


def _enough_orders(setup: _Setup, inner_size: float) -> int:
    """Return the order beyond which terms stay below `_NEGLIGIBLE`.

    Some cube roots of ka beyond ka (and k_1 a), terms decay from order to order at least by the ratios of the
    distances of point and source to the radius.
    """
    largest = max(float(setup.size), inner_size)
    past = largest + 4 * math.cbrt(largest) + 16
    fall = (setup.point_distances / setup.radius).clamp(min=_CENTER).log().abs().min()
    fall += (setup.source_distances.min() / setup.radius).log()
    orders = past - math.log(_NEGLIGIBLE) / float(fall)
    if orders > _MOST_ORDERS:
        nearest = float(setup.source_distances.min()) - setup.radius
        raise ValueError(
            f"sources: {nearest:g} m off the sphere, points about as near; both distances must add up to "
            f"about {1e-3 * setup.radius:g} m or more"
        )
    return math.ceil(orders)


def _hankel_slopes(x: torch.Tensor, orders: int) -> torch.Tensor:
    """Return h_n'(x) / h_n(x), (orders + 1, *x.shape)."""
    return _hankel_ratios(x, orders) - (order_column(x, orders) + 1) / x


def _hankel_ratios(x: torch.Tensor, orders: int) -> torch.Tensor:
    """Return h_{n-1}(x) / h_n(x), (orders + 1, *x.shape), by upward recurrence."""
    ratio = torch.full_like(x, 1j, dtype=torch.complex128)
    ratios = [ratio]
    for n in range(orders):
        ratio = 1 / ((2 * n + 1) / x - ratio)
        ratios.append(ratio)
    return torch.stack(ratios)


def _hankel_fall(near: torch.Tensor, far: torch.Tensor, orders: int) -> torch.Tensor:
    """Return h_n(far) / h_n(near), (orders + 1, P), for near <= far, one of them a scalar."""
    steps_near, steps_far = _hankel_ratios(near, orders), _hankel_ratios(far, orders)
    size = max(near.numel(), far.numel())
    steps = (steps_near.reshape(orders + 1, -1) / steps_far.reshape(orders + 1, -1)).expand(-1, size).clone()
    turn = far - near
    steps[0] = near / far * torch.exp(1j * turn) if turn.is_complex() else torch.polar(near / far, turn)
    return steps.cumprod(dim=0)


def _product(x: torch.Tensor, orders: int) -> torch.Tensor:
    """Return j_n(x) h_n(x), (orders + 1, *x.shape), from their Wronskian."""
    return 1j / x**2 / (_hankel_slopes(x, orders) - bessel_slopes(x, orders))


def _require_outside(name: str, positions: torch.Tensor, distances: torch.Tensor, least: float) -> None:
    nearest = int(distances.argmin())
    if distances[nearest] < least:
        raise ValueError(
            f"{name}[{nearest}]: {tuple(positions[nearest].tolist())} m, {float(distances[nearest]):g} m "
            f"from the centre of the sphere; must be at least {least:g} m from it"
        )
