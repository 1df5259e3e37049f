"""An objective that a device plays to, and nothing else of the device: for the simulation of a trial."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from autdtorch.conditions import Condition
from autdtorch.hardware.amplitude_scale import AmplitudeScale
from autdtorch.hardware.devices import Device
from autdtorch.hardware.wiring import Wiring
from autdtorch.objective import Objective
from autdtorch.validation import invalid


class Played(Condition):
    """What is asked for is rounded as a device rounds it: phases and amplitudes, calibrated, within a limit.

    A method sees in `Played(SimulatedObjective(...), device, ...)` what it would see in a `HardwareObjective`
    without noise, but for the pressure's scale, and finds the very same drive.
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
        wiring = Wiring(device, transducers)
        count = len(objective.scene.array)
        if len(wiring.transducers) != count:
            raise invalid(
                "transducers", len(wiring.transducers), f"must be {count}, as many as the scene has"
            )
        self._scale = AmplitudeScale(wiring, amplitude)
        super().__init__(objective)

    def played(self, drive: torch.Tensor) -> torch.Tensor:
        """What the device plays (..., M), in the trial's scale, when asked for drives (..., M)."""
        return self._scale.played(drive)
