"""Values that a user could give by mistake or in bad faith, of every kind."""

import datetime
import functools
import math
import warnings
from collections import UserList, deque
from collections.abc import Callable, Iterator, Sequence
from decimal import Decimal
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
import torch


class Wrong(NamedTuple):
    """A value, and whether no parameter of any function may take it."""

    name: str
    value: Any
    never: bool = False


class OwnTensor(torch.Tensor):
    """A tensor of a subclass."""


def deep(levels: int) -> list[Any]:
    """A list in a list in a list."""
    nested: list[Any] = []
    for _ in range(levels):
        nested = [nested]
    return nested


class OwnList:
    """A class that NumPy takes for a list though it is no `Sequence`."""

    def __init__(self) -> None:
        self.entries: list[Any] = []
        self.extend = self.entries.extend

    def __len__(self) -> int:
        return len(self.entries)

    def __getitem__(self, index: int) -> Any:
        return self.entries[index]


class Broken(Sequence[Any]):
    """A list whose entries cannot be read."""

    def __len__(self) -> int:
        return 3

    def __getitem__(self, index: Any) -> Any:
        raise KeyError(index)


class BrokenArray:
    """An array that has no numbers."""

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise KeyError("numbers")


def holding_itself(times: int, kind: Callable[[], Any] = list) -> Any:
    """A list whose entries are the list itself."""
    loop = kind()
    loop.extend([loop] * times)
    return loop


def sharing(kind: Callable[[list[Any]], Any], levels: int = 15) -> Any:
    """A list that holds one below it ten times, and so on: small in memory, large as text."""
    value: Any = kind([1.0])
    for _ in range(levels):
        value = kind([value] * 10)
    return value


def quantised() -> torch.Tensor:
    """A tensor of 8 bits and a scale."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # PyTorch will drop this kind
        return torch.quantize_per_tensor(torch.ones(3), 0.1, 0, torch.quint8)


def nested() -> torch.Tensor:
    """A tensor of tensors of other lengths, of the layout for which PyTorch imports nothing."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of its age
        return torch.nested.nested_tensor([torch.ones(2), torch.ones(3)])


RECORDS = np.zeros(3, [("x", float)])


@functools.cache
def wrong_values() -> list[Wrong]:
    """Return values of all kinds."""
    return [
        Wrong("None", None),
        *(Wrong(repr(text), text) for text in ("text", "", "two\nlines", "nul\0", b"bytes")),
        Wrong("a dict", {"key": 1}),
        Wrong("an object", object(), never=True),
        Wrong("a function", math.sin),
        Wrong("a class", int),
        *(Wrong(str(number), number) for number in (math.nan, math.inf, -math.inf, 0, -1, -0.5, 1.5, 1 + 2j)),
        *(Wrong(str(truth), truth) for truth in (True, False, np.True_)),
        *(Wrong(f"10^{power}", 10**power) for power in (400, 5000)),
        Wrong("-10^400", -(10**400)),
        Wrong("a fraction", Fraction(3, 2)),
        Wrong("a fraction of 10^400", Fraction(10**400, 3)),
        *(Wrong(f"Decimal {number}", Decimal(number), never=True) for number in ("1.5", "nan", "1e999")),
        Wrong("1e400", np.longdouble("1e400"), never=True),
        Wrong("[]", []),
        Wrong("[[]]", [[]]),
        Wrong("a ragged list", [[1.0, 2.0], [3.0]], never=True),
        Wrong("a list of text", ["a", "b"]),
        Wrong("a list in itself", holding_itself(1), never=True),
        *(  # which keep NumPy busy for ever
            Wrong(f"a {kind.__name__} twice in itself", holding_itself(2, kind), never=True)
            for kind in (list, UserList, deque, OwnList)
        ),
        Wrong("lists that share", sharing(UserList), never=True),
        Wrong("a list that cannot be read", Broken(), never=True),
        Wrong("an array that cannot be read", BrokenArray(), never=True),
        Wrong("a deep list", deep(100_000), never=True),
        Wrong("masked", np.ma.masked, never=True),
        Wrong("a masked number", np.ma.array(1.0, mask=True), never=True),
        Wrong("a masked array", np.ma.array([0, 1, 2], mask=[False, True, False]), never=True),
        Wrong("masked records", np.ma.array(RECORDS, mask=[True, False, False]), never=True),
        Wrong("masked in a list", [1.0, np.ma.masked, 2.0], never=True),
        Wrong("records", RECORDS, never=True),
        Wrong("an array of objects", np.array([1, None, "a"], object), never=True),
        Wrong("a number as an array", np.array(1.5)),
        Wrong("an integer as an array", np.array(2)),
        Wrong("an empty array", np.zeros((0, 3))),
        Wrong("an array of text", np.array(["a", "b"])),
        Wrong("an array of 40 axes", np.zeros((1,) * 40), never=True),
        Wrong("dates", np.array(["2020-01-01"], "datetime64[D]"), never=True),
        Wrong("a date", datetime.date(2020, 1, 1), never=True),
        Wrong("a time", np.timedelta64(1, "s"), never=True),
        Wrong("a meta tensor", torch.zeros(3, device="meta"), never=True),
        Wrong("a number as a meta tensor", torch.zeros((), device="meta"), never=True),
        Wrong("a sparse tensor", torch.eye(3).to_sparse()),
        Wrong("a quantised tensor", quantised(), never=True),
        Wrong("a nested tensor", nested()),
        Wrong("a tensor of booleans", torch.ones(3, dtype=torch.bool)),
        Wrong("a tensor of 8 bits", torch.ones(3).to(torch.float8_e5m2)),
        Wrong("a tensor of unsigned integers", torch.ones(3, dtype=torch.uint64)),
        Wrong("a tensor with gradient", torch.ones(3, requires_grad=True)),
        Wrong("a list of meta tensors", [torch.zeros((), device="meta")] * 3, never=True),
    ]


def spoiled(valid: object) -> Iterator[Wrong]:
    """Arrays and lists like one that is accepted, with another entry, a mask or of another kind."""
    if isinstance(valid, bool | str | dict) or valid is None or callable(valid):
        return
    try:
        array = np.asarray(valid)
    except (TypeError, ValueError):
        return
    if array.dtype.kind not in "ifc" or array.size == 0:
        return
    mask = np.zeros(array.shape, bool)
    mask.flat[0] = True
    numbers = array.astype(complex if array.dtype.kind == "c" else float)
    tensor = torch.tensor(numbers)
    yield Wrong("itself, masked", np.ma.array(array, mask=mask), never=True)
    yield Wrong("itself, with an empty mask", np.ma.array(array))
    yield Wrong("itself, of objects", array.astype(object))
    yield Wrong("itself, as text", array.astype(str), never=True)
    yield Wrong("itself, on meta", tensor.to("meta"), never=True)
    yield Wrong("itself, of a subclass", tensor.as_subclass(OwnTensor))
    for end in (math.nan, math.inf):
        numbers.flat[-1] = end
        yield Wrong(f"itself, with {end}", numbers.copy(), never=True)
    if array.ndim == 0:
        return
    first, *rest = array.tolist()
    rows = [np.ma.array(row, mask=hidden) for row, hidden in zip(array, mask, strict=True)]
    yield Wrong("its rows, masked", rows, never=True)
    yield Wrong("itself, sparse", tensor.to_sparse())
    for name, entry in {"text": "a", "None": None, "a boolean": True, "10^400": 10**400}.items():
        yield Wrong(f"itself, with {name}", [entry, *rest], never=True)
    loop = [first, *rest]
    loop.append(loop)
    yield Wrong("itself, holding itself", loop, never=True)
