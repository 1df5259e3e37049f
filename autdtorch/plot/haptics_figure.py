"""A figure of the field of a sequence: radiation pressure in time, its spectrum, pressure at moving foci."""

from __future__ import annotations

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from autdtorch.objectives.haptics import TACTILE_BAND, HapticMetrics
from autdtorch.plot.style import new_figure, styled
from autdtorch.utils.validation import require_kind

_SIZE = (9.0, 2.8)  # of the figure [inch]
_COLOURS = ("#0072B2", "#D55E00", "#009E73")  # of foci; the first one also of the strongest point
_ABOVE = 1.2  # of the pressures, up to which their axis extends, for the legend
_BEYOND = 1.6  # of the tactile band, up to which lines of the spectrum are drawn


@styled
def plot_haptics(metrics: HapticMetrics) -> Figure:
    """Plot the field of a sequence.

    The left panel shows the radiation pressure over time, the middle one its spectrum without the mean. Both
    are at the point with the largest part from 5 to 500 Hz, the shaded band. With a path, the right panel
    shows the pressure at the foci and the largest elsewhere.

    Args:
        metrics: of `haptic_metrics`.

    Raises:
        ValueError: another object.
    """
    require_kind("metrics", metrics, HapticMetrics)
    figure = new_figure(*_SIZE)
    axes = figure.subplots(1, 2 if metrics.foci is None else 3)
    point = int(metrics.tactile.argmax())
    _draw_frames(axes[0], metrics, metrics.radiation[:, point], _COLOURS[0])
    axes[0].set(xlabel="time [ms]", ylabel="radiation pressure [Pa]", title="strongest point", ylim=0)
    _draw_spectrum(axes[1], metrics, point)
    if metrics.foci is not None and metrics.elsewhere is not None and metrics.ripple is not None:
        for number, pressure in enumerate(metrics.foci.T):
            label = "focus" if metrics.foci.shape[1] == 1 else f"focus {number}"
            _draw_frames(axes[2], metrics, pressure, _COLOURS[number % len(_COLOURS)], label)
        _draw_frames(axes[2], metrics, metrics.elsewhere, "0.5", "elsewhere")
        ripple = f"ripple {100 * float(metrics.ripple.max()):.1f} %"
        axes[2].set(xlabel="time [ms]", ylabel="pressure [Pa]", title=ripple)
        axes[2].set_ylim(0, _ABOVE * axes[2].get_ylim()[1])
        axes[2].legend(loc="upper center", ncols=2)
    return figure


def _draw_frames(
    ax: Axes, metrics: HapticMetrics, values: torch.Tensor, color: str, label: str | None = None
) -> None:
    """Draw values (T,), each from its frame to the next one."""
    times = torch.cat([metrics.times, 1 / metrics.frequencies[1:2]])
    held = torch.cat([values, values[-1:]])
    ax.step((1e3 * times).numpy(), held.numpy(), where="post", color=color, label=label, linewidth=1.0)


def _draw_spectrum(ax: Axes, metrics: HapticMetrics, point: int) -> None:
    """Draw the lines of the spectrum at a point, and the tactile band."""
    frequencies, lines = metrics.frequencies.numpy()[1:], metrics.spectrum[1:, point].numpy()
    shown = frequencies <= _BEYOND * TACTILE_BAND[1]
    ax.axvspan(*TACTILE_BAND, color="0.92", zorder=0)
    ax.vlines(frequencies[shown], 0, lines[shown], color=_COLOURS[0], linewidth=1.5)
    most = min(float(frequencies[-1]), _BEYOND * TACTILE_BAND[1])
    rms = f"5 to 500 Hz: {float(metrics.tactile[point]):.3g} Pa rms"
    ax.set(xlabel="frequency [Hz]", ylabel="radiation pressure [Pa]", title=rms, xlim=(0, most), ylim=0)
