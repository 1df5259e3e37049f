"""What a device plays of a drive, around any objective: for the simulation of a trial."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from autdtorch.hardware.amplitude_scale import AmplitudeScale
from autdtorch.hardware.devices.device import Device
from autdtorch.hardware.wiring import Wiring
from autdtorch.objectives.objective import Objective
from autdtorch.objectives.perturbations import Perturbation
from autdtorch.utils.validation import invalid


class Played(Perturbation):
    """A device that plays the nearest of its levels, as it is calibrated, within the limit of a trial.

    What a method observes in ``Played(SimulatedObjective(...), device)`` is what it observes in a
    `HardwareObjective` without noise, but for the pressures' scale, and it finds the very same drive.

    Attributes:
        largest: the amplitude of the device that is |q| = 1: its highest level within the limit.
    """

    def __init__(
        self,
        objective: Objective,
        device: Device,
        transducers: Sequence[int] | torch.Tensor | None = None,
        amplitude: float = 1.0,
    ) -> None:
        """Wrap an objective.

        Args:
            objective: what the device plays to.
            device: which.
            transducers: for each transducer of the scene, which of the device's it is (M,); by default all
                in order.
            amplitude: the limit of the trial, as in `Limits`; |q| = 1 is the largest amplitude within it.

        Raises:
            ValueError: `transducers` that the device does not have, one twice, or not as many as the scene
                has; `amplitude` out of range, or the device has none up to it but 0.
        """
        super().__init__(objective)
        wiring = Wiring(device, transducers)
        count = len(self.scene.array)
        if len(wiring.transducers) != count:
            raise invalid(
                "transducers", len(wiring.transducers), f"must be {count}, as many as the scene has"
            )
        self._scale = AmplitudeScale(wiring, amplitude)
        self.largest = self._scale.largest

    def quantised(self, drive: torch.Tensor) -> torch.Tensor:
        """What the device plays (..., M), in the trial's scale, when asked for drives (..., M)."""
        return self._scale.played(drive)
