from collections.abc import Sequence
from typing import Literal

from autdtorch.methods.prior import Prior
from autdtorch.methods.seeds import Trials
from autdtorch.methods.solution import Solution
from autdtorch.objectives.objective import GoalFunction, Objective
from autdtorch.objectives.readings import Readings
from autdtorch.utils.validation import ArrayLike

def lss(objective: Objective, goal: GoalFunction = ...) -> Solution: ...
def lssg(
    objective: Objective,
    levels: int = 16,
    order: Literal["given"] | Sequence[int] = "given",
    passes: int = 1,
    goal: GoalFunction = ...,
) -> Solution: ...
def gabs(
    objective: Objective,
    levels: int = 16,
    order: Literal["random", "given", "strength"] | Sequence[int] = "random",
    first: int | None = None,
    passes: int = 1,
    trials: Trials = 1,
    seed: int = 0,
    goal: GoalFunction = ...,
) -> Solution: ...
def bayes_opt(
    objective: Objective,
    evaluations: int = 256,
    initial: int = 16,
    trials: Trials = 1,
    seed: int = 0,
    fixed_transducer: int | None = None,
    goal: GoalFunction = ...,
    *,
    model: Literal["weakest", "foci"] = "weakest",
    kernel: Literal["phases", "circle", "phasor"] = "phases",
    acquisition: Literal["ei", "log_ei"] = "ei",
    initial_points: Literal["sobol", "random"] = "sobol",
    noise: float | Literal["inferred"] = 1e-4,
    prior: Prior | None = None,
    device: Literal["cpu", "cuda"] = "cpu",
    readings: Readings | None = None,
) -> Solution: ...
def bo_foci(
    objective: Objective,
    evaluations: int = 64,
    initial: int = 4,
    trials: Trials = 1,
    seed: int = 0,
    fixed_transducer: int | None = None,
    goal: GoalFunction = ...,
    *,
    model: Literal["weakest", "foci"] = "foci",
    kernel: Literal["phases", "circle", "phasor"] = "phasor",
    acquisition: Literal["ei", "log_ei"] = "ei",
    initial_points: Literal["sobol", "random"] = "sobol",
    noise: float | Literal["inferred"] = "inferred",
    prior: Prior | None = None,
    device: Literal["cpu", "cuda"] = "cpu",
    readings: Readings | None = None,
) -> Solution: ...
def identify(
    objective: Objective,
    evaluations: int | None = None,
    trials: Trials = 1,
    seed: int = 0,
    *,
    prior: Prior | None = None,
    goal: GoalFunction = ...,
    readings: Readings | None = None,
) -> Solution: ...
def phase_stepping(
    objective: Objective, rounds: int = 1, trials: Trials = 1, seed: int = 0, goal: GoalFunction = ...
) -> Solution: ...
def random_search(
    objective: Objective,
    evaluations: int = 256,
    levels: int | None = None,
    trials: Trials = 1,
    seed: int = 0,
    goal: GoalFunction = ...,
) -> Solution: ...
def gradient_ascent(
    objective: Objective | ArrayLike,
    starts: int = 32,
    steps: int = 300,
    trials: Trials = 1,
    seed: int = 0,
    goal: GoalFunction = ...,
) -> Solution: ...
