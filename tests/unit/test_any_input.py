"""Whatever is given to a public function: a result, or one line that names the field."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from public_calls import Call, public_calls
from wrong_values import WRONG, Wrong, spoiled

import autdtorch as at
from autdtorch.plot.view3d import animation, view

CALLS = public_calls()

EXPECTED = {
    ("load_scene", "source", "a dict"),  # a scene without the keys that it needs
    ("view3d", "volume", "itself, with nan"),  # which stands for what is not known
}

#: Kinds of annotations that let a kind of value in.
LET_IN = {
    type(None): ("None", "Any"),
    bool: ("bool", "Literal[False]"),
    str: ("str", "Literal", "Path"),
    bytes: (),
}


class Accepted(Exception):
    """The arguments were all checked, and nothing is to be drawn."""


@pytest.fixture(autouse=True)
def nothing_is_rendered(monkeypatch: pytest.MonkeyPatch) -> None:
    def stop() -> None:
        raise Accepted

    monkeypatch.setattr(animation, "require_rendering", stop)
    monkeypatch.setattr(view, "require_rendering", stop)


def refusal(function: Callable[..., Any], arguments: dict[str, Any]) -> Exception | None:
    """What a call with these arguments raises, warnings but those of results included."""
    with warnings.catch_warnings():
        for kind in (at.ScaleWarning, at.SteadyStateWarning):
            warnings.simplefilter("ignore", kind)
        try:
            function(**arguments)
        except Accepted:
            return None
        except Exception as error:
            return error
    return None


def complaint(call: Call, parameter: str, wrong: Wrong, error: Exception | None) -> str | None:
    """What is not as promised, if anything."""
    annotation = call.parameters[parameter]
    barred = type(wrong.value) in LET_IN and not any(kind in annotation for kind in LET_IN[type(wrong.value)])
    if error is None:
        return "taken" if wrong.never or barred else None
    if isinstance(error, OSError) and not wrong.never:
        return None  # accepted, but there is no such file or device
    text = str(error)
    if not isinstance(error, ValueError | TypeError):
        return f"{type(error).__name__}: {text[:200]}"
    field = text.partition(":")[0]
    if "\n" in text or len(text) > 500 or not any(name in field for name in call.parameters):
        return f"not one line of a field: {text[:200]!r}"
    return None


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS.keys())
def test_a_wrong_value_is_refused_in_a_line_that_names_the_field(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    function = call.bound(tmp_path)
    complaints = []
    for parameter, annotation in call.parameters.items():
        valid = call.argument(parameter, tmp_path)
        for wrong in (*WRONG, *spoiled(valid)):
            if annotation == "Any" or (callable(valid) and callable(wrong.value)):
                continue  # what is wrong with a function shows where it is called
            error = refusal(function, call.arguments(tmp_path) | {parameter: wrong.value})
            found = complaint(call, parameter, wrong, error)
            if found and (call.name, parameter, wrong.name) not in EXPECTED:
                complaints.append(f"{parameter} = {wrong.name}: {found}")
    if complaints:
        pytest.fail("\n".join(complaints), pytrace=False)
