"""Sequences that the boards of AUTD3 hold: what they emit, by the kit and its emulators."""

import math
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_scenes import random_frames

from autdtorch import hardware as hw
from autdtorch.hardware import streaming
from autdtorch.hardware.devices import autd3
from autdtorch.scene.sequence import Sequence, modulated


def deviation(held, drives):
    """The largest difference of what held levels emit, frame by frame, from drives (T, N)."""
    levels = held.frames.reshape(len(held.frames), 2, -1).astype(float)
    patterns = levels[:, 1] / 255 * np.exp(2j * math.pi * levels[:, 0] / 256)
    number = np.arange(len(drives))
    factors = held.modulation[number % len(held.modulation), None] / 255
    return np.abs(patterns[number % len(patterns)] * factors - drives.numpy()).max()


LEVEL = math.pi / 256 + 1 / 255  # half a level of phase, and of both amplitudes


@given(st.lists(st.sampled_from([0.0, 1e-12, 0.3, 1.0, -1.0, 1j]), min_size=1, max_size=6), st.integers(0, 9))
def test_what_is_held_emits_the_frames(factors, seed):
    drives = torch.tensor(factors, dtype=torch.complex128)[:, None] * random_frames(1, 249, seed)
    assert deviation(hw.AUTD3.held(drives, 4000.0, True), drives) <= LEVEL


@given(st.integers(3, 40), st.integers(1200, 3000), st.integers(0, 9))
@settings(max_examples=20)
def test_a_loop_of_moving_frames_times_factors_is_held(laps, rest, seed):
    lap, count = random_frames(rest // laps, 16, seed), rest // laps * laps
    number = torch.arange(count)
    factors = (0.6 + 0.4 * torch.cos(2 * math.pi * number.double() / count))[:, None]
    drives = factors * lap[number % len(lap)]
    held = replace(hw.AUTD3, board=16).held(drives, 4000.0, True)
    assert len(held.frames) <= max(len(lap), 2)
    assert deviation(held, drives) <= LEVEL


def test_a_drive_and_its_opposite_are_two_patterns():
    drive = random_frames(1, 249)
    held = hw.AUTD3.held(torch.cat([drive, -drive]), 4000.0, True)
    assert not np.array_equal(held.frames[0], held.frames[1])
    assert (held.modulation == 255).all()


def test_a_modulation_longer_than_the_memory_is_refused():
    drives = torch.linspace(0, 1, 65_537, dtype=torch.float64)[:, None] * torch.ones(2).cdouble()
    with pytest.raises(ValueError, match="sequence: 65537 frames; must be at most 65536 frames"):
        hw.AUTD3.held(drives, 4000.0, True)


@pytest.mark.usefixtures("kit")
class TestWithTheKit:
    """Against its emulators of the network and of the boards."""

    def test_limits_are_those_of_the_kit(self, kit):
        assert kit.params.EMISSION_MAX_INDICES == autd3._MOST_PATTERNS
        assert kit.params.MOD_BUFFER_SAMPLES == autd3._MOST_FACTORS
        assert kit.params.ULTRASOUND_FREQ_HZ == autd3._CLOCK

    @pytest.mark.parametrize("loop", [True, False])
    def test_boards_play_a_sequence_and_then_a_drive_without_its_modulation(self, kit, loop, monkeypatch):
        def state():
            async def read():
                states.extend(await link._port._client.read_fpga_state())

            states = []
            link._port._run("be asked", read, 5.0)
            return states

        def begun(rate, count, ended):
            end = time.monotonic() + 60
            while not all(one.is_stm_mode() for one in state()) and time.monotonic() < end:
                time.sleep(0.01)
            begins.append([one.is_stm_mode() for one in state()])
            return real(rate, count, ended)

        begins, real = [], streaming.outlast
        monkeypatch.setattr("autdtorch.hardware.link.outlast", begun)
        boards = kit.UdpEmulator(2)
        with hw.open_autd3(2, network=boards.option(), settle=0) as link:
            playback = link.play_sequence(Sequence(random_frames(50, 498), 1000.0, loop), seconds=0.05)
            assert (playback.frames, playback.late) == (50, None)
            assert begins == [[True, True]]
            assert not any(one.is_stm_mode() for one in state())
            link.play_sequence(modulated(random_frames(1, 498)[0], 200.0), seconds=0.01)
            link.play(torch.ones(498).cdouble())
            assert all(one.current_mod_bank() == kit.value.ModulationBank.B0 for one in state())

    def recorded(self, sequence, laps):
        """Phases and pulse widths (M, ticks) of the boards that the kit emulates."""
        emulator = pytest.importorskip("autd3_emulator", reason="install autdtorch[crosscheck]")
        from autd3_core import Autd3, Duration, Geometry

        recorder = emulator.Recorder(Geometry([Autd3()]), 0)
        held = hw.AUTD3.held(sequence.drives, sequence.rate, sequence.loop)
        recorder.send(autd3.autd3_sequence(held, 1))
        recorder.tick(Duration.from_nanos(round(1e9 * laps * sequence.duration)))
        record = recorder.into_record()
        return [part.to_numpy().astype(int) for part in (record.phase(), record.pulse_width())]

    @pytest.mark.parametrize("rate", [500.0, 4000.0, 40_000.0])
    def test_the_emulated_boards_emit_every_frame_in_order_at_its_time(self, rate):
        # Phases that swing: emulator 0.12.0 smooths in the wrong direction where they wind down twice.
        start, frame = random_frames(1, 249)[0], torch.arange(20)[:, None]
        drives = start.abs() * torch.polar(
            torch.ones(20, 249).double(), start.angle() + torch.sin(math.pi * frame / 10)
        )
        sequence = Sequence(drives, rate)
        phases, widths = self.recorded(sequence, 3)
        ticks = round(40_000 / rate)
        ends = slice(ticks - 1, None, ticks)  # of each frame, when the silencer has reached it
        levels = [level.T.repeat(1, 3).numpy() for level in hw.AUTD3.levels(drives)]
        assert np.array_equal(phases[:, ends], levels[0])
        pulses = 512 * np.arcsin(levels[1] / 255) / math.pi
        assert np.abs(widths[:, ends] - pulses).max() <= 1  # counts of 512

    def test_the_emulated_boards_emit_laps_of_a_path_times_factors(self):
        start, frame = random_frames(1, 249)[0], torch.arange(1220)[:, None]
        swing = torch.sin(math.pi * frame.double() / 10)
        factor = 0.6 + 0.4 * torch.cos(2 * math.pi * frame.double() / 61)  # 61 frames, in laps of 20
        sequence = Sequence(factor * torch.polar(start.abs().expand(1220, -1), start.angle() + swing), 4000.0)
        phases, widths = self.recorded(sequence, 1)
        phase, intensity = (level.T.numpy() for level in hw.AUTD3.levels(sequence.drives))
        assert np.array_equal(phases[:, 9::10][intensity > 0], phase[intensity > 0])
        emitted = np.sin(math.pi * widths[:, 9::10] / 512)
        # Half a level of factor and of intensity, and of 512 pulse widths.
        assert (
            np.abs(emitted - factor.T.numpy() * start.abs()[:, None].numpy()).max() < 1 / 255 + math.pi / 512
        )

    def test_amplitude_modulation_has_its_frequency_and_depth_within_a_hundredth(self):
        sequence = modulated(torch.ones(249).cdouble(), 200.0)
        widths = self.recorded(sequence, 8)[1]
        drive = np.sin(math.pi * widths / 512)
        ends = (drive[:, 9::10] ** 2).mean(axis=0)  # radiation pressure goes with the square
        wanted = (1 + np.sin(2 * math.pi * np.arange(160) / 20)) / 2
        # 8 bits of the factor and of the intensity, 9 bits of the pulse width.
        assert np.abs(ends - wanted).max() < 0.01
        spectrum = np.abs(np.fft.rfft(ends - ends.mean()))
        assert spectrum.argmax() * 4000 / 160 == 200.0
