"""Files of states: what was changed in them is refused, and named."""

import dataclasses
import functools
import json

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import autdtorch as at
from autdtorch.methods import state_file
from autdtorch.methods.catalogue import METHODS

GUESS = torch.randn(2, 4, dtype=torch.complex128, generator=torch.Generator().manual_seed(1))
FOCI = {"model": "foci", "kernel": "phasor", "noise": "inferred"}
SMALL = [
    at.GABS(levels=3),
    at.LSSG(levels=3),
    at.LSS(),
    at.RandomSearch(evaluations=70),
    at.Identify(evaluations=13),
    at.Identify(evaluations=4, prior=at.Prior(GUESS)),
    at.BayesOpt(evaluations=7, initial=4),
    at.BayesOpt(evaluations=3, prior=at.Prior(GUESS), **FOCI),
    at.PhaseStepping(),
    at.GradientAscent(starts=2, steps=5),
    at.Holography("gs"),
]


@pytest.fixture(scope="module")
def states(make_objective, random_matrix, tmp_path_factory):
    """Every method, its problem, and the arrays of its state before and after the first evaluations."""
    objective, folder = make_objective(random_matrix(2, 4, 0)), tmp_path_factory.mktemp("states")
    cases, problem = [], at.Problem.of(objective)
    for method in SMALL:
        state = method.start(problem, seed=0)
        for _ in range(2):
            if not state.done:
                at.save_state(folder / "state.npz", method, state)
                with np.load(folder / "state.npz") as file:
                    cases.append((method, problem, dict(file)))
                state = method.tell(state, objective(method.ask(state)))
    return cases


def test_every_method_is_here(states):
    assert {method.name for method, _, _ in states} == set(METHODS)
    assert len(states) > len(SMALL)


def removed(array, draw):
    return None


def of_another_type(array, draw):
    other = {"f": "f4", "c": "c8", "i": "i4", "u": "i8", "b": "i8"}.get(array.dtype.kind, "S9000")
    return array.astype(draw(st.sampled_from([other, "U40"])))


def of_another_shape(array, draw):
    return draw(st.sampled_from([array[None], np.repeat(array[None], 2, axis=0), array.reshape(-1)[:0]]))


def of_another_value(array, draw):
    changed = array.reshape(-1).copy()
    at_index = draw(st.integers(0, changed.size - 1))
    kind = changed.dtype.kind
    other = {"f": [np.nan, np.inf, -1e300], "c": [np.nan, 1e300, 5j]}.get(kind, [0, 1, -1, 127])
    value = np.array(draw(st.sampled_from(other))).astype(changed.dtype)
    if kind == "U" or np.array_equal(value, changed[at_index], equal_nan=kind in "fc"):
        return None
    changed[at_index] = value
    return changed.reshape(array.shape)


DAMAGES = [removed, of_another_type, of_another_shape, of_another_value]


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_field_that_was_changed_is_refused_by_its_name(states, tmp_path, data):
    method, problem, arrays = data.draw(st.sampled_from(states))
    name = data.draw(st.sampled_from(sorted(arrays)))
    damage = data.draw(st.sampled_from(DAMAGES))
    damaged = dict(arrays)
    if (array := damage(arrays[name], data.draw) if arrays[name].size else None) is None:
        del damaged[name]
    else:
        damaged[name] = array
    np.savez(tmp_path / "state.npz", **damaged)
    with pytest.raises(ValueError, match=rf"state\.npz: .*{name}") as refused:
        at.load_state(tmp_path / "state.npz", method, problem)
    assert "\n" not in str(refused.value)


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_header_that_was_changed_is_refused(states, tmp_path, data):
    method, problem, arrays = data.draw(st.sampled_from(states))
    header = json.loads(str(arrays["header"]))
    place = data.draw(st.integers(0, len(header) - 1))
    header[place] = data.draw(st.sampled_from([None, 1, "", [], {}, {"drives": "0"}, [[header[0]]]]))
    damaged = {**arrays, "header": np.array(json.dumps(header))}
    np.savez(tmp_path / "state.npz", **damaged)
    with pytest.raises(ValueError, match=r"state\.npz: (header|state of)"):
        at.load_state(tmp_path / "state.npz", method, problem)


def test_files_of_older_versions_and_fields_that_nobody_saved_are_refused(states, tmp_path):
    method, problem, arrays = states[0]
    older = {name: array for name, array in arrays.items() if name != "header"}
    np.savez(tmp_path / "state.npz", origin=np.array("[]"), **older)
    with pytest.raises(ValueError, match=r"header: missing; must be .* of this version"):
        at.load_state(tmp_path / "state.npz", method, problem)
    method, problem, arrays = states[0]
    np.savez(tmp_path / "state.npz", **{**arrays, "search.more": np.zeros(2)})
    with pytest.raises(ValueError, match=r"search\.more: changed"):
        at.load_state(tmp_path / "state.npz", method, problem)


def test_a_state_goes_on_in_the_same_scene_and_matrix_alone(make_objective, random_matrix, tmp_path):
    method, path = at.GABS(levels=3), tmp_path / "state.npz"
    problem = at.Problem.of(make_objective(random_matrix(2, 4, 0)))
    moved = dataclasses.replace(problem.scene, control_points=problem.scene.control_points + 1e-3)
    others = {
        "scene": dataclasses.replace(problem, scene=moved),
        "transfer_matrix": dataclasses.replace(problem, transfer_matrix=random_matrix(2, 4, 1)),
        "start": dataclasses.replace(problem, start=torch.ones(4, dtype=torch.complex128)),
    }
    at.save_state(path, method, method.start(problem))
    at.load_state(path, method, at.Problem.of(make_objective(random_matrix(2, 4, 0))))
    for name, other in others.items():
        with pytest.raises(ValueError, match=rf"state of .*gabs.*{name}.*; must be of .*{name}"):
            at.load_state(path, method, other)


def scaled(pressure, factor):
    return factor * pressure.amin(dim=-1)


def around(weight):
    return lambda pressure: (weight * pressure).amin(dim=-1)


GOALS = {
    "paper's": lambda: at.weakest_focus,
    "weighted": lambda: at.WeakestFocus([1, 2]),
    "lowest": lambda: lambda pressure: pressure.amin(dim=-1),
    "lowest of all but one": lambda: lambda pressure: pressure[..., 1:].amin(dim=-1),
    "highest": lambda: lambda pressure: -pressure.amax(dim=-1),
    "twice": lambda: lambda pressure: 2 * pressure.amin(dim=-1),
    "default": lambda: lambda pressure, weight=2.5: weight * pressure.amin(dim=-1),
    "other default": lambda: lambda pressure, weight=3.5: weight * pressure.amin(dim=-1),
    "partial": lambda: functools.partial(scaled, factor=2.0),
    "other partial": lambda: functools.partial(scaled, factor=3.0),
    "closure": lambda: around(torch.tensor([1.0, 2.0], requires_grad=True)),
    "other closure": lambda: around(torch.tensor([1.0, 3.0])),
}


def test_a_state_goes_on_under_a_function_of_the_same_code_and_values_alone(tmp_path):
    method, path = at.GABS(levels=3), tmp_path / "state.npz"
    for name, made in GOALS.items():
        at.save_state(path, method, method.start(at.Problem(4, 2, made())))
        at.load_state(path, method, at.Problem(4, 2, made()))
        for other in GOALS.keys() - {name}:
            with pytest.raises(ValueError, match=r"state of .*goal.*; must be of"):
                at.load_state(path, method, at.Problem(4, 2, GOALS[other]()))


# The search of each method in files of this version. Where it changes, `_VERSION` must, too.
VERSION = 5
SEARCHES = {
    "lss": "",
    "lssg": "before drifting foci order trend weights",
    "gabs": "before drifting order trend weights",
    "bayes_opt": "answer ends entries factors fitted fitted_values generators length_scale noise outliers "
    "points spread trend values variance",
    "identify": "answer drives ends entries factors fitted generators numbers observed outliers random "
    "spread trend variance",
    "phase_stepping": "generators matrix weight",
    "random_search": "generators",
    "gradient_ascent": "",
    "holography": "",
}


def test_searches_of_methods_belong_to_the_version_of_the_format(make_objective, random_matrix):
    objective = make_objective(random_matrix(2, 4, 0))
    names_of = {name: set() for name in METHODS}
    for method in SMALL:
        state = method.start(at.Problem.of(objective))
        names_of[method.name] |= set(state.search)
        while not state.done:
            state = method.tell(state, objective(method.ask(state)))
            names_of[method.name] |= set(state.search)
    searches = {name: " ".join(sorted(names)) for name, names in names_of.items()}
    assert (state_file._VERSION, searches) == (VERSION, SEARCHES)
