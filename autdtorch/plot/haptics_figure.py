"""A figure of the field of a sequence: radiation pressure in time, its spectrum, pressure at moving foci."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from autdtorch.objectives.haptics import TACTILE_BAND, HapticMetrics
from autdtorch.plot.style import new_figure, styled
from autdtorch.utils.validation import require_kind

_SIZE = (9.0, 2.8)  # of the figure [inch]
_COLOURS = ("#0072B2", "#D55E00", "#009E73")  # of the points with the largest tactile part
_ABOVE = 1.2  # of the pressures, up to which their axis extends, for the legend
_BEYOND = 1.6  # of the tactile band, up to which lines of the spectrum are drawn


@styled
def plot_haptics(metrics: HapticMetrics) -> Figure:
    """Plot the field of a sequence.

    On the left the radiation pressure over time, in the middle its spectrum without the mean, at the point
    with the largest part from 5 to 500 Hz, the band that is shaded. On the right the pressure at the foci,
    and the largest elsewhere, if the metrics have a path.

    Args:
        metrics: of `haptic_metrics`.

    Raises:
        ValueError: another object.
    """
    require_kind("metrics", metrics, HapticMetrics)
    figure = new_figure(*_SIZE)
    axes = figure.subplots(1, 2 if metrics.foci is None else 3)
    point = int(metrics.tactile.argmax())
    times = 1e3 * metrics.times.numpy()
    axes[0].step(times, metrics.radiation[:, point].numpy(), where="post", color=_COLOURS[0], linewidth=1.0)
    axes[0].set(xlabel="time [ms]", ylabel="radiation pressure [Pa]", title="strongest point", ylim=0)
    _draw_spectrum(axes[1], metrics, point)
    if metrics.foci is not None and metrics.elsewhere is not None and metrics.ripple is not None:
        for number, pressure in enumerate(metrics.foci.numpy().T):
            label = "focus" if metrics.foci.shape[1] == 1 else f"focus {number}"
            axes[2].plot(times, pressure, color=_COLOURS[number % len(_COLOURS)], label=label, linewidth=1.0)
        axes[2].plot(times, metrics.elsewhere.numpy(), color="0.5", label="elsewhere", linewidth=1.0)
        ripple = f"ripple {100 * float(metrics.ripple.max()):.1f} %"
        axes[2].set(xlabel="time [ms]", ylabel="pressure [Pa]", title=ripple)
        axes[2].set_ylim(0, _ABOVE * axes[2].get_ylim()[1])
        axes[2].legend(loc="upper center", ncols=2)
    return figure


def _draw_spectrum(ax: Axes, metrics: HapticMetrics, point: int) -> None:
    """Draw the lines of the spectrum at a point, and the tactile band."""
    frequencies, lines = metrics.frequencies.numpy()[1:], metrics.spectrum[1:, point].numpy()
    shown = frequencies <= _BEYOND * TACTILE_BAND[1]
    ax.axvspan(*TACTILE_BAND, color="0.92", zorder=0)
    ax.vlines(frequencies[shown], 0, lines[shown], color=_COLOURS[0], linewidth=1.5)
    most = min(float(frequencies[-1]) if len(frequencies) else np.inf, _BEYOND * TACTILE_BAND[1])
    rms = f"5 to 500 Hz: {float(metrics.tactile[point]):.3g} Pa rms"
    ax.set(xlabel="frequency [Hz]", ylabel="radiation pressure [Pa]", title=rms, xlim=(0, most), ylim=0)
