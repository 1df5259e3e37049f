"""The objective that a device and a sensor make: measured where `SimulatedObjective` simulates."""

from __future__ import annotations

from pathlib import Path

import torch

from autdtorch.hardware.link import Link
from autdtorch.hardware.log import EvaluationLog
from autdtorch.hardware.sensor import Sensor
from autdtorch.objective import validate_drives
from autdtorch.scene import Scene
from autdtorch.validation import invalid, real_tensor


class HardwareObjective:
    """An objective whose observations are measured, one drive after the other.

    The device plays the nearest drive on its levels. To have a `Solution` hold what was played, wrap it as a
    simulated one: ``Quantised(objective, levels=32, on_off=True)`` is a SonicSurface.

    Attributes:
        scene: its array plays the drives, its control points are observed.
        evaluations: number of observations so far.
    """

    scene: Scene
    evaluations: int

    def __init__(self, scene: Scene, link: Link, sensor: Sensor, log: str | Path) -> None:
        """Prepare the observations.

        Args:
            scene: what is on the bench.
            link: plays the drives; its device's transducers stand where the scene says.
            sensor: reads the pressure at the scene's control points.
            log: JSON lines file; every evaluation is appended before the next begins.

        Raises:
            ValueError: the link plays another number of transducers than the scene has.
            OSError: the log cannot be opened.
        """
        if len(link.transducers) != len(scene.array):
            accepted = f"must be {len(scene.array)}, as many as the scene has"
            raise invalid("link.transducers", len(link.transducers), accepted)
        self.scene = scene
        self.evaluations = 0
        self._link = link
        self._sensor = sensor
        self._log = EvaluationLog(log)

    def __call__(self, drive: torch.Tensor) -> torch.Tensor:
        """Play each of several drives and read the control points.

        Args:
            drive: (B, M) complex, |q| <= 1.

        Returns:
            Pressure magnitudes (B, P) [Pa], float64.

        Raises:
            ValueError: another shape, not finite complex numbers, or an amplitude above 1; or a sensor that
                does not give a finite magnitude for each control point.
            LinkError: the device does not take the bytes.
            OSError: the log cannot be written.
        """
        return torch.stack([self._evaluate(row) for row in validate_drives(drive, len(self.scene.array))])

    def _evaluate(self, drive: torch.Tensor) -> torch.Tensor:
        self._link.play(drive)
        pressure = real_tensor("pressure of the sensor", self._sensor.read(), "Pa")
        points = len(self.scene.control_points)
        if pressure.shape != (points,) or pressure.min() < 0:
            raise invalid("pressure of the sensor", pressure.tolist(), f"must be {points} numbers >= 0", "Pa")
        self._log.append(drive, pressure)
        self.evaluations += 1
        return pressure
