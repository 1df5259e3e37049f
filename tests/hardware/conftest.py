"""A bench that the tests share: 4 x 4 transducers of a device of 16 x 16, two control points."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from autdtorch import hardware as hw
from autdtorch.hardware import safety
from autdtorch.objectives.objective import SimulatedObjective
from autdtorch.propagators import make_propagator
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.scene import Medium, Scene

#: The scene's transducers among the device's: four columns of four rows, not in the order of its channels.
TRANSDUCERS = [16 * row + column for column in range(6, 10) for row in range(5, 9)]


@dataclass
class Trial:
    """A scene, its simulation, and where its log goes."""

    scene: Scene
    simulated: SimulatedObjective
    log: Path

    def bench(self, device: hw.Device = hw.SONICSURFACE, failed: Sequence[int] = ()) -> hw.EmulatedBench:
        assert self.simulated.transfer_matrix is not None
        return hw.EmulatedBench(device, self.simulated.transfer_matrix, TRANSDUCERS, failed=failed)

    def link(self, bench: hw.EmulatedBench, device: hw.Device = hw.SONICSURFACE) -> hw.Link:
        return hw.open_link(device, TRANSDUCERS, backend=bench.bus)

    def played(self, device: hw.Device = hw.SONICSURFACE, amplitude: float = 1.0) -> hw.Played:
        return hw.Played(self.simulated, device, TRANSDUCERS, amplitude)

    @contextmanager
    def limited(
        self,
        device: hw.Device = hw.SONICSURFACE,
        failed: Sequence[int] = (),
        amplitude: float = 1.0,
        **limits: float,
    ) -> Iterator[tuple[hw.EmulatedBench, hw.LimitedLink]]:
        """A bench, and a link to it with limits."""
        bench = self.bench(device, failed)
        with self.link(bench, device) as link:
            yield bench, hw.LimitedLink(link, hw.Limits(amplitude, **limits))  # type: ignore[arg-type]

    def objective(
        self, link: hw.Link | hw.LimitedLink, sensor: hw.Sensor, **settings: object
    ) -> hw.HardwareObjective:
        limited = hw.LimitedLink(link, hw.Limits(1.0)) if isinstance(link, hw.Link) else link
        return hw.HardwareObjective(self.scene, limited, sensor, self.log, settings)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """The clock of limits: `now` [s] goes on in sleeps alone, and timers of many seconds do not go off."""
    clock = SimpleNamespace(now=0.0, monotonic=lambda: clock.now)
    clock.sleep = lambda seconds: setattr(clock, "now", clock.now + seconds)
    monkeypatch.setattr(safety, "time", clock)
    return clock


@pytest.fixture
def kit() -> ModuleType:
    """The kit of AUTD3."""
    reason = "the kit of AUTD3: install autdtorch[autd3]"
    for part in ("autd3_pattern", "autd3_modulation"):
        pytest.importorskip(part, reason=reason)
    return pytest.importorskip("autd3", reason=reason)


@pytest.fixture
def stray_signals_do_no_harm() -> Iterator[None]:
    before = signal.signal(signal.SIGTERM, lambda *_: None)
    yield
    signal.signal(signal.SIGTERM, before)


@pytest.fixture
def signalled_all_the_time(stray_signals_do_no_harm: None) -> Callable[[], AbstractContextManager[None]]:
    """SIGTERM every few ms, from without: a thread would send it only where it has the interpreter."""

    @contextmanager
    def signalled() -> Iterator[None]:
        sender = subprocess.Popen(["sh", "-c", "while kill -TERM $PPID; do sleep 0.002; done"])
        try:
            yield
        finally:
            sender.kill()
            sender.wait()

    return signalled


@pytest.fixture(scope="session")
def simulated() -> SimulatedObjective:
    scene = Scene(
        TransducerArray.grid((4, 4), pitch=10.5e-3, center=(0, 0, 0)),
        Medium(1.2, 340.0),
        frequency=40e3,
        control_points=[(80e-3, 10e-3, 0.0), (80e-3, -20e-3, 5e-3)],
    )
    return SimulatedObjective(scene, make_propagator(scene, method="free_space"))


@pytest.fixture
def trial(simulated: SimulatedObjective, tmp_path: Path) -> Trial:
    return Trial(simulated.scene, simulated, tmp_path / "trial.jsonl")
