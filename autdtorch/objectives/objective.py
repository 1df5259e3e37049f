"""Objectives: black boxes that take drives and give the pressure magnitudes at the control points.

Neither a microphone nor a thermal camera measures a phase, so a method cannot distinguish a simulated
objective from a measured one. For the same reason, observations have no gradient; propagators have.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Literal, Protocol, TypeAlias, runtime_checkable

import torch

from autdtorch.scene.drive import validate_drive
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import device_of
from autdtorch.utils.process import one_library_thread
from autdtorch.utils.text import counted
from autdtorch.utils.validation import (
    ArrayLike,
    complex_tensor,
    invalid,
    real_tensor,
    require_kind,
    require_one_of,
)

if TYPE_CHECKING:
    from autdtorch.propagators import Propagator

logger = logging.getLogger(__name__)

GoalFunction: TypeAlias = Callable[[torch.Tensor], torch.Tensor]
"""A goal, such as a `Goal`: a function of pressures (..., P) [Pa] that gives the scores (...) to maximise."""


@runtime_checkable
class Objective(Protocol):
    """Observes the control points of a scene, simulated or real.

    Observations are plain numbers, as of a microphone: the gradient of a drive ends here, and is logged once
    as lost. Gradients by the drive come from a propagator's `field` or `transfer_matrix`, gradients by
    materials too from `differentiable_field`. `gradient_ascent` maximises a goal by them.

    Attributes:
        scene: its array plays the drives, and its control points are observed.
        evaluations: number of observations so far.
    """

    scene: Scene

    @property
    def evaluations(self) -> int:
        """Number of observations so far."""
        ...

    def __call__(self, drive: torch.Tensor) -> torch.Tensor:
        """Observe drives (B, M), complex, |q| <= 1: pressure magnitudes (B, P) [Pa], one evaluation each.

        The objectives of this package take drives (..., M), and give magnitudes (..., P).
        """
        ...


def require_objective(objective: Objective) -> None:
    """Check that `objective` is an objective of a scene."""
    if not isinstance(objective, Objective):
        accepted = "must be an Objective, such as SimulatedObjective(scene, make_propagator(scene))"
        raise invalid("objective", objective, accepted)
    require_kind("objective.scene", objective.scene, Scene)


def observe_drives(
    observe: Callable[[torch.Tensor], torch.Tensor], drive: torch.Tensor, transducers: int
) -> torch.Tensor:
    """Return magnitudes (..., P) [Pa] of drives (..., M) from a function that takes (B, M) and gives (B, P).

    `ValueError` for no drive, another M than `transducers`, not finite complex numbers, or |q| > 1.
    """
    device, drive = device_of(drive), validate_drives(drive, transducers)
    pressure = observe(drive.reshape(-1, transducers))
    return pressure.reshape(*drive.shape[:-1], -1).to(device)


def validate_drives(drive: torch.Tensor, transducers: int, name: str = "drive") -> torch.Tensor:
    """Check drives (..., M), at least one, and return them as complex128 on the CPU, without gradient."""
    drive = validate_drive(drive, transducers, name)
    if drive.requires_grad and torch.is_grad_enabled():
        _log_lost_gradient()
    drive = drive.detach().cpu()
    if drive.numel() == 0:
        raise ValueError(f"{name}: shape {tuple(drive.shape)}; must be (..., {transducers}), not empty")
    return drive


@functools.cache  # once is enough: drives in a loop would fill the log
def _log_lost_gradient() -> None:
    logger.warning(
        "an objective observes magnitudes without gradient, and the drive's is lost; propagator.field(drive, "
        "points), at.differentiable_field and at.gradient_ascent have gradients"
    )


def validate_magnitudes(name: str, value: object, points: int, unit: str = "Pa") -> torch.Tensor:
    """Return observed magnitudes (P,) of `points` control points as float64, after checking them."""
    magnitudes = real_tensor(name, value, unit)
    if magnitudes.shape != (points,) or magnitudes.min() < 0:
        raise invalid(name, value, f"must be {points} numbers >= 0", unit)
    return magnitudes


def validate_matrix(name: str, value: object, points: int, transducers: int) -> torch.Tensor:
    """Return a transfer matrix (P, M) [Pa] as complex128 on the CPU, without gradient, after checking it."""
    matrix = complex_tensor(name, value).detach().cpu()
    if matrix.shape != (points, transducers):
        raise ValueError(f"{name}: shape {tuple(matrix.shape)}; must be ({points}, {transducers})")
    return matrix


def weakest_focus(pressure: torch.Tensor) -> torch.Tensor:
    """Return the pressure of the weakest focus (...) [Pa] of pressures (..., P): the paper's f = min(p_n)."""
    return checked_pressure(pressure).amin(dim=-1)


def checked_pressure(pressure: ArrayLike) -> torch.Tensor:
    """Return pressures (..., P) [Pa] with P >= 1 as float64, after checking them."""
    checked = real_tensor("pressure", pressure, "Pa")
    if checked.ndim == 0 or checked.shape[-1] == 0:
        raise ValueError(f"pressure: shape {tuple(checked.shape)}; must be (..., P) with P >= 1")
    return checked


_PRODUCTS = 2**16  # of transfer matrix and drives, that are computed at once


class SimulatedObjective:
    """An objective whose observations are simulated.

    It gives magnitudes without gradient, as a measurement would (see `Objective`). With gradient, the
    pressures of the control points are ``propagator.field(drive, scene.control_points)``, or ``drive @ G.mT``
    with its `transfer_matrix` G.

    Attributes:
        scene: its array plays the drives, and its control points are observed.
        evaluations: number of observations so far.
        transfer_matrix: G (P, M) [Pa], complex128; None in mode "replay". Only `GradientAscent` and methods
            with a `Prior` use it.
    """

    def __init__(
        self, scene: Scene, propagator: Propagator, mode: Literal["transfer", "replay"] = "transfer"
    ) -> None:
        """Prepare the observations.

        Args:
            scene: of the propagator, or an equal one.
            propagator: simulates the scene.
            mode: "transfer" simulates the transfer matrix G once, here, and observes |G q|, since the field
                is linear in the drive. "replay" asks the propagator for the field of every drive: a
                simulation for each, as in the paper, unless the propagator has stored its outgoing field.
        """
        from autdtorch.propagators import Propagator  # takes a second, and is loaded where there is one

        require_kind("scene", scene, Scene)
        require_kind("propagator", propagator, Propagator)
        require_one_of("mode", mode, ("transfer", "replay"))
        if not scene.equals(propagator.scene):
            raise invalid("scene", scene, f"must be the propagator's scene, {propagator.scene!r}")
        self.scene = propagator.scene
        self.evaluations = 0
        self._propagator = propagator
        self.transfer_matrix: torch.Tensor | None = None
        if mode == "transfer":
            self.transfer_matrix = propagator.transfer_matrix().to("cpu", torch.complex128)

    @classmethod
    def of_matrix(cls, scene: Scene, transfer_matrix: ArrayLike) -> SimulatedObjective:
        """Return the objective of a scene whose transfer matrix (P, M) [Pa] is known."""
        require_kind("scene", scene, Scene)
        objective = cls.__new__(cls)
        objective.scene, objective.evaluations = scene, 0
        shape = len(scene.control_points), len(scene.array)
        objective.transfer_matrix = validate_matrix("transfer_matrix", transfer_matrix, *shape)
        return objective

    def __repr__(self) -> str:
        mode = "replay" if self.transfer_matrix is None else "transfer"
        evaluations = counted(self.evaluations, "evaluation")
        return f"SimulatedObjective(scene {self.scene.name!r}, mode {mode!r}, {evaluations})"

    @one_library_thread()
    def __call__(self, drive: torch.Tensor) -> torch.Tensor:
        """Observe the control points under each of several drives.

        Args:
            drive: (..., M) complex, |q| <= 1; each drive is an evaluation.

        Returns:
            Pressure magnitudes (..., P) [Pa], float64, without gradient. In mode "transfer" a row
            is rounded alike, whatever the other rows and the number of threads.

        Raises:
            ValueError: no drive, another shape, not finite complex numbers, or an amplitude above 1.
        """
        return observe_drives(self._observe, drive, len(self.scene.array))

    def _observe(self, drive: torch.Tensor) -> torch.Tensor:
        self.evaluations += len(drive)
        if self.transfer_matrix is None:
            # One by one: a propagator may use the transfer matrix for many drives at once.
            rows = [self._propagator.field(row, self.scene.control_points) for row in drive]
            return torch.stack(rows).abs().cpu()
        # In parts, as large temporary arrays take most of the time
        parts = torch.split(drive, max(1, _PRODUCTS // self.transfer_matrix.numel()))
        return torch.cat([magnitudes(self.transfer_matrix, part) for part in parts])


def magnitudes(matrix: torch.Tensor, drive: torch.Tensor) -> torch.Tensor:
    """Return |G q| (B, P) of drives (B, M), with the same rounding for every row.

    A search through thousands of choices amplifies differences of rounding. BLAS rounds by the number of
    rows, and complex products by their place in a vector register; single real operations always round alike.
    """
    a, b = matrix.real.contiguous(), matrix.imag.contiguous()
    c, d = drive.real.contiguous()[:, None], drive.imag.contiguous()[:, None]
    real, imaginary = (a * c - b * d).sum(dim=-1), (a * d + b * c).sum(dim=-1)
    return (real.square() + imaginary.square()).sqrt()
