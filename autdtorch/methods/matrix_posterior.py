"""The posterior of a transfer matrix by a Gaussian prior and by magnitudes read for known drives."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch

from autdtorch.methods.doubtful_readings import Magnitudes
from autdtorch.methods.linearised_readings import LinearisedReadings
from autdtorch.utils.array_types import COMPLEX, REAL
from autdtorch.utils.process import one_library_thread

USUAL_NOISE = 0.03
"""Noise assumed before readings, in rms pressures at random phases."""

PSEUDO_READINGS = 4.0
"""Number of readings that the assumed noise counts as."""

_STEPS = 10  # of the Gauss-Newton search
_HALVINGS = 6  # of a step that raises the misfit
_DAMPINGS = (1.0, 10.0, 100.0, 1e3, 1e4)  # of such a step where readings state their deviations
_ENOUGH = 1e-3  # relative gain of a step below which the fit ends
_NOISE_ROUNDS = 4  # estimates of the noise
_NOISE_FACTOR = 1.5  # change of the variance above which the maximum is sought again
_DARK = 1e-6  # floor of a row's spread, relative to the strongest row's
_TINY = 1e-150  # floor of a row's spread [Pa], whose square is not 0
_FAR = 5.0  # ratio of the first reading's scale to the others' beyond which it is an outlier
_OUTLIER = 6.0  # robust standard deviations beyond which a reading is an outlier
_HARMLESS = 0.1  # deviation, in rms pressures at random phases, that does no harm
_LEAST_SHARE = 0.02  # least share of a reading's variance that the fit leaves; less is rounding
_MEDIAN = 0.6745  # median magnitude of a standard normal deviate


@dataclass(frozen=True, eq=False)
class MatrixPrior:
    """A Gaussian prior of the transfer matrix: G = e^(s + i c + a_m + i b_m) (R + sum_k t_k V_k) + d_p e.

    All foci share the factors a_m and b_m of transducer m, the scale s, the common phase c and the amounts
    t_k. The entries e of row p and column m are circular, of variance 1.

    Attributes:
        rows: R (P, M) [Pa].
        spread: d_p (P,) [Pa].
        widths: standard deviations (2 M + 2 + K,) of a_m, b_m [rad], s, c and t_k; empty without factors.
        changes: V (K, P, M) [Pa].
    """

    rows: torch.Tensor
    spread: torch.Tensor
    widths: torch.Tensor
    changes: torch.Tensor

    @property
    def usual_variance(self) -> torch.Tensor:
        """Variance of the noise that is assumed before readings which state none [Pa^2]."""
        power = (self.rows.abs().square() + self.spread[:, None].square()).sum(dim=1).mean()
        return 0.5 * USUAL_NOISE**2 * power

    def variance_of(self, read: Magnitudes) -> torch.Tensor:
        """Return the usual variance of the readings' noise [Pa^2], as stated or else assumed."""
        return self.usual_variance if read.deviation is None else read.stated.square()

    def in_units_of(self, drives: torch.Tensor, observed: torch.Tensor) -> MatrixPrior:
        """Return the prior in units of the first of magnitudes (N, P) by drives (N, M), or of their median.

        The median decides where the first reading is far from it: an outlier.
        """
        usual = self.unit_of(drives, observed)
        factor = float(observed[0].norm() / (drives[0] @ self.rows.T).norm())
        return self.times(factor if usual / _FAR < factor < usual * _FAR else usual)

    def unit_of(self, drives: torch.Tensor, observed: torch.Tensor) -> float:
        """Return the median ratio of magnitudes (N, P) to those by drives (N, M); 1 where all are 0."""
        expected = (drives @ self.rows.T).abs()
        ratio = (observed / expected)[(observed > 0) & (expected > 0)]
        return float(ratio.median()) if len(ratio) else 1.0

    def times(self, unit: float) -> MatrixPrior:
        """Return the prior of another unit."""
        return replace(self, **{name: unit * getattr(self, name) for name in ("rows", "spread", "changes")})

    def parts(self, factors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return a_m, b_m, s, c and t_k of factors (2 M + 2 + K,)."""
        transducers = self.rows.shape[1]
        return torch.split(factors, [transducers, transducers, 1, 1, len(self.changes)])

    def errors(self, drives: torch.Tensor) -> torch.Tensor:
        """Return the standard deviations (N, P) [Pa] of the pressures of drives (N, M), without scale."""
        power = drives.abs().square()
        gain, phase, _, _, amounts = self.parts(self.widths)
        of_factors = (power * (gain.square() + phase.square())) @ self.rows.abs().square().T
        by_amounts = torch.einsum("nm,kpm->knp", drives, self.changes).abs() * amounts[:, None, None]
        of_entries = power.sum(dim=1, keepdim=True) * self.spread.square()
        variance = of_factors + by_amounts.square().sum(dim=0) + of_entries + self.usual_variance
        return variance.sqrt()

    @classmethod
    def unknown(cls, read: Magnitudes, transducers: int) -> MatrixPrior:
        """Return the prior of a matrix of which only magnitudes (N, P) of full drives are known."""
        rows = torch.zeros(read.value.shape[1], transducers, **COMPLEX)
        spread = read.power.div(transducers).sqrt()
        # A focus that nothing reaches has an unknown row, too.
        spread = spread.clamp_min(_DARK * float(spread.max())).clamp_min(_TINY)
        return cls(rows, spread, spread.new_empty(0), rows.new_empty(0, *rows.shape))


@dataclass(frozen=True, eq=False)
class MatrixPosterior:
    """The posterior of a transfer matrix around its maximum, where the magnitudes are linearised.

    Attributes:
        prior: of the matrix.
        factors: a_m, b_m, s, c and t_k at the maximum, as `MatrixPrior.widths`.
        entries: e_pm at the maximum (P, M).
        variance: of the magnitudes' noise, for each focus (P,) [Pa^2]; of the median reading where these
            state their deviations.
    """

    prior: MatrixPrior
    factors: torch.Tensor
    entries: torch.Tensor
    variance: torch.Tensor

    @classmethod
    def start(cls, prior: MatrixPrior, read: Magnitudes) -> MatrixPosterior:
        """Return the maximum of the prior, with the usual noise of readings."""
        variance = prior.variance_of(read).expand_as(prior.spread)
        return cls(prior, torch.zeros_like(prior.widths), torch.zeros_like(prior.rows), variance)

    @property
    def matrix(self) -> torch.Tensor:
        """The transfer matrix (P, M) [Pa] at the maximum."""
        return self._scaled()[0] + self.prior.spread[:, None] * self.entries

    @one_library_thread()
    def fitted(self, drives: torch.Tensor, read: Magnitudes, infer_noise: bool = True) -> MatrixPosterior:
        """Return the posterior by magnitudes (N, P) that drives (N, M) made.

        The search for the maximum begins at this one. The noise follows MacKay's rule (1992), by the misfit
        and the number of readings that no unknown explains, with a few pseudo-readings of the usual noise.
        """
        now, line = self._maximum(self.linearised(drives, read), drives, read)
        for _ in range(_NOISE_ROUNDS if infer_noise else 0):
            before, now = now.variance[0], now._with_noise(line, self.prior.variance_of(read))
            if not 1 / _NOISE_FACTOR < now.variance[0] / before < _NOISE_FACTOR:
                now, line = now._maximum(now.linearised(drives, read), drives, read)
        return now

    def _maximum(
        self, line: LinearisedReadings, drives: torch.Tensor, read: Magnitudes
    ) -> tuple[MatrixPosterior, LinearisedReadings]:
        """Return the maximum by damped Gauss-Newton steps, and its linearisation."""
        now = self
        for _ in range(_STEPS):
            misfit = now._misfit(line)
            for there in now._steps(line, read):
                new_line = there.linearised(drives, read)
                better = there._misfit(new_line)
                if better < misfit:
                    break
            else:
                break
            now, line = there, new_line
            if misfit - better < _ENOUGH * misfit:
                break
        return now, line

    def _with_noise(self, line: LinearisedReadings, usual: torch.Tensor) -> MatrixPosterior:
        left = line.left.square().sum() + PSEUDO_READINGS * usual
        # The mean of its posterior, by which 95 % intervals of few readings are as wide as Student's
        variance = left / (line.unexplained + PSEUDO_READINGS - 2)
        return replace(self, variance=variance.expand_as(self.variance))

    @one_library_thread()
    def samples(
        self, drives: torch.Tensor, read: Magnitudes, generator: torch.Generator, count: int
    ) -> torch.Tensor:
        """Return samples (count, P, M) [Pa] of the matrix after fitted readings (N, P) of drives (N, M).

        Samples of the prior are corrected by the readings that they would give (Matheron's rule).
        """
        line = self.linearised(drives, read)
        return torch.stack([self._sample(line, generator) for _ in range(count)])

    def _sample(self, line: LinearisedReadings, generator: torch.Generator) -> torch.Tensor:
        widths = self.prior.widths
        factors = torch.randn(self.factors.shape, **REAL, generator=generator)
        entries = torch.randn(self.entries.shape, **COMPLEX, generator=generator)
        noise = line.noise.sqrt() * torch.randn(line.left.shape, **REAL, generator=generator)
        correction = line.explained(line.change(factors, entries) + noise)
        drawn = replace(
            self,
            factors=self.factors + widths * (factors - correction[0]),
            entries=self.entries + entries - correction[1],
        )
        if len(self.factors):
            return drawn.matrix
        # No reading shows the common phase of a row. Drawn as a straight step, it would make the row longer.
        turn = (drawn.matrix * self.matrix.conj()).sum(dim=1).imag / self.matrix.abs().square().sum(dim=1)
        return drawn.matrix - 1j * turn.nan_to_num()[:, None] * self.matrix

    def outliers(self, drives: torch.Tensor, read: Magnitudes, observed: torch.Tensor) -> torch.Tensor:
        """Return the readings (N, P), bool, of drives (N, M) that are far from this fit to `read`."""
        line, doubted = self.linearised(drives, read), read.outliers
        left = line.left
        if doubted.any():  # they are judged as if they were believed, by their phases too
            believed = replace(read, value=observed.where(doubted, read.value), limit=read.limit & ~doubted)
            left = self.linearised(drives, believed).left
        left = left.abs()
        pressure = left if read.deviation is None else self._in_pascals(left, read)
        far = pressure > _HARMLESS * self.matrix.norm(dim=1)
        if not far.any():
            return torch.zeros_like(read.limit)
        share = line.shares.masked_fill(~line.decided, 1)
        ratio = left / share.clamp_min(_LEAST_SHARE).sqrt()
        usual = ratio.masked_fill(~line.decided, torch.nan)
        # Of all readings, or of the point's: a row that the search missed explains none of its readings.
        deviation = torch.maximum(usual.nanmedian(), usual.nanmedian(dim=0).values.nan_to_num()) / _MEDIAN
        doubtful: torch.Tensor = far & (ratio > _OUTLIER * deviation)
        return doubtful.reshape(-1, *observed.shape).any(dim=0)

    def _in_pascals(self, left: torch.Tensor, read: Magnitudes) -> torch.Tensor:
        """Return differences (R, P) that count in the readings' deviations as those of magnitudes [Pa]."""
        assert read.deviation is not None
        by_drive = left.reshape(-1, *read.deviation.shape) * (read.deviation / read.stated)
        return by_drive.reshape(left.shape)

    def deviations(self, drives: torch.Tensor, read: Magnitudes) -> torch.Tensor:
        """Return how far the readings of each control point (P,) are from this fit, rms [Pa].

        It is over the number of readings that no unknown explains, at least 1.
        """
        line = self.linearised(drives, read)
        shares = (line.shares * line.decided).sum(dim=0)
        return (line.left.square().sum(dim=0) / shares.clamp_min(1)).sqrt()

    @property
    def changes(self) -> torch.Tensor:
        """Derivatives (K, P, M) [Pa] of the matrix by the amounts of changes."""
        return self._scaled()[1]

    def _scaled(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return rows (P, M) and changes (K, P, M) of the prior, by the factors."""
        rows, changes = self.prior.rows, self.prior.changes
        if not len(self.factors):
            return rows, changes
        gain, phase, scale, turn, amounts = self.prior.parts(self.factors)
        factor = torch.polar((gain + scale).exp(), phase + turn)
        return factor * (rows + (amounts[:, None, None] * changes).sum(dim=0)), factor * changes

    def linearised(self, drives: torch.Tensor, read: Magnitudes) -> LinearisedReadings:
        """Return readings (N, P) of drives (N, M), linearised around this matrix."""
        rows, changes = self._scaled()
        matrix = rows + self.prior.spread[:, None] * self.entries
        widths, spread = self.prior.widths, self.prior.spread
        return LinearisedReadings.at(matrix, rows, changes, widths, spread, drives, read, self.variance)

    def _steps(self, line: LinearisedReadings, read: Magnitudes) -> Iterator[MatrixPosterior]:
        """Yield the maximum where the readings were linear, and then nearer ones."""
        target = self._solved(line)
        yield target
        if read.deviation is None:
            for halving in range(1, _HALVINGS):
                yield self._towards(target, 0.5**halving)
            return
        # Pictures determine many factors at once; shares of their steps would have to be too small.
        for damping in _DAMPINGS:
            yield self._solved(line, damping)

    def _solved(self, line: LinearisedReadings, damping: float = 0.0) -> MatrixPosterior:
        """Return the maximum where the readings were linear; damping holds the factors near these."""
        here = self.factors / self.prior.widths
        held = damping / (1 + damping) * here
        left = line.left + line.change(here - held, self.entries)
        factors, entries = line.explained(left, damping)
        return replace(self, factors=self.prior.widths * (held + factors), entries=entries)

    def _towards(self, other: MatrixPosterior, share: float) -> MatrixPosterior:
        return replace(
            self,
            factors=torch.lerp(self.factors, other.factors, share),
            entries=self.entries + share * (other.entries - self.entries),
        )

    def misfit(self, drives: torch.Tensor, read: Magnitudes) -> torch.Tensor:
        """Return twice the negative logarithm of the posterior by readings (N, P), up to a constant."""
        return self._misfit(self.linearised(drives, read))

    def _misfit(self, line: LinearisedReadings) -> torch.Tensor:
        """Return twice the negative logarithm of the posterior, up to a constant."""
        readings = (line.left.square() / line.noise).sum()
        factors = (self.factors / self.prior.widths).square().sum()
        return readings + factors + 2 * self.entries.abs().square().sum()
