"""The state of a method in a file: plain NumPy arrays and a line of JSON, so that reading it runs no code.

The line holds a version of the format, method and problem of the state, and a digest of every array: a run
goes on from files that `save_state` has written alone.
"""

from __future__ import annotations

import dataclasses
import functools
import io
import json
import os
import types
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch

from autdtorch.methods.base import Method, State
from autdtorch.methods.problem import Problem
from autdtorch.methods.solution import Solution
from autdtorch.objectives.goals import Goal
from autdtorch.objectives.over_scenes import OverScenes
from autdtorch.objectives.readings import Readings
from autdtorch.utils.array_types import AnyArray
from autdtorch.utils.digest import digest_of
from autdtorch.utils.files import path_of, read_arrays, replace_file
from autdtorch.utils.validation import invalid, require_kind, within

_BEST, _SEARCH, _READINGS, _HEADER = "best.", "search.", "readings.", "header"
_OF_READINGS = ("drives", "pressure")
_VERSION = 5  # of the format; a new one where `State`, or the `search` of a method, changes
_SHOWN = 16  # digits of a digest
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
    tensors = {"seeds": seeds, "trials": state.trials, "drives": state.drives, "pressure": state.pressure}
    if state.readings is not None:
        tensors |= {f"{_READINGS}{name}": getattr(state.readings, name) for name in _OF_READINGS}
    tensors |= {f"{_BEST}{name}": getattr(state.best, name) for name in _COLUMNS}
    tensors |= {f"{_SEARCH}{name}": tensor for name, tensor in state.search.items()}
    arrays: dict[str, Any] = {name: tensor.numpy() for name, tensor in tensors.items()}
    digests = {name: digest_of(array.shape, array) for name, array in arrays.items()}
    header = [_VERSION, _origin_of(method, state.problem), digests]
    arrays[_HEADER] = np.array(json.dumps([*header, digest_of(*header)]))
    content = io.BytesIO()
    np.savez(content, **arrays)
    replace_file(path_of("path", path), content.getvalue())


def load_state(path: str | os.PathLike[str], method: Method, problem: Problem) -> State:
    """Load the state of a method from a file of `save_state`.

    Args:
        path: of the file.
        method: of the same settings as when the state was saved.
        problem: the same as when the state was saved: numbers of transducers and foci, goal, start, readings,
            scene and transfer matrix. Of a goal that is a function, code and values are compared, but not
            what it finds by global names; of an object of a user's class, unless it is a dataclass, the name
            alone.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the state of another method or problem, a file of another version of the format, or one
            that is not as `save_state` wrote it. The message names the file and the field.
    """
    require_kind("method", method, Method)
    require_kind("problem", problem, Problem)
    arrays = read_arrays(path_of("path", path))
    with within(os.fspath(path)):
        _require_as_saved(arrays, arrays.pop(_HEADER, None), _origin_of(method, problem))
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    best = Solution(**{name: tensors[f"{_BEST}{name}"] for name in _COLUMNS})
    search = {
        name.removeprefix(_SEARCH): tensor for name, tensor in tensors.items() if name.startswith(_SEARCH)
    }
    seeds = tuple(map(int, arrays["seeds"]))
    parts = {name: tensors[key] for name in _OF_READINGS if (key := f"{_READINGS}{name}") in tensors}
    readings = Readings(**parts) if parts else None
    trials, drives, pressure = (tensors[name] for name in ("trials", "drives", "pressure"))
    return State(method, problem, seeds, trials, drives, search, best, pressure, readings)


def _require_as_saved(
    arrays: Mapping[str, AnyArray], header: AnyArray | None, origin: dict[str, Any]
) -> None:
    """Check the header of a file: its version, method and problem, and the digest of each array."""
    if header is None:
        raise ValueError("header: missing; must be a file of save_state, of this version of autdtorch")
    try:
        version, written, digests, digest = json.loads(str(header))
        whole = digest == digest_of(version, written, digests)
    except (ValueError, TypeError, RecursionError) as error:
        raise invalid("header", str(header), "must be as save_state wrote it") from error
    if version != _VERSION:
        raise invalid("header: version", version, f"must be {_VERSION}, the one that this autdtorch writes")
    if not whole:
        raise ValueError("header: changed; must be as save_state wrote it")
    if written != origin:
        stored, wanted = _differences(written, origin)
        raise ValueError(f"state of {stored}; must be of {wanted}")
    missing = [f"{name}: missing" for name in digests if name not in arrays]
    there = {name: digest_of(array.shape, array) for name, array in arrays.items()}
    changed = [f"{name}: changed" for name, digest in there.items() if digest != digests.get(name)]
    if missing or changed:
        raise ValueError(f"{', '.join(missing + changed)}; must be as save_state wrote it")


def _origin_of(method: Method, problem: Problem) -> dict[str, Any]:
    """Return the settings of a method and the fields of a problem by name, as JSON gives them.

    Tensors, the scene and a goal that is no `Goal` are digests.
    """
    origin = {
        "method": method.name,
        "settings": dataclasses.asdict(method),
        "transducers": problem.transducers,
        "foci": problem.foci,
        "goal": _goal(problem.goal),
        "start": problem.start,
        "readings": problem.readings,
        "scene": None if problem.scene is None else _digest(problem.scene),
        "transfer_matrix": problem.transfer_matrix,
    }
    plain: dict[str, Any] = json.loads(json.dumps(origin, default=_digest))
    return plain


def _differences(written: Mapping[str, Any], wanted: Mapping[str, Any]) -> tuple[str, str]:
    """Return the entries that differ in two origins, after the name of the method, as JSON."""
    names = [name for name in wanted if name == "method" or written[name] != wanted[name]]
    return json.dumps({name: written[name] for name in names}), json.dumps(
        {name: wanted[name] for name in names}
    )


def _goal(goal: object) -> str:
    if isinstance(goal, OverScenes):
        return f"{goal.by} of {goal.scenes} scenes, {_goal(goal.goal)}"
    if isinstance(goal, Goal):
        return repr(goal)
    function = goal.func if isinstance(goal, functools.partial) else goal
    return f"{_named(function)} {_digest(goal)}"


def _digest(value: object) -> str:
    return digest_of(*_parts(value))[:_SHOWN]


def _named(value: object) -> str:
    return str(getattr(value, "__qualname__", type(value).__qualname__))


def _parts(value: object, closure: bool = True) -> Iterator[object]:
    """Yield parts, which have a digest, that distinguish a value from others.

    The parts of a function are its code, its defaults and the values of functions around it, without global
    names. The part of an object that is no dataclass is the name of its type.
    """
    if isinstance(value, torch.Tensor):
        yield value.detach().cpu()
    elif isinstance(value, tuple | list):
        yield len(value)
        for part in value:
            yield from _parts(part)
    elif isinstance(value, Mapping):
        yield from _parts(tuple(value.items()))
    elif isinstance(value, functools.partial):
        yield from _parts((value.func, *value.args, value.keywords))
    elif isinstance(value, types.CodeType):
        yield from (value.co_code.hex(), value.co_names)
        yield from _parts(value.co_consts)
    elif isinstance(value, types.FunctionType):
        yield from _parts(value.__code__)
        yield from _parts((*(value.__defaults__ or ()), *(value.__kwdefaults__ or {}).values()))
        for cell in (value.__closure__ or ()) if closure else ():  # functions there may be around each other
            yield from _parts(cell.cell_contents, closure=False)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        yield _named(value)
        for field in dataclasses.fields(value):
            part = getattr(value, field.name)
            if field.compare or hasattr(part, "__array__"):
                yield field.name
                yield from _parts(part)
    elif isinstance(value, complex | bytes):
        yield repr(value)
    else:
        try:
            yield digest_of(value)
        except TypeError:
            yield _named(value)
