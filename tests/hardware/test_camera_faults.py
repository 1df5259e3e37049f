"""A trial by an emulated camera: twenty faults of frames, and what becomes of it."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from autdtorch import hardware as hw
from autdtorch.hardware.camera.screen import Screen
from autdtorch.objectives.objective import SimulatedObjective
from autdtorch.propagators import make_propagator
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.geometry import Plane
from autdtorch.scene.scene import Medium, Scene

#: A focus of 3 kPa on a plane of 30 mm.
PLANE = Plane((40e-3, 0.0, 0.0), (1, 0, 0), (30e-3, 30e-3))
SCENE = Scene(
    TransducerArray.grid((2, 2), pitch=10e-3, center=(0, 0, 0), source_strength=30.0),
    Medium(1.2, 340.0),
    frequency=40e3,
    control_points=[(40e-3, 0.0, 0.0), (40e-3, 6e-3, 0.0)],
    observation_plane=PLANE,
)
FULL = torch.ones(4, dtype=torch.complex128)
SCREEN = Screen(heating=1e-6)
AFTER = 0.03  # of a reading that goes on in spite of a fault: 0.8 % measured, of noise


@dataclass
class Disturbed:
    """A source of frames that a fault changes once `armed`."""

    source: hw.FolderFrames
    folder: Path
    change: Callable[["Disturbed", list[hw.Frame]], list[hw.Frame]]
    armed: bool = False
    held: list[hw.Frame] = field(default_factory=list)
    calls: int = 0

    def clock(self) -> float:
        return self.source.clock()

    def begin(self) -> None:
        self.source.begin()
        self.calls = 0

    def wait(self, seconds: float) -> None:
        self.source.wait(seconds)

    def frames(self) -> list[hw.Frame]:
        self.calls += 1
        frames = self.source.frames()
        return self.change(self, frames) if self.armed else frames


class Bench:
    """An emulated bench of four transducers, a small camera, and the objective of a trial."""

    def __init__(self, log: Path, folder: Path, change: Callable, **camera: float) -> None:
        propagator = make_propagator(SCENE, method="free_space")
        self.simulated = SimulatedObjective(SCENE, propagator)
        self.bench = hw.EmulatedBench(hw.SONICSURFACE, self.simulated.transfer_matrix, range(4))
        self.camera = hw.EmulatedCamera(
            self.bench, propagator.transfer_matrix, PLANE, folder, SCREEN, shape=(40, 48), seed=1, **camera
        )
        sleep = self.bench.bus.sleep
        files = hw.FolderFrames(folder, 0.01, -273.15, delete=True, clock=self.camera.clock, sleep=sleep)
        self.source = Disturbed(files, folder, change)
        self.sensor = hw.ThermalCamera(
            self.source, PLANE, self.camera.corners, SCENE.control_points, screen=SCREEN, pulse=0.5, after=0.2
        )
        self.log = log

    @contextmanager
    def objective(self) -> Iterator[hw.HardwareObjective]:
        with hw.open_link(hw.SONICSURFACE, range(4), backend=self.bench.bus) as link:
            limited = hw.LimitedLink(link, hw.Limits(1.0))
            yield hw.HardwareObjective(SCENE, limited, self.sensor, self.log)


def frame_by_frame(change: Callable[[Disturbed, hw.Frame], hw.Frame | None]) -> Callable:
    """A fault of single frames; None loses one."""

    def changed(source: Disturbed, frames: list[hw.Frame]) -> list[hw.Frame]:
        results = [change(source, frame) for frame in frames]
        return [frame for frame in results if frame is not None]

    return changed


def image(change: Callable[[np.ndarray, hw.Frame], np.ndarray]) -> Callable:
    """A fault of the images."""
    return frame_by_frame(lambda _, frame: hw.Frame(frame.time, change(frame.image.copy(), frame)))


def every(count: int, change: Callable[[np.ndarray], np.ndarray]) -> Callable:
    """A fault of every few images."""
    return image(lambda values, frame: values if round(30 * frame.time) % count else change(values))


def painted(values: np.ndarray, where: object, number: float) -> np.ndarray:
    values[where] = number
    return values


def frozen(source: Disturbed, frames: list[hw.Frame]) -> list[hw.Frame]:
    source.held = source.held or frames[:1]
    return [hw.Frame(frame.time, source.held[0].image) for frame in frames]


def late(source: Disturbed, frames: list[hw.Frame]) -> list[hw.Frame]:
    """Most frames come a second later."""
    if source.calls == 1:
        source.held = frames[5:]
        return frames[:5]
    return source.held + frames


def gone(source: Disturbed, frames: list[hw.Frame]) -> list[hw.Frame]:
    shutil.rmtree(source.folder)
    return source.source.frames()


def broken_files(content: bytes) -> Callable:
    def leave(source: Disturbed, frames: list[hw.Frame]) -> list[hw.Frame]:
        for number in range(3):
            (source.folder / f"broken{number}.tif").write_bytes(content)
        return frames + source.source.frames()

    return leave


def unplugged(source: Disturbed, frames: list[hw.Frame]) -> list[hw.Frame]:
    raise hw.SensorError("no frame of the camera: it is unplugged, or another program has it")


#: Faults that end the trial, with what the error says.
ENDING = {
    "no frames": (lambda source, frames: [], "no frame came"),
    "unplugged": (unplugged, "unplugged"),
    "folder gone": (gone, "must be the folder into which"),
    "black": (image(lambda values, _: 0 * values), "frozen or covered"),
    "all NaN": (image(lambda values, _: np.nan * values), "frozen or covered"),
    "frozen": (frozen, "frozen or covered"),
    "turned": (image(lambda values, _: np.rot90(values)), "was the camera turned"),
    "another size": (image(lambda values, _: values[::2, ::2]), "another size"),
    "two sizes": (every(3, lambda values: values[:-1]), "of one shape"),
    "kelvin": (image(lambda values, _: values + 273.15), "check scale and zero"),
    "raw counts": (image(lambda values, _: 100 * (values + 273.15)), "check scale and zero"),
    "saturated": (image(lambda values, _: np.where(values > 24.0, np.nan, values)), "saturated"),
    "clock of another machine": (
        frame_by_frame(lambda _, frame: replace(frame, time=frame.time + 3600)),
        "their clock differs",
    ),
    "clock stands": (frame_by_frame(lambda _, frame: replace(frame, time=1.0)), "repeat each other"),
    "flicker": (every(3, lambda values: values + 2), "jump as a whole"),
    "few frames": (
        frame_by_frame(lambda _, frame: None if frame.time % 0.3 > 0.034 else frame),
        "too seldom",
    ),
}  # fmt: skip


#: Faults that a trial survives.
SURVIVED = {
    "dropped": frame_by_frame(lambda _, frame: None if round(30 * frame.time) % 3 == 0 else frame),
    "late": late,
    "duplicate": lambda source, frames: frames + frames[::2],
    "out of order": lambda source, frames: frames[::-1],
    "one black": every(9, lambda values: 0 * values),
    "one flash": every(11, lambda values: values + 3),
    "one of long ago": lambda source, frames: [replace(frames[0], time=frames[0].time - 60), *frames],
    "dead rows": image(lambda values, _: painted(values, slice(12, 14), 19.0)),
    "dead rows of NaN": image(lambda values, _: painted(values, (slice(None), slice(8, 10)), np.nan)),
    "hot spot": image(lambda values, _: painted(values, (slice(2, 6), slice(2, 6)), 60.0)),
    "warm lamp": image(lambda values, frame: values + np.linspace(0, 30, values.shape[1])),
    "drift": image(lambda values, frame: values + 0.05 * frame.time),
    "corrupt files": broken_files(b"II*\x00\x08\x00\x00\x00"),
    "half-written files": broken_files(b"II*\x00"),
    "saturated far away": every(7, lambda values: painted(values, (0, 0), np.nan)),
}  # fmt: skip


@pytest.mark.parametrize("fault", ENDING)
def test_a_fault_ends_the_trial_with_the_outputs_off_and_its_log(tmp_path, fault):
    change, message = ENDING[fault]
    folder = tmp_path / "frames"
    folder.mkdir()
    bench = Bench(tmp_path / "trial.jsonl", folder, change)
    with bench.objective() as objective:
        objective(FULL)
        bench.source.armed = True
        with pytest.raises(hw.SensorError, match=message) as raised:
            objective(1j * FULL)
        assert "\n" not in str(raised.value)
        assert not bench.bench.emitted().any()
        assert objective.evaluations == 1
        objective.log.end(1.0)
    assert len(bench.log.read_text().splitlines()) == 3  # its head, the evaluation, its end


@pytest.mark.parametrize("fault", SURVIVED)
def test_a_fault_that_a_trial_survives_hardly_changes_a_reading(tmp_path, fault):
    folder = tmp_path / "frames"
    folder.mkdir()
    bench = Bench(tmp_path / "trial.jsonl", folder, SURVIVED[fault])
    expected = bench.simulated(FULL)
    assert expected.max() > 2500
    with bench.objective() as objective:
        bench.source.armed = True
        reading = objective(FULL)
        assert not bench.bench.emitted().any()

    torch.testing.assert_close(reading, expected, rtol=AFTER, atol=0)
