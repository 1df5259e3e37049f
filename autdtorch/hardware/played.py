"""The quantisation of drives by a device, around any objective: for the simulation of a trial."""

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

    With ``Played(SimulatedObjective(...), device)`` a method finds the same drive as with a
    `HardwareObjective` without noise. The pressures differ by a factor.

    Attributes:
        largest: amplitude of the device that is |q| = 1 in the trial: its highest level within the limit.
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
            objective: simulates the pressure of the device's drives.
            device: the device whose levels are used.
            transducers: the device's transducer for each of the scene's (M,); by default all in order.
            amplitude: amplitude limit of the trial, as in `Limits`.

        Raises:
            ValueError: `transducers` that the device does not have, one twice, or not as many as the scene
                has; or an `amplitude` out of range or below the device's lowest level.
        """
        super().__init__(objective)
        wiring = Wiring(device, transducers)
        count = len(self.scene.array)
        if len(wiring.transducers) != count:
            accepted = f"must be {count}, as many as the scene has"
            raise invalid("transducers", len(wiring.transducers), accepted)
        self._scale = AmplitudeScale(wiring, amplitude)
        self.largest = self._scale.largest

    def quantised(self, drive: torch.Tensor) -> torch.Tensor:
        """Return the device's nearest drives to drives (..., M), both in the trial's scale."""
        return self._scale.quantised(drive)
