"""The field of sequences in time: radiation pressure, its spectrum, moving foci, and the silencer."""

import math

import pytest
import torch

import autdtorch as at

AIR = at.Medium(density=1.2, sound_speed=343.0)
ARRAY = at.TransducerArray.grid((8, 8), 10e-3, (0, 0, 0), (0, 0, 1))
CENTER = (0.0, 0.0, 0.1)
CIRCLE = at.circle_points(CENTER, 5e-3, 40, (0, 0, 1))
PROPAGATOR = at.make_propagator(at.Scene(ARRAY, AIR, 40e3, CIRCLE))


def test_modulated_radiation_pressure_of_a_focus_is_one_line():
    matrix = PROPAGATOR.transfer_matrix([CENTER])[0]
    sequence = at.modulated(matrix.conj() / matrix.abs(), 200.0)
    metrics = at.haptic_metrics(PROPAGATOR, sequence, [CENTER], reflection=0.5)
    most = 1.25 * float(matrix.abs().sum()) ** 2 / (2 * 1.2 * 343.0**2)
    # (1 + sin) / 2 of the most: mean and amplitude are half of it; each of 20 frames is held
    held = math.sin(math.pi / 20) / (math.pi / 20)
    assert metrics.spectrum[0, 0] == pytest.approx(most / 2, rel=1e-12)
    line = metrics.frequencies.tolist().index(pytest.approx(200.0))
    assert metrics.spectrum[line, 0] == pytest.approx(held * most / 2, rel=1e-12)
    # 400 Hz and more: none
    assert metrics.tactile[0] == pytest.approx(held * most / 2 / math.sqrt(2), rel=1e-12)
    assert metrics.foci is metrics.elsewhere is metrics.ripple is None


def test_two_frames_are_a_square_wave():
    """Its amplitudes are 4 / (pi n) of half the difference, for odd n, also above half the rate."""
    drives = torch.stack([torch.ones(64), torch.zeros(64)]).to(torch.complex128)
    metrics = at.haptic_metrics(PROPAGATOR, at.Sequence(drives, 200.0), [CENTER])
    half = metrics.radiation[0, 0] / 2
    odd = 4 / math.pi, 4 / (3 * math.pi), 4 / (5 * math.pi)
    expected = half * torch.tensor([1, odd[0], 0, odd[1], 0, odd[2]], dtype=torch.float64)
    assert metrics.frequencies.tolist() == pytest.approx([0, 100, 200, 300, 400, 500])
    torch.testing.assert_close(metrics.spectrum[:, 0], expected, rtol=1e-12, atol=1e-12 * float(half))
    assert metrics.tactile[0] == pytest.approx(float((expected[1:].square().sum() / 2).sqrt()), rel=1e-12)


@pytest.mark.parametrize("frames", [1, 2, 7, 8])
def test_the_spectrum_has_the_power_of_the_time_signal(frames):
    drives = torch.rand(frames, 64, generator=torch.Generator().manual_seed(frames)).to(torch.complex128)
    metrics = at.haptic_metrics(PROPAGATOR, at.Sequence(drives, frames * 5.0), CIRCLE[:2])
    assert metrics.frequencies[1] == pytest.approx(5.0)
    power = metrics.spectrum[0].square() + metrics.tactile.square()
    # steps of (frames * 5) Hz leave 1 / (pi^2 n) of their power above 500 Hz, n = 500 / (5 frames)
    torch.testing.assert_close(power, metrics.radiation.square().mean(dim=0), rtol=0.02, atol=0)


def test_foci_of_a_path_have_ripple_and_side_maxima():
    sequence = at.sequence_along(PROPAGATOR, CIRCLE, 10.0)
    plane = at.Plane(CENTER, (0, 0, 1), (80e-3, 80e-3)).points(4e-3).reshape(-1, 3)
    metrics = at.haptic_metrics(PROPAGATOR, at.silenced(sequence), plane, CIRCLE)
    assert metrics.foci.shape == (400, 1)
    assert metrics.ripple < 0.01  # phases lag by up to 0.8 mm of 8 mm wavelength
    # side lobes of a square aperture: 22 % of the focus, and less than half behind the silencer
    assert (metrics.elsewhere < 0.5 * metrics.foci.min()).all()
    assert (metrics.elsewhere > 0.05 * metrics.foci.min()).all()
    assert "ripple" in repr(metrics)


def test_modulation_of_two_laps_is_the_ripple_of_foci_that_are_named_twice():
    sequence = at.modulated(at.sequence_along(PROPAGATOR, CIRCLE, 10.0), 25.0, depth=0.19, waveform="square")
    metrics = at.haptic_metrics(PROPAGATOR, sequence, CIRCLE[:1], CIRCLE.repeat(2, 1))
    assert sequence.duration == pytest.approx(0.2)
    assert float(metrics.ripple) == pytest.approx((1 - 0.9) / (1 + 0.9), rel=1e-9)  # root of 1 - 0.19


def test_the_silencer_turns_phases_and_amplitudes_over_its_times():
    drives = torch.tensor([[1.0], [0.5j], [0.0]], dtype=torch.complex128)
    played = at.silenced(at.Sequence(drives, 500.0, loop=False))  # 2 ms a frame, in parts of 0.2 ms
    assert (len(played), played.rate) == (30, 5000)
    angle, size = played.drives[:, 0].angle(), played.drives[:, 0].abs()
    assert angle[:10].tolist() == [0.0] * 10
    assert angle[10:20].tolist() == pytest.approx(
        [math.pi / 2 * x for x in (0.1, 0.3, 0.5, 0.7, 0.9, *[1] * 5)]
    )
    assert size[10:20].tolist() == pytest.approx([0.8, *[0.5] * 9])
    assert size[20:].tolist() == pytest.approx([0.3, *[0.0] * 9])
    short = at.silenced(at.Sequence(drives, 10e3))  # a frame is shorter than both times: half-way on average
    assert short.drives[10:20, 0].abs().mean() == pytest.approx(0.75)
    unchanged = at.silenced(at.Sequence(drives, 500.0), 0.0, 0.0)
    torch.testing.assert_close(unchanged.drives, drives.repeat_interleave(10, 0), rtol=0, atol=1e-15)


def test_the_figure_has_time_spectrum_and_foci():
    sequence = at.sequence_along(PROPAGATOR, CIRCLE, 10.0)
    with_path, without = (
        at.plot_haptics(at.haptic_metrics(PROPAGATOR, sequence, CIRCLE[:3], path)) for path in (CIRCLE, None)
    )
    assert [len(figure.axes) for figure in (with_path, without)] == [3, 2]
    assert {line.get_label() for line in with_path.axes[2].lines} == {"focus", "elsewhere"}
    for axes in (*with_path.axes[::2], without.axes[0]):
        assert axes.lines[0].get_xdata()[-1] == pytest.approx(100.0)  # ms, the end of the last frame


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"sequence": at.modulated(torch.ones(3).to(torch.complex128), 30.0)}, "sequence: 3 transducers"),
        ({"points": [1.0, 2.0]}, "points: shape"),
        ({"points": ARRAY.positions[:1]}, "points: "),
        ({"path": CIRCLE[:7]}, r"path: shape \(7, 1, 3\); must be .* of which 40 frames are a multiple"),
        ({"reflection": 1.5}, "reflection: 1.5; must be in 0 to 1"),
    ],
)
def test_mistakes_are_named(arguments, message):
    sequence = at.Sequence(torch.ones(40, 64, dtype=torch.complex128), 400.0)
    with pytest.raises(ValueError, match=message):
        at.haptic_metrics(**{"propagator": PROPAGATOR, "sequence": sequence, "points": [CENTER], **arguments})
