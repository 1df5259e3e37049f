"""Sequences on emulated devices: every frame in order and in time, and outputs off however they end.

First an OpenMPD compares every transfer with the sequence and times it by itself, while a bare loop of sleeps
beside it shows the delays of the computer. Then `autdtorch play` drives a SonicSurface on a pseudo-terminal,
and is ended by signals at random moments; and an OpenMPD is unplugged at random moments.
"""

import contextlib
import itertools
import math
import multiprocessing
import os
import pty
import random
import select
import signal
import subprocess
import sys
import tempfile
import threading
import time
import tty
from typing import Any

import torch

from autdtorch import hardware
from autdtorch.cli import main as command_line
from autdtorch.hardware.streaming import LATE
from autdtorch.scene.sequence import Sequence

_FRAMES = 900  # of the sequence, which loops
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL)
_LONGEST = 60.0  # until a process plays, or has ended [s]
_DRAINED = 0.1  # without a byte, the line is empty [s]
_PLAYING = 0.5  # largest time from the first frame to a signal [s]

_SLEEPS = """
import time
end, delays = time.perf_counter() + {seconds}, []
while (begin := time.perf_counter()) < end:
    time.sleep(0.4e-3)
    delays.append(time.perf_counter() - begin - 0.4e-3)
print(f"{{sum(d > 1e-3 for d in delays)}} more than 1 ms late, the latest by {{1e3 * max(delays):.2f}} ms")
"""

OPTIONS = {
    "--seconds": {"type": float, "default": 60.0, "help": "to play [s]"},
    "--rate": {"type": float, "default": 9000.0, "help": "frames per second [Hz]"},
    "--moments": {"type": int, "default": 40, "help": "number of signals, and of unpluggings"},
    "--seed": {"type": int, "default": 0, "help": "seed of the moments"},
}


def main(seconds: float, rate: float, moments: int, seed: int) -> int:
    """Check all three, and print what was seen; return true if a frame was lost or late, or outputs on."""
    rng = random.Random(seed)
    failed = in_time(seconds, rate) if seconds > 0 else False
    failed |= signalled(moments, rng)
    return failed | unplugged(moments, rng)


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


def in_time(seconds: float, rate: float) -> bool:
    """Play random frames, and print what the device saw; return true if a frame was lost or late."""
    device = hardware.OPENMPD
    sequence = random_sequence(_FRAMES, device.transducers, rate)
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
    command = [sys.executable, "-c", _SLEEPS.format(seconds=seconds)]
    with hardware.open_link(device, backend=bench.bus, settle=0) as link:
        beside = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        busy = time.process_time()
        playback = link.play_sequence(sequence, seconds)
        busy = time.process_time() - busy
    lost = round(seconds * rate) - seen.count + seen.wrong
    is_on = bool(bench.emitted().any())
    print(f"sent: {playback}")
    print(f"taken: {seen.count} frames, {lost} lost or wrong, {seen.late} more than 1 ms late")
    print(f"from {-1e3 * seen.earliest:.2f} ms early to {1e3 * seen.latest:.2f} ms late")
    print(f"sleeps of 0.4 ms beside it: {beside.communicate()[0].strip()}")
    print(f"{busy / seconds:.0%} of a core; load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    print(f"outputs {'ON' if is_on else 'off'} in the end", flush=True)
    return lost > 0 or seen.late > 0 or is_on


def random_sequence(frames: int, transducers: int, rate: float) -> Sequence:
    """Return frames of random phases."""
    generator = torch.Generator().manual_seed(0)
    phases = 2 * math.pi * torch.rand(frames, transducers, generator=generator, dtype=torch.float64)
    return Sequence(torch.polar(torch.ones_like(phases), phases), rate)


def signalled(moments: int, rng: random.Random) -> bool:
    """End `autdtorch play` by signals; return true if outputs are on after one that a program can handle."""
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(["autdtorch.cli.play_command"])
    on, playing = [], 0
    with tempfile.TemporaryDirectory() as folder:
        for number in itertools.islice(itertools.cycle(_SIGNALS), moments):
            is_on = after_signal(number, rng, processes, folder)
            if number == signal.SIGKILL:
                playing += is_on
            elif is_on:
                on.append(number.name)
    kills = len(range(_SIGNALS.index(signal.SIGKILL), moments, len(_SIGNALS)))
    print(f"{moments} signals: outputs on after {len(on)} of {moments - kills} {' '.join(on)}".rstrip())
    print(f"after SIGKILL, which no program sees, the device played on in {playing} of {kills}", flush=True)
    return bool(on)


def after_signal(number: signal.Signals, rng: random.Random, processes: Any, folder: str) -> bool:
    """Signal to `autdtorch play` at a random moment; return whether the device is on once it has ended."""
    device = hardware.SONICSURFACE
    firmware = device.firmware(device.transducers)
    far, near = pty.openpty()
    tty.setraw(far)
    process = processes.Process(target=play, args=(folder, os.ttyname(near)))
    process.start()
    end, moment = time.monotonic() + _LONGEST, math.inf
    while time.monotonic() < end:
        if select.select([far], [], [], 0.01)[0]:
            firmware.receive(os.read(far, 4096))
            if moment == math.inf:  # it has opened the port
                moment = time.monotonic() + rng.uniform(0, _PLAYING)
        if time.monotonic() > moment and process.is_alive():
            os.kill(process.pid, number)
            process.join(_LONGEST)
            end = time.monotonic() + _DRAINED
    os.close(far)
    os.close(near)
    return bool(firmware.drive().any())


def play(folder: str, port: str) -> None:
    """Run `autdtorch play` without end on a SonicSurface at a port."""
    os.chdir(folder)
    sys.argv[1:] = [
        *("play", "scene=homogeneous", "path.frequency=2", "play.rate=80", "play.seconds=null"),
        *("hardware=sonicsurface", f"hardware.port={port}", "hardware.transducers=0-15"),
        *("hardware.limits.amplitude=1", "output=out"),
    ]
    with open(os.devnull, "w", encoding="utf-8") as nowhere, contextlib.redirect_stderr(nowhere):
        command_line.main()


def unplugged(moments: int, rng: random.Random) -> bool:
    """Unplug an OpenMPD amid a sequence, and plug it in again; return true if it is on once it is opened."""
    device = hardware.OPENMPD
    sequence = random_sequence(_FRAMES, device.transducers, 9000.0)
    bench = hardware.EmulatedBench(device, torch.ones(1, device.transducers, dtype=torch.complex128))
    told = on = 0
    for _ in range(moments):
        timer = threading.Timer(rng.uniform(0, 0.05), setattr, (bench.chip, "present", False))
        try:
            with hardware.open_link(device, backend=bench.bus, settle=0) as link:
                timer.start()
                link.play_sequence(sequence)
        except hardware.LinkError as error:
            told += "outputs may still be on" in str(error)
        bench.chip.present = True
        with hardware.open_link(device, backend=bench.bus):
            on += bool(bench.emitted().any())
    print(f"{moments} unpluggings: {told} said that the outputs may be on; on after opening again: {on}")
    return told < moments or on > 0
