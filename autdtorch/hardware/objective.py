"""Objectives of a device: measured by a sensor, or simulated for the drives that the device plays."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch

from autdtorch.hardware.devices.device import Device
from autdtorch.hardware.link import AmplitudeScale, Wiring
from autdtorch.hardware.log import Evaluation, EvaluationLog
from autdtorch.hardware.safety import LimitedLink, LimitError
from autdtorch.hardware.sensors.sensor import PRESSURE, AnySensor, Quantity, quantity_of, require_sensor
from autdtorch.objectives.goals import WEAKEST_FOCUS, Goal
from autdtorch.objectives.objective import Objective, observe_drives, validate_matrix
from autdtorch.objectives.perturbations import Perturbation
from autdtorch.scene.scene import Scene
from autdtorch.utils.digest import digest_of
from autdtorch.utils.files import path_of
from autdtorch.utils.validation import ArrayLike, integer_at_least, invalid, require_callable, require_kind


@dataclass(frozen=True)
class LeastReading(Goal):
    """The goal of a sensor of another quantity than the pressure: its least reading.

    Attributes:
        quantity: of the readings.
    """

    of_pressures: ClassVar[bool] = False

    quantity: Quantity

    @property
    def name(self) -> str:  # type: ignore[override]
        """The name of the quantity."""
        return self.quantity.name

    @property
    def unit(self) -> str:  # type: ignore[override]
        """The unit of the readings."""
        return self.quantity.unit

    def __call__(self, pressure: ArrayLike) -> torch.Tensor:
        """Return the least of readings (..., P)."""
        return self.checked(pressure).amin(dim=-1)


def goal_of_sensor(sensor: AnySensor) -> Goal:
    """Return the goal of a sensor's readings: the weakest focus, or the least of another quantity."""
    quantity = quantity_of(sensor)
    return WEAKEST_FOCUS if quantity == PRESSURE else LeastReading(quantity)


class HardwareObjective:
    """An objective whose observations are measured, one drive after the other.

    The device plays the nearest drive on its phase levels, which a `Solution` holds; the log holds the
    requested drive. The outputs are off while a method computes.

    To continue an interrupted trial, run the same method with the same seed again: `autdtorch.run` takes the
    evaluations in the log from there, and so does a function of your own in a block `continued`.

    Attributes:
        scene: the scene on the bench.
        log: of the evaluations.
        transfer_matrix: simulated G (P, M) [Pa], or None, as for a sensor of another quantity.
        goal: the weakest focus; of a sensor of another quantity its least reading, which takes its place.
    """

    def __init__(
        self,
        scene: Scene,
        link: LimitedLink,
        sensor: AnySensor,
        log: str | Path,
        settings: Mapping[str, Any] | None = None,
        watch: Callable[[Evaluation], None] | None = None,
        transfer_matrix: torch.Tensor | None = None,
    ) -> None:
        """Prepare the observations.

        Args:
            scene: the scene on the bench.
            link: plays the drives; its device's transducers are those of the scene.
            sensor: reads the pressure at the scene's control points.
            log: file of the evaluations (`EvaluationLog`); each is appended before the next begins.
            settings: further settings that identify the trial, values of JSON: method, seed, sensor. A log
                of other settings, or of another scene, device or amplitude, is refused.
            watch: function that is called with every evaluation, those from the log included.
            transfer_matrix: G (P, M) [Pa] of a simulation of the scene, for a `Prior` and `GradientAscent`,
                up to a factor.

        Raises:
            ValueError: no scene or sensor; the link is not limited, or plays another number of transducers
                than the scene has; a transfer matrix of another shape, or beside a sensor of another
                quantity than the pressure; or `settings` that JSON cannot hold.
            LogError: the log is of another trial, none, or open in another process.
            OSError: the log cannot be read or written.
        """
        require_kind("scene", scene, Scene)
        require_sensor(sensor)
        watch = (lambda _: None) if watch is None else watch
        require_callable("watch", watch)
        if not isinstance(link, LimitedLink):
            raise invalid("link", link, "must be a LimitedLink: no trial without an amplitude limit")
        transducers = link.link.transducers.tolist()
        points, count = len(scene.control_points), len(scene.array)
        if len(transducers) != count:
            accepted = f"must be {count}, as many as the scene has"
            raise invalid("link.transducers", len(transducers), accepted)
        try:
            json.dumps(named := {} if settings is None else {**settings})
        except (TypeError, ValueError) as error:
            raise invalid("settings", settings, "must be a mapping of what JSON can hold") from error
        self.transfer_matrix = transfer_matrix
        if transfer_matrix is not None:
            self.transfer_matrix = validate_matrix("transfer_matrix", transfer_matrix, points, count)
        self.scene, self._link, self._sensor, self._watch = scene, link, sensor, watch
        self.goal = goal_of_sensor(sensor)
        if not self.goal.of_pressures:
            if transfer_matrix is not None:
                accepted = f"must be None with a sensor of {self.goal.name}: it gives pressures"
                raise invalid("transfer_matrix", "a matrix", accepted)
            named["quantity"] = f"{self.goal.name} [{self.goal.unit}]"
        self._sensed: Callable[[torch.Tensor], torch.Tensor] | None = getattr(sensor, "deviation", None)
        origin = {
            "scene": f"{scene.name} {digest_of(scene)[:16]}",
            "device": link.link.device.name,
            "transducers": transducers,
            "amplitude limit": link.limits.amplitude,
            **named,
        }
        self.log = EvaluationLog(path_of("log", log), origin, count, points)
        self._next: int | None = None  # number of the next evaluation that is looked up in the log
        place = self.log.path.resolve()
        if self.log.goes_on and place not in link.logs:
            link.go_on(self.log.seconds_on)
        link.logs.add(place)

    def __call__(self, drive: torch.Tensor) -> torch.Tensor:
        """Play drives (..., M), |q| <= 1, one by one; return readings (..., P), float64.

        The outputs are off afterwards, also after an error.

        Raises:
            ValueError: no drive, another shape, not finite complex numbers, or an amplitude above 1; or a
                sensor that does not give a finite magnitude for each control point.
            LogError: the log has changed meanwhile.
            LimitError: a limit of the trial is reached.
            OSError: the device does not take the bytes, or the log cannot be written.
        """
        return observe_drives(self._observe, drive, len(self.scene.array))

    @property
    def evaluations(self) -> int:
        """Number of observations so far, those from the log included."""
        return self.log.count

    def continued(self, number: int = 0) -> contextlib.AbstractContextManager[None]:
        """Take evaluations from `number` on out of the log as long as it has them; then play.

        The block, `with objective.continued():`, runs a method that observes the objective, perhaps by a
        perturbation around it. A block inside goes on with it, from its `number` at least, as where a state
        file holds the evaluations before. `ValueError` if `number` is no integer >= 0; in the block
        `LogError` if the log has another drive.
        """
        return self._continued(integer_at_least("number", number, 0))

    @contextlib.contextmanager
    def _continued(self, number: int) -> Iterator[None]:
        if self._next is not None:
            self._next = max(self._next, number)
            yield
            return
        self._next = number
        try:
            yield
        finally:
            self._next = None

    def recorded(self, number: int, drive: torch.Tensor) -> torch.Tensor | None:
        """Return the pressures (P,) [Pa] of a logged evaluation, or None; see `EvaluationLog.recorded`."""
        evaluation = self.log.recorded(number, drive)
        if evaluation is None:
            return None
        self._watch(evaluation)
        return evaluation.pressure

    def quantised(self, drive: torch.Tensor) -> torch.Tensor:
        """Return the device's nearest drives to drives (..., M); |q| = 1 is the highest level in the limit.

        `ValueError` for another shape, not finite complex numbers, or an amplitude above 1.
        """
        return self._link.quantised(drive)

    @property
    def deviation(self) -> Callable[[torch.Tensor], torch.Tensor] | None:
        """The function of readings (..., P) [Pa] that gives their deviations, if the sensor has one.

        Readings in the log have those of the log, so that a trial goes on as it began.
        """
        if (sensed := self._sensed) is None:
            return None

        def deviation(pressure: torch.Tensor) -> torch.Tensor:
            logged = {
                tuple(evaluation.pressure.tolist()): evaluation.deviation
                for evaluation in self.log.evaluations
            }
            rows = pressure.reshape(-1, pressure.shape[-1])
            known = [logged.get(tuple(row.tolist())) for row in rows]
            parts = [
                sensed(row) if deviation is None else deviation
                for deviation, row in zip(known, rows, strict=True)
            ]
            return torch.stack(parts).reshape(pressure.shape)

        return deviation

    def _observe(self, drive: torch.Tensor) -> torch.Tensor:
        try:
            return torch.stack([self._recorded_or_measured(row) for row in drive])
        finally:
            self._link.off()

    def _recorded_or_measured(self, drive: torch.Tensor) -> torch.Tensor:
        if self._next is None:
            return self._measure(drive)
        pressure = self.recorded(self._next, drive)
        pressure = self._measure(drive) if pressure is None else pressure
        self._next += 1
        return pressure

    def _measure(self, drive: torch.Tensor) -> torch.Tensor:
        most = self._link.limits.evaluations
        if self.evaluations >= most:
            raise LimitError(f"{most} evaluations are made, the limit")
        pressure = self._link.measure(drive, self._sensor, len(self.scene.control_points))[0]
        deviation = None if self._sensed is None else self._sensed(pressure)
        evaluation = self.log.append(drive, pressure, self._link.seconds_on, deviation)
        self._watch(evaluation)
        return pressure


class Played(Perturbation):
    """A device that plays the nearest of its levels, as it is calibrated, within the limit of a trial.

    With ``Played(SimulatedObjective(...), device)`` a method finds the same drive as with a
    `HardwareObjective` without noise. The pressures differ by a factor: |q| = 1 in the trial is the amplitude
    `largest` of the device, its highest level within the limit.
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

        `ValueError` for `transducers` that the device does not have, one twice, or not as many as the scene
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
