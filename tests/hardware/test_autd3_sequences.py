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
