"""Readings linearised around a transfer matrix, and their covariance by noise, entries and shared factors."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from autdtorch.methods.doubtful_readings import Magnitudes
from autdtorch.utils.process import cached_property


@dataclass(frozen=True, eq=False)
class LinearisedReadings:
    """Readings (R, P) around a matrix, with derivatives by shared factors (K,) and by entries (P, M).

    R is N, or 2 N where phases are read: the magnitudes of N drives, then the parts of the pressures at a
    right angle to the matrix's. A row of entries shows in the readings of its point alone.

    Attributes:
        magnitudes: by the matrix (N, P) [Pa].
        left: differences (R, P) of readings to the matrix's.
        decided: readings (R, P) that constrain the fit here, bool; differences and derivatives of the others
            are 0.
        by_factors: derivatives (R, P, K), in widths of the factors.
        by_entries: derivatives (R, P, M) by entries, whose parts have the variance 1/2.
        noise: variance of each reading's noise (R, P) [Pa^2].
    """

    magnitudes: torch.Tensor
    left: torch.Tensor
    decided: torch.Tensor
    by_factors: torch.Tensor
    by_entries: torch.Tensor
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
        """Linearise readings of drives (N, M).

        Args:
            matrix: (P, M) [Pa], by rows and entries.
            rows: (P, M) [Pa], by the factors alone.
            changes: derivatives of the rows (K', P, M) by the last of the factors.
            widths: standard deviations (K,) of the factors: 2 M of transducers, scale and common phase, K'
                amounts; empty without factors.
            spread: standard deviations of the entries of each row (P,) [Pa].
            drives: (N, M).
            read: magnitudes (N, P), and phases where there are any.
            variance: of the noise of each point (P,) [Pa^2].
        """
        pressure = drives @ matrix.T
        magnitudes, unit = pressure.abs(), pressure.sgn().conj()
        decided, left = read.decided(magnitudes), read.nearest(magnitudes) - magnitudes
        turned = (unit * decided)[..., None] * drives[:, None]
        noise = variance.expand_as(magnitudes)
        if read.phase is not None:
            # The phasor that was read has parts along the matrix's and across it.
            phasor = torch.polar(read.value, read.phase.nan_to_num()) * unit
            shown = decided & ~read.limit & read.phase.isfinite()
            left = torch.cat([torch.where(shown, phasor.real - magnitudes, left), phasor.imag * shown])
            turned = torch.cat([turned, -1j * turned * shown[..., None]])
            decided, noise = torch.cat([decided, shown]), torch.cat([noise, noise])
        by_factors = magnitudes.new_empty(*left.shape, 0)
        if len(widths):
            by_amounts = torch.einsum("npm,kpm->npk", turned, changes).real
            parts = turned * rows
            whole = parts.sum(dim=-1, keepdim=True)
            by_factors = torch.cat([parts.real, -parts.imag, whole.real, -whole.imag, by_amounts], dim=-1)
        return cls(magnitudes, left, decided, by_factors * widths, turned * spread[:, None], noise)

    def change(self, factors: torch.Tensor, entries: torch.Tensor) -> torch.Tensor:
        """Return the change of the readings (R, P) with factors (K,), in their widths, and entries (P, M)."""
        return self.by_factors @ factors + (self.by_entries * entries).sum(dim=-1).real

    def explained(self, left: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the likeliest factors (K,), in widths, and entries (P, M) that change readings (R, P)."""
        weights = self.covariance.solved(left[..., None])[..., 0]
        factors = torch.einsum("rp,rpk->k", weights, self.by_factors)
        return factors, 0.5 * (weights[..., None] * self.by_entries.conj()).sum(dim=0)

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
        entries = line.by_entries.transpose(0, 1)
        self._noise = line.noise.mT  # (P, R)
        self._shared = line.by_factors.transpose(0, 1)  # (P, R, K)
        points, readings, factors = self._shared.shape
        self._slopes = _parts(entries)  # (P, R, 2 M)
        self._is_long = readings > self._slopes.shape[-1]
        self._is_dense = 0 < points * readings <= factors  # else the factors are the fewer
        if self._is_long:
            self._scaled = self._slopes / self._noise[..., None]
            inner = self._slopes.mT @ self._scaled
            inner.diagonal(dim1=1, dim2=2).add_(1)
            self._factor = torch.linalg.cholesky(inner)
        else:
            self._factor = torch.linalg.cholesky(self._blocks)

    def solved(self, right: torch.Tensor) -> torch.Tensor:
        """Return C^-1 X of columns X (R, P, C)."""
        columns = right.transpose(0, 1)
        if self._is_dense:
            flat = torch.cholesky_solve(columns.flatten(0, 1), self._dense)
            return flat.reshape(columns.shape).transpose(0, 1)
        by_block = self._blocks_solved(columns)
        if self._shared.shape[-1]:
            seen = torch.einsum("prk,prc->kc", self._by_block, columns)
            by_block = by_block - self._by_block @ torch.cholesky_solve(seen, self._inner)
        return by_block.transpose(0, 1)

    @property
    def inverse_diagonal(self) -> torch.Tensor:
        """The diagonal of C^-1, as (R, P)."""
        if self._is_dense:
            return torch.cholesky_inverse(self._dense).diagonal().reshape(self._noise.shape).mT
        if self._is_long:
            diagonal = 1 / self._noise - _squares(self._factor, self._scaled)
        else:
            diagonal = torch.cholesky_inverse(self._factor).diagonal(dim1=1, dim2=2)
        if self._shared.shape[-1]:
            diagonal = diagonal - _squares(self._inner, self._by_block)
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
        slopes = _parts(others.by_entries.transpose(0, 1))
        shared, variance = others.by_factors.transpose(0, 1), slopes.square().sum(dim=-1)
        if same_points:
            alike = self._slopes @ slopes.mT  # (P, R, R')
            known = self._blocks_solved(alike)
            variance = variance - (alike * known).sum(dim=1)
            shared = shared - known.mT @ self._shared
        variance = variance + ((shared @ self.of_factors) * shared).sum(dim=-1)
        deviations: torch.Tensor = variance.clamp_min(0).sqrt().mT
        return deviations

    @property
    def _blocks(self) -> torch.Tensor:
        """B (P, R, R)."""
        blocks = self._slopes @ self._slopes.mT
        blocks.diagonal(dim1=1, dim2=2).add_(self._noise)
        return blocks

    @cached_property
    def _dense(self) -> torch.Tensor:
        """The Cholesky factor of C (P R, P R)."""
        flat, blocks = self._shared.flatten(0, 1), self._blocks
        covariance = (flat @ flat.T).reshape(2 * blocks.shape[:2])
        for point, block in enumerate(blocks):
            covariance[point, :, point] += block
        factor: torch.Tensor = torch.linalg.cholesky(covariance.reshape(len(flat), -1))
        return factor

    @cached_property
    def _by_block(self) -> torch.Tensor:
        """B^-1 times the derivatives by factors (P, R, K)."""
        return self._blocks_solved(self._shared)

    @cached_property
    def _inner(self) -> torch.Tensor:
        """The Cholesky factor of the factors' inverse covariance (K, K) after the readings."""
        inner = torch.einsum("prk,prl->kl", self._shared, self._by_block)
        inner.diagonal().add_(1)
        factor: torch.Tensor = torch.linalg.cholesky(inner)
        return factor

    def _blocks_solved(self, columns: torch.Tensor) -> torch.Tensor:
        """Return B^-1 X of columns X (P, R, C)."""
        solved: torch.Tensor
        if self._is_long:
            scaled = columns / self._noise[..., None]
            solved = scaled - self._scaled @ torch.cholesky_solve(self._slopes.mT @ scaled, self._factor)
        else:
            solved = torch.cholesky_solve(columns, self._factor)
        return solved


def _parts(by_entries: torch.Tensor) -> torch.Tensor:
    """Return derivatives (..., M) by entries as (..., 2 M) by real parts of variance 1."""
    parts: torch.Tensor = torch.cat([by_entries.real, by_entries.imag], dim=-1) * 0.5**0.5
    return parts


def _squares(factor: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
    """Return x A^-1 x of rows x (..., R, K), as (..., R), by a Cholesky factor of A (..., K, K)."""
    whitened: torch.Tensor = torch.linalg.solve_triangular(factor, rows.mT, upper=False)
    return whitened.square().sum(dim=-2)
