"""What study_conditions.py writes: tables and a figure of methods under real conditions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import torch
from generated_block import table
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from autdtorch.plot.style import TICK_SIZE, Look, looks_of, new_figure, readable, styled

AXES = {
    "signal-to-noise ratio [dB]": {
        "10": "SNR 10 dB",
        "20": "SNR 20 dB",
        "30": "SNR 30 dB",
        "40": "SNR 40 dB",
        r"$\infty$": "undisturbed",
    },
    "phase levels": {
        "2": "2 levels",
        "4": "4 levels",
        "8": "8 levels",
        "16": "16 levels",
        "32": "32 levels",
        "256": "256 levels",
        "any": "undisturbed",
    },
}
"""Rows of panels: label of the axis, then tick and condition."""


@dataclass(frozen=True)
class Outcome:
    """What a method's trials found in a scene under a condition.

    Attributes:
        true: weakest focus that the drives found really make (T,) [Pa].
        observed: what was observed for them (T,) [Pa].
    """

    true: torch.Tensor
    observed: torch.Tensor

    @property
    def error(self) -> float:
        """Standard error of the mean true score [Pa]; 0 for one trial."""
        count = len(self.true)
        return float(self.true.std() / count**0.5) if count > 1 else 0.0


Outcomes = Mapping[tuple[str, str, str], Outcome]
"""By scene, condition and label of the method."""


def keys(outcomes: Outcomes, place: int) -> list[str]:
    """Scenes (0), conditions (1) or methods (2), in the order of their first mention."""
    return list(dict.fromkeys(key[place] for key in outcomes))


def tables(outcomes: Outcomes) -> Iterator[str]:
    """For each scene its name and a Markdown table, rows of conditions and columns of methods."""
    methods = keys(outcomes, 2)
    for scene in keys(outcomes, 0):
        rows = [
            [condition, *(f"{outcomes[scene, condition, method].true.mean():.2f}" for method in methods)]
            for condition in keys(outcomes, 1)
        ]
        error = max(outcome.error for key, outcome in outcomes.items() if key[0] == scene)
        yield f"{readable(scene).capitalize()} (standard errors up to {error:.2f} Pa)"
        yield table(["condition", *methods], rows)


def curse(outcomes: Outcomes) -> str:
    """A Markdown table: mean observed over mean true score, mean over the scenes, where a sensor errs."""
    methods, rows = keys(outcomes, 2), []
    for condition in keys(outcomes, 1):
        ratios = [mean_ratio(outcomes, condition, method) for method in methods]
        if any(abs(ratio - 1) > 1e-6 for ratio in ratios):
            rows.append([condition, *(f"{ratio:.2f}" for ratio in ratios)])
    return table(["condition", *methods], rows)


def mean_ratio(outcomes: Outcomes, condition: str, method: str) -> float:
    """Mean over the scenes of mean observed over mean true score."""
    found = [outcomes[scene, condition, method] for scene in keys(outcomes, 0)]
    return sum(float(one.observed.mean() / one.true.mean()) for one in found) / len(found)


@styled
def plot_conditions(outcomes: Outcomes, command: str) -> Figure:
    """True weakest focus over noise and over levels, a column a scene."""
    scenes, methods = keys(outcomes, 0), keys(outcomes, 2)
    figure = new_figure(0.8 + 2.6 * len(scenes), 6.0)
    panels = figure.subplots(len(AXES), len(scenes), squeeze=False, sharex="row", sharey=True)
    for row, (label, ticks) in zip(panels, AXES.items(), strict=True):
        for ax, scene in zip(row, scenes, strict=True):
            for method, look in looks_of(methods).items():
                line = [outcomes[scene, condition, method] for condition in ticks.values()]
                _draw(ax, line, look, method)
            ax.set_xticks(range(len(ticks)), list(ticks))
            ax.set_xlabel(label)
            ax.tick_params(labelsize=TICK_SIZE)
            ax.grid(color="0.9", lw=0.6)
        row[0].set_ylabel("true weakest focus [Pa]")
    for ax, scene in zip(panels[0], scenes, strict=True):
        ax.set_title(readable(scene))
    panels[0, 0].set_ylim(bottom=0)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=min(len(methods), 6))
    figure.supxlabel(f"bands: standard error of the mean over trials\n{command}", fontsize=TICK_SIZE)
    return figure


def _draw(ax: Axes, outcomes: list[Outcome], look: Look, label: str) -> None:
    colour, marker, dashes = look
    means = torch.stack([outcome.true.mean() for outcome in outcomes]).numpy()
    errors = torch.tensor([outcome.error for outcome in outcomes]).numpy()
    places = range(len(outcomes))
    ax.fill_between(places, means - errors, means + errors, color=colour, alpha=0.2, lw=0)
    ax.plot(places, means, color=colour, marker=marker, linestyle=dashes, ms=4, lw=1.2, label=label)
