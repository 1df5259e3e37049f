"""Every public function and method, with an accepted argument for each of its parameters.

A new function is called as soon as it is public.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from public_arguments import ARGUMENTS, INSTANCES, OTHERS
from public_values import Made

import autdtorch as at
from autdtorch import hardware, propagators

#: Results, parts of drivers, and calls that need a device.
NOT_CALLED_BY_USERS = """
Adapter Calibration Device Dialect Estimate Evaluation EvaluationLog FocusMetrics Goal HapticMetrics Method
Obstacle OpenMPDBoard Picture Playback Preflight Run SimulatedPropagator Solution State Sweep TMatrix
TMatrixPropagator UsbtmcPort Waveform
CallableFrames.wait Device.pack EmulatedBench.receive EmulatedScope.execute EmulatedScope.plug_into
FolderFrames.wait Oscilloscope.capture Oscilloscope.set_up ThermalCamera.deviation ThermalCamera.read_pulse
LimitedLink.play_sequence Link.play_sequence Link.play_prepared
lock_log open_autd3 uvc_frames
"""

#: Methods that the driver calls, and that authors of methods implement.
INSIDE_METHODS = """
advance at begin by_poses by_waves check checked climbed coarser farthest for_scene forms forward
images_around in_poses joined levels most_at_once most_evaluations near numbers_kept offsets recorded
require_fit section slope some_poses together_on wanted worst_bound write_file
"""


class Call(NamedTuple):
    """A public function, class or method; `owner` is the class of a method that needs an instance."""

    name: str
    function: Callable[..., Any]
    owner: type | None = None

    @property
    def parameters(self) -> dict[str, str]:
        """Annotations by name."""
        return _annotations(self.function)

    def argument(self, parameter: str, folder: Path) -> Any:
        """A value that it accepts for a parameter."""
        default = _parameters(self.function)[parameter].default
        value = OTHERS.get(f"{self.name}.{parameter}", ARGUMENTS.get(parameter, default))
        assert value is not inspect.Parameter.empty, f"add {self.name}.{parameter} to public_arguments.py"
        return value.make(folder) if isinstance(value, Made) else value

    def arguments(self, folder: Path, /, **chosen: Any) -> dict[str, Any]:
        """Values that it accepts, by parameter, with some chosen."""
        return {
            name: chosen[name] if name in chosen else self.argument(name, folder) for name in self.parameters
        }

    def bound(self, folder: Path) -> Callable[..., Any]:
        """The function, of an instance if it needs one."""
        if self.owner is None:
            return self.function
        maker = INSTANCES.get(self.owner.__name__)
        maker_call = Call(self.owner.__name__, self.owner)
        instance = (
            maker_call.function(**maker_call.arguments(folder)) if maker is None else maker.make(folder)
        )
        return getattr(instance, self.function.__name__)


@cache
def _parameters(function: Callable[..., Any]) -> Mapping[str, inspect.Parameter]:
    return inspect.signature(function).parameters


@cache
def _annotations(function: Callable[..., Any]) -> dict[str, str]:
    parameters = _parameters(function).values()
    return {each.name: str(each.annotation) for each in parameters if each.name != "self"}


def public_calls() -> dict[str, Call]:
    """All that have parameters, by name; a method that classes inherit is that of the first of them."""
    calls = [
        call
        for module in (at, at.analytic, hardware, propagators)
        for name in getattr(module, "__all__", dir(module))
        if callable(thing := getattr(module, name))
        for call in (_calls_of(thing) if inspect.isclass(thing) else [Call(name, thing)])
    ]
    called = [call for call in calls if call.parameters and call.name not in NOT_CALLED_BY_USERS.split()]
    return {call.name: call for call in {call.function: call for call in reversed(called)}.values()}


def _calls_of(kind: type) -> Iterator[Call]:
    """The constructor and the methods of a class."""
    protocol = getattr(kind, "_is_protocol", False)
    not_made = kind.__name__ in NOT_CALLED_BY_USERS.split() and kind.__name__ not in INSTANCES
    if issubclass(kind, BaseException) or protocol or not_made:
        return
    yield Call(kind.__name__, kind)
    # fields, as defaults may be functions
    inner = {*INSIDE_METHODS.split(), *getattr(kind, "__dataclass_fields__", {})}
    for name in dir(kind):
        member = inspect.getattr_static(kind, name)
        if isinstance(member, classmethod) and name[0] != "_":
            yield Call(f"{kind.__name__}.{name}", getattr(kind, name))
        elif not inspect.isfunction(member) or not member.__module__.startswith("autdtorch"):
            continue  # such as a method that comes from GPyTorch
        elif name not in inner and (name == "__call__" or name[0] != "_"):
            yield Call(f"{kind.__name__}.{name}", member, kind)
