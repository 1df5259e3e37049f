"""Sequences: frames in time, amplitude modulation, and files of them."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import autdtorch as at

DRIVE = torch.tensor([1.0, 0.5j, -0.25], dtype=torch.complex128)


def numbered(frames, rate=100.0, loop=True):
    """Return a sequence whose frames are told apart by their amplitude."""
    return at.Sequence(torch.linspace(0.1, 1, frames, dtype=torch.complex128)[:, None], rate, loop)


def test_a_sequence_has_times_and_copies_its_drives():
    drives = torch.ones(5, 3, dtype=torch.complex128)
    sequence = at.Sequence(drives, 50.0)
    drives[:] = 0
    assert (sequence.drives == 1).all()
    assert (len(sequence), sequence.transducers, sequence.duration) == (5, 3, 0.1)
    assert sequence.times.tolist() == pytest.approx([0, 0.02, 0.04, 0.06, 0.08])


@settings(max_examples=50)
@given(st.integers(1, 40), st.floats(1, 1e3), st.floats(1, 1e3), st.booleans())
def test_a_new_rate_plays_the_frame_of_its_time(frames, rate, new_rate, loop):
    sequence = numbered(frames, rate, loop)
    other = sequence.at_rate(new_rate)
    assert (other.rate, other.loop) == (new_rate, loop)
    assert abs(other.duration - sequence.duration) <= (0.5 + 1e-9) / new_rate or len(other) == 1
    # times are stretched to whole frames; a time on a border may round to either side
    elapsed = torch.arange(len(other)).double() / len(other) * frames
    near = [{int(time - 1e-9), int(time + 1e-9)} for time in elapsed.tolist()]
    playing = [(sequence.drives == drive).all(dim=1).nonzero()[0].item() for drive in other.drives]
    assert all(frame in frames_near for frame, frames_near in zip(playing, near, strict=True))


@pytest.mark.parametrize(("rate", "frames"), [(None, 20), (4000.0, 20), (1000.0, 5), (900.0, 9)])
def test_the_radiation_pressure_of_a_sine_has_one_frequency(rate, frames):
    sequence = at.modulated(DRIVE, 200.0, depth=0.8, rate=rate)
    assert len(sequence) == frames
    assert sequence.duration * 200 == pytest.approx(round(sequence.duration * 200), rel=1e-12)
    power = sequence.drives.abs().square()
    lines = torch.fft.rfft(power, dim=0).abs() / frames
    periods = round(sequence.duration * 200)
    mean = 1 - 0.8 / 2
    torch.testing.assert_close(lines[0], mean * DRIVE.abs().square(), rtol=1e-12, atol=0)
    torch.testing.assert_close(lines[periods], 0.8 / 4 * DRIVE.abs().square(), rtol=1e-12, atol=0)
    assert lines.sum() == pytest.approx(float((mean + 0.8 / 4) * DRIVE.abs().square().sum()), rel=1e-12)


def test_square_and_samples_hold_their_levels():
    square = at.modulated(DRIVE, 100.0, depth=0.75, waveform="square", rate=1000.0)
    assert square.drives[:, 0].abs().tolist() == pytest.approx([1.0] * 5 + [0.5] * 5)
    sampled = at.modulated(DRIVE, 100.0, waveform=[0.0, 0.25, 1.0])
    assert sampled.rate == pytest.approx(300)
    assert sampled.drives[:, 0].abs().tolist() == pytest.approx([0, 0.5, 1])
    held = at.modulated(DRIVE, 100.0, waveform=[0.0, 0.25, 1.0], rate=600.0)
    assert torch.equal(held.drives, sampled.drives.repeat_interleave(2, dim=0))


def test_a_modulated_sequence_has_whole_laps_and_periods():
    lap = numbered(10, rate=100.0)  # 0.1 s; 25 Hz needs two laps
    both = at.modulated(lap, 25.0, depth=0.5, rate=200.0)
    assert (both.rate, both.duration) == (200, pytest.approx(0.2))
    amplitude = both.drives.abs()[:, 0] / lap.at_rate(200.0).drives.abs()[:, 0].repeat(2)
    turn = 2 * math.pi * torch.arange(40).double() / 8
    torch.testing.assert_close(amplitude.square(), 0.75 + 0.25 * turn.sin(), rtol=0, atol=1e-12)
    ending = at.modulated(numbered(10, loop=False), 3.0)
    assert (ending.duration, ending.loop) == (pytest.approx(0.1), False)
    assert at.modulated(lap, 25.0).rate == 500  # the first multiple with 20 frames a period


ARRAY = at.TransducerArray.grid((3, 1), 10e-3, (0, 0, 0), (0, 0, 1))


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_a_sequence_comes_back_from_its_file(suffix, tmp_path):
    sequence = at.Sequence(at.modulated(DRIVE, 30.0).drives, 1 / 3, loop=False)
    at.save_sequence(tmp_path / f"sequence{suffix}", sequence, ARRAY)
    loaded = at.load_sequence(tmp_path / f"sequence{suffix}")
    assert (loaded.rate, loaded.loop) == (1 / 3, False)
    # phases and amplitudes in text leave rounding
    torch.testing.assert_close(loaded.drives, sequence.drives, rtol=0, atol=1e-14)
    assert torch.equal(at.load_drive(tmp_path / f"sequence{suffix}"), loaded.drives)
    assert at.load_array(tmp_path / f"sequence{suffix}").positions.shape == (3, 3)


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_a_file_for_a_device_has_its_levels(suffix, tmp_path):
    array = at.TransducerArray.autd3((0, 0, 0), (0, 0, 1))
    sequence = at.modulated(torch.full((249,), 0.6 - 0.8j, dtype=torch.complex128), 200.0)
    at.save_sequence(tmp_path / f"sequence{suffix}", sequence, array, device="autd3")
    loaded = at.load_sequence(tmp_path / f"sequence{suffix}")
    assert (loaded.rate, loaded.loop) == (4000, True)
    assert torch.equal(loaded.drives, at.hardware.AUTD3.quantised(sequence.drives))


def test_a_sequence_along_a_path_plays_its_points():
    air = at.Medium(1.2, 343.0)
    array = at.TransducerArray.grid((6, 6), 10e-3, (0, 0, 0), (0, 0, 1))
    circle = at.circle_points((0, 0, 0.1), 5e-3, 20, (0, 0, 1))
    propagator = at.make_propagator(at.Scene(array, air, 40e3, circle))
    sequence = at.sequence_along(propagator, circle, 10.0)
    assert (len(sequence), sequence.rate, sequence.loop) == (20, 200, True)
    matrix = propagator.transfer_matrix()
    level = (matrix * sequence.drives).sum(dim=1).abs()
    assert level.tolist() == pytest.approx([float(matrix.abs().sum(dim=1).min())] * 20, rel=1e-9)
    both = at.sequence_along(propagator, torch.stack([circle, circle.roll(10, 0)], 1), 10.0, [2.0, 1.0])
    reached = (matrix * both.drives).sum(dim=1).abs() / (matrix.roll(10, 0) * both.drives).sum(dim=1).abs()
    assert reached.tolist() == pytest.approx([2.0] * 20, rel=0.05)  # weights settle
    with pytest.raises(ValueError, match=r"path: shape \(2,\); must be \(T, 3\) or \(T, P, 3\)"):
        at.sequence_along(propagator, [1.0, 2.0], 10.0)


def test_files_of_other_things_are_refused(tmp_path):
    other = at.TransducerArray.grid((6, 6), 10e-3, (0, 0, 0), (0, 0, 1))
    with pytest.raises(ValueError, match=r"sequence.drives: shape \(20, 3\); must be \(..., 36\)"):
        at.save_sequence(tmp_path / "sequence.npz", at.modulated(DRIVE, 30.0), other)
    for suffix in (".csv", ".npz"):
        at.save_drive(tmp_path / f"drive{suffix}", DRIVE, ARRAY)
        with pytest.raises(ValueError, match=f"drive{suffix}: a single drive; must have frames"):
            at.load_sequence(tmp_path / f"drive{suffix}")
        at.save_drive(tmp_path / f"frames{suffix}", DRIVE[None], ARRAY)
        with pytest.raises(
            ValueError, match=f"frames{suffix}: no rate and loop; must be written by save_seq"
        ):
            at.load_sequence(tmp_path / f"frames{suffix}")
    with pytest.raises(ValueError, match=r"path: .*; must end in one of .csv, .npz"):
        at.load_sequence("sequence.txt")


MISTAKES = [
    (lambda: at.Sequence(torch.zeros(0, 3, dtype=torch.complex128), 10.0), r"drives: shape \(0, 3\)"),
    (lambda: at.Sequence(DRIVE, 10.0), r"drives: shape \(3,\); must be \(T, M\)"),
    (lambda: at.Sequence(2 * DRIVE[None], 10.0), "drives: amplitude 2; "),
    (lambda: at.Sequence(DRIVE[None], 0.0), "rate: 0.0 Hz; must be finite and > 0"),
    (lambda: numbered(3).at_rate(-1.0), "rate: -1.0 Hz"),
    (lambda: numbered(3).at_rate(1e12), "rate: .* Hz; must be at most .* for 100000 frames"),
    (lambda: at.modulated(DRIVE, 0.0), "frequency: 0.0 Hz"),
    (lambda: at.modulated(DRIVE, 200.0, depth=1.5), "depth: 1.5; must be in 0 to 1"),
    (lambda: at.modulated(DRIVE, 200.0, waveform="triangle"), "waveform: .* sine, square"),
    (lambda: at.modulated(DRIVE, 200.0, waveform=[]), r"waveform: shape \(0,\)"),
    (lambda: at.modulated(DRIVE, 200.0, waveform=[0.0, 2.0]), "waveform: from 0 to 2"),
    (lambda: at.modulated(DRIVE, 200.0, rate=300.0), "rate: 300.0 Hz; must be at least 400"),
    (lambda: at.modulated(numbered(10), 20.0, rate=250.0), "rate: 250.0 Hz; must be a multiple"),
    (lambda: at.modulated(numbered(10), math.pi), "frequency: .* within 100000 frames"),
    (lambda: at.modulated(DRIVE[None], 20.0), r"drive: shape \(1, 3\); must be \(M,\), or a Sequence"),
]


@pytest.mark.parametrize(("mistake", "message"), MISTAKES)
def test_mistakes_are_named_in_one_line(mistake, message):
    with pytest.raises(ValueError, match=message) as refused:
        mistake()
    assert "\n" not in str(refused.value)
