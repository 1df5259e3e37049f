"""AUTD3 without hardware: the kit's own emulator answers on the network, and an emulated bench plays."""

from __future__ import annotations

from autdtorch.hardware.emulator.bench import EmulatedBench
from autdtorch.hardware.transport.autd3_network import Autd3Port, autd3_kit


class EmulatedAutd3Port(Autd3Port):
    """The port of boards that the kit emulates on this machine, silently; a bench plays for them."""

    def __init__(self, boards: int, bench: EmulatedBench) -> None:
        """Start the emulator of `boards` boards, and connect to it."""
        self._emulator = autd3_kit().UdpEmulator(boards)
        self._bench = bench
        super().__init__(boards, self._emulator.option())

    def write(self, data: bytes) -> None:
        """Play a frame, on boards and bench."""
        super().write(data)
        self._bench.receive(data)
