"""Faults of an emulated bench: a loose plug, a busy hub or a hung chip, and whatever disturbs a sensor."""

from array import array
from collections.abc import Callable, Sequence

from autdtorch.hardware import EmulatedBench, EmulatedSensor
from autdtorch.hardware.emulator.bench import EmulatedBus, EmulatedDevice, stall, time_out, unplugged

#: "time-out" and "short write": a transfer ends in mid-frame, with an error or without, and the chip takes
#: nothing until it is reset; "stall": the endpoint refuses until its halt is cleared; "unplug": the chip is
#: gone.
FAULTS = ("time-out", "stall", "short write", "unplug")


class FaultyBus(EmulatedBus):
    """A bus with one fault, which strikes once, after a number of bytes."""

    def __init__(self, chips: Sequence[EmulatedDevice], fault: str, after: int) -> None:
        super().__init__(chips)
        self.struck = False
        self._fault = fault
        self._left = after
        self._halted = False

    def bulk_write(self, dev_handle: int, ep: int, intf: int, data: "array[int]", timeout: int) -> int:
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
        super().clear_halt(dev_handle, ep)
        self._halted = False

    def _refuse(self) -> int:
        if self._fault == "short write":
            return 0
        raise {"time-out": time_out, "stall": stall, "unplug": unplugged}[self._fault]()


class Disturbed(EmulatedSensor):
    """Counts its readings; `disturb` is called with their number before each."""

    def __init__(self, bench: EmulatedBench, disturb: Callable[[int], object] = int) -> None:
        super().__init__(bench)
        self.readings = 0
        self._disturb = disturb

    def read(self):
        self.readings += 1
        self._disturb(self.readings)
        return super().read()
