"""Docstrings of public names: every argument, shapes of arrays, units of quantities, errors that are raised.

The unit of a quantity goes by its name, which therefore means the same everywhere.
"""

import inspect
import re

import pytest

import autdtorch
from autdtorch.utils import validation

UNITS = {
    "deg C": {"temperature"},
    "%": {"relative_humidity"},
    "Hz": {"frequency"},
    "dB": {"isosurface", "snr"},
    "dB/m": {"absorption"},
    "kg/m^3": {"density"},
    "m": {
        *(
            "center",
            "control_points",
            "distance",
            "domain",
            "focus",
            "half_extents",
            "height",
            "lower",
            "margin",
        ),
        *("offset", "origin", "pitch", "points", "positions", "radius", "size", "sources", "spacing"),
        *("corners", "thickness", "upper", "vertices", "wavelength"),
    },
    "m/s": {"sound_speed"},
    "m^2": {"area", "cell_area"},
    "Np/m": {"attenuation"},
    "Pa": {
        "G",
        "field",
        "loudest",
        "mean",
        "min",
        "plane_pressure",
        "pressure",
        "reference",
        "silence",
        "std",
        "threshold",
        "transfer_matrix",
        "volume",
    },
    "Pa m": {"source_strength"},
    "rad": {"angle", "phase", "phase_offsets", "phases", "rotation"},
    "rad/m": {"complex_wavenumber", "wavenumber"},
    "rad/s": {"angular_frequency"},
    "bytes": {"memory"},
    "s": {"seconds", "seconds_in_a_row", "seconds_on", "settle", "time_step", "timeout"},
    "s/division": {"time_scale"},
    "V": {"dc_offset", "resolution", "volts"},
    "V/Pa": {"sensitivity"},
    "V/division": {"finest", "scales"},
}
UNIT_OF = {name: unit for unit, names in UNITS.items() for name in names}
WITHOUT_UNIT = {
    *(
        "amplitude",
        "amplitudes",
        "axis",
        "basis",
        "density_ratio",
        "drive",
        "drift",
        "duty_cycle",
        "evaluations",
        "faces",
        "gain",
        "gains",
        "loss",
        "mask",
        "noise",
    ),
    *("normal", "normals", "scale", "sensor", "speed_ratio", "tolerance", "transducers", "uniformity"),
    *("history", "score"),  # whatever the score function's is
}

ARRAY = re.compile(r"Tensor|ArrayLike|NDArray|Vector")
QUANTITY = re.compile(rf"^(?!Mapping|Callable).*\b(float|complex|{ARRAY.pattern})\b")
SHAPE = re.compile(r"\((\.\.\.|\w+,)[^()]*\)|shape")
CHECKS = [name for name, thing in vars(validation).items() if inspect.isfunction(thing) and name[0] != "_"]
REFUSES = re.compile(rf"\braise\b|\b({'|'.join(CHECKS)})\(")


def public_members():
    """By name: functions and classes of ``__all__``, in public submodules too, and members of classes."""
    submodules = [thing for name in autdtorch.__all__ if inspect.ismodule(thing := getattr(autdtorch, name))]
    for module in (autdtorch, *submodules):
        for name in module.__all__:
            thing = getattr(module, name)
            if inspect.isfunction(thing):
                yield name, thing
            elif inspect.isclass(thing):
                yield name, thing
                for own, member in vars(thing).items():
                    function = inspect.unwrap(getattr(member, "__func__", member))
                    if own[0] != "_" or (own in ("__init__", "__call__") and function.__doc__):
                        yield f"{name}.{own}", function


MEMBERS = dict(public_members())
CLASSES = {name: thing for name, thing in MEMBERS.items() if inspect.isclass(thing)}
PROPERTIES = {name: thing for name, thing in MEMBERS.items() if isinstance(thing, property)}
FUNCTIONS = {name: thing for name, thing in MEMBERS.items() if inspect.isfunction(thing)}


def each(things):
    return pytest.mark.parametrize(("name", "thing"), things.items(), ids=list(things))


def written(thing):
    """The docstring, and those that it refers to."""
    doc = inspect.getdoc(thing)
    for other in re.findall(r"(?:see|as for) `([\w.]+)`", doc):
        doc += f"\n\n{inspect.getdoc(MEMBERS.get(other))}"
    return doc


def section(doc, title):
    """Text of a section of a docstring, or None."""
    found = re.search(rf"^{title}:\n((?:    .*\n|\n)+)", f"{doc}\n", re.M)
    return found and found[1]


def entries(doc, title):
    """Names and texts of the entries of a section."""
    return dict(re.findall(r"^    (\w+): (.*\n(?:      .*\n|\n)*)", section(doc, title) or "", re.M))


def problems(name, annotation, text):
    """What a description of a quantity lacks."""
    if ARRAY.search(str(annotation)) and not SHAPE.search(text):
        yield f"{name}: no shape in {text!r}"
    if QUANTITY.search(str(annotation)):
        if name not in UNIT_OF and name not in WITHOUT_UNIT:
            yield f"{name}: has it a unit? List it in this test"
        if name in UNIT_OF and f"[{UNIT_OF[name]}]" not in text:
            yield f"{name}: no [{UNIT_OF[name]}] in {text!r}"


@each(FUNCTIONS)
def test_functions_tell_what_they_take_and_give(name, thing):
    doc = written(thing)
    parameters = {
        key: given for key, given in inspect.signature(thing).parameters.items() if key not in ("self", "cls")
    }
    described = entries(doc, "Args")
    if section(doc, "Args"):
        assert list(described) == list(parameters)
    wrong = [f"{key}: not mentioned" for key in parameters if not re.search(rf"\b{key}", doc)]
    for key, parameter in parameters.items():
        wrong += problems(key, parameter.annotation, described.get(key, doc))
    returned = section(doc, "Returns") or doc
    if section(doc, "Returns") and ": " in returned.splitlines()[0]:
        wrong.append("what stands before a colon in the first line of Returns is shown as a type")
    given = str(inspect.signature(thing).return_annotation)
    if ARRAY.search(given) and not SHAPE.search(returned):
        wrong.append("no shape of what is returned")
    if REFUSES.search(inspect.getsource(thing)) and section(doc, "Raises") is None:
        wrong.append("no errors that it raises")
    assert not wrong


@each(PROPERTIES)
def test_properties_tell_shape_and_unit(name, thing):
    annotation = thing.fget.__annotations__["return"]
    assert not list(problems(name.rpartition(".")[-1], annotation, inspect.getdoc(thing)))


@each(CLASSES)
def test_classes_tell_shape_and_unit_of_their_attributes(name, thing):
    described, annotations = {}, {}
    for kind in reversed([kind for kind in thing.__mro__ if kind.__module__.startswith("autdtorch")]):
        described |= entries(inspect.getdoc(kind), "Attributes")
        annotations |= {key: given for key, given in kind.__annotations__.items() if key[0] != "_"}
    wrong = [f"{key}: not described" for key in annotations if key not in described]
    for key in annotations.keys() & described.keys():
        wrong += problems(key, annotations[key], described[key])
    assert not wrong
