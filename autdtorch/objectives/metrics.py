"""Figures of merit of foci, from pressure magnitudes alone (Fig. 3)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from autdtorch.utils.validation import ArrayLike, positive, real_tensor


@dataclass(frozen=True, eq=False)
class FocusMetrics:
    """Figures of merit of the foci; (...) is the leading shape of the pressure they were computed from.

    Attributes:
        mean: mean pressure (...) of the foci [Pa] (Fig. 3a).
        min: pressure (...) of the weakest focus [Pa].
        std: standard deviation (...) among the foci [Pa], of the population (Fig. 3c).
        uniformity: (...), 1 - (max - min) / (max + min), from 0 to 1; 1 where all foci are equal.
        area: area (...) a focus [m^2] (Fig. 3b), or None without a plane.
    """

    mean: torch.Tensor
    min: torch.Tensor
    std: torch.Tensor
    uniformity: torch.Tensor
    area: torch.Tensor | None

    def __repr__(self) -> str:
        area = "none" if self.area is None else f"{1e6 * _median(self.area):.4g} mm²"
        return (
            f"FocusMetrics(mean {_median(self.mean):.4g} Pa, min {_median(self.min):.4g} Pa, "
            f"std {_median(self.std):.4g} Pa, uniformity {_median(self.uniformity):.3g}, area {area}; "
            f"medians of {self.mean.numel()})"
        )


def focus_metrics(
    pressure: ArrayLike, plane_pressure: ArrayLike | None = None, cell_area: float | None = None
) -> FocusMetrics:
    """Compute the figures of merit of foci.

    The area counts the cells of the observation plane in which |p| is at least the mean pressure of the foci
    over sqrt(2) (half its intensity), divided by the number of foci. The paper's "threshold above sqrt(2) of
    the average sound pressure", taken as a factor, would leave nearly no area at all.

    Args:
        pressure: magnitudes at the foci (..., P) [Pa].
        plane_pressure: magnitudes in the cells of the observation plane (..., Nu, Nv) [Pa], with the same
            leading shape; only for the area.
        cell_area: area of one cell [m^2], > 0; with `plane_pressure` alone.

    Raises:
        ValueError: not finite, negative, shapes that do not fit, or only one of the last two.
    """
    pressure = _magnitudes("pressure", pressure, 1)
    largest, smallest = pressure.amax(dim=-1), pressure.amin(dim=-1)
    mean, total = pressure.mean(dim=-1), largest + smallest
    return FocusMetrics(
        mean=mean,
        min=smallest,
        std=(pressure - mean[..., None]).square().mean(dim=-1).sqrt(),
        uniformity=1 - torch.where(total > 0, (largest - smallest) / total, 0.0),
        area=_area_per_focus(pressure, plane_pressure, cell_area),
    )


def _area_per_focus(
    pressure: torch.Tensor, plane_pressure: ArrayLike | None, cell_area: float | None
) -> torch.Tensor | None:
    if plane_pressure is None and cell_area is None:
        return None
    if plane_pressure is None or cell_area is None:
        missing = "plane_pressure" if plane_pressure is None else "cell_area"
        raise ValueError(f"{missing}: None; must be given where the other of plane_pressure and cell_area is")
    cell_area = positive("cell_area", cell_area, "m^2")
    plane = _magnitudes("plane_pressure", plane_pressure, 2).to(pressure.device)
    if plane.shape[:-2] != pressure.shape[:-1]:
        expected = ", ".join([*map(str, pressure.shape[:-1]), "Nu", "Nv"])
        raise ValueError(f"plane_pressure: shape {tuple(plane.shape)}; must be ({expected}), like pressure")
    threshold = pressure.mean(dim=-1)[..., None, None] / math.sqrt(2)
    loud = (plane >= threshold) & (threshold > 0)  # silent foci have no area
    return loud.sum(dim=(-2, -1), dtype=torch.float64) * (cell_area / pressure.shape[-1])


def _median(values: torch.Tensor) -> float:
    return float(values.double().quantile(0.5)) if values.numel() else math.nan


def _magnitudes(name: str, value: ArrayLike, axes: int) -> torch.Tensor:
    magnitudes = real_tensor(name, value, "Pa")
    if magnitudes.ndim < axes or 0 in magnitudes.shape[-axes:]:
        layout = "(..., P) with P >= 1" if axes == 1 else "(..., Nu, Nv) with at least one cell"
        raise ValueError(f"{name}: shape {tuple(magnitudes.shape)}; must be {layout}")
    if magnitudes.numel() and magnitudes.min() < 0:
        raise ValueError(f"{name}: {magnitudes.min().item():g} Pa; every magnitude must be >= 0")
    return magnitudes
