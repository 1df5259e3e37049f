"""Gaussian processes over drives: one model holds the processes of all trials and foci in its batch shape."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, Literal, NamedTuple, TypeAlias

import torch
from botorch.fit import fit_gpytorch_mll
from botorch.models import SingleTaskGP
from gpytorch.kernels import Kernel, MaternKernel
from gpytorch.means import ZeroMean
from gpytorch.mlls import ExactMarginalLogLikelihood

from autdtorch.methods.matrix_posterior import PSEUDO_READINGS, USUAL_NOISE
from autdtorch.utils.array_types import REAL
from autdtorch.utils.validation import complex_tensor, invalid, real_tensor, require_one_of


class PhasorKernel(Kernel):  # type: ignore[misc]
    """The covariance of the intensity |g . q|^2 at a point, over drives q.

    The row g of the transfer matrix is Gaussian, with the mean g0 and independent circular entries of the
    variance s^2. Two drives q and q' with the product b = sum_m q_m conj(q'_m) then have intensities of the
    covariance ``s^4 |b|^2 + 2 s^2 Re(conj(g0 . q) (g0 . q') b)`` and of the mean ``|g0 . q|^2 + s^2 |q|^2``
    (fourth moments of Gaussian variables, Isserlis 1918). No hyperparameter is left to fit. Phases enter with
    their period, and an offset that all phases share changes nothing.
    """

    has_lengthscale = False

    def __init__(
        self,
        inputs: str = "phases",
        rows: torch.Tensor | None = None,
        variance: torch.Tensor | None = None,
        **settings: Any,
    ) -> None:
        """Make the kernel.

        Args:
            inputs: "phases": inputs (..., M - 1) are phases in turns of fully driven transducers; one
                transducer, whichever it is, keeps phase 0, and is the last of a row. "drives": inputs
                (..., 2 M) are the real parts of drives, then their imaginary parts.
            rows: g0 (..., M), complex; the dimensions before are those of a batch. 0 by default.
            variance: s^2 (...), > 0, with `rows` alone. Without them 1 / M: intensities are in units of their
                mean at full drive.
            settings: of `gpytorch.kernels.Kernel`.

        Raises:
            ValueError: unknown inputs; rows or a variance that are no finite numbers, one without the other,
                or of shapes that do not fit.
        """
        require_one_of("inputs", inputs, ("phases", "drives"))
        if (rows is None) != (variance is None):
            raise invalid("variance", variance, "must be given with rows, and only then")
        if rows is not None and variance is not None:
            rows, variance = complex_tensor("rows", rows), real_tensor("variance", variance)
            if rows.ndim == 0 or variance.shape != rows.shape[:-1] or not bool((variance > 0).all()):
                raise invalid("variance", variance, f"must be > 0, of shape {tuple(rows.shape[:-1])}")
            settings.setdefault("batch_shape", rows.shape[:-1])
        super().__init__(**settings)
        self.inputs = inputs
        # As real numbers: PyTorch's `Module.to` would drop imaginary parts.
        self.register_buffer("_rows", None if rows is None else torch.view_as_real(rows.resolve_conj()))
        self.register_buffer("variance", variance)

    @property
    def rows(self) -> torch.Tensor | None:
        """The rows (..., M), complex, or None."""
        return None if self._rows is None else torch.view_as_complex(self._rows)

    def __getitem__(self, index: Any) -> PhasorKernel:
        """Return the kernel of a part of the batch."""
        if self.rows is None:
            return super().__getitem__(index)  # type: ignore[no-any-return]
        return PhasorKernel(self.inputs, self.rows[index], self.variance[index])

    def forward(self, x1: torch.Tensor, x2: torch.Tensor, diag: bool = False, **_: Any) -> torch.Tensor:
        """Return covariances (..., N1, N2) of inputs (..., N1, D) and (..., N2, D); (..., N) with `diag`."""
        if self.inputs == "phases":
            x1, x2 = phasors(x1), phasors(x2)
        real, imaginary = _products(x1, x2, diag)
        variance = self._variance(x1) if diag else self._variance(x1)[..., None]
        covariance = variance**2 * (real.square() + imaginary.square())
        if self.rows is None:
            return covariance
        of_means = _products(_pressures(x1, self.rows), _pressures(x2, self.rows), diag)
        return covariance + 2 * variance * (of_means[0] * real + of_means[1] * imaginary)

    def mean(self, x: torch.Tensor) -> torch.Tensor:
        """Return the mean intensities (..., N) of inputs (..., N, D); `ValueError` for other shapes."""
        x = real_tensor("x", x)
        if x.ndim < 2 or x.numel() == 0:
            raise ValueError(f"x: shape {tuple(x.shape)}; must be (..., N, D), not empty")
        if self.inputs == "phases":
            x = phasors(x)
        mean = self._variance(x) * x.square().sum(dim=-1)
        return mean if self.rows is None else mean + _pressures(x, self.rows).square().sum(dim=-1)

    def _variance(self, x: torch.Tensor) -> torch.Tensor:
        """Return s^2 (..., 1) for drives (..., 2 M)."""
        return x.new_tensor([2 / x.shape[-1]]) if self.variance is None else self.variance[..., None]


def _products(x1: torch.Tensor, x2: torch.Tensor, diag: bool) -> tuple[torch.Tensor, torch.Tensor]:
    """Return real and imaginary parts of the products of x1 and the conjugate of x2, summed over entries.

    Entries (..., N, 2 M) are real parts, then imaginary parts. Products are (..., N1, N2), or (..., N) with
    `diag`.
    """
    entries = x1.shape[-1] // 2
    turned = torch.cat([x1[..., entries:], -x1[..., :entries]], dim=-1)
    if diag:
        return (x1 * x2).sum(dim=-1), (turned * x2).sum(dim=-1)
    return x1 @ x2.mT, turned @ x2.mT


def _pressures(x: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
    """Return g . q (..., N, 2), real and imaginary part, of drives (..., N, 2 M) and rows (..., M)."""
    real, imaginary = rows.real, rows.imag
    by_parts = [torch.cat([real, -imaginary], dim=-1), torch.cat([imaginary, real], dim=-1)]
    return x @ torch.stack(by_parts, dim=-1)


def phasors(points: torch.Tensor) -> torch.Tensor:
    """Return drives (..., 2 M), real and imaginary parts, of phases (..., M - 1) in turns and of phase 0."""
    phases = -2 * math.pi * torch.cat([points, torch.zeros_like(points[..., :1])], dim=-1)
    return torch.cat([phases.cos(), phases.sin()], dim=-1)


def on_circle(points: torch.Tensor) -> torch.Tensor:
    """Return points (..., 2 D) on circles, (cos, sin), of phases (..., D) in turns."""
    angles = 2 * math.pi * points
    return torch.cat([angles.cos(), angles.sin()], dim=-1)


KernelName: TypeAlias = Literal["phases", "circle", "phasor"]
"""The space in which a process measures phases: as numbers, on the circle, or by the phasors they make."""

_FEATURES = {"phases": lambda points: points, "circle": on_circle, "phasor": phasors}
_LEAST_VARIANCE = 1e-12
"""Smallest variance of a posterior: rounding may leave one below 0 at an observed point."""

_JITTER = 1e-5
"""Variance added to intensities, in variances of the process, so that their covariance can be inverted."""

_DARK = 1e-12  # least mean intensity of a focus, relative to the strongest
_TINY = 1e-30  # least mean intensity where all foci are dark [Pa^2]
_PHASOR_REACH = 0.2  # [turns]

_NOISES = 10.0 ** torch.linspace(-6, 0, 25, **REAL)
"""Candidates for the variance of a reading's noise, in mean intensities."""


class Hyperparameters(NamedTuple):
    """The fitted hyperparameters of the processes of T trials, with K outputs each.

    Attributes:
        length_scale: of the Matern kernel (T, K); ones for the phasor kernel, which has none.
        noise: variance of the noise (T, K): of values in variances of the process, or, for the phasor
            kernel, of a reading in mean intensities.
    """

    length_scale: torch.Tensor
    noise: torch.Tensor

    def of(self, outputs: list[int]) -> Hyperparameters:
        """Return the hyperparameters of some outputs."""
        return Hyperparameters(*(part[:, outputs] for part in self))

    def to(self, device: str) -> Hyperparameters:
        """Return them on a device."""
        return Hyperparameters(*(part.to(device) for part in self))


class MatrixRows(NamedTuple):
    """The rows of the transfer matrix as they are known before the observations.

    Attributes:
        mean: (T, K, M) [Pa], complex; the transducer whose phase stays 0 is the last.
        variance: of an entry (T, K) [Pa^2].
        best: phases in turns (T, D) of a drive that focuses best by the mean.
    """

    mean: torch.Tensor
    variance: torch.Tensor
    best: torch.Tensor

    def of(self, outputs: list[int]) -> MatrixRows:
        """Return the rows of some outputs."""
        return MatrixRows(self.mean[:, outputs], self.variance[:, outputs], self.best)

    def to(self, device: str) -> MatrixRows:
        """Return the rows on a device."""
        return MatrixRows(*(part.to(device) for part in self))


class Posterior(NamedTuple):
    """Mean and standard deviation at points, both (T, C, K)."""

    mean: torch.Tensor
    deviation: torch.Tensor


class Processes:
    """Gaussian processes of T trials with K outputs each, in the batch shape of one `SingleTaskGP`.

    With the kernels "phases" and "circle" (Matern 5/2) the process models the values, standardised. With the
    kernel "phasor" it models the intensities of pressures, in units of their mean.

    Attributes:
        periodic: whether phases have their period.
        reach: length over which a process varies (T,) [turns].
        mean: of the processes before the observations (T, 1, K).
        scale: standard deviation, likewise.
    """

    def __init__(
        self,
        kernel: KernelName,
        points: torch.Tensor,
        values: torch.Tensor,
        fit: Hyperparameters,
        rows: MatrixRows | None = None,
    ) -> None:
        """Condition the processes on observations.

        Args:
            kernel: space in which phases are measured.
            points: phases in turns (T, N, D).
            values: scores or pressures (T, N, K).
            fit: hyperparameters.
            rows: for the kernel "phasor". Without them, each output has the same covariances.
        """
        self._features = _FEATURES[kernel]
        observed = self._features(points)
        self.periodic = kernel != "phases"
        self.reach = _reach(kernel, fit)
        standard, self.mean, self.scale = standardised(kernel, values, fit.noise)
        self._shared = rows is None
        self._kernel = _kernel(kernel, fit, rows, self.scale[:, 0])
        # For the kernels "phases" and "circle", GPyTorch's Matern kernel written out takes half the time
        matern = partial(_matern, length_scale=fit.length_scale)
        self._covariance: Any = self._kernel.forward if kernel == "phasor" else matern
        excess = self._excess(observed)
        variance = fit.noise[:, None]
        if kernel == "phasor":
            variance = _intensity_variance(variance, 1 + excess)
        self.model = SingleTaskGP(
            observed, standard - excess, variance.expand_as(standard).contiguous(),
            covar_module=self._kernel, mean_module=ZeroMean(), outcome_transform=None,
        ).eval().requires_grad_(False)  # fmt: skip
        self.model.posterior(observed[:, :1])  # makes GPyTorch's caches
        cached: Any = self.model.prediction_strategy
        shape = *values.shape[::2], -1
        self._observed = self._by_output(observed)
        self._weights = cached.mean_cache.reshape(*shape, 1)
        factor = cached.lik_train_train_covar.cholesky().to_dense().reshape(*shape, points.shape[1])
        identity = torch.eye(points.shape[1], dtype=factor.dtype, device=factor.device)
        self._whitening = torch.linalg.solve_triangular(factor, identity, upper=False).mT

    def at(self, points: torch.Tensor) -> Posterior:
        """Return the posterior at points (T, C, D), in the units of scores, or of intensities.

        It equals the model's, written out from its caches: no covariance between points is needed.
        """
        features = self._features(points)
        there = self._by_output(features)
        covariance = self._covariance(there, self._observed)
        variance: torch.Tensor | float = 1.0
        if self._shared:
            covariance = covariance[:, None]
        else:
            variance = self._covariance(there, there, diag=True)
        mean = self._excess(features) + (covariance @ self._weights)[..., 0].mT
        unexplained = (variance - (covariance @ self._whitening).square().sum(dim=-1)).mT
        deviation = unexplained.clamp_min(_LEAST_VARIANCE).sqrt()
        return Posterior(self.mean + self.scale * mean, self.scale * deviation)

    def _by_output(self, features: torch.Tensor) -> torch.Tensor:
        """Return features (T, N, F) for the covariances of all outputs, or of each output."""
        return features if self._shared else features[:, None]

    def _excess(self, features: torch.Tensor) -> torch.Tensor | float:
        """Return the means before the observations (T, C, K), less `mean`, in units of `scale`."""
        return 0.0 if self._shared else self._kernel.mean(features[:, None]).mT - 1


def standardised(
    kernel: KernelName, values: torch.Tensor, noise: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return the values (T, N, K) as a process models them, their mean and their unit (T, 1, K)."""
    if kernel != "phasor":
        mean, unit = values.mean(dim=1, keepdim=True), values.std(dim=1, keepdim=True)
        unit = unit.clamp_min(1e-6 * mean.abs()).clamp_min(_LEAST_VARIANCE)  # values that never change
        return (values - mean) / unit, mean, unit
    # A reading is |p + n|, n circular Gaussian noise: its square is above |p|^2 by the noise's variance.
    intensity = values.square()
    unit = mean_intensity(values)[:, None] / (1 + noise[:, None])
    return intensity / unit - noise[:, None] - 1, unit, unit


def fitted(
    kernel: KernelName, points: torch.Tensor, values: torch.Tensor, noise: float | Literal["inferred"]
) -> Hyperparameters:
    """Return the hyperparameters of the largest marginal likelihood.

    Args:
        kernel: space in which phases are measured.
        points: phases in turns (T, N, D).
        values: scores or pressures (T, N, K).
        noise: as in `Hyperparameters`; "inferred" to fit it, too.
    """
    shape = values.shape[0], values.shape[2]
    fixed = torch.full(shape, 0.0 if isinstance(noise, str) else noise, **REAL)
    if kernel == "phasor":
        ones = torch.ones_like(fixed)
        return Hyperparameters(ones, _likeliest_noise(points, values) if isinstance(noise, str) else fixed)
    standard = standardised(kernel, values, fixed)[0]
    fits = [
        [_fit_alone(kernel, turns, column[:, None], noise) for column in columns.T]
        for turns, columns in zip(points, standard, strict=True)
    ]
    length_scale, variance = torch.tensor(fits, **REAL).unbind(dim=-1)
    return Hyperparameters(length_scale, variance)


def _fit_alone(
    kernel: KernelName, points: torch.Tensor, standard: torch.Tensor, noise: float | Literal["inferred"]
) -> tuple[float, float]:
    """Return length scale and noise of one process; a joint fit of many would couple them (L-BFGS)."""
    known = None if isinstance(noise, str) else torch.full_like(standard, noise)
    model = SingleTaskGP(
        _FEATURES[kernel](points), standard, known,
        covar_module=MaternKernel(2.5), mean_module=ZeroMean(), outcome_transform=None,
    )  # fmt: skip
    fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model))
    variance = model.likelihood.noise.mean()
    return model.covar_module.lengthscale.item(), variance.item()


def _likeliest_noise(points: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """Return the variance of a reading's noise (T, P), in mean intensities, equal in pascals for all foci.

    Few intensities are as likely noise alone, so the noise has the prior of `MatrixPosterior.fitted`, a
    scaled inverse chi-squared distribution that stands for some readings of the usual noise.
    """
    features, intensity = phasors(points), values.square()
    mean = mean_intensity(values)
    share, vectors = torch.linalg.eigh(PhasorKernel("drives").forward(features, features))
    seen = (vectors.mT @ (intensity / mean[:, None] - 1)).square()
    variance = _NOISES[:, None, None] * mean.mean(dim=-1, keepdim=True)
    noise = variance / (mean - variance).clamp_min(0.1 * mean)
    unit = 1 + noise
    spread = share.clamp_min(0)[..., None] + _intensity_variance(noise)[:, :, None]
    misfit = (spread.log() + unit[:, :, None].square() * seen / spread).sum(dim=2)
    fit = (len(seen[0]) * unit.log() - 0.5 * misfit).sum(dim=-1)
    prior = -0.5 * PSEUDO_READINGS * (_NOISES.log() + USUAL_NOISE**2 / _NOISES)
    return noise[(fit + prior[:, None]).argmax(dim=0), torch.arange(len(mean), device="cpu")]


def mean_intensity(pressure: torch.Tensor) -> torch.Tensor:
    """Return the mean squares (T, K) of pressures (T, N, K); of a focus that nothing reaches, not quite 0."""
    mean = pressure.square().mean(dim=1)
    return mean.clamp_min(_DARK * mean.amax(dim=1, keepdim=True)).clamp_min(_TINY)


def _intensity_variance(noise: torch.Tensor, expected: torch.Tensor | float = 1.0) -> torch.Tensor:
    # |p + n|^2 has the variance 2 |p|^2 s^2 + s^4.
    return noise * (2 * expected + noise) + _JITTER


def _kernel(kernel: KernelName, fit: Hyperparameters, rows: MatrixRows | None, unit: torch.Tensor) -> Any:
    """Return the covariance of the modelled values; `unit` of intensities (T, K)."""
    if kernel != "phasor":
        matern = MaternKernel(2.5, batch_shape=fit.length_scale.shape[:1])
        matern.lengthscale = fit.length_scale[..., None].cpu()  # the model moves it
        return matern
    if rows is None:
        return PhasorKernel("drives")
    return PhasorKernel("drives", rows.mean / unit[..., None].sqrt(), rows.variance / unit)


def _matern(x1: torch.Tensor, x2: torch.Tensor, length_scale: torch.Tensor) -> torch.Tensor:
    """Return Matern 5/2 covariances (T, N1, N2) of inputs (T, N1, D) and (T, N2, D)."""
    distance = math.sqrt(5) * torch.cdist(x1, x2) / length_scale[..., None]
    return (1 + distance + distance.square() / 3) * (-distance).exp()


def _reach(kernel: KernelName, fit: Hyperparameters) -> torch.Tensor:
    if kernel == "phasor":
        return fit.noise.new_full(fit.noise.shape[:1], _PHASOR_REACH)
    shortest = fit.length_scale.amin(dim=-1)
    return shortest / (2 * math.pi) if kernel == "circle" else shortest
