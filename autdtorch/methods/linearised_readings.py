"""Readings linearised around a transfer matrix, and their covariance by noise, entries and shared factors."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from autdtorch.methods.doubtful_readings import Magnitudes
from autdtorch.utils.array_types import REAL
from autdtorch.utils.process import cached_property

NUMBERS_AT_ONCE = 2**22
"""Number of derivatives that are computed at once: 32 MiB."""


@dataclass(frozen=True, eq=False)
class LinearisedReadings:
    """Readings (R, P) around a matrix G (P, M), with derivatives by shared factors and by its entries.

    R is N, or 2 N where phases are read: the magnitudes of N drives, then the parts of the pressures at a
    right angle to the matrix's. A change dG of the matrix changes them by Re(turns * (drives @ dG^T)). A row
    of entries shows in the readings of its point alone. Readings with deviations count in these.

    Attributes:
        left: differences (R, P) of readings to the matrix's.
        decided: readings (R, P) that constrain the fit here, bool; differences and derivatives of the others
            are 0.
        turns: derivatives (R, P) by the phasors' parts.
        drives: (R, M).
        rows: (P, M) [Pa], by the factors alone.
        changes: derivatives of the rows (K', P, M) by the last of the factors.
        widths: standard deviations (K,) of the factors: 2 M of transducers, scale and common phase, K'
            amounts; empty without factors.
        spread: standard deviations of the entries of each row (P,) [Pa], whose parts have the variance 1/2.
        noise: variance of each reading's noise (R, P) [Pa^2].
    """

    left: torch.Tensor
    decided: torch.Tensor
    turns: torch.Tensor
    drives: torch.Tensor
    rows: torch.Tensor
    changes: torch.Tensor
    widths: torch.Tensor
    spread: torch.Tensor
    noise: torch.Tensor

    @classmethod
    def at(
        cls,
        matrix: torch.Tensor,
        rows: torch.Tensor,
        changes: torch.Tensor,
        widths: torch.Tensor,
        spread: torch.Tensor,
        drives: torch.Tensor,
        read: Magnitudes,
        variance: torch.Tensor,
    ) -> LinearisedReadings:
        """Linearise readings (N, P) of drives (N, M) around a matrix (P, M) [Pa].

        `variance` (P,) [Pa^2] belongs to the noise of each point. See the class for the others.
        """
        pressure = drives @ matrix.T
        magnitudes, unit = pressure.abs(), pressure.sgn().conj()
        decided, left = read.decided(magnitudes), read.nearest(magnitudes) - magnitudes
        noise = variance.expand_as(magnitudes)
        turns = unit * decided
        weight = None
        if read.deviation is not None:
            # A camera's noise is in |p|^2; magnitudes near 0 would have a bias.
            weight = read.stated / read.deviation
            by_square = weight / (2 * read.value + read.deviation)
            left = left * (magnitudes + read.nearest(magnitudes)) * by_square
            turns = turns * (2 * magnitudes * by_square)
        if read.phase is not None:
            # The phasor that was read has parts along the matrix's and across it.
            phasor = torch.polar(read.value, read.phase.nan_to_num()) * unit
            shown = decided & ~read.limit & read.phase.isfinite()
            weight = torch.ones_like(magnitudes) if weight is None else weight
            along = torch.where(shown, weight * (phasor.real - magnitudes), left)
            left = torch.cat([along, weight * phasor.imag * shown])
            turns = torch.cat([torch.where(shown, weight * unit, turns), -1j * weight * unit * shown])
            decided, noise, drives = (
                torch.cat(pair) for pair in ((decided, shown), (noise, noise), (drives, drives))
            )
        return cls(left, decided, turns, drives, rows, changes, widths, spread, noise)

    def change(self, factors: torch.Tensor, entries: torch.Tensor) -> torch.Tensor:
        """Return the change of the readings (R, P) with factors (K,), in their widths, and entries (P, M)."""
        matrix = self.spread[:, None] * entries
        if len(self.widths):
            sizes = [self.rows.shape[1], self.rows.shape[1], 2, len(self.changes)]
            gain, phase, common, amounts = torch.split(self.widths * factors, sizes)
            matrix = matrix + torch.complex(gain + common[0], phase + common[1]) * self.rows
            matrix = matrix + (amounts[:, None, None] * self.changes).sum(dim=0)
        return (self.turns * (self.drives @ matrix.T)).real

    def explained(self, left: torch.Tensor, damping: float = 0.0) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the likeliest factors (K,), in widths, and entries (P, M) that change readings (R, P).

        The factors' variance is 1 / (1 + damping).
        """
        by_matrix = self._by_matrix(self.covariance.solved(left, damping))
        factors = self._by_factors(by_matrix) / (1 + damping)
        return factors, 0.5 * self.spread[:, None] * by_matrix.conj()

    def seen(self, weights: torch.Tensor) -> torch.Tensor:
        """Return the sum of derivatives by factors (K,), in widths, with weights (R, P) of the readings."""
        return self._by_factors(self._by_matrix(weights))

    def _by_matrix(self, weights: torch.Tensor) -> torch.Tensor:
        """Return the sum (P, M) of derivatives by the matrix with weights (R, P) of the readings."""
        return (weights * self.turns).T @ self.drives

    def _by_factors(self, by_matrix: torch.Tensor) -> torch.Tensor:
        if not len(self.widths):
            return self.widths
        parts = by_matrix * self.rows
        each, whole = parts.sum(dim=0), parts.sum()[None]
        by_amounts = (by_matrix * self.changes).real.sum(dim=(1, 2))
        return self.widths * torch.cat([each.real, -each.imag, whole.real, -whole.imag, by_amounts])

    def by_factors(self, points: slice = slice(None)) -> torch.Tensor:
        """Return derivatives (P, R, K) by the factors, in their widths, of the readings of points."""
        turned = self.turns.T[points, :, None] * self.drives
        if not len(self.widths):
            return turned.real[..., :0]
        by_amounts = (turned @ self.changes[:, points].permute(1, 2, 0)).real
        parts = turned * self.rows[points, None]
        whole = parts.sum(dim=-1, keepdim=True)
        return self.widths * torch.cat([parts.real, -parts.imag, whole.real, -whole.imag, by_amounts], dim=-1)

    @property
    def by_entries(self) -> torch.Tensor:
        """Derivatives (P, R, 2 M) by the entries, as by real parts of variance 1."""
        turned = (0.5**0.5 * self.spread[:, None] * self.turns.T)[..., None] * self.drives
        return torch.cat([turned.real, -turned.imag], dim=-1)

    def alike(self, others: LinearisedReadings) -> torch.Tensor:
        """Return the covariance (P, R, R') with other readings of the points by their entries."""
        spreads = 0.5 * (self.spread * others.spread)[:, None, None]
        turns = self.turns.T[:, :, None] * others.turns.T.conj()[:, None]
        return spreads * (turns * (self.drives @ others.drives.mH)).real

    @property
    def by_entries_variance(self) -> torch.Tensor:
        """Variance of the readings (R, P) by the entries."""
        power = self.drives.abs().square().sum(dim=1, keepdim=True)
        return 0.5 * power * (self.spread * self.turns.abs()).square()

    @cached_property
    def shares(self) -> torch.Tensor:
        """Share of each reading's variance (R, P) that no unknown explains."""
        return self.noise * self.covariance.inverse_diagonal

    @property
    def unexplained(self) -> torch.Tensor:
        """Number of readings that no unknown explains."""
        return (self.shares * self.decided).sum()

    @cached_property
    def covariance(self) -> Covariance:
        """The covariance of the readings."""
        return Covariance(self)


class Covariance:
    """The covariance C of readings (R, P): noise, a block for each point by its entries, and the factors'.

    Blocks and factors have a low rank beside many readings, where Woodbury's identity inverts them.
    """

    def __init__(self, line: LinearisedReadings) -> None:
        """Factorise the blocks B of linearised readings, which the covariance has without factors."""
        self._line, self._noise = line, line.noise.mT  # (P, R)
        points, readings = self._noise.shape
        transducers, factors = line.drives.shape[1], len(line.widths)
        self._is_long = readings > 2 * transducers
        self._is_dense = 0 < points * readings <= factors  # else the factors are the fewer
        if self._is_long:
            slopes = line.by_entries
            self._slopes, self._scaled = slopes, slopes / self._noise[..., None]
            inner = slopes.mT @ self._scaled
            inner.diagonal(dim1=1, dim2=2).add_(1)
            self._factor = torch.linalg.cholesky(inner)
        else:
            self._factor = torch.linalg.cholesky(self._blocks)
        several = max(1, NUMBERS_AT_ONCE // max(1, readings * factors))
        self._parts = [slice(start, start + several) for start in range(0, points, several)]

    def solved(self, right: torch.Tensor, damping: float = 0.0) -> torch.Tensor:
        """Return C^-1 x of a column x (R, P), where the factors have the variance 1 / (1 + damping)."""
        if self._is_dense and not damping:
            return torch.cholesky_solve(right.mT.reshape(-1, 1), self._dense).reshape(right.mT.shape).mT
        by_block = self._blocks_solved(right.mT[..., None])[..., 0].mT
        if not len(self._line.widths):
            return by_block
        inner = self._inner
        if damping:
            inner = self._precision.clone()
            inner.diagonal().add_(damping)
            inner = torch.linalg.cholesky(inner)
        factors = torch.cholesky_solve(self._line.seen(by_block)[:, None], inner)[:, 0]
        by_factors = self._line.change(factors, torch.zeros_like(self._line.rows))
        return by_block - self._blocks_solved(by_factors.mT[..., None])[..., 0].mT

    @property
    def inverse_diagonal(self) -> torch.Tensor:
        """The diagonal of C^-1, as (R, P)."""
        if self._is_dense:
            return torch.cholesky_inverse(self._dense).diagonal().reshape(self._noise.shape).mT
        if self._is_long:
            diagonal = 1 / self._noise - _squares(self._factor, self._scaled)
        else:
            diagonal = torch.cholesky_inverse(self._factor).diagonal(dim1=1, dim2=2)
        if len(self._line.widths):
            by_block = (self._blocks_solved(self._line.by_factors(part), part) for part in self._parts)
            diagonal = diagonal - torch.cat([_squares(self._inner, rows) for rows in by_block])
        return diagonal.mT

    @cached_property
    def of_factors(self) -> torch.Tensor:
        """The covariance (K, K) of the factors, in their widths, that the readings leave."""
        inverse: torch.Tensor = torch.cholesky_inverse(self._inner)
        return inverse

    def deviations_of(self, others: LinearisedReadings, same_points: bool) -> torch.Tensor:
        """Return the standard deviations (R', P') of other readings that these leave, without noise.

        The entries of others are known from these readings at the same points, in the same order.
        """
        shared, variance = others.by_factors(), others.by_entries_variance.mT
        if same_points:
            alike = self._line.alike(others)
            known = self._blocks_solved(alike)
            variance = variance - (alike * known).sum(dim=1)
            shared = shared - known.mT @ self._line.by_factors()
        variance = variance + ((shared @ self.of_factors) * shared).sum(dim=-1)
        deviations: torch.Tensor = variance.clamp_min(0).sqrt().mT
        return deviations

    @property
    def _blocks(self) -> torch.Tensor:
        """B (P, R, R)."""
        blocks = self._line.alike(self._line)
        blocks.diagonal(dim1=1, dim2=2).add_(self._noise)
        return blocks

    @cached_property
    def _dense(self) -> torch.Tensor:
        """The Cholesky factor of C (P R, P R)."""
        flat, blocks = self._line.by_factors().flatten(0, 1), self._blocks
        covariance = (flat @ flat.T).reshape(2 * blocks.shape[:2])
        for point, block in enumerate(blocks):
            covariance[point, :, point] += block
        factor: torch.Tensor = torch.linalg.cholesky(covariance.reshape(len(flat), -1))
        return factor

    @cached_property
    def _inner(self) -> torch.Tensor:
        """The Cholesky factor of `_precision`."""
        factor: torch.Tensor = torch.linalg.cholesky(self._precision)
        return factor

    @cached_property
    def _precision(self) -> torch.Tensor:
        """The factors' inverse covariance (K, K) after the readings."""
        inner = torch.eye(len(self._line.widths), **REAL)
        for part in self._parts:
            shared = self._line.by_factors(part)
            inner += shared.flatten(0, 1).mT @ self._blocks_solved(shared, part).flatten(0, 1)
        return inner

    def _blocks_solved(self, columns: torch.Tensor, points: slice = slice(None)) -> torch.Tensor:
        """Return B^-1 X of columns X (P, R, C) of points."""
        if not self._is_long:
            solved: torch.Tensor = torch.cholesky_solve(columns, self._factor[points])
            return solved
        scaled = columns / self._noise[points, :, None]
        inner = torch.cholesky_solve(self._slopes[points].mT @ scaled, self._factor[points])
        return scaled - self._scaled[points] @ inner


def _squares(factor: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
    """Return x A^-1 x of rows x (..., R, K), as (..., R), by a Cholesky factor of A (..., K, K)."""
    whitened: torch.Tensor = torch.linalg.solve_triangular(factor, rows.mT, upper=False)
    return whitened.square().sum(dim=-2)
