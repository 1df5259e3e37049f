"""What a state is of: the method, its settings, and the problem, so that it does not go on in another one."""

from __future__ import annotations

import dataclasses
import functools
import json
import types
from collections.abc import Iterator, Mapping
from typing import Any

import torch

from autdtorch.methods.base import Method, Problem
from autdtorch.objectives.goals import Goal
from autdtorch.utils.digest import digest_of

_SHOWN = 16  # digits of a digest


def origin_of(method: Method, problem: Problem) -> dict[str, Any]:
    """Return the settings of a method and the fields of a problem by name, as JSON gives them.

    Of a tensor, of the scene and of a goal that is no `Goal`, it is a digest.
    """
    origin = {
        "method": method.name,
        "settings": dataclasses.asdict(method),
        "transducers": problem.transducers,
        "foci": problem.foci,
        "goal": _goal(problem.goal),
        "start": problem.start,
        "scene": None if problem.scene is None else _digest(problem.scene),
        "transfer_matrix": problem.transfer_matrix,
    }
    found: dict[str, Any] = json.loads(json.dumps(origin, default=_digest))
    return found


def differences(written: Mapping[str, Any], wanted: Mapping[str, Any]) -> tuple[str, str]:
    """Return what differs in two origins, after the name of the method, as JSON."""
    names = [name for name in wanted if name == "method" or written[name] != wanted[name]]
    written_text, wanted_text = (json.dumps({name: own[name] for name in names}) for own in (written, wanted))
    return written_text, wanted_text


def _goal(goal: object) -> str:
    if isinstance(goal, Goal):
        return repr(goal)
    function = goal.func if isinstance(goal, functools.partial) else goal
    return f"{_named(function)} {_digest(goal)}"


def _digest(value: object) -> str:
    return digest_of(*_parts(value))[:_SHOWN]


def _named(value: object) -> str:
    return str(getattr(value, "__qualname__", type(value).__qualname__))


def _parts(value: object, closure: bool = True) -> Iterator[object]:
    """Yield what tells a value from others, in parts that have a digest.

    Of a function, that is its code, its defaults and the values of functions around it, not what it finds by
    global names. Of an object that is no dataclass, it is the name of its type.
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
            own = getattr(value, field.name)
            if field.compare or hasattr(own, "__array__"):
                yield field.name
                yield from _parts(own)
    elif isinstance(value, complex | bytes):
        yield repr(value)
    else:
        try:
            yield digest_of(value)
        except TypeError:
            yield _named(value)
