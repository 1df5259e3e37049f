"""The simulated objective: a scene and its propagator."""

from __future__ import annotations

from typing import Literal

import torch

from autdtorch.objectives.objective import observe_drives
from autdtorch.propagators import Propagator
from autdtorch.scene.scene import Scene
from autdtorch.utils.display import counted
from autdtorch.utils.process import one_library_thread
from autdtorch.utils.validation import invalid, require_kind, require_one_of

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

    def __repr__(self) -> str:
        """Return scene, mode and number of evaluations."""
        mode = "replay" if self.transfer_matrix is None else "transfer"
        evaluations = counted(self.evaluations, "evaluation")
        return f"SimulatedObjective(scene {self.scene.name!r}, mode {mode!r}, {evaluations})"

    @one_library_thread()
    def __call__(self, drive: torch.Tensor) -> torch.Tensor:
        """Observe the control points under each of several drives.

        Args:
            drive: (..., M) complex, |q| <= 1; each drive is an evaluation.

        Returns:
            Pressure magnitudes (..., P) [Pa], float64, on the CPU, without gradient. In mode "transfer" a row
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
        return torch.cat([_magnitudes(self.transfer_matrix, part) for part in parts])


def _magnitudes(matrix: torch.Tensor, drive: torch.Tensor) -> torch.Tensor:
    """Return |G q| (B, P) of drives (B, M), with the same rounding for every row.

    A search through thousands of choices amplifies differences of rounding. BLAS rounds by the number of
    rows, and complex products by their place in a vector register; single real operations always round alike.
    """
    a, b = matrix.real.contiguous(), matrix.imag.contiguous()
    c, d = drive.real.contiguous()[:, None], drive.imag.contiguous()[:, None]
    real, imaginary = (a * c - b * d).sum(dim=-1), (a * d + b * c).sum(dim=-1)
    return (real.square() + imaginary.square()).sqrt()
