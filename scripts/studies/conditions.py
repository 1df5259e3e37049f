"""Methods under noise, few phase levels, failed transducers and drift.

Writes conditions.png and a block of the documentation. Each trial has its noise and drift, seeded by the
number of the trial. The true score is the weakest focus that the resulting drive makes without noise on the
device in its final state.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from shared.document import Page, command_line, table
from shared.scenes import PAPER, paper_objectives

import autdtorch as at
from autdtorch.plot.style import TICK_SIZE, Look, looks_of, new_figure, readable, styled

DOCUMENT = "conditions.md"
SHOWN = "three_cubes"
"""Scene of the table in the document."""
ONLY_DRAWN = {"SNR 30 dB", "SNR 20 dB, 4 reads", "32 levels, on/off", "8 levels", "4 levels", "drift 0.3 rad"}
"""Conditions that its table leaves out; the figure and the printed tables have them."""

Wrap = Callable[[at.Objective, int], at.Objective]
"""Puts an objective under a condition, for the number of a trial."""


METHODS: dict[str, at.Method] = {
    "random search": at.RandomSearch(),
    "LSSG": at.LSSG(),
    "GABS": at.GABS(),
    "GABS, 2 passes": at.GABS(passes=2),
    "BO": at.BayesOpt(),
    "BO, circle": at.BayesOpt(kernel="circle"),
    "identify": at.Identify(),
    "identify, 256 evaluations": at.Identify(256),
}

OPTIONS = {
    "--methods": {"nargs": "+", "choices": METHODS, "default": list(METHODS), "help": "compared methods"},
    "--trials": {"type": int, "default": 20, "help": "trials of each method"},
}


def main(page: Page, methods: list[str], trials: int) -> None:
    """Measure; print all tables, and write block and figure."""
    outcomes = {}
    for scene, objective in paper_objectives().items():
        for condition, wrap in CONDITIONS.items():
            for name in methods:
                method = METHODS[name]
                result = outcome(method, objective, wrap, trials, isinstance(method, at.BayesOpt))
                outcomes[scene, condition, name] = result
                print(f"{scene}, {condition}, {name}: {result.true.mean():.3f} Pa", flush=True)
    for scene in PAPER:
        print("", f"True weakest focus [Pa], {scene}:", "", true_scores(outcomes, scene), sep="\n")
    error = max(result.error for result in outcomes.values())
    page.write(
        "![True weakest focus over the level of noise and over the number of phase levels](conditions.png)",
        f"Mean true weakest focus [Pa] of {trials} trials in {readable(SHOWN)}; standard errors are at "
        f"most {error:.2f} Pa.",
        true_scores({key: each for key, each in outcomes.items() if key[1] not in ONLY_DRAWN}, SHOWN),
    )
    page.save("conditions.png", plot_conditions(outcomes))


def failed(objective: at.Objective, trial: int, count: int = 1) -> at.Objective:
    """Switch off transducers, different ones in each trial."""
    order = torch.randperm(len(objective.scene.array), generator=torch.Generator().manual_seed(trial))
    return at.FailedTransducers(objective, order[:count].tolist())


def bench(objective: at.Objective, trial: int) -> at.Objective:
    """Combine everything: 32 levels without amplitudes, one failed transducer, drift, four reads at 20 dB."""
    drifting = at.Drift(failed(objective, trial), phase=0.3, loss=0.1, sensor=0.1, seed=trial)
    return at.Noise(at.Quantised(drifting, 32, on_off=True), 20, reads=4, seed=trial)


CONDITIONS: dict[str, Wrap] = {
    "undisturbed": lambda objective, trial: objective,
    **{f"SNR {snr} dB": lambda o, t, snr=snr: at.Noise(o, snr, seed=t) for snr in (40, 30, 20, 10)},
    "SNR 20 dB, 4 reads": lambda objective, trial: at.Noise(objective, 20, reads=4, seed=trial),
    **{f"{n} levels": lambda o, t, n=n: at.Quantised(o, n) for n in (256, 32, 16, 8, 4, 2)},
    "32 levels, on/off": lambda objective, trial: at.Quantised(objective, 32, on_off=True),
    "four failed": partial(failed, count=4),
    "drift 0.3 rad": lambda objective, trial: at.Drift(objective, phase=0.3, seed=trial),
    "drift 1 rad": lambda objective, trial: at.Drift(objective, phase=1.0, seed=trial),
    "all at once": bench,
}

NOISE = {str(snr): f"SNR {snr} dB" for snr in (10, 20, 30, 40)}
AXES = {
    "signal-to-noise ratio [dB]": {**NOISE, r"$\infty$": "undisturbed"},
    "phase levels": {**{str(n): f"{n} levels" for n in (2, 4, 8, 16, 32, 256)}, "any": "undisturbed"},
}
"""Rows of panels: label of the axis, then ticks and their conditions."""


@dataclass(frozen=True)
class Outcome:
    """The weakest foci (T,) [Pa] of a method's trials under a condition."""

    true: torch.Tensor
    observed: torch.Tensor

    @property
    def error(self) -> float:
        """Return the standard error of the mean true score [Pa]; 0 for one trial."""
        count = len(self.true)
        return float(self.true.std() / count**0.5) if count > 1 else 0.0


Outcomes = Mapping[tuple[str, str, str], Outcome]
"""Outcomes by scene, condition and method."""


class SideBySide:
    """Objectives of several trials as one, with an equal share of the rows for each."""

    def __init__(self, objectives: Sequence[at.Objective]) -> None:
        """Join the objectives of trials 0, 1, ..."""
        self.scene = objectives[0].scene
        self.evaluations = 0
        self._objectives = objectives

    def __call__(self, drive: torch.Tensor) -> torch.Tensor:
        """Observe drives (T * B, M), with the rows of a trial together."""
        self.evaluations += len(drive)
        shares = drive.chunk(len(self._objectives))
        return torch.cat([see(share) for see, share in zip(self._objectives, shares, strict=True)])


def outcome(
    method: at.Method, objective: at.Objective, wrap: Wrap, trials: int, together: bool = False
) -> Outcome:
    """Return true and observed scores of a method's trials under a condition.

    All trials run in one call if `together`, of methods whose trials take equally many evaluations a step.
    """
    objectives = [wrap(objective, trial) for trial in range(trials)]
    if together:
        solutions = [at.run(method, SideBySide(objectives), trials)]
    else:
        solutions = [at.run(method, each, [trial]) for trial, each in enumerate(objectives)]
    drives = torch.cat([solution.drive for solution in solutions])
    true = [at.true_pressure(each, drive) for each, drive in zip(objectives, drives, strict=True)]
    return Outcome(at.weakest_focus(torch.stack(true)), torch.cat([each.score for each in solutions]))


def keys(outcomes: Outcomes, place: int) -> list[str]:
    """Return the scenes (0), conditions (1) or methods (2)."""
    return list(dict.fromkeys(key[place] for key in outcomes))


def true_scores(outcomes: Outcomes, scene: str) -> str:
    """Return a table of mean true scores in a scene, rows of conditions and columns of methods."""
    methods = keys(outcomes, 2)
    rows = []
    for condition in keys(outcomes, 1):
        means = [outcomes[scene, condition, method].true.mean() for method in methods]
        rows.append([condition, *(f"{mean:.2f}" for mean in means)])
    return table(["perturbation", *methods], rows)


@styled
def plot_conditions(outcomes: Outcomes) -> Figure:
    """Plot the true weakest focus over noise and over levels, a column for each scene."""
    scenes, methods = keys(outcomes, 0), keys(outcomes, 2)
    figure = new_figure(0.8 + 2.6 * len(scenes), 6.0)
    panels = figure.subplots(len(AXES), len(scenes), squeeze=False, sharex="row", sharey=True)
    for row, (label, ticks) in zip(panels, AXES.items(), strict=True):
        for ax, scene in zip(row, scenes, strict=True):
            for method, look in looks_of(methods).items():
                _draw(ax, [outcomes[scene, condition, method] for condition in ticks.values()], look, method)
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
    figure.supxlabel(f"bands: standard error of the mean over trials\n{command_line()}", fontsize=TICK_SIZE)
    return figure


def _draw(ax: Axes, outcomes: list[Outcome], look: Look, label: str) -> None:
    means, errors = np.array([(float(outcome.true.mean()), outcome.error) for outcome in outcomes]).T
    style = {"color": look.colour, "marker": look.marker, "linestyle": look.dashes, "ms": 4, "lw": 1.2}
    ax.fill_between(range(len(means)), means - errors, means + errors, color=look.colour, alpha=0.2, lw=0)
    ax.plot(means, label=label, **style)
