"""The methods as functions: each makes a method of its settings, and runs it on an objective.

Parameters and defaults are those of the method's class and of `run`. The stub beside this file repeats them
for editors and type checkers; a test compares both.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import numpy as np
import torch

from autdtorch.methods.base import Method
from autdtorch.methods.bayes_opt import BayesOpt
from autdtorch.methods.catalogue import VARIANTS
from autdtorch.methods.gabs import GABS
from autdtorch.methods.gradient import GradientAscent
from autdtorch.methods.identify import Identify
from autdtorch.methods.lssg import LSS, LSSG
from autdtorch.methods.phase_stepping import PhaseStepping
from autdtorch.methods.problem import Problem
from autdtorch.methods.random_search import RandomSearch
from autdtorch.methods.run import run
from autdtorch.methods.seeds import Trials
from autdtorch.methods.solution import Solution
from autdtorch.objectives.bound import checked_matrix
from autdtorch.objectives.objective import GoalFunction, Objective
from autdtorch.utils.hints import renamed_keywords
from autdtorch.utils.validation import ArrayLike

_OF_RUN = inspect.signature(run).parameters
_EITHER, _BY_NAME = inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY


def _function(
    name: str,
    method: Method,
    positional: str = "",
    execute: Callable[..., Solution] = run,
    details: str = "",
    continues: bool = False,
) -> Callable[..., Any]:
    """Return the function that runs a method with other settings.

    Args:
        name: of the function.
        method: has the defaults.
        positional: parameters after the objective that are also taken by position, in this order; all others
            by name only. By default settings, trials, seed and goal.
        execute: runs the method.
        details: second part of the docstring.
        continues: whether the function takes readings, which the method goes on from.
    """
    settings = {
        key: parameter.replace(default=getattr(method, key))
        for key, parameter in inspect.signature(type(method)).parameters.items()
    }
    of_run = [*(("trials", "seed") if method.random else ()), "goal", *(("readings",) if continues else ())]
    common = {key: _OF_RUN[key] for key in of_run}
    parameters = {**settings, **common}
    order = positional.split() or list(parameters)
    rest = [key for key in parameters if key not in order]
    objective = "Objective" if execute is run else "Objective | ArrayLike"
    signature = inspect.Signature(
        [
            inspect.Parameter("objective", _EITHER, annotation=objective),
            *(parameters[key].replace(kind=_EITHER) for key in order),
            *(parameters[key].replace(kind=_BY_NAME) for key in rest),
        ],
        return_annotation="Solution",
    )

    def call(*arguments: Any, **keywords: Any) -> Solution:
        if unknown := keywords.keys() - signature.parameters.keys():  # `bind` would name missing ones first
            raise TypeError(f"{name}() got an unexpected keyword argument '{min(unknown)}'")
        values = signature.bind(*arguments, **keywords).arguments
        changed = replace(method, **{key: values.pop(key) for key in settings if key in values})
        return execute(changed, **values)

    call.__name__ = call.__qualname__ = name
    call.__signature__ = signature  # type: ignore[attr-defined]
    kind = type(method).__name__
    call.__doc__ = f"Run `{kind}` with these settings; see `{kind}` and `run`.{details}"
    return renamed_keywords(score="goal")(call)


def _on_matrix(
    method: Method,
    objective: Objective | ArrayLike,
    trials: Trials = 1,
    seed: int = 0,
    goal: GoalFunction = _OF_RUN["goal"].default,
) -> Solution:
    """Run a method that reads the transfer matrix on an objective, or on the matrix alone."""
    listed = isinstance(objective, list | tuple)
    rows = listed and not any(isinstance(entry, Objective) for entry in cast(Any, objective))
    if not (rows or isinstance(objective, torch.Tensor | np.ndarray)):
        return run(method, cast(Objective, objective), trials, seed, goal=goal)
    matrix = torch.from_numpy(checked_matrix(cast(ArrayLike, objective), "objective"))
    points, transducers = matrix.shape
    state = method.start(Problem(transducers, points, goal, transfer_matrix=matrix), seed, trials)
    return method.best(method.tell(state, (method.ask(state) @ matrix.mT).abs()))


lss = _function("lss", LSS())
lssg = _function("lssg", LSSG())
gabs = _function("gabs", GABS())
_OF_BAYES_OPT = "evaluations initial trials seed fixed_transducer goal"
bayes_opt = _function("bayes_opt", BayesOpt(), _OF_BAYES_OPT, continues=True)
bo_foci = _function("bo_foci", VARIANTS["bo_foci"], _OF_BAYES_OPT, continues=True)
identify = _function("identify", Identify(), "evaluations trials seed", continues=True)
phase_stepping = _function("phase_stepping", PhaseStepping())
random_search = _function("random_search", RandomSearch())
gradient_ascent = _function(
    "gradient_ascent",
    GradientAscent(),
    execute=_on_matrix,
    details="\n\nIn place of the objective, it takes the transfer matrix G (P, M) [Pa] alone, too.",
)
