"""The config of a thermal camera: the section `hardware.sensor` of the kind `camera`."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any

from autdtorch.hardware.camera.frames import FolderFrames, FrameSource, uvc_frames
from autdtorch.hardware.camera.screen import Screen
from autdtorch.hardware.camera.thermal_camera import ThermalCamera
from autdtorch.hardware.sensors.sensor import PulsedSensor, SensorConfig, Setup
from autdtorch.utils.validation import invalid, require_known, require_one_of, within

_KINDS = ("folder", "uvc")
_EMULATED = {
    "frames": "folder",
    "path": None,
    "number": 0,
    "scale": 0.01,
    "zero": -273.15,
    "rate": None,
    "corners": None,
}
_NEEDED = {
    "corners": "the pixels [column, row] of the corners of the scene's observation plane",
    "path": "the folder into which the camera's program writes",
}


@dataclass(frozen=True)
class CameraConfig(SensorConfig):
    """The config of a `ThermalCamera`; configs/hardware/sensor/camera.yaml describes the keys."""

    frames: Any
    path: Any
    number: int
    scale: float
    zero: float
    rate: float | None
    corners: Any
    screen: Mapping[str, Any]
    pulse: float
    before: float
    after: float
    noise: float | None

    @property
    def settings(self) -> dict[str, Any]:
        """Times of a pulse, the screen and the corners."""
        times = {"pulse [s]": [self.before, self.pulse, self.after]}
        return {**times, "screen": dict(self.screen), "corners": self.corners}

    def check(self, emulated: bool) -> None:
        """Check the values for a real or an `emulated` bench."""
        super().check(emulated)
        require_one_of("hardware.sensor.frames", self.frames, _KINDS)
        require_known("hardware.sensor.screen", self.screen, [field.name for field in fields(Screen)])
        with within("hardware.sensor.screen"):
            Screen(**self.screen)
        if emulated:
            for key, value in _EMULATED.items():
                if (setting := getattr(self, key)) != value:
                    accepted = f"must be {'null' if value is None else value}, as of an emulated camera"
                    raise invalid(f"hardware.sensor.{key}", setting, accepted)
            return
        for key, wanted in (("corners", True), ("path", self.frames == "folder")):
            if wanted and getattr(self, key) is None:
                raise invalid(f"hardware.sensor.{key}", None, f"must be {_NEEDED[key]}")
        if self.noise is not None:
            raise invalid("hardware.sensor.noise", self.noise, "must be null: it is for an emulated device")

    @contextlib.contextmanager
    def open(self, setup: Setup) -> Iterator[PulsedSensor]:
        """Open the camera, on an emulated bench an emulated one."""
        scene, screen = setup.scene, Screen(**self.screen)
        if scene.observation_plane is None:
            accepted = "must be the plane of the screen, which holds the control points"
            raise invalid("scene.observation_plane", None, accepted)
        with self._source(setup, screen) as (source, corners):
            with within("hardware.sensor"):
                camera = ThermalCamera(
                    source,
                    scene.observation_plane,
                    corners,
                    scene.control_points,
                    screen=screen,
                    wavelength=scene.wavelength,
                    pulse=self.pulse,
                    before=self.before,
                    after=self.after,
                )
            yield camera

    @contextlib.contextmanager
    def _source(self, setup: Setup, screen: Screen) -> Iterator[tuple[FrameSource, Any]]:
        """Open the source of frames; return the pixels of the plane's corners with it."""
        bench = setup.bench
        if bench is None:
            if self.frames == "folder":
                yield FolderFrames(self.path, self.scale, self.zero, self.rate), self.corners
            else:
                with uvc_frames(self.number, self.scale, self.zero) as camera:
                    yield camera, self.corners
            return
        from autdtorch.hardware.emulator.emulated_camera import EmulatedCamera  # needs pyusb

        noise = 0.05 if self.noise is None else self.noise
        plane = setup.scene.observation_plane
        assert plane is not None
        with tempfile.TemporaryDirectory() as folder:
            emulated = EmulatedCamera(
                bench, setup.matrix_of, plane, folder, screen, seed=setup.seed, noise=noise
            )
            with contextlib.closing(emulated):
                sleep = bench.bus.sleep
                source = FolderFrames(
                    folder, self.scale, self.zero, delete=True, clock=emulated.clock, sleep=sleep
                )
                yield source, emulated.corners.round(1)
