"""The state of a method in a file: plain NumPy arrays and a line of JSON, so that reading it runs no code.

The line holds a version of the format, what the state is of, and a digest of every array, so that nothing but
what `save_state` has written goes on.
"""

from __future__ import annotations

import dataclasses
import io
import json
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from autdtorch.methods.base import Method, Problem, State
from autdtorch.methods.solution import Solution
from autdtorch.methods.state_origin import differences, origin_of
from autdtorch.utils.array_types import AnyArray
from autdtorch.utils.digest import digest_of
from autdtorch.utils.files import read_arrays, replace_file
from autdtorch.utils.validation import invalid, path_of, require_kind, within

_BEST, _SEARCH, _HEADER = "best.", "search.", "header"
_VERSION = 3  # of the format; a new one where `State`, or what a method keeps in `search`, changes
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
    digests = {name: digest_of(array.shape, array) for name, array in arrays.items()}
    header = [_VERSION, origin_of(method, state.problem), digests]
    arrays[_HEADER] = np.array(json.dumps([*header, digest_of(*header)]))
    content = io.BytesIO()
    np.savez(content, **arrays)
    replace_file(path_of("path", path), content.getvalue())


def load_state(path: str | os.PathLike[str], method: Method, problem: Problem) -> State:
    """Load the state of a method from a file of `save_state`.

    Args:
        path: of the file.
        method: of the same settings as when the state was saved.
        problem: the same as when the state was saved: numbers of transducers and foci, goal, start, scene and
            transfer matrix. Of a goal that is a function, code and values are compared, but not what it finds
            by global names; of an object of a class of one's own, unless it is a dataclass, the name alone.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the state of another method or problem, a file of another version of the format, or one
            that is not as `save_state` wrote it. The message names the file and the field.
    """
    require_kind("method", method, Method)
    require_kind("problem", problem, Problem)
    arrays = read_arrays(path_of("path", path))
    with within(os.fspath(path)):
        _require_as_saved(arrays, arrays.pop(_HEADER, None), origin_of(method, problem))
    tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
    best = Solution(**{name: tensors[f"{_BEST}{name}"] for name in _COLUMNS})
    search = {
        name.removeprefix(_SEARCH): tensor for name, tensor in tensors.items() if name.startswith(_SEARCH)
    }
    seeds = tuple(map(int, arrays["seeds"]))
    return State(method, problem, seeds, tensors["trials"], tensors["drives"], search, best)


def _require_as_saved(
    arrays: Mapping[str, AnyArray], header: AnyArray | None, origin: dict[str, Any]
) -> None:
    """Check the header of a file: its version, what it is the state of, and the digest of each array."""
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
        found, wanted = differences(written, origin)
        raise ValueError(f"state of {found}; must be of {wanted}")
    missing = [f"{name}: missing" for name in digests if name not in arrays]
    there = {name: digest_of(array.shape, array) for name, array in arrays.items()}
    changed = [f"{name}: changed" for name, digest in there.items() if digest != digests.get(name)]
    if missing or changed:
        raise ValueError(f"{', '.join(missing + changed)}; must be as save_state wrote it")
