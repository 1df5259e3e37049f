"""A property that is computed once for each object, without a lock."""

from __future__ import annotations

import functools
from typing import Any, Self, TypeVar, overload

T_co = TypeVar("T_co", covariant=True)


class cached_property(functools.cached_property[T_co]):  # noqa: TID251
    """`functools.cached_property` as of Python 3.12, also in 3.11.

    In 3.11 all objects of a class share a lock. Simulations in threads wait for each other, and a process
    that is forked while another thread holds the lock waits forever. Without it, two threads may compute a
    value at once; both get the first one.
    """

    @overload
    def __get__(self, instance: None, owner: type[Any] | None = None) -> Self: ...

    @overload
    def __get__(self, instance: object, owner: type[Any] | None = None) -> T_co: ...

    def __get__(self, instance: object, owner: type[Any] | None = None) -> Self | T_co:
        """Compute and store the value, which Python then reads without this call."""
        if instance is None:
            return self
        assert self.attrname is not None  # Python sets it when the class is made
        value: T_co = instance.__dict__.setdefault(self.attrname, self.func(instance))
        return value
