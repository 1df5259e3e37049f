"""A trial without a device: what would be on the wire is shown instead."""

from __future__ import annotations

from collections.abc import Callable

from autdtorch.hardware.devices import Device
from autdtorch.hardware.emulator.bench import EmulatedBench
from autdtorch.scene.drive import amplitudes_of, phases_of


class DryPort:
    """A port that shows each frame it is given; an emulated device takes it, for the sensor to hear."""

    def __init__(self, bench: EmulatedBench, device: Device, show: Callable[[str], object]) -> None:
        """Open no device.

        Args:
            bench: hears the frames.
            device: whose frames they are.
            show: is given a text for each frame.
        """
        self._bench = bench
        self._device = device
        self._show = show

    def write(self, data: bytes) -> None:
        """Show the frame."""
        self._show(described_frame(self._device, data))
        self._bench.receive(data)

    def flush(self) -> None:
        """Nothing waits."""

    def recover(self) -> None:
        """Nothing breaks."""

    def close(self) -> None:
        """Nothing is open."""


def described_frame(device: Device, frame: bytes) -> str:
    """A frame as hexadecimal numbers, and below it what the device plays: amplitude and phase [deg]."""
    drive = device.played(frame)
    played = [
        f"{index}: {amplitude:.3g} at {phase:.4g}"
        for index, (amplitude, phase) in enumerate(
            zip(amplitudes_of(drive).tolist(), phases_of(drive).rad2deg().tolist(), strict=True)
        )
        if amplitude > 0
    ]
    return f"{frame.hex(' ')}\n  {', '.join(played) or 'all off'}"
