"""A trial without a device: its frames are shown, and an emulated device takes them."""

from __future__ import annotations

from collections.abc import Callable

from autdtorch.hardware.emulator.bench import EmulatedBench
from autdtorch.hardware.transport.port import Port
from autdtorch.scene.drive import amplitudes_of, phases_of


class DryPort(Port):
    """A port that shows each frame in hexadecimal, and the drive that an emulated device emits for it."""

    def __init__(self, bench: EmulatedBench, show: Callable[[str], object]) -> None:
        """Open no device: the `bench` takes the frames, and `show` takes a text for each."""
        self._bench = bench
        self._show = show

    def write(self, data: bytes) -> None:
        """Show the frame; amplitude and phase [deg] of each of the device's transducers below it."""
        self._bench.receive(data)
        drive = self._bench.emitted()
        pairs = zip(amplitudes_of(drive).tolist(), phases_of(drive).rad2deg().tolist(), strict=True)
        emitted = [f"{number}: {a:.3g} at {phase:.4g}" for number, (a, phase) in enumerate(pairs) if a > 0]
        self._show(f"{data.hex(' ')}\n  {', '.join(emitted) or 'all off'}")
