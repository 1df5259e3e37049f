"""A bench without hardware: a device behind its USB chip or port, and the pressure that it makes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from autdtorch.hardware.devices.device import Device
from autdtorch.hardware.emulator.bus import CHIPS, EmulatedBus, EmulatedDevice
from autdtorch.hardware.played import Wiring
from autdtorch.hardware.transport.port import Port
from autdtorch.scene.drive import amplitudes_of, phases_of
from autdtorch.utils.array_types import REAL
from autdtorch.utils.hints import renamed_keywords
from autdtorch.utils.validation import complex_tensor, indices, integers


class EmulatedBench:
    """A device on an emulated USB bus, and the pressure it makes at the control points.

    Attributes:
        bus: backend for pyusb; empty if the device is not on USB, and takes its frames by `receive`.
        firmware: emulated firmware behind the chip; of the first of several boards.
        transfer_matrix: (P, M) [Pa], complex128.
    """

    @renamed_keywords(dead="failed")
    def __init__(
        self,
        device: Device,
        transfer_matrix: torch.Tensor,
        transducers: Sequence[int] | torch.Tensor | None = None,
        failed: Sequence[int] = (),
    ) -> None:
        """Plug the device in, on its usual chip.

        Args:
            device: the device to emulate.
            transfer_matrix: (P, M) of the scene on the bench [Pa].
            transducers: the device's transducer for each of the scene's (M,); by default all in order.
            failed: transducers of the scene that stay silent.

        `ValueError` for `transducers` that the device does not have, or not as many as the matrix has, or
        `failed` ones that the scene does not have.
        """
        self._transducers = Wiring(device, transducers).transducers
        self.transfer_matrix = complex_tensor("transfer_matrix", transfer_matrix).to("cpu", torch.complex128)
        if self.transfer_matrix.ndim != 2 or self.transfer_matrix.shape[1] != len(self._transducers):
            shape = tuple(self.transfer_matrix.shape)
            raise ValueError(f"transfer_matrix: shape {shape}; must be (P, {len(self._transducers)})")
        self._working = torch.ones(len(self._transducers), **REAL)
        if silent := integers("failed", failed, 0, "must be indices of transducers"):
            self._working[indices("failed", silent, len(self._transducers))] = 0
        each = device.transducers // len(device.serials)
        self._firmwares = [device.firmware(each) for _ in device.serials]
        self.firmware = self._firmwares[0]
        self.bus = EmulatedBus(
            [
                CHIPS[vendor, product](vendor, product, serial or "EMULATED", firmware)
                for vendor, product, _ in device.adapters[:1]
                for serial, firmware in zip(device.serials, self._firmwares, strict=True)
            ]
        )

    @property
    def chip(self) -> EmulatedDevice:
        """The device's USB chip on the bus; of the first of several boards."""
        return self.bus.chips[0]

    def receive(self, frame: bytes) -> None:
        """Have the device take a frame without USB; several chips share it evenly."""
        each = len(frame) // len(self._firmwares)
        for number, firmware in enumerate(self._firmwares):
            firmware.receive(frame[each * number :][:each])

    def emitted(self) -> torch.Tensor:
        """Return the drive (N,), complex128, that the firmware sends to the device's transducers now."""
        return torch.cat([firmware.drive() for firmware in self._firmwares])

    def drive(self) -> torch.Tensor:
        """Return the drive (M,), complex128, that the scene's transducers emit now; 0 for failed ones."""
        return self.emitted()[self._transducers] * self._working

    def pressure(self) -> torch.Tensor:
        """Return the phasors (P,) [Pa], complex128, at the control points now."""
        return self.transfer_matrix @ self.drive()


class BenchPort(Port):
    """A port without USB: an emulated device takes its frames, each of which may be shown."""

    def __init__(self, bench: EmulatedBench, show: Callable[[str], object] | None = None) -> None:
        """Set the `bench` that takes the frames, and the function that takes a text for each."""
        self._bench, self._show = bench, show

    def write(self, data: bytes) -> None:
        """Have the device take a frame; show it in hexadecimal, with amplitudes and phases [deg]."""
        self._bench.receive(data)
        if self._show is None:
            return
        drive = self._bench.emitted()
        pairs = zip(amplitudes_of(drive).tolist(), phases_of(drive).rad2deg().tolist(), strict=True)
        emitted = [f"{number}: {a:.3g} at {phase:.4g}" for number, (a, phase) in enumerate(pairs) if a > 0]
        self._show(f"{data.hex(' ')}\n  {', '.join(emitted) or 'all off'}")
