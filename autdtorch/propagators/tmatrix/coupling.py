"""The waves that bodies with known T-matrices send one another.

Body i has the T-matrix T_i and the incident waves d_i, and body j sends it the waves S_ij b_j. The outgoing
waves are b_i = T_i (d_i + sum_j S_ij b_j) (Waterman and Truell 1961, doi:10.1063/1.1703737).

One body after the other takes what the others have sent last (block Gauss-Seidel). The steps are combined by
the least residual (generalised conjugate residuals; Eisenstat, Elman and Schultz 1983, doi:10.1137/0720023):
4 to 11 of them leave 1e-11, also where spheres touch. Systems of many right sides are solved as matrices.
Gradients are those of one more step: they solve the adjoint system.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeAlias

import torch

from autdtorch.propagators.tmatrix.body_matrix import BodyMatrix
from autdtorch.propagators.tmatrix.translation import Translation, WaveFrame
from autdtorch.utils.array_types import COMPLEX
from autdtorch.utils.mirror_images import Image
from autdtorch.utils.process import cached_property, require_memory

logger = logging.getLogger(__name__)

_ACCURACY = 1e-11
"""Residual of each right side, relative to it, at which the iteration ends."""

_MOST_STEPS = 30
"""Steps after which the system is solved as a matrix."""

USUAL_STEPS = 7
"""Steps that most systems take. With more right sides than 1 / 7 of the unknowns, a matrix is quicker."""

_FEWEST_WAVES = 32
"""Waves in a block of a map, as products of smaller ones take as long."""

ENTRY_BYTES = 130.0
"""Memory of a pair of waves while a system is solved as a matrix [bytes]; 80 to 170 for 625 to 1250 waves."""

_TINY = torch.finfo(torch.float64).tiny


Ways = list[list[list[Translation]]]
"""Ways: the translations to body i from the images of body j, by i and j."""


def ways_between(bodies: Sequence[BodyMatrix], images: Sequence[Image], more: int = 0) -> Ways:
    """Return the ways between bodies in one pose, or in B poses; regular waves have so many more degrees."""
    frames = [
        WaveFrame(each.center.reshape(-1, 3), each.axes.reshape(-1, 3, 3), each.degree) for each in bodies
    ]

    def ways(number: int, other: int) -> list[Translation]:
        here = frames[number]._replace(degree=frames[number].degree + more)
        return [
            Translation(bodies[0].wavenumber, here, _seen(frames[other], image), image.weight)
            for image in (images[1:] if number == other else images)
        ]

    return [[ways(number, other) for other in range(len(bodies))] for number in range(len(bodies))]


def _seen(frame: WaveFrame, image: Image) -> WaveFrame:
    center = (frame.center - image.offset) @ image.matrix
    return WaveFrame(center, image.matrix.mT @ frame.axes, frame.degree)


def received(
    ways: Sequence[Sequence[Translation]], sent: Sequence[torch.Tensor | None]
) -> torch.Tensor | None:
    """Return the regular waves (N, B, R) that come to a body from the outgoing ones (K, B, R) of bodies."""
    parts = [
        way.applied(waves)
        for each, waves in zip(ways, sent, strict=True)
        for way in each
        if waves is not None
    ]
    return functools.reduce(torch.add, parts) if parts else None


def solved(maps: Sequence[torch.Tensor], ways: Ways, incident: Sequence[torch.Tensor]) -> list[torch.Tensor]:
    """Return the outgoing waves (n, B, R) of all bodies, given their maps T_i (n, n) and waves (n, B, R)."""
    sweep = _Sweep(list(maps), ways, list(incident), [_blocks(matrix) for matrix in maps])
    carried: torch.Tensor | None = None
    if sweep.carried:
        carried = _Fixed.apply(sweep, *sweep.tensors)  # type: ignore[no-untyped-call]
    return sweep.after(carried, incident)


@dataclass(frozen=True, eq=False)
class _Sweep:
    """A system x = start + K x: a step for one body after the other.

    Its unknowns are the waves of those that send to earlier ones. `tensors` are all that it depends on.
    """

    maps: list[torch.Tensor]
    ways: Ways
    incident: list[torch.Tensor]
    blocks: list[list[_Block]]  # of each map

    @cached_property
    def carried(self) -> list[int]:
        """The bodies whose waves count from one step to the next."""
        every = range(len(self.maps))
        return [body for body in every if any(self.ways[number][body] for number in range(body + 1))]

    @property
    def tensors(self) -> list[torch.Tensor]:
        ways = (way for row in self.ways for pair in row for way in pair)
        frames = (frame for way in ways for frame in (way.here, way.there))
        return [*self.maps, *self.incident, *(tensor for frame in frames for tensor in frame[:2])]

    def of(self, tensors: Sequence[torch.Tensor]) -> _Sweep:
        """Return the system of other tensors."""
        count, rest = len(self.maps), iter(tensors[2 * len(self.maps) :])

        def placed(way: Translation) -> Translation:
            here, there = (WaveFrame(next(rest), next(rest), each.degree) for each in (way.here, way.there))
            return replace(way, here=here, there=there)

        ways = [[[placed(way) for way in pair] for pair in row] for row in self.ways]
        return replace(self, maps=list(tensors[:count]), ways=ways, incident=list(tensors[count : 2 * count]))

    def start(self) -> torch.Tensor:
        return self._next(self.after(None, self.incident))

    def linear(self, x: torch.Tensor) -> torch.Tensor:
        """Return K x."""
        return self._next(self.after(x, None))

    def adjoint(self, x: torch.Tensor) -> torch.Tensor:
        """Return K^H x."""
        later: list[torch.Tensor | None] = self._sent(x)  # by waves after the step
        before: list[torch.Tensor | None] = [None] * len(self.maps)
        for number, matrix in reversed(list(enumerate(self.maps))):
            weights = later[number]
            if weights is None:
                continue
            weights = _scattered_by(matrix, self.blocks[number], weights, is_adjoint=True)
            for other, ways in enumerate(self.ways[number]):
                sums = later if other < number else before
                for way in ways:
                    part = way.adjoint.applied(weights)
                    total = sums[other]
                    sums[other] = part if total is None else total + part
        return torch.cat([waves for body in self.carried if (waves := before[body]) is not None])

    def step(self, x: torch.Tensor) -> torch.Tensor:
        """Return start + K x."""
        return self._next(self.after(x, self.incident))

    def _sent(self, x: torch.Tensor) -> list[torch.Tensor | None]:
        """Return the waves of each body that x has."""
        sent: list[torch.Tensor | None] = [None] * len(self.maps)
        parts = torch.split(x, [len(self.maps[body]) for body in self.carried])
        for body, part in zip(self.carried, parts, strict=True):
            sent[body] = part
        return sent

    def _next(self, waves: Sequence[torch.Tensor]) -> torch.Tensor:
        return torch.cat([waves[body] for body in self.carried])

    def after(self, x: torch.Tensor | None, incident: Sequence[torch.Tensor] | None) -> list[torch.Tensor]:
        """Return the outgoing waves of all bodies after a step."""
        sent: list[torch.Tensor | None] = [None] * len(self.maps) if x is None else self._sent(x)
        for number, matrix in enumerate(self.maps):
            waves = received(self.ways[number], sent)
            if incident is not None:
                waves = incident[number] if waves is None else incident[number] + waves
            assert waves is not None
            sent[number] = _scattered_by(matrix, self.blocks[number], waves)
        return [waves for waves in sent if waves is not None]


class _Block(NamedTuple):
    """Waves that a map scatters into one another alone, and its part (b, b) for them."""

    waves: torch.Tensor
    matrix: torch.Tensor


def _blocks(matrix: torch.Tensor) -> list[_Block]:
    """Return the blocks of a map (n, n), of at least `_FEWEST_WAVES` each; none if they are one.

    Nor of a map with gradients, as entries that are 0 have some, too.
    """
    if matrix.requires_grad:
        return []
    linked = matrix != 0
    linked = linked | linked.mT
    label, last = torch.arange(len(matrix), dtype=torch.int64, device="cpu"), None
    linked.fill_diagonal_(True)
    while last is None or not torch.equal(label, last):
        label, last = torch.where(linked, label, len(matrix)).amin(dim=1), label
    cuts, end = [0], 0
    for size in label.bincount().tolist():
        end += size
        if size and min(end - cuts[-1], len(matrix) - end) >= _FEWEST_WAVES:
            cuts.append(end)
    if len(cuts) == 1:
        return []
    return [
        _Block(waves, matrix[waves][:, waves])
        for waves in torch.tensor_split(label.argsort(stable=True), cuts[1:])
    ]


def _scattered_by(
    matrix: torch.Tensor, blocks: Sequence[_Block], waves: torch.Tensor, is_adjoint: bool = False
) -> torch.Tensor:
    """Return what a map (n, n) of some blocks, or its adjoint, makes of waves (n, B, R)."""
    flat = waves.reshape(len(waves), -1)
    if not blocks:
        return ((matrix.mH if is_adjoint else matrix) @ flat).reshape(waves.shape)
    order = torch.cat([block.waves for block in blocks])
    parts = torch.split(flat.index_select(0, order), [len(block.waves) for block in blocks])
    maps = [block.matrix.mH if is_adjoint else block.matrix for block in blocks]
    products = torch.cat([each @ part for each, part in zip(maps, parts, strict=True)])
    return products.index_select(0, order.argsort()).reshape(waves.shape)


@dataclass(frozen=True, eq=False)
class _Adjoint:
    """The system of the adjoint K^H."""

    system: _System
    gradient: torch.Tensor

    @property
    def tensors(self) -> list[torch.Tensor]:
        return [*self.system.tensors, self.gradient]

    def of(self, tensors: Sequence[torch.Tensor]) -> _Adjoint:
        return _Adjoint(self.system.of(tensors[:-1]), tensors[-1])

    def start(self) -> torch.Tensor:
        return self.gradient

    def linear(self, x: torch.Tensor) -> torch.Tensor:
        return self.system.adjoint(x)

    def adjoint(self, x: torch.Tensor) -> torch.Tensor:
        return self.system.linear(x)

    def step(self, x: torch.Tensor) -> torch.Tensor:
        return self.gradient + self.linear(x)


_System: TypeAlias = _Sweep | _Adjoint


class _Fixed(torch.autograd.Function):
    """The solution x (N, B, R) of a system, whose gradients are those of one more step."""

    @staticmethod
    def forward(system: _System, *tensors: torch.Tensor) -> torch.Tensor:
        return _solution(system.of([tensor.detach() for tensor in tensors]))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: torch.Tensor) -> None:
        ctx.system, *_ = inputs
        ctx.save_for_backward(output)

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        (solution,), system, again = ctx.saved_tensors, ctx.system, torch.is_grad_enabled()
        adjoint = _Adjoint(system, gradient)
        weights = _Fixed.apply(adjoint, *adjoint.tensors)  # type: ignore[no-untyped-call]
        needed = ctx.needs_input_grad[1:]
        with torch.enable_grad():  # copies, as the solution depends on the tensors themselves
            copies = [
                each.view_as(each) if again else each.detach().requires_grad_(need)
                for each, need in zip(system.tensors, needed, strict=True)
            ]
            step = system.of(copies).step(solution if again else solution.detach())
            some = [each for each, need in zip(copies, needed, strict=True) if need]
            slopes = iter(torch.autograd.grad(step, some, weights, create_graph=again, allow_unused=True))
        return None, *(next(slopes) if need else None for need in needed)


def _solution(system: _System) -> torch.Tensor:
    """Return the solution by steps, or by a matrix where this is quicker or where they do not converge."""
    start = system.start()
    if USUAL_STEPS * start.shape[-1] <= len(start):
        solution = _by_steps(system, start)
        if solution is not None:
            return solution
        logger.debug("waves between bodies have not converged in %d steps: by a matrix", _MOST_STEPS)
    return _by_matrix(system, start)


def _by_steps(system: _System, start: torch.Tensor) -> torch.Tensor | None:
    """Return x, each right side with the least residual, or None if it has not converged."""
    residual, accepted = start, _ACCURACY * _norm(start)
    residuals, images = list[torch.Tensor](), list[torch.Tensor]()  # the latter orthonormal
    triangle, shares = list[list[torch.Tensor]](), list[torch.Tensor]()
    for _ in range(_MOST_STEPS):
        residuals.append(residual)
        image, column = residual - system.linear(residual), list[torch.Tensor]()
        for each in images:
            column.append(_product(each, image))
            image = image.addcmul(column[-1], each, value=-1)
        size = _norm(image).clamp_min(_TINY)
        image = image / size
        images.append(image)
        triangle.append([*column, size])
        shares.append(_product(image, residual))
        residual = residual.addcmul(shares[-1], image, value=-1)
        if (_norm(residual) <= accepted).all():
            return _combined(residuals, triangle, shares)
    return None


def _combined(
    residuals: Sequence[torch.Tensor], triangle: Sequence[Sequence[torch.Tensor]], shares: list[torch.Tensor]
) -> torch.Tensor:
    """Return the sum of residuals whose images have these shares of the orthonormal ones."""
    solution, shares = torch.zeros_like(residuals[0]), list(shares)
    for number in reversed(range(len(shares))):
        *column, size = triangle[number]
        weight = shares[number] / size
        for other, entry in enumerate(column):
            shares[other] = shares[other] - entry * weight
        solution = solution.addcmul(weight, residuals[number])
    return solution


def _product(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """Return the inner products (B, R) of waves (N, B, R)."""
    products: torch.Tensor = torch.linalg.vecdot(one, other, dim=0)
    return products


def _norm(waves: torch.Tensor) -> torch.Tensor:
    """Return the norms (B, R) of waves (N, B, R)."""
    return _product(waves, waves).real.sqrt()


def _by_matrix(system: _System, start: torch.Tensor) -> torch.Tensor:
    """Return x of a matrix of each pose."""
    count, poses, _ = start.shape
    require_memory("bodies", f"{count} waves", ENTRY_BYTES * poses * count**2)
    identity = torch.eye(count, **COMPLEX)
    matrix = system.linear(identity[:, None].expand(-1, poses, -1).contiguous())
    solution: torch.Tensor = torch.linalg.solve(identity - matrix.movedim(1, 0), start.movedim(1, 0))
    return solution.movedim(0, 1).contiguous()
