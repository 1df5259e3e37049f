"""Faults of an emulated USB bus: what a loose plug, a busy hub or a hung chip do to a transfer."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import Literal, TypeAlias

from autdtorch.hardware.emulator.bus import EmulatedBus, EmulatedDevice, stall, time_out, unplugged
from autdtorch.utils.validation import integer_at_least, require_one_of

#: "time-out" and "short write": a transfer ends in mid-frame, with an error or without, and the chip takes
#: nothing until it is reset; "stall": the endpoint refuses until its halt is cleared; "unplug": the chip is
#: gone.
Fault: TypeAlias = Literal["time-out", "stall", "short write", "unplug"]
FAULTS: tuple[Fault, ...] = ("time-out", "stall", "short write", "unplug")


class FaultyBus(EmulatedBus):
    """A bus on which one thing goes wrong, once.

    Attributes:
        struck: whether it has.
    """

    def __init__(self, chips: Sequence[EmulatedDevice], fault: Fault, after: int) -> None:
        """Plug the chips in.

        Args:
            chips: on the bus.
            fault: what goes wrong.
            after: number of bytes that reach a chip before.

        Raises:
            ValueError: an unknown fault, or `after` below 0.
        """
        require_one_of("fault", fault, FAULTS)
        super().__init__(chips)
        self.struck = False
        self._fault = fault
        self._left = integer_at_least("after", after, 0)
        self._halted = False

    def bulk_write(self, dev_handle: int, ep: int, intf: int, data: array[int], timeout: int) -> int:
        """All of it at once, until the fault."""
        if self._halted:
            return self._refuse()
        if self.struck or len(data) <= self._left:
            self._left -= len(data)
            return super().bulk_write(dev_handle, ep, intf, data, timeout)
        self.struck = self._halted = True
        super().bulk_write(dev_handle, ep, intf, data[: self._left], timeout)
        if self._fault == "short write":
            return self._left
        if self._fault == "unplug":
            self.chips[dev_handle].present = False
        return self._refuse()

    def clear_halt(self, dev_handle: int, ep: int) -> None:
        """The endpoint works again."""
        super().clear_halt(dev_handle, ep)
        self._halted = False

    def _refuse(self) -> int:
        """Nothing is taken."""
        if self._fault == "short write":
            return 0
        if self._fault == "time-out":
            raise time_out()
        if self._fault == "stall":
            raise stall()
        raise unplugged()
