"""The black box that the optimisers see: drives in, pressure magnitudes at the control points out.

Neither a microphone nor a thermal camera gives a phase, so that an optimiser cannot tell a simulated
objective from a measured one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, Protocol, TypeAlias, runtime_checkable

import torch

from autdtorch.propagators import Propagator
from autdtorch.scene.drive import validate_drive
from autdtorch.scene.scene import Scene
from autdtorch.utils.threads import one_torch_thread
from autdtorch.utils.validation import invalid, real_tensor, require_kind, require_one_of

#: What is maximised: pressure (..., P) [Pa] to score (...).
Score: TypeAlias = Callable[[torch.Tensor], torch.Tensor]


@runtime_checkable
class Objective(Protocol):
    """Observes the control points of a scene, simulated or real.

    Attributes:
        scene: its array plays the drives, its control points are observed.
        evaluations: number of observations so far.
    """

    scene: Scene
    evaluations: int

    def __call__(self, drive: torch.Tensor) -> torch.Tensor:
        """Observe drives (B, M), complex, |q| <= 1: pressure magnitudes (B, P) [Pa], an evaluation a row."""
        ...


def require_objective(objective: Objective) -> None:
    """Check that `objective` is one, of a scene.

    Raises:
        ValueError: it is not.
    """
    require_kind("objective", objective, Objective)
    require_kind("objective.scene", objective.scene, Scene)


class SimulatedObjective:
    """An objective whose observations are simulated.

    Attributes:
        scene: its array plays the drives, its control points are observed.
        evaluations: number of observations so far.
        transfer_matrix: G (P, M) [Pa], complex128; None in mode "replay". Not for black-box methods.
    """

    scene: Scene
    evaluations: int
    transfer_matrix: torch.Tensor | None

    def __init__(
        self, scene: Scene, propagator: Propagator, mode: Literal["transfer", "replay"] = "transfer"
    ) -> None:
        """Prepare the observations.

        Args:
            scene: the scene that `propagator` was made for.
            propagator: simulates the scene.
            mode: "transfer" simulates the transfer matrix G here, once, and observes |G q|: the field is
                linear in the drive. "replay" runs a simulation for every evaluation, as the paper does.

        Raises:
            ValueError: another mode, no propagator, or one of another scene.
        """
        require_kind("scene", scene, Scene)
        require_kind("propagator", propagator, Propagator)
        require_one_of("mode", mode, ("transfer", "replay"))
        if propagator.scene is not scene:
            raise invalid("scene", scene, f"must be the propagator's scene, {propagator.scene!r}")
        self.scene = scene
        self.evaluations = 0
        self._propagator = propagator
        self.transfer_matrix = None
        if mode == "transfer":
            self.transfer_matrix = propagator.transfer_matrix().to("cpu", torch.complex128)

    def __repr__(self) -> str:
        """Scene, mode and evaluations so far."""
        mode = "replay" if self.transfer_matrix is None else "transfer"
        return f"SimulatedObjective(scene {self.scene.name!r}, mode {mode!r}, {self.evaluations} evaluations)"

    @one_torch_thread()
    def __call__(self, drive: torch.Tensor) -> torch.Tensor:
        """Observe the control points under each of several drives.

        Args:
            drive: (B, M) complex, |q| <= 1.

        Returns:
            Pressure magnitudes (B, P) [Pa], float64, on the CPU, without gradient. In mode "transfer" a row
            does not depend on the rows beside it, nor on the number of threads, not even in its rounding.

        Raises:
            ValueError: another shape, not finite complex numbers, or an amplitude above 1.
        """
        drive = validate_drives(drive, len(self.scene.array))
        self.evaluations += len(drive)
        if self.transfer_matrix is None:
            # One by one: given many drives at once, a propagator may take the transfer matrix as well.
            rows = [self._propagator.field(row, self.scene.control_points) for row in drive]
            return torch.stack(rows).abs().cpu()
        return _magnitudes(self.transfer_matrix, drive)


def _magnitudes(matrix: torch.Tensor, drive: torch.Tensor) -> torch.Tensor:
    """|G q| (B, P) of drives (B, M), every row rounded in the same way.

    A search through thousands of choices amplifies any other rounding until a trial depends on the trials
    beside it. BLAS rounds by the number of rows, complex products by their place in a vector register and so
    by where threads begin; single real operations round in one way only.
    """
    drive = drive.contiguous()[:, None]
    real = (matrix.real * drive.real - matrix.imag * drive.imag).sum(dim=-1)
    imaginary = (matrix.real * drive.imag + matrix.imag * drive.real).sum(dim=-1)
    return (real.square() + imaginary.square()).sqrt()


def validate_drives(drive: torch.Tensor, transducers: int) -> torch.Tensor:
    """Drives (B, M) to observe, complex128, on the CPU and without gradient, after checking them.

    Raises:
        ValueError: another shape, not finite complex numbers, or an amplitude above 1.
    """
    drive = validate_drive(drive, transducers).detach().cpu()
    if drive.ndim != 2 or len(drive) == 0:
        raise ValueError(f"drive: shape {tuple(drive.shape)}; must be (B, {transducers}) with B >= 1")
    return drive


def validate_magnitudes(name: str, value: object, points: int) -> torch.Tensor:
    """Return observed magnitudes (P,) [Pa], float64, after checking them.

    Args:
        name: of the field, for the message.
        value: what was observed.
        points: number of control points P.

    Raises:
        ValueError: not P finite real numbers >= 0.
    """
    pressure = real_tensor(name, value, "Pa")
    if pressure.shape != (points,) or pressure.min() < 0:
        raise invalid(name, value, f"must be {points} numbers >= 0", "Pa")
    return pressure


def weakest_focus(pressure: torch.Tensor) -> torch.Tensor:
    """Return the weakest (...) [Pa] of the foci of a `pressure` (..., P): the paper's f = min(p_n).

    Raises:
        ValueError: not finite real numbers, or no focus.
    """
    pressure = real_tensor("pressure", pressure, "Pa")
    if pressure.ndim == 0 or pressure.shape[-1] == 0:
        raise ValueError(f"pressure: shape {tuple(pressure.shape)}; must be (..., P) with P >= 1")
    return pressure.amin(dim=-1)
