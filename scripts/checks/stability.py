"""Growth in random scenes, stepped far beyond the steady state.

Prints two Markdown tables. Each scene of `shared/random_scenes.py` runs twice: driven from silence, and from
random pressure without a source, which excites every mode of the grid. All values must stay finite. The norm
of the pressure must rise less in its last half than a driven resonance can, and the spread of its phasors
must not increase. Exits with 1 if any scene fails. Takes about 12 minutes for 500 scenes on 2 idle cores.
"""

import logging
import math
import multiprocessing
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from shared.document import table
from shared.random_scenes import LONG_SHARE, LONG_STEPS, Trial, draw_trial
from tqdm import tqdm

from autdtorch.fdtd.kernels.contract import Receivers, Sources, WaveState
from autdtorch.fdtd.kernels.cpu import CpuKernel
from autdtorch.fdtd.stepping import RAMP_PERIODS, Assembly, assemble, drive_dft, drive_signal
from autdtorch.propagators.plan import region_of
from autdtorch.utils.array_types import Array

FEWEST_PERIODS = 3 * RAMP_PERIODS
"""Shortest driven run; in a scene with a fast obstacle a period has hundreds of steps."""

LONGER = 10
"""Ratio of the steps of a second run, in which a rise must go on to count; slow beats end."""

WINDOWS, SAMPLES = 32, 16
"""Windows of a run, and samples of its norm in each; the largest counts."""

LARGEST_RISE = {"driven": math.log(2.5), "free": math.log(1.2)}
"""Rise of the logarithm of the pressure's norm over the last half of a run. A driven resonance without loss
rises in proportion to time, to twice its norm. Without a source only beating modes rise, by less than 1.2."""

WANDERING = 2.0
"""Spread of the phasors in the last quarter of a run over that in the two quarters before it."""
STILL = {torch.float32: 1e-3, torch.float64: 1e-6}
"""Spread of steady phasors relative to their size."""


OPTIONS = {
    "--scenes": {"type": int, "default": 500, "help": "number of scenes"},
    "--seed": {"type": int, "default": 0, "help": "seed of the scenes"},
    "--only": {"type": int, "help": "number of the one scene to run"},
    "--long-share": {"type": float, "default": LONG_SHARE, "help": f"share of {LONG_STEPS} steps"},
    "--processes": {"type": int, "default": 2, "help": "scenes at once"},
}


def main(scenes: int, seed: int, only: int | None, long_share: float, processes: int) -> int:
    """Run the scenes; print each failure when it occurs, then the tables."""
    if only is not None:
        outcome = _numbered((seed, only, long_share))
        print(outcome)
        return int(outcome.failed)
    tasks = [(seed, number, long_share) for number in range(scenes)]
    outcomes = []
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        for outcome in tqdm(pool.imap(_numbered, tasks), total=len(tasks)):
            outcomes.append(outcome)
            if outcome.failed:
                tqdm.write(f"{outcome}\n")
    titles = {True: "Obstacles inside the domain", False: "Obstacles that may reach out of it"}
    for inside, title in titles.items():
        print(f"\n{title}:\n\n{summary([o for o in outcomes if o.trial.inside == inside])}")
    refused = sum(outcome.trial.refused for outcome in outcomes)
    reasons = "an obstacle too slow for the spacing, or a wall across the domain that absorbs"
    print(f"\n{refused} further scenes were refused: {reasons}.")
    return int(any(outcome.failed for outcome in outcomes))


@dataclass(frozen=True)
class Outcome:
    """The result of a trial. The logarithm of the pressure's norm grows over the last half of a run."""

    trial: Trial
    rate: dict[str, float]  # growth per period, by run
    rise: dict[str, float]  # growth, by run
    finite: bool
    wandering: float  # spread of the phasors in the last quarter of the driven run over that before it
    where: str  # place of the peak of the run that rose most [cells], or the error before the run

    @property
    def failed(self) -> bool:
        risen = any(rise > LARGEST_RISE[run] for run, rise in self.rise.items())
        return not self.finite or risen or self.wandering > WANDERING

    def __str__(self) -> str:
        rates = ", ".join(
            f"{run} {rate:+.2g} (x {math.exp(min(self.rise[run], 700)):.3g})"
            for run, rate in self.rate.items()
        )
        return (
            f"{self.trial}\n    growth per period: {rates}; phasors' spread x {self.wandering:.2g}; "
            f"largest at {self.where}{'' if self.finite else '; NOT FINITE'}"
        )


def run_trial(trial: Trial) -> Outcome:
    """Step the scene of a trial, driven and free."""
    try:
        assembly = assemble(region_of(trial.scene).whole, trial.spacing, trial.dtype)
    except Exception as error:  # counts as a failure: all scenes are valid
        infinite = dict.fromkeys(LARGEST_RISE, math.inf)
        return Outcome(trial, infinite, infinite, False, math.inf, f"assembling: {error!r}")
    period = float(assembly.steps_per_period)
    driven = math.ceil(FEWEST_PERIODS * period)
    steps = {
        "driven": max(trial.steps, driven),
        "free": max(trial.steps, assembly.steps_per_period.numerator),
    }
    mass = np.ones(math.prod(assembly.grid.shape))
    mass[assembly.heterogeneous.index] = assembly.heterogeneous.mass
    strength = torch.full(
        (len(trial.scene.array),), trial.scene.array.source_strength, dtype=torch.complex128
    )
    sources = assembly.sources(trial.scene.array.positions, strength)
    silent = Sources(sources.index[:0], sources.force[:, :0])
    receivers = assembly.receivers(trial.scene.control_points)
    start = {"driven": assembly.silence(sources), "free": _random_state(assembly, sources, trial.number)}
    drive = {"driven": sources, "free": silent}
    courses = {
        run: _course(assembly, start[run], drive[run], receivers, mass, count) for run, count in steps.items()
    }
    rise = {run: _rise(course.norm) for run, course in courses.items()}
    return Outcome(
        trial,
        {run: value / (steps[run] / 2 / period) for run, value in rise.items()},
        rise,
        all(math.isfinite(value) for value in rise.values()),
        _wandering(courses["driven"].phasor, STILL[trial.dtype]),
        courses[max(rise, key=lambda run: rise[run])].where,
    )


@dataclass(frozen=True)
class _Course:
    """A run: largest norm of each window (n,), phasors of each block (b, R), place of the peak."""

    norm: Array
    phasor: NDArray[np.complex128]
    where: str


def _random_state(assembly: Assembly, sources: Sources, seed: int) -> WaveState:
    """Return random pressure at rest in the interior; none in rigid cells, where it would stay."""
    grid, state = assembly.grid, assembly.silence(sources)
    inside = grid.deeper(0)
    state.now[0, *inside] = torch.from_numpy(np.random.default_rng(seed).standard_normal(grid.interior)).to(
        assembly.dtype
    )
    state.now.reshape(-1)[torch.from_numpy(assembly.heterogeneous.rigid)] = 0
    state.before.copy_(state.now)
    return state


def _course(
    assembly: Assembly, state: WaveState, sources: Sources, receivers: Receivers, mass: Array, steps: int
) -> _Course:
    """Step a run and record the norm of its pressure, weighted with the masses as in the energy."""
    at_once = math.ceil(steps / (WINDOWS * SAMPLES))
    norm, recorded = np.zeros(WINDOWS * SAMPLES), []
    for sample in range(len(norm)):
        signal = drive_signal(assembly.steps_per_period, sample * at_once, at_once).to(assembly.dtype)
        state, observed = CpuKernel().advance(state, assembly.coefficients, sources, receivers, signal)
        recorded.append(observed[0])
        pressure = state.now.numpy().ravel().astype(np.float64)
        with np.errstate(over="ignore", invalid="ignore"):  # detected below
            norm[sample] = np.sqrt((mass * pressure**2).sum())
    block = assembly.steps_per_period.numerator
    whole = torch.cat(recorded)
    phasor = [
        drive_dft(whole[first : first + block], assembly.steps_per_period.denominator)
        for first in range(0, len(whole) - block + 1, block)
    ]
    peak = np.unravel_index(np.abs(state.now[0].numpy()).argmax(), assembly.grid.shape)
    where = np.array(peak) - assembly.grid.to_cells(torch.zeros((1, 3), dtype=torch.float64))[0]
    text = "(" + ", ".join(f"{x:.1f}" for x in where) + ")"
    return _Course(norm.reshape(WINDOWS, SAMPLES).max(axis=1), torch.stack(phasor).numpy(), text)


def _rise(norm: Array) -> float:
    """Return the rise of the logarithm of `norm` over the last half of its windows, by a linear fit."""
    late = norm[len(norm) // 2 :]
    if not np.isfinite(late).all():
        return math.inf
    if late.min() == 0:
        return 0.0
    return float(np.polyfit(np.linspace(0, 1, len(late)), np.log(late), 1)[0])


def _wandering(phasor: NDArray[np.complex128], still: float) -> float:
    """Return the spread of phasors (b, R) in the last quarter over that before it; 0 within `still`."""
    quarters = np.array_split(phasor, 4)[1:]
    early, middle, late = (float(np.linalg.norm(part - part.mean(axis=0), axis=1).max()) for part in quarters)
    if late <= still * np.linalg.norm(phasor, axis=1).max():
        return 0.0
    return late / max(early, middle, 1e-300)


def summary(outcomes: list[Outcome]) -> str:
    """Return a table of outcomes by label; a scene counts under each of its labels."""
    rows = []
    for label in ("any", *sorted({label for outcome in outcomes for label in outcome.trial.labels})):
        chosen = [o for o in outcomes if label == "any" or label in o.trial.labels]
        failed, infinite = sum(o.failed for o in chosen), sum(not o.finite for o in chosen)
        worst = [f"{max((o.rate[run] for o in chosen), default=math.nan):+.1e}" for run in ("driven", "free")]
        rows.append([label, str(len(chosen)), str(failed), str(infinite), *worst])
    return table(["scenes with", "count", "failed", "not finite", "worst rate, driven", "free"], rows)


def _numbered(task: tuple[int, int, float]) -> Outcome:
    torch.set_num_threads(1)
    logging.getLogger("autdtorch").setLevel(logging.ERROR)  # spacings are coarse on purpose
    trial = draw_trial(*task)
    outcome = run_trial(trial)
    if outcome.failed and outcome.finite:
        outcome = run_trial(replace(trial, steps=LONGER * trial.steps))
    return outcome
