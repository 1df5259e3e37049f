"""Simulations that Ultraino saves (.xml.gz): transducers with their strengths, sizes, phases and amplitudes.

The file is the text in which Java's XMLEncoder writes objects: a list of calls that set fields and
properties. Only these are followed, on records of values: nothing of the file is run. Ultraino's y axis,
along which its transducers emit, becomes z here.
"""

from __future__ import annotations

import math
import os
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, ParseError, TreeBuilder, XMLParser

import numpy as np

from autdtorch.utils.array_types import Array
from autdtorch.utils.files import require_file
from autdtorch.utils.validation import invalid, within

SUFFIX = ".xml.gz"

_LARGEST = 2**26  # [bytes] of unpacked text; a hundred transducers take 0.3 MB, with an animation 5 MB
_MOST = 2_000_000  # elements; an animation of 5 MB has 110,000
_DEEPEST = 200  # levels of elements; Ultraino writes 13
_GZIP = 16 + zlib.MAX_WBITS
_NUMBERS = ("float", "double", "int", "long", "short", "byte")
# Ultraino leaves out what has its default
_TRANSDUCER = {"power": 2.53, "apperture": 9e-3, "phase": 0.0, "amplitude": 0.0, "orderNumber": 0.0}
_ROTATION = {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}
_VECTOR = {"x": 0.0, "y": 0.0, "z": 0.0}


class UltrainoFile(NamedTuple):
    """The M transducers of a file, in the order of their numbers.

    Attributes:
        parts: positions (M, 3) [m], normals (M, 3), source_strength (M,) [Pa m] and radius (M,) [m].
        amplitudes: (M,), 0 to 1.
        phases: arg q (M,) [rad]; Ultraino corrects phases of devices elsewhere.
    """

    parts: dict[str, Array]
    amplitudes: Array
    phases: Array


@dataclass(eq=False, slots=True)
class _Record:
    """An object of the file: its class, its fields and the entries that were added to it."""

    kind: str = ""
    fields: dict[str, Any] = field(default_factory=dict)
    entries: list[Any] = field(default_factory=list)

    def get(self, name: str) -> Any:
        return self.fields.setdefault(name, _Record())


class _Field(NamedTuple):
    """A field of a class, on which `set` and `get` are called."""

    name: str


def read_ultraino(path: str | os.PathLike[str]) -> UltrainoFile:
    """Read a simulation of Ultraino; `ValueError` names the file and what is wrong."""
    reader = _Reader()
    try:
        parser = XMLParser(target=_Tree())
        parser.feed(_unpacked(Path(path)))
        reader.value(parser.close())
    except (ParseError, zlib.error, EOFError) as error:
        raise ValueError(f"{path}: {error}; must be a simulation saved by Ultraino, XML in gzip") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    lists = [simulation.fields.get("transducers") for simulation in reader.simulations]
    transducers = [entry for each in lists if isinstance(each, _Record) for entry in each.entries]
    if not transducers:
        raise ValueError(f"{path}: no transducers; must be a simulation saved by Ultraino with some")
    with within(path):
        return _transducers(transducers)


def _transducers(unsorted: list[Any]) -> UltrainoFile:
    order = np.argsort(_values("transducer", unsorted, _TRANSDUCER)["orderNumber"], kind="stable")
    records = [unsorted[index] for index in order]
    values = _values("transducer", records, _TRANSDUCER)
    poses = [_inner(record, "transform") for record in records]
    places = np.stack(
        [*_values("translation", [_inner(p, "translation") for p in poses], _VECTOR).values()], 1
    )
    turn = _values("rotation", [_inner(pose, "rot") for pose in poses], _ROTATION)
    w, x, y, z = (turn[name] for name in "wxyz")
    emitted = np.stack([2 * (x * y - w * z), w * w - x * x + y * y - z * z, 2 * (y * z + w * x)], axis=1)
    upright = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])  # x stays, y becomes z, z becomes -y
    parts = {
        "positions": places @ upright,
        "normals": emitted @ upright,
        "source_strength": values["power"],
        "radius": values["apperture"] / 2,
    }
    return UltrainoFile(parts, values["amplitude"], math.pi * values["phase"])


def _inner(record: Any, name: str) -> Any:
    return record.fields.get(name, _Record()) if isinstance(record, _Record) else None


def _values(what: str, records: list[Any], defaults: Mapping[str, float]) -> dict[str, Array]:
    """Return the numbers (M,) of the records by the names of their fields."""
    columns = {}
    for name, default in defaults.items():
        column = [
            record.fields.get(name, default) if isinstance(record, _Record) else None for record in records
        ]
        for number, value in enumerate(column):
            if not isinstance(value, float) or not math.isfinite(value):
                shown = "another object" if isinstance(value, _Record) else value
                raise invalid(f"{what} {number}, {name}", shown, "must be a finite number")
        columns[name] = np.array(column)
    return columns


def _unpacked(path: Path) -> bytes:
    """Return the text of a file, packed or not, of limited size."""
    content = require_file(path).read_bytes()
    if content[:2] != b"\x1f\x8b":
        text, rest = content[:_LARGEST], content[_LARGEST:]
    else:
        unpacker = zlib.decompressobj(_GZIP)
        text = unpacker.decompress(content, _LARGEST)
        rest = unpacker.unconsumed_tail
        if not unpacker.eof and not rest:
            raise EOFError("it breaks off")
    if rest:
        raise ValueError(f"more than {_LARGEST} bytes of text; Ultraino writes far less")
    return text


class _Tree(TreeBuilder):
    """A tree of limited depth and size, without a document type, which alone could define entities."""

    depth = count = 0

    def start(self, tag: Any, attrs: Any) -> Any:
        self.depth, self.count = self.depth + 1, self.count + 1
        if self.depth > _DEEPEST:
            raise ValueError(f"elements in more than {_DEEPEST} levels; Ultraino writes 13")
        if self.count > _MOST:
            raise ValueError(f"more than {_MOST} elements; Ultraino writes far fewer")
        return super().start(tag, attrs)

    def end(self, tag: Any) -> Any:
        self.depth -= 1
        return super().end(tag)

    def doctype(self, *_: object) -> None:
        raise ValueError("it has a document type; must be a simulation saved by Ultraino")


class _Reader:
    """Follows the calls of a file."""

    def __init__(self) -> None:
        self.simulations: list[_Record] = []
        self._named: dict[str, Callable[[], Any]] = {}

    def value(self, element: Element, target: Any = None) -> Any:
        """Return the value of an element: a call on a target, whose arguments are the elements in it.

        The call is made with the arguments read so far where an element within calls on its value.
        """
        arguments: list[Any] = []
        results: list[Any] = []

        def result() -> Any:
            if not results:
                results.append(None)  # of an element that names itself
                results[0] = self._called(element, target, arguments)
            return results[0]

        if "id" in element.attrib:
            self._named[element.attrib["id"]] = result
        if _is_object(element):
            result()
        for child in element:
            calls_on = child.tag == "void" and not child.attrib.keys() & {"class", "idref"}
            value = self.value(child, result() if calls_on else None)
            if child.tag != "void":
                arguments.append(value)
        return result()

    def _called(self, element: Element, target: Any, arguments: list[Any]) -> Any:
        attributes = element.attrib
        if _is_object(element):
            if "idref" in attributes:
                return self._named.get(attributes["idref"], lambda: None)()
            record = _Record(attributes.get("class", ""))
            if record.kind.endswith(".Simulation"):
                self.simulations.append(record)
            return record
        if element.tag in _NUMBERS:
            return float(element.text or "")
        if element.tag in ("string", "boolean", "char", "class"):
            return element.text or ""
        method, name = attributes.get("method"), attributes.get("property")
        if method == "getField" and arguments and isinstance(arguments[0], str):
            return _Field(arguments[0])
        if isinstance(target, _Field) and arguments and isinstance(arguments[0], _Record):
            if method == "set" and len(arguments) == 2:
                arguments[0].fields[target.name] = arguments[1]
            return arguments[0].get(target.name)
        if name is not None and isinstance(target, _Record):
            if arguments:
                target.fields[name] = arguments[-1]
            return target.get(name)
        if method == "add" and isinstance(target, _Record):
            target.entries += arguments
        return _Record()


def _is_object(element: Element) -> bool:
    return element.tag in ("object", "void") and not element.attrib.keys() & {"method", "property"}
