"""Sequences on an emulated OpenMPD: every frame in order and in time, while the computer is idle.

The emulated device compares every transfer with the sequence, and times it by itself.
"""

import math
import os
import time

import torch

from autdtorch import hardware
from autdtorch.hardware.streaming import LATE
from autdtorch.scene.sequence import Sequence

_FRAMES = 900  # of the sequence, which loops

OPTIONS = {
    "--seconds": {"type": float, "default": 60.0, "help": "to play [s]"},
    "--rate": {"type": float, "default": 9000.0, "help": "frames per second [Hz]"},
}


class Receiver:
    """Compares transfers with the frames of a sequence that loops, and counts and times the frames."""

    def __init__(self, frames: bytes, each: int, rate: float) -> None:
        """Expect `frames` of `each` bytes, again and again, at a `rate` [Hz]."""
        self._frames, self._each, self._rate = 2 * frames, each, rate
        self._lap = len(frames)
        self.begin = self.earliest = self.latest = 0.0
        self.count = self.late = self.wrong = 0

    def receive(self, data: bytes) -> None:
        """Take a transfer."""
        now = time.perf_counter()
        if self.count == 0:
            self.begin = now
        place = self._each * self.count % self._lap
        self.wrong += data != self._frames[place : place + len(data)]
        delay = now - self.begin - self.count / self._rate
        number = len(data) // self._each
        self.late += min(number, max(0, math.ceil((delay - LATE) * self._rate)))
        self.latest = max(self.latest, delay)
        self.earliest = min(self.earliest, delay - (number - 1) / self._rate)
        self.count += number


def main(seconds: float, rate: float) -> int:
    """Play random frames, and print what the device saw; return true if a frame was lost or late."""
    device = hardware.OPENMPD
    generator = torch.Generator().manual_seed(0)
    phases = 2 * math.pi * torch.rand(_FRAMES, device.transducers, generator=generator, dtype=torch.float64)
    sequence = Sequence(torch.polar(torch.ones_like(phases), phases), rate)
    bench = hardware.EmulatedBench(device, torch.ones(1, device.transducers, dtype=torch.complex128))
    frames = device.frames(sequence.drives)
    seen = Receiver(frames.tobytes(), frames.shape[1], rate)
    off = device.frame(torch.zeros(device.transducers, dtype=torch.complex128))
    real = bench.firmware.receive

    def receive(data: bytes) -> None:
        if data != off:
            seen.receive(data)
        real(data)

    bench.firmware.receive = receive  # type: ignore[method-assign]
    with hardware.open_link(device, backend=bench.bus, settle=0) as link:
        busy = time.process_time()
        playback = link.play_sequence(sequence, seconds)
        busy = time.process_time() - busy
    lost = round(seconds * rate) - seen.count + seen.wrong
    print(f"sent: {playback}")
    print(f"taken: {seen.count} frames, {lost} lost or wrong, {seen.late} more than 1 ms late")
    print(f"from {-1e3 * seen.earliest:.2f} ms early to {1e3 * seen.latest:.2f} ms late")
    print(f"{busy / seconds:.0%} of a core; load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    print("outputs off in the end" if not bench.emitted().any() else "outputs ON in the end")
    return lost > 0 or seen.late > 0 or bool(bench.emitted().any())
