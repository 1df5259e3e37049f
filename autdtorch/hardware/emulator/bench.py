"""A bench without hardware: a device behind its USB chip or port, the air before it, and microphones."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from autdtorch.hardware.devices.device import Device
from autdtorch.hardware.emulator.bus import EmulatedBus, EmulatedDevice
from autdtorch.hardware.emulator.chips import CHIPS
from autdtorch.hardware.played import Wiring
from autdtorch.hardware.transport.autd3_network import Autd3Port, autd3_kit
from autdtorch.hardware.transport.port import Port
from autdtorch.objectives.perturbations import SNRS, random_rms
from autdtorch.scene.drive import amplitudes_of, phases_of
from autdtorch.utils.array_types import REAL
from autdtorch.utils.validation import (
    complex_tensor,
    indices,
    integer_at_least,
    integers,
    number_between,
    require_kind,
)


class EmulatedBench:
    """A device on an emulated USB bus, and the pressure it makes at the control points.

    Attributes:
        bus: backend for pyusb; empty if the device is not on USB, and takes its frames by `receive`.
        firmware: emulated firmware behind the chip; of the first of several boards.
        transfer_matrix: (P, M) [Pa], complex128.
    """

    def __init__(
        self,
        device: Device,
        transfer_matrix: torch.Tensor,
        transducers: Sequence[int] | torch.Tensor | None = None,
        dead: Sequence[int] = (),
    ) -> None:
        """Plug the device in, on its usual chip.

        Args:
            device: the device to emulate.
            transfer_matrix: (P, M) of the scene on the bench [Pa].
            transducers: the device's transducer for each of the scene's (M,); by default all in order.
            dead: failed transducers of the scene, which stay silent.

        `ValueError` for `transducers` that the device does not have, or not as many as the matrix has, or
        `dead` ones that the scene does not have.
        """
        self._transducers = Wiring(device, transducers).transducers
        self.transfer_matrix = complex_tensor("transfer_matrix", transfer_matrix).to("cpu", torch.complex128)
        if self.transfer_matrix.ndim != 2 or self.transfer_matrix.shape[1] != len(self._transducers):
            shape = tuple(self.transfer_matrix.shape)
            raise ValueError(f"transfer_matrix: shape {shape}; must be (P, {len(self._transducers)})")
        self._working = torch.ones(len(self._transducers), **REAL)
        if failed := integers("dead", dead, 0, "must be indices of transducers"):
            self._working[indices("dead", failed, len(self._transducers))] = 0
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


class DryPort(Port):
    """A port that shows each frame in hexadecimal, and the drive that an emulated device emits for it."""

    def __init__(self, bench: EmulatedBench, show: Callable[[str], object]) -> None:
        """Open no device: the `bench` takes the frames, and `show` takes a text for each."""
        self._bench, self._show = bench, show

    def write(self, data: bytes) -> None:
        """Show the frame; amplitude and phase [deg] of each of the device's transducers below it."""
        self._bench.receive(data)
        drive = self._bench.emitted()
        pairs = zip(amplitudes_of(drive).tolist(), phases_of(drive).rad2deg().tolist(), strict=True)
        emitted = [f"{number}: {a:.3g} at {phase:.4g}" for number, (a, phase) in enumerate(pairs) if a > 0]
        self._show(f"{data.hex(' ')}\n  {', '.join(emitted) or 'all off'}")


class EmulatedAutd3Port(Autd3Port):
    """The port of AUTD3 boards that the kit emulates on this machine, silently; a bench plays for them."""

    def __init__(self, boards: int, bench: EmulatedBench) -> None:
        """Start the emulator of `boards` boards, and connect to it."""
        self._emulator = autd3_kit().UdpEmulator(boards)
        self._bench = bench
        super().__init__(boards, self._emulator.option())

    def write(self, data: bytes) -> None:
        """Play a frame, on boards and bench."""
        super().write(data)
        self._bench.receive(data)


class EmulatedSensor:
    """A microphone at each control point of an emulated bench, with the noise of `perturbations.Noise`."""

    def __init__(self, bench: EmulatedBench, snr: float | None = None, seed: int = 0) -> None:
        """Set the microphones up.

        Args:
            bench: the bench to measure on.
            snr: 20 log10(reference / sigma) [dB], -1000 to 1000, where the reference is the rms pressure over
                control points and random phases, all transducers fully on; None for no noise.
            seed: of the noise, >= 0.

        `ValueError` for an argument out of range.
        """
        require_kind("bench", bench, EmulatedBench)
        self._bench = bench
        self._generator = np.random.default_rng(integer_at_least("seed", seed, 0))
        rms = random_rms(bench.transfer_matrix)
        self._sigma = 0.0 if snr is None else rms * 10 ** (-number_between("snr", snr, *SNRS, "dB") / 20)

    def read(self) -> torch.Tensor:
        """Return the magnitudes (P,) [Pa]."""
        pressure = self._bench.pressure()
        parts = torch.from_numpy(self._generator.standard_normal((len(pressure), 2)))
        return (pressure + torch.view_as_complex(self._sigma / 2**0.5 * parts)).abs()
