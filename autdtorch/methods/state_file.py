"""The state of a method in a file: plain NumPy arrays and a line of JSON, so that reading it runs no code."""

from __future__ import annotations

import dataclasses
import io
import json
import os
from typing import Any

import numpy as np
import torch

from autdtorch.methods.base import Method, Problem, State
from autdtorch.methods.solution import Solution
from autdtorch.objectives.goals import WEAKEST_FOCUS, Goal
from autdtorch.utils.digest import digest_of
from autdtorch.utils.files import replace_file
from autdtorch.utils.numpy_file import read_arrays
from autdtorch.utils.validation import path_of, require_kind

_BEST, _SEARCH, _ORIGIN = "best.", "search.", "origin"
_COLUMNS = tuple(field.name for field in dataclasses.fields(Solution))


def save_state(path: str | os.PathLike[str], method: Method, state: State) -> None:
    """Save the state of a method as a .npz file, which is replaced as a whole.

    Args:
        path: of the file.
        method: whose state it is. Its settings are saved, and compared when the file is loaded.
        state: between `tell` and `ask`.

    Raises:
        OSError: the file cannot be written.
    """
    require_kind("method", method, Method)
    require_kind("state", state, State)
    seeds = torch.tensor(state.seeds, dtype=torch.int64, device="cpu")
    tensors = {"seeds": seeds, "trials": state.trials, "drives": state.drives}
    tensors |= {f"{_BEST}{name}": getattr(state.best, name) for name in _COLUMNS}
    tensors |= {f"{_SEARCH}{name}": tensor for name, tensor in state.search.items()}
    arrays: dict[str, Any] = {name: tensor.numpy() for name, tensor in tensors.items()}
    arrays[_ORIGIN] = np.array(_origin(method, state.problem))
    content = io.BytesIO()
    np.savez(content, **arrays)
    replace_file(path_of("path", path), content.getvalue())


def load_state(path: str | os.PathLike[str], method: Method, problem: Problem) -> State:
    """Load the state of a method from a file of `save_state`.

    Args:
        path: of the file.
        method: of the same settings as when the state was saved.
        problem: with the same numbers of transducers and foci, and the same goal.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a damaged file, or the state of another method or problem. The message names the file.
    """
    require_kind("method", method, Method)
    require_kind("problem", problem, Problem)
    arrays = read_arrays(path_of("path", path))
    origin = _origin(method, problem)
    if (found := str(arrays.pop(_ORIGIN, ""))) != origin:
        raise ValueError(f"{os.fspath(path)}: state of {found or 'nothing'}; must be of {origin}")
    try:
        tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
        best = Solution(**{name: tensors[f"{_BEST}{name}"] for name in _COLUMNS})
        search = {
            name.removeprefix(_SEARCH): tensor for name, tensor in tensors.items() if name.startswith(_SEARCH)
        }
        seeds = tuple(map(int, arrays["seeds"]))
        state = State(method, problem, seeds, tensors["trials"], tensors["drives"], search, best)
        _require_consistent(state)
    except (KeyError, TypeError, IndexError, ValueError) as error:
        raise ValueError(f"{os.fspath(path)}: {error}; must be a file of save_state") from error
    return state


def _origin(method: Method, problem: Problem) -> str:
    """Return method, settings, size, goal and start of a problem as JSON; of a tensor, its digest.

    The paper's goal, and no start, are left out: older files do not name them.
    """
    settings = dataclasses.asdict(method)
    prior = settings.get("prior")
    if prior is not None and prior["transfer_matrix"] is None:  # then it is that of the problem
        prior["transfer_matrix"] = problem.transfer_matrix
    goal = problem.goal
    named = repr(goal) if isinstance(goal, Goal) else getattr(goal, "__qualname__", type(goal).__name__)
    goals = [] if goal == WEAKEST_FOCUS else [named]
    starts = [] if problem.start is None else [problem.start]
    parts = [method.name, settings, problem.transducers, problem.foci, *goals, *starts]
    return json.dumps(parts, default=digest_of)


def _require_consistent(state: State) -> None:
    """Check the shapes and types of what all methods share."""
    count, transducers, foci = len(state.seeds), state.problem.transducers, state.problem.foci
    evaluations = state.best.history.shape[-1]
    wanted = {
        "trials": (state.trials, (len(state.trials),), torch.int64),
        "drives": (state.drives, (len(state.trials), state.drives.shape[1], transducers), torch.complex128),
        "drive": (state.best.drive, (count, transducers), torch.complex128),
        "pressure": (state.best.pressure, (count, foci), torch.float64),
        "score": (state.best.score, (count,), torch.float64),
        "evaluations": (state.best.evaluations, (count,), torch.int64),
        "history": (state.best.history, (count, evaluations), torch.float64),
    }
    for name, (tensor, shape, dtype) in wanted.items():
        if tensor.shape != shape or tensor.dtype != dtype:
            found = f"{tensor.dtype} of shape {tuple(tensor.shape)}"
            raise ValueError(f"{name}: {found}; must be {dtype} of shape {shape}")
