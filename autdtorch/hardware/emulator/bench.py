"""A bench without hardware: the device behind its USB chip, the air before it, and microphones."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from autdtorch.hardware.devices import OPENMPD, SONICSURFACE, ULTRAINO, Device
from autdtorch.hardware.emulator.bus import EmulatedBus, EmulatedDevice
from autdtorch.hardware.emulator.chips import CHIPS
from autdtorch.hardware.emulator.firmware import (
    Autd3Firmware,
    Firmware,
    OpenMPDFirmware,
    SonicSurfaceFirmware,
    UltrainoFirmware,
)
from autdtorch.hardware.transport.autd3_network import autd3_device
from autdtorch.hardware.transport.serial_chips import Adapter
from autdtorch.hardware.wiring import Wiring
from autdtorch.objectives.perturbations import SNRS, random_rms
from autdtorch.utils.validation import (
    complex_tensor,
    indices,
    integer_at_least,
    integers,
    number_between,
    require_kind,
)

_FIRMWARES: dict[str, Callable[[int], Firmware]] = {
    SONICSURFACE.name: lambda transducers: SonicSurfaceFirmware(),
    OPENMPD.name: lambda transducers: OpenMPDFirmware(),
    ULTRAINO.name: lambda transducers: UltrainoFirmware(transducers // ULTRAINO.transducers),
    autd3_device().name: Autd3Firmware,
}


class EmulatedBench:
    """A device on an emulated USB bus, and the pressure it makes at the control points.

    Attributes:
        bus: backend for pyusb; without a device that is not on USB, which takes its frames by `receive`.
        firmware: what takes the bytes behind the chip; of several boards, that of the first.
    """

    def __init__(
        self,
        device: Device,
        transfer_matrix: torch.Tensor,
        transducers: Sequence[int] | torch.Tensor | None = None,
        adapter: Adapter | None = None,
        dead: Sequence[int] = (),
    ) -> None:
        """Plug the device in.

        Args:
            device: which.
            transfer_matrix: (P, M) of the scene on the bench [Pa].
            transducers: for each transducer of the scene, which of the device's it is (M,); by default all
                in order.
            adapter: the USB chip that it hangs on; by default the usual one, if any.
            dead: transducers of the scene that are silent, whatever the device plays.

        Raises:
            ValueError: `transducers` that the device does not have, not as many as the matrix has, or `dead`
                ones that the scene does not have.
        """
        if adapter is not None:
            require_kind("adapter", adapter, Adapter)
        self._transducers = Wiring(device, transducers).transducers
        self.transfer_matrix = complex_tensor("transfer_matrix", transfer_matrix).to("cpu", torch.complex128)
        if self.transfer_matrix.ndim != 2 or self.transfer_matrix.shape[1] != len(self._transducers):
            shape = tuple(self.transfer_matrix.shape)
            raise ValueError(f"transfer_matrix: shape {shape}; must be (P, {len(self._transducers)})")
        self._alive = torch.ones(len(self._transducers), dtype=torch.float64, device="cpu")
        if silent := integers("dead", dead, 0, "must be indices of transducers"):
            self._alive[indices("dead", silent, len(self._transducers))] = 0
        each = device.transducers // len(device.serials)
        self._firmwares = [_FIRMWARES[device.name](each) for _ in device.serials]
        self.firmware = self._firmwares[0]
        adapters = device.adapters[:1] if adapter is None else (adapter,)
        self.bus = EmulatedBus(
            [
                CHIPS[vendor, product](vendor, product, serial or "EMULATED", firmware)
                for vendor, product, _ in adapters
                for serial, firmware in zip(device.serials, self._firmwares, strict=True)
            ]
        )

    @property
    def chip(self) -> EmulatedDevice:
        """The device's USB chip on the bus; of several boards, that of the first."""
        return self.bus.chips[0]

    def receive(self, frame: bytes) -> None:
        """Have the device take a frame without USB; several boards share it evenly."""
        each = len(frame) // len(self._firmwares)
        for number, firmware in enumerate(self._firmwares):
            firmware.receive(frame[each * number : each * (number + 1)])

    def drive(self) -> torch.Tensor:
        """What the scene's transducers now play (M,), complex128; 0 where they are dead."""
        played = torch.cat([firmware.drive() for firmware in self._firmwares])
        return played[self._transducers] * self._alive

    def pressure(self) -> torch.Tensor:
        """Phasors (P,) [Pa] at the control points now, complex128."""
        return self.transfer_matrix @ self.drive()


class EmulatedSensor:
    """A microphone at each control point of an emulated bench, with the noise of `conditions.Noise`."""

    def __init__(self, bench: EmulatedBench, snr: float | None = None, seed: int = 0) -> None:
        """Set the microphones up.

        Args:
            bench: where they stand.
            snr: 20 log10(reference / sigma) [dB], -1000 to 1000, where the reference is the rms pressure over
                control points and random phases, all transducers fully on; None for no noise.
            seed: of the noise, >= 0.

        Raises:
            ValueError: an argument out of range.
        """
        require_kind("bench", bench, EmulatedBench)
        self._bench = bench
        self._generator = np.random.default_rng(integer_at_least("seed", seed, 0))
        rms = random_rms(bench.transfer_matrix)
        self._sigma = 0.0 if snr is None else rms * 10 ** (-number_between("snr", snr, *SNRS, "dB") / 20)

    def read(self) -> torch.Tensor:
        """Magnitudes (P,) [Pa]."""
        pressure = self._bench.pressure()
        parts = torch.from_numpy(self._generator.standard_normal((len(pressure), 2)))
        return (pressure + torch.view_as_complex(self._sigma / 2**0.5 * parts)).abs()
