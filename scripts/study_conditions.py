"""Every method under noise, few levels, dead transducers and drift; writes docs/conditions.md.

    python scripts/study_conditions.py                              all methods that the package has
    python scripts/study_conditions.py --methods gabs identify      only these

Each trial has an objective of its own, whose noise and drift follow from the trial's number. What counts is
the true score: the weakest focus that the drive found really makes on the device as it then is.
"""

from __future__ import annotations

import argparse
import inspect
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from conditions_report import Outcome, curse, plot_conditions, tables
from generated_block import fill_in, measured
from paper_objectives import DOCS, paper_objectives

import autdtorch as at
from autdtorch.plot.style import label_of

Wrap = Callable[[at.Objective, int], at.Objective]
"""Puts an objective under a condition; takes the trial's number as well."""


@dataclass(frozen=True)
class Method:
    """A method with its settings.

    Attributes:
        function: name in the package.
        settings: keyword arguments.
        together: all trials go in one call, which batches their work; only for methods whose trials take the
            same number of evaluations in every step.
    """

    function: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    together: bool = False

    @property
    def label(self) -> str:
        """Its name in the report."""
        settings = (
            value if isinstance(value, str) else f"{value} {key}" for key, value in self.settings.items()
        )
        return ", ".join([label_of(self.function), *settings])


METHODS = {
    "random_search": Method("random_search"),
    "lss": Method("lss"),
    "lssg": Method("lssg"),
    "lssg_5_passes": Method("lssg", {"passes": 5}),
    "gabs": Method("gabs"),
    "gabs_2_passes": Method("gabs", {"passes": 2}),
    "bayes_opt": Method("bayes_opt", together=True),
    "bayes_opt_circle": Method("bayes_opt", {"embedding": "circle"}, together=True),
    "identify": Method("identify"),
    "identify_256": Method("identify", {"evaluations": 256}),
}
"""By the name to choose them by."""


def dead(objective: at.Objective, trial: int, count: int = 1) -> at.Objective:
    """Silences transducers that are other ones in every trial."""
    order = torch.randperm(len(objective.scene.array), generator=torch.Generator().manual_seed(trial))
    return at.Dead(objective, order[:count].tolist())


def bench(objective: at.Objective, trial: int) -> at.Objective:
    """Everything at once: a device of 32 levels without amplitudes, warming up, read four times at 20 dB."""
    drifting = at.Drift(dead(objective, trial), phase=0.3, loss=0.1, sensor=0.1, seed=trial)
    return at.Noise(at.Quantised(drifting, 32, on_off=True), 20, reads=4, seed=trial)


CONDITIONS: dict[str, Wrap] = {
    "undisturbed": lambda objective, trial: objective,
    **{f"SNR {snr} dB": lambda o, t, snr=snr: at.Noise(o, snr, seed=t) for snr in (40, 30, 20, 10)},
    "SNR 20 dB, 4 reads": lambda objective, trial: at.Noise(objective, 20, reads=4, seed=trial),
    **{f"{n} levels": lambda o, t, n=n: at.Quantised(o, n) for n in (256, 32, 16, 8, 4, 2)},
    "32 levels, on/off": lambda objective, trial: at.Quantised(objective, 32, on_off=True),
    "one dead": dead,
    "four dead": partial(dead, count=4),
    "drift 0.3 rad": lambda objective, trial: at.Drift(objective, phase=0.3, seed=trial),
    "drift 1 rad": lambda objective, trial: at.Drift(objective, phase=1.0, seed=trial),
    "drift of the sensor, 0.3": lambda objective, trial: at.Drift(objective, sensor=0.3, seed=trial),
    "all at once": bench,
}


class SideBySide:
    """Objectives of several trials as one: equal shares of the rows go to each, in order."""

    def __init__(self, objectives: Sequence[at.Objective]) -> None:
        """Hold the objectives of trials 0, 1, ..."""
        self.scene = objectives[0].scene
        self.evaluations = 0
        self._objectives = objectives

    def __call__(self, drive: torch.Tensor) -> torch.Tensor:
        """Observe drives (T * B, M), the rows of a trial together."""
        self.evaluations += len(drive)
        shares = drive.chunk(len(self._objectives))
        return torch.cat([own(share) for own, share in zip(self._objectives, shares, strict=True)])


def solve(method: Method, objective: at.Objective, trials: Sequence[int]) -> at.Solution:
    """Run trials of a method; one without random choices has no `trials` and no `seed`."""
    function = getattr(at, method.function)
    given = {"trials": list(trials), "seed": 0}
    known = {key: value for key, value in given.items() if key in inspect.signature(function).parameters}
    return function(objective, **method.settings, **known)


def outcome(method: Method, objective: at.Objective, wrap: Wrap, trials: int) -> Outcome:
    """True and observed scores of a method's trials under a condition."""
    objectives = [wrap(objective, trial) for trial in range(trials)]
    if method.together:
        solutions = [solve(method, SideBySide(objectives), range(trials))]
    else:
        solutions = [solve(method, own, [trial]) for trial, own in enumerate(objectives)]
    drives = torch.cat([solution.drive for solution in solutions])
    true = [at.true_pressure(own, drive[None]) for own, drive in zip(objectives, drives, strict=True)]
    return Outcome(at.weakest_focus(torch.cat(true)), torch.cat([found.score for found in solutions]))


def main() -> None:
    """Measure, and write block and figure."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--trials", type=int, default=20)
    arguments = parser.parse_args()
    outcomes = {}
    for scene, objective in paper_objectives().items():
        for condition, wrap in CONDITIONS.items():
            for name in arguments.methods:
                found = outcome(METHODS[name], objective, wrap, arguments.trials)
                outcomes[scene, condition, METHODS[name].label] = found
                print(f"{scene}, {condition}, {name}: {found.true.mean():.3f} Pa", flush=True)

    command = shlex.join(["python", "scripts/study_conditions.py", *sys.argv[1:]])
    plot_conditions(outcomes, command).savefig(DOCS / "conditions.png")
    parts = (
        measured(command),
        "![True weakest focus over the level of noise and over the number of phase levels](conditions.png)",
        f"Mean true weakest focus [Pa] of {arguments.trials} trials:",
        *tables(outcomes),
        "What the best observation promises over what it then gives (mean observed over mean true score):",
        curse(outcomes),
    )
    fill_in(DOCS / "conditions.md", "study_conditions", parts, DOCS)


if __name__ == "__main__":
    main()
