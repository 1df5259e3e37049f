"""Docstrings of public names give the shape of every array and the unit of every quantity.

The unit belongs to the name of the quantity, which therefore has one meaning everywhere.
"""

import inspect
import re

import pytest

import autdtorch

LENGTHS = (
    "center control_points corners distance domain focus half_extents height lower margin offset origin "
    "pitch points positions radius size sources spacing thickness upper vertices wavelength"
)
PRESSURES = (
    "G field loudest mean min plane_pressure pressure reference silence std threshold transfer_matrix volume"
)
UNITS = {
    "deg C": "temperature",
    "%": "relative_humidity",
    "Hz": "frequency",
    "dB": "isosurface snr",
    "dB/m": "absorption",
    "kg/m^3": "density",
    "m": LENGTHS,
    "m/s": "sound_speed",
    "m^2": "area cell_area",
    "Np/m": "attenuation",
    "Pa": PRESSURES,
    "Pa m": "source_strength",
    "rad": "angle phase phase_offsets phases rotation",
    "rad/m": "complex_wavenumber wavenumber",
    "rad/s": "angular_frequency",
    "bytes": "memory",
    "s": "seconds seconds_in_a_row seconds_on settle time_step timeout",
    "s/division": "time_scale",
    "V": "dc_offset resolution volts",
    "V/Pa": "sensitivity",
    "V/division": "finest scales",
}
UNIT_OF = {name: unit for unit, names in UNITS.items() for name in names.split()}

ARRAY = re.compile(r"Tensor|ArrayLike|NDArray|Vector")
ARRAYS = re.compile(rf"^(?!Callable|Mapping).*({ARRAY.pattern})")
SHAPE = re.compile(r"\((\.\.\.|\w+,)[^()]*\)|shape")
QUANTITY = re.compile(rf"^(?!Callable|Mapping).*\b(float|complex|{ARRAY.pattern})\b")


def public_members():
    """Yield functions and classes of ``__all__``, also of public submodules, and members of classes."""
    submodules = [thing for name in autdtorch.__all__ if inspect.ismodule(thing := getattr(autdtorch, name))]
    for module in (autdtorch, *submodules):
        for name in module.__all__:
            thing = getattr(module, name)
            if inspect.isfunction(thing):
                yield name, thing
            elif inspect.isclass(thing):
                yield name, thing
                inherited = {key for base in thing.__mro__[1:] for key in vars(base)} - {"__init__"}
                for key, member in vars(thing).items():
                    if key in inherited:
                        continue  # documented in the base class
                    function = inspect.unwrap(getattr(member, "__func__", member))
                    if key[0] != "_" or (key in ("__init__", "__call__") and function.__doc__):
                        yield f"{name}.{key}", function


MEMBERS = dict(public_members())


def written(thing):
    """Return the docstring of a thing with those that it refers to."""
    doc = inspect.getdoc(thing) or ""
    for other in re.findall(r"(?:see|as for) `([\w.]+)`", doc):
        doc += f"\n\n{inspect.getdoc(MEMBERS.get(other))}"
    return doc


def entries(doc, title):
    """Return the texts of the entries of a section by name."""
    section = re.search(rf"^{title}:\n((?:    .*\n|\n)+)", f"{doc}\n", re.M)
    return dict(re.findall(r"^    (\w+): (.*\n(?:      .*\n|\n)*)", section[1] if section else "", re.M))


def described(thing):
    """Yield names, annotations and descriptions of parameters, results, properties and attributes."""
    doc = written(thing)
    if isinstance(thing, property):
        yield thing.fget.__name__, thing.fget.__annotations__["return"], doc
    elif inspect.isclass(thing):
        kinds = [kind for kind in thing.__mro__ if kind.__module__.startswith("autdtorch")]
        texts = {
            key: text for kind in kinds[::-1] for key, text in entries(written(kind), "Attributes").items()
        }
        for kind in kinds:
            for name, annotation in kind.__annotations__.items():
                if name[0] != "_":
                    yield name, annotation, texts.get(name, "")
    elif inspect.isfunction(thing):
        texts = entries(doc, "Args")
        signature = inspect.signature(thing)
        for name, parameter in signature.parameters.items():
            yield name, parameter.annotation, texts.get(name, doc)
        yield "return", signature.return_annotation, doc


@pytest.mark.parametrize("name", MEMBERS)
def test_docstrings_give_shapes_and_units(name):
    wrong = []
    for part, annotation, text in described(MEMBERS[name]):
        if ARRAYS.search(str(annotation)) and not SHAPE.search(text):
            wrong.append(f"{part}: no shape in {text!r}")
        if QUANTITY.search(str(annotation)) and part in UNIT_OF and f"[{UNIT_OF[part]}]" not in text:
            wrong.append(f"{part}: no [{UNIT_OF[part]}] in {text!r}")
    assert not wrong
